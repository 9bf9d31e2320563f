"""Alignment of an estimate with the truth: a step of its own, because it changes every score."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from ...datasets.state import Array
from ...datasets.trajectory import Trajectory
from .association import ScoreError
from .pose_error import positions

Alignment: TypeAlias = Literal["none", "origin", "yaw", "se3"]

DEGENERATE = 1e-12
"""Relative: a value this small compared with its inputs is rounding, not geometry."""


def align(truth: Trajectory, estimate: Trajectory, mode: Alignment = "none") -> Trajectory:
    """Return the estimate moved from its own world V into the truth's W: p_WB_W = R_WV p_VB_V + p_WV_W.

    Attitude, position and velocity are moved; biases and P are not. P's position and velocity are then still in V's
    axes, so covariances must be judged (`nees`) on the estimate before alignment.

    Args:
        truth, estimate: associated, n rows each.
        mode: the transform that is estimated.
            "none": the identity.
            "origin": from the first pose: T_WV = T_WB,0 T_VB,0⁻¹. Needs the truth's first attitude.
            "yaw": a rotation about the vertical and a translation, the four degrees of freedom that dead reckoning
                cannot observe, with the least squared position error. Without heights in the truth, heights stay.
            "se3": the rotation and translation with the least squared position error.

    Raises:
        ScoreError: not associated, not finite, or the transform is not determined: too few poses, no motion, all on
            one line ("se3"), or no attitude ("origin").

    Source: Umeyama 1991, eqs. (38)-(41), scale 1; Zhang & Scaramuzza 2018, "A tutorial on quantitative trajectory
    evaluation", section IV ("yaw" is its yaw-only alignment, solved in closed form).
    """
    if len(truth) != len(estimate) or not len(truth):
        raise ScoreError(f"alignment: {len(truth)} poses of truth, {len(estimate)} of estimate; associate them first")
    if mode == "none":
        return estimate
    if mode not in _TRANSFORM:
        raise ScoreError(f"alignment: no mode {mode!r}; known: none, {', '.join(_TRANSFORM)}")
    positions(truth, estimate, "2d")  # refuses what is not finite
    R_WV, p_WV_W = _TRANSFORM[mode](truth, estimate)
    return replace(
        estimate,
        R_WB=R_WV @ estimate.R_WB,
        p_WB_W=estimate.p_WB_W @ R_WV.T + p_WV_W,
        v_WB_W=None if estimate.v_WB_W is None else estimate.v_WB_W @ R_WV.T,
    )


def _origin(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """T_WV = T_WB,0 T_VB,0⁻¹."""
    if not (np.isfinite(truth.R_WB[0]).all() and np.isfinite(estimate.R_WB[0]).all()):
        raise ScoreError("alignment 'origin': the first pose has no attitude; use 'yaw' or 'se3', which need none")
    _need_vertical(truth.p_WB_W[:1], "origin")
    R_WV = truth.R_WB[0] @ estimate.R_WB[0].T
    return R_WV, truth.p_WB_W[0] - R_WV @ estimate.p_WB_W[0]


def _yaw(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """Minimise Σ |p_WB_W − Rz(ψ) p_VB_V − t|²: tan ψ = Σ x_V × x_W / Σ x_V · x_W, over centred horizontal x."""
    x_W, x_V = _centred(truth.p_WB_W[:, :2]), _centred(estimate.p_WB_W[:, :2])
    cross = float(np.sum(x_V[:, 0] * x_W[:, 1] - x_V[:, 1] * x_W[:, 0]))
    dot = float(np.sum(x_V * x_W))
    if np.hypot(cross, dot) <= DEGENERATE * np.linalg.norm(x_W) * np.linalg.norm(x_V):
        raise ScoreError(f"alignment 'yaw': {len(truth)} poses determine no yaw: one of the tracks does not move")
    c, s = np.array([dot, cross]) / np.hypot(cross, dot)
    R_WV = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    offset = truth.p_WB_W - estimate.p_WB_W @ R_WV.T
    known = ~np.isnan(offset[:, 2])
    return R_WV, np.array([*offset[:, :2].mean(axis=0), offset[known, 2].mean() if known.any() else 0.0])


def _se3(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """Umeyama: U D Vᵀ = Σ x_W x_Vᵀ over centred x, R_WV = U diag(1, 1, det U det V) Vᵀ."""
    _need_vertical(truth.p_WB_W, "se3")
    U, D, Vt = np.linalg.svd(_centred(truth.p_WB_W).T @ _centred(estimate.p_WB_W))
    if D[1] <= DEGENERATE * D[0]:
        raise ScoreError(
            f"alignment 'se3': {len(truth)} poses determine no rotation: one of the tracks is a point or a straight "
            "line; use 'yaw'"
        )
    R_WV = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    return R_WV, truth.p_WB_W.mean(axis=0) - R_WV @ estimate.p_WB_W.mean(axis=0)


_TRANSFORM = {"origin": _origin, "yaw": _yaw, "se3": _se3}


def _centred(p: Array) -> Array:
    """Return p (n, k) less its mean; exactly zero if only rounding is left."""
    x = p - p.mean(axis=0)
    return x if np.abs(x).max() > DEGENERATE * np.abs(p).max() else np.zeros_like(x)


def _need_vertical(p: Array, mode: str) -> None:
    if np.isnan(p[:, 2]).any():
        raise ScoreError(f"alignment {mode!r}: the truth has no vertical; use 'yaw', or none")
