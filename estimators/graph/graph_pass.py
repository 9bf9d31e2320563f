"""One pass of any smoother on GTSAM: keyframes, factors, and two trajectories; `solvers` does the solving.

One keyframe holds pose, velocity and biases; neighbours are tied by the IMU. A reading between keyframes is tied to the
keyframe before it, carried there by the IMU. The pass gives what it believes now, and of each state what it believes
when that state leaves the window.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from typing import Annotated, Any, Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from ...datasets.epochs import DVL, IMU_SAMPLE, SENSOR, Epoch
from ...datasets.rig import Rig
from ...datasets.state import DIM, Array, Belief, NavState
from ...datasets.trajectory import Trajectory
from ..interface import FACTORS, Diverged, Factors, Inflation, Pass
from ..physics.dvl_preintegration import preintegrate_dvl
from ..physics.elimination import normalised_square
from ..physics.imu import BLOCK, compile_rig, first_sample, integrate, over_world, predict, split
from ..physics.kalman import carry, correct, propagate
from ..physics.measurements import measure
from ..physics.state import STATE, as_belief, as_record, with_rate_noise
from ..robust import Loss, Losses, distance, m_estimator, rows, width, with_loss
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
from .solvers import EDGE_S, Solver

DvlFactor = Literal["velocity", "preintegrated-loose", "preintegrated-tight"]
LONGEST_SILENCE_S = 1.0
"""A first-order bias correction, and one factor's rounding, hold for about so long without a keyframe."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _once(dvl: frozenset[DvlFactor]) -> frozenset[DvlFactor]:
    if dvl >= {"preintegrated-loose", "preintegrated-tight"}:
        raise ValueError(
            "preintegrated-loose and preintegrated-tight sum the same readings, so each would be used twice: name one"
        )
    return dvl


@dataclass(frozen=True)
class GraphSmoother(ABC):
    """What every factor-graph smoother can be told; a kind of it says how it solves.

    A DVL reading makes a keyframe, or with keyframe_period_s the first one after that long. Where the DVL is silent for
    keyframe_timeout_s, the next other reading makes one; where everything is silent, time does, so that no IMU factor
    spans much more than a second. Between keyframes the belief is carried on and corrected as a filter would; the graph
    does not see that.

    Attributes:
        dvl: how DVL readings enter. "velocity": each by its own factor (eq. 4). "preintegrated-loose": summed to a
            displacement from keyframe to keyframe (eq. 6), turned by the gyro at the bias of the moment, as if the IMU
            factor had another gyro. "preintegrated-tight": the same displacement given the rotation between the
            keyframes and the gyro bias, so that with the IMU factor each gyro sample counts once. One of these two
            at most: over a second they differ little; over 5 s with a consumer's gyro, loose claims to know the
            attitude too well. With "velocity" beside it, the reading at a keyframe goes by its velocity and the others
            are summed, so that none is used twice. A reading that comes after its interval was closed goes by its
            velocity whatever is said here. So does an interval with a reading that leaves an axis unmeasured (wheel
            speed): as the vehicle turns, what is not known of one axis of B gets into every axis of the sum, and no
            displacement is known. `not_summed` counts the readings of such intervals, and of those that max_hold_s
            leaves out.
        dvl_between: within a preintegrated interval the velocity is held from one reading to the next, or runs
            straight, up to the reading at the interval's end (which so has a small part in two factors). Held, its
            covariance knows the DVL's and the gyro's noise but not what is lost by holding: on a vehicle that
            manoeuvres it claims too much.
        keyframe_period_s: None for every DVL reading (1 s with a preintegrated factor).
        keyframe_timeout_s: see above.
        max_hold_s: an interval with a longer silence of the DVL is not preintegrated; its readings go by velocity.
        merge_ns: a reading this close to a keyframe is taken as of it, and counted.
        factors: the sensors it may use.
        inflate: factor on the stated sigma by sensor; also "gyro" and "accel".
        robust: loss by sensor, "huber", "cauchy" or "tukey", of the widths of `robust`. Every factor of the sensor has
            it; `outliers_<sensor>` counts the residuals that are beyond the width when their keyframe leaves. A weight
            is as fresh as the linearisation of its factor, and stays as it is once a neighbour of its keyframe is
            marginalised out. Tukey and, less so, Cauchy have no single minimum: what lies beyond the width at the
            first guess, the IMU's prediction, has no pull and is not reconsidered unless others move the estimate. So
            a vehicle that is lost by more than the width never hears that sensor again.
        hindsight_covariance_s: period at which states with hindsight keep their covariance.
        earth_rotation: W turns with the Earth (see `imu`); needs the rig's latitude.
    """

    dvl: Annotated[frozenset[DvlFactor], Field(min_length=1), AfterValidator(_once)] = frozenset({"velocity"})
    dvl_between: Literal["held", "straight"] = "held"
    keyframe_period_s: Positive | None = None
    keyframe_timeout_s: Positive = 0.5
    max_hold_s: Positive = 1.5
    merge_ns: int = Field(default=5_000_000, ge=0)
    factors: Factors = FACTORS
    inflate: Inflation = Field(default_factory=dict)
    robust: Losses = Field(default_factory=dict)
    hindsight_covariance_s: Positive = 5.0
    earth_rotation: bool = False

    @property
    @abstractmethod
    def window_s(self) -> float:
        """How long a state is kept before it leaves with what has been learnt of it; infinite for the whole log."""

    @abstractmethod
    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""

    @property
    def preintegrates(self) -> bool:
        """Whether DVL readings are summed between keyframes."""
        return self.dvl != {"velocity"}

    @property
    def period_s(self) -> float:
        """Time between keyframes; 0 for one at every DVL reading."""
        return self.keyframe_period_s or (1.0 if self.preintegrates else 0.0)


@dataclass(frozen=True)
class GtsamSmoother(GraphSmoother):
    """What the smoothers on GTSAM can be told besides.

    Attributes:
        factorization: of the linear system; Cholesky fails on the IMU noise of a tactical grade.
    """

    factorization: Literal["QR", "CHOLESKY"] = "QR"

    @abstractmethod
    def solver(self, R_BI: Array) -> Solver:
        """Return a new solver for one pass."""

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        return GraphPass(self, prior, rig)


@plain_dataclass
class Keyframe:
    """A state of the graph, and the motion since: what later readings and ticks are carried by.

    Attributes:
        index: of its variables.
        t_ns: its time.
        before: the IMU sample that ends at it.
        imu: samples from it to the next keyframe.
        next_ns: time of the next keyframe, if there is one.
        dvl: DVL readings from it to the next keyframe, in order.
        doubted: factors on it under a loss, each with its sensor and the loss's width.
    """

    index: int
    t_ns: int
    before: NDArray[Any] | None
    imu: NDArray[Any]
    next_ns: int | None = None
    dvl: list[NDArray[Any]] = field(default_factory=list)
    doubted: list[tuple[str, Any, float]] = field(default_factory=list)


class GraphPass:
    """One pass of a `GtsamSmoother`."""

    def __init__(self, config: GtsamSmoother, prior: Belief, rig: Rig) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._rig = compile_rig(rig, config.factors, config.inflate, config.earth_rotation)
        self._R_BI = rig.imu.R_BS
        self._silence_ns = int((config.period_s + LONGEST_SILENCE_S) * 1e9)
        self._losses: list[Loss | None] = [config.robust.get(sensor) for sensor in SENSOR]
        self._inflate: list[float] = self._rig["inflate"][0].tolist()
        self._start_ns = self._now_ns = self._dvl_heard_ns = prior.t_ns
        self._solver = config.solver(rig.imu.R_BS)
        self._graph = gtsam.NonlinearFactorGraph()
        self._state = prior.state
        self._belief: Belief | None = prior
        self._pending: list[NDArray[Any]] = []  # readings after the last keyframe
        self._ticks: deque[int] = deque()
        self._hindsight: list[Belief] = []
        self._covariance_due_ns = prior.t_ns
        self._window: deque[Keyframe] = deque([Keyframe(0, prior.t_ns, None, np.zeros(0, IMU_SAMPLE))])
        certain = np.flatnonzero(prior.P.diagonal() == 0.0)
        if len(certain):
            raise Diverged(f"the prior has no variance in error component {certain[0]}; a graph needs some in each")
        self._graph.add(prior_factor(as_record(prior), self._rig))
        values = gtsam.Values()
        insert_state(values, 0, prior.state, self._R_BI)
        with gtsam_failures():
            self._update(values, self._window[0])

    # --- the interface -----------------------------------------------------------------------------------------------

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        newest = self._window[-1]
        if newest.before is None:
            newest.before = first_sample(epoch.imu, self._rig)
        newest.imu = np.concatenate([newest.imu, epoch.imu]) if len(newest.imu) else epoch.imu
        self._now_ns = epoch.t_ns
        if epoch.tick:
            self._ticks.append(epoch.t_ns)
        with gtsam_failures():
            if len(epoch.readings):
                self._receive(epoch.readings)
            while self._now_ns - self._window[-1].t_ns > self._silence_ns:
                self._make_keyframe(self._window[-1].t_ns + self._silence_ns)

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        newest = self._window[-1]
        with gtsam_failures():
            self._flush()
            if self._belief is None:
                self._belief = self._solver.belief(newest.index, newest.t_ns)
        return with_rate_noise(self._filter_on(newest, self._belief), self._rig)

    def finish(self) -> Trajectory | None:
        """See `Pass.finish`. States still in the window have seen less than the lag: all that there was."""
        with gtsam_failures():
            if self._now_ns - self._window[-1].t_ns > self._config.merge_ns:
                self._make_keyframe(self._now_ns)
            for reading in self._pending:
                self._add_reading(self._window[-1], reading)
            self._flush()
            self._solver.finish()
            self._leave(list(self._window), gtsam.Values())
        return Trajectory.from_beliefs(self._hindsight, self._config.window_s) if self._hindsight else None

    # --- keyframes ---------------------------------------------------------------------------------------------------

    def _receive(self, readings: NDArray[Any]) -> None:
        """Put every reading of an epoch where it belongs, and make the keyframes that they call for."""
        new = []
        for k in np.argsort(readings["t_ns"], kind="stable").tolist():
            reading = readings[k : k + 1]
            kind, t_ns = int(reading["kind"][0]), _time_of(reading)
            if np.isinf(self._inflate[kind]) or not np.isfinite(reading["sigma"]).any():
                continue
            if kind == DVL:
                self._dvl_heard_ns = self._now_ns
            if t_ns < self._window[-1].t_ns - self._config.merge_ns:
                self._receive_late(reading, t_ns)
            else:
                self._pending.append(reading)
                new.append((kind, t_ns))
        for kind, t_ns in new:
            if self._calls_for_keyframe(kind, t_ns):
                self._make_keyframe(t_ns)

    def _calls_for_keyframe(self, kind: int, t_ns: int) -> bool:
        since_ns = t_ns - self._window[-1].t_ns
        if since_ns <= self._config.merge_ns:
            return False
        period_ns = self._config.period_s * 1e9 - self._config.merge_ns
        if kind == DVL:
            return since_ns >= period_ns
        timeout_ns = self._config.keyframe_timeout_s * 1e9
        silent_ns = self._now_ns - self._dvl_heard_ns
        return silent_ns >= timeout_ns and since_ns >= max(period_ns, timeout_ns - self._config.merge_ns)

    def _receive_late(self, reading: NDArray[Any], t_ns: int) -> None:
        """Tie a reading older than the newest keyframe to the one before it, if that is still in the window."""
        keyframe = next((k for k in reversed(self._window) if k.t_ns <= t_ns + self._config.merge_ns), None)
        if keyframe is None:
            self.counts["late"] += 1
            return
        self.counts["late_used"] += 1
        self._add_reading(keyframe, reading)

    def _make_keyframe(self, t_ns: int) -> None:
        """Close the newest keyframe's interval at t_ns, start the next one there, and update the smoother."""
        last = self._window[-1]
        assert last.before is not None
        last.imu, rest = split(last.imu, t_ns)
        last.next_ns = t_ns
        new = Keyframe(last.index + 1, t_ns, last.imu[-1:], rest)
        i, j = last.index, new.index

        record, block = self._block(last, self._state, t_ns)
        state = self._predict(record, block, t_ns)
        preintegrated = preintegrate_imu(last.imu, last.before, block, self._rig, record[0]["p_WB_W"])
        self._graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), preintegrated))
        pending, self._pending = self._pending, []
        for reading in pending:
            at_ns = _time_of(reading)
            if at_ns > t_ns + self._config.merge_ns:
                self._pending.append(reading)
            elif self._config.preintegrates and int(reading["kind"][0]) == DVL:
                self._sum_or_use(last, new, reading)
            else:
                self._add_reading(new if abs(at_ns - t_ns) <= self._config.merge_ns else last, reading)
        if self._config.preintegrates:
            self._add_displacement(last, new)
        values = gtsam.Values()
        insert_state(values, j, state, self._R_BI)
        self._update(values, new)

    def _update(self, values: gtsam.Values, new: Keyframe) -> None:
        """Let what is about to leave the window leave with hindsight, then update, and read off the newest state."""
        t_s = (new.t_ns - self._start_ns) * 1e-9
        # a state of just the window's age stays, for it has yet to see `new`
        horizon_ns = new.t_ns - (self._config.window_s + 0.5 * EDGE_S) * 1e9
        leaving = []
        while self._window and self._window[0].t_ns < horizon_ns and self._window[0] is not new:
            leaving.append(self._window.popleft())
        self._leave(leaving, values)
        stamps: dict[Any, Any] = {key(new.index): t_s for key in (X, V, B)}
        self._solver.update(self._graph, values, stamps)
        state = self._solver.state(new.index)
        if not np.isfinite(state.p_WB_W).all():
            raise Diverged("the newest position is not finite")
        self._graph = gtsam.NonlinearFactorGraph()
        self.counts["keyframes"] += 1
        if new.index > 0:
            self._window.append(new)
            self._state, self._belief = state, None

    def _flush(self) -> None:
        """Let the smoother have the factors of late readings that no keyframe has taken along."""
        if self._graph.size():
            self._solver.update(self._graph, gtsam.Values(), {})
            self._graph = gtsam.NonlinearFactorGraph()
            self._state, self._belief = self._state_of(self._window[-1]), None

    # --- factors -----------------------------------------------------------------------------------------------------

    def _add_reading(self, keyframe: Keyframe, reading: NDArray[Any]) -> None:
        """Add the factor of a reading on `keyframe`, carried by the IMU where it was true later."""
        t_ns = _time_of(reading)
        if abs(t_ns - keyframe.t_ns) <= self._config.merge_ns:
            self.counts["merged"] += int(t_ns != keyframe.t_ns)
            self._add(keyframe, int(reading["kind"][0]), reading_factor(keyframe.index, reading, self._rig))
            return
        self.counts["carried"] += 1
        state = self._state if keyframe is self._window[-1] else self._state_of(keyframe)
        record, block = self._block(keyframe, state, t_ns)
        factor = carried_factor(keyframe.index, reading, block, record, self._rig)
        self._add(keyframe, int(reading["kind"][0]), factor)

    def _add(self, keyframe: Keyframe, kind: int, factor: Any) -> None:
        """Add a factor of a sensor's readings, under the sensor's loss if it has one."""
        loss = self._losses[kind]
        if loss is not None:
            limit = width(loss, rows(factor))
            factor = with_loss(factor, loss)
            keyframe.doubted.append((SENSOR[kind], factor, limit))
        self._graph.add(factor)

    def _sum_or_use(self, last: Keyframe, new: Keyframe, reading: NDArray[Any]) -> None:
        """Keep a DVL reading for the interval that it begins or lies in; at a keyframe, by velocity if asked for."""
        at_new = abs(_time_of(reading) - new.t_ns) <= self._config.merge_ns
        if at_new and "velocity" in self._config.dvl:
            self._add_reading(new, reading)
        elif at_new:
            new.dvl.append(reading)
            if self._config.dvl_between == "straight":
                last.dvl.append(reading)
        else:
            last.dvl.append(reading)

    def _add_displacement(self, last: Keyframe, new: Keyframe) -> None:
        """Add the preintegrated-DVL factor of an interval, or its readings one by one where the DVL was silent."""
        if not last.dvl:
            return
        readings = np.concatenate(last.dvl)
        readings = readings[np.argsort(readings["t_ns"], kind="stable")]
        times = np.concatenate([[last.t_ns], readings["t_ns"], [new.t_ns]])
        if np.diff(times).max() > self._config.max_hold_s * 1e9 or not np.isfinite(readings["sigma"]).all():
            one_by_one = np.flatnonzero(readings["t_ns"] < new.t_ns - self._config.merge_ns).tolist()
            self.counts["not_summed"] += len(one_by_one)
            for k in one_by_one:
                self._add_reading(last, readings[k : k + 1])
            return
        straight = self._config.dvl_between == "straight"
        inflate = self._rig["inflate"][0, DVL]
        imu = over_world(last.imu, self._state.R_WB, self._state.b_g, self._rig)
        displacement = preintegrate_dvl(
            imu, last.t_ns, readings["t_ns"].copy(), readings["z"][:, :3].copy(), inflate * readings["sigma"],
            self._state.b_g, self._rig, straight,
        )  # fmt: skip
        self.counts["preintegrated"] += len(readings)
        if "preintegrated-tight" in self._config.dvl:
            factor = tight_displacement_factor(last.index, new.index, displacement, self._rig)
        else:
            factor = displacement_factor(last.index, new.index, displacement["dp"][0], displacement["N"][0, 3:, 3:])
        self._add(last, DVL, factor)

    # --- states between keyframes ------------------------------------------------------------------------------------

    def _state_of(self, keyframe: Keyframe) -> NavState:
        return self._solver.state(keyframe.index)

    def _block(self, keyframe: Keyframe, state: NavState, t_ns: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the keyframe's state as a record, and the block from it to t_ns."""
        assert keyframe.before is not None
        block = np.zeros(1, BLOCK)
        record = as_record(Belief(keyframe.t_ns, state, np.zeros((15, 15))))
        head, _ = split(keyframe.imu, t_ns)
        integrate(head, keyframe.before, state.b_a, state.b_g, self._rig, block)
        return record, block

    def _predict(self, record: NDArray[Any], block: NDArray[Any], t_ns: int) -> NavState:
        """Return the state at the block's end, t_ns."""
        end, F = np.zeros(1, STATE), np.empty((DIM, DIM))
        predict(block, record, self._rig[0]["gravity"], F, end)
        return as_belief(t_ns, end).state

    def _carry(self, keyframe: Keyframe, belief: Belief, t_ns: int) -> Belief:
        """Return a belief at a keyframe, carried to t_ns."""
        if t_ns == keyframe.t_ns:
            return belief
        record, block = self._block(keyframe, belief.state, t_ns)
        record["P"] = belief.P
        carry(block, record, self._rig[0]["gravity"])
        return as_belief(t_ns, record)

    def _filter_on(self, keyframe: Keyframe, belief: Belief) -> Belief:
        """Return the belief at the newest keyframe, carried to now and corrected by the readings since."""
        if self._now_ns == keyframe.t_ns and not self._pending:
            return belief
        assert keyframe.before is not None
        state, block = as_record(belief), np.zeros(1, BLOCK)
        rest, before = keyframe.imu, keyframe.before
        for reading in [*sorted(self._pending, key=_time_of), None]:
            t_ns = self._now_ns if reading is None else max(_time_of(reading), keyframe.t_ns)
            part, rest = split(rest, t_ns)
            if len(part):
                propagate(state, self._rig, before, part, block)
                before = part[-1:]
            if reading is not None and not correct(state, self._rig, self._weighted(reading, state)):
                raise Diverged("the innovation covariance is not positive, or the state is not finite")
        return as_belief(self._now_ns, state)

    def _weighted(self, reading: NDArray[Any], state: NDArray[Any]) -> NDArray[Any]:
        """Return a reading of the noise that its loss leaves it with at a predicted state (a STATE record)."""
        loss = self._losses[int(reading["kind"][0])]
        r, H, C = np.empty(3), np.empty((3, 15)), np.empty((3, 3))
        if loss is None or not (n := measure(reading, 0, state, self._rig, r, H, C)):
            return reading
        weight = m_estimator(loss, n).weight(np.sqrt(normalised_square(n, r, H, C)))
        reading = reading.copy()
        reading["sigma"] = reading["sigma"] / np.sqrt(weight) if weight > 0 else np.inf
        return reading

    # --- hindsight ---------------------------------------------------------------------------------------------------

    def _leave(self, keyframes: list[Keyframe], new: gtsam.Values) -> None:
        """Record the ticks from each keyframe to the next, as the smoother sees them now; `new` is what it will get.

        A tick is carried by the IMU from the keyframe before, with the IMU's noise since then added, although the
        keyframe after it limits that too: between keyframes the covariance is on the safe side, of velocity by 2 %.
        """
        for keyframe in keyframes:
            if keyframe.doubted:
                self._count_outliers(keyframe, gtsam.Values(new))
            until_ns = self._now_ns + 1 if keyframe.next_ns is None else keyframe.next_ns
            while self._ticks and self._ticks[0] < until_ns:
                t_ns = self._ticks.popleft()
                if t_ns >= self._covariance_due_ns:
                    self._covariance_due_ns = t_ns + int(self._config.hindsight_covariance_s * 1e9)
                    belief = self._solver.belief(keyframe.index, keyframe.t_ns)
                else:
                    belief = Belief(keyframe.t_ns, self._state_of(keyframe), np.full((15, 15), np.nan))
                self._hindsight.append(with_rate_noise(self._carry(keyframe, belief, t_ns), self._rig))

    def _count_outliers(self, keyframe: Keyframe, values: gtsam.Values) -> None:
        """Count the factors on a keyframe that end beyond the width of their loss."""
        for sensor, factor, limit in keyframe.doubted:
            for i in {gtsam.Symbol(key).index() for key in factor.keys()}:  # noqa: SIM118 - a factor is no dict
                if not values.exists(X(i)):
                    insert_state(values, i, self._solver.state(i), self._R_BI)
            self.counts[f"outliers_{sensor}"] += int(distance(factor, values) > limit)


def _time_of(reading: NDArray[Any]) -> int:
    return int(reading["t_ns"][0])
