"""Relative errors: RPE over a step, and errors over sub-trajectories of given lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from ...datasets.state import Array, TimeArray, rotation_angle
from ...datasets.trajectory import Trajectory
from .association import ScoreError, associate
from .pose_error import Dims, positions, statistics, travelled

Unit: TypeAlias = Literal["frames", "s", "m"]
Pairs: TypeAlias = Literal["consecutive", "all"]
RowPairs: TypeAlias = tuple[TimeArray, TimeArray]

STEP_TOLERANCE = 0.1
"""Relative: a step may differ from delta by this; evo's rel_delta_tol has the same default."""

LONGEST_STEP = 1e9
"""Frames, s or m: nanoseconds of more would not fit int64."""


@dataclass(frozen=True)
class Rpe:
    """Relative pose error over n pairs of poses of the truth, each delta (frames, s or m) apart."""

    rmse_m: float
    mean_m: float
    median_m: float
    std_m: float
    min_m: float
    max_m: float
    rotation_rmse_deg: float
    rotation_mean_deg: float
    rotation_median_deg: float
    rotation_std_deg: float
    rotation_min_deg: float
    rotation_max_deg: float
    delta: float
    unit: Unit
    pairs: Pairs
    dims: Dims
    n: int


def rpe(
    truth: Trajectory,
    estimate: Trajectory,
    delta: float = 1.0,
    unit: Unit = "frames",
    pairs: Pairs = "consecutive",
    tolerance_ns: int = 0,
    dims: Dims = "3d",
) -> Rpe:
    """Relative pose error: |trans E| and the angle of E, E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j), Q the truth, P the estimate.

    It does not depend on alignment; docs/conventions.md (52). Pairs (i, j) are chosen on the truth, so that they are
    the same for every estimate:

    | unit | consecutive, from i = 0, then from the last j | all, from every i |
    | --- | --- | --- |
    | frames | j = i + delta | j = i + delta |
    | s | the first j with t_j − t_i >= delta; left out if over 10 % late | likewise |
    | m | the first j at least delta further on the path | the j nearest to delta on it; left out if over 10 % off |

    Pairs by frames and by metres are evo's (pairs_from_reference, rel_delta_tol 0.1); evo's consecutive metres have no
    tolerance, and evo has no seconds.

    Args:
        truth, estimate, tolerance_ns: as for `ate`. Pairs with an unknown attitude are left out.
        delta: positive; whole, when in frames.
        unit, pairs: see the table.
        dims: "2d" takes the horizontal part of the translation error (in W axes) and the horizontal path.

    Raises:
        ScoreError: no such pair (what matches is shorter than delta, or too sparse), bad arguments, or no attitude,
            which a relative pose needs.

    Source: Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", eqs. (1)-(2).
    """
    sparser = "estimate" if len(estimate) < len(truth) else "truth"
    truth, estimate = associate(truth, estimate, tolerance_ns)
    p_true, _ = positions(truth, estimate, dims)
    i, j = _choose(truth.t_ns, p_true, delta, unit, pairs)
    if len(i) == 0:
        raise ScoreError(_no_pair(truth.t_ns, p_true, delta, unit, sparser))
    translation_m, rotation_rad, (i, j) = _relative_errors(
        truth, estimate, _error_rotation(truth, estimate), i, j, dims
    )
    return Rpe(
        **statistics(translation_m, "{}_m"),  # pyright: ignore[reportArgumentType]
        **statistics(np.degrees(rotation_rad), "rotation_{}_deg"),  # pyright: ignore[reportArgumentType]
        delta=delta,
        unit=unit,
        pairs=pairs,
        dims=dims,
        n=len(i),
    )


@dataclass(frozen=True)
class SegmentError:
    """Errors over the n sub-trajectories of one length: translation in % of the distance, rotation in °/m."""

    length_m: float
    n: int
    translation_rmse_percent: float
    translation_mean_percent: float
    translation_median_percent: float
    translation_std_percent: float
    translation_min_percent: float
    translation_max_percent: float
    rotation_rmse_deg_m: float
    rotation_mean_deg_m: float
    rotation_median_deg_m: float
    rotation_std_deg_m: float
    rotation_min_deg_m: float
    rotation_max_deg_m: float


def segment_errors(
    truth: Trajectory,
    estimate: Trajectory,
    lengths_m: Sequence[float] = (10, 25, 50, 100, 250, 500, 1000),
    tolerance_ns: int = 0,
    dims: Dims = "3d",
) -> dict[float, SegmentError]:
    """Relative errors over sub-trajectories: from every pose i to the first pose j at or past the length, on the truth.

    The error E is that of `rpe`. Two differences from KITTI: each error is divided by the distance from i to j, which
    is a little longer than the nominal length; and every pose starts a sub-trajectory, not every tenth.

    Args:
        truth, estimate, tolerance_ns, dims: as for `rpe`.
        lengths_m: positive.

    Returns:
        By length; a length that the truth does not cover is absent.

    Raises:
        ScoreError: nothing to compare, a length that is not positive, or no attitude.

    Source: Geiger et al. 2012, KITTI odometry development kit; Zhang & Scaramuzza 2018, section V.
    """
    truth, estimate = associate(truth, estimate, tolerance_ns)
    p_true, _ = positions(truth, estimate, dims)
    path_m = travelled(p_true)
    if not all(length_m > 0 for length_m in lengths_m):
        raise ScoreError(f"segments: lengths must be positive, found {list(lengths_m)}")
    D, by_length = _error_rotation(truth, estimate), {}
    for length_m in lengths_m:
        j = np.searchsorted(path_m, path_m + length_m)
        i = np.flatnonzero(j < len(truth))
        if len(i) == 0:
            continue
        translation_m, rotation_rad, (i, j) = _relative_errors(truth, estimate, D, i, j[i], dims)
        way_m = path_m[j] - path_m[i]
        by_length[length_m] = SegmentError(
            length_m=length_m,
            n=len(i),
            **statistics(100 * translation_m / way_m, "translation_{}_percent"),  # pyright: ignore[reportArgumentType]
            **statistics(np.degrees(rotation_rad) / way_m, "rotation_{}_deg_m"),  # pyright: ignore[reportArgumentType]
        )
    return by_length


def _error_rotation(truth: Trajectory, estimate: Trajectory) -> Array:
    """D_k = R_est,k R_true,kᵀ (n, 3, 3), the error of the attitude in W; NaN where unknown."""
    return estimate.R_WB @ truth.R_WB.transpose(0, 2, 1)


def _relative_errors(
    truth: Trajectory, estimate: Trajectory, D: Array, i: TimeArray, j: TimeArray, dims: Dims
) -> tuple[Array, Array, RowPairs]:
    """Return |trans E| (m) and the angle of E (rad), both (k,), and the pairs (i, j) whose attitudes are known.

    The rotation of E is D_iᵀ D_j in another frame, with the same angle. Its translation, in W, is
    D_iᵀ (p_est,j − p_est,i) − (p_true,j − p_true,i).
    """
    known = ~np.isnan(D[:, 0, 0])
    if not known.all():
        i, j = (row[known[i] & known[j]] for row in (i, j))
        if len(i) == 0:
            raise ScoreError("a relative pose needs the attitude of truth and estimate, which is unknown here")
    Dt_i = D[i].transpose(0, 2, 1)
    step_est = (Dt_i @ (estimate.p_WB_W[j] - estimate.p_WB_W[i])[:, :, None])[:, :, 0]
    error = (step_est - (truth.p_WB_W[j] - truth.p_WB_W[i]))[:, : int(dims[0])]
    return np.linalg.norm(error, axis=1), rotation_angle(Dt_i @ D[j]), (i, j)


def check_step(delta: float, unit: Unit) -> None:
    """Raise ScoreError if no pair of poses can be delta apart."""
    if not (0 < delta <= LONGEST_STEP) or (unit == "frames" and delta != int(delta)):
        raise ScoreError(
            f"rpe: delta must be positive, at most {LONGEST_STEP:g}, and whole in frames; found {delta} {unit}"
        )


def _choose(t_ns: TimeArray, p: Array, delta: float, unit: Unit, pairs: Pairs) -> RowPairs:
    """Return the rows (i, j) that `rpe` compares, by the table in its docstring."""
    if unit not in ("frames", "s", "m") or pairs not in ("consecutive", "all"):
        raise ScoreError(f"rpe: unit is 'frames', 's' or 'm', pairs 'consecutive' or 'all'; found {unit!r}, {pairs!r}")
    check_step(delta, unit)
    n = len(t_ns)
    if unit == "frames":
        i = np.arange(0, n - int(delta), 1 if pairs == "all" else int(delta))
        return i, i + int(delta)
    if unit == "m":
        return _nearest_on_path(travelled(p), delta) if pairs == "all" else _chain(_step_lengths(p), delta)
    delta_ns = max(round(delta * 1e9), 1)
    if pairs == "all":
        j = np.searchsorted(t_ns, t_ns + delta_ns)
        i = np.flatnonzero(j < n)
        j = j[i]
    else:
        i, j = _chain(np.diff(t_ns), delta_ns)
    on_time = t_ns[j] - t_ns[i] - delta_ns <= STEP_TOLERANCE * delta_ns
    return i[on_time], j[on_time]


def _no_pair(t_ns: TimeArray, p: Array, delta: float, unit: Unit, sparser: str) -> str:
    """Return why no two matched poses are delta apart, and which delta to use; `sparser` has fewer poses."""
    path_m, span_s = travelled(p), (t_ns - t_ns[0]) * 1e-9
    along = {"frames": np.arange(len(t_ns)), "s": span_s, "m": path_m}[unit]
    step = float(np.median(np.diff(along))) if len(along) > 1 else 0.0
    apart = f", each about {step:.3g} {unit} from the next" if step and unit != "frames" else ""
    if along[-1] < delta:
        advice = "use a smaller delta"
    elif step > delta:
        advice = f"use a larger delta, or a denser {sparser}"
    else:
        advice = f"use a delta of one or several such steps, or a denser {sparser}"
    return (
        f"rpe: no pair of poses is {delta} {unit} apart: {len(t_ns)} poses match, over {span_s[-1]:.3f} s and "
        f"{path_m[-1]:.3f} m{apart}; {advice}"
    )


def _nearest_on_path(path_m: Array, delta_m: float) -> RowPairs:
    """Pair each i with the j > i nearest to delta_m along the path (of equals the first), if within tolerance."""
    n = len(path_m)
    i = np.arange(n - 1)
    past = np.searchsorted(path_m, path_m[:-1] + delta_m).clip(i + 1, n - 1)
    short = np.searchsorted(path_m, path_m[past - 1]).clip(i + 1)  # the first pose of a halt
    miss_past, miss_short = (np.abs(path_m[j] - path_m[i] - delta_m) for j in (past, short))
    j = np.where(miss_short <= miss_past, short, past)
    keep = np.minimum(miss_short, miss_past) <= STEP_TOLERANCE * delta_m
    return i[keep], j[keep]


def _chain(steps: Array | TimeArray, delta: float) -> RowPairs:
    """Pair row 0 with the first row at least delta further, that row with the next, and so on; steps (n − 1,) >= 0."""
    rows, gone = [0], 0
    for row, step in enumerate(steps.tolist(), 1):
        gone += step
        if gone >= delta:
            rows.append(row)
            gone = 0
    chain = np.array(rows)
    return chain[:-1], chain[1:]


def _step_lengths(p: Array) -> Array:
    return np.linalg.norm(np.diff(p, axis=0), axis=1)
