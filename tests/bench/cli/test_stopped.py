"""What ends `fathom run` early: a full disk, a place that cannot be written, Ctrl-C. Finished runs stay."""

from __future__ import annotations

import errno
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fathom.bench.cli import app as cli
from fathom.bench.execution import sweep as runner
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.output import present as presenting
from fathom.bench.results.store import load_runs
from typer.testing import CliRunner

PLAN = "name: t\nlogs: [{scenario: {duration_s: 20}}]\nestimators: [{name: dead-reckoning}]\nseeds: "


def full(*_: object, **__: object) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`fathom run` with so many seeds, in this process; returns exit status and standard error."""
    bench = WorkerCache()
    monkeypatch.setattr(runner, "run_all", lambda tasks, jobs: (bench.execute(task) for task in tasks))
    monkeypatch.setattr(presenting, "_draw_figures", lambda *_: 0)
    monkeypatch.setattr(presenting, "_write_report", lambda *_: None)

    def call(seeds: int, out: Path = tmp_path) -> tuple[int, str]:
        (tmp_path / "t.yaml").write_text(f"{PLAN}{seeds}\n")
        result = CliRunner().invoke(cli.app, ["run", str(tmp_path / "t.yaml"), "--out", str(out)])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.stderr

    return call


def test_a_disk_that_fills_up_is_one_sentence_and_status_1(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(1)[0] == 0
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        status, said = run(3)
    assert status == 1
    assert said.splitlines()[-1].startswith("fathom: ")
    assert "No space left on device" in said
    assert "Traceback" not in said
    assert load_runs(tmp_path / "t")["seed"].tolist() == [1]
    assert run(3)[0] == 0


def test_a_table_that_cannot_be_written_is_status_1_after_runs_and_2_without(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presenting, "write_table", full)
    for expected in (1, 2):
        status, said = run(1)
        assert status == expected
        assert "No space left on device" in said
        assert "the runs are in runs.sqlite" in said


def test_a_place_that_cannot_be_written_is_status_2_and_nothing_is_run(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("a file, not a folder")
    monkeypatch.setattr(runner, "run_all", full)
    status, said = run(1, tmp_path / "file")
    assert status == 2
    assert "give another --out" in said


def test_a_store_that_another_program_writes_to_is_told_so(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fathom.bench.results.store.LOCKED_S", 0.01)
    (tmp_path / "t").mkdir()
    with closing(sqlite3.connect(tmp_path / "t" / "runs.sqlite")) as other:
        other.execute("BEGIN EXCLUSIVE")
        status, said = run(1)
    assert status == 2
    assert "another program has it open to write" in said


def test_memory_that_is_not_enough_is_told_as_memory(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def large(*_: object) -> None:
        raise MemoryError("Unable to allocate 3.00 TiB")

    monkeypatch.setattr(runner, "compile_first", large)
    status, said = run(1)
    assert status == 1
    assert said.splitlines()[-1].startswith("fathom: not enough memory (Unable to allocate 3.00 TiB); ")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for the children in /proc")
@pytest.mark.parametrize("interrupts", [1, 2])
def test_ctrl_c_ends_the_command_and_its_workers_and_keeps_finished_runs(tmp_path: Path, interrupts: int) -> None:
    (tmp_path / "t.yaml").write_text(f"{PLAN}500\n")
    command = [sys.executable, "-m", "fathom.bench.cli.app", "run", str(tmp_path / "t.yaml"), "--out", str(tmp_path)]
    process = subprocess.Popen([*command, "--jobs", "2"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def held() -> list[int]:
        try:
            with closing(sqlite3.connect(tmp_path / "t" / "runs.sqlite")) as store:
                return [seed for (seed,) in store.execute("SELECT seed FROM runs WHERE status = 'done'")]
        except sqlite3.Error:
            return []

    while len(held()) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    children = [int(each) for each in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    assert len(children) == 2
    before = held()
    for _ in range(interrupts):
        process.send_signal(signal.SIGINT)
        time.sleep(0.01)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted: finished runs are kept" in said
    assert "Traceback" not in said
    assert set(before) <= set(held())
    assert [child for child in children if Path(f"/proc/{child}").exists()] == []
