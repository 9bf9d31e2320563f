"""Bootstrap intervals over seeds."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Literal

import numpy as np
import scipy  # its stats load when they are first asked for

from ...datasets.state import Array

FEWEST_SEEDS = 5
"""With fewer there is neither interval nor test: the bootstrap's 95 % interval would contain the truth in half to three
quarters of cases (with 20 seeds, in 91 %), and even five seeds that all agree have a p of 0.06."""

MANY_SEEDS = 1000
"""With more, BCa is not worth its time, which grows with the square of the seeds: for a mean of scores as skewed as an
exponential distribution it moves the ends by 3 % of their distance from the mean, and less with every seed more."""
ENOUGH = 1999
"""Draws of many seeds: the ends of an interval at 95 % then have an error of 2 % of its width."""
BATCH = 500_000
"""Numbers drawn at a time: 4 MB for each array."""


def bootstrap_interval(
    data: tuple[Array, ...],
    statistic: Callable[..., Array],
    method: Literal["BCa", "percentile"] = "BCa",
    level: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
) -> tuple[float, float] | None:
    """Return the bootstrap interval of a statistic over seeds; None with fewer than FEWEST_SEEDS.

    Args:
        data: (n,) arrays, which are resampled together, seed by seed: values, weights, values, weights, ...
        statistic: of such arrays, along `axis`.
        method: "BCa" is bias-corrected and accelerated; "percentile" is used also where BCa is not defined, and with
            more than MANY_SEEDS.
        level: of the interval, between 0 and 1.
        resamples, seed: of the draws; 9999 is scipy's own number. With more than MANY_SEEDS at most ENOUGH are drawn.
    """
    if len(data[0]) < FEWEST_SEEDS:
        return None
    n, value = len(data[0]), float(statistic(*data))
    if n > MANY_SEEDS:
        method, resamples = "percentile", min(resamples, ENOUGH)
    if all(np.ptp(x) == 0.0 for x in data) or (method == "BCa" and _are_equal_without_one(data, statistic)):
        return value, value  # all resamples are equal
    low = high = math.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)
        for name in (method, "percentile"):  # where BCa is not defined
            interval = scipy.stats.bootstrap(
                data, statistic, paired=True, vectorized=True, batch=max(1, BATCH // n), method=name,
                confidence_level=level, n_resamples=resamples, rng=np.random.default_rng(seed),
            ).confidence_interval  # fmt: skip
            low, high = float(interval.low), float(interval.high)
            if math.isfinite(low) and math.isfinite(high):
                break
    return low, high


def _are_equal_without_one(data: tuple[Array, ...], statistic: Callable[..., Array]) -> bool:
    """Return whether the statistic is the same whichever seed is left out."""
    each = np.arange(len(data[0]))
    without = np.array([statistic(*(x[each != k] for x in data)) for k in each])
    scale = max(float(np.abs(x).max()) for x in (without, *data[::2]))
    return bool(np.ptp(without) <= 1e-12 * scale)
