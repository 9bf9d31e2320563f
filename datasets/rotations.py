"""What counts as a rotation, wherever one is given: as a matrix or a quaternion, in a file, a config or an estimate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .notes import Note
from .state import Array

UNHEARD = 1e-7
"""How far single precision (24 bits) rounds a rotation: such a matrix is taken as it is, without a word."""
ROUNDED = 2e-6
"""A rotation written to six decimals is not farther off: its rounding is taken out as well, but that is no news."""
TOLERANCE = 1e-3
"""A rotation written to three decimals is not farther off; what is farther was not meant as one."""


def off_rotation(R: Array) -> Array:
    """Return how far each matrix (..., 3, 3) is from a rotation, (...): the largest entry of |R Rᵀ − I| / 2.

    A scale of 1 + ε is ε off. Infinite where R is not finite, or mirrors (determinant below zero).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-1, -2), initial=0.0) / 2
        return np.where(np.isnan(off) | (np.linalg.det(R) < 0), np.inf, off)


def off_unit(q: Array) -> Array:
    """Return how far the length of each quaternion (..., 4) is from one, (...); infinite where it is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.linalg.norm(q, axis=-1) - 1)
        return np.where(np.isnan(off), np.inf, off)


def is_rotation(off: Array) -> NDArray[np.bool_]:
    """Return where what is this far off still counts as a rotation."""
    return np.asarray(off <= TOLERANCE)


def orthonormalised(R: Array, off: Array) -> Array:
    """Return matrices (..., 3, 3) that are `off` a rotation (...), each replaced by the nearest rotation if it counts
    as one and is farther off than single precision rounds; others unchanged."""
    mend = is_rotation(off) & (off > UNHEARD)
    if not mend.any():
        return R
    R = R.copy()
    U, _, Vt = np.linalg.svd(R[mend])
    R[mend] = U @ Vt
    return R


def complaint(R: Array, at_most: float = TOLERANCE) -> str:
    """Return why one matrix (3, 3) is not a rotation; `at_most` is what it may be off."""
    if not np.isfinite(R).all():
        return f"not a rotation: {_row(R)} is not finite"
    with np.errstate(over="ignore"):
        if np.linalg.det(R) < 0:
            return f"not a rotation, but mirrors (an axis has the wrong sign): {_row(R)}"
    return f"not a rotation: {_row(R)} is {off_rotation(R):.2g} off orthonormal axes; it may be {at_most:g} off"


def complaint_of_quaternion(q: Array) -> str:
    """Return why one quaternion (4,) is not of unit length."""
    with np.errstate(over="ignore", invalid="ignore"):
        return f"not a unit quaternion (|q| = {np.linalg.norm(q):.6g}); it may be {TOLERANCE:g} off"


def note(what: str, off: Array, stream: str = "") -> tuple[Note, ...]:
    """Return in a sentence that rotations `off` (n,) were orthonormalised; nothing where that cannot be told.

    It is of kind "about" where they are no farther off than six decimals round, else "repaired".

    Args:
        what: whose: "heading", "truth".
        off: of those that are kept.
        stream: the sensor, for a table.
    """
    count = int(np.count_nonzero(off > UNHEARD))
    if not count:
        return ()
    most = np.max(off)
    text = f"{what}: {count:,} rotation{'s' if count > 1 else ''} made exact, off by up to {most:.1e}"
    return (Note(text, "repaired" if most > ROUNDED else "about", stream, count, len(off)),)


def _row(R: Array) -> str:
    return np.array2string(R.ravel(), precision=6, separator=", ", max_line_width=1000)
