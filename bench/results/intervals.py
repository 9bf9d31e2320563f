"""Intervals of scores over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from ..metrics.comparison import OVER_SEEDS
from ..metrics.interval import interval
from ..metrics.scoring import POOLED
from .paired import TAKE
from .summary import Record, Rows, groups, has_score, records, summarise

TABLED = ("ate_rmse_m", "heading_rmse_deg", "drift_end_percent", "rpe_rmse_m")
"""Scores whose intervals stand in table.csv and table.tex."""


def interval_over_seeds(done: Sequence[Record], score: str) -> tuple[float, float] | None:
    """Return the 95 % `interval` of what `summarise` makes of a score; None with fewer than FEWEST_SEEDS seeds.

    Args:
        done: the rows of one log, estimator and output that finished.
        score: one of `paired.OVER_SEEDS`.
    """
    known = [row for row in done if row[score] is not None]
    if not all(has_score(row, score) for row in known):
        return None
    weights = tuple(float(row[POOLED[score]]) if score in POOLED else 1.0 for row in known)
    return _interval(tuple(float(row[score]) for row in known), weights, score)


@lru_cache(maxsize=10_000)
def _interval(values: tuple[float, ...], weights: tuple[float, ...], score: str) -> tuple[float, float] | None:
    over = OVER_SEEDS[score]
    return interval(
        (np.array(values), np.array(weights)),
        lambda value, weight, axis=-1: TAKE[over](value, weight, axis),
        positive=True,
        median=over == "median",
    )


def summarise_with_intervals(rows: Rows) -> list[Record]:
    """Return what `summarise` does, and `<score>_low`, `<score>_high` for each score of TABLED: None with few seeds."""
    every = records(rows)
    by_output = groups((row for row in every if row["status"] == "done"), "log", "label", "output")
    summary = [dict(record) for record in summarise(every)]
    for record in summary:
        of_output = by_output.get((record["log"], record["label"], record["output"]), [])
        for score in TABLED:
            low, high = interval_over_seeds(of_output, score) or (None, None)
            record |= {f"{score}_low": low, f"{score}_high": high}
    return summary
