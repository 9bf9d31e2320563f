"""One pass of any smoother on GTSAM: it follows the orders of `keyframes`; `solvers` does the solving.

A keyframe has pose, velocity and biases; neighbouring keyframes are connected by an IMU factor. The pass returns the
belief now, and each smoothed state as it is when it leaves the window.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from ...datasets.epochs import DVL, IMU_SAMPLE, SENSOR, Epoch
from ...datasets.rig import Rig
from ...datasets.state import DIM, Belief, NavState
from ...datasets.trajectory import Trajectory
from ..between_keyframes import carry_on
from ..interface import OUTLIERS, Diverged
from ..keyframes import AT_KEYFRAME, CARRIED, KEYFRAME, SOLVE, SUMMED, Keyframes
from ..physics.dvl_preintegration import VelocityWalk, preintegrate_readings
from ..physics.imu import BLOCK, compile_rig, first_sample, integrate, predict, split
from ..physics.state import STATE, as_belief, as_record, with_rate_noise
from ..robust import Loss, width
from ..smoothers import GraphSmoother
from ..stages import clock, stage
from ..unknown_start import refuse_lost_heading
from .gtsam_border import (
    carried_factor,
    displacement_factor,
    gtsam_failures,
    insert_state,
    preintegrate_imu,
    prior_factor,
    reading_factor,
    tight_displacement_factor,
)
from .imu_factor import imu_factor
from .losses import distance, rows, with_loss
from .solvers import Solver

ImuFactor = Literal["gtsam", "fathom"]


@dataclass
class Keyframe:
    """A state of the graph, and the IMU samples since, which carry it to later readings and ticks.

    Attributes:
        index: of its variables.
        t_ns: its time.
        before: the IMU sample that ends at it.
        imu: samples from it to the next keyframe.
        next_ns: time of the next keyframe, if there is one.
        robust: factors on it under a loss, each with its sensor and the loss's width.
    """

    index: int
    t_ns: int
    before: NDArray[Any] | None
    imu: NDArray[Any]
    next_ns: int | None = None
    robust: list[tuple[str, Any, float]] = field(default_factory=list)


class GraphPass:
    """One pass of a smoother on GTSAM."""

    def __init__(self, config: GraphSmoother, solver: Solver, prior: Belief, rig: Rig, imu_factor: ImuFactor) -> None:
        self._config, self._imu_factor = config, imu_factor
        self._rig = compile_rig(rig, config.factors, config.inflate, config.earth_rotation)
        self._R_BI = rig.imu.R_BS
        self._losses: list[Loss | None] = [config.robust.get(sensor) for sensor in SENSOR]
        self._start_ns = self._now_ns = prior.t_ns
        self._keyframes = Keyframes(config, self._rig["inflate"][0], prior.t_ns)
        self._walk = VelocityWalk()
        self._outliers: Counter[str] = Counter()
        self._solver = solver
        self._graph = gtsam.NonlinearFactorGraph()
        self._newest, self._solved = prior.state, 0  # newest keyframe that is solved for, and its index
        self._predicted = prior.state  # the keyframe after it, by the IMU
        self._belief: Belief | None = prior
        self._ticks: deque[int] = deque()
        self._smoothed: list[Belief] = []
        self._covariance_due_ns = prior.t_ns
        self._window: deque[Keyframe] = deque([Keyframe(0, prior.t_ns, None, np.zeros(0, IMU_SAMPLE))])
        certain = np.flatnonzero(prior.P.diagonal() == 0.0)
        if len(certain):
            raise Diverged(f"the prior has no variance in error component {certain[0]}; a graph needs some in each")
        try:
            np.linalg.cholesky(prior.P)
        except np.linalg.LinAlgError:
            raise Diverged("the prior's covariance is not positive definite") from None
        self._graph.add(prior_factor(as_record(prior), self._rig))
        with gtsam_failures():
            self._solve(0)

    # --- the interface -----------------------------------------------------------------------------------------------

    @property
    def counts(self) -> dict[str, int]:
        """See `Pass.counts`."""
        return {**+self._keyframes.counts, **self._outliers}

    @property
    def work(self) -> dict[str, int]:
        """How much was done, for `fathom timing counters`: see `Solver.work`, and the calls of our factors by GTSAM.

        Both are counted while `stages.clock` runs.
        """
        return {**self._solver.work(), "callbacks": sum(n for name, n in clock.calls.items() if "callback" in name)}

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        newest = self._window[-1]
        if newest.before is None:
            newest.before = first_sample(epoch.imu, self._rig)
        newest.imu = np.concatenate([newest.imu, epoch.imu]) if len(newest.imu) else epoch.imu
        self._now_ns = epoch.t_ns
        if epoch.tick:
            self._ticks.append(epoch.t_ns)
        orders = self._keyframes.take(epoch.t_ns, epoch.readings)
        with gtsam_failures():
            self._follow(orders)

    @stage("output")
    def belief(self) -> Belief:
        """See `Pass.belief`."""
        newest = self._window[-1]
        with gtsam_failures():
            self._flush()
            if self._belief is None:
                self._belief = self._solver.belief(newest.index, newest.t_ns)
        return self._carried_on(newest, self._belief, self._now_ns, self._keyframes.not_given_out())

    def finish(self) -> Trajectory | None:
        """See `Pass.finish`. States still in the window have seen less than the lag."""
        with gtsam_failures():
            self._follow(self._keyframes.finish())
            self._flush()
            self._solver.finish()
            self._record(list(self._window), gtsam.Values())
        return Trajectory.from_beliefs(self._smoothed, self._config.window_s) if self._smoothed else None

    # --- keyframes ---------------------------------------------------------------------------------------------------

    def _follow(self, orders: NDArray[np.int64]) -> None:
        """Do what `keyframes` has decided."""
        given, summed = self._keyframes.rows, []
        for what, k, x in orders.tolist():
            if what == KEYFRAME:
                self._make_keyframe(x)
            elif what in (AT_KEYFRAME, CARRIED):
                self._add_reading(self._window[k - self._window[0].index], given[x : x + 1].copy(), what == CARRIED)
            elif what == SUMMED:
                summed.append(x)
            elif what == SOLVE:
                if summed:
                    self._add_displacement(given[summed])
                    summed = []
                self._solve(x)

    def _make_keyframe(self, t_ns: int) -> None:
        """Close the newest keyframe's interval at t_ns, and start the next one there, tied to it by the IMU."""
        last = self._window[-1]
        assert last.before is not None
        last.imu, rest = split(last.imu, t_ns)
        last.next_ns = t_ns
        i, j = last.index, last.index + 1
        record, block = self._block(last, self._newest, t_ns)
        if self._imu_factor == "fathom":
            self._graph.add(imu_factor(i, j, block, record[0]["R_WB"], self._rig))
        else:
            preintegrated = preintegrate_imu(last.imu, last.before, block, self._rig, record[0]["p_WB_W"])
            self._graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), preintegrated))
        self._window.append(Keyframe(j, t_ns, last.imu[-1:], rest))
        self._predicted = self._predict(record, block, t_ns)

    def _solve(self, oldest: int) -> None:
        """Record what leaves the window, then solve, and read off the newest state.

        Args:
            oldest: the oldest keyframe that stays.
        """
        new, values = self._window[-1], gtsam.Values()
        insert_state(values, new.index, self._predicted, self._R_BI)
        leaving = [self._window.popleft() for _ in range(oldest - self._window[0].index)]
        self._record(leaving, values)
        t_s = (new.t_ns - self._start_ns) * 1e-9
        stamps: dict[Any, Any] = {key(new.index): t_s for key in (X, V, B)}
        self._solver.update(self._graph, values, stamps)
        self._graph = gtsam.NonlinearFactorGraph()
        state = self._solver.state(new.index)
        if not np.isfinite(state.p_WB_W).all():
            raise Diverged("the newest position is not finite")
        if new.index > 0:
            self._newest, self._solved, self._belief = state, new.index, None

    def _flush(self) -> None:
        """Give the solver the factors of late readings that no keyframe has included."""
        if self._graph.size():
            self._solver.update(self._graph, gtsam.Values(), {})
            self._graph = gtsam.NonlinearFactorGraph()
            self._newest, self._belief = self._solver.state(self._solved), None

    # --- factors -----------------------------------------------------------------------------------------------------

    def _add_reading(self, keyframe: Keyframe, reading: NDArray[Any], carried: bool) -> None:
        """Add the factor of a reading on `keyframe`, carried there by the IMU or taken as of it."""
        kind = int(reading["kind"][0])
        if not carried:
            self._add(keyframe, kind, reading_factor(keyframe.index, reading, self._rig))
            return
        state = self._newest if keyframe.index == self._solved else self._solver.state(keyframe.index)
        record, block = self._block(keyframe, state, int(reading["t_ns"][0]))
        self._add(keyframe, kind, carried_factor(keyframe.index, reading, block, record, self._rig))

    def _add(self, keyframe: Keyframe, kind: int, factor: Any) -> None:
        """Add a factor of a sensor's readings, under the sensor's loss if it has one."""
        loss = self._losses[kind]
        if loss is not None:
            limit = width(loss, rows(factor))
            factor = with_loss(factor, loss)
            keyframe.robust.append((SENSOR[kind], factor, limit))
        self._graph.add(factor)

    def _add_displacement(self, readings: NDArray[Any]) -> None:
        """Add the preintegrated-DVL factor of the interval just closed, of DVL readings in the order of their times."""
        last, new = self._window[-2], self._window[-1]
        if np.isfinite(self._config.window_s):
            if self._belief is None:
                self._belief = self._solver.belief(last.index, last.t_ns)
            refuse_lost_heading(self._belief)
        displacement = preintegrate_readings(
            readings, last.imu, last.t_ns, self._newest.R_WB, self._newest.b_g, self._rig,
            self._config.dvl_between == "straight", self._walk,
        )  # fmt: skip
        if "preintegrated-tight" in self._config.dvl:
            factor = tight_displacement_factor(last.index, new.index, displacement, self._rig)
        else:
            factor = displacement_factor(last.index, new.index, displacement["dp"][0], displacement["N"][0, 3:, 3:])
        self._add(last, DVL, factor)

    # --- states between keyframes ------------------------------------------------------------------------------------

    @stage("propagation")
    def _block(self, keyframe: Keyframe, state: NavState, t_ns: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the keyframe's state as a record, and the block from it to t_ns."""
        assert keyframe.before is not None
        block = np.zeros(1, BLOCK)
        record = as_record(Belief(keyframe.t_ns, state, np.zeros((DIM, DIM))))
        head, _ = split(keyframe.imu, t_ns)
        integrate(head, keyframe.before, state.b_a, state.b_g, self._rig, block)
        return record, block

    @stage("propagation")
    def _predict(self, record: NDArray[Any], block: NDArray[Any], t_ns: int) -> NavState:
        """Return the state at the block's end, t_ns."""
        end, F = np.zeros(1, STATE), np.empty((DIM, DIM))
        predict(block, record, self._rig[0]["gravity"], F, end)
        return as_belief(t_ns, end).state

    def _carried_on(
        self, keyframe: Keyframe, belief: Belief, t_ns: int, waiting: Sequence[NDArray[Any]] = ()
    ) -> Belief:
        """Return a belief at a keyframe, carried on to t_ns and corrected by the readings that wait."""
        if t_ns != keyframe.t_ns or waiting:
            assert keyframe.before is not None
            state = as_record(belief)
            carry_on(state, self._rig, keyframe.before, keyframe.imu, t_ns, waiting, self._config.robust)
            belief = as_belief(t_ns, state)
        return with_rate_noise(belief, self._rig)

    # --- smoothed states --------------------------------------------------------------------------------------------

    @stage("output")
    def _record(self, keyframes: list[Keyframe], new: gtsam.Values) -> None:
        """Record the smoothed states at the ticks after each keyframe; `new`: values that the solver lacks.

        The IMU carries the state from the keyframe before the tick, and adds its noise. The keyframe after the tick
        would lower the covariance; so between keyframes it is too large, that of velocity by 2 %.
        """
        for keyframe in keyframes:
            if keyframe.robust:
                self._count_outliers(keyframe, gtsam.Values(new))
            until_ns = self._now_ns + 1 if keyframe.next_ns is None else keyframe.next_ns
            while self._ticks and self._ticks[0] < until_ns:
                t_ns = self._ticks.popleft()
                if t_ns >= self._covariance_due_ns:
                    self._covariance_due_ns = t_ns + int(self._config.smoothed_covariance_s * 1e9)
                    belief = self._solver.belief(keyframe.index, keyframe.t_ns)
                else:
                    belief = Belief(keyframe.t_ns, self._solver.state(keyframe.index), np.full((DIM, DIM), np.nan))
                self._smoothed.append(self._carried_on(keyframe, belief, t_ns))

    def _count_outliers(self, keyframe: Keyframe, values: gtsam.Values) -> None:
        """Count the factors on a keyframe whose residual exceeds the width of their loss."""
        for sensor, factor, limit in keyframe.robust:
            for i in {gtsam.Symbol(key).index() for key in factor.keys()}:  # noqa: SIM118 - a factor is no dict
                if not values.exists(X(i)):
                    insert_state(values, i, self._solver.state(i), self._R_BI)
            self._outliers[OUTLIERS + sensor] += int(distance(factor, values) > limit)
