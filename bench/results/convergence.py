"""Convergence over seeds: the share of runs whose attitude converges, and how accurate and consistent these are."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from statistics import fmean, median

from scipy.stats import binomtest

from ..metrics.consistency import anees_of
from ..metrics.pose_error import pooled_rmse
from ..metrics.state_error import Block
from .summary import Record, Rows, groups, has_score, records

JUDGED: tuple[Block, ...] = ("attitude", "all")
"""The blocks whose ANEES is given: what started wrong, and everything."""
CONVERGENCE = (
    *("log", "label", "output", "lookahead_s", "limit_deg", "runs", "converged", "share", "low", "high"),
    *("median_s", "ate_rmse_m", *(f"anees_{block}" for block in JUDGED)),
)


def convergence(rows: Rows) -> list[Record]:
    """Return one record per log, estimator and output whose runs were scored by `converged_deg`, as in CONVERGENCE.

    `share` is of all runs, with its 95 % interval by Wilson from `low` to `high`: one that fails does not converge.
    Time (median), ATE (pooled over runs) and ANEES (mean over times and runs) are of the runs that converge. What a
    smoother over the whole log says during the log is left out: it is a filter's, or a first guess.
    """
    found = []
    for (log, label), of_label in groups(records(rows), "log", "label").items():
        limit_deg = json.loads(of_label[-1]["spec"] or "{}").get("scores", {}).get("converged_deg")
        if limit_deg is None:
            continue
        whole = any(row["lookahead_s"] == math.inf for row in of_label)
        runs = len(groups(of_label, "seed"))
        for (output,), of in groups(of_label, "output").items():
            ahead = next((row["lookahead_s"] for row in of if row["lookahead_s"] is not None), None)
            if whole and ahead != math.inf:
                continue
            record = {"log": log, "label": label, "output": output, "lookahead_s": ahead, "limit_deg": limit_deg}
            found.append(record | {"runs": runs} | _of_converged(of, runs))
    return found


def _of_converged(rows: Sequence[Record], runs: int) -> Record:
    """Return how many of the runs converge, and the scores of these."""
    good = [row for row in rows if row["status"] == "done" and row["converged_s"] is not None]
    interval = binomtest(len(good), runs).proportion_ci(method="wilson")
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
