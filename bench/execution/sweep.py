"""Run an experiment: what is missing in the store, the longest first, and every finished run in the store at once."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ...datasets.described.opening import RecordingNotFound
from ..errors import ExperimentError
from ..experiment.plan import Experiment, Run
from ..results.identity import content_sha256
from ..results.store import Row, Store, provenance, sole_writer
from .cold_start import compile_first
from .dask_pool import run_on_cluster
from .pool import run_all
from .task import Task


class Outcome(NamedTuple):
    """What a sweep left in the store.

    Attributes:
        rows: of the store, one per run and output.
        standing: how many runs were in the store already.
        renewed: how many stood there under another identity and were run anew.
        kept: why a log did not run whose rows of an earlier day are kept.
    """

    rows: pd.DataFrame
    standing: int
    renewed: int
    kept: dict[str, str]


def run_experiment(
    experiment: Experiment | str | Path,
    data: Path | str | None = None,
    out: Path | str = "results",
    jobs: int = 0,
    only: str | None = None,
    repair: bool = False,
    force: bool = False,
    dask: str | None = None,
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
        jobs: worker processes; 0 for one per core. The workers of a cluster elsewhere are its own affair.
        only: run only what matches this pattern: an estimator's label, a log's name, or "log/label".
        repair: let loaders drop bad rows, and count them.
        force: run what is in the store already, too.
        dask: address of a Dask scheduler, its scheduler file, or "local", see `cluster`; else worker processes here.

    Raises:
        ExperimentError, EstimatorError, DatasetError: nothing was run.
    """
    if not isinstance(experiment, Experiment):
        experiment = Experiment.load(experiment)
    if jobs < 0:
        raise ExperimentError(f"jobs must be 0 (one per core) or more, found {jobs}")
    folder = Path(out) / experiment.name
    runs = _select(experiment, only)
    tasks, absent = _order([Task.of(experiment, run, Path(data) if data else None, repair) for run in runs])
    _make_room(folder)
    with sole_writer(folder), Store(folder / "runs.sqlite") as store:
        kept = {row["log"]: row["cause"] for row in absent if not store.write_absent(row)}
        missing, renewed = _missing(tasks, store, force)
        if dask in (None, "local"):
            compile_first(task.run.estimator.create() for task in missing)
        with (
            _progress(len(missing), len(tasks) - len(missing)) as (advance, say),
            closing(run_all(missing, jobs) if dask is None else run_on_cluster(missing, dask, jobs, say)) as finished,
        ):
            for each in finished:
                rows = each.keep(folder)
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
        return (-duration_s[task.run.log.name], task.run.log.name, task.run.seed or 0, -task.run.estimator.lag_s)

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


@contextmanager
def _progress(missing: int, standing: int) -> Iterator[tuple[Callable[[Sequence[Row]], None], Callable[[str], None]]]:
    """Give functions to call with each finished run's rows, and with a message; the bar is for terminals only."""
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

        def say(message: str) -> None:
            bar.console.print(message, markup=False, highlight=False, soft_wrap=True)

        yield advance, say
