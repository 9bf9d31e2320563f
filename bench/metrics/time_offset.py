"""What would pair more poses of two trajectories: a larger tolerance, or a shift of one clock."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from ...datasets.state import Array, TimeArray
from ...datasets.trajectory import Trajectory
from .alignment import Alignment, align
from .association import ScoreError, associate
from .pose_error import rmse

MOST_POSES = 500
"""How many poses an offset is fitted to: more cost time, and a path of a mission bends less often."""
STEPS = 200
"""Offsets tried either way, before the best is refined."""
LONGEST_SHARE = 0.25
"""Of the shorter trajectory's length: the largest offset tried. With more, too little of the two overlaps."""
MOST = 0.95
"""Share of the nearest poses that a suggested tolerance pairs."""


def tolerance_needed_s(truth: Trajectory, estimate: Trajectory) -> float | None:
    """Return a tolerance that pairs most poses with their nearest, s; None where their times do not overlap.

    A row is paired only within half the usual step between poses: further off, it would have another neighbour.
    """
    half_ns = max(_step_ns(truth), _step_ns(estimate)) // 2
    try:
        true, near = associate(truth, estimate, max(half_ns, 1))
    except ScoreError:
        return None
    return float(np.quantile(np.abs(near.t_ns - true.t_ns), MOST)) * 1e-9


def _step_ns(of: Trajectory) -> int:
    return int(np.median(np.diff(of.t_ns))) if len(of) > 1 else 0


def best_offset_s(truth: Trajectory, estimate: Trajectory, mode: Alignment = "none") -> tuple[float, float] | None:
    """Return the offset to add to the estimate's times for the least position error, s, and the error with it, m.

    The estimate is interpolated at the truth's times. None where there are too few poses, or nothing overlaps.
    """
    longest_s = LONGEST_SHARE * min(_span_s(truth), _span_s(estimate))
    if not longest_s > 0.0:
        return None
    true = truth.select(np.unique(np.linspace(0, len(truth) - 1, MOST_POSES).astype(int)))

    def error_m(offset_s: float) -> float:
        return _error_m(true, estimate, offset_s, mode)

    step_s = longest_s / STEPS
    tried_s = np.arange(-STEPS, STEPS + 1) * step_s
    errors_m = np.array([error_m(offset_s) for offset_s in tried_s.tolist()])
    if not np.isfinite(errors_m).any():
        return None
    near_s = float(tried_s[np.nanargmin(errors_m)])
    found = minimize_scalar(error_m, bounds=(near_s - step_s, near_s + step_s), method="bounded")
    return float(found.x), float(found.fun)


def _span_s(of: Trajectory) -> float:
    return (int(of.t_ns[-1]) - int(of.t_ns[0])) * 1e-9 if len(of) > 1 else 0.0


def _error_m(true: Trajectory, estimate: Trajectory, offset_s: float, mode: Alignment) -> float:
    """Return the position error after a shift of the estimate's clock, m; infinite where none can be told."""
    t_ns = true.t_ns - round(offset_s * 1e9)
    inside = (t_ns >= estimate.t_ns[0]) & (t_ns <= estimate.t_ns[-1])
    if np.count_nonzero(inside) < 2:
        return np.inf
    shifted = Trajectory(true.t_ns[inside], true.R_WB[inside], _interpolated(estimate, t_ns[inside]))
    true = true.select(np.flatnonzero(inside))
    try:
        moved = align(true, shifted, "yaw" if mode == "origin" else mode)  # the first pose changes with the offset
    except ScoreError:
        return np.inf
    measured = 2 if np.isnan(true.p_WB_W[:, 2]).any() else 3
    error = rmse((moved.p_WB_W - true.p_WB_W)[:, :measured])
    return np.inf if error is None else error


def _interpolated(estimate: Trajectory, t_ns: TimeArray) -> Array:
    """Return the estimate's positions at other times within its own, (n, 3) m, linear in between."""
    start_ns = estimate.t_ns[0]
    return np.stack([np.interp(t_ns - start_ns, estimate.t_ns - start_ns, x) for x in estimate.p_WB_W.T], axis=1)
