"""How often the interval over seeds holds the true value: measured, by law of the scores and by number of seeds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fathom.bench.metrics.interval import FEWEST_SEEDS, GROUPS, MANY_SEEDS, interval
from scipy import stats

RUNS = 200
"""Experiments at each law and number of seeds: 95 % have a σ of 1.5 % then, so a bootstrap would be 7 σ off."""


def normal(rng: np.random.Generator, n: int) -> np.ndarray:
    return 1 + 0.2 * rng.standard_normal(n)


def chi(rng: np.random.Generator, n: int) -> np.ndarray:
    """RMSEs of a slow error: chi-square with two degrees of freedom."""
    return np.sqrt(rng.chisquare(2, n) / 2)


def lognormal(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.exp(0.5 * rng.standard_normal(n))


def skewed(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.exp(rng.standard_normal(n))


def mixed(rng: np.random.Generator, n: int) -> np.ndarray:
    """One run in ten goes three times worse."""
    return np.where(rng.random(n) < 0.1, 3.0, 1.0) * np.exp(0.2 * rng.standard_normal(n))


def rms(x: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.sqrt((x * x).mean(axis=axis))


TRUE = {
    (normal, "rms"): np.sqrt(1.04), (normal, "mean"): 1.0,
    (chi, "rms"): 1.0, (chi, "mean"): np.sqrt(np.pi) / 2,
    (lognormal, "rms"): np.exp(0.25), (lognormal, "mean"): np.exp(0.125),
    (skewed, "rms"): np.exp(1.0), (skewed, "mean"): np.exp(0.5),
    (mixed, "rms"): np.sqrt(1.8 * np.exp(0.08)), (mixed, "mean"): 1.2 * np.exp(0.02),
}  # fmt: skip
HELD = {
    (law, name): dict(zip((5, 10, 20, 50), held, strict=True))
    for (law, name), held in {
        (normal, "rms"): (0.957, 0.949, 0.955, 0.947), (normal, "mean"): (0.953, 0.951, 0.956, 0.949),
        (chi, "rms"): (0.931, 0.941, 0.935, 0.945), (chi, "mean"): (0.953, 0.956, 0.945, 0.949),
        (lognormal, "rms"): (0.911, 0.897, 0.912, 0.922), (lognormal, "mean"): (0.942, 0.936, 0.943, 0.946),
        (skewed, "rms"): (0.769, 0.747, 0.764, 0.798), (skewed, "mean"): (0.911, 0.897, 0.912, 0.922),
        (mixed, "rms"): (0.597, 0.672, 0.853, 0.921), (mixed, "mean"): (0.790, 0.757, 0.877, 0.926),
    }.items()
}  # fmt: skip
"""Measured with 3,000 experiments each; what `HOLDS` says in words."""


@pytest.mark.parametrize(("law", "name"), TRUE)
def test_it_holds_the_true_value_as_often_as_it_says(law: Callable[..., np.ndarray], name: str) -> None:
    for n, stated in HELD[law, name].items():
        rng, held = np.random.default_rng(n), 0
        for _ in range(RUNS):
            low, high = bounds(law(rng, n), {"rms": rms, "mean": np.mean}[name])
            held += low <= TRUE[law, name] <= high
        least, most = stats.binom.ppf((0.001, 0.999), RUNS, stated)
        assert least <= held <= most, (n, held / RUNS)


def bounds(x: np.ndarray, statistic: Callable[..., np.ndarray], **options: bool) -> tuple[float, float]:
    found = interval((x,), statistic, **({"positive": True} | options))  # type: ignore[arg-type]
    assert found is not None
    return found


def test_of_a_mean_it_is_that_of_student() -> None:
    x = np.random.default_rng(0).normal(3, 2, 7)
    exact = stats.t.interval(0.95, 6, x.mean(), stats.sem(x))
    assert bounds(x, np.mean, positive=False) == pytest.approx(exact, rel=1e-12)


def test_of_a_positive_quantity_it_is_as_wide_upwards_as_downwards_by_a_factor() -> None:
    low, high = bounds(x := np.array([0.2, 0.5, 1.0, 3.0, 9.0]), rms)
    assert low > 0
    assert low * high == pytest.approx(rms(x) ** 2)


def test_what_is_nought_without_one_seed_has_no_logarithm() -> None:
    low, high = bounds(np.array([0.0, 0.0, 0.0, 0.0, 1.0]), rms)
    assert low < 0 < high


def test_of_many_seeds_groups_are_left_out_and_it_is_the_normal_interval() -> None:
    x = np.random.default_rng(1).lognormal(0, 0.5, 20 * MANY_SEEDS)
    low, high = bounds(x, np.mean, positive=False)
    half = stats.norm.ppf(0.975) * stats.sem(x)
    assert (high - low) / 2 == pytest.approx(half, rel=4 / np.sqrt(2 * GROUPS))  # 4 σ of a deviation of 100 groups
    assert (low + high) / 2 == pytest.approx(x.mean())


def test_too_few_seeds_have_none() -> None:
    assert interval((np.arange(1.0, FEWEST_SEEDS),), np.mean) is None
