"""Rows without a reading: a marker value that the device writes instead, zeros on every axis, and stuck pieces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..findings.fitting import MAD_TO_SIGMA
from .channels import Channel
from .frozen import frozen_rows
from .neighbours import FEWEST

FEWEST_MARKED = 3
"""Rows: two equal values may be chance."""
MARKER_FAR = 20.0
"""In robust sigmas from the median: a value that repeats exactly beyond this is a marker."""
NEAR_ZERO = 0.1
"""Of the median size: a stream that has readings below this may well have some at zero."""


@dataclass(frozen=True, eq=False)
class MissingRows:
    """Rows (n,) without a reading: those with the value `marker` on some axis, of zeros, and stuck."""

    marked: NDArray[np.bool_]
    zero: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    marker: float = 0.0

    @property
    def readings(self) -> NDArray[np.bool_]:
        """The other rows."""
        return ~(self.marked | self.zero | self.frozen)


@lru_cache(maxsize=16)
def missing_rows(channel: Channel) -> MissingRows:
    """Find a value far outside the others that repeats exactly, and rows of zeros far from the rest."""
    measured = np.isfinite(channel.sigma)
    x = channel.raw[:, measured]
    marked, zero, marker = np.zeros(len(x), bool), np.zeros(len(x), bool), 0.0
    if len(x) < FEWEST or x.shape[1] == 0:
        return MissingRows(marked, zero, frozen_rows(channel))
    quanta = np.array([steps.quantum for steps in channel.steps])[measured]
    for axis, quantum in zip(x.T, quanta, strict=True):
        off = np.abs(axis - np.median(axis))
        spread = max(MAD_TO_SIGMA * float(np.median(off)), quantum)
        far = (off > MARKER_FAR * spread) & (axis != 0)
        if spread == 0 or not far.any():
            continue
        values, counts = np.unique(axis[far], return_counts=True)
        most = int(np.argmax(counts))
        value, others = values[most], axis[axis != values[most]]
        change = np.abs(np.diff(others))
        usual = max(float(np.median(change[change > 0])) if change.any() else 0.0, quantum)
        # only markers and a few outliers lie out there; a true reading would have been reached gradually
        alone = np.abs(others - value).min() > MARKER_FAR * usual
        if alone and counts[most] >= max(FEWEST_MARKED, 0.5 * counts.sum()):
            marked |= axis == value
            marker = float(value)
    rest = ~marked & ~(x == 0).all(axis=1)
    if x.shape[1] > 1 and rest.sum() >= FEWEST:
        size = float(np.median(np.linalg.norm(x[rest], axis=1)))
        zeros = (x == 0).all(axis=1) & ~marked
        near = np.mean((np.abs(x[rest]) <= np.maximum(NEAR_ZERO * size, 1.5 * quanta)).all(axis=1))
        if zeros.sum() >= FEWEST_MARKED and near <= 0.5 * np.mean(zeros):
            zero = zeros
    return MissingRows(marked, zero, frozen_rows(channel) & ~marked & ~zero, marker)


def readings_of(channel: Channel) -> Channel:
    """Return the channel without the rows that `missing_rows` finds."""
    good = missing_rows(channel).readings
    return channel if good.all() else channel.rows(good)
