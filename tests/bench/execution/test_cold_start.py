from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fathom.bench.execution import cold_start
from fathom.bench.execution.cold_start import NOTICE, code_of, compile_first, remember, warm
from fathom.bench.timing import driver
from fathom.estimators import create


class FakeDriver:
    """Counts what it is asked to warm up, and compiles one function for each."""

    asked: list[object]

    def __init__(self, probed: bool) -> None:
        assert not probed

    def __enter__(self) -> FakeDriver:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def warm_up(self, estimator: object, compiling: object) -> None:
        FakeDriver.asked.append(estimator)
        assert callable(compiling)
        compiling("integrate")


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    monkeypatch.setattr(cold_start, "_stamp", lambda: tmp_path / "warm.txt")
    monkeypatch.setattr(driver, "Driver", FakeDriver)
    FakeDriver.asked = []
    return FakeDriver.asked


def test_what_differs_in_numbers_runs_on_the_same_code() -> None:
    assert code_of(create("window", lag_s=3.0)) == code_of(create("window", lag_s=12.5, merge_ns=1))
    assert code_of(create("window")) != code_of(create("fls"))
    assert code_of(create("fls")) != code_of(create("fls", dvl=["preintegrated-tight"]))
    assert "depth" in code_of(create("eskf"))


def test_the_first_time_is_told_once_and_the_second_time_nothing_is_done(
    asked: list[object], capfd: pytest.CaptureFixture[str]
) -> None:
    wanted = [create("eskf"), create("window", lag_s=3.0), create("window", lag_s=10.0)]
    compile_first(wanted)
    assert [type(one).__name__ for one in asked] == ["ErrorStateKalmanFilter", "WindowSmoother"]
    assert capfd.readouterr().err.count(NOTICE) == 1
    compile_first(wanted)
    assert len(asked) == 2
    assert capfd.readouterr().err == ""


def test_a_cache_that_cannot_be_written_stops_nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cold_start, "_stamp", lambda: tmp_path / "no" / "such" / "folder.txt")
    remember("eskf")
    assert warm() == set()


def test_other_packages_estimators_are_left_to_their_workers(asked: list[object]) -> None:
    class Theirs:
        factors = frozenset({"dvl"})

        def begin(self, prior: object, rig: object) -> None: ...

    compile_first([Theirs()])  # pyright: ignore[reportArgumentType]
    assert asked == []


@pytest.mark.slow
def test_a_run_on_an_empty_cache_says_that_it_compiles_and_the_next_one_does_not(tmp_path: Path) -> None:
    plan = tmp_path / "short.yaml"
    plan.write_text("description: x\nlogs: [{scenario: {duration_s: 20}}]\nestimators: [{name: dead-reckoning}]\n")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "fathom.bench.cli.app", "run", str(plan), "--out", str(tmp_path), "--force"]
    said = [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr for _ in range(2)
    ]
    assert said[0].startswith(NOTICE)
    assert NOTICE not in said[1]
