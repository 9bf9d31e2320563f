"""The names of the scores, how to ask for them, and all of them for one trajectory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from ...datasets.epochs import SENSOR
from ...datasets.log import Log
from ...datasets.quantities import Number, Positive, Whole
from ...datasets.state import Array
from ...datasets.trajectory import Trajectory
from .absolute_error import ate, drift, horizontal_error, outage_drift
from .alignment import Alignment, align
from .association import ScoreError, associate
from .convergence import converged_s
from .energy_score import energy_score
from .floor_ratio import FLOORS
from .pose_error import Dims
from .relative_error import Pairs, Unit, check_step, rpe, segment_errors
from .state_error import BLOCKS, DOF, Block, coverage, judged, nees, not_positive, share_inside, state_errors

ELLIPSOIDS = (50, 90, 99)
"""Per cent of a consistent estimate's errors inside: the middle, and two tails."""
OF_ELLIPSOIDS = {"position": "position", "all": "the whole state"}
"""The blocks whose ellipsoids are scored, and their names in words."""
HONESTY = ("nees_", "within_", "inside_", "energy_")
"""Prefixes of the scores of an estimate's covariance."""

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
    "nees_position": "mean NEES of position over the log; 3 if consistent",
    "nees_attitude": "mean NEES of attitude; 3 if consistent",
    "nees_velocity": "mean NEES of velocity; 3 if consistent",
    "nees_biases": "mean NEES of both biases; 6 if consistent",
    "nees_all": "mean NEES of the whole state; 15 if consistent",
    "within_1sigma_position": "share of position components with an error of at most 1 σ; 0.683 if consistent",
    "within_2sigma_position": "the same within 2 σ; 0.954 if consistent",
    "within_3sigma_position": "the same within 3 σ; 0.997 if consistent",
    "within_1sigma_all": "share of all 15 components with an error of at most 1 σ; 0.683 if consistent",
    "within_2sigma_all": "the same within 2 σ; 0.954 if consistent",
    "within_3sigma_all": "the same within 3 σ; 0.997 if consistent",
    "converged_s": "when the attitude's error falls below `converged_deg` for good, s; where that is stated",
    **{
        f"inside_{percent}_{block}": f"share of errors of {what} inside the {percent} % ellipsoid of their covariance"
        for block, what in OF_ELLIPSOIDS.items()
        for percent in ELLIPSOIDS
    },
    "energy_score_m": "mean energy score of position, m: error and covariance in one, lower is better",
    "n_not_positive": "poses whose covariance is not positive definite; these have no NEES",
}


NIS, LOG_DENSITY, WHITENESS = (
    {f"{score}_{sensor}": what.format(sensor) for sensor in dict.fromkeys(SENSOR)}
    for score, what in {
        "nis": "NIS of the {} readings, mean per degree of freedom; 1 if consistent",
        "log_density": "log-likelihood of the {} readings as predicted, nats per degree of freedom: higher is better",
        "whiteness": "correlation of an innovation of {} with the one before it; 0 if consistent",
    }.items()
)
INNOVATIONS = NIS | LOG_DENSITY | WHITENESS
"""Only where `nis` is asked for, and of the online output."""


COSTS = {
    "step_median_us": "time of one step: median, µs",
    "step_p99_us": "time of one step: 99th percentile, µs",
    "step_max_us": "time of one step: maximum, µs",
    "step_cpu_median_us": "processor time of one step: median, µs",
    "belief_median_us": "time of one belief: median, µs",
    "finish_s": "time of finish, s",
    "total_s": "time of all steps and finish, s",
    "cpu_s": "processor time of the thread in all steps and finish, s",
    "real_time_factor": "length of the log divided by total_s",
    "us_per_imu_sample": "total_s divided by the number of IMU samples, µs",
    "us_per_imu_sample_with_outputs": "the same with a belief at the rate output_rate_hz, µs",
    "peak_mb": "peak memory of the run above the memory before it, MB",
}


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Scoring:
    """How a trajectory is scored.

    Attributes:
        align: how the estimate is aligned first, see `fathom.bench.metrics.align`; printed with the number.
        dims: "2d" counts horizontal positions only, in ATE, RPE and sub-trajectories; drift is always horizontal.
        rpe_delta, rpe_unit, rpe_pairs: see `fathom.bench.metrics.rpe`.
        segment_lengths_m: of the sub-trajectories.
        score_period_s: time between two scored beliefs; 1 ms or more.
        nees_epochs: number of evenly spaced times at which NEES is averaged over seeds (see `consistency`).
        output_rate_hz: beliefs per second that every estimator is charged for, in `us_per_imu_sample_with_outputs`.
        nis: take the NIS of innovations, see `run_log`; costs are then not comparable.
        floor: compute the posterior Cramér–Rao bound of every output, for simulated logs, unaligned and in 3d.
        converged_deg: an attitude's error that stays below it has converged, see `fathom.bench.metrics.convergence`.
    """

    align: Alignment = "none"
    dims: Dims = "3d"
    rpe_delta: Positive = 10.0
    rpe_unit: Unit = "m"
    rpe_pairs: Pairs = "all"
    segment_lengths_m: tuple[Positive, ...] = (50.0, 100.0, 200.0, 400.0)
    score_period_s: Annotated[Number, Field(ge=1e-3, le=1e6)] = 1.0
    nees_epochs: Annotated[Whole, Field(ge=1, le=1000)] = 10
    output_rate_hz: Annotated[Number, Field(ge=0, le=1e6)] = 10.0
    nis: bool = False
    floor: bool = False
    converged_deg: Annotated[Positive, Field(le=180)] | None = None

    @model_validator(mode="after")
    def _step_is_possible(self) -> Scoring:
        check_step(self.rpe_delta, self.rpe_unit)
        return self


class Scored(NamedTuple):
    """The scores of one trajectory.

    Attributes:
        values: every score of SCORES by name; None where it is not defined for this log and estimate.
        missing: by the name of each that is None, why, in a sentence.
    """

    values: dict[str, float | None]
    missing: dict[str, str]


def scores(log: Log, estimate: Trajectory, scoring: Scoring = Scoring()) -> dict[str, float | None]:  # noqa: B008
    """Return the values of `scored`."""
    return scored(log, estimate, scoring).values


def scored(log: Log, estimate: Trajectory, scoring: Scoring = Scoring()) -> Scored:  # noqa: B008
    """Return every score of SCORES, and the reason of each that is missing.

    Consistency is scored only where `can_judge` holds. Where no alignment is determined, as with a truth that does not
    move, those scores are left that alignment does not change (RPE, sub-trajectories, biases), and the heading, as it
    is.
    """
    values: dict[str, float | None] = dict.fromkeys(SCORES)
    if log.truth is None:
        return Scored(values, dict.fromkeys(SCORES, "no ground truth"))
    try:
        truth, estimate = associate(log.truth, estimate)
    except ScoreError as error:
        return Scored(values, dict.fromkeys(SCORES, str(error)))
    found: dict[str, float | str] = {"n_scored": len(truth)}
    try:
        aligned, parts = align(truth, estimate, scoring.align), ALIGNED | ANYWAY
    except ScoreError as error:
        aligned, parts = estimate, ANYWAY
        heading = _heading(truth, estimate)
        why = f"{error}{'; the heading is scored unaligned' if heading else ''}"
        found |= dict.fromkeys((name for names in ALIGNED.values() for name in names), why) | heading
    for part, names in parts.items():
        found |= dict.fromkeys(names, "not defined for this run") | _or_why(names, part, log, truth, aligned, scoring)
    found |= _consistency(log, truth, estimate, scoring)
    values |= {name: value for name, value in found.items() if not isinstance(value, str)}
    return Scored(values, {name: why for name, why in found.items() if isinstance(why, str)})


Found: TypeAlias = dict[str, float | str]
"""A score's value by its name, or why there is none."""


def _or_why(names: Iterable[str], part: Callable[..., Found], *args: Any) -> Found:
    """Return the scores of a part, or the reason that it raises for each of these names."""
    try:
        return part(*args)
    except ScoreError as error:
        return dict.fromkeys(names, PREFIX.sub("", str(error)))


PREFIX = re.compile(r"^(nees|rpe|coverage|segments): ")
"""The function that raised a reason; the score's name says it already."""


def by_reason(missing: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the names of the missing scores by their reason, as a row of the store holds them."""
    found: dict[str, list[str]] = {}
    for name, why in missing.items():
        found.setdefault(why, []).append(name)
    return found


def _lacks(what: str, of_truth: Array | None, log: Log) -> str:
    """Return whether it is the truth or the estimate that has no such part."""
    there = of_truth is not None and not np.isnan(of_truth).all()
    return f"no {what} in the estimate" if there else f"no {what} in the {truth_name(log.truth_kind)}"


def truth_name(kind: str) -> str:
    """Return what a truth of this kind is called: "ground truth", or its kind."""
    return "ground truth" if kind == "truth" else kind


def can_judge(log: Log, scoring: Scoring) -> bool:
    """Return whether consistency can be scored: against ground truth, without alignment."""
    return log.truth is not None and log.truth_kind == "truth" and scoring.align == "none"


def _consistency(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    """Return NEES and coverage; absent for a block without truth, or without a valid covariance."""
    names = [name for name in SCORES if name.startswith((*HONESTY, "n_not_positive"))]
    if not can_judge(log, scoring):
        return dict.fromkeys(names, "covariances are judged only against ground truth, unaligned")
    found: Found = {}
    for block in BLOCKS:
        inside = [f"inside_{percent}_{block}" for percent in ELLIPSOIDS if block in OF_ELLIPSOIDS]
        found |= _or_why([f"nees_{block}", *inside], _nees, truth, estimate, block)
    found |= _or_why(["energy_score_m"], _energy, truth, estimate)
    for block in OF_ELLIPSOIDS:
        found |= _or_why([f"within_{k}sigma_{block}" for k in (1, 2, 3)], _coverage, truth, estimate, block)
    sound = not isinstance(found["nees_all"], str)
    return found | ({"n_not_positive": 0} if sound else _or_why(["n_not_positive"], _not_positive, estimate))


def _nees(truth: Trajectory, estimate: Trajectory, block: Block) -> Found:
    each = nees(truth, estimate, block)
    known = not np.isnan(each).all()
    found: Found = {f"nees_{block}": float(np.nanmean(each)) if known else NO_COVARIANCE}
    for percent in ELLIPSOIDS if block in OF_ELLIPSOIDS else ():
        share = share_inside(each, DOF[block], percent / 100) if known else NO_COVARIANCE
        found[f"inside_{percent}_{block}"] = share
    return found


def _energy(truth: Trajectory, estimate: Trajectory) -> Found:
    e, P, _ = judged(truth, estimate, "position")
    known = np.isfinite(e).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
    return {"energy_score_m": float(energy_score(e[known], P[known]).mean()) if known.any() else NO_COVARIANCE}


def _coverage(truth: Trajectory, estimate: Trajectory, block: Block) -> Found:
    shares = coverage(truth, estimate, block)
    return {f"within_{k}sigma_{block}": share for k, share in enumerate(shares, 1)}


def _not_positive(estimate: Trajectory) -> Found:
    return {"n_not_positive": len(not_positive(estimate))}


def _absolute(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    e = ate(truth, estimate, dims=scoring.dims)
    found: Found = {f"ate_{name}": getattr(e, name) for name in ("rmse_m", "mean_m", "median_m", "max_m")}
    for name in ("rotation_rmse_deg", "heading_rmse_deg"):
        value = getattr(e, name)
        found[name] = _lacks("attitude", truth.R_WB, log) if value is None else value
    return found


def _heading(truth: Trajectory, estimate: Trajectory) -> Found:
    """Return the heading's error without alignment, where there is one."""
    with suppress(ScoreError):  # the reason why nothing is aligned stands
        value = state_errors(truth, estimate).heading_deg
        if value is not None:
            return {"heading_rmse_deg": value}
    return {}


def _velocity(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    value = state_errors(truth, estimate).velocity_m_s
    return {"velocity_rmse_m_s": _lacks("velocity", truth.v_WB_W, log) if value is None else value}


def _biases(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    e = state_errors(truth, estimate)
    accel, gyro = e.accel_bias_m_s2, e.gyro_bias_rad_s
    return {
        "accel_bias_rmse_m_s2": _lacks("accelerometer bias", truth.b_a, log) if accel is None else accel,
        "gyro_bias_rmse_rad_s": _lacks("gyro bias", truth.b_g, log) if gyro is None else gyro,
    }


def _relative(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    e = rpe(truth, estimate, scoring.rpe_delta, scoring.rpe_unit, scoring.rpe_pairs, dims=scoring.dims)
    return {"rpe_rmse_m": e.rmse_m, "rpe_rotation_rmse_deg": e.rotation_rmse_deg, "n_rpe": e.n}


def _segments(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    each = segment_errors(truth, estimate, scoring.segment_lengths_m, dims=scoring.dims).values()
    n = sum(e.n for e in each)
    if n == 0:
        shortest_m = min(scoring.segment_lengths_m, default=0.0)
        raise ScoreError(f"the track is shorter than every sub-trajectory ({shortest_m:g} m and more)")
    return {
        "segment_percent": sum(e.n * e.translation_mean_percent for e in each) / n,
        "segment_deg_m": sum(e.n * e.rotation_mean_deg_m for e in each) / n,
    }


def _drift(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    e = drift(truth, estimate)
    if e.end_percent is None or e.max_percent is None:
        raise ScoreError(f"the {truth_name(log.truth_kind)} does not move")
    return {"drift_end_percent": e.end_percent, "drift_max_percent": e.max_percent}


def _outages(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    gps_t_ns = np.zeros(0, np.int64) if log.gps is None else log.gps.received_ns
    outages = outage_drift(truth, estimate, gps_t_ns)
    each = [e.growth_percent for e in outages if e.growth_percent is not None]
    if not each:
        still = f"the {truth_name(log.truth_kind)} does not move while GPS is silent"
        raise ScoreError(still if outages else "GPS is never silent for 30 s")
    return {"outage_percent": max(each)}


def _horizontal(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    e = horizontal_error(truth, estimate)
    return {"cep50_m": e.cep50_m, "drms_m": e.drms_m}


def _converged(log: Log, truth: Trajectory, estimate: Trajectory, scoring: Scoring) -> Found:
    if scoring.converged_deg is None:
        return {"converged_s": "not asked for: `converged_deg` among the scores states below which error"}
    if scoring.align != "none":
        return {"converged_s": "convergence is judged unaligned"}
    return {"converged_s": converged_s(truth, estimate, scoring.converged_deg)}


NO_COVARIANCE = "no pose has a covariance and a known error"
ALIGNED: dict[Callable[..., Found], tuple[str, ...]] = {
    _absolute: ("ate_rmse_m", "ate_mean_m", "ate_median_m", "ate_max_m", "rotation_rmse_deg", "heading_rmse_deg"),
    _velocity: ("velocity_rmse_m_s",),
    _drift: ("drift_end_percent", "drift_max_percent"),
    _outages: ("outage_percent",),
    _horizontal: ("cep50_m", "drms_m"),
}
"""Parts of the scores that alignment changes, and the names in each."""
ANYWAY: dict[Callable[..., Found], tuple[str, ...]] = {
    _biases: ("accel_bias_rmse_m_s2", "gyro_bias_rmse_rad_s"),
    _relative: ("rpe_rmse_m", "rpe_rotation_rmse_deg", "n_rpe"),
    _segments: ("segment_percent", "segment_deg_m"),
    _converged: ("converged_s",),
}
"""Those that it does not change."""


POOLED = {
    "ate_rmse_m": "n_scored",
    "rotation_rmse_deg": "n_scored",
    "heading_rmse_deg": "n_scored",
    "velocity_rmse_m_s": "n_scored",
    "rpe_rmse_m": "n_rpe",
    "drms_m": "n_scored",
    **dict.fromkeys(FLOORS, "n_scored"),
}
"""Scores whose squares are pooled over seeds before the root, and the score that holds the weight of each."""


MEAN = (
    "drift_end_percent",
    "drift_max_percent",
    "outage_percent",
    "segment_percent",
    "cep50_m",
    *(name for name in SCORES if name.startswith(HONESTY)),
)
"""Scores of which the mean over seeds is taken."""


MEDIAN = (
    "step_median_us",
    "step_cpu_median_us",
    "step_p99_us",
    "real_time_factor",
    "us_per_imu_sample",
    "us_per_imu_sample_with_outputs",
    "total_s",
    "cpu_s",
    "peak_mb",
)
"""Scores of which the median over seeds is taken: their outliers are the machine's."""
