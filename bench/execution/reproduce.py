"""Repeat runs of a store from their specs alone, and compare the scores bit for bit."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from ...datasets.errors import message_of
from ...estimators.registry import package_of
from ..experiment.plan import EstimatorSpec, Experiment, LogSpec
from ..metrics.floor_ratio import FLOORS
from ..metrics.scoring import INNOVATIONS, SCORES, Scoring
from ..results.identity import FINAL, content_sha256, identity
from ..results.select import Stored, facts
from ..results.store import COLUMNS, Row, provenance
from ..results.summary import Record
from .cold_start import compile_first
from .pool import run_all
from .task import Task

COMPARED = ("status", "cause", "failed_at_s", "lookahead_s", "truth_kind", "duration_s", "start")
COMPARED += (*SCORES, *FLOORS, *INNOVATIONS)
"""What must be equal when a run is repeated, besides the JSON of PARTS. Times and memory need not be."""
PARTS = ("nees_at", "nis_dof", "counts")

Value: TypeAlias = float | str | None
HashOf: TypeAlias = Callable[[str, Path | None, bool], str]
"""From a recorded log, where recordings are, and whether to repair it, to the hash of its readings."""


class CannotRunError(Exception):
    """A stored run cannot be repeated here; says why."""


@dataclass(frozen=True)
class Difference:
    """One score or fact that differs."""

    name: str
    then: Value
    now: Value

    @property
    def absolute(self) -> float | None:
        """Now less then; None where they are no numbers."""
        if isinstance(self.then, str | None) or isinstance(self.now, str | None):
            return None
        return self.now - self.then

    @property
    def relative(self) -> float:
        """|now − then| over the larger of both; infinite where they are no numbers."""
        if self.absolute is None or isinstance(self.then, str | None) or isinstance(self.now, str | None):
            return math.inf
        return abs(self.absolute) / max(abs(self.then), abs(self.now))


@dataclass(frozen=True)
class Again:
    """A stored run and its repetition.

    Attributes:
        stored: as it was.
        remarks: what has changed of the spec, the log's description or the readings, in sentences.
        differences: by output, the largest first; empty where it was not repeated.
        skipped: why it was not repeated.
        time_ratio: computing time now over then.
    """

    stored: Stored
    remarks: tuple[str, ...] = ()
    differences: Mapping[str, tuple[Difference, ...]] = field(default_factory=dict)
    skipped: str | None = None
    time_ratio: float | None = None

    @property
    def is_identical(self) -> bool:
        """Whether it was repeated, and every score of every output is the same, bit for bit."""
        return self.skipped is None and not any(self.differences.values())


# -- from the store to a task -----------------------------------------------------------------------------------------


def rebuild(stored: Stored, data: Path | None, hash_of: HashOf) -> Task:
    """Return the task that repeats a stored run, from its spec alone.

    Args:
        stored: a run of a store.
        data: where recorded logs are.
        hash_of: of a recorded log's readings, see `reproduce`.

    Raises:
        CannotRunError: it never ran, its spec is not in the store, its log is not here, or this version cannot take it.
    """
    spec, first = stored.spec, stored.first
    if first["status"] == "absent":
        raise CannotRunError(f"never ran: {first['cause']}")
    if not spec:
        raise CannotRunError("the store does not hold its spec; `fathom run` makes the row anew")
    try:
        recorded = isinstance(spec["log"], str)
        experiment = Experiment(
            name=first["experiment"],
            logs=(LogSpec(**{"log" if recorded else "scenario": spec["log"]}, name=first["log"]),),
            estimators=(EstimatorSpec(spec["estimator"]["name"], first["label"], spec["estimator"]["config"]),),
            seeds=(1 if recorded else first["seed"],),
            scores=Scoring(**spec["scores"]),
            max_gap_s=spec["max_gap_s"],
            timeout_s=spec["timeout_s"],
        )
        (run,) = experiment.runs()
        readings = hash_of(spec["log"], data, spec["repair"]) if recorded else run.log.path_sha256
    except KeyError as error:
        raise CannotRunError(f"its spec has no {error}: another version wrote it") from None
    except ValueError as error:  # of a log, an estimator, or pydantic
        raise CannotRunError(message_of(error)) from None
    return replace(Task.of(experiment, run, data, spec["repair"]), readings_sha256=readings)


def _remarks(stored: Stored, task: Task) -> Iterator[str]:
    """Yield what has changed: of the spec, of the log's description, of its readings.

    If the identity differs while spec and versions are those of the row, then the readings have changed, or the package
    that the estimator comes from.
    """
    then, now = _flat(stored.spec), _flat(json.loads(json.dumps(task.spec)))
    for key in dict.fromkeys([*then, *now]):
        if key == "log_sha256" and then.get(key) != now.get(key):
            yield f"the description of {task.run.log.log} (its log.yaml, or the catalog's entry) has changed since"
        elif key not in then:
            yield f"its spec lacks {key}; it was run with today's default, {now[key]!r}"
        elif then[key] != now.get(key):
            yield f"its spec says {key}: {then[key]!r}, which was taken for {now.get(key)!r}"
    made_by = json.loads(stored.first["versions"] or "{}")
    package = package_of(task.run.estimator.name)
    if stored.first["identity"] not in (None, identity(stored.spec, package, task.readings_sha256, made_by)):
        which = "the readings" if task.readings_sha256 else "its spec or versions, as the store has them,"
        which += f" or the version of {package.rpartition(' ')[0]}, now {package}," if package else ""
        yield f"{which} must have changed: the identity differs"


def _flat(value: Any, path: str = "") -> dict[str, Any]:
    """Return nested values by dotted path; an item of a list by its number."""
    if isinstance(value, list):
        value = dict(enumerate(value))
    if isinstance(value, Mapping):
        return {k: v for key, item in value.items() for k, v in _flat(item, f"{path}.{key}".lstrip(".")).items()}
    return {path: value}


# -- then and now -----------------------------------------------------------------------------------------------------


def reproduce_all(runs: Sequence[Stored], data: Path | str | None = None, jobs: int = 0) -> tuple[list[Again], bool]:
    """Repeat stored runs with a progress bar, and return how they compare, and whether all were repeated.

    Interrupted (KeyboardInterrupt), it returns those that are finished.
    """
    from rich.console import Console
    from rich.progress import track

    found: list[Again] = []
    seen = reproduce(runs, data, jobs)
    try:
        with closing(seen):
            bar = Console(stderr=True)
            found.extend(track(seen, "runs", len(runs), console=bar, disable=not sys.stderr.isatty()))
    except KeyboardInterrupt:
        return found, False
    return found, True


def reproduce(runs: Sequence[Stored], data: Path | str | None = None, jobs: int = 0) -> Generator[Again]:
    """Repeat stored runs in worker processes, and yield how each compares; nothing is stored.

    First come those that cannot be repeated here, then the others, as they end.

    Args:
        runs: as `choose` returns them.
        data: where recorded logs are; else FATHOM_DATA.
        jobs: worker processes; 0 for one per core.
    """
    hash_of = cache(_readings_sha256)
    tasks, waiting = [], {}
    for stored in runs:
        try:
            task = rebuild(stored, Path(data) if data else None, hash_of)
        except CannotRunError as error:
            yield Again(stored, skipped=str(error))
            continue
        waiting[stored.name] = stored, tuple(_remarks(stored, task))
        tasks.append(task)
    compile_first(task.run.estimator.create() for task in tasks)
    with closing(run_all(tasks, jobs)) as finished:
        for each in finished:
            done = Stored(tuple(map(_as_stored, each.rows)))
            stored, remarks = waiting.pop(done.name)
            yield compare(stored, done, remarks)


def _readings_sha256(log: str, data: Path | None, repair: bool) -> str:
    return content_sha256(LogSpec(log, log=log).open(None, data, repair))


def _as_stored(row: Row) -> Record:
    """Return a row as a store returns it: NaN is None."""
    return {
        name: None if isinstance(row.get(name), float) and math.isnan(row[name]) else row.get(name) for name in COLUMNS
    }


def compare(stored: Stored, done: Stored, remarks: tuple[str, ...] = ()) -> Again:
    """Compare a repeated run with the stored one."""
    then, now = ({row["output"]: _outcome(row) for row in run.rows} for run in (stored, done))
    outputs = dict.fromkeys([*then, *now])
    differences = {output: _differences(then.get(output, {}), now.get(output, {})) for output in outputs}
    before_s, after_s = stored.first["total_s"], done.first["total_s"]
    return Again(stored, remarks, differences, time_ratio=after_s / before_s if before_s and after_s else None)


def _differences(then: Mapping[str, Value], now: Mapping[str, Value]) -> tuple[Difference, ...]:
    """Return what differs, the largest first."""
    every = [Difference(name, then.get(name), now.get(name)) for name in dict.fromkeys([*then, *now])]
    return tuple(sorted((each for each in every if each.then != each.now), key=lambda each: -each.relative))


def _outcome(row: Record) -> dict[str, Value]:
    """Return the part of a row that spec, readings, versions and kind of machine determine.

    A run that was out of time was ended by the clock, so only its status and cause can be equal.
    """
    if row["status"] not in FINAL and (row["cause"] or "").startswith("out of time"):
        return {name: row[name] for name in ("status", "cause")}
    outcome = {name: row[name] for name in COMPARED}
    for part in PARTS:
        outcome |= _flat(json.loads(row[part] or "{}"), part)
    return outcome


def changed_facts(stored: Stored) -> list[Difference]:
    """Return which of commit, code, versions and machine differ from today's."""
    then, today = stored.made_by, facts(provenance())
    return [Difference(name, then.get(name), today[name]) for name in today if then.get(name) != today[name]]
