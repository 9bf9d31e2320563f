"""Which results are compared, and how each score is taken over the seeds."""

from __future__ import annotations

from typing import Literal, NamedTuple

from .scoring import MEAN, MEDIAN, POOLED

Over = Literal["rms", "mean", "median"]


OVER_SEEDS: dict[str, Over] = {
    **dict.fromkeys(POOLED, "rms"),
    **dict.fromkeys(MEAN, "mean"),
    **dict.fromkeys(MEDIAN, "median"),
}
"""Scores that can be compared, and how `summary` takes each over the seeds."""


class Comparison(NamedTuple):
    """One estimator on one log against its baseline: another estimator there, or itself on another log."""

    log: str
    label: str
    baseline_log: str
    baseline_label: str
