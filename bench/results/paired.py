"""Paired differences of two variants on the same logs, with intervals and tests over seeds.

All variants run on the same log of a seed, so the two scores of a seed are a pair, and stay together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy  # its stats load when they are first asked for

from ...datasets.state import Array
from ..metrics.association import ScoreError
from ..metrics.comparison import OVER_SEEDS, Comparison, Over
from ..metrics.interval import FEWEST_SEEDS, interval
from ..metrics.scoring import POOLED, SCORES
from .summary import Record, Rows, groups, has_score, records

ALPHA = 0.05
"""Level of the tests, the customary one."""


@dataclass(frozen=True)
class Difference:
    """One score of a variant minus its baseline's, over the seeds that both finished.

    Attributes:
        pairs: how many seeds, or 1 for a recorded log.
        value, baseline: the scores of both over those seeds, pooled as in tables.
        difference: value − baseline, with its 95 % `interval` over seeds, low to high.
        ratio: value / baseline, likewise; None where scores are not all positive.
        mean_difference, median_difference: of the differences seed by seed.
        p_wilcoxon: two-sided, of the signed-rank test of those differences; the one to use, see `difference`.
        p_t: of the t test of the log ratios, for comparison.
        rank_biserial: effect size of the signed-rank test, from −1 (lower in every seed) to 1 (higher in every seed).
        d_z: mean of the differences over their standard deviation.
    """

    pairs: int
    value: float
    baseline: float
    difference: float
    low: float | None
    high: float | None
    ratio: float | None
    ratio_low: float | None
    ratio_high: float | None
    mean_difference: float
    median_difference: float
    p_wilcoxon: float | None
    p_t: float | None
    rank_biserial: float | None
    d_z: float | None


def difference(
    variant: Array,
    baseline: Array,
    over: Over = "mean",
    weights: tuple[Array, Array] | None = None,
    level: float = 0.95,
) -> Difference:
    """Compare two variants, scored on the same seeds.

    The two scores of a seed stay together. A 95 % interval of two RMSEs that share nine tenths of their errors holds
    the true difference and the true ratio in 93 to 96 % of cases, from 5 seeds to 50; of medians in 94 to 99 %.

    The test is Wilcoxon's signed-rank test, exact up to 50 seeds without ties. It assumes only that without an effect
    the two scores of a seed could be swapped. RMSEs are skewed, and a single bad seed ruins a t test; the t test of log
    ratios, given as well, has more power where ratios are log-normal. n seeds cannot give a p under 2^(1 − n). Seeds
    without a difference are left out; if no seed has one, p is 1.

    Args:
        variant, baseline: (n,) scores, seed by seed.
        over: how scores are pooled over seeds; "rms" pools their squares, by `weights`.
        weights: (n,) each, the number of errors in each RMSE; None for equal numbers.
        level: of the intervals.

    Raises:
        ScoreError: no pairs, not as many of one as of the other, or a number that is not finite.

    Source: Wilcoxon 1945, doi:10.2307/3001968; Kerby 2014, doi:10.2466/11.IT.3.1.
    """
    v, b = np.asarray(variant, np.float64), np.asarray(baseline, np.float64)
    if v.ndim != 1 or len(v) == 0 or v.shape != b.shape or not np.isfinite(np.stack([v, b])).all():
        raise ScoreError("paired difference: expected finite scores in pairs, at least one")
    n_v, n_b = (np.ones(len(v)), np.ones(len(v))) if weights is None else weights
    take = TAKE[over]

    def subtracted(v: Array, n_v: Array, b: Array, n_b: Array, axis: int = -1) -> Array:
        return take(v, n_v, axis) - take(b, n_b, axis)

    def divided(v: Array, n_v: Array, b: Array, n_b: Array, axis: int = -1) -> Array:
        return take(v, n_v, axis) / take(b, n_b, axis)

    data, median = (v, n_v, b, n_b), over == "median"
    positive, enough = bool((np.minimum(v, b) > 0).all()), len(v) >= FEWEST_SEEDS
    low, high = interval(data, subtracted, median=median, level=level) or (None, None)
    ratio = interval(data, divided, positive=True, median=median, level=level) if positive else None
    ratio_low, ratio_high = ratio or (None, None)
    d = v - b
    return Difference(
        pairs=len(v),
        value=float(take(v, n_v, -1)),
        baseline=float(take(b, n_b, -1)),
        difference=float(subtracted(*data)),
        low=low,
        high=high,
        ratio=float(divided(*data)) if positive else None,
        ratio_low=ratio_low,
        ratio_high=ratio_high,
        mean_difference=float(d.mean()),
        median_difference=float(np.median(d)),
        p_wilcoxon=signed_rank_p(d) if enough else None,
        p_t=t_p(np.log(v / b)) if enough and positive else None,
        rank_biserial=rank_biserial(d) if enough else None,
        d_z=d_z(d) if enough else None,
    )


def signed_rank_p(d: Array) -> float:
    """Return the two-sided p of Wilcoxon's signed-rank test of differences d (n,); 1 where they are all 0."""
    d = d[d != 0]
    if len(d) == 0:
        return 1.0
    result: Any = scipy.stats.wilcoxon(d)
    return float(result.pvalue)


def out_of_reach(seeds: int, tests: int) -> str | None:
    """Return in a sentence that no test of so many can be significant, however large its effect; None if one can.

    The smallest p of an exact test of n seeds is 2^(1 − n), and Holm multiplies the smallest of m by m.
    """
    if tests == 0:
        return None
    if seeds < FEWEST_SEEDS:
        return f"differences have neither intervals nor tests: they need {FEWEST_SEEDS} seeds"
    least = min(1.0, tests * 2.0 ** (1 - seeds))
    if least <= ALPHA:
        return None
    return f"with {tests} tests on {seeds} seeds there is no p under {least:.2g}: run more seeds, or compare less"


def t_p(x: Array) -> float | None:
    """Return the two-sided p of the t test that the mean of x (n,) is 0; None where all x have one value, not 0."""
    if np.ptp(x) <= 1e-12 * np.abs(x).max():
        return None if x.any() else 1.0
    result: Any = scipy.stats.ttest_1samp(x, 0.0)
    return float(result.pvalue)


def rank_biserial(d: Array) -> float:
    """Return the matched-pairs rank-biserial correlation of differences d (n,): (W₊ − W₋) / (W₊ + W₋).

    W₊ and W₋ are the sums of the ranks of |d| over the positive and the negative ones; 0 where all are 0.
    """
    d = d[d != 0]
    ranks = scipy.stats.rankdata(np.abs(d))
    return float((np.sign(d) * ranks).sum() / ranks.sum()) if len(d) else 0.0


def d_z(d: Array) -> float | None:
    """Return Cohen's d of paired differences (n,), mean over standard deviation; None if all are one value, not 0."""
    spread = float(d.std(ddof=1))
    if spread <= 1e-12 * float(np.abs(d).max()):
        return None if d.any() else 0.0
    return float(d.mean()) / spread


def holm(p: Sequence[float]) -> list[float]:
    """Return p values corrected by Holm: rejecting below α gives any false rejection with probability at most α.

    Valid under arbitrary dependence of the tests.
    p̃_(i) = max over j ≤ i of min(1, (m − j + 1) p_(j)), p_(1) the smallest of m.

    Source: Holm 1979, Scandinavian Journal of Statistics 6, 65–70.
    """
    order = np.argsort(p, kind="stable")
    steps = np.minimum(1.0, (len(p) - np.arange(len(p))) * np.asarray(p, np.float64)[order])
    corrected = np.empty(len(p))
    corrected[order] = np.maximum.accumulate(steps)
    return corrected.tolist()


def _rms(x: Array, n: Array, axis: int) -> Array:
    return np.sqrt((n * x * x).sum(axis=axis) / n.sum(axis=axis))


TAKE: dict[Over, Callable[[Array, Array, int], Array]] = {
    "rms": _rms,
    "mean": lambda x, n, axis: x.mean(axis=axis),
    "median": lambda x, n, axis: np.median(x, axis=axis),
}
"""How scores are pooled over seeds: functions of (scores, weights, axis)."""


# -- of a table of runs -----------------------------------------------------------------------------------------------

PAIRED = (
    *("log", "label", "output", "lookahead_s"),
    *("baseline_log", "baseline_label", "baseline_output", "baseline_lookahead_s"),
    *("score", "runs", *Difference.__dataclass_fields__, "p_holm"),
)
"""Columns of `paired`."""


def paired(rows: Rows, comparisons: Sequence[Comparison], scores: Sequence[str]) -> list[Record]:
    """Return one record per comparison, output and score: a `Difference`, None where there is nothing to compare.

    Each output is compared with the baseline's output of the same name; a smoothed one, where the baseline has none,
    with the baseline's online output. `runs` counts the seeds of both, `pairs` those that both finished. `p_holm` is
    `p_wilcoxon` corrected for all tests of the list. Two runs of one configuration (a second label, or an ablation of a
    sensor that the log has not) differ in no score of any seed: there is nothing to test, and they are not counted.
    """
    every = records(rows)
    outputs = groups(every, "log", "label", "output")
    seeds = {key: {row["seed"] for row in of} for key, of in groups(every, "log", "label").items()}
    found: list[Record] = []
    for log, label, *baseline in comparisons:
        for output in ("online", "smoothed"):
            own = outputs.get((log, label, output))
            against = next((o for o in (output, "online") if (*baseline, o) in outputs), None)
            if own is None or against is None:
                continue
            other, runs = outputs[*baseline, against], len(seeds[log, label] | seeds[*baseline])
            names = (log, label, output, _lookahead(own), *baseline, against, _lookahead(other))
            for score in scores:
                record: Record = dict.fromkeys(PAIRED) | dict(zip(PAIRED, (*names, score, runs), strict=False))
                found.append(record | _of_score(own, other, score))
    tested = [record for record in found if record["p_wilcoxon"] is not None]
    for record, p in zip(tested, holm([record["p_wilcoxon"] for record in tested]), strict=True):
        record["p_holm"] = p
    return found


def _of_score(own: Sequence[Record], other: Sequence[Record], score: str) -> Record:
    mine, theirs = ({row["seed"]: row for row in of} for of in (own, other))
    both = [
        (mine[seed], theirs[seed])
        for seed in mine
        if all(seed in of and of[seed]["status"] == "done" and has_score(of[seed], score) for of in (mine, theirs))
    ]
    if not both:
        return {"pairs": 0}
    v, b = (np.array([pair[k][score] for pair in both]) for k in (0, 1))
    weights = None
    if score in POOLED:
        n_v, n_b = (np.array([pair[k][POOLED[score]] for pair in both], float) for k in (0, 1))
        weights = n_v, n_b
    found = asdict(difference(v, b, OVER_SEEDS[score], weights))
    if all(mine[name] == theirs[name] for mine, theirs in both for name in SCORES):
        found |= {"p_wilcoxon": None, "p_t": None}
    return found


def _lookahead(rows: Sequence[Record]) -> float | None:
    return next((row["lookahead_s"] for row in rows if row["lookahead_s"] is not None), None)
