"""One pass of the smoother on our own solver: over a fixed lag, or over the whole log.

Gauss–Newton on the chain of keyframes (`chain`). It follows the orders of `keyframes`, as the passes on GTSAM do. The
steps are compiled (`steps`); this module calls them in their order, and allocates.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.epochs import DVL, IMU_SAMPLE, READING, SENSOR, Epoch
from ...datasets.rig import Rig
from ...datasets.state import DIM, Belief
from ...datasets.trajectory import Trajectory
from ..between_keyframes import carry_on
from ..interface import OUTLIERS, Diverged
from ..keyframes import SUMMED, Keyframes
from ..physics.dvl_preintegration import DISPLACEMENT, VelocityWalk, given_rotation, preintegrate_readings
from ..physics.imu import BLOCK, compile_rig, first_sample
from ..physics.invariant import inject_moved, move
from ..physics.state import STATE, as_belief, as_record, with_rate_noise
from ..robust import LOSSES, width
from ..smoothers import GraphSmoother
from ..stages import stage
from ..unknown_start import refuse_lost_heading
from . import steps
from .chain import NODE, smooth_covariances
from .factors import FACTOR, LOOSE, TIGHT
from .steps import CAUSES, MOST_ITERATIONS, NO_ROOM, NOT_POSITIVE, SOLVED, WINDOW, count_outliers

WORDS = IMU_SAMPLE.itemsize // 8
"""Numbers of eight bytes in an IMU sample."""


@dataclass(frozen=True)
class Solving:
    """How the window is solved.

    Attributes:
        relinearize: thresholds of rotation (rad), position (m), velocity (m/s) and bias (its units) beyond which a
            keyframe is relinearised.
        extra_updates: Gauss–Newton steps after the one that takes in new factors, as long as anything moves.
        relinearize_prior: also where a keyframe touches the marginal prior.
        reach: keyframes that a step goes back to, besides those that it changes.
        to_optimum: iterate to the optimum at the end.
    """

    relinearize: tuple[float, float, float, float]
    extra_updates: int = 0
    relinearize_prior: bool = False
    reach: int = 1 << 40
    to_optimum: bool = False


class WindowPass:
    """One pass of a `GraphSmoother` on our own solver; for the arrays see `steps.extend`."""

    def __init__(self, config: GraphSmoother, solving: Solving, prior: Belief, rig: Rig) -> None:
        if not (np.isfinite(prior.P).all() and np.linalg.eigvalsh(prior.P).min() > -1e-12 * np.abs(prior.P).max()):
            raise Diverged("the prior's covariance is not positive semi-definite")
        self._config, self._solving = config, solving
        self._lost = self._begun = self._swept = False
        self._rig = compile_rig(rig, config.factors, config.inflate, config.earth_rotation)
        self._keyframes = Keyframes(config, self._rig["inflate"][0], prior.t_ns)
        self._walk = VelocityWalk()
        self._now_ns = self._covariance_due_ns = prior.t_ns
        self._ticks: deque[int] = deque()
        self._smoothed: list[tuple[int, NDArray[Any]]] = []
        self._w = _options(config, solving)
        self._nodes, self._points, self._blocks = np.zeros(16, NODE), np.zeros(16, STATE), np.zeros(16, BLOCK)
        self._factors, self._readings = np.zeros(0, FACTOR), np.zeros(0, READING)
        self._carries, self._displacements = np.zeros(0, BLOCK), np.zeros(0, DISPLACEMENT)
        self._imu = np.zeros(256, IMU_SAMPLE)
        self._anchor = as_record(prior)
        self._points[0] = self._anchor[0]
        node = self._nodes[:1]
        node["P"] = node["P_given"] = prior.P
        node["t_ns"], node["imu_from"], node["first"] = prior.t_ns, 1, -1
        self._add_free_factors()

    # --- the interface -----------------------------------------------------------------------------------------------

    @property
    def counts(self) -> dict[str, int]:
        """See `Pass.counts`; keyframes linearised anew, and blocks factored, are `relinearised` and `refactored`."""
        w, counts = self._w[0], self._keyframes.counts
        counts["relinearised"], counts["refactored"] = int(w["relinearised"]), int(w["refactored"])
        for kind, sensor in enumerate(SENSOR):
            if sensor in self._config.robust:
                counts[OUTLIERS + sensor] += int(w["outliers"][kind])
        return counts

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        if not self._begun:
            self._begun = True
            self._imu[:1] = first_sample(epoch.imu, self._rig)
            self._w["n_imu"] = 1
        self._now_ns = epoch.t_ns
        if epoch.tick:
            self._ticks.append(epoch.t_ns)
        self._keep_samples(epoch.imu)
        self._follow(self._keyframes.take(epoch.t_ns, epoch.readings))

    @stage("output")
    def belief(self) -> Belief:
        """See `Pass.belief`."""
        w = self._w[0]
        if w["unsolved"] <= w["newest"]:
            self._update(w["oldest"])
        a = w["newest"] & (len(self._nodes) - 1)
        node, state = self._nodes[a], self._points[a : a + 1].copy()
        state["P"] = node["P"]
        inject_moved(state, node["m"])
        waiting = self._keyframes.not_given_out()
        if waiting or node["t_ns"] != self._now_ns:
            carry_on(state, self._rig, *self._samples(a), self._now_ns, waiting, self._config.robust)
        return with_rate_noise(as_belief(self._now_ns, state), self._rig)

    def finish(self) -> Trajectory | None:
        """See `Pass.finish`. States still in the window have seen less than the lag."""
        if self._lost:
            raise Diverged("the estimate diverged before the end")
        if not self._begun:
            return None
        self._follow(self._keyframes.finish())
        w = self._w[0]
        self._update(w["oldest"], self._solving.to_optimum)
        smooth_covariances(self._nodes, w["oldest"], w["newest"])
        self._swept = True
        self._record(self._now_ns + 1)
        count_outliers(self._w, self._nodes, self._factors, w["newest"] + 1)
        beliefs = [with_rate_noise(as_belief(t_ns, state), self._rig) for t_ns, state in self._smoothed]
        return Trajectory.from_beliefs(beliefs, self._config.window_s) if beliefs else None

    # --- a step, as docs/window.md derives it ------------------------------------------------------------------------

    def _follow(self, orders: NDArray[np.int64]) -> None:
        """Do what `keyframes` has decided: extend the chain, record what leaves, solve, forget."""
        n = 0
        while n < len(orders):
            while (done := self._extend(orders, n)) == NO_ROOM:
                self._make_room(len(orders))
            n = done
            if n == len(orders):
                return  # late readings only: they are solved for with the next keyframe
            if orders[n, 0] == SUMMED:
                n = self._add_displacement(orders, n)
            oldest = int(orders[n, 2])
            until_ns = self._nodes["t_ns"][oldest & (len(self._nodes) - 1)]
            if self._ticks and self._ticks[0] < until_ns:
                self._record(until_ns)
            self._update(oldest)
            n += 1

    @stage("propagation")
    def _extend(self, orders: NDArray[np.int64], first: int) -> int:
        return steps.extend(
            self._w, self._nodes, self._points, self._blocks, self._factors, self._readings, self._carries, self._imu,
            self._rig, self._keyframes.rows, orders, first,
        )  # fmt: skip

    @stage("linearisation")
    def _add_displacement(self, orders: NDArray[np.int64], first: int) -> int:
        """Add the preintegrated-DVL factor of the interval just closed; return the place of the order to solve."""
        n = first
        while orders[n, 0] == SUMMED:
            n += 1
        readings, mask = self._keyframes.rows[orders[first:n, 2]], len(self._nodes) - 1
        k, tight = int(orders[first, 1]), "preintegrated-tight" in self._config.dvl
        a = k & mask
        x = self._points[a : a + 1].copy()
        move(x, self._nodes[a]["d"], x)
        begin, end = (int(self._nodes["imu_from"][j & mask] - self._w["imu_gone"][0]) for j in (k, k + 1))
        if np.isfinite(self._config.window_s):
            x["P"] = self._nodes[a]["P"]
            refuse_lost_heading(as_belief(int(self._nodes[a]["t_ns"]), x))
        displacement = preintegrate_readings(
            readings, self._imu[begin:end], int(self._nodes[a]["t_ns"]), x[0]["R_WB"], x[0]["b_g"], self._rig,
            self._config.dvl_between == "straight", self._walk,
        )  # fmt: skip
        N = displacement[0]["N"]
        f = steps.add_factor(self._w, self._nodes, self._factors, k, DVL, TIGHT if tight else LOOSE)
        self._displacements[f] = displacement[0]
        self._factors["K"][f], self._factors["cov"][f] = given_rotation(N) if tight else (0.0, N[3:, 3:])
        return n

    def _update(self, oldest: int, to_optimum: bool = False) -> None:
        """Solve with what is new by one Gauss–Newton step, and as many more as are asked for while anything moves.

        Then forget the keyframes before `oldest`.
        """
        w = self._w[0]
        if to_optimum:
            w["unsolved"] = w["oldest"]
        for _ in range(MOST_ITERATIONS if to_optimum else self._solving.extra_updates + 1):
            first = self._linearise(to_optimum)
            if first > w["newest"]:
                break
            reach = w["newest"] if to_optimum else self._solving.reach
            status = self._solve(first, reach) if first >= w["oldest"] else NOT_POSITIVE
            if status != SOLVED:
                self._give_up(CAUSES[status])
        else:
            if to_optimum:
                self._give_up("Gauss–Newton has not converged to an optimum of the whole log")
        if oldest > w["oldest"]:
            self._forget(oldest)

    @stage("linearisation")
    def _linearise(self, exact: bool) -> int:
        return steps.linearise(
            self._w, self._nodes, self._points, self._blocks, self._factors, self._readings, self._carries,
            self._displacements, self._anchor, self._rig, exact,
        )  # fmt: skip

    @stage("solve")
    def _solve(self, first: int, reach: int) -> int:
        return steps.solve(self._w, self._nodes, self._points, self._factors, first, reach)

    @stage("marginal")
    def _forget(self, oldest: int) -> None:
        steps.forget(self._w, self._nodes, self._points, self._factors, self._anchor, oldest)

    def _give_up(self, cause: str) -> None:
        self._lost = True
        raise Diverged(cause)

    # --- smoothed states ---------------------------------------------------------------------------------------------

    @stage("output")
    def _record(self, until_ns: int) -> None:
        """Record the smoothed states at the ticks before until_ns.

        The IMU carries the state from the keyframe before the tick, and adds its noise; see `GraphPass`.
        """
        w, mask = self._w[0], len(self._nodes) - 1
        k, newest = int(w["oldest"]), int(w["newest"])
        while self._ticks and self._ticks[0] < until_ns:
            t_ns = self._ticks.popleft()
            while k < newest and self._nodes["t_ns"][(k + 1) & mask] <= t_ns:
                k += 1
            a = k & mask
            node, state = self._nodes[a], self._points[a : a + 1].copy()
            if t_ns >= self._covariance_due_ns:
                self._covariance_due_ns = t_ns + self._config.smoothed_covariance_s * 1e9
                if not self._swept:
                    self._smooth_covariances(k, newest - 1)
                state["P"] = node["P_smoothed"]
            else:
                state["P"] = np.nan
            inject_moved(state, node["d"])
            if t_ns != node["t_ns"]:
                carry_on(state, self._rig, *self._samples(a), t_ns)
            self._smoothed.append((t_ns, state))

    @stage("marginal")
    def _smooth_covariances(self, low: int, newest: int) -> None:
        smooth_covariances(self._nodes, low, newest)

    # --- what is kept ------------------------------------------------------------------------------------------------

    def _samples(self, a: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the IMU sample before the keyframe in place a of the rings, and those since."""
        w, first = self._w[0], int(self._nodes["imu_from"][a] - self._w["imu_gone"][0])
        return self._imu[first - 1 : first], self._imu[first : w["n_imu"]]

    def _keep_samples(self, imu: NDArray[Any]) -> None:
        w = self._w[0]
        n, end = w["n_imu"], w["n_imu"] + len(imu)
        if end > len(self._imu):
            self._make_room(len(imu))
            n, end = w["n_imu"], w["n_imu"] + len(imu)
        if end > n:  # word by word: NumPy copies a record field by field, five times as slowly
            self._imu.view(np.int64)[n * WORDS : end * WORDS] = imu.view(np.int64)
            w["n_imu"] = end

    def _make_room(self, more: int) -> None:
        """Make room for as many more keyframes, factors and samples."""
        w = self._w[0]
        while w["n_free"] < more:
            self._add_free_factors()
        while w["newest"] - w["oldest"] + 1 + more > len(self._nodes):
            n, kept = len(self._nodes), np.arange(w["oldest"], w["newest"] + 1)
            for name in ("_nodes", "_points", "_blocks"):
                ring = getattr(self, name)
                longer = np.zeros(2 * n, ring.dtype)
                longer[kept & (2 * n - 1)] = ring[kept & (n - 1)]
                setattr(self, name, longer)
        if w["n_imu"] + more > len(self._imu):
            gone = int(self._nodes["imu_from"][w["oldest"] & (len(self._nodes) - 1)] - 1 - w["imu_gone"])
            kept = self._imu[gone : w["n_imu"]].copy()
            if 2 * (len(kept) + more) > len(self._imu):
                self._imu = np.zeros(2 * (len(kept) + more + len(self._imu)), IMU_SAMPLE)
            self._imu[: len(kept)] = kept
            w["n_imu"], w["imu_gone"] = len(kept), w["imu_gone"] + gone

    def _add_free_factors(self) -> None:
        w, n = self._w[0], len(self._factors)
        more = max(64, n)
        for name in ("_factors", "_readings", "_carries", "_displacements"):
            rows = getattr(self, name)
            setattr(self, name, np.concatenate([rows, np.zeros(more, rows.dtype)]))
        self._factors["next"][n:] = np.append(np.arange(n + 1, n + more), w["free"])
        w["free"], w["n_free"] = n, w["n_free"] + more


def _options(config: GraphSmoother, solving: Solving) -> NDArray[Any]:
    """Return a WINDOW record with the options filled in."""
    w = np.zeros(1, WINDOW)
    rotation, position, velocity, bias = solving.relinearize
    w["thresholds"] = np.repeat([rotation, position, velocity, bias, bias], 3)
    assert w["thresholds"].shape == (1, DIM)
    w["relinearize_prior"] = solving.relinearize_prior
    w["reach"], w["unsolved"], w["free"] = solving.reach, 1, -1
    for kind, sensor in enumerate(SENSOR):
        loss = config.robust.get(sensor)
        if loss is not None:
            w["loss"][0, kind] = LOSSES.index(loss)
            w["widths"][0, kind, 1:] = [width(loss, n) for n in (1, 2, 3)]
    return w
