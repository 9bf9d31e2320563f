"""Every estimator's time is split the same way, the parts add up, and timing changes nothing."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from fathom.bench.output.tables.table import print_sheet
from fathom.bench.timing.passes import PARTS, Timed, WatchedPass, parts_of, quickest, stopwatch, timed_run
from fathom.bench.timing.profile import Profile, draw_profile, profile, profile_sheet
from fathom.bench.timing.scaling import Steps, by_lag, course, over_log
from fathom.datasets import Log, Scenario, simulate
from fathom.estimators import ESTIMATORS, create
from fathom.estimators.physics.kalman import correct, propagate
from fathom.estimators.registry import EstimatorError
from fathom.estimators.stages import clock, stage
from rich.console import Console


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(mission="lawnmower", duration_s=40.0, imu="tactical"), seed=1)


@stage("linearisation")
def residual() -> None:
    time.sleep(0.003)


@stage("solve")
def solve() -> None:
    time.sleep(0.005)
    residual()


class Sleeping:
    """A pass that solves in every step, and rests as well."""

    counts: ClassVar[dict[str, int]] = {}

    def step(self, epoch: object) -> None:
        time.sleep(0.002)
        solve()

    def belief(self) -> str:
        time.sleep(0.004)
        return "belief"

    def finish(self) -> None:
        return None


def test_every_nanosecond_of_a_step_belongs_to_one_part_and_what_is_marked_inside_another_to_itself() -> None:
    steps, beliefs = [], []
    one = WatchedPass(Sleeping(), steps, beliefs)  # type: ignore[arg-type]
    clock.start()
    try:
        started = time.perf_counter_ns()
        one.step(None)  # type: ignore[arg-type]
        elapsed_ns = time.perf_counter_ns() - started
        assert one.belief() == "belief"
    finally:
        clock.stop()
    rows = parts_of(steps, "rest"), parts_of(beliefs, "output")
    step, belief = (dict(zip(PARTS, parts[0].tolist(), strict=True)) for parts in rows)
    assert 0.9 * elapsed_ns < sum(step.values()) <= elapsed_ns
    assert step["linearisation"] >= 3e6
    assert step["solve"] >= 5e6
    assert step["rest"] >= 2e6
    assert step["propagation"] == step["marginal"] == step["output"] == 0
    assert belief["output"] == sum(belief.values()) >= 4e6


def test_a_pass_of_another_package_that_marks_nothing_is_all_rest(log: Log) -> None:
    @dataclass(frozen=True)
    class Theirs:
        factors: frozenset[str] = frozenset()

        def begin(self, prior: object, rig: object) -> Still:
            return Still(prior)

    timed = timed_run(log, Theirs(), stages=True)  # type: ignore[arg-type]
    assert isinstance(timed, Timed)
    assert timed.step_parts[:, :-1].sum() == 0
    assert timed.step_parts.shape == (len(timed.step_ns), len(PARTS))
    assert not clock.running


class Still:
    """Says that the vehicle stays where it is."""

    counts: ClassVar[dict[str, int]] = {}

    def __init__(self, prior: object) -> None:
        self.said = prior

    def step(self, epoch: object) -> None:
        self.t_ns = epoch.t_ns  # type: ignore[attr-defined]

    def belief(self) -> object:
        from dataclasses import replace

        return replace(self.said, t_ns=self.t_ns)  # type: ignore[type-var]

    def finish(self) -> None:
        return None


def timed(step_ns: list[int], first_part: list[int]) -> Timed:
    """A run of two parts, the second being the remainder of each step."""
    parts = np.zeros((len(step_ns), len(PARTS)), np.int64)
    parts[:, 1], parts[:, 2] = first_part, np.subtract(step_ns, first_part)
    nothing = np.zeros((0, len(PARTS)), np.int64)
    t_ns, none = np.arange(len(step_ns)), np.zeros(0, np.int64)
    return Timed(t_ns, np.array(step_ns), none, sum(step_ns), 1, {}, parts, nothing, None)


def test_timing_the_stages_of_ours_compiles_nothing_more(log: Log) -> None:
    def compiled() -> int:
        return sum(len(function.signatures) for function in (propagate, correct))

    timed_run(log, create("eskf"), stages=False)
    before = compiled()
    assert before >= 2
    timed_run(log, create("eskf"), stages=True)
    assert compiled() == before


def test_of_each_step_the_quickest_is_taken_with_its_own_parts() -> None:
    best = quickest([timed([10, 50, 30], [1, 2, 3]), timed([20, 40, 99], [4, 5, 6])])
    assert best.step_ns.tolist() == [10, 40, 30]
    assert best.step_parts[:, 1].tolist() == [1, 5, 3]
    assert best.parts_ns.sum() == best.whole_ns == 80
    assert best.finish_ns == 90


def test_the_table_has_every_number_in_80_columns() -> None:
    console = Console(width=80, record=True)
    one = Profile("window, lag 30 s", timed([1_234_567_000, 50_000], [1000, 2000]), 1_234_000_000)
    print_sheet(profile_sheet([one], "survey"), console)
    text = console.export_text()
    assert "…" not in text
    assert all(word in text for word in ("617,000", *PARTS, "IMU sample", "keyframe", "finish", "timing adds"))
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.slow
def test_a_run_in_a_process_of_its_own_gives_the_same_result_as_here_and_which_steps_it_took(log: Log) -> None:
    from fathom.bench import run_log

    here = run_log(log, create("eskf"))
    with stopwatch() as process:
        process.warm_up(create("eskf"))
        there = process.run(log, create("eskf"))
        assert len(there.step_ns) == len(there.t_ns) == len(here.step_ns)
        assert there.step_parts.shape == (len(here.step_ns), len(PARTS))
        assert there.online is not None
        assert here.online is not None
        np.testing.assert_array_equal(there.online.p_WB_W, here.online.p_WB_W)
        with pytest.raises(EstimatorError, match="diverged"):
            process.run(log, create("fls", factorization="CHOLESKY"))
        process.run(log, create("eskf"))  # still works


def test_growth_is_distinguished_from_flatness() -> None:
    rng = np.random.default_rng(3)
    t_s = np.arange(0.01, 1200.0, 0.01)
    noise = rng.gamma(2.0, 5_000.0, len(t_s))
    _, low, high = course(Steps(t_s, noise), 0.0).growth
    assert low < 0 < high
    assert high - low < 0.02
    value, low, high = course(Steps(t_s, noise * (1 + 0.5 * t_s / 600.0)), 0.0).growth
    assert 0 < low < value < high
    assert value == pytest.approx(0.5 / 1.5, rel=0.03)  # of the mean, which is that of the middle


@pytest.mark.slow
def test_a_step_of_the_window_costs_the_same_late_in_a_log_as_early() -> None:
    long = simulate(Scenario(mission="lawnmower", duration_s=240.0, imu="tactical"), seed=1)
    found = over_log({"window": create("window", lag_s=3.0)}, long, repeats=3)
    cost = found["window"].ms_per_s
    assert np.median(cost[-6:]) < 1.5 * np.median(cost[6:12])


@pytest.mark.slow
def test_the_window_costs_more_by_lag_and_a_filter_has_none(log: Log) -> None:
    found = by_lag({"eskf": create("eskf"), "window": create("window")}, log, (1.0, 20.0), repeats=3)
    assert list(found["eskf"]) == [None]
    assert found["window"][20.0] > 1.1 * found["window"][1.0]


@pytest.fixture(scope="module")
def profiles(log: Log) -> list[Profile]:
    return profile({name: create(name) for name in ESTIMATORS}, log, repeats=2)


@pytest.mark.slow
def test_the_parts_of_every_estimator_add_up_to_its_steps_and_beliefs(profiles: list[Profile]) -> None:
    assert [one.label for one in profiles] == list(ESTIMATORS)
    for one in profiles:
        assert sum(one.shares.values()) == pytest.approx(1.0)
        assert 0.85 < one.accounted <= 1.0, one.label
        assert one.shares["propagation"] > 0.001, one.label
        assert one.shares["solve"] > 0.001, one.label
        assert one.shares["output"] > 0, one.label
        is_smoother = one.label in {"fls", "fls-batch", "isam2", "batch", "window"}
        assert (one.shares["linearisation"] > 0.005) == is_smoother, one.label  # a filter's is within its update
        assert (one.shares["marginal"] > 0) == (one.label != "dead-reckoning"), one.label


@pytest.mark.slow
def test_timing_the_stages_changes_no_estimate(profiles: list[Profile], log: Log) -> None:
    with stopwatch() as process:
        for one in profiles:
            online = process.run(log, create(one.label)).online
            assert online is not None
            assert one.timed.online is not None
            np.testing.assert_array_equal(one.timed.online.p_WB_W, online.p_WB_W)


@pytest.mark.slow
def test_the_table_of_the_fleet_fits_a_page_and_every_estimator_has_a_bar(profiles: list[Profile]) -> None:
    console = Console(width=120, record=True)
    print_sheet(profile_sheet(profiles, ""), console)
    text = console.export_text()
    assert "…" not in text
    for name in ESTIMATORS:
        assert name in text
    (axes,) = draw_profile(profiles, "").axes
    assert [label.get_text() for label in axes.get_yticklabels()] == list(ESTIMATORS)


@pytest.mark.slow
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
