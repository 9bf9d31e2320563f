"""How finely a channel is told: the values it takes, and the grid they lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....datasets.state import Array

ROUNDING = 1e-9
"""Of the largest value: what two equal values may differ by after conversion."""
SAME_STEP = 0.9
"""Share of the changes that are one step, from which on a channel rests on its steps."""
GRID_SHARE = 0.95
FEWEST = 20
"""Rows below which no grid is looked for."""


@dataclass(frozen=True)
class Steps:
    """How finely an axis is told.

    Attributes:
        levels: how many values it takes.
        quantum: their spacing, where all lie on one grid; else 0.
        coarse: whether the axis mostly stands still, and then changes by one step.
        same: share of readings that equal the one before.
    """

    levels: int
    quantum: float
    coarse: bool
    same: float


def steps_of(x: Array) -> Steps:
    """Measure the steps of an axis (n,)."""
    size = float(np.abs(x).max(initial=0.0))
    if len(x) < 2 or size == 0.0:
        return Steps(min(len(x), 1), 0.0, False, float(len(x) > 1))
    counts = np.rint(x / (size * ROUNDING)).astype(np.int64)
    levels = np.sort(counts)
    levels = levels[np.concatenate([[True], np.diff(levels) > 0])]  # np.unique hashes, ten times slower
    spacing = np.diff(levels)
    spacing = spacing[spacing > 1]
    change = np.abs(np.diff(counts))
    same = float(np.mean(change <= 1))
    if not len(spacing):
        return Steps(1, 0.0, False, same)
    least = int(spacing.min())
    near = spacing[spacing < 20 * least]  # farther, the error of the least one adds up
    least = float(np.median(near / np.rint(near / least)))
    off = np.abs(near / least - np.rint(near / least))
    on_grid = len(near) >= min(5, len(levels) - 1) and np.mean(off < 0.05) >= GRID_SHARE and len(x) >= FEWEST
    fine = len(levels) > 0.99 * len(x) and least < 100  # as many values as rows, on the grid of our own rounding
    if not on_grid or fine:
        return Steps(len(levels), 0.0, False, same)
    moved = change[change > 1]
    coarse = same > 0.5 and float(np.mean(moved < 1.5 * least)) >= SAME_STEP
    return Steps(len(levels), least * size * ROUNDING, bool(coarse), same)
