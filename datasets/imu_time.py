"""When an IMU sampled, by its stamps: the sampling interval about each sample, and the gaps.

Stamps jitter, come in bursts (pairs over USB, packets) or in whole milliseconds, and a rate may change during a log.
None of this is a gap. So an interval is judged by those about it and by how many samples there are: where the next
stamps catch up with a late one, nothing is lost.
"""

from __future__ import annotations

import numpy as np

from .state import Array, TimeArray

STRETCH = 120
"""Intervals over which a rate is found: about a second; whole packets of 2 to 6, 8, 10, 12, 15 or 20 samples."""
STRETCHES = 5
"""Stretches whose mean interval counts together, less the longest and the shortest: a gap lengthens one of them."""
SHORT, MOST_SHORT = 0.7, 0.02
"""Lost samples make intervals longer. If over 2 % of them are shorter than 0.7 of the mean, the stamps are uneven."""
GAP_FACTOR = 1.5
"""An interval longer than this many of its neighbours is a gap, if no later stamp makes up for it."""
CATCH_UP = 32
"""Samples in which stamps may catch up: packets of IMUs hold some ten."""
LONGEST_STALL_NS = 250_000_000
"""0.25 s: if stamps stand still for longer, one sample stands for too long a motion, whatever comes after it."""
LEAST_GAP_NS = 2_000_000
"""2 ms: stamps in whole milliseconds are off by this much, and no vehicle turns noticeably meanwhile."""


def sampling_ns(t_ns: TimeArray) -> TimeArray:
    """Return the sampling interval about each sample, (n,) ns: the median, or the mean where stamps are uneven.

    Args:
        t_ns: (n,) times of the samples, n > 1, increasing.
    """
    return _sampling(np.diff(t_ns))[1][_stretch_of(len(t_ns))]


def first_sampling_ns(t_ns: TimeArray) -> int:
    """Return the sampling interval about the first sample, ns."""
    return int(sampling_ns(t_ns[: STRETCH * STRETCHES + 1])[0])


def gaps_ns(t_ns: TimeArray) -> TimeArray:
    """Return how long samples are missing before each sample, (n,) ns; 0 where none is, and before the first.

    Args:
        t_ns: as for `sampling_ns`.
    """
    n, step = len(t_ns), np.diff(t_ns)
    of = _stretch_of(n)[1:]
    median, period = _sampling(step)
    stalled = (step > LONGEST_STALL_NS) & (step > GAP_FACTOR * _slowest(median)[of])
    longer = (step > GAP_FACTOR * _slowest(period)[of]) & (step > period[of] + LEAST_GAP_NS)
    gaps = np.zeros(n, np.int64)
    gaps[1:][longer] = _missing(t_ns, np.flatnonzero(longer) + 1, period[of[longer]])
    gaps[1:][stalled] = step[stalled] - median[of[stalled]]
    return gaps


def _missing(t_ns: TimeArray, late: TimeArray, period: TimeArray) -> TimeArray:
    """Return the time that is missing before each late sample, less that of samples which only came late.

    Args:
        t_ns: (n,) times of all samples.
        late, period: (m,) rows of the late samples, and the sampling interval about them.
    """
    missing = t_ns[late] - t_ns[late - 1] - period
    least = missing.copy()
    for more in range(1, CATCH_UP + 1):
        at = np.minimum(late + more, len(t_ns) - 1)
        least = np.minimum(least, t_ns[at] - t_ns[late - 1] - (at - late + 1) * period)
    missing -= np.rint((missing - least) / period).astype(np.int64) * period
    return np.where(least > np.maximum((GAP_FACTOR - 1) * period, LEAST_GAP_NS), missing, 0)


def _sampling(step: TimeArray) -> tuple[TimeArray, TimeArray]:
    """Return the median interval of each stretch, and its sampling interval; the last holds the rest as well."""
    size = min(STRETCH, len(step))
    count = len(step) // size
    stretches = step[: count * size].reshape(count, size)
    median, mean = np.median(stretches, axis=1), _smoothed(stretches.mean(axis=1))
    uneven = (stretches < SHORT * mean[:, None]).mean(axis=1) > MOST_SHORT
    fine = median < 2 * LEAST_GAP_NS  # rounded to milliseconds, a median may be off by as much
    both = np.array([median, np.where(uneven | fine, mean, median)])
    return tuple(np.maximum(np.rint(both), 1).astype(np.int64))


def _smoothed(values: Array) -> Array:
    """Return the mean of each value and its neighbours, STRETCHES in all, less the greatest and the least."""
    if len(values) < STRETCHES:
        return np.full(len(values), np.median(values))
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(values, STRETCHES), axis=1)
    return np.pad(windows[:, 1:-1].mean(axis=1), STRETCHES // 2, mode="edge")


def _slowest(stretch: TimeArray) -> TimeArray:
    """Return the longest interval of each stretch and its neighbours, so that a new rate is no gap."""
    around = np.pad(stretch, 1, mode="edge")
    return np.max([around[:-2], around[1:-1], around[2:]], axis=0)


def _stretch_of(n: int) -> TimeArray:
    """Return the stretch of each of n samples; a sample belongs to the interval that ends at it."""
    size = min(STRETCH, n - 1)
    return np.minimum(np.maximum(np.arange(n) - 1, 0) // size, (n - 1) // size - 1)
