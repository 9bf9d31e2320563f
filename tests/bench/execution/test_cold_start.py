from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from fathom.bench.execution import cold_start
from fathom.bench.execution.cold_start import NOTICE, code_of, compile_first, remember, warm
from fathom.estimators import create


def pretend(connection: Any) -> None:
    """Stands in for `serve`, in the child: compiles one function for each estimator, without compiling."""
    folder = Path(os.environ["ASKED"])
    while True:
        try:
            estimator = connection.recv()
        except EOFError:
            return
        (folder / f"{time.monotonic_ns()} {type(estimator).__name__}").touch()
        connection.send("integrate")
        if os.environ.get("MEETING"):  # wait until another process is here as well
            begun = time.monotonic()
            while len(list(folder.iterdir())) < 2 and time.monotonic() < begun + 60:
                time.sleep(0.01)
        if type(estimator).__name__ == os.environ.get("DIES"):
            os._exit(1)
        connection.send(True)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the children note what they are asked for."""
    monkeypatch.setattr(cold_start, "_stamp", lambda: tmp_path / "warm.txt")
    monkeypatch.setattr(cold_start, "SERVE", f"{__file__}:pretend")
    monkeypatch.setattr(cold_start, "_cores", lambda: 1)
    (tmp_path / "asked").mkdir()
    monkeypatch.setenv("ASKED", str(tmp_path / "asked"))
    return tmp_path / "asked"


def asked(folder: Path) -> list[str]:
    """The kinds asked for, in order."""
    return [path.name.split()[1] for path in sorted(folder.iterdir(), key=lambda path: int(path.name.split()[0]))]


def test_what_differs_in_numbers_runs_on_the_same_code() -> None:
    assert code_of(create("window", lag_s=3.0)) == code_of(create("window", lag_s=12.5, merge_ns=1))
    assert code_of(create("window")) != code_of(create("fls"))
    assert code_of(create("fls")) != code_of(create("fls", dvl=["preintegrated-tight"]))
    assert "depth" in code_of(create("eskf"))


@pytest.mark.slow
def test_the_first_time_is_reported_once_and_the_second_time_nothing_is_done(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    wanted = [create("eskf"), create("window", lag_s=3.0), create("window", lag_s=10.0)]
    compile_first(wanted)
    assert asked(folder) == ["WindowSmoother", "ErrorStateKalmanFilter"]  # the heaviest first
    said = capfd.readouterr().err
    assert said.count(f"{NOTICE}: window, eskf; ") == 1
    assert "compiled for WindowSmoother, 1 of 2: 1 functions" in said
    assert "compiled for ErrorStateKalmanFilter, 2 of 2: 2 functions" in said
    compile_first(wanted)
    assert len(asked(folder)) == 2
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_two_cores_compile_for_two_estimators_at_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cold_start, "_cores", lambda: 2)
    monkeypatch.setenv("MEETING", "1")
    begun = time.monotonic()
    compile_first([create("eskf"), create("window")])
    assert time.monotonic() < begun + 50
    assert set(asked(folder)) == {"WindowSmoother", "ErrorStateKalmanFilter"}


@pytest.mark.slow
def test_what_a_dead_process_left_undone_is_left_to_the_workers(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cold_start, "_cores", lambda: 2)
    monkeypatch.setenv("DIES", "WindowSmoother")
    compile_first([create("eskf"), create("window")])
    assert warm() == {code_of(create("eskf"))}


def test_a_cache_that_cannot_be_written_stops_no_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cold_start, "_stamp", lambda: tmp_path / "no" / "such" / "folder.txt")
    remember("eskf")
    assert warm() == set()


def test_other_packages_estimators_are_left_to_their_workers(folder: Path) -> None:
    class Theirs:
        factors = frozenset({"dvl"})

        def begin(self, prior: object, rig: object) -> None: ...

    compile_first([Theirs()])  # pyright: ignore[reportArgumentType]
    assert asked(folder) == []


@pytest.mark.slow
def test_a_run_on_an_empty_cache_says_that_it_compiles_and_the_next_one_does_not(tmp_path: Path) -> None:
    plan = tmp_path / "short.yaml"
    plan.write_text("description: x\nlogs: [{scenario: {duration_s: 20}}]\nestimators: [{name: dead-reckoning}]\n")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "fathom.bench.cli.app", "run", str(plan), "--out", str(tmp_path), "--force"]
    said = [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr for _ in range(2)
    ]
    assert said[0].startswith(f"{NOTICE}: dead-reckoning; ")
    assert NOTICE not in said[1]
