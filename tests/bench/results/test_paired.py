from __future__ import annotations

import io
import itertools
import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fathom.bench.metrics import ScoreError, pooled_rmse
from fathom.bench.metrics.comparison import Comparison
from fathom.bench.metrics.interval import FEWEST_SEEDS
from fathom.bench.output.tables.table import print_table
from fathom.bench.results.paired import (
    PAIRED,
    d_z,
    difference,
    holm,
    out_of_reach,
    paired,
    rank_biserial,
    signed_rank_p,
    t_p,
)
from fathom.bench.results.store import COLUMNS
from fathom.bench.results.summary import records, summarise
from rich.console import Console
from scipy import stats

SEEDS = range(20)
OWN = 0.4
"""A variant's own part of an error, to the seed's part of 1, on each axis."""


def scores(rng: np.random.Generator, n: int, effect: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of two variants' errors over n seeds: most of an error is the seed's; in the mean a factor apart."""
    of_seed = rng.normal(size=(n, 3))
    v, b = (np.linalg.norm(of_seed + rng.normal(0, OWN, (n, 3)), axis=1) for _ in range(2))
    return v * math.exp(effect), b


# -- the test ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", range(5, 11))
def test_p_is_the_share_of_all_swaps_that_tell_as_much(n: int) -> None:
    rng = np.random.default_rng(n)
    d = rng.normal(0.5, 1, n)
    ranks = 1 + np.argsort(np.argsort(np.abs(d)))
    swaps = np.array(list(itertools.product((-1, 1), repeat=n)))
    told = np.abs(swaps @ ranks) >= np.abs(np.sign(d) @ ranks)
    assert signed_rank_p(d) == pytest.approx(told.mean(), rel=1e-12)


def test_seeds_that_all_agree_have_the_least_p_there_is() -> None:
    for n in (5, 10, 20):
        assert signed_rank_p(np.arange(1.0, n + 1)) == pytest.approx(2.0 ** (1 - n), rel=1e-12)


@pytest.mark.parametrize("n", [8, 20])
def test_where_there_is_nothing_the_test_is_reported_as_often_as_its_level(n: int) -> None:
    rng = np.random.default_rng(n)
    rejected = sum(signed_rank_p(np.subtract(*scores(rng, n))) <= 0.05 for _ in range(600))
    sums = np.bincount([0])  # how many of the 2^n swaps have each sum of positive ranks, rank by rank
    for rank in range(1, n + 1):
        sums = np.pad(sums, (0, rank)) + np.pad(sums, (rank, 0))
    lower = np.cumsum(sums) / 2.0**n
    level = 2 * lower[2 * lower <= 0.05].max()
    assert 0.03 < level <= 0.05
    low, high = stats.binom.interval(0.999, 600, level)
    assert low <= rejected <= high


def test_power_grows_with_the_effect_and_with_the_seeds() -> None:
    rng = np.random.default_rng(3)

    def power(n: int, effect: float) -> float:
        return float(np.mean([signed_rank_p(np.subtract(*scores(rng, n, effect))) <= 0.05 for _ in range(150)]))

    weak, strong, more_seeds = power(10, 0.1), power(10, 0.3), power(40, 0.1)
    assert 0.05 < weak < strong - 0.2
    assert weak < more_seeds - 0.2


def test_one_seed_gone_wrong_hardly_changes_the_verdict_but_undoes_the_t_test() -> None:
    d = np.linspace(1, 2, 12)
    d[0] = -100.0
    assert signed_rank_p(d) < 0.07
    assert stats.ttest_1samp(d, 0.0).pvalue > 0.3


def test_t_is_the_effect_size_by_the_root_of_the_seeds() -> None:
    x = np.random.default_rng(0).normal(0.3, 1, 15)
    z = d_z(x)
    assert z is not None
    assert t_p(x) == pytest.approx(2 * stats.t.sf(abs(z) * math.sqrt(15), 14), rel=1e-12)
    assert d_z(np.array([1.0, 2.0, 3.0])) == 2.0


def test_the_rank_correlation_is_that_of_all_means_of_two_seeds() -> None:
    d = np.random.default_rng(1).normal(0.4, 1, 14)  # Tukey: W₊ counts the positive means of pairs, with themselves
    means = [d[i] + d[j] for i in range(14) for j in range(i, 14)]
    assert rank_biserial(d) == pytest.approx(np.mean(np.sign(means)), rel=1e-12)
    assert rank_biserial(np.array([1.0, 2.0, 3.0])) == 1.0
    assert rank_biserial(np.array([-1.0, -2.0, 3.0])) == 0.0


# -- the correction ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("m", range(1, 7))
def test_holm_is_the_closed_test_of_bonferroni(m: int) -> None:
    p = np.random.default_rng(m).beta(0.5, 3, m)
    subsets = [s for k in range(1, m + 1) for s in itertools.combinations(range(m), k)]
    closed = [max(min(1.0, len(s) * min(p[list(s)])) for s in subsets if i in s) for i in range(m)]
    assert holm(p.tolist()) == pytest.approx(closed, rel=1e-12)


def test_holm_of_none_is_none() -> None:
    assert holm([]) == []


@pytest.mark.slow
def test_of_many_comparisons_with_nothing_in_them_few_experiments_claim_any() -> None:
    rng, uncorrected, corrected = np.random.default_rng(5), 0, 0
    for _ in range(500):
        baseline = scores(rng, 16)[1]  # all variants against one baseline: the tests depend on one another
        p = [signed_rank_p(scores(rng, 16)[0] - baseline) for _ in range(6)]
        uncorrected += min(p) <= 0.05
        corrected += min(holm(p)) <= 0.05
    assert corrected <= stats.binom.ppf(0.999, 500, 0.05)
    assert uncorrected > 2 * stats.binom.ppf(0.999, 500, 0.05)


# -- the interval -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("over", "n"), [("rms", 20), ("mean", 12), ("median", 20)])
def test_the_intervals_hold_what_they_claim_to(over: Any, n: int) -> None:
    rng, held, ratio_held = np.random.default_rng(n), 0, 0
    effect, axis = 0.1, math.hypot(1, OWN)
    baseline = (
        axis * {"rms": math.sqrt(3), "mean": math.sqrt(8 / math.pi), "median": math.sqrt(stats.chi2.median(3))}[over]
    )
    difference_true = baseline * (math.exp(effect) - 1)
    for _ in range(400):
        found = difference(*scores(rng, n, effect), over=over)
        assert found.low is not None
        assert found.high is not None
        assert found.ratio_low is not None
        assert found.ratio_high is not None
        held += found.low <= difference_true <= found.high
        ratio_held += found.ratio_low <= math.exp(effect) <= found.ratio_high
    low, high = stats.binom.ppf(0.001, 400, 0.93), stats.binom.ppf(0.999, 400, 0.99 if over == "median" else 0.96)
    assert low <= held <= high
    assert low <= ratio_held <= high


def test_it_is_the_pairs_that_make_the_interval_narrow() -> None:
    v, b = scores(np.random.default_rng(2), 20, 0.1)
    together, apart = difference(v, b), difference(v, np.roll(b, 1))
    assert together.difference == pytest.approx(apart.difference)
    assert together.high - together.low < 0.7 * (apart.high - apart.low)  # type: ignore[operator]


def test_units_do_not_matter() -> None:
    v, b = scores(np.random.default_rng(4), 20, 0.1)
    m, mm = difference(v, b, "rms"), difference(1000 * v, 1000 * b, "rms")
    for name in ("value", "baseline", "difference", "low", "high", "mean_difference", "median_difference"):
        assert getattr(mm, name) == pytest.approx(1000 * getattr(m, name))
    for name in ("ratio", "ratio_low", "ratio_high", "p_wilcoxon", "p_t", "rank_biserial", "d_z"):
        assert getattr(mm, name) == pytest.approx(getattr(m, name))
    assert difference(v, b, "rms") == m  # and chance is always the same


def test_exchanging_variant_and_baseline_changes_signs_alone() -> None:
    v, b = scores(np.random.default_rng(6), 20, 0.1)
    there, back = difference(v, b), difference(b, v)
    assert back.difference == pytest.approx(-there.difference)
    assert back.low == pytest.approx(-there.high, rel=1e-12)  # type: ignore[operator]
    assert (back.p_wilcoxon, back.rank_biserial) == (there.p_wilcoxon, pytest.approx(-there.rank_biserial))  # type: ignore[operator]


def test_nothing_is_nothing_and_a_constant_is_certain() -> None:
    b = scores(np.random.default_rng(8), 10)[1]
    same = difference(b, b, "rms")
    assert (same.difference, same.low, same.high, same.ratio_low, same.ratio_high) == (0, 0, 0, 1, 1)
    assert (same.p_wilcoxon, same.p_t, same.rank_biserial, same.d_z) == (1, 1, 0, 0)
    more = difference(b + 1, b)
    assert (more.low, more.high) == (pytest.approx(1), pytest.approx(1))
    assert (more.p_wilcoxon, more.rank_biserial, more.d_z) == (pytest.approx(2.0**-9), 1, None)
    twice = difference(2 * b, b, "rms")
    assert (twice.ratio_low, twice.ratio_high, twice.p_t) == (pytest.approx(2), pytest.approx(2), None)


def test_one_seed_that_differs_leaves_an_interval() -> None:
    b = np.arange(1.0, 9.0)
    v = b.copy()
    v[3] += 1
    found = difference(v, b)
    assert found.low is not None
    assert found.high is not None
    assert found.low < 0 < 0.125 < found.high
    assert found.p_wilcoxon == 1  # one seed of eight tells nothing


def test_scores_that_may_be_nought_have_no_ratio() -> None:
    found = difference(np.array([0.0, 1, 2, 3, 4, 5]), np.ones(6))
    assert (found.ratio, found.ratio_low, found.p_t) == (None, None, None)
    assert found.p_wilcoxon is not None


@pytest.mark.parametrize("n", range(1, FEWEST_SEEDS))
def test_few_seeds_have_a_difference_and_no_more(n: int) -> None:
    v, b = scores(np.random.default_rng(n), n, 0.5)
    found = difference(v, b)
    assert found.difference == pytest.approx(v.mean() - b.mean())
    assert {found.low, found.high, found.ratio_low, found.p_wilcoxon, found.rank_biserial, found.d_z} == {None}


@pytest.mark.parametrize(("v", "b"), [([], []), ([1.0], [1.0, 2.0]), ([1.0, math.nan], [1.0, 1.0])])
def test_what_is_no_pairs_is_refused(v: list[float], b: list[float]) -> None:
    with pytest.raises(ScoreError, match="finite scores in pairs"):
        difference(np.array(v), np.array(b))


# -- of a table of runs -----------------------------------------------------------------------------------------------


def run(log: str, label: str, seed: int | None, ate_m: float | None, **more: Any) -> dict[str, Any]:
    row = {"log": log, "label": label, "seed": seed, "output": "online", "status": "done", "lookahead_s": 0.0}
    return row | {"ate_rmse_m": ate_m, "n_scored": 100, "spec": "{}", "counts": "{}"} | more


def table(*rows: dict[str, Any]) -> pd.DataFrame:
    return pd.DataFrame(list(rows)).reindex(columns=list(COLUMNS)).astype({"seed": "Int64", "ate_rmse_m": float})


def test_values_are_those_of_the_tables_pooled_before_the_root() -> None:
    rng = np.random.default_rng(0)
    errors = {label: rng.uniform(1, 5, 6) for label in ("a", "b")}
    counts = rng.integers(10, 1000, 6)
    rows = table(
        *(run("l", x, s, errors[x][s], n_scored=int(counts[s])) for s in range(6) for x in ("a", "b")),
    )
    (record,) = paired(rows, [Comparison("l", "b", "l", "a")], ["ate_rmse_m"])
    by_label = {row["label"]: row["ate_rmse_m"] for row in summarise(rows)}
    assert record["baseline"] == pytest.approx(by_label["a"]) == pytest.approx(pooled_rmse(errors["a"], counts))
    assert record["difference"] == pytest.approx(by_label["b"] - by_label["a"])
    assert record["mean_difference"] == pytest.approx(np.mean(errors["b"] - errors["a"]))
    assert set(record) == set(PAIRED)


def test_a_seed_that_either_did_not_end_is_left_out_and_counted() -> None:
    good = [run("l", x, s, s + 1.0 + (x == "b")) for s in range(8) for x in "ab" if (x, s) not in {("a", 2), ("b", 5)}]
    lost = [run("l", "a", 2, 99.0, status="diverged"), run("l", "b", 5, None, status="failed")]
    (record,) = paired(table(*good, *lost), [Comparison("l", "b", "l", "a")], ["ate_rmse_m"])
    assert (record["pairs"], record["runs"]) == (6, 8)
    assert record["mean_difference"] == pytest.approx(1.0)


def test_an_output_is_compared_with_its_like_or_with_the_online_output() -> None:
    rows = []
    for s in range(6):
        for label, outputs in (
            ("filter", ("online",)),
            ("f1", ("online", "smoothed")),
            ("f2", ("online", "smoothed")),
        ):
            for output in outputs:
                seen = 0.0 if output == "online" else 3.0
                rows.append(run("l", label, s, 1.0 + len(label) + len(output), output=output, lookahead_s=seen))
    pairs = [
        Comparison("l", "f2", "l", "f1"),
        Comparison("l", "f2", "l", "filter"),
        Comparison("l", "filter", "l", "f1"),
    ]
    found = paired(table(*rows), pairs, ["ate_rmse_m"])
    keys = ("label", "output", "baseline_label", "baseline_output", "baseline_lookahead_s")
    assert [tuple(row[key] for key in keys) for row in found] == [
        ("f2", "online", "f1", "online", 0),
        ("f2", "smoothed", "f1", "smoothed", 3),
        ("f2", "online", "filter", "online", 0),
        ("f2", "smoothed", "filter", "online", 0),
        ("filter", "online", "f1", "online", 0),
    ]


def test_logs_are_paired_by_seed_in_any_order_of_rows() -> None:
    rows = [run("calm", "e", s, s + 1.0) for s in range(7)] + [
        run("rough", "e", s, s + 3.0) for s in reversed(range(7))
    ]
    (record,) = paired(table(*rows), [Comparison("rough", "e", "calm", "e")], ["ate_rmse_m"])
    assert (record["median_difference"], record["d_z"], record["rank_biserial"]) == (2.0, None, 1.0)


def test_a_recorded_log_has_a_difference_without_interval_or_test() -> None:
    rows = table(run("dive", "a", None, 2.0), run("dive", "b", None, 3.0))
    (record,) = paired(rows, [Comparison("dive", "b", "dive", "a")], ["ate_rmse_m", "heading_rmse_deg"][:1])
    assert (record["pairs"], record["difference"], record["ratio"]) == (1, 1.0, 1.5)
    assert {record[name] for name in ("low", "high", "p_wilcoxon", "p_holm", "d_z")} == {None}


def test_what_was_not_run_or_has_no_score_is_not_invented() -> None:
    rows = table(*(run("l", x, s, 1.0) for s in range(6) for x in "ab"))
    assert paired(rows, [Comparison("l", "b", "l", "c"), Comparison("l", "c", "l", "a")], ["ate_rmse_m"]) == []
    (record,) = paired(rows, [Comparison("l", "b", "l", "a")], ["heading_rmse_deg"])
    assert (record["pairs"], record["difference"], record["p_holm"]) == (0, None, None)


def test_every_test_of_the_list_counts_in_the_correction() -> None:
    rng = np.random.default_rng(11)
    rows = table(*(run("l", x, s, rng.uniform(1, 2) + 0.3 * ord(x) % 7) for s in range(10) for x in "abcd"))
    found = paired(rows, [Comparison("l", x, "l", "a") for x in "bcd"], ["ate_rmse_m"])
    assert [row["p_holm"] for row in found] == holm([row["p_wilcoxon"] for row in found])
    assert all(row["p_holm"] > row["p_wilcoxon"] for row in sorted(found, key=lambda row: row["p_wilcoxon"])[:2])


def printed(rows: pd.DataFrame, pairs: list[Comparison]) -> str:
    console = Console(file=io.StringIO(), width=120)
    print_table(rows, console, paired(rows, pairs, ["ate_rmse_m"]))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_printed_table_holds_the_differences() -> None:
    rng = np.random.default_rng(12)
    rows = table(*(run("l", x, s, rng.uniform(1, 1.1) * (3.0 if x == "worse" else 1.0))
                   for s in SEEDS for x in ("base", "worse")))  # fmt: skip
    (record,) = paired(rows, [Comparison("l", "worse", "l", "base")], ["ate_rmse_m"])
    text = printed(rows, [Comparison("l", "worse", "l", "base")])
    section = text[text.index("l: against base") :]
    for words in (
        f"{record['baseline']:.2f}",
        f"+{record['difference']:.2f}",
        f"[+{record['low']:.2f}",
        "< 0.0001",
        "+1.00",
    ):
        assert words in section
    assert f"{100 * (record['ratio'] - 1):+.0f}" in section
    assert "corrected by Holm for 1 tests" in " ".join(section.split())
    assert "against" not in printed(rows, []).replace("no ground truth to score against", "")


def test_the_printed_table_says_when_seeds_are_too_few_for_so_many_tests() -> None:
    pairs = [Comparison("l", x, "l", "a") for x in "bcd"]
    few = table(*(run("l", x, s, 1.0 + s + ord(x)) for s in range(6) for x in "abcd"))
    assert "no p under 0.094" in printed(few, pairs)
    assert "neither intervals nor tests" in printed(table(*(run("l", x, None, 1.0) for x in "ab")), pairs[:1])
    assert len(records(few)) == 24


def test_two_names_of_one_run_are_no_test_and_do_not_weaken_the_others() -> None:
    rng = np.random.default_rng(13)
    ate = {(x, s): rng.uniform(1, 2) + 3 * (x == "c") for s in range(8) for x in "ac"}
    ate |= {("b", s): ate["a", s] for s in range(8)}
    rows = table(*(run("l", x, s, ate[x, s]) for x, s in ate))
    pairs = [Comparison("l", x, "l", "a") for x in "bc"]
    same, other = paired(rows, pairs, ["ate_rmse_m"])
    assert (same["difference"], same["p_wilcoxon"], same["p_holm"], same["rank_biserial"]) == (0, None, None, 0)
    assert other["p_holm"] == other["p_wilcoxon"] == 2.0**-7
    assert "both are one configuration" in printed(rows, pairs)
    rows.loc[(rows["label"] == "b") & (rows["seed"] == 3), "rpe_rmse_m"] = 1.0
    same, other = paired(rows, pairs, ["ate_rmse_m"])  # another run, that happens to be as good
    assert (same["p_holm"], other["p_holm"]) == (1, 2.0**-6)


@pytest.mark.parametrize(("seeds", "tests"), [(5, 1), (6, 1), (6, 2), (10, 25), (10, 26), (20, 12)])
def test_what_no_effect_could_make_significant_is_said_beforehand(seeds: int, tests: int) -> None:
    least = holm([signed_rank_p(np.arange(1.0, seeds + 1))] * tests)[0]
    told = out_of_reach(seeds, tests)
    assert (told is None) == (least <= 0.05)
    assert told is None or f"no p under {least:.2g}" in told
    assert out_of_reach(FEWEST_SEEDS - 1, tests) is not None
    assert out_of_reach(seeds, 0) is None
