"""A reading against its neighbours: noise and outliers, without a model of the motion.

A cubic through the two readings before and the two after predicts the one between. The residual contains no motion that
is slow compared with five readings. For white noise its variance is (1 + 34/36) times that of a reading.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....datasets.state import Array, TimeArray
from ..findings.fitting import MAD_TO_SIGMA
from .channels import Channel

NOISE_GAIN = np.sqrt(1 + 34 / 36)
"""Standard deviation of the residual over that of the readings, for white normal noise."""
BLOCK = 100
"""Rows over which the spread is taken to be constant: its robust sigma is then known to 12 %."""
FEWEST = 20
"""Residuals: with fewer no spread is estimated."""
FAR = 7.0
"""In robust sigmas: a reading beyond this is an outlier; normal noise exceeds it once in 4e11."""
FAR_FROM_CUBIC = 4.0
"""In robust sigmas from the cubic: the second condition on an outlier, since a cubic follows motion closely."""
STATED_FAR = 3.0
"""In stated sigmas: within this the stated noise explains an outlier."""


def robust_sigma(values: Array) -> Array:
    """Return 1.4826 × the median absolute deviation, by columns; rows with NaN are ignored."""
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < FEWEST:
        return np.full(values.shape[1], np.nan)
    return MAD_TO_SIGMA * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def residuals(channel: Channel) -> Array:
    """Return (n, k): reading less the cubic through its four neighbours; NaN where one of them is missing."""
    x, t_ns, out = channel.x, channel.t_ns, np.full(channel.x.shape, np.nan)
    if len(x) >= 5:
        whole = (t_ns[4:] - t_ns[:-4]) * 1e-9 < 5.0 * channel.period_s
        out[2:-2][whole] = (x[2:-2] - (4 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6)[whole]
    return out


def noise_sigma(channel: Channel) -> Array:
    """Return (k,) the standard deviation of the channel's white noise, estimated from its values."""
    return robust_sigma(residuals(channel)) / NOISE_GAIN


def rounding_sigma(channel: Channel) -> Array:
    """Return (k,) the standard deviation of the rounding error, step / √12; 0 for an axis without steps."""
    return np.array([steps.quantum for steps in channel.steps]) / np.sqrt(12)


def outliers(channel: Channel) -> NDArray[np.bool_]:
    """Return which readings (n,) are outliers among their neighbours on some measured axis.

    A reading must be far from the median of its four neighbours, far from the cubic through them (else it is motion),
    and further than the stated noise explains. For the IMU the spread is the local one, because vibration varies. For
    an aiding sensor it is that of the whole log: a noisy time is an error too.
    """
    x, none = channel.x, np.zeros(len(channel.x), bool)
    off = residuals(channel)
    if not np.isfinite(off).any():
        return none
    around = np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]])
    beside = np.full(x.shape, np.nan)
    beside[2:-2] = x[2:-2] - np.median(around, axis=0)
    beside[np.isnan(off)] = np.nan
    stated = STATED_FAR * np.where(np.isfinite(channel.sigma), channel.sigma, np.inf)
    spread_of = _spread_thereabouts if channel.stream == "imu" else robust_sigma
    rounding = rounding_sigma(channel)
    with np.errstate(invalid="ignore"):
        far = (np.abs(beside) > FAR * np.maximum(spread_of(beside), rounding)) & (np.abs(beside) > stated)
        far &= np.abs(off) > FAR_FROM_CUBIC * np.maximum(spread_of(off), rounding)
    return np.asarray(far.any(axis=1))


def spread_by_block(values: Array) -> tuple[TimeArray, Array]:
    """Return the edges (b + 1,) of blocks of about 100 rows, and the robust sigma of each (b, k)."""
    blocks = max(len(values) // BLOCK, 1)
    edges = np.linspace(0, len(values), blocks + 1).astype(np.int64)
    longest = int(np.diff(edges).max())
    padded = np.full((blocks, longest, values.shape[1]), np.nan)
    row = np.arange(len(values)) - np.repeat(edges[:-1], np.diff(edges))
    padded[np.repeat(np.arange(blocks), np.diff(edges)), row] = values
    spread = MAD_TO_SIGMA * _nan_median(np.abs(padded - _nan_median(padded)[:, None]))
    return edges, np.where(np.isfinite(padded).sum(axis=1) >= FEWEST, spread, np.nan)


def _nan_median(values: Array) -> Array:
    """Return the medians (b, k) of values (b, m, k) without NaN; numpy's own makes a Python call for each."""
    count = np.isfinite(values).sum(axis=1, keepdims=True)
    ordered = np.sort(values, axis=1)  # NaN last
    middle = [np.take_along_axis(ordered, np.maximum((count - less) // 2, 0), axis=1) for less in (0, 1)]
    return 0.5 * (middle[0] + middle[1])[:, 0]


def _spread_thereabouts(values: Array) -> Array:
    """Return (n, k): the largest of the robust sigmas of a row's block, of the two next to it, and of all rows."""
    edges, spread = spread_by_block(values)
    overall = robust_sigma(values)
    spread = np.where(np.isfinite(spread), spread, overall)
    padded = np.vstack([spread[:1], spread, spread[-1:]])
    widest = np.maximum(np.maximum(padded[:-2], padded[1:-1]), np.maximum(padded[2:], overall))
    return np.repeat(widest, np.diff(edges), axis=0).reshape(values.shape)


def stretches(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the stretches in which a mask (n,) is true, by their first and their last row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
