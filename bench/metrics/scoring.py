"""The names of the scores, how to ask for them, and all of them for one trajectory."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from ...datasets.epochs import SENSOR
from ...datasets.log import Log
from ...datasets.quantities import Number, Positive, Whole
from ...datasets.trajectory import Trajectory
from .absolute_error import ate, drift, horizontal_error, outage_drift
from .alignment import Alignment, align
from .association import ScoreError, associate
from .floor_ratio import FLOORS
from .pose_error import Dims
from .relative_error import Pairs, Unit, check_step, rpe, segment_errors
from .state_error import BLOCKS, coverage, nees, not_positive, state_errors

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
    "n_not_positive": "poses whose covariance is not positive definite; these have no NEES",
}


INNOVATIONS = {
    f"nis_{sensor}": f"NIS of the {sensor} readings that came in time, mean per degree of freedom; 1 if consistent"
    for sensor in dict.fromkeys(SENSOR)
}
"""Only where `nis` is asked for, and of the online output."""


COSTS = {
    "step_median_us": "time of one step: median, µs",
    "step_p99_us": "time of one step: 99th percentile, µs",
    "step_max_us": "time of one step: maximum, µs",
    "belief_median_us": "time of one belief: median, µs",
    "finish_s": "time of finish, s",
    "total_s": "time of all steps and finish, s",
    "real_time_factor": "length of the log divided by total_s",
    "us_per_imu_sample": "total_s divided by the number of IMU samples, µs",
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
        nis: take the NIS of innovations, see `run_log`; costs are then not comparable.
        floor: compute the posterior Cramér–Rao bound of every output, for simulated logs, unaligned and in 3d.
    """

    align: Alignment = "none"
    dims: Dims = "3d"
    rpe_delta: Positive = 10.0
    rpe_unit: Unit = "m"
    rpe_pairs: Pairs = "all"
    segment_lengths_m: tuple[Positive, ...] = (50.0, 100.0, 200.0, 400.0)
    score_period_s: Annotated[Number, Field(ge=1e-3, le=1e6)] = 1.0
    nees_epochs: Annotated[Whole, Field(ge=1, le=1000)] = 10
    nis: bool = False
    floor: bool = False

    @model_validator(mode="after")
    def _step_is_possible(self) -> Scoring:
        check_step(self.rpe_delta, self.rpe_unit)
        return self


def scores(log: Log, estimate: Trajectory, scoring: Scoring = Scoring()) -> dict[str, float | None]:  # noqa: B008
    """Return every score of SCORES by name; None where it is not defined for this log and estimate.

    Consistency is scored only where `can_judge` holds.
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
        row |= _consistency(truth, estimate)
    return row


def can_judge(log: Log, scoring: Scoring) -> bool:
    """Return whether consistency can be scored: against ground truth, without alignment."""
    return log.truth is not None and log.truth_kind == "truth" and scoring.align == "none"


def _consistency(truth: Trajectory, estimate: Trajectory) -> dict[str, float | None]:
    """Return NEES and coverage; absent for a block without truth, or without a valid covariance."""
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
    *(name for name in SCORES if name.startswith(("nees_", "within_"))),
)
"""Scores of which the mean over seeds is taken."""


MEDIAN = ("step_median_us", "step_p99_us", "real_time_factor", "us_per_imu_sample", "peak_mb")
"""Scores of which the median over seeds is taken: their outliers are the machine's."""
