"""Absolute errors: ATE, horizontal error, and drift over the whole log and within each GPS outage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...datasets.state import TimeArray, rotation_angle
from ...datasets.trajectory import Trajectory
from .alignment import Alignment, align
from .association import associate
from .pose_error import Dims, heading_roll_pitch, positions, rmse, statistics, travelled, wrapped


@dataclass(frozen=True)
class Ate:
    """Absolute trajectory error over n poses. Rotations are None if truth or estimate has no attitude."""

    rmse_m: float
    mean_m: float
    median_m: float
    std_m: float
    min_m: float
    max_m: float
    rotation_rmse_deg: float | None
    rotation_mean_deg: float | None
    rotation_median_deg: float | None
    rotation_std_deg: float | None
    rotation_min_deg: float | None
    rotation_max_deg: float | None
    heading_rmse_deg: float | None
    alignment: Alignment
    dims: Dims
    n: int


def ate(
    truth: Trajectory, estimate: Trajectory, align: Alignment = "none", tolerance_ns: int = 0, dims: Dims = "3d"
) -> Ate:
    """Absolute trajectory error: |p_est − p_true| and the angle of R_trueᵀ R_est, after alignment.

    See docs/conventions.md (51).

    Args:
        truth: rows of NaN in R_WB: attitude unknown; z of NaN: height unknown, which needs dims "2d".
        estimate: at the truth's times, or see `associate`.
        align: see `fathom.bench.metrics.alignment.align`.
        tolerance_ns: see `associate`.
        dims: "2d" scores horizontal positions only; rotations are not affected.

    Raises:
        ScoreError: nothing to compare, or the alignment is not determined.

    Source: Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", eq. (4), on stated alignments.
    """
    truth, estimate = _aligned(truth, estimate, align, tolerance_ns)
    p_true, p_est = positions(truth, estimate, dims)
    angle = rotation_angle(truth.R_WB.transpose(0, 2, 1) @ estimate.R_WB)
    heading = wrapped(heading_roll_pitch(estimate.R_WB)[:, 0] - heading_roll_pitch(truth.R_WB)[:, 0])
    return Ate(
        **statistics(np.linalg.norm(p_est - p_true, axis=1), "{}_m"),  # pyright: ignore[reportArgumentType]
        **statistics(np.degrees(angle), "rotation_{}_deg"),
        heading_rmse_deg=rmse(np.degrees(heading)),
        alignment=align,
        dims=dims,
        n=len(truth),
    )


@dataclass(frozen=True)
class HorizontalError:
    """Horizontal radial error over n poses: its median (CEP50) and its root mean square (DRMS), m."""

    cep50_m: float
    drms_m: float
    alignment: Alignment
    n: int


def horizontal_error(
    truth: Trajectory, estimate: Trajectory, align: Alignment = "none", tolerance_ns: int = 0
) -> HorizontalError:
    """CEP50, the median of |p_est − p_true| in the horizontal plane, and DRMS, the root of its mean square.

    Raises:
        ScoreError: as `ate`.
    """
    e = ate(truth, estimate, align, tolerance_ns, dims="2d")
    return HorizontalError(cep50_m=e.median_m, drms_m=e.rmse_m, alignment=align, n=e.n)


@dataclass(frozen=True)
class Drift:
    """Error at the end and at its worst, m and % of the distance travelled (None if that is zero)."""

    end_m: float
    max_m: float
    end_percent: float | None
    max_percent: float | None
    distance_m: float
    alignment: Alignment
    dims: Dims
    n: int


def drift(
    truth: Trajectory, estimate: Trajectory, align: Alignment = "none", tolerance_ns: int = 0, dims: Dims = "2d"
) -> Drift:
    """Position error at the end, and the largest, over the distance travelled along the truth.

    See docs/conventions.md (53).

    Args:
        truth, estimate, align, tolerance_ns: as for `ate`.
        dims: "2d" by default: horizontal error over horizontal distance is how data sheets of DVL-aided navigation
            state "% of distance travelled" (depth is observed, and does not drift); "3d" takes both in space.

    Raises:
        ScoreError: as `ate`.
    """
    truth, estimate = _aligned(truth, estimate, align, tolerance_ns)
    p_true, p_est = positions(truth, estimate, dims)
    error_m = np.linalg.norm(p_est - p_true, axis=1)
    end_m, max_m, distance_m = float(error_m[-1]), float(error_m.max()), float(travelled(p_true)[-1])
    return Drift(
        end_m,
        max_m,
        _percent(end_m, distance_m),
        _percent(max_m, distance_m),
        distance_m,
        align,
        dims,
        len(truth),
    )


@dataclass(frozen=True)
class Outage:
    """Growth of the position error while GPS was silent; growth_percent is None if the distance is zero.

    Attributes:
        begin_ns, end_ns: the poses compared: the first at or after the last reading, and the last before the next.
        distance_m: travelled between them, along the truth.
        growth_m: |e_end − e_begin|, e = p_est − p_true.
    """

    begin_ns: int
    end_ns: int
    distance_m: float
    growth_m: float
    growth_percent: float | None
    dims: Dims


def outage_drift(
    truth: Trajectory,
    estimate: Trajectory,
    gps_t_ns: TimeArray,
    min_outage_s: float = 30.0,
    tolerance_ns: int = 0,
    dims: Dims = "2d",
) -> tuple[Outage, ...]:
    """Drift within each GPS outage: the growth of the error vector over the distance travelled meanwhile.

    An outage is a time without GPS longer than min_outage_s. The time before the first reading and the time after the
    last count too, and so does the whole log if it has no reading. The pose at the time of the next reading is not
    used: it may have used that reading.

    Args:
        truth, estimate, tolerance_ns: as for `ate`; nothing is aligned.
        gps_t_ns: (k,) times of reception of the readings, any order; those outside the trajectory are ignored.
        min_outage_s: s.
        dims: as for `drift`.

    Returns:
        One for each outage with at least two poses in it, in time order; empty if GPS was never silent.

    Raises:
        ScoreError: as `ate`.
    """
    truth, estimate = associate(truth, estimate, tolerance_ns)
    p_true, p_est = positions(truth, estimate, dims)
    error, distance, t_ns = p_est - p_true, travelled(p_true), truth.t_ns
    gps_t_ns = np.sort(gps_t_ns[(gps_t_ns >= t_ns[0]) & (gps_t_ns <= t_ns[-1])])
    edges = np.concatenate([t_ns[:1], gps_t_ns, t_ns[-1:] + 1])  # no reading ends the log: its last pose counts
    outages = []
    for k in np.flatnonzero(np.diff(edges) > min_outage_s * 1e9):
        i, j = np.searchsorted(t_ns, edges[k : k + 2]) - (0, 1)
        if j > i:
            growth_m, distance_m = float(np.linalg.norm(error[j] - error[i])), float(distance[j] - distance[i])
            percent = _percent(growth_m, distance_m)
            outages.append(Outage(int(t_ns[i]), int(t_ns[j]), distance_m, growth_m, percent, dims))
    return tuple(outages)


def _aligned(
    truth: Trajectory, estimate: Trajectory, mode: Alignment, tolerance_ns: int
) -> tuple[Trajectory, Trajectory]:
    truth, estimate = associate(truth, estimate, tolerance_ns)
    return truth, align(truth, estimate, mode)


def _percent(error_m: float, distance_m: float) -> float | None:
    return 100.0 * error_m / distance_m if distance_m > 0 else None
