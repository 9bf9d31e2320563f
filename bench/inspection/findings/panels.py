"""Style of the page's panels: one colour per stream, and no more points than a page can show."""

from __future__ import annotations

import numpy as np

from ....datasets.state import Array, TimeArray
from ...drawing import PALETTE

COLOURS: dict[str, str] = dict(zip(("imu", "dvl", "depth", "gps", "heading"), PALETTE, strict=False))
AXIS_COLOURS = PALETTE[:3]
MOST_BINS = 1000
"""Points per curve, twice: a panel is some 500 pixels wide, so more would not be seen."""


def colour_of(stream: str) -> str:
    """Return the colour of a stream in every panel."""
    return COLOURS.get(stream, PALETTE[6])


def thinned(values: Array) -> TimeArray:
    """Return the rows of a long (n,) series that its picture needs: the least and the largest of each of 1000 bins."""
    n = len(values)
    if n <= 2 * MOST_BINS:
        return np.arange(n)
    size = -(-n // MOST_BINS)
    padded = np.concatenate([values, np.repeat(values[-1:], -n % size)]).reshape(-1, size)
    starts = np.arange(len(padded)) * size
    rows = np.concatenate([starts + padded.argmin(axis=1), starts + padded.argmax(axis=1)])
    return np.unique(np.minimum(rows, n - 1))
