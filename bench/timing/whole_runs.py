"""Overhead of a run beyond its work, and cost of repeating the command when all runs are finished."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from ...datasets import Scenario, simulate
from ...estimators import create
from ..execution.child import THREAD_COUNTS, start
from ..execution.drive import run_log
from ..execution.task import Task
from ..execution.worker import WorkerCache
from ..experiment.plan import Experiment
from ..results.store import Store
from .budgets import Measured

FINISHED = 20_000
"""Number of runs of a large experiment that is finished."""
WORK_S = 0.4
"""Processor time of simulating and running in each round: enough for the clock, and for what happens now and then."""
ROUNDS = 5
"""Of which the sums are compared."""


def plan_of(duration_s: float, seeds: int, estimator: str = "eskf") -> dict[str, Any]:
    """Return a plan of one estimator on many seeds of one mission."""
    return {
        "name": "runs",
        "description": "Many runs.",
        "logs": [{"scenario": {"duration_s": duration_s}}],
        "estimators": [{"name": estimator}],
        "seeds": seeds,
    }


def whole_run(duration_s: float) -> Measured:
    """Measure the processor time of whole runs of `eskf` in a worker over that of simulating and running alone."""
    with start(f"{__name__}:serve", str(duration_s)) as child:
        ratios, whole_ms, alone_ms = child.connection.recv()
    return Measured(ratios, f"{whole_ms:.0f} ms a run, {alone_ms:.0f} ms of them simulating and running")


def serve(connection: Any, duration: str) -> None:
    """In a process like a worker's: let whole runs and their work alone take turns, and send what they took."""
    duration_s = float(duration)
    experiment = Experiment.from_dict(plan_of(duration_s, 1000))
    tasks = iter([Task.of(experiment, run) for run in experiment.runs()])
    scenario, estimator, bench = Scenario(duration_s=duration_s), create("eskf"), WorkerCache()

    def whole(task: Task) -> None:
        (row,) = bench.execute(task).rows
        assert row["status"] == "done", row["cause"]

    def alone(task: Task) -> None:
        assert task.run.seed is not None
        run_log(simulate(scenario, task.run.seed), estimator)

    def seconds(work: Any, some: list[Task]) -> float:
        started = time.process_time()
        for task in some:
            work(task)
        return (time.process_time() - started) / len(some)

    warm = [next(tasks) for _ in range(3)]
    seconds(whole, warm)
    n = max(2, round(WORK_S / seconds(alone, warm)))
    rounds = []
    for _ in range(ROUNDS):
        some = [next(tasks) for _ in range(n)]
        rounds.append((seconds(whole, some), seconds(alone, some)))
    whole_s, alone_s = (1e3 * sum(column) / ROUNDS for column in zip(*rounds, strict=True))
    connection.send((tuple(a / b for a, b in rounds), whole_s, alone_s))


def finished_again_s() -> Measured:
    """Measure the processor time of `fathom run` on an experiment whose runs are all finished, s."""
    again = _again(FINISHED)
    return Measured((again.cpu_s,), f"processor time; {again.wall_s:.0f} s by the clock")


def finished_again_mb() -> Measured:
    """Measure the peak memory of the same command, MB."""
    return Measured((_again(FINISHED).peak_mb,))


def page_of_finished_mb() -> Measured:
    """Measure the size of the report that the same command writes, MB."""
    return Measured((_again(FINISHED).page_mb,))


class Again(NamedTuple):
    """What the command took on finished runs: processor time and time, s, its peak memory and its report, MB."""

    cpu_s: float
    wall_s: float
    peak_mb: float
    page_mb: float


MEASURED = """
import json, resource, subprocess, sys
done = subprocess.run([sys.executable, "-m", "fathom.bench.cli.app", *sys.argv[1:]])
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([usage.ru_utime + usage.ru_stime, usage.ru_maxrss]))
sys.exit(done.returncode)
"""
"""A small process between: on Linux a process begins with the peak of its parent's memory."""


@cache
def _again(n: int) -> Again:
    """Run the command on n finished runs.

    One run is made. Its row and its trajectories stand for all others, under their own seeds and identities.
    """
    plan = plan_of(20.0, n, "dead-reckoning")
    experiment = Experiment.from_dict(plan)
    tasks = [Task.of(experiment, run) for run in experiment.runs()]
    with TemporaryDirectory() as temporary:
        file, folder = Path(temporary) / "runs.yaml", Path(temporary) / "runs"
        file.write_text(repr(plan), encoding="utf-8")
        one = WorkerCache().execute(tasks[0])
        (row,) = one.keep(folder)
        with Store(folder / "runs.sqlite") as store:
            store.write(
                [{**row, "seed": task.run.seed, "identity": task.identity, "spec": _spec(task)} for task in tasks]
            )
        del tasks
        command = [sys.executable, "-c", MEASURED, "run", str(file), "--out", temporary]
        environment = os.environ | dict.fromkeys(THREAD_COUNTS, "1")
        started = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        wall_s = time.perf_counter() - started
        assert done.returncode == 0, done.stderr
        assert f"{n} " in done.stderr, done.stderr  # so many runs were finished already
        page_mb = (folder / "report.html").stat().st_size / 1e6
    cpu_s, peak = json.loads(done.stdout.splitlines()[-1])
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, Linux kilobytes
    return Again(cpu_s, wall_s, peak * unit / 1e6, page_mb)


def _spec(task: Task) -> str:
    return str(task.row("done", None)["spec"])
