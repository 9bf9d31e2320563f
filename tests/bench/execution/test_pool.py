"""Whatever a worker does or says costs its own run alone, in time, and every planned run has a row."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from fathom.bench.errors import StoppedError
from fathom.bench.execution import pool
from fathom.bench.execution import sweep as sweeping
from fathom.bench.execution.child import start
from fathom.bench.execution.pool import Worker, next_finished
from fathom.bench.execution.task import Finished, Stage, Task
from fathom.bench.experiment.plan import Experiment
from packages import distribution, idler

PLAN = Experiment.from_dict(
    {
        "name": "t",
        "logs": [{"scenario": {"mission": "lawnmower", "duration_s": 20}}],
        "estimators": [{"name": "dead-reckoning", "label": label} for label in ("a", "b")],
        "timeout_s": 1.0,
    }
)
TASK, OTHER = (Task.of(PLAN, run) for run in PLAN.runs())

SAYS = """
import os, sys, time, threading, subprocess

def main(connection, what):
    connection.recv_bytes()
    fd = connection.fileno()
    if what == "garbage":
        os.write(fd, b"\\x00\\x00\\x00\\x05hello")
    elif what == "half":
        os.write(fd, b"\\x00\\x00\\x10\\x00only half of it")
        time.sleep(60)
    elif what == "less than nothing":
        os.write(fd, b"\\xff\\xff\\xff\\x00")
    elif what == "ten gigabytes":
        os.write(fd, b"\\xff\\xff\\xff\\xff" + (10**10).to_bytes(8, "big") + b"and so on")
    elif what == "print":
        print("an answer")
    elif what == "exit":
        sys.exit(0)
    elif what == "closes":
        os.close(fd)
    elif what == "sleeps":
        subprocess.Popen(["sleep", "60"])
        connection.send("started")
    elif what == "text":
        connection.send("done")
    time.sleep(60)
"""


@pytest.fixture
def script(tmp_path: Path) -> str:
    (tmp_path / "says.py").write_text(SAYS)
    return f"{tmp_path / 'says.py'}:main"


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("garbage", "worker gave what cannot be read: UnpicklingError"),
        ("less than nothing", "worker gave what cannot be read"),
        ("ten gigabytes", "worker gave what cannot be read: OSError: bad message length"),
        ("text", "worker gave what cannot be read: str, which is no result of this run"),
        ("half", "out of time: hung while starting; its worker was killed"),
        ("print", "out of time: hung while starting; its worker was killed"),
        ("exit", "worker died (exit code 0)"),
        ("closes", "worker closed its connection"),
    ],
)
def test_what_cannot_be_received_is_a_failed_row_in_time(
    script: str, what: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "GRACE_S", 0.2)
    monkeypatch.setattr(pool, "START_S", 0.2 if "hung" in says else 60.0)
    worker = Worker(child=start(script, what))
    try:
        worker.begin(TASK)
        (row,) = next_finished([worker], worker.answers).rows
        assert (row["status"], row["identity"], row["label"]) == ("failed", TASK.identity, "a")
        assert says in row["cause"]
        assert worker.lost
    finally:
        worker.child.kill()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="the system does not list processes in /proc")
def test_what_a_worker_has_started_ends_with_it(script: str) -> None:
    worker = Worker(child=start(script, "sleeps"))
    worker.begin(TASK)
    next_finished([worker], worker.answers)
    group = worker.child.process.pid
    worker.child.kill()
    give_up_s = time.monotonic() + 10
    while any(members(group)) and time.monotonic() < give_up_s:
        time.sleep(0.01)
    assert not list(members(group))


def members(group: int) -> Iterator[str]:
    """The processes of a group, those that wait to be collected aside."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of_group = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(of_group) == group and state != "Z":
            yield stat.parent.name


class Deaf:
    """Stands for a process that says nothing by itself."""

    class connection:  # noqa: N801
        @staticmethod
        def send(_: object) -> None: ...

        @staticmethod
        def recv_bytes(_: int) -> bytes:
            raise EOFError

    class process:  # noqa: N801
        returncode = 7

        @staticmethod
        def wait(_: float) -> None: ...


def listening() -> Worker:
    worker = Worker(child=Deaf())  # type: ignore[arg-type]
    worker.begin(TASK)
    return worker


def test_a_result_of_another_task_is_no_result() -> None:
    wrong = [
        Finished([OTHER.row("done", None)]),
        Finished([TASK.row("done", None), OTHER.row("done", None, "smoothed")]),
        Finished([TASK.row("done", None) | {"seed": 7}]),
        Finished([TASK.row("done", None) | {"identity": "0" * 64}]),
        Finished([]),
        Finished(["done"]),  # type: ignore[list-item]
        Finished([TASK.row("done", None)], {"../outside.parquet": b""}),
        [TASK.row("done", None)],
        Stage("of another run", "scoring", 1e9),
    ]
    for answer in wrong:
        finished = listening().take(pickle.loads(pickle.dumps(answer)))
        assert finished is not None
        (row,) = finished.rows
        assert (row["status"], row["label"]) == ("failed", "a")
        assert "no result of this run" in row["cause"]
    right = listening().take(Finished([TASK.row("done", None)], {"truth.parquet": b""}))
    assert right is not None
    assert right.rows[0]["status"] == "done"


def test_each_stage_has_its_own_time() -> None:
    worker = listening()
    assert worker.take(Stage(TASK.identity, "opening the log", 50.0)) is None
    assert 49.0 < worker.give_up_s - time.monotonic() <= 50.0 + pool.GRACE_S
    assert worker.hung().rows[0]["cause"] == "out of time: hung while opening the log; its worker was killed"


def test_a_planned_run_without_a_row_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forgetful(tasks: Any, jobs: int) -> Iterator[Finished]:
        yield Finished([tasks[0].row("done", None)])

    monkeypatch.setattr(sweeping, "run_all", forgetful)
    monkeypatch.setattr(sweeping, "compile_first", lambda wanted: None)
    with pytest.raises(StoppedError, match=r"1 of 2 planned runs have no result, the first is lawnmower-.* / b"):
        sweeping.sweep(PLAN, out=tmp_path)


# -- whole runs of other people's estimators --------------------------------------------------------------------------

STRANGE = idler("""
if self.steps != 5:
    return
match self.kind:
    case "exits": sys.exit(0)
    case "dies": os._exit(0)
    case "swallows":
        while True:
            try:
                time.sleep(60)
            except BaseException:
                pass
    case "forks": os.fork()
    case "changes":
        import fathom.estimators.physics.so3, fathom.bench.metrics.absolute_error as absolute
        absolute.ate = lambda *_, **__: 1 / 0
        np.seterr(all="raise")
        np.random.seed(0)
        os.chdir("/")
        os.environ["FATHOM_DATA"] = "/nowhere"
        sys.setrecursionlimit(60 + len(__import__("inspect").stack()))
        warnings.simplefilter("error")
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        threading.Thread(target=time.sleep, args=(600,)).start()
""")


@pytest.fixture
def strange(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody's package with an estimator `strange`, here and in the workers."""
    distribution(tmp_path, "strangers", "[fathom.estimators]\nstrange = strangers:Idler\n", strangers=STRANGE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.slow  # seven workers start, one after the other
def test_other_peoples_code_falsifies_no_run_after_it_and_each_run_has_its_row(
    tmp_path: Path, strange: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "GRACE_S", 2.0)
    kinds = ("exits", "dies", "swallows", "forks", "changes", "none")
    content = {
        "name": "t",
        "logs": [{"scenario": {"mission": "lawnmower", "duration_s": 20}}],
        "estimators": [
            {"name": "dead-reckoning", "label": "before"},
            *({"name": "strange", "label": kind, "with": {"kind": kind}} for kind in kinds),
            {"name": "dead-reckoning", "label": "after"},
        ],
        "timeout_s": 8.0,
    }
    rows = sweeping.run_experiment(Experiment.from_dict(content), out=tmp_path / "out", jobs=1).set_index("label")
    assert rows.index.tolist() == ["before", *kinds, "after"]
    assert rows["status"].drop("changes").tolist() == ["done", "failed", "failed", "failed", "done", "done", "done"]
    assert rows.loc["exits", "cause"] == "SystemExit: 0"
    assert rows.loc["dies", "cause"] == "worker died (exit code 0)"
    assert rows.loc["swallows", "cause"] == "out of time: hung while warming up; its worker was killed"
    assert rows.loc["forks", "ate_rmse_m"] == rows.loc["none", "ate_rmse_m"]
    pd.testing.assert_series_equal(
        rows.loc["before", ["ate_rmse_m", "heading_rmse_deg"]],
        rows.loc["after", ["ate_rmse_m", "heading_rmse_deg"]],
        check_names=False,
    )
    assert "in step" in rows.loc["exits", "traceback"]
