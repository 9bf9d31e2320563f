"""Check what an estimator gives back: shapes, real finite numbers, rotations, covariances, times.

Each belief is checked for its form as it comes. Its values are checked when the run is over, all at once: that costs a
tenth of checking one by one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from ...datasets.state import DIM, Array, Belief, TimeArray
from ...datasets.trajectory import Trajectory

ROTATION_TOLERANCE = 1e-6
"""Largest entry of |R Rᵀ − I|. Rounding in an hour of products gives 1e-12, in single precision 1e-6; the errors of
attitude that are scored are a thousand times larger."""

COVARIANCE_TOLERANCE = 1e-6
"""How far a covariance may be from symmetric and positive semidefinite, as a share of the mean variance of its blocks.
Rounding gives 1e-10 in a filter that does not symmetrise; 1e-6 of a variance is 1e-3 of a sigma."""

FLOAT = np.dtype(np.float64)
VECTORS = ("p_WB_W", "v_WB_W", "b_a", "b_g")


def check_form(belief: Belief, t_ns: int) -> None:
    """Refuse what is no belief of t_ns: NumPy would broadcast another shape, and drop an imaginary part, in silence.

    Raises:
        ValueError: it is for another time.
        TypeError: not a Belief, or an array in it is of another shape or type.
    """
    if not isinstance(belief, Belief):
        raise TypeError(f"belief() returned {type(belief).__name__}, expected a fathom.datasets.Belief")
    check_time(belief, t_ns)
    x = belief.state
    for name, shape, values in (
        ("R_WB", (3, 3), x.R_WB),
        ("p_WB_W", (3,), x.p_WB_W),
        ("v_WB_W", (3,), x.v_WB_W),
        ("b_a", (3,), x.b_a),
        ("b_g", (3,), x.b_g),
        ("P", (DIM, DIM), belief.P),
    ):
        if type(values) is not np.ndarray or values.dtype is not FLOAT or values.shape != shape:
            _check_array(name, values, shape)


def check_time(belief: Belief, t_ns: int) -> None:
    """Refuse a belief of another time than t_ns.

    Raises:
        ValueError: it is one.
    """
    if belief.t_ns != t_ns:
        raise ValueError(f"asked for a belief at {t_ns} ns, was given one at {belief.t_ns} ns")


def _check_array(name: str, values: Any, shape: tuple[int, ...]) -> None:
    if not (isinstance(values, np.ndarray) and values.dtype == FLOAT and values.shape == shape):
        found = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise TypeError(f"{name} of a belief or trajectory must be a float64 array {shape}, found {found}")


def check_smoothed(smoothed: Trajectory, ticks_ns: TimeArray, given_ns: TimeArray) -> None:
    """Refuse what is not the trajectory at all ticks: one of some ticks would choose where it is scored.

    Args:
        smoothed: what `finish` returned.
        ticks_ns: all ticks of the log, (k,) ns.
        given_ns: those at which it gave a belief, (n,) ns: all, unless the run ended early.

    Raises:
        TypeError: not a Trajectory, or an array in it is of another shape or type.
        ValueError: it lacks a tick or has a time that is none; its look-ahead is not positive.
    """
    if not isinstance(smoothed, Trajectory):
        raise TypeError(f"finish() returned {type(smoothed).__name__}, expected a fathom.datasets.Trajectory or None")
    n, t_ns = len(smoothed.t_ns), smoothed.t_ns
    if not (isinstance(t_ns, np.ndarray) and t_ns.dtype == np.int64):
        raise TypeError(f"t_ns of a trajectory must be int64 nanoseconds, found {getattr(t_ns, 'dtype', type(t_ns))}")
    for name, shape in {"R_WB": (n, 3, 3), **dict.fromkeys(VECTORS, (n, 3)), "P": (n, DIM, DIM)}.items():
        values = getattr(smoothed, name)
        if values is not None or name in ("R_WB", "p_WB_W"):
            _check_array(name, values, shape)
    if (np.diff(t_ns) <= 0).any():
        raise ValueError("finish(): the times are not in order")
    elsewhere = np.flatnonzero(~np.isin(t_ns, ticks_ns))
    if len(elsewhere):
        raise ValueError(f"finish(): {t_ns[elsewhere[0]]} ns is no time at which a belief was asked for (epoch.tick)")
    lacking = np.flatnonzero(~np.isin(given_ns, t_ns))
    if len(lacking):
        raise ValueError(
            f"finish(): {n} of {len(given_ns)} ticks; it must return the states at all times at which a belief was "
            f"asked for, the first without one is {given_ns[lacking[0]]} ns"
        )
    if not isinstance(smoothed.lookahead_s, int | float) or not smoothed.lookahead_s >= 0:
        raise ValueError(f"finish(): lookahead_s must be seconds, 0 or more, found {smoothed.lookahead_s!r:.60}")


def check_counts(counts: Mapping[str, int]) -> None:
    """Refuse numbers that count nothing.

    Raises:
        ValueError: one is negative.
    """
    for name, n in counts.items():
        if n < 0:
            raise ValueError(f"counts[{name!r}] is {n}; a count is 0 or more")


class WrongValue(NamedTuple):
    """The first row of a trajectory that cannot be, what the run is for it, and why."""

    row: int
    status: Literal["diverged", "failed"]
    cause: str


def wrong_value(track: Trajectory) -> WrongValue | None:
    """Return the first row of a trajectory that cannot be; None if all can.

    A row of P may be all NaN: no covariance was asked for there. What else is not finite has diverged, and so has a
    covariance that is none. What is no rotation is an error of the program.
    """
    return min([*_not_finite(track), *_not_rotations(track.R_WB), *_not_covariances(track.P)], default=None)


def _not_finite(track: Trajectory) -> Iterator[WrongValue]:
    for name in ("R_WB", *VECTORS):
        values = getattr(track, name)
        if values is not None and not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0]) // math.prod(values.shape[1:])
            yield WrongValue(row, "diverged", f"{name} is not finite")


def _not_rotations(R: Array) -> Iterator[WrongValue]:
    off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    for row in np.flatnonzero(off > ROTATION_TOLERANCE)[:1]:
        yield WrongValue(int(row), "failed", f"R_WB is not a rotation: |R Rᵀ − I| is up to {off[row]:.1e}")
    for row in np.flatnonzero((off <= ROTATION_TOLERANCE) & (np.linalg.det(R) < 0))[:1]:
        yield WrongValue(int(row), "failed", "R_WB is a reflection, not a rotation: its determinant is −1")


def _not_covariances(P: Array | None) -> Iterator[WrongValue]:
    if P is None:
        return
    absent = np.isnan(P[:, 0, 0])
    absent[absent] = np.isnan(P[absent]).all(axis=(1, 2))
    rows = np.flatnonzero(~absent)
    P = P[rows] if absent.any() else P
    if _is_positive_definite(P):
        return
    variance = np.abs(P.diagonal(axis1=1, axis2=2)).reshape(len(P), -1, 3).mean(axis=2)
    sigma = np.sqrt(np.where(variance > 0, variance, 1.0)).repeat(3, axis=1)  # one for each block, as for its unit
    scaled = P / (sigma[:, :, None] * sigma[:, None, :])
    infinite = ~np.isfinite(scaled).all(axis=(1, 2))
    scaled[infinite] = np.eye(DIM)
    skew = np.abs(scaled - scaled.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0) > COVARIANCE_TOLERANCE
    negative = np.linalg.eigvalsh(scaled)[:, 0] < -COVARIANCE_TOLERANCE
    for what, bad in (("finite", infinite), ("symmetric", skew), ("positive semidefinite", negative)):
        for row in rows[bad][:1]:
            yield WrongValue(int(row), "diverged", f"P is not {what}")


def _is_positive_definite(P: Array) -> bool:
    """Return whether all covariances are, far from doubt, at a sixth of what eigenvalues cost; as a rule that is so."""
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    least = P.diagonal(axis1=1, axis2=2).min(initial=np.inf)
    return bool(np.abs(P - P.swapaxes(1, 2)).max(initial=0.0) <= COVARIANCE_TOLERANCE * least)  # NaN is not
