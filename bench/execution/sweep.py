"""Run an experiment: runs that the store lacks, each stored as soon as it is finished."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ...datasets.described.opening import RecordingNotFound
from ..errors import ExperimentError, StoppedError
from ..experiment.plan import Experiment, Run
from ..files import writing
from ..results.identity import FINAL, content_sha256
from ..results.rows import run_keys
from ..results.store import Row, Store, provenance, sole_writer, with_whole_specs
from ..saying import say
from .cold_start import compile_first
from .dask_pool import Tls, run_on_cluster
from .log_check import Findings, check_log, note_of, report
from .pool import run_all
from .task import Finished, Task

FIRST_SHARE = 0.1
"""An experiment's first log goes first where its runs are at most this share of the work, so that its table is there
early. It costs little: the longest of the other runs begin a tenth of the time later at most."""

TABLES = ("table.csv", "table.tex", "consistency.csv", "honesty.csv", "convergence.csv", "paired.csv")
WRITTEN = (*TABLES, "report.html")
"""Files that `fathom run` writes into the folder of an experiment, again each time."""

LINE_EVERY_S = 10.0
"""Where there is no terminal, a line of progress comes at most this often: some twenty in a log of `make bench`."""


class Outcome(NamedTuple):
    """The result of a sweep.

    Attributes:
        rows: of the store, one per run and output, as `Store.read` returns them.
        standing: number of runs that were in the store already.
        renewed: number of runs that were there under another identity and were repeated.
        kept: by a log's name, why it did not run; its earlier rows are kept.
        made: number of runs that were made now.
    """

    rows: pd.DataFrame
    standing: int
    renewed: int
    kept: dict[str, str]
    made: int = 0


def run_experiment(
    experiment: Experiment | str | Path,
    data: Path | str | None = None,
    out: Path | str = "results",
    jobs: int = 0,
    only: str | None = None,
    repair: bool = False,
    force: bool = False,
    dask: str | None = None,
    check: bool = True,
    strict: bool = False,
    tls: Tls | None = None,
) -> pd.DataFrame:
    """Run every estimator on every log and return the rows of the store, one per run and output; see `sweep`."""
    outcome = sweep(experiment, data, out, jobs, only, repair, force, dask, check=check, strict=strict, tls=tls)
    return with_whole_specs(outcome.rows)


def sweep(
    experiment: Experiment | str | Path,
    data: Path | str | None = None,
    out: Path | str = "results",
    jobs: int = 0,
    only: str | None = None,
    repair: bool = False,
    force: bool = False,
    dask: str | None = None,
    finished_log: Callable[[pd.DataFrame], None] | None = None,
    check: bool = True,
    strict: bool = False,
    tls: Tls | None = None,
) -> Outcome:
    """Run what the store lacks, and return its rows.

    A run that is in the store under its `identity` is not run again. A run that fails, diverges, or kills its worker is
    a row that says so. Interrupted (KeyboardInterrupt), the finished runs are in the store. A run whose recording is
    missing keeps its earlier rows.

    Args:
        experiment: an experiment, a shipped one's name, or a YAML file.
        data: where recorded logs are; else FATHOM_DATA.
        out: the rows go to out/<experiment>/runs.sqlite, the trajectories beside it.
        jobs: worker processes; 0 for one per core. Not for a cluster elsewhere, which has its own workers.
        only: run only what matches this pattern: an estimator's label, a log's name, or "log/label".
        repair: let loaders drop bad rows, and count them.
        force: repeat runs that are in the store already.
        dask: address of a Dask scheduler, its scheduler file, or "local", see `dask_pool`; else worker processes here.
        finished_log: called with the rows of a log as soon as the last of its runs has ended.
        check: look for gross faults in recorded logs before anything runs. They are said on standard error, and are
            among the notes of the log's rows.
        strict: refuse to run if the check finds any.
        tls: certificates for a scheduler at a tls:// address, see `dask_pool`.

    Raises:
        ExperimentError, EstimatorError, DatasetError: nothing was run.
        StoppedError: a result could not be kept, as on a full disk, or a planned run has none at the end; the others
            are in the store.
    """
    if not isinstance(experiment, Experiment):
        experiment = Experiment.load(experiment)
    if strict and not check:
        raise ExperimentError("--strict refuses what the check finds, and --no-check leaves the check out")
    if jobs < 0:
        raise ExperimentError(f"jobs must be 0 (one per core) or more, found {jobs}")
    folder = Path(out) / experiment.name
    runs = _select(experiment, only)
    tasks, absent, duration_s, findings = _opened(
        [Task.of(experiment, run, Path(data) if data else None, repair) for run in runs], check
    )
    report(findings, strict, say)
    _make_room(folder)
    with sole_writer(folder), Store(folder / "runs.sqlite") as store:
        kept = {row["log"]: row["cause"] for row in absent if not store.write_absent(row)}
        rows = store.read()
        missing, renewed = _missing(tasks, rows, force)
        left = Counter(task.run.log.name for task in missing)
        progress = _Progress(len(missing))
        for batch in _batches(missing, duration_s):
            if dask in (None, "local"):
                compile_first(task.run.estimator.create() for task in batch)
            ended = run_all(batch, jobs) if dask is None else run_on_cluster(batch, dask, jobs, progress.say, tls)
            with progress, closing(ended):
                for each in ended:
                    progress.advance(_keep(each, store, folder))
                    log = each.rows[0]["log"]
                    left[log] -= 1
                    if finished_log is not None and left[log] == 0:
                        progress.clear()
                        finished_log(rows_of(store.read(log), runs))
        _sweep(folder / "trajectories", store)
        if missing or absent:
            rows = store.read()
        rows = rows_of(rows, runs)
        _refuse_silence(runs, rows)
        return Outcome(rows, len(tasks) - len(missing), renewed, kept, len(missing))


def _refuse_silence(runs: Sequence[Run], rows: pd.DataFrame) -> None:
    """Refuse to end as if all were well where a planned run has no row.

    Raises:
        StoppedError: names the first such run.
    """
    told = set(run_keys(rows))
    silent = [run for run in runs if run.key not in told]
    if silent:
        raise StoppedError(
            f"{len(silent)} of {len(runs)} planned runs have no result, the first is {silent[0]}; finished runs are "
            "kept, and the same command continues"
        )


def _batches(tasks: Sequence[Task], duration_s: dict[str, float]) -> list[list[Task]]:
    """Return the tasks in the order to run them, in batches; runs on one log are neighbours, so workers load it once.

    The longest logs come first, so that no worker is left alone with one at the end. But the experiment's first log is
    a batch of its own ahead of them, where it has a small share of the work; only what it needs is compiled before it.

    Args:
        tasks: in the order of the experiment.
        duration_s: length of each log, by its name.
    """

    def longest(task: Task) -> tuple[float, str, int, float]:
        return (-duration_s[task.run.log.name], task.run.log.name, task.run.seed or 0, -task.run.estimator.lag_s)

    ordered = sorted(tasks, key=longest)
    work_s: Counter[str] = Counter()
    for task in ordered:
        work_s[task.run.log.name] += duration_s[task.run.log.name]  # type: ignore[assignment]
    first = tasks[0].run.log.name if tasks else ""
    if len(work_s) < 2 or work_s[first] > FIRST_SHARE * work_s.total():
        return [ordered] if ordered else []
    return [[t for t in ordered if t.run.log.name == first], [t for t in ordered if t.run.log.name != first]]


def _keep(finished: Finished, store: Store, folder: Path) -> list[Row]:
    """Write a finished run's trajectories, then its rows, and return these."""
    try:
        store.announce(finished.files)
        store.write(finished.keep(folder))
    except ExperimentError as error:
        raise StoppedError(str(error)) from None
    return finished.rows


def _missing(tasks: Sequence[Task], rows: pd.DataFrame, force: bool) -> tuple[list[Task], int]:
    """Return the tasks that are not in the store yet, and how many of them are there under another identity."""
    final = rows.loc[rows["status"].isin(FINAL)]
    finished = set(zip(run_keys(final), final["identity"], strict=True))
    named = {key for key, _ in finished}
    missing, renewed = [], 0
    for task in tasks:
        stands = (task.run.key, task.identity) in finished
        if force or not stands:
            missing.append(task)
            renewed += task.run.key in named and not stands
    return missing, renewed


def _sweep(folder: Path, store: Store) -> None:
    """Remove the files of runs that were killed or repeated; nothing that this store did not write."""
    announced, left = store.files()
    for path in folder.iterdir():
        whole, _, process = path.name.rpartition(".")
        if path.name in left or (process.isdecimal() and whole in announced):  # the latter was killed in mid-write
            try:
                path.unlink()
            except OSError:  # it can go the next time
                left.discard(path.name)
    store.forget(left)


def _make_room(folder: Path) -> None:
    """Make the folders of the results, before anything runs.

    Raises:
        ExperimentError: they cannot be made, or something else is at a result's path: what no run here wrote is not
            written over.
    """
    if not (folder / "runs.sqlite").exists():
        for path in (*(folder / name for name in WRITTEN), *(folder / "figures").glob("*")):
            if path.exists():
                raise ExperimentError(
                    f"{path}: is there, but no runs.sqlite beside it, so no run here wrote it; move it away, or give "
                    "another --out"
                )
    for path in (folder / "trajectories", folder / "figures"):  # the lock lies in their parent
        with writing(path, "; give another --out", "made"):
            path.mkdir(parents=True, exist_ok=True)
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


def _opened(tasks: Sequence[Task], check: bool) -> tuple[list[Task], list[dict[str, Any]], dict[str, float], Findings]:
    """Open each recorded log once, so that bad input is refused before any run begins.

    Returns the tasks whose log is here, a row for each of the others, how long each log is (s), and what the check of
    each recorded log found.
    """
    findings: dict[str, Any] = {}
    duration_s: dict[str, float] = {}
    readings: dict[str, str] = {}
    missing: dict[str, str] = {}
    for task in {task.run.log.name: task for task in tasks}.values():
        spec = task.run.log
        try:
            if spec.duration_s is None:
                log = spec.open(None, task.data, task.repair)
                duration_s[spec.name], readings[spec.name] = log.duration_s, content_sha256(log)
                assert spec.log is not None
                if check and (found := check_log(log, spec.log, task.data)):
                    findings[spec.name] = found
            else:
                duration_s[spec.name] = spec.duration_s
                if (path := spec.path_sha256) is not None:
                    readings[spec.name] = path
        except RecordingNotFound as error:
            missing[spec.name] = f"not here: {error}"
    here = [
        replace(task, readings_sha256=readings.get(name), checked=tuple(map(note_of, findings.get(name, ()))))
        for task in tasks
        if (name := task.run.log.name) in duration_s
    ]
    absent = [task.row("absent", missing[task.run.log.name]) for task in tasks if task.run.log.name in missing]
    return here, absent, duration_s, findings


def rows_of(rows: pd.DataFrame, runs: Sequence[Run]) -> pd.DataFrame:
    """Return the rows of these runs, in their order: the store may hold those of earlier experiments of this name."""
    place = {run.key: k for k, run in enumerate(runs)}
    order = [place.get(key, -1) for key in run_keys(rows)]
    rows = rows.assign(order=order).query("order >= 0").sort_values("order", kind="stable")
    return rows.drop(columns="order").reset_index(drop=True)


def outdated(rows: pd.DataFrame, experiment: Experiment) -> pd.Series:
    """Return which of the rows `rows_of` gave were made with another spec or version than the present one."""
    runs = {run.key: run for run in experiment.runs()}
    versions = json.loads(provenance()["versions"])

    def is_old(key: tuple[str, str, int | None], row: Any) -> bool:
        if not isinstance(row.spec, str) or not isinstance(row.versions, str):
            return True
        spec = json.loads(row.spec) | {"seed": runs[key].seed}
        today = experiment.spec(runs[key], spec.get("repair", False))
        as_text = [json.dumps(one, sort_keys=True) for one in (spec, today)]
        return as_text[0] != as_text[1] or json.loads(row.versions) != versions

    return pd.Series(list(map(is_old, run_keys(rows), rows.itertuples())), index=rows.index, dtype=bool)


class _Progress:
    """How many runs are finished of how many, on stderr: a bar on a terminal, elsewhere a line now and then."""

    def __init__(self, total: int) -> None:
        self.done, self.total, self.line_s = 0, total, monotonic()
        self.terminal = sys.stderr.isatty()
        columns = (
            TextColumn("runs"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}", markup=False),
        )
        self.bar = Progress(
            *columns, console=Console(stderr=True), disable=not self.terminal, transient=True, redirect_stdout=False
        )
        self.task = self.bar.add_task("", total=total)

    def advance(self, rows: Sequence[Row]) -> None:
        """Count a finished run, by its rows."""
        self.done += 1
        what = f"{rows[0]['log']} / {rows[0]['label']}: {rows[0]['status']}"
        self.bar.start()  # `clear` may have stopped it
        self.bar.update(self.task, advance=1, description=what)
        if not self.terminal and self.done < self.total and monotonic() > self.line_s + LINE_EVERY_S:
            self.line_s = monotonic()
            self.say(f"{self.done} of {self.total} runs finished; the last: {what}")

    def say(self, message: str) -> None:
        """Print a message above the bar."""
        self.bar.console.print(message, markup=False, highlight=False, soft_wrap=True)

    def clear(self) -> None:
        """Take the bar away until the next run is finished, so that others can print."""
        self.bar.stop()

    def __enter__(self) -> None:
        self.bar.start()

    def __exit__(self, *_: object) -> None:
        self.bar.stop()
