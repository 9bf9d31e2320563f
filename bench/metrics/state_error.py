"""Errors of the whole state, from heading to biases, and the consistency of their covariance: NEES and coverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import gammaincinv

from ...datasets.state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array, NavState, TimeArray
from ...datasets.trajectory import Trajectory
from .association import ScoreError, associate
from .pose_error import check_finite, heading_roll_pitch, rmse, wrapped

Block: TypeAlias = Literal["position", "attitude", "velocity", "biases", "all"]
BLOCKS: dict[Block, slice] = {
    "position": POSITION,
    "attitude": THETA,
    "velocity": VELOCITY,
    "biases": slice(ACCEL_BIAS.start, GYRO_BIAS.stop),
    "all": slice(0, DIM),
}
DOF: dict[Block, int] = {block: of.stop - of.start for block, of in BLOCKS.items()}


@dataclass(frozen=True)
class StateErrors:
    """RMSE of each part of the state over n poses; vectors by their norm; None if truth or estimate lack it."""

    heading_deg: float | None
    roll_deg: float | None
    pitch_deg: float | None
    velocity_m_s: float | None
    depth_m: float | None
    accel_bias_m_s2: float | None
    gyro_bias_rad_s: float | None
    n: int


def state_errors(truth: Trajectory, estimate: Trajectory, tolerance_ns: int = 0) -> StateErrors:
    """RMSE of heading, roll, pitch (R_WB = Rz Ry Rx, differences wrapped), velocity, depth and biases; unaligned.

    Args:
        truth, estimate, tolerance_ns: as for `ate`. Rows in which a part is NaN are left out of that part.

    Raises:
        ScoreError: nothing to compare, or the estimate diverged.
    """
    truth, estimate = associate(truth, estimate, tolerance_ns)
    check_finite(estimate)
    e = error_state(truth, estimate)
    angles = np.degrees(wrapped(heading_roll_pitch(estimate.R_WB) - heading_roll_pitch(truth.R_WB)))
    return StateErrors(
        heading_deg=rmse(angles[:, 0]),
        roll_deg=rmse(angles[:, 1]),
        pitch_deg=rmse(angles[:, 2]),
        velocity_m_s=rmse(e[:, VELOCITY]),
        depth_m=rmse(e[:, POSITION][:, 2]),
        accel_bias_m_s2=rmse(e[:, ACCEL_BIAS]),
        gyro_bias_rad_s=rmse(e[:, GYRO_BIAS]),
        n=len(truth),
    )


def nees(truth: Trajectory, estimate: Trajectory, block: Block = "position", tolerance_ns: int = 0) -> Array:
    """Normalised estimation error squared, eᵀ P⁻¹ e, with estimate ⊕ e = truth; χ² for a consistent estimate.

    See docs/conventions.md (54).

    Args:
        truth, estimate, tolerance_ns: as for `ate`; nothing is aligned.
        block: "position", "attitude", "velocity" (3 degrees of freedom each), "biases" (6) or "all" (15).

    Returns:
        (n,) for the n associated rows; NaN where P or the truth is.

    Raises:
        ScoreError: unknown block, the estimate has no P, part of the block is unknown in every row, or a P is not
            positive definite.

    Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2; e in the coordinates of `fathom.datasets.state`.
    """
    e, P, t_ns = judged(truth, estimate, block, tolerance_ns)
    known = ~(np.isnan(e).any(axis=1) | np.isnan(P).any(axis=(1, 2)))
    score = np.full(len(e), np.nan)
    try:
        L = np.linalg.cholesky(P[known]).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        row = int(np.flatnonzero(known)[np.argmin(np.linalg.eigvalsh(P[known])[:, 0])])
        raise ScoreError(f"nees: P of {block!r} is not positive definite at {t_ns[row]} ns") from None
    score[known] = (_solve_lower(L, e[known]) ** 2).sum(axis=1)  # L w = e, so eᵀ P⁻¹ e = wᵀ w
    return score


def _solve_lower(L: Array, e: Array) -> Array:
    """Return w (n, k) with L w = e for each row of e, for lower triangular L (n, k, k)."""
    w = np.empty_like(e)
    for i in range(e.shape[1]):
        w[:, i] = (e[:, i] - (L[:, i, :i] * w[:, :i]).sum(axis=1)) / L[:, i, i]
    return w


def coverage(
    truth: Trajectory, estimate: Trajectory, block: Block = "position", tolerance_ns: int = 0
) -> tuple[float, float, float]:
    """Return the share of the errors' components within 1, 2 and 3 σ, the roots of P's diagonal.

    For a consistent Gaussian estimate it is 0.6827, 0.9545 and 0.9973 on average, under any correlations. Rows and
    components where P or the truth is NaN are left out. See docs/conventions.md (57).

    Args:
        truth, estimate, block, tolerance_ns: as for `nees`.

    Raises:
        ScoreError: as `nees`, except for a P that is not positive definite; also if P is NaN in every row.
    """
    e, P, _ = judged(truth, estimate, block, tolerance_ns)
    variance = np.einsum("nii->ni", P)
    known = ~(np.isnan(e) | np.isnan(variance))
    if not known.any():
        raise ScoreError("coverage: no row has a covariance")
    squared, bound = e[known] ** 2, variance[known]
    one, two, three = (float((squared <= k**2 * bound).mean()) for k in (1, 2, 3))
    return one, two, three


def share_inside(nees: Array, dof: int, probability: float) -> float:
    """Return the share of errors inside the ellipsoid of this probability, by their NEES (n,).

    Of a consistent Gaussian estimate it is the probability, on average; docs/conventions.md (70). NaNs are left out.
    """
    known = nees[~np.isnan(nees)]
    return float((known <= 2.0 * gammaincinv(0.5 * dof, probability)).mean())


def not_positive(estimate: Trajectory) -> TimeArray:
    """Return the rows whose P is not positive definite, (k,), without rows of NaN.

    Raises:
        ScoreError: the estimate has no P.
    """
    if estimate.P is None:
        raise ScoreError("the estimate has no covariances: its estimator keeps none, or must be asked for them")
    rows = np.flatnonzero(~np.isnan(estimate.P).any(axis=(1, 2)))
    try:
        np.linalg.cholesky(estimate.P[rows])
    except np.linalg.LinAlgError:
        return np.array([row for row in rows if not _has_root(estimate.P[row])], np.int64)
    return np.zeros(0, np.int64)


def _has_root(P: Array) -> bool:
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True


def judged(
    truth: Trajectory, estimate: Trajectory, block: Block, tolerance_ns: int = 0
) -> tuple[Array, Array, TimeArray]:
    """Return the block's errors (n, k) of (54), covariances (n, k, k) and times (n,), of the associated rows.

    Raises:
        ScoreError: unknown block, the estimate has no P, or part of the block is unknown in every row.
    """
    if block not in BLOCKS:
        raise ScoreError(f"nees: no block {block!r}; known: {', '.join(BLOCKS)}")
    truth, estimate = associate(truth, estimate, tolerance_ns)
    if estimate.P is None:
        raise ScoreError("nees: the estimate has no covariances: its estimator keeps none, or must be asked for them")
    check_finite(estimate)
    of = BLOCKS[block]
    e = error_state(truth, estimate)[:, of]
    unknown = np.isnan(e).all(axis=0)
    if unknown.any():
        raise ScoreError(
            f"nees: {np.count_nonzero(unknown)} of the {unknown.size} components of {block!r} have no known error"
        )
    return e, estimate.P[:, of, of], estimate.t_ns


def error_state(truth: Trajectory, estimate: Trajectory) -> Array:
    """Return e (n, 15) with estimate ⊕ e = truth, of associated trajectories; NaN where unknown."""
    return _states(estimate).local(_states(truth))


def _states(of: Trajectory) -> NavState:
    """Return all states of a trajectory in one, row by row; NaN where unknown."""
    unknown = np.full((len(of), 3), np.nan)
    v_WB_W, b_a, b_g = (unknown if x is None else x for x in (of.v_WB_W, of.b_a, of.b_g))
    return NavState(of.R_WB, of.p_WB_W, v_WB_W, b_a, b_g)
