"""How sure a number over seeds is: its bootstrap interval, the seeds being what is drawn from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..paired import FEWEST_SEEDS, OVER_SEEDS, TAKE, bootstrap_interval
from ..summary import POOLED, Record

RESAMPLES = 1999


def interval_over_seeds(done: Sequence[Record], score: str) -> tuple[float, float] | None:
    """Return the 95 % bootstrap interval of what `summarise` makes of a score; None with fewer than FEWEST_SEEDS seeds.

    Bias-corrected and accelerated, and of percentiles for a median, as `paired.difference` has it; with few seeds it
    is too narrow by as much as is said there.

    Args:
        done: the rows of one log, estimator and output that came to their end.
        score: one of `paired.OVER_SEEDS`.
    """
    known = [row for row in done if row[score] is not None]
    if len(known) < FEWEST_SEEDS:
        return None
    over = OVER_SEEDS[score]
    value = np.array([row[score] for row in known], float)
    weight = np.array([row[POOLED[score]] if score in POOLED else 1.0 for row in known], float)
    return bootstrap_interval(
        (value, weight),
        lambda value, weight, axis=-1: TAKE[over](value, weight, axis),
        method="percentile" if over == "median" else "BCa",
        seed=0,
        confidence_level=0.95,
        n_resamples=RESAMPLES,
    )
