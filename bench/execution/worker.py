"""In a worker: open a task's log, run its estimator, score it, and return rows and trajectories."""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from pathlib import Path
from platform import node

import numpy as np

from ...datasets.errors import DatasetError, one_line
from ...datasets.log import Log
from ...datasets.notes import as_data
from ...datasets.simulated.scenario import Scenario
from ...estimators.interface import Estimator
from ...estimators.registry import ESTIMATORS
from ..experiment.plan import plain
from ..metrics import ScoreError
from ..metrics.consistency import nees_at
from ..metrics.floor import Floor, floors
from ..metrics.floor_ratio import FLOORS, floor_scores
from ..metrics.scoring import INNOVATIONS, by_reason, can_judge, scored
from ..results.identity import content_sha256
from ..results.store import Row
from .drive import run_log, traceback_of, warm_up
from .noticed import unmeasured_height
from .result import Result, costs, innovation_dof, innovation_scores
from .task import Finished, Stage, Task, file_name, parquet

LOGS_KEPT = 2
"""How many logs a worker keeps in memory, so that estimators share them: the present one and the one before."""

COMPILE_S = 120.0
"""How long compiling one of our estimators may take beyond a run's own time, s; it takes half a minute on two cores."""

SCORE_S = 120.0
"""How long scoring may take beyond a run's own time, s; it takes seconds, and a floor a minute."""


def work(connection: Connection) -> None:
    """Do tasks until the connection closes."""
    cache, process = WorkerCache(connection.send), os.getpid()
    while True:
        try:
            finished = cache.execute(connection.recv())
            if os.getpid() != process:  # an estimator has forked: there is one answer, and not from here
                os._exit(1)
            connection.send(finished)
        except (EOFError, OSError):
            return


class WorkerCache:
    """Kept by a worker between tasks: the last logs, their floors and truths, and compiled estimators.

    Args:
        tell: called with every stage of a task.
    """

    def __init__(self, tell: Callable[[Stage], object] = lambda stage: None) -> None:
        self.tell = tell
        self.logs: OrderedDict[str, Log] = OrderedDict()
        self.floors: dict[str, dict[float, Floor]] = {}
        self.truth: dict[str, bytes] = {}
        self.warm: set[str] = set()

    def execute(self, task: Task) -> Finished:
        """Do one run and return its rows and trajectories; an error becomes a row."""
        started = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            self._enter(task, "opening the log")
            log = self.open(task)
            ours = task.run.estimator.name in ESTIMATORS
            self._enter(task, "warming up", COMPILE_S if ours else 0.0)
            estimator = self.estimator(task)
            self._enter(task, "running the estimator")
            with _PeakMemory() as memory:
                result = run_log(
                    log,
                    estimator,
                    score_period_s=task.scoring.score_period_s,
                    max_gap_s=task.max_gap_s,
                    timeout_s=task.timeout_s,
                    nis=task.scoring.nis,
                )
            if not ours and result.status == "failed":
                self.logs.clear()  # it may have changed them
            self._enter(task, "scoring", SCORE_S)
            return self.finished(task, log, result, {"started": started, "peak_mb": memory.peak_mb})
        except (Exception, SystemExit) as error:  # another package's code may raise anything, or exit
            row = task.row("failed", one_line(error)) | {"started": started, "traceback": traceback_of(error)}
            return Finished([row])

    def _enter(self, task: Task, doing: str, extra_s: float = 0.0) -> None:
        self.tell(Stage(task.identity, doing, task.timeout_s + extra_s))

    def open(self, task: Task) -> Log:
        """Open or simulate the task's log, unless it is one of the last.

        Raises:
            DatasetError: it cannot be read, or its readings are not those that the task is about.
        """
        key = log_key(task)
        if key not in self.logs:
            self.logs[key] = open_same(task)
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
            gc.collect()
            gc.freeze()  # imports and compiled code stay: later collections skip them
        return estimator

    def floor(self, task: Task, result: Result, lookahead_s: float) -> dict[str, float | None]:
        """Return the scores of FLOORS for one look-ahead; None where they are not asked for.

        The floors of all the experiment's lags are found together, once for all estimators that use the same sensors.

        Raises:
            ScoreError: there is none.
        """
        run, scoring = task.run, task.scoring
        if not scoring.floor:
            return dict.fromkeys(FLOORS)
        if run.log.scenario is None or (scoring.align, scoring.dims) != ("none", "3d"):
            raise ScoreError("the floor is known for simulated logs only, unaligned and in 3d")
        if result.status != "done" or result.online is None:
            raise ScoreError("the run did not finish, so it has no floor")
        assert run.seed is not None
        factors = run.estimator.create().factors
        key = f"{log_key(task)} {sorted(factors)} {scoring.score_period_s} {task.max_gap_s}"
        if lookahead_s not in self.floors.get(key, {}):
            scenario = Scenario.from_dict(run.log.scenario or {})
            wanted = sorted({0.0, math.inf, lookahead_s, *task.lags_s})
            self.floors[key] = floors(scenario, run.seed, result.online.t_ns, wanted, factors, task.max_gap_s)
        return floor_scores(self.floors[key][lookahead_s], result.online.t_ns)

    def finished(self, task: Task, log: Log, result: Result, extra: Row) -> Finished:
        """Score a run: one row per output, and its trajectories beside them."""
        scoring, notes = task.scoring, (*log.notes, *task.checked, *result.notes)
        if scoring.dims == "3d" and result.online is not None:
            notes += unmeasured_height(log, task.run.estimator.create().factors)
        files: dict[str, bytes] = {}
        shared = {
            "failed_at_s": result.failed_at_s,
            "traceback": result.traceback,
            "truth_kind": log.truth_kind if log.truth is not None else None,
            "duration_s": result.duration_s,
            "start": result.start,
            "counts": json.dumps(plain(result.counts)),
            "notes": json.dumps([as_data(note) for note in notes]),
            **costs(result, scoring.output_rate_hz),
            **extra,
        }
        if log.truth is not None and result.online is not None:
            known = log.truth.select(np.flatnonzero(np.isin(log.truth.t_ns, result.online.t_ns)))
            name = shared["truth_trajectory"] = file_name(task, "truth", content_sha256(known))
            if name not in self.truth:  # the estimators of a log share it
                self.truth = {name: parquet(known)}
            files |= self.truth
        rows = []
        for output, trajectory in result.outputs.items():
            name = file_name(task, output, task.identity)
            files[name] = parquet(trajectory)
            values, missing = scored(log, trajectory, scoring)
            row = task.row(result.status, result.cause, output) | shared | values
            if output == "online":
                row |= innovation_scores(result) | {"nis_dof": json.dumps(innovation_dof(result))}
            try:
                row |= self.floor(task, result, trajectory.lookahead_s)
            except ScoreError as error:  # a look-ahead that is not defined, say: the other scores stand
                missing |= dict.fromkeys(FLOORS, str(error))
            if scoring.nis:
                why = (
                    "innovations are of the online output"
                    if output != "online"
                    else "no such reading that came in time or was replayed"
                )
                missing |= {name: why for name in INNOVATIONS if row.get(name) is None}
            row["missing"] = json.dumps(by_reason(missing))
            if can_judge(log, scoring):
                row["nees_at"] = json.dumps(nees_at(log, trajectory, scoring.nees_epochs))
            rows.append(row | {"lookahead_s": trajectory.lookahead_s, "trajectory": name})
        return Finished(rows or [task.row(result.status, result.cause) | shared], files)


def log_key(task: Task) -> str:
    """Return a key that is equal for equal logs only."""
    return json.dumps([plain(task.run.log), task.run.seed, task.repair, str(task.data), task.readings_sha256])


def open_same(task: Task) -> Log:
    """Open or simulate the task's log.

    Raises:
        DatasetError: it cannot be read; or its readings are not those by which the run is known, as where another
            machine holds another recording under the same name.
    """
    spec, expected = task.run.log, task.readings_sha256
    log = spec.open(task.run.seed, task.data, task.repair)
    if expected is not None:
        found = content_sha256(log) if spec.scenario is None else spec.path_sha256
        if found != expected:
            what = "recording" if spec.scenario is None else "recorded path"
            raise DatasetError(
                f"{spec.name}: the {what} on {node()} differs from the one where the run was planned "
                f"(SHA-256 {str(found)[:8]}… here, {expected[:8]}… there); copy it there, or mend --data or FATHOM_DATA"
            )
    return log


class _PeakMemory:
    """Peak of resident memory inside the block, less that at its start, MB; None where the system does not report it.

    Memory of earlier runs is released before, since it would hide the peak.
    """

    def __enter__(self) -> _PeakMemory:
        self.peak_mb: float | None = None
        gc.collect()
        with suppress(AttributeError, OSError):  # glibc's; otherwise memory of earlier runs would hide the peak
            ctypes.CDLL(None).malloc_trim(0)
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
