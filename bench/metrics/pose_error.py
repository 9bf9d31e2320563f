"""Errors of poses, and their statistics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np

from ...datasets.state import Array
from ...datasets.trajectory import Trajectory
from .association import ScoreError

Dims: TypeAlias = Literal["3d", "2d"]
"""Whether position errors are taken in space or in the horizontal plane."""


def positions(truth: Trajectory, estimate: Trajectory, dims: Dims) -> tuple[Array, Array]:
    """Return p_WB_W of both, (n, 3) m, or (n, 2) with dims "2d".

    Raises:
        ScoreError: unknown dims, a truth without them (that of a GPS buoy has no height: its z is NaN), or an estimate
            that is not finite.
    """
    if dims not in ("3d", "2d"):
        raise ScoreError(f"dims must be '3d' or '2d', found {dims!r}")
    check_finite(estimate)
    p_true, p_est = truth.p_WB_W[:, : int(dims[0])], estimate.p_WB_W[:, : int(dims[0])]
    unknown = ~np.isfinite(p_true).all(axis=1)
    if unknown.any():
        way_out = "drop such rows" if np.isnan(truth.p_WB_W[:, :2]).any() else "dims='2d' scores the horizontal only"
        raise ScoreError(f"{dims} positions: the truth is unknown in {unknown.sum()} of {len(truth)} rows; {way_out}")
    return p_true, p_est


def check_finite(estimate: Trajectory) -> None:
    """Refuse an estimate that diverged to NaN or infinity; it may have no attitude at all (NaN in every row).

    Raises:
        ScoreError: naming what, row and time.
    """
    R_finite = np.isfinite(estimate.R_WB).all(axis=(1, 2))
    for name, finite in (("position", np.isfinite(estimate.p_WB_W).all(axis=1)), ("attitude", R_finite)):
        if not finite.all() and (name == "position" or finite.any()):
            row = int(np.argmin(finite))
            raise ScoreError(f"estimate: {name} is not finite in row {row} ({estimate.t_ns[row]} ns): it diverged")


def heading_roll_pitch(R_WB: Array) -> Array:
    """Return (n, 3) rad: R_WB = Rz(heading) Ry(pitch) Rx(roll). Heading and roll are undefined at a pitch of ±90°."""
    return np.stack(
        [
            np.arctan2(R_WB[:, 1, 0], R_WB[:, 0, 0]),
            np.arctan2(R_WB[:, 2, 1], R_WB[:, 2, 2]),
            -np.arcsin(R_WB[:, 2, 0].clip(-1.0, 1.0)),
        ],
        axis=1,
    )


def wrapped(angle: Array) -> Array:
    """Return the angle in [−π, π), rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def travelled(p: Array) -> Array:
    """Return the distance (n,) m from the first row along p (n, 2 or 3), starting at 0."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])


def rmse(errors: Array) -> float | None:
    """Root of the mean squared norm of errors (n,) or (n, k), without rows of NaN; None if there are no others."""
    squared = (errors * errors).reshape(len(errors), -1).sum(axis=1)
    known = squared[~np.isnan(squared)]
    return float(np.sqrt(known.mean())) if len(known) else None


def statistics(errors: Array, name: str) -> dict[str, float | None]:
    """Return rmse, mean, median, std, min, max of errors (n,), each under `name` with its {} filled in.

    NaN is left out; if there is nothing else, all are None.
    """
    known = errors[~np.isnan(errors)]
    values: dict[str, float | None] = dict.fromkeys(("rmse", "mean", "median", "std", "min", "max"))
    if len(known):
        values = {
            "rmse": float(np.sqrt(np.mean(known * known))),
            "mean": float(known.mean()),
            "median": float(np.median(known)),
            "std": float(known.std()),
            "min": float(known.min()),
            "max": float(known.max()),
        }
    return {name.format(key): value for key, value in values.items()}


def pooled_rmse(rmses: Sequence[float], counts: Sequence[int]) -> float:
    """RMSE over several runs: sqrt(Σ n_k rmse_k² / Σ n_k); squared errors are pooled before the root.

    Args:
        rmses: one per run, any unit.
        counts: the number of errors in each.

    Raises:
        ScoreError: not one count for each RMSE, a negative count, or none at all.
    """
    r, n = np.asarray(rmses, float), np.asarray(counts, float)
    if r.shape != n.shape or r.ndim != 1 or (n < 0).any() or not n.sum() > 0:
        raise ScoreError(f"pooled rmse: expected a positive count for each of {r.size} RMSEs, found {list(counts)}")
    return float(np.sqrt(np.sum(n * r * r) / n.sum()))
