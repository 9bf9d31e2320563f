from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from time import perf_counter_ns

import numpy as np
import pytest
from fathom.bench.timing.driver import PARTS, Driver, Timed, quickest
from fathom.bench.timing.probes import PROBES
from fathom.bench.timing.profile import Profile, draw_profile, profile, profile_table
from fathom.bench.timing.scaling import Steps, by_lag, course, over_log
from fathom.datasets import Log, Scenario, simulate
from fathom.estimators import ESTIMATORS, create
from fathom.estimators.registry import EstimatorError
from rich.console import Console


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(mission="lawnmower", duration_s=40.0, imu="tactical"), seed=1)


def test_every_probe_names_what_is_there() -> None:
    names = [name for of_part in PROBES.values() for name in of_part]
    assert len(names) == len(set(names))
    for name in names:
        module, *attributes = name.split(".")
        owner = import_module(f"fathom.estimators.{module}")
        for attribute in attributes:
            owner = vars(owner)[attribute]


def test_every_nanosecond_belongs_to_one_part_and_of_two_to_the_greater() -> None:
    from fathom.bench.timing.stopwatch import BOARD, ENTER, LEAVE, Part, enter, leave, totals
    from numba import njit

    assert tuple(part.name.lower() for part in Part) == PARTS
    assert set(PROBES) < set(Part.__members__)

    @njit
    def work(inside: int) -> float:
        total = 0.0
        ENTER(inside)
        for k in range(300_000):
            total += np.sqrt(k)
        LEAVE()
        return total

    enter(int(Part.IDLE))
    work(int(Part.IDLE))
    leave()  # compiled
    begun, started = totals(), perf_counter_ns()
    enter(int(Part.REST))
    work(int(Part.SOLVE))
    solved = totals()
    enter(int(Part.OUTPUT))
    work(int(Part.SOLVE))  # is done for the output
    work(int(Part.MARGINAL))
    leave()
    leave()
    elapsed_ns = perf_counter_ns() - started
    spent = dict(zip(PARTS, (totals() - begun).tolist(), strict=True))
    assert BOARD[0] == 0
    assert spent["solve"] == (solved - begun)[Part.SOLVE] > 0
    assert min(spent["output"], spent["marginal"]) > 0
    assert spent["propagation"] == spent["linearisation"] == 0
    inside_ns = sum(ns for part, ns in spent.items() if part != "idle")
    assert 0.9 * elapsed_ns < inside_ns <= elapsed_ns


def timed(step_ns: list[int], first_part: list[int]) -> Timed:
    """A run of two parts, the second being what is left of each step."""
    parts = np.zeros((len(step_ns), len(PARTS)), np.int64)
    parts[:, 1], parts[:, 2] = first_part, np.subtract(step_ns, first_part)
    nothing = np.zeros((0, len(PARTS)), np.int64)
    t_ns, none = np.arange(len(step_ns)), np.zeros(0, np.int64)
    return Timed(t_ns, np.array(step_ns), none, sum(step_ns), 1, 1.0, {}, parts, nothing, parts[0], None)


def test_of_each_step_the_quickest_is_taken_with_its_own_parts() -> None:
    best = quickest([timed([10, 50, 30], [1, 2, 3]), timed([20, 40, 99], [4, 5, 6])])
    assert best.step_ns.tolist() == [10, 40, 30]
    assert best.step_parts[:, 1].tolist() == [1, 5, 3]
    assert best.parts_ns.sum() == best.whole_ns == 80
    assert best.finish_ns == 90


def test_a_run_in_a_process_of_its_own_says_what_it_says_here_and_which_steps_it_took(log: Log) -> None:
    from fathom.bench import run_log

    here = run_log(log, create("eskf"))
    with Driver(probed=False) as driver:
        assert driver.warm_up(create("eskf")) > 0
        there = driver.run(log, create("eskf"))
        assert len(there.step_ns) == len(there.t_ns) == len(here.step_ns)
        assert there.step_parts.shape == (len(here.step_ns), len(PARTS))
        assert there.online is not None
        assert here.online is not None
        np.testing.assert_array_equal(there.online.p_WB_W, here.online.p_WB_W)
        with pytest.raises(EstimatorError, match="diverged"):
            driver.run(log, create("fls", factorization="CHOLESKY"))
        driver.run(log, create("eskf"))  # is none the worse


def test_growth_is_told_from_flatness() -> None:
    rng = np.random.default_rng(3)
    t_s = np.arange(0.01, 1200.0, 0.01)
    noise = rng.gamma(2.0, 5_000.0, len(t_s))
    _, low, high = course(Steps(t_s, noise), 0.0).growth
    assert low < 0 < high
    assert high - low < 0.02
    value, low, high = course(Steps(t_s, noise * (1 + 0.5 * t_s / 600.0)), 0.0).growth
    assert 0 < low < value < high
    assert value == pytest.approx(0.5 / 1.5, rel=0.03)  # of the mean, which is that of the middle


def test_a_step_of_the_window_costs_the_same_late_in_a_log_as_early() -> None:
    long = simulate(Scenario(mission="lawnmower", duration_s=240.0, imu="tactical"), seed=1)
    found = over_log({"window": create("window", lag_s=3.0)}, long, repeats=3)
    cost = found["window"].ms_per_s
    assert np.median(cost[-6:]) < 1.5 * np.median(cost[6:12])


def test_the_window_costs_more_by_lag_and_a_filter_has_none(log: Log) -> None:
    found = by_lag({"eskf": create("eskf"), "window": create("window")}, log, (1.0, 20.0), repeats=3)
    assert list(found["eskf"]) == [None]
    assert found["window"][20.0] > 1.1 * found["window"][1.0]


@pytest.fixture(scope="module")
def profiles(log: Log) -> list[Profile]:
    return profile({name: create(name) for name in ESTIMATORS}, log, repeats=4)


@pytest.mark.slow
def test_the_parts_of_every_estimator_add_up_to_its_steps_and_beliefs(profiles: list[Profile]) -> None:
    assert [one.label for one in profiles] == list(ESTIMATORS)
    for one in profiles:
        assert sum(one.shares.values()) == pytest.approx(1.0)
        assert 0.85 < one.accounted <= 1.0, one.label
        assert one.shares["propagation"] > 0.001, one.label
        assert one.shares["solve"] > 0.001, one.label
        assert one.shares["output"] > 0, one.label
        if one.label != "dead-reckoning":
            assert one.shares["linearisation"] > 0.005, one.label
        assert (one.shares["marginal"] > 0) == (one.label in {"iekf", "fls", "fls-batch", "isam2", "batch", "window"})


@pytest.mark.slow
def test_probes_change_nothing_that_is_said(profiles: list[Profile], log: Log) -> None:
    with Driver(probed=False) as plain:
        for one in profiles:
            online = plain.run(log, create(one.label)).online
            assert online is not None
            assert one.timed.online is not None
            np.testing.assert_allclose(one.timed.online.p_WB_W, online.p_WB_W, atol=1e-9, rtol=0)


@pytest.mark.slow
def test_the_table_of_the_fleet_fits_a_page_and_every_estimator_has_a_bar(profiles: list[Profile]) -> None:
    console = Console(width=120, record=True)
    console.print(profile_table(profiles))
    text = console.export_text()
    assert "…" not in text
    for name in ESTIMATORS:
        assert name in text
    (axes,) = draw_profile(profiles, "").axes
    assert [label.get_text() for label in axes.get_yticklabels()] == list(ESTIMATORS)


@pytest.mark.parametrize(
    ("what", "absent"),
    [
        (
            "fathom.bench.cli.app",
            {"numba", "gtsam", "scipy", "pandas", "matplotlib", "pydantic", "numpy", "rich.table"},
        ),
        (
            "fathom.bench.experiment.packaged",
            {"numba", "gtsam", "scipy", "pandas", "matplotlib", "pydantic", "numpy", "yaml"},
        ),
        ("fathom.datasets", {"numba", "gtsam", "scipy.stats", "scipy.optimize", "pandas", "matplotlib", "pydantic"}),
        ("fathom.estimators", {"scipy.stats", "filterpy", "pandas", "pyarrow", "matplotlib"}),
        ("fathom.bench.execution.sweep", {"scipy.stats", "filterpy", "matplotlib"}),
    ],
)
def test_imports_wait_for_their_use(what: str, absent: set[str]) -> None:
    command = f"import sys, {what}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True).stdout.split()
    assert what in loaded
    assert not absent & set(loaded)
