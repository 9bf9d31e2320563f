"""Drive one estimator through one log, time every step, and score what it said."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from ..datasets.epochs import SENSOR, Epoch, Voyage, cut
from ..datasets.log import AttitudeStream, HeadingStream, Log
from ..datasets.quantities import Positive
from ..datasets.rig import Rig
from ..datasets.state import Belief, TimeArray
from ..datasets.trajectory import Trajectory
from ..estimators.imu import compile_rig
from ..estimators.innovation import INNOVATION, innovations
from ..estimators.interface import Diverged, Estimator, Pass
from .metrics import (
    BLOCKS,
    Alignment,
    Dims,
    Pairs,
    ScoreError,
    Unit,
    align,
    associate,
    ate,
    check_step,
    coverage,
    drift,
    horizontal_error,
    nees,
    not_positive,
    outage_drift,
    rpe,
    segment_errors,
    state_errors,
)
from .step_time import step_histogram

Status: TypeAlias = Literal["done", "diverged", "failed"]

LOST_M = 1e7
"""Nothing on Earth is this far from W's origin, m: an estimate that says so has diverged."""

ON_TIME_NS = 1_000_000
"""A reading at most this much older than its epoch is true at it."""


@dataclass(frozen=True, eq=False)
class Result:
    """What one estimator said about one log, and what that cost.

    Attributes:
        status: "done"; "diverged" where the estimator lost itself; "failed" for anything else that ended it early.
        cause: why it is not done, in a sentence.
        failed_at_s: when, from the start of the log.
        online: the beliefs at the ticks, with no delay; None where it never came to the first tick.
        smoothed: the same states with hindsight; None where the estimator has none.
        step_ns: (epochs,) time of each `step`.
        belief_ns: (ticks,) time of each `belief`.
        finish_ns: time of `finish`.
        counts: what happened to readings, gaps and solvers, by name.
        duration_s: how much of the log was driven through.
        imu_samples: how many IMU samples went in.
        start: where the prior came from: "given" by the log's maker, else what `initialise` found: "static", "moving",
            and after a comma what is unusual in that.
        notes: how the start was found, in sentences.
        nis: INNOVATION rows, in the order of reception; None where they were not asked for.
    """

    status: Status
    cause: str | None
    failed_at_s: float | None
    online: Trajectory | None
    smoothed: Trajectory | None
    step_ns: TimeArray
    belief_ns: TimeArray
    finish_ns: int
    counts: dict[str, int]
    duration_s: float
    imu_samples: int
    start: str = "given"
    notes: tuple[str, ...] = ()
    nis: NDArray[Any] | None = None

    @property
    def outputs(self) -> dict[str, Trajectory]:
        """The trajectories there are: "online", "hindsight"."""
        every = {"online": self.online, "hindsight": self.smoothed}
        return {name: trajectory for name, trajectory in every.items() if trajectory is not None}


class Ending(NamedTuple):
    """How a run ended, and when; t_ns is None for one that came to its end."""

    status: Status
    cause: str | None = None
    t_ns: int | None = None


class Tape:
    """Beliefs and times as a run makes them; a belief is copied here, so a pass may reuse its arrays."""

    def __init__(self, ticks: int) -> None:
        self.step_ns: list[int] = []
        self.belief_ns: list[int] = []
        self.t_ns = np.zeros(ticks, np.int64)
        self.R_WB = np.zeros((ticks, 3, 3))
        self.vectors = np.zeros((ticks, 4, 3))  # p_WB_W, v_WB_W, b_a, b_g
        self.P = np.zeros((ticks, 15, 15))
        self.has_P = True  # settled by the first belief

    def keep(self, belief: Belief, t_ns: int) -> None:
        """Add a belief.

        Raises:
            Diverged: it is not finite, is off this planet, or has no covariance although the first one had.
            ValueError: it is for another time than the t_ns it was asked for.
        """
        _check_time(belief, t_ns)
        k, state = len(self.belief_ns), belief.state
        self.t_ns[k], self.R_WB[k], self.P[k] = t_ns, state.R_WB, belief.P
        row = self.vectors[k]
        row[0], row[1], row[2], row[3] = state.p_WB_W, state.v_WB_W, state.b_a, state.b_g
        if k == 0:
            self.has_P = not np.isnan(self.P[0]).all()
        if not (np.isfinite(row).all() and np.isfinite(self.R_WB[k]).all()):
            raise Diverged("the state is not finite")
        if np.abs(row[0]).max() > LOST_M:
            raise Diverged(f"the position is {np.abs(row[0]).max():.1e} m away")
        if self.has_P and not np.isfinite(self.P[k]).all():
            raise Diverged("the covariance is not finite")

    def trajectory(self) -> Trajectory | None:
        """Return the beliefs that were kept and timed; None where there are none."""
        n = len(self.belief_ns)
        if n == 0:
            return None
        p, v, b_a, b_g = (self.vectors[:n, i] for i in range(4))
        return Trajectory(self.t_ns[:n], self.R_WB[:n], p, v, b_a, b_g, self.P[:n] if self.has_P else None)


class Examiner:
    """Judges an estimator by readings that it has not seen yet: the NIS of each, against the belief from before it.

    It asks for the belief between the two halves of an epoch, its motion and its readings. Readings that come late are
    left out, for they speak of an earlier state; so are those of an estimator that keeps no covariance.

    Attributes:
        counts: readings left out because they came late ("nis_late"), or because S is not positive ("nis_undefined").
    """

    def __init__(self, estimator: Estimator, rig: Rig) -> None:
        self.counts = {"nis_late": 0, "nis_undefined": 0}
        self._rig = compile_rig(rig, estimator.factors, getattr(estimator, "inflate", {}))
        self._tables: list[NDArray[Any]] = []

    def wants(self, epoch: Epoch) -> bool:
        """Return whether any reading of the epoch is on time."""
        on_time = self._on_time(epoch)
        self.counts["nis_late"] += len(epoch.readings) - int(on_time.sum())
        return bool(on_time.any())

    def judge(self, belief: Belief, epoch: Epoch) -> None:
        """Take the innovations of the epoch's readings, given the belief at its time that has not seen them.

        Raises:
            ValueError: the belief is for another time.
        """
        _check_time(belief, epoch.t_ns)
        if np.isnan(belief.P).all():
            return
        table = innovations(belief, epoch.readings[self._on_time(epoch)], self._rig)
        defined = np.isfinite(table["nis"])
        self.counts["nis_undefined"] += int((~defined).sum())
        self._tables.append(table[defined])

    def table(self) -> NDArray[Any]:
        """Return all that was taken, as INNOVATION rows."""
        return np.concatenate([np.zeros(0, INNOVATION), *self._tables])

    @staticmethod
    def _on_time(epoch: Epoch) -> NDArray[np.bool_]:
        return epoch.t_ns - epoch.readings["t_ns"] <= ON_TIME_NS


def _check_time(belief: Belief, t_ns: int) -> None:
    if belief.t_ns != t_ns:
        raise ValueError(f"asked for a belief at {t_ns} ns, was given one at {belief.t_ns} ns")


def run_log(
    log: Log,
    estimator: Estimator,
    *,
    score_period_s: float = 1.0,
    max_gap_s: float = 1.0,
    timeout_s: float | None = None,
    nis: bool = False,
) -> Result:
    """Drive an estimator through a log, in the order of reception.

    Whatever the estimator raises ends the run, not the caller; only KeyboardInterrupt and its like pass through.

    Args:
        log: where it states no prior, `initialise` makes one.
        estimator: a configuration, as `create` returns it; it gets the sensors of its `factors`.
        score_period_s: beliefs are asked for this far apart: at the truth's own stamps, else on a regular grid.
        max_gap_s: longest gap in the IMU that is bridged.
        timeout_s: longest time for the whole run, looked at after each step; None for no limit.
        nis: judge the estimator by its innovations. It then gets each epoch in two halves, first the motion without
            readings, then the readings without motion, and is asked for its belief in between. A step's time is that of
            both halves; the belief is not charged, but what it leaves computed may make a smoother's next step cheaper.
            What is said stays the same, but for a graph smoother with late readings: asked for a belief, it takes their
            factors in at once and not with its next keyframe.

    Raises:
        DatasetError: no prior can be made for the log.
    """
    log, start, notes = _with_prior(log)
    assert log.prior is not None
    readings = sum(len(stream) for sensor, stream in log.streams.items() if sensor in estimator.factors)
    limit_ns = math.inf if timeout_s is None else perf_counter_ns() + timeout_s * 1e9
    smoothed, finish_ns, counts = None, 0, {}
    examiner = Examiner(estimator, log.rig) if nis else None
    with _collector_off():
        voyage = cut(log, score_ticks(log, score_period_s), estimator.factors, max_gap_s)
        tape = Tape(sum(epoch.tick for epoch in voyage.epochs))
        try:
            run = estimator.begin(log.prior, log.rig)
        except Diverged as error:
            ending = Ending("diverged", str(error), voyage.start_ns)
        except Exception as error:
            ending = Ending("failed", _describe(error), voyage.start_ns)
        else:
            ending = _drive(run, voyage, tape, limit_ns, examiner)
            smoothed, finish_ns, ending = _finish(run, voyage, ending)
            counts = dict(run.counts)

    driven = voyage.epochs[: len(tape.step_ns)]
    return Result(
        ending.status,
        ending.cause,
        None if ending.t_ns is None else (ending.t_ns - voyage.start_ns) * 1e-9,
        tape.trajectory(),
        smoothed,
        np.array(tape.step_ns, np.int64),
        np.array(tape.belief_ns, np.int64),
        finish_ns,
        {"readings": readings} | voyage.counts | (examiner.counts if examiner else {}) | counts,
        (driven[-1].t_ns - voyage.start_ns) * 1e-9 if driven else 0.0,
        sum(len(epoch.imu) for epoch in driven),
        start,
        notes,
        examiner.table() if examiner else None,
    )


def _with_prior(log: Log) -> tuple[Log, str, tuple[str, ...]]:
    """Return the log with a prior, where that came from, and in sentences how it was made."""
    if log.prior is not None:
        return log, "given", ()
    from ..datasets.initialise import initialise

    found = initialise(log)
    return log.with_prior(found.belief), found.start, found.notes


def _drive(run: Pass, voyage: Voyage, tape: Tape, limit_ns: float, examiner: Examiner | None) -> Ending:
    """Hand over every epoch, in halves for an examiner; time `step` and `belief` apart, and collect garbage outside."""
    clock, step, step_ns = perf_counter_ns, run.step, tape.step_ns.append
    t_ns = voyage.start_ns
    try:
        for epoch in voyage.epochs:
            t_ns, spent_ns = epoch.t_ns, 0
            if examiner is not None and examiner.wants(epoch):
                started = clock()
                step(epoch._replace(readings=epoch.readings[:0], tick=False))
                spent_ns = clock() - started
                examiner.judge(run.belief(), epoch)
                epoch = epoch._replace(imu=epoch.imu[:0])
            started = clock()
            step(epoch)
            ended = clock()
            step_ns(spent_ns + ended - started)
            if ended > limit_ns:
                return Ending("failed", "out of time", t_ns)
            if epoch.tick:
                started = clock()
                belief = run.belief()
                ended = clock()
                tape.keep(belief, t_ns)
                tape.belief_ns.append(ended - started)
                gc.collect(0)
    except Diverged as error:
        return Ending("diverged", str(error), t_ns)
    except Exception as error:
        return Ending("failed", _describe(error), t_ns)
    if voyage.failure is not None:
        return Ending("failed", voyage.failure, t_ns)
    return Ending("done")


def _finish(run: Pass, voyage: Voyage, ending: Ending) -> tuple[Trajectory | None, int, Ending]:
    """Return (hindsight, time it took, ending); a run that had ended early keeps its own cause."""
    started = perf_counter_ns()
    smoothed = None
    try:
        smoothed = run.finish()
        if smoothed is not None and not (np.abs(smoothed.p_WB_W).max(initial=0.0) < LOST_M):  # nor NaN
            smoothed = None
            raise Diverged("the state with hindsight is not finite, or off this planet")
    except Exception as error:
        if ending.status == "done":
            lost = isinstance(error, Diverged)
            end_ns = voyage.epochs[-1].t_ns if voyage.epochs else voyage.start_ns
            ending = Ending("diverged" if lost else "failed", str(error) if lost else _describe(error), end_ns)
    return smoothed, perf_counter_ns() - started, ending


def _describe(error: Exception) -> str:
    """Name the type and what it says, on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@contextmanager
def _collector_off() -> Iterator[None]:
    """Keep Python's garbage collector from landing in somebody's step."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def score_ticks(log: Log, period_s: float) -> TimeArray:
    """Return the times at which beliefs are asked for, (k,) ns.

    With truth they are its own stamps, so that nobody interpolates: the nearest to each point of a regular grid that
    begins one period after the start. Without, or where it is empty, a regular grid from the start.
    """
    period_ns = int(period_s * 1e9)
    if log.truth is None or len(log.truth) == 0:
        return np.arange(log.start_ns + period_ns, int(log.imu.t_ns[-1]) + 1, period_ns, dtype=np.int64)
    stamps, first_ns = log.truth.t_ns, log.start_ns + period_ns
    begin_ns = stamps[np.abs(stamps - first_ns).argmin()]
    grid = np.arange(begin_ns, stamps[-1] + 1, period_ns)
    after = np.searchsorted(stamps, grid)
    before = (after - 1).clip(0)
    return np.unique(stamps[np.where(grid - stamps[before] <= stamps[after] - grid, before, after)])


# -- scores -----------------------------------------------------------------------------------------------------------

SCORES = {
    "n_scored": "poses compared",
    "ate_rmse_m": "ATE: root mean square of the position error, m",
    "ate_mean_m": "ATE: mean, m",
    "ate_median_m": "ATE: median, m",
    "ate_max_m": "ATE: maximum, m",
    "rotation_rmse_deg": "ATE: root mean square of the rotation angle, °",
    "heading_rmse_deg": "root mean square of the heading error, °",
    "velocity_rmse_m_s": "root mean square of the velocity error, m/s",
    "accel_bias_rmse_m_s2": "root mean square of the accelerometer bias error, m/s²",
    "gyro_bias_rmse_rad_s": "root mean square of the gyro bias error, rad/s",
    "rpe_rmse_m": "RPE: root mean square of the translation, m",
    "rpe_rotation_rmse_deg": "RPE: root mean square of the rotation angle, °",
    "n_rpe": "pairs of poses in the RPE",
    "segment_percent": "mean error over sub-trajectories, % of their length",
    "segment_deg_m": "mean rotation error over sub-trajectories, °/m",
    "drift_end_percent": "horizontal error at the end, % of the distance travelled",
    "drift_max_percent": "largest horizontal error, % of the distance travelled",
    "outage_percent": "worst growth of the horizontal error in a GPS outage, % of the distance travelled in it",
    "cep50_m": "median horizontal error, m",
    "drms_m": "root mean square of the horizontal error, m",
    "nees_position": "mean NEES of position over the ticks; 3 when the covariance is honest",
    "nees_attitude": "mean NEES of attitude; 3 when honest",
    "nees_velocity": "mean NEES of velocity; 3 when honest",
    "nees_biases": "mean NEES of both biases; 6 when honest",
    "nees_all": "mean NEES of the whole state; 15 when honest",
    "within_1sigma_position": "share of the components of position that err by at most 1 σ; 0.683 when honest",
    "within_2sigma_position": "the same within 2 σ; 0.954 when honest",
    "within_3sigma_position": "the same within 3 σ; 0.997 when honest",
    "within_1sigma_all": "share of all 15 components that err by at most 1 σ; 0.683 when honest",
    "within_2sigma_all": "the same within 2 σ; 0.954 when honest",
    "within_3sigma_all": "the same within 3 σ; 0.997 when honest",
    "n_not_positive": "poses whose covariance is not positive definite; their NEES is then absent",
}
INNOVATIONS = {
    f"nis_{sensor}": f"NIS of the {sensor} readings that came in time, by degree of freedom: mean; 1 when honest"
    for sensor in dict.fromkeys(SENSOR)
}
"""Only where `nis` is asked for, and of what was said online."""
COSTS = {
    "step_median_us": "time of one step: median, µs",
    "step_p99_us": "time of one step: 99th percentile, µs",
    "step_max_us": "time of one step: maximum, µs",
    "belief_median_us": "time of one belief: median, µs",
    "finish_s": "time of finish, s",
    "total_s": "time of all steps and finish, s",
    "real_time_factor": "length of the log over total_s",
    "us_per_imu_sample": "total_s over IMU samples, µs",
    "peak_mb": "peak memory of the run over that before it, MB",
}


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Scoring:
    """How a trajectory is scored.

    Attributes:
        align: what the estimator is forgiven, see `fathom.bench.metrics.align`; printed with the number.
        dims: "2d" counts horizontal positions only, in ATE, RPE and sub-trajectories; drift is always horizontal.
        rpe_delta, rpe_unit, rpe_pairs: see `fathom.bench.metrics.rpe`.
        segment_lengths_m: of the sub-trajectories.
        score_period_s: beliefs are asked for this far apart; 1 ms or more.
        nees_epochs: at how many times, evenly spaced over the log, NEES is averaged over the seeds (see `consistency`).
        nis: judge the estimators by their innovations, see `run_log`; their costs are then not to be compared.
        floor: find the posterior Cramér–Rao bound of every output; of simulated logs, unaligned and in 3d.
    """

    align: Alignment = "none"
    dims: Dims = "3d"
    rpe_delta: Positive = 10.0
    rpe_unit: Unit = "m"
    rpe_pairs: Pairs = "all"
    segment_lengths_m: tuple[Positive, ...] = (50.0, 100.0, 200.0, 400.0)
    score_period_s: Annotated[float, Field(ge=1e-3, le=1e6)] = 1.0
    nees_epochs: Annotated[int, Field(ge=1, le=1000)] = 10
    nis: bool = False
    floor: bool = False

    @model_validator(mode="after")
    def _step_is_possible(self) -> Scoring:
        check_step(self.rpe_delta, self.rpe_unit)
        return self


def scores(log: Log, estimate: Trajectory, scoring: Scoring = Scoring()) -> dict[str, float | None]:  # noqa: B008
    """Return every score of SCORES by name; None where it is not defined for this log and estimate.

    Covariances are judged only where `can_judge` says so.
    """
    row: dict[str, float | None] = dict.fromkeys(SCORES)
    if log.truth is None:
        return row
    try:
        truth, estimate = associate(log.truth, estimate)
        aligned = align(truth, estimate, scoring.align)
    except ScoreError:
        return row
    row["n_scored"] = len(truth)
    for part in (_absolute, _state, _relative, _segments, _drift, _outages, _horizontal):
        with suppress(ScoreError):
            row |= part(log, truth, aligned, scoring)
    if can_judge(log, scoring):
        row |= _honesty(truth, estimate)
    return row


def can_judge(log: Log, scoring: Scoring) -> bool:
    """Return whether covariances can be judged: where nothing is aligned, and the truth is one."""
    return log.truth is not None and log.truth_kind == "truth" and scoring.align == "none"


def _honesty(truth: Trajectory, estimate: Trajectory) -> dict[str, float | None]:
    """Return NEES and coverage; what cannot be had of one block (an unknown truth, a P that is none) is absent."""
    row: dict[str, float | None] = {}
    for block in BLOCKS:
        with suppress(ScoreError):
            each = nees(truth, estimate, block)
            if not np.isnan(each).all():
                row[f"nees_{block}"] = float(np.nanmean(each))
    for block in ("position", "all"):
        with suppress(ScoreError):
            shares = coverage(truth, estimate, block)
            row |= {f"within_{k}sigma_{block}": share for k, share in enumerate(shares, 1)}
    with suppress(ScoreError):
        row["n_not_positive"] = 0 if "nees_all" in row else len(not_positive(estimate))
    return row


def _absolute(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    e = ate(truth, estimate, dims=scoring.dims)
    names = ("rmse_m", "mean_m", "median_m", "max_m")
    row = {f"ate_{name}": getattr(e, name) for name in names}
    return row | {"rotation_rmse_deg": e.rotation_rmse_deg, "heading_rmse_deg": e.heading_rmse_deg}


def _state(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    e = state_errors(truth, estimate)
    return {
        "velocity_rmse_m_s": e.velocity_m_s,
        "accel_bias_rmse_m_s2": e.accel_bias_m_s2,
        "gyro_bias_rmse_rad_s": e.gyro_bias_rad_s,
    }


def _relative(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    e = rpe(truth, estimate, scoring.rpe_delta, scoring.rpe_unit, scoring.rpe_pairs, dims=scoring.dims)
    return {"rpe_rmse_m": e.rmse_m, "rpe_rotation_rmse_deg": e.rotation_rmse_deg, "n_rpe": e.n}


def _segments(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    each = segment_errors(truth, estimate, scoring.segment_lengths_m, dims=scoring.dims).values()
    n = sum(e.n for e in each)
    if n == 0:
        return {}
    return {
        "segment_percent": sum(e.n * e.translation_mean_percent for e in each) / n,
        "segment_deg_m": sum(e.n * e.rotation_mean_deg_m for e in each) / n,
    }


def _drift(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    e = drift(truth, estimate)
    return {"drift_end_percent": e.end_percent, "drift_max_percent": e.max_percent}


def _outages(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    gps_t_ns = np.zeros(0, np.int64) if log.gps is None else log.gps.received_ns
    each = [e.growth_percent for e in outage_drift(truth, estimate, gps_t_ns) if e.growth_percent is not None]
    return {"outage_percent": max(each, default=None)}


def _horizontal(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> dict[str, float | None]:
    e = horizontal_error(truth, estimate)
    return {"cep50_m": e.cep50_m, "drms_m": e.drms_m}


def innovation_scores(result: Result) -> dict[str, float | None]:
    """Return every score of INNOVATIONS by name; None where it was not asked for, or no such reading came in time."""
    row: dict[str, float | None] = dict.fromkeys(INNOVATIONS)
    for sensor, dof in innovation_dof(result).items():
        row[f"nis_{sensor}"] = float(_of_sensor(result, sensor)["nis"].sum()) / dof
    return row


def innovation_dof(result: Result) -> dict[str, int]:
    """Return over how many degrees of freedom the NIS of each sensor is; only those that have any."""
    every = {sensor: int(_of_sensor(result, sensor)["dof"].sum()) for sensor in dict.fromkeys(SENSOR)}
    return {sensor: dof for sensor, dof in every.items() if dof > 0}


def _of_sensor(result: Result, sensor: str) -> NDArray[Any]:
    nis = np.zeros(0, INNOVATION) if result.nis is None else result.nis
    return nis[np.isin(nis["kind"], [kind for kind, name in enumerate(SENSOR) if name == sensor])]


def costs(result: Result) -> dict[str, float | str | None]:
    """Return every cost of COSTS that a result knows, by name, and its `step_histogram`; none where it has no step."""
    if not len(result.step_ns):
        return {}
    median_us, p99_us, max_us = (float(q) / 1e3 for q in np.percentile(result.step_ns, [50, 99, 100]))
    total_s = (int(result.step_ns.sum()) + result.finish_ns) * 1e-9
    return {
        "step_median_us": median_us,
        "step_p99_us": p99_us,
        "step_max_us": max_us,
        "belief_median_us": float(np.median(result.belief_ns)) / 1e3 if len(result.belief_ns) else None,
        "finish_s": result.finish_ns * 1e-9,
        "total_s": total_s,
        "real_time_factor": result.duration_s / total_s,
        "us_per_imu_sample": 1e6 * total_s / max(result.imu_samples, 1),
        "step_histogram": step_histogram(result.step_ns),
    }


# -- before a run -----------------------------------------------------------------------------------------------------


def warm_up(estimator: Estimator) -> None:
    """Run the estimator over a few simulated seconds, so that compiling is over before anything is timed.

    Once with a heading sensor, once with one that gives the full attitude.
    """
    from ..datasets.scenario import Scenario
    from ..datasets.simulator import simulate

    log = simulate(Scenario(duration_s=20.0), seed=0)
    run_log(log, estimator)
    if isinstance(log.heading, HeadingStream):
        run_log(replace(log, heading=_level_attitude(log.heading)), estimator)


def _level_attitude(heading: HeadingStream) -> AttitudeStream:
    """Return the headings as full attitudes, roll and pitch being level."""
    c, s, zero = np.cos(heading.z[:, 0]), np.sin(heading.z[:, 0]), np.zeros(len(heading))
    z = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1)
    return AttitudeStream(heading.t_ns, heading.received_ns, z, np.repeat(heading.sigma, 3, axis=1))
