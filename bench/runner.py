"""Run an experiment: every run in a worker process, every finished run in the store at once."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatch
from functools import cached_property
from hashlib import sha256
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..datasets.log import Log
from ..datasets.opening import RecordingNotFound
from ..datasets.scenario import Scenario
from ..datasets.trajectory import Trajectory
from ..estimators.interface import Estimator
from .consistency import nees_at
from .experiment import Experiment, ExperimentError, Run, plain
from .floor import Floor, floors
from .floor_ratio import FLOORS, floor_scores
from .ledger import content_sha256, identity, sole_writer
from .metrics import ScoreError
from .run import Result, can_judge, costs, innovation_dof, innovation_scores, run_log, scores, warm_up
from .store import Row, Store, provenance

THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")
LOGS_KEPT = 2
"""How many logs a worker keeps in memory, so that estimators share them."""

GRACE_S = 120.0
"""A worker that is this far past its run's timeout hangs inside one call, and is killed."""


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


def run_experiment(
    experiment: Experiment | str | Path,
    data: Path | str | None = None,
    out: Path | str = "results",
    jobs: int = 0,
    only: str | None = None,
    repair: bool = False,
    force: bool = False,
) -> pd.DataFrame:
    """Run every estimator on every log and return the rows of the store, one per run and output.

    What is in the store already, under its `ledger.identity`, is not run again: `attrs["standing"]` says how many runs
    that were, `attrs["renewed"]` how many stood there under another identity and were made anew. A run that fails,
    diverges, or kills its worker is a row that says so. Interrupted (KeyboardInterrupt), the finished runs are in the
    store. A run whose recording is not here keeps the rows of an earlier day; `attrs["kept"]` then maps its log to why
    it did not run.

    Args:
        experiment: an experiment, a shipped one's name, or a YAML file.
        data: where recorded logs are; else FATHOM_DATA.
        out: the rows go to out/<experiment>/runs.sqlite, the trajectories beside it.
        jobs: worker processes; 0 for one per core.
        only: run only what matches this pattern: an estimator's label, a log's name, or "log/label".
        repair: let loaders drop bad rows, and count them.
        force: run what is in the store already, too.

    Raises:
        ExperimentError, EstimatorError, DatasetError: nothing was run.
    """
    if not isinstance(experiment, Experiment):
        experiment = Experiment.load(experiment)
    if jobs < 0:
        raise ExperimentError(f"jobs must be 0 (one per core) or more, found {jobs}")
    folder = Path(out) / experiment.name
    runs = _select(experiment, only)
    tasks, absent = _order([Task(experiment, run, folder, Path(data) if data else None, repair) for run in runs])
    _make_room(folder)
    with sole_writer(folder), Store(folder / "runs.sqlite") as store:
        kept = {row["log"]: row["cause"] for row in absent if not store.write_absent(row)}
        missing, renewed = _missing(tasks, store, force)
        with _progress(len(missing), len(tasks) - len(missing)) as advance:
            for rows in run_all(missing, jobs):
                store.write(rows)
                advance(rows)
        _sweep(folder / "trajectories", store.trajectories())
        rows = rows_of(store.read(), runs)
    rows.attrs |= {"kept": kept, "standing": len(tasks) - len(missing), "renewed": renewed}
    return rows


def _missing(tasks: Sequence[Task], store: Store, force: bool) -> tuple[list[Task], int]:
    """Return the tasks that are not in the store yet, and how many of them stand there under another identity."""
    finished = store.finished()
    named = {key[:3] for key in finished}
    missing, renewed = [], 0
    for task in tasks:
        names = (task.run.log.name, task.run.estimator.label, task.run.seed)
        stands = (*names, task.identity) in finished
        if force or not stands:
            missing.append(task)
            renewed += names in named and not stands
    return missing, renewed


def _sweep(folder: Path, spoken_of: set[str]) -> None:
    """Remove what runs that were killed or made anew left behind."""
    for path in folder.iterdir():
        if path.name not in spoken_of and (path.suffix == ".parquet" or ".parquet." in path.name):
            path.unlink(missing_ok=True)


def _make_room(folder: Path) -> None:
    """Make the folders of the results, before anything runs.

    Raises:
        ExperimentError: they cannot be made, or something else is where a result will go.
    """
    for path in (folder / "trajectories", folder / "figures"):  # the lock lies in their parent
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ExperimentError(f"{path}: cannot be made ({error.strerror}); give another --out") from None
    for path in (folder / "table.csv", folder / "consistency.csv"):
        if path.is_dir():
            raise ExperimentError(f"{path}: a folder is in the way; move it, or give another --out")


def _select(experiment: Experiment, only: str | None) -> list[Run]:
    runs = experiment.runs()
    if only is None:
        return runs

    def names(run: Run) -> tuple[str, str, str]:
        return run.log.name, run.estimator.label, f"{run.log.name}/{run.estimator.label}"

    chosen = [run for run in runs if any(fnmatch(name, only) for name in names(run))]
    if not chosen:
        raise ExperimentError(f"--only {only!r} matches none of: {', '.join(dict.fromkeys(names(r)[2] for r in runs))}")
    return chosen


def _order(tasks: Sequence[Task]) -> tuple[list[Task], list[dict[str, Any]]]:
    """Open each recorded log once, now, so that bad input ends everything; then put the longest runs first.

    Returns the tasks whose log is here (runs on one log stay neighbours, so workers load it once), and a row for each
    of the others.
    """
    duration_s: dict[str, float] = {}
    readings: dict[str, str] = {}
    missing: dict[str, str] = {}
    for task in {task.run.log.name: task for task in tasks}.values():
        spec = task.run.log
        try:
            if spec.duration_s is None:
                log = spec.open(None, task.data, task.repair)
                duration_s[spec.name], readings[spec.name] = log.duration_s, content_sha256(log)
            else:
                duration_s[spec.name] = spec.duration_s
                if (path := spec.path_sha256) is not None:
                    readings[spec.name] = path
        except RecordingNotFound as error:
            missing[spec.name] = f"not here: {error}"
    here = [
        replace(task, readings_sha256=readings.get(task.run.log.name))
        for task in tasks
        if task.run.log.name in duration_s
    ]
    absent = [task.row("absent", missing[task.run.log.name]) for task in tasks if task.run.log.name in missing]

    def longest(task: Task) -> tuple[float, str, int, float]:
        lag_s = float(getattr(task.run.estimator.create(), "lag_s", 0.0))
        return (-duration_s[task.run.log.name], task.run.log.name, task.run.seed or 0, -lag_s)

    return sorted(here, key=longest), absent


def rows_of(rows: pd.DataFrame, runs: Sequence[Run]) -> pd.DataFrame:
    """Return the rows of these runs, in their order: the store may hold those of earlier experiments of this name."""
    place = {(run.log.name, run.estimator.label, run.seed): k for k, run in enumerate(runs)}
    keys = zip(rows["log"], rows["label"], rows["seed"], strict=True)
    order = [place.get((log, label, None if pd.isna(seed) else int(seed)), -1) for log, label, seed in keys]
    rows = rows.assign(order=order).query("order >= 0").sort_values("order", kind="stable")
    return rows.drop(columns="order").reset_index(drop=True)


def outdated(rows: pd.DataFrame, experiment: Experiment) -> pd.Series:
    """Return which of the rows `rows_of` gave were made under another spec or version than a run today would be."""
    runs = {(run.log.name, run.estimator.label, run.seed): run for run in experiment.runs()}
    versions = json.loads(provenance()["versions"])

    def is_old(row: Any) -> bool:
        if not isinstance(row.spec, str) or not isinstance(row.versions, str):
            return True
        spec, seed = json.loads(row.spec), None if pd.isna(row.seed) else int(row.seed)
        today = experiment.spec(runs[row.log, row.label, seed], spec.get("repair", False))
        as_text = [json.dumps(one, sort_keys=True) for one in (spec, today)]
        return as_text[0] != as_text[1] or json.loads(row.versions) != versions

    return pd.Series([is_old(row) for row in rows.itertuples()], index=rows.index, dtype=bool)


# -- in the parent: workers and what becomes of them ------------------------------------------------------------------


@dataclass
class Worker:
    """One process, with the task it is at."""

    connection: Any = field(init=False)
    process: Any = field(init=False)
    task: Task | None = None
    give_up_s: float = float("inf")

    def __post_init__(self) -> None:
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs,), daemon=True)
        with _deaf_to_ctrl_c():
            self.process.start()
        theirs.close()

    def begin(self, task: Task) -> None:
        """Hand over a task; a worker that is already dead is found out by `wait`."""
        self.task, self.give_up_s = task, time.monotonic() + 2 * task.experiment.timeout_s + GRACE_S
        try:
            self.connection.send(task)
        except OSError:
            return

    def kill(self) -> None:
        """End the process, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run_all(tasks: Sequence[Task], jobs: int = 0) -> Iterator[list[Row]]:
    """Yield the rows of each task as it ends, from `jobs` worker processes (0: one per core).

    Each worker has one task at a time, so a death is that task's, and is made good by a fresh worker.
    """
    waiting = deque(tasks)
    with _single_threaded_children():
        workers = [Worker() for _ in range(min(jobs or os.cpu_count() or 1, len(waiting)))]
        try:
            while waiting or any(worker.task for worker in workers):
                for worker in workers:
                    if worker.task is None and waiting:
                        worker.begin(waiting.popleft())
                busy = [worker for worker in workers if worker.task]
                ready = wait([worker.connection for worker in busy], max(0.0, _soonest(busy) - time.monotonic()))
                for worker in busy:
                    hung = time.monotonic() > worker.give_up_s
                    if worker.connection not in ready and not hung:
                        continue
                    rows = _collect(worker, hung)
                    if worker.task is not None:  # it did not survive
                        worker.kill()
                        workers[workers.index(worker)] = Worker()
                    yield rows
        finally:
            for worker in workers:
                worker.kill()


def _soonest(workers: Sequence[Worker]) -> float:
    return min(worker.give_up_s for worker in workers)


def _collect(worker: Worker, hung: bool) -> list[Row]:
    """Return the rows of a worker's task; the task stays with it where the worker is lost."""
    task = worker.task
    assert task is not None
    if hung and not worker.connection.poll():
        return [task.row("failed", "out of time: hung inside one call; its worker was killed")]
    try:
        rows = worker.connection.recv()
    except (EOFError, OSError):
        worker.process.join(10)
        return [task.row("failed", f"worker died (exit code {worker.process.exitcode})")]
    worker.task = None
    return rows


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Ignore SIGINT, so that a child started here ignores it from its first moment on; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Set the variables that libraries read when a child starts; timings are single-threaded."""
    before = {name: os.environ.get(name) for name in THREAD_COUNTS}
    os.environ.update(dict.fromkeys(THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _progress(missing: int, standing: int) -> Iterator[Any]:
    """Give a function to call with each finished run's rows; draws a bar on a terminal, nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("", total=missing + standing, completed=standing)

        def advance(rows: Sequence[Row]) -> None:
            bar.update(task, advance=1, description=f"{rows[0]['log']} / {rows[0]['label']}: {rows[0]['status']}")

        yield advance


# -- in the worker ----------------------------------------------------------------------------------------------------


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
