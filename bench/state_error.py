"""Errors of the whole state: heading to biases, and whether the estimate's covariance owns up to them (NEES)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from ..datasets.state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array
from ..datasets.trajectory import Trajectory
from .association import ScoreError, associate
from .pose_error import check_finite, heading_roll_pitch, rmse, rotation_vector, wrapped

Block: TypeAlias = Literal["position", "attitude", "velocity", "biases", "all"]
BLOCKS: dict[Block, slice] = {
    "position": POSITION,
    "attitude": THETA,
    "velocity": VELOCITY,
    "biases": slice(ACCEL_BIAS.start, GYRO_BIAS.stop),
    "all": slice(0, DIM),
}


@dataclass(frozen=True)
class StateErrors:
    """RMSE of each part of the state over n poses; vectors by their norm; None where truth or estimate know it not."""

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
    angles = np.degrees(wrapped(heading_roll_pitch(estimate.R_WB) - heading_roll_pitch(truth.R_WB)))
    return StateErrors(
        heading_deg=rmse(angles[:, 0]),
        roll_deg=rmse(angles[:, 1]),
        pitch_deg=rmse(angles[:, 2]),
        velocity_m_s=rmse(_difference(truth.v_WB_W, estimate.v_WB_W, len(truth))),
        depth_m=rmse(truth.p_WB_W[:, 2] - estimate.p_WB_W[:, 2]),
        accel_bias_m_s2=rmse(_difference(truth.b_a, estimate.b_a, len(truth))),
        gyro_bias_rad_s=rmse(_difference(truth.b_g, estimate.b_g, len(truth))),
        n=len(truth),
    )


def nees(truth: Trajectory, estimate: Trajectory, block: Block = "position", tolerance_ns: int = 0) -> Array:
    """Normalised estimation error squared, eᵀ P⁻¹ e, with estimate ⊕ e = truth; of an honest estimate, χ² on average.

    Args:
        truth, estimate, tolerance_ns: as for `ate`; nothing is aligned.
        block: "position", "attitude", "velocity" (3 degrees of freedom each), "biases" (6) or "all" (15).

    Returns:
        (n,) for the n associated rows; NaN where P or the truth is.

    Raises:
        ScoreError: no such block, the estimate has no P, part of the block is unknown in every row, or a P is not
            positive definite.

    Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2; e in the coordinates of `fathom.datasets.state`.
    """
    if block not in BLOCKS:
        raise ScoreError(f"nees: no block {block!r}; there are {', '.join(BLOCKS)}")
    truth, estimate = associate(truth, estimate, tolerance_ns)
    if estimate.P is None:
        raise ScoreError("nees: the estimate has no covariances; ask the estimator for them")
    check_finite(estimate)
    of = BLOCKS[block]
    e, P = error_state(truth, estimate)[:, of], estimate.P[:, of, of]
    unknown = np.isnan(e).all(axis=0)
    if unknown.any():
        raise ScoreError(
            f"nees: {np.count_nonzero(unknown)} of the {unknown.size} components of {block!r} have no known error"
        )
    known = ~(np.isnan(e).any(axis=1) | np.isnan(P).any(axis=(1, 2)))
    score = np.full(len(e), np.nan)
    try:
        L = np.linalg.cholesky(P[known])
    except np.linalg.LinAlgError:
        row = int(np.flatnonzero(known)[np.argmin(np.linalg.eigvalsh(P[known])[:, 0])])
        raise ScoreError(f"nees: P of {block!r} is not positive definite at {estimate.t_ns[row]} ns") from None
    whitened = np.linalg.solve(L, e[known][:, :, None])[:, :, 0]  # L w = e, so eᵀ P⁻¹ e = wᵀ w
    score[known] = (whitened * whitened).sum(axis=1)
    return score


def error_state(truth: Trajectory, estimate: Trajectory) -> Array:
    """Return e (n, 15) with estimate ⊕ e = truth, of associated trajectories; NaN where something is unknown."""
    n = len(truth)
    e = np.empty((n, DIM))
    e[:, THETA] = rotation_vector(estimate.R_WB.transpose(0, 2, 1) @ truth.R_WB)
    e[:, POSITION] = truth.p_WB_W - estimate.p_WB_W
    e[:, VELOCITY] = _difference(estimate.v_WB_W, truth.v_WB_W, n)
    e[:, ACCEL_BIAS] = _difference(estimate.b_a, truth.b_a, n)
    e[:, GYRO_BIAS] = _difference(estimate.b_g, truth.b_g, n)
    return e


def _difference(x: Array | None, y: Array | None, n: int) -> Array:
    """Return y − x (n, 3), NaN where either is unknown."""
    return np.full((n, 3), np.nan) if x is None or y is None else y - x
