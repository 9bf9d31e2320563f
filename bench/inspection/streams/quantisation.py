"""The resolution of a channel: the values it takes, and the grid that they lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....datasets.state import Array

ROUNDING = 1e-9
"""Of the largest value: two equal values may differ by this after conversion."""
SAME_STEP = 0.9
"""Share of the changes that must be one step for a channel to count as coarse."""
GRID_SHARE = 0.95
"""Share of the values that must lie on the grid; the rest may be outliers or markers."""
FEWEST = 20
"""Rows below which no grid is looked for."""


@dataclass(frozen=True)
class Quantisation:
    """The resolution of an axis.

    Attributes:
        levels: number of different values.
        quantum: their spacing if all lie on one grid; else 0.
        coarse: whether most readings equal the one before, and most others differ by one step.
        same: share of readings that equal the one before.
    """

    levels: int
    quantum: float
    coarse: bool
    same: float


def quantisation_of(x: Array) -> Quantisation:
    """Return the resolution of an axis (n,)."""
    size = float(np.abs(x).max(initial=0.0))
    if len(x) < 2 or size == 0.0:
        return Quantisation(min(len(x), 1), 0.0, False, float(len(x) > 1))
    counts = np.rint(x / (size * ROUNDING)).astype(np.int64)
    levels = np.sort(counts)
    levels = levels[np.concatenate([[True], np.diff(levels) > 0])]  # np.unique hashes, ten times slower
    spacing = np.diff(levels)
    spacing = spacing[spacing > 1]
    change = np.abs(np.diff(counts))
    same = float(np.mean(change <= 1))
    if not len(spacing):
        return Quantisation(1, 0.0, False, same)
    least = int(spacing.min())
    near = spacing[spacing < 20 * least]  # further apart, the error of the smallest adds up
    least = float(np.median(near / np.rint(near / least)))
    off = np.abs(near / least - np.rint(near / least))
    on_grid = len(near) >= min(5, len(levels) - 1) and np.mean(off < 0.05) >= GRID_SHARE and len(x) >= FEWEST
    fine = len(levels) > 0.99 * len(x) and least < 100  # as many values as rows, on the grid of our own rounding
    if not on_grid or fine:
        return Quantisation(len(levels), 0.0, False, same)
    moved = change[change > 1]
    coarse = same > 0.5 and float(np.mean(moved < 1.5 * least)) >= SAME_STEP
    return Quantisation(len(levels), least * size * ROUNDING, bool(coarse), same)
