"""One pass of the window: a fixed-lag smoother of our own, and the whole log where the window has no end.

Gauss–Newton on the chain of keyframes (`window_chain`), with the policy and the factors of `graph_pass`. What costs
time is compiled (`window_steps`); here is what allocates, and what talks to Python.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.epochs import IMU_SAMPLE, READING, SENSOR, Epoch
from ...datasets.rig import Rig
from ...datasets.state import Belief
from ...datasets.trajectory import Trajectory
from ..interface import Diverged
from ..keyframes import LONGEST_SILENCE_S
from ..physics.dvl_preintegration import DISPLACEMENT
from ..physics.imu import BLOCK, compile_rig, first_sample
from ..physics.state import STATE, as_belief, as_record, with_rate_noise
from ..robust import width
from ..smoothers import GraphSmoother
from .chain import NODE
from .factors import FACTOR, LOSSES
from .steps import (
    CAUSES,
    CLOSE,
    DONE,
    FACTORS,
    NODES,
    OUT,
    PENDING,
    SAMPLES,
    SOLVE,
    STEP,
    TICKS,
    WINDOW,
    Store,
    believe,
    drive,
)

NEVER_NS = 1 << 62
"""Later than any valid time (LIMIT_NS)."""
NO_IMU, NO_READINGS = np.zeros(0, IMU_SAMPLE), np.zeros(0, READING)


@dataclass(frozen=True)
class Solving:
    """How the window is solved.

    Attributes:
        relinearize: thresholds of rotation (rad), position (m), velocity (m/s) and bias (its units) beyond which a
            keyframe is linearised anew.
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
    """One pass of a `GraphSmoother` on our own solver."""

    def __init__(self, config: GraphSmoother, solving: Solving, prior: Belief, rig: Rig) -> None:
        if not (np.isfinite(prior.P).all() and np.linalg.eigvalsh(prior.P).min() > -1e-12 * np.abs(prior.P).max()):
            raise Diverged("the prior's covariance is none")
        self._window_s, self._lost = config.window_s, False
        self._counted = sorted(config.robust)
        self._begun = False
        self._left: list[tuple[NDArray[Any], NDArray[Any]]] = []
        w = np.zeros(1, WINDOW)
        _tell(w[0], config, solving)
        w["now_ns"] = w["dvl_heard_ns"] = w["covariance_due_ns"] = prior.t_ns
        w["unsolved"], w["keyframes"], w["free"] = 1, 1, -1
        anchor = as_record(prior)
        self._store = Store(
            w, np.zeros(16, NODE), np.zeros(16, STATE), np.zeros(16, BLOCK), anchor, np.zeros(15), np.zeros(0, FACTOR),
            np.zeros(0, READING), np.zeros(0, BLOCK), np.zeros(0, DISPLACEMENT), np.zeros(256, IMU_SAMPLE),
            np.zeros(16, READING), np.zeros(16, np.int64), np.zeros(16, STATE), np.zeros(16, np.int64),
            compile_rig(rig, config.factors, config.inflate, config.earth_rotation),
        )  # fmt: skip
        self._make_room(FACTORS)
        node = self._store.nodes[:1]
        self._store.points[0] = anchor[0]
        node["P"] = node["P_given"] = prior.P
        node["t_ns"], node["imu_from"], node["imu_to"], node["first"], node["dvl"] = prior.t_ns, 1, 1, -1, -1

    @property
    def counts(self) -> dict[str, int]:
        """See `Pass.counts`; keyframes linearised anew, and blocks factored, are `relinearised` and `refactored`."""
        w = self._store.w[0]
        names = ("keyframes", "carried", "merged", "late", "late_used", "preintegrated", "not_summed")
        names += ("relinearised", "refactored")
        counts = Counter({name: int(w[name]) for name in names})
        for kind, sensor in enumerate(SENSOR):
            if sensor in self._counted:
                counts[f"outliers_{sensor}"] += int(w["outliers"][kind])
        return counts

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        if not self._begun:
            self._begun = True
            self._store.imu[:1] = first_sample(epoch.imu, self._store.rig)
            self._store.w["n_imu"] = 1
        self._drive(STEP, epoch)

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        w, out = self._store.w[0], np.empty(1, STATE)
        if w["unsolved"] <= w["newest"]:
            self._drive(SOLVE, Epoch(int(w["now_ns"]), NO_IMU, NO_READINGS, False))
        if (status := believe(self._store, out)) != DONE:
            self._give_up(status)
        return with_rate_noise(as_belief(int(self._store.w["now_ns"][0]), out), self._store.rig)

    def finish(self) -> Trajectory | None:
        """See `Pass.finish`. States still in the window have seen less than the lag: all that there was."""
        if self._lost:
            raise Diverged("the estimate was lost before the end")
        if not self._begun:
            return None
        self._drive(CLOSE, Epoch(int(self._store.w["now_ns"][0]), NO_IMU, NO_READINGS, False))
        self._take_out()
        beliefs = [
            with_rate_noise(as_belief(int(t_ns), states[k : k + 1]), self._store.rig)
            for times, states in self._left
            for k, t_ns in enumerate(times)
        ]
        return Trajectory.from_beliefs(beliefs, self._window_s) if beliefs else None

    def _drive(self, asked: int, epoch: Epoch) -> None:
        while (status := drive(self._store, asked, epoch.imu, epoch.readings, epoch.t_ns, epoch.tick)) < 0:
            self._make_room(-status)
        if status != DONE:
            self._give_up(status)

    def _give_up(self, status: int) -> None:
        self._lost = True
        raise Diverged(CAUSES[status])

    # --- room --------------------------------------------------------------------------------------------------------

    def _make_room(self, short: int) -> None:
        """Lengthen what the store is short of, or take out of it what nobody needs any more."""
        s, w = self._store, self._store.w[0]
        if short & NODES:
            n, keyframes = len(s.nodes), np.arange(w["head"], w["newest"] + 1)
            longer = {name: np.zeros(2 * n, getattr(s, name).dtype) for name in ("nodes", "points", "blocks")}
            for name, ring in longer.items():
                ring[keyframes & (2 * n - 1)] = getattr(s, name)[keyframes & (n - 1)]
            s = s._replace(**longer)
        if short & FACTORS:
            n, more = len(s.factors), max(64, len(s.factors))
            names = "factors", "readings", "carries", "displacements"
            s = s._replace(**{name: _longer(getattr(s, name), n + more) for name in names})
            s.factors["next"][n:] = np.append(np.arange(n + 1, n + more), w["free"])
            w["free"], w["n_free"] = n, w["n_free"] + more
        if short & SAMPLES:
            gone = int(s.nodes["imu_from"][w["head"] & (len(s.nodes) - 1)] - 1 - w["imu_gone"])
            kept = s.imu[gone : w["n_imu"]].copy()
            imu = s.imu if 2 * gone > len(s.imu) else np.zeros(2 * len(s.imu), IMU_SAMPLE)
            imu[: len(kept)] = kept
            s = s._replace(imu=imu)
            w["n_imu"], w["imu_gone"] = len(kept), w["imu_gone"] + gone
        if short & PENDING:
            s = s._replace(pending=_longer(s.pending, 2 * len(s.pending)))
        if short & TICKS:
            done = int(w["ticks_done"])
            kept = s.ticks[done : w["n_ticks"]].copy()
            ticks = s.ticks if 2 * done > len(s.ticks) else np.zeros(2 * len(s.ticks), np.int64)
            ticks[: len(kept)] = kept
            s = s._replace(ticks=ticks)
            w["n_ticks"], w["ticks_done"] = len(kept), 0
        if short & OUT:
            self._take_out()
            n = max(2 * int(w["n_ticks"] - w["ticks_done"]) + 2, len(s.out))
            s = s._replace(out=np.zeros(n, STATE), out_ns=np.zeros(n, np.int64))
        self._store = s

    def _take_out(self) -> None:
        """Keep what has left the window."""
        s = self._store
        n = int(s.w["n_out"][0])
        self._left.append((s.out_ns[:n].copy(), s.out[:n].copy()))
        s.w["n_out"] = 0


def _longer(rows: NDArray[Any], n: int) -> NDArray[Any]:
    """Return the rows with zeros behind them, n in all."""
    return np.concatenate([rows, np.zeros(n - len(rows), rows.dtype)])


def _tell(w: Any, config: GraphSmoother, solving: Solving) -> None:
    """Fill in what a WINDOW record is told."""
    w["window_ns"], w["merge_ns"] = config.window_s * 1e9, config.merge_ns
    w["period_ns"], w["timeout_ns"] = config.period_s * 1e9, config.keyframe_timeout_s * 1e9
    w["silence_ns"], w["hold_ns"] = int((config.period_s + LONGEST_SILENCE_S) * 1e9), config.max_hold_s * 1e9
    w["covariance_ns"] = int(min(config.hindsight_covariance_s * 1e9, NEVER_NS))
    w["preintegrates"], w["velocity"] = config.preintegrates, "velocity" in config.dvl
    w["tight"], w["straight"] = "preintegrated-tight" in config.dvl, config.dvl_between == "straight"
    rotation, position, velocity, bias = solving.relinearize
    w["thresholds"] = np.repeat([rotation, position, velocity, bias, bias], 3)
    w["extra_updates"], w["whole"] = solving.extra_updates, solving.relinearize_prior
    w["reach"], w["to_optimum"] = solving.reach, solving.to_optimum
    for kind, sensor in enumerate(SENSOR):
        loss = config.robust.get(sensor)
        if loss is not None:
            w["loss"][kind] = LOSSES.index(loss)
            w["width"][kind, 1:] = [width(loss, n) for n in (1, 2, 3)]
