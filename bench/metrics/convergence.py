"""Convergence of a start that was wrong: from when on the attitude's error stays small."""

from __future__ import annotations

import numpy as np

from ...datasets.state import rotation_angle
from ...datasets.trajectory import Trajectory
from .association import ScoreError, associate

STAYS_S = 10.0
"""How long an error must have stayed below the limit at the end: one that only passes through it has not converged."""


def converged_s(truth: Trajectory, estimate: Trajectory, limit_deg: float) -> float:
    """Return when the angle of R_trueᵀ R_est falls below the limit for good, s after the first associated pose.

    Args:
        truth, estimate: nothing is aligned.
        limit_deg: of the angle.

    Raises:
        ScoreError: it is not below the limit throughout the last STAYS_S, or truth or estimate has no attitude.
    """
    truth, estimate = associate(truth, estimate)
    error_deg = np.degrees(rotation_angle(truth.R_WB.swapaxes(1, 2) @ estimate.R_WB))
    if np.isnan(error_deg).all():
        raise ScoreError("no attitude, in the ground truth or in the estimate")
    beyond = np.flatnonzero(~(error_deg < limit_deg))
    since = beyond[-1] + 1 if len(beyond) else 0
    t_ns = truth.t_ns
    if since == len(t_ns) or t_ns[-1] - t_ns[since] < STAYS_S * 1e9:
        raise ScoreError(f"the attitude's error does not stay below {limit_deg:g}° for the last {STAYS_S:g} s")
    return float(t_ns[since] - t_ns[0]) * 1e-9
