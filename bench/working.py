"""In a worker: open a task's log, run its estimator, score what it said, and save its trajectories."""

from __future__ import annotations

import json
import math
import os
import re
import signal
from collections import OrderedDict
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from hashlib import sha256
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.log import Log
from ..datasets.scenario import Scenario
from ..datasets.trajectory import Trajectory
from ..estimators.interface import Estimator
from .consistency import nees_at
from .experiment import Experiment, Run, plain
from .floor import Floor, floors
from .floor_ratio import FLOORS, floor_scores
from .ledger import content_sha256, identity
from .metrics import ScoreError
from .run import Result, can_judge, costs, innovation_dof, innovation_scores, run_log, scores, warm_up
from .store import Row, provenance

LOGS_KEPT = 2
"""How many logs a worker keeps in memory, so that estimators share them."""


@dataclass(frozen=True)
class Task:
    """One run and all a worker needs for it."""

    experiment: Experiment
    run: Run
    folder: Path
    data: Path | None = None
    repair: bool = False
    readings_sha256: str | None = None
    """Of a recorded log, or of a simulated one's recorded path; see `ledger.identity`."""

    @cached_property
    def spec(self) -> dict[str, Any]:
        """All that decides the run's numbers but readings and versions."""
        return self.experiment.spec(self.run, self.repair)

    @cached_property
    def identity(self) -> str:
        """What tells this run from any other."""
        return identity(self.spec, self.readings_sha256)

    def row(self, status: str, cause: str | None, output: str = "online") -> dict[str, Any]:
        """Return what a row says whether the run succeeds or not."""
        run, scoring = self.run, self.experiment.scoring(self.run.log)
        return {
            "experiment": self.experiment.name,
            "log": run.log.name,
            "label": run.estimator.label,
            "seed": run.seed,
            "output": output,
            "status": status,
            "cause": cause,
            "align": scoring.align,
            "dims": scoring.dims,
            "estimator": run.estimator.name,
            "identity": self.identity,
            "spec": json.dumps(self.spec),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        } | provenance()


def work(connection: Connection) -> None:
    """Do tasks until there are no more, or no parent; Ctrl-C is the parent's affair."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    bench = Bench()
    while True:
        try:
            connection.send(bench.execute(connection.recv()))
        except (EOFError, OSError):
            return


class Bench:
    """What a worker keeps from one task to the next: the last logs, and which estimators are compiled."""

    def __init__(self) -> None:
        self.logs: OrderedDict[str, Log] = OrderedDict()
        self.floors: dict[str, dict[float, Floor]] = {}
        self.warm: set[str] = set()

    def execute(self, task: Task) -> list[Row]:
        """Do one run and return its rows, whatever happens."""
        started = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            log = self.open(task)
            estimator = self.estimator(task)
            experiment, scoring = task.experiment, task.experiment.scoring(task.run.log)
            with _PeakMemory() as memory:
                result = run_log(
                    log,
                    estimator,
                    score_period_s=scoring.score_period_s,
                    max_gap_s=experiment.max_gap_s,
                    timeout_s=experiment.timeout_s,
                    nis=scoring.nis,
                )
            return self.rows(task, log, result, {"started": started, "peak_mb": memory.peak_mb})
        except Exception as error:
            return [task.row("failed", f"{type(error).__name__}: {error}") | {"started": started}]

    def open(self, task: Task) -> Log:
        """Open or simulate the task's log, unless it is one of the last."""
        key = log_key(task)
        if key not in self.logs:
            self.logs[key] = task.run.log.open(task.run.seed, task.data, task.repair)
        self.logs.move_to_end(key)
        while len(self.logs) > LOGS_KEPT:
            gone, _ = self.logs.popitem(last=False)
            self.floors = {of: floors for of, floors in self.floors.items() if not of.startswith(gone)}
        return self.logs[key]

    def estimator(self, task: Task) -> Estimator:
        """Return the task's estimator, compiled."""
        estimator = task.run.estimator.create()
        if repr(estimator) not in self.warm:
            warm_up(estimator)
            self.warm.add(repr(estimator))
        return estimator

    def floor(self, task: Task, result: Result, lookahead_s: float) -> dict[str, float | None]:
        """Return the scores of FLOORS for one look-ahead; None where there are none: of a recorded log, say.

        The floors of all the experiment's lags are found together, once for all estimators that use the same sensors.
        """
        experiment, run = task.experiment, task.run
        scoring = experiment.scoring(run.log)
        asked = scoring.floor and run.log.scenario is not None and (scoring.align, scoring.dims) == ("none", "3d")
        if not asked or result.status != "done" or result.online is None:
            return dict.fromkeys(FLOORS)
        assert run.seed is not None
        factors = run.estimator.create().factors
        key = f"{log_key(task)} {sorted(factors)} {scoring.score_period_s} {experiment.max_gap_s}"
        if lookahead_s not in self.floors.get(key, {}):
            lags = {getattr(estimator.create(), "lag_s", 0.0) for estimator in experiment.estimators}
            scenario = Scenario.from_dict(run.log.scenario or {})
            wanted = sorted({0.0, math.inf, lookahead_s, *lags})
            self.floors[key] = floors(scenario, run.seed, result.online.t_ns, wanted, factors, experiment.max_gap_s)
        return floor_scores(self.floors[key][lookahead_s], result.online.t_ns)

    def rows(self, task: Task, log: Log, result: Result, extra: Row) -> list[Row]:
        """Score a run and save its trajectories: one row per output."""
        scoring = task.experiment.scoring(task.run.log)
        shared = {
            "failed_at_s": result.failed_at_s,
            "truth_kind": log.truth_kind if log.truth is not None else None,
            "duration_s": result.duration_s,
            "start": result.start,
            "counts": json.dumps(plain(result.counts)),
            "notes": json.dumps([*log.notes, *result.notes]),
            **costs(result),
            **extra,
        }
        if log.truth is not None and result.online is not None:
            known = log.truth.select(np.flatnonzero(np.isin(log.truth.t_ns, result.online.t_ns)))
            shared["truth_trajectory"] = save(task, "truth", known)
        rows = []
        for output, trajectory in result.outputs.items():
            name = save(task, output, trajectory)
            row = task.row(result.status, result.cause, output) | shared | scores(log, trajectory, scoring)
            if output == "online":
                row |= innovation_scores(result) | {"nis_dof": json.dumps(innovation_dof(result))}
            try:
                row |= self.floor(task, result, trajectory.lookahead_s)
            except ScoreError as error:  # a look-ahead that is none, say: the run is none the worse
                row["notes"] = json.dumps([*log.notes, *result.notes, str(error)])
            if can_judge(log, scoring):
                row["nees_at"] = json.dumps(nees_at(log, trajectory, scoring.nees_epochs))
            rows.append(row | {"lookahead_s": trajectory.lookahead_s, "trajectory": name})
        return rows or [task.row(result.status, result.cause) | shared]


def log_key(task: Task) -> str:
    """Return what tells the task's log from any other."""
    return json.dumps([plain(task.run.log), task.run.seed])


def save(task: Task, output: str, trajectory: Trajectory) -> str:
    """Write a trajectory beside the store and return its file's name; of the covariance, the 3 × 3 blocks.

    The name ends in the identity of the run (of the content, for the truth, which runs share): so a file is never
    written over with another's content, and a row that stands keeps its own.
    """
    label = task.run.estimator.label if output != "truth" else ""
    seed = "" if task.run.seed is None else str(task.run.seed)
    mark = (content_sha256(trajectory) if output == "truth" else task.identity)[:8]
    name = "--".join(_file_part(part) for part in (task.run.log.name, label, seed, output, mark) if part) + ".parquet"
    if output == "truth" and (task.folder / "trajectories" / name).is_file():
        return name
    table = trajectory.to_pandas()
    across = [f"P_{i}_{j}" for i in range(15) for j in range(i, 15) if i // 3 != j // 3]
    table = table.drop(columns=across, errors="ignore")
    folder = task.folder / "trajectories"
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = folder / f"{name}.{os.getpid()}"
    with np.errstate(over="ignore"):  # a covariance on its way to infinity may get there
        table = table.astype({column: "float32" for column in table if column.startswith("P_")})
    table.to_parquet(unfinished, index=False)
    unfinished.replace(folder / name)
    return name


def _file_part(text: str) -> str:
    """Return the text as a file name may hold it; a changed text gains a few letters of its own."""
    safe = re.sub(r"[^\w.=+-]+", "_", text)
    return safe if safe == text else f"{safe}-{sha256(text.encode()).hexdigest()[:4]}"


class _PeakMemory:
    """Highest resident memory within the block above that at its start, MB; None where the system does not tell."""

    def __enter__(self) -> _PeakMemory:
        self.peak_mb: float | None = None
        try:
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak restarts from here
            self.start_kb = self._status("VmRSS")
        except OSError:
            self.start_kb = None
        return self

    def __exit__(self, *_: object) -> None:
        if self.start_kb is not None:
            self.peak_mb = (self._status("VmHWM") - self.start_kb) / 1024

    @staticmethod
    def _status(key: str) -> float:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(key):
                return float(line.split()[1])
        raise OSError(f"/proc/self/status has no {key}")
