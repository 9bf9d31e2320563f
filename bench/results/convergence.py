"""Convergence over seeds: the share of runs whose attitude converges, and how accurate and consistent these are."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, median

import scipy  # its stats load when they are first asked for

from ..metrics.consistency import anees_of
from ..metrics.pose_error import pooled_rmse
from ..metrics.state_error import Block
from .summary import Record, Rows, has_score, last_words, outputs, scores_of

JUDGED: tuple[Block, ...] = ("attitude", "all")
"""The blocks whose ANEES is given: what started wrong, and everything."""
CONVERGENCE = (
    *("log", "label", "output", "lookahead_s", "limit_deg", "runs", "converged", "share", "low", "high"),
    *("median_s", "ate_rmse_m", *(f"anees_{block}" for block in JUDGED)),
)


def convergence(rows: Rows) -> list[Record]:
    """Return one record per log, estimator and output whose runs were scored by `converged_deg`, as in CONVERGENCE.

    `share` is of all runs, with its 95 % interval by Wilson from `low` to `high`: one that fails does not converge.
    Time (median), ATE (pooled over runs) and ANEES (mean over times and runs) are of the runs that converge. Only
    `last_words` are given.
    """
    found = []
    for output, of in outputs(rows):
        limit_deg = scores_of(of).get("converged_deg")
        if limit_deg is not None:
            found.append(output | {"limit_deg": limit_deg} | _of_converged(of, output["runs"]))
    return last_words(found)


def limits(found: Sequence[Record]) -> str:
    """Return below which errors runs have converged, in words: "3°"."""
    return ", ".join(f"{limit:g}°" for limit in sorted({row["limit_deg"] for row in found}))


def _of_converged(rows: Sequence[Record], runs: int) -> Record:
    """Return how many of the runs converge, and the scores of these."""
    good = [row for row in rows if row["status"] == "done" and row["converged_s"] is not None]
    interval = scipy.stats.binomtest(len(good), runs).proportion_ci(method="wilson")
    averages = anees_of([row["nees_at"] for row in good])
    scored = [row for row in good if has_score(row, "ate_rmse_m")]
    each, weights = ([row[name] for row in scored] for name in ("ate_rmse_m", "n_scored"))
    return {
        "converged": len(good),
        "share": len(good) / runs,
        "low": float(interval.low),
        "high": float(interval.high),
        "median_s": median(row["converged_s"] for row in good) if good else None,
        "ate_rmse_m": pooled_rmse(each, weights) if scored else None,
        **{f"anees_{block}": fmean(averages[block].value) if block in averages else None for block in JUDGED},
    }
