"""An estimator's RMSE over the floor, with its interval over seeds; docs/conventions.md (61)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...datasets.state import POSITION, THETA, VELOCITY, Array, TimeArray
from ...datasets.trajectory import Trajectory
from .association import ScoreError, associate
from .floor import Floor
from .interval import interval
from .pose_error import check_finite
from .state_error import error_state

FLOORS = {
    "floor_position_m": "floor (posterior Cramér–Rao bound) of the position error's root mean square, m",
    "floor_attitude_deg": "floor of the rotation angle's, °",
    "floor_velocity_m_s": "floor of the velocity error's, m/s",
}
"""Only for simulated logs, and if `floor` is set."""

OVER = {
    "position": ("ate_rmse_m", "floor_position_m"),
    "attitude": ("rotation_rmse_deg", "floor_attitude_deg"),
    "velocity": ("velocity_rmse_m_s", "floor_velocity_m_s"),
}
"""The score and its floor, by block."""


@dataclass(frozen=True)
class FloorRatio:
    """An estimator's RMSE over the floor; 1 is the best possible.

    Attributes:
        ratio: root of the mean squared error over root of the mean bound.
        low, high: its `interval`; None with fewer than FEWEST_SEEDS.
        level: of the interval.
        seeds: number of runs.
    """

    ratio: float
    low: float | None
    high: float | None
    level: float
    seeds: int


def squares(truth: Trajectory, estimate: Trajectory, floor: Floor, block: slice) -> tuple[float, float]:
    """Return the mean squared error of a block of the state in one run, and its floor: the mean trace of the bound.

    Args:
        truth, estimate, floor: rows at times that all three have are used.
        block: of the error state, in one unit: THETA, POSITION, ... of `fathom.datasets.state`.

    Raises:
        ScoreError: estimate and floor have different look-ahead, the estimate diverged, no times match, or the error
            of the block is unknown.
    """
    if estimate.lookahead_s != floor.lookahead_s:
        raise ScoreError(
            f"floor: the estimate looks {estimate.lookahead_s:g} s ahead and the floor {floor.lookahead_s:g} s; "
            "compute `floors` for the same look-ahead"
        )
    truth, estimate = associate(truth, estimate)
    check_finite(estimate)
    _, rows, floor_rows = np.intersect1d(estimate.t_ns, floor.t_ns, assume_unique=True, return_indices=True)
    if len(rows) == 0:
        raise ScoreError("floor: it has none of the estimate's times; compute `floors` at those")
    e = error_state(truth, estimate)[rows, block]
    if np.isnan(e).any():
        raise ScoreError("floor: the error of this block is not known")
    variances = floor.P[floor_rows].diagonal(axis1=1, axis2=2)[:, block]
    return float((e * e).sum(axis=1).mean()), float(variances.sum(axis=1).mean())


def floor_scores(floor: Floor, t_ns: TimeArray) -> dict[str, float | None]:
    """Return every score of FLOORS by name, over the poses at t_ns; None if the floor lacks one of them."""
    rows = np.isin(floor.t_ns, t_ns)
    if rows.sum() < len(t_ns):
        return dict.fromkeys(FLOORS)
    variances = floor.P[rows].diagonal(axis1=1, axis2=2)
    p, theta, v = (math.sqrt(variances[:, block].sum(axis=1).mean()) for block in (POSITION, THETA, VELOCITY))
    return dict(zip(FLOORS, (p, math.degrees(theta), v), strict=True))


def rmse_over_floor(squared_error: Array, floor_variance: Array, level: float = 0.95) -> FloorRatio:
    """Return the ratio of root means over seeds, √(mean squared error / mean bound), and its interval.

    Args:
        squared_error, floor_variance: (n,), one per seed, from `squares`; they stay together.
        level: of the interval, between 0 and 1.

    Raises:
        ScoreError: no seeds, a value that is not finite, or a floor that is not positive.
    """
    e, f = np.asarray(squared_error, np.float64), np.asarray(floor_variance, np.float64)
    if len(e) == 0 or e.shape != f.shape or not (np.isfinite(e).all() and np.isfinite(f).all() and f.min() > 0):
        raise ScoreError("floor: a ratio needs at least one seed, with a finite error and a positive bound for each")
    ratio = float(_ratio(e, f))
    low, high = interval((e, f), _ratio, positive=True, level=level) or (None, None)
    return FloorRatio(ratio, low, high, level, len(e))


def _ratio(squared_error: Array, floor_variance: Array, axis: int = -1) -> Array:
    return np.sqrt(squared_error.mean(axis=axis) / floor_variance.mean(axis=axis))
