"""The verdicts are right where the answer is known: on chi-square numbers, and on filters told right or wrong noise."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.execution.result import innovation_dof, innovation_scores
from fathom.bench.metrics import BLOCKS, DOF, associate, consistency, nees
from fathom.bench.metrics.consistency import (
    FALSE_ALARM,
    anees,
    anees_of,
    autocorrelation,
    interval,
    nees_at,
    pooled_nis,
    pooled_whiteness,
)
from fathom.bench.metrics.scoring import ELLIPSOIDS
from fathom.bench.metrics.state_error import share_inside
from fathom.datasets import Log
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import create
from scipy.stats import binom, chi2, norm

TIMES = np.arange(10.0)


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(duration_s=30.0), seed=3)


@pytest.mark.parametrize("probability", [0.5, 0.95, 1 - 1e-3, 1 - 1e-4])
def test_the_interval_is_that_of_chi_square_over_its_degrees_of_freedom(probability: float) -> None:
    dof = np.array([1, 3, 15, 300, 36_000])
    expected = np.array(chi2.interval(probability, dof)) / dof
    assert np.array(interval(dof, probability)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("dof", [3, 15])
def test_consistent_numbers_raise_the_expected_share_of_false_alarms(dof: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(consistency, "FALSE_ALARM", 0.1)
    rng, tables = np.random.default_rng(dof), 4000
    averages = [anees(rng.chisquare(dof, (20, 10)), dof, TIMES) for _ in range(tables)]
    above, below = (np.array([getattr(a, side) for a in averages]) for side in ("above", "below"))
    for side in (above, below):  # 0.05 / 10 of all times on either
        low, high = binom.interval(0.999, side.size, 0.005)
        assert low <= side.sum() <= high
    low, high = binom.interval(0.999, tables, 1 - 0.99**10)
    assert low <= (above | below).any(axis=1).sum() <= high


def test_errors_correlated_in_time_raise_no_more() -> None:
    """One draw per seed, the same at all times: the average over time of all would be far too sure of itself."""
    rng, tables = np.random.default_rng(1), 4000
    averages = [anees(np.repeat(rng.chisquare(3, (20, 1)), 10, axis=1), 3, TIMES) for _ in range(tables)]
    alarms = sum((a.above | a.below).any() for a in averages)
    assert alarms <= binom.ppf(0.999, tables, FALSE_ALARM / 10)
    low, high = interval(np.array([20 * 10 * 3]), 1 - FALSE_ALARM)  # pooled over time, as one must not
    assert sum(not low[0] < a.value.mean() < high[0] for a in averages) > 0.1 * tables


@pytest.mark.parametrize(("scale", "above", "below"), [(4.0, 10, 0), (1.0, 0, 0), (0.25, 0, 10)])
def test_a_covariance_half_or_twice_the_size_of_the_error_is_flagged(scale: float, above: int, below: int) -> None:
    average = anees(scale * np.random.default_rng(2).chisquare(15, (20, 10)), 15, TIMES)
    assert (average.above.sum(), average.below.sum()) == (above, below)
    assert average.value == pytest.approx(scale, rel=0.3)


def test_a_seed_that_lacks_a_time_is_left_out_there_and_a_time_that_all_lack_is_none() -> None:
    values = np.array([[3.0, np.nan, 6.0], [9.0, np.nan, np.nan]])
    average = anees(values, 3, np.arange(3.0))
    assert average.t_s.tolist() == [0.0, 2.0]
    assert average.runs.tolist() == [2, 1]
    assert average.value.tolist() == [2.0, 2.0]
    low, high = chi2.interval(1 - FALSE_ALARM / 2, np.array([6, 3])) / np.array([6, 3])
    assert (average.low, average.high) == (pytest.approx(low), pytest.approx(high))


# -- the times --------------------------------------------------------------------------------------------------------


def test_nees_stands_at_the_middles_of_equal_parts_of_the_log_and_is_the_same_again(log: Log) -> None:
    online = run_log(log, create("eskf")).online
    found = nees_at(log, online, 10)
    assert found["t_s"] == pytest.approx([1, 4, 7, 10, 13, 16, 19, 22, 25, 28])  # the first of two equally near
    truth, estimate = associate(log.truth, online)
    for block in BLOCKS:
        assert found[block] == pytest.approx(nees(truth, estimate, block)[[0, 3, 6, 9, 12, 15, 18, 21, 24, 27]])
    assert json.dumps(nees_at(log, run_log(log, create("eskf")).online, 10)) == json.dumps(found)


def test_smoothed_states_with_few_covariances_are_scored_at_those_times_once_each(log: Log) -> None:
    smoothed = run_log(log, create("fls", smoothed_covariance_s=7.0)).smoothed
    kept_s = (smoothed.t_ns[np.isfinite(smoothed.P[:, 0, 0])] - log.start_ns) * 1e-9
    found = nees_at(log, smoothed, 10)
    assert [t for t in found["t_s"] if t is not None] == pytest.approx(kept_s)
    assert len(kept_s) == 5
    assert [x is None for x in found["all"]] == [t is None for t in found["t_s"]]


def test_what_cannot_be_known_is_absent_and_what_ended_early_has_no_later_times(log: Log) -> None:
    online = run_log(log, create("eskf")).online
    assert nees_at(log, replace(online, P=None), 10) == {}
    assert nees_at(log, replace(online, t_ns=online.t_ns + 1), 10) == {}
    blind = nees_at(replace(log, truth=replace(log.truth, b_a=None, b_g=None)), online, 10)
    assert set(blind) == {"t_s", "position", "attitude", "velocity"}
    half = nees_at(log, online.select(slice(0, 15)), 10)
    assert [x is None for x in half["position"]] == [False] * 5 + [True] * 5


def test_runs_are_averaged_as_the_store_has_them() -> None:
    times = {"t_s": [5.0, None, 25.0]}
    runs = [
        json.dumps({"t_s": [1.0], "position": [99.0]}),  # an earlier run, with other times
        json.dumps({}),
        None,
        json.dumps(times | {"position": [3.0, None, 9.0], "all": [15.0, None, 30.0]}),
        json.dumps(times | {"position": [9.0, None, 3.0]}),
    ]
    found = anees_of(runs)
    assert set(found) == {"position", "all"}
    assert found["position"].t_s.tolist() == [5.0, 25.0]
    assert found["position"].value.tolist() == [2.0, 2.0]
    assert found["all"].value.tolist() == [1.0, 2.0]
    assert found["all"].dof.tolist() == [DOF["all"]] * 2
    assert anees_of([None, "{}"]) == {}


def test_nis_is_pooled_by_degrees_of_freedom() -> None:
    runs = [
        {"nis_dof": '{"dvl": 300}', "nis_dvl": 1.0},
        {"nis_dof": '{"dvl": 100, "gps": 30}', "nis_dvl": 3.0, "nis_gps": 2.0},
        {"nis_dof": None},
    ]
    found = pooled_nis(runs)
    assert {sensor: float(nis.value[0]) for sensor, nis in found.items()} == {"dvl": 1.5, "gps": 2.0}
    assert found["dvl"].high[0] == pytest.approx(chi2.ppf(1 - FALSE_ALARM / 2, 400) / 400)
    assert found["dvl"].above.all()


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_ellipsoids_hold_the_share_of_draws_that_they_claim(scale: float) -> None:
    """Of correlated errors; where the covariance is a quarter of what it should be, by the law of the larger errors."""
    rng, n = np.random.default_rng(8), 5000
    root = rng.normal(size=(3, 3)) * [0.1, 1, 10]
    e = np.sqrt(scale) * rng.normal(size=(n, 3)) @ root.T
    squares = np.append(np.einsum("ni,ij,nj->n", e, np.linalg.inv(root @ root.T), e), np.nan)
    for percent in ELLIPSOIDS:
        due = chi2.cdf(chi2.ppf(percent / 100, 3) / scale, 3)
        low, high = binom.interval(0.999, n, due)
        assert low <= n * share_inside(squares, 3, percent / 100) <= high


def test_the_whiteness_of_a_known_process_is_its_coefficient() -> None:
    rng, n = np.random.default_rng(6), 4000
    for coefficient in (-0.5, 0.0, 0.3, 0.9):
        x = np.zeros((n, 2))
        for k in range(1, n):
            x[k] = coefficient * x[k - 1] + rng.normal(size=2)
        sigma = np.sqrt((1 - coefficient**2) / (2 * n))
        assert autocorrelation(x) == pytest.approx(coefficient, abs=4 * sigma)
        assert autocorrelation(7 * x) == pytest.approx(autocorrelation(x))
    assert autocorrelation(np.ones((1, 3))) is None
    assert autocorrelation(np.zeros((5, 3))) is None


def test_white_innovations_are_called_coloured_as_seldom_as_stated() -> None:
    rng, outside = np.random.default_rng(7), 0
    for _ in range(2000):
        runs = [{"nis_dof": '{"dvl": 300}', "whiteness_dvl": autocorrelation(rng.normal(size=(100, 3)))}]
        runs += [{"nis_dof": '{"dvl": 150}', "whiteness_dvl": autocorrelation(rng.normal(size=(50, 3)))}]
        average = pooled_whiteness(runs)["dvl"]
        assert average.dof.tolist() == [450]
        outside += int(average.above[0] or average.below[0])
    assert outside <= binom.ppf(0.999, 2000, FALSE_ALARM)
    assert average.high[0] == -average.low[0] == pytest.approx(norm.ppf(1 - FALSE_ALARM / 2) / np.sqrt(450))


# -- filters told right and wrong noise -------------------------------------------------------------------------------


Averages = dict[str, consistency.Average]


def voyages(name: str, **options: object) -> tuple[Averages, Averages, Averages]:
    """NIS, ANEES and whiteness of 20 seeds of a minute."""
    runs, at = [], []
    for seed in range(20):
        log = simulate(Scenario(duration_s=60.0, surface_for_s=60.0), seed)
        result = run_log(log, create(name, **options), nis=True)
        runs.append(innovation_scores(result) | {"nis_dof": json.dumps(innovation_dof(result))})
        at.append(json.dumps(nees_at(log, result.online, 10)))
    return pooled_nis(runs), anees_of(at), pooled_whiteness(runs)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["eskf", "iekf", "fls"])
def test_an_estimator_with_the_right_noise_is_consistent(name: str) -> None:
    nis, nees, white = voyages(name)
    assert set(nis) == {"dvl", "depth", "gps", "heading"}
    assert nis["dvl"].dof[0] == 20 * 60 * 5 * 3
    for sensor, average in (*nis.items(), *white.items()):
        assert not (average.above | average.below).any(), (sensor, average)
    for block, average in nees.items():
        assert average.runs.tolist() == [20] * 10
        assert not (average.above | average.below).any(), (block, average)


@pytest.mark.slow
def test_who_takes_the_dvl_for_three_times_better_than_it_is_gives_itself_away() -> None:
    nis, nees, white = voyages("eskf", inflate={"dvl": 0.3})
    assert white["dvl"].below[0]  # each correction goes too far, and the next innovation back
    assert nis["dvl"].value[0] > 3
    assert nis["depth"].value[0] == pytest.approx(1, abs=0.1)
    assert nees["velocity"].above.sum() >= 8
    modest, _, late = voyages("eskf", inflate={"dvl": 3.0})
    assert modest["dvl"].value[0] < 0.5
    assert late["dvl"].above[0]
