"""The budgets of `fathom timing budgets`: what is far from its limit must hold on any machine, however busy."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from fathom.bench.timing import evo
from fathom.bench.timing.budget_rows import BUDGETS, array_bytes
from fathom.bench.timing.budgets import Budget, Measured, take_turns
from fathom.datasets import Scenario, simulate

NEAR = {
    "our Python factor over a native one, 3 × 12",  # 8 of 10
    "harness over eskf's steps, 10 min",  # by the clock, and 0.4 of 0.5
    "two workers over one, 100 runs",  # needs two idle cores
    "20,000 finished runs, the same command again",  # 11 to 14 of 15 s
    "20,000 finished runs, peak memory of it",  # 460 to 490 of 500 MB
    "check before an experiment over eskf's run, 10 min",  # 0.048 of 0.05
}


@pytest.mark.slow
@pytest.mark.parametrize("budget", [each for each in BUDGETS if each.name not in NEAR], ids=lambda each: each.name)
def test_what_is_far_from_its_limit_holds(budget: Budget) -> None:
    measured = budget.measure()
    print(f"{budget.name}: {measured.median:.3g} of {budget.limit:g}; {measured.note}")
    assert budget.holds(measured), measured


def test_budgets_that_are_left_out_here_exist() -> None:
    assert {each.name for each in BUDGETS} > NEAR


def busy(seconds: float) -> Callable[[], None]:
    def work() -> None:
        until = time.process_time() + seconds
        while time.process_time() < until:
            pass

    return work


def test_a_ratio_is_the_first_over_the_second() -> None:
    ratios = take_turns(busy(0.03), busy(0.01), 3)
    assert len(ratios) == 3
    assert np.median(ratios) == pytest.approx(3.0, rel=0.2)


def test_a_budget_is_the_least_or_the_most_that_is_allowed() -> None:
    least, most = (Budget("a", 2.0, at_least, lambda: Measured((1.0,))) for at_least in (True, False))
    for ratio in (1.9, 2.1):
        assert least.holds(Measured((ratio,))) == (ratio > 2)
        assert most.holds(Measured((ratio,))) == (ratio < 2)
    assert least.holds(Measured((0.1, 2.5, 2.6)))  # the median counts


def test_evo_finds_the_same_statistics() -> None:
    assert evo.compare(500, repeats=1).largest_difference < evo.TOLERANCE


def test_the_arrays_of_a_log_are_counted_whole() -> None:
    log = simulate(Scenario(duration_s=20.0), seed=1)
    imu = 2000 * (8 + 24 + 24)
    assert array_bytes(log.imu) == imu
    assert log.truth is not None
    assert array_bytes(log) > imu + array_bytes(log.truth) > imu + len(log.truth) * (8 + 72 + 24)
