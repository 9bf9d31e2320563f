"""Run again what a store holds, from the store alone, and compare bit for bit."""

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
"""What two runs of the same must have in common; and all within the JSON of PARTS. Times and memory are not there."""
PARTS = ("nees_at", "nis_dof", "counts")

Value: TypeAlias = float | str | None
HashOf: TypeAlias = Callable[[str, Path | None, bool], str]
"""From a recorded log, where recordings are, and whether to repair it, to the hash of its readings."""


class CannotRunError(Exception):
    """A stored run cannot be made again here; says why."""


@dataclass(frozen=True)
class Difference:
    """One score or fact that did not come out again."""

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
    """A stored run, and what became of it when it was run again.

    Attributes:
        stored: as it was.
        remarks: what of the spec, the log's description or the readings is not as it was, in sentences.
        differences: by output, the largest first; no output at all where it was not run.
        skipped: why it was not run.
        time_ratio: computing time, now over then.
    """

    stored: Stored
    remarks: tuple[str, ...] = ()
    differences: Mapping[str, tuple[Difference, ...]] = field(default_factory=dict)
    skipped: str | None = None
    time_ratio: float | None = None

    @property
    def is_identical(self) -> bool:
        """Whether it was run, and every score of every output came out the same, bit for bit."""
        return self.skipped is None and not any(self.differences.values())


# -- from the store to a task -----------------------------------------------------------------------------------------


def rebuild(stored: Stored, data: Path | None, hash_of: HashOf) -> Task:
    """Return the task that makes a stored run again, from its spec alone.

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
        raise CannotRunError(" ".join(str(error).split())) from None
    return replace(Task.of(experiment, run, data, spec["repair"]), readings_sha256=readings)


def _remarks(stored: Stored, task: Task) -> Iterator[str]:
    """Yield what is not as it was: of the spec, of the log's description, of its readings.

    The spec and the versions being those of the row, an identity that is not can only come from the readings, or from
    the package that brings the estimator.
    """
    then, now = _flat(stored.spec), _flat(json.loads(json.dumps(task.spec)))
    for key in dict.fromkeys([*then, *now]):
        if key == "log_sha256" and then.get(key) != now.get(key):
            yield f"the description of {task.run.log.log} (its log.yaml, or the catalog's entry) has changed since"
        elif key not in then:
            yield f"its spec does not tell {key}; it was run with today's default, {now[key]!r}"
        elif then[key] != now.get(key):
            yield f"its spec says {key}: {then[key]!r}, which was taken for {now.get(key)!r}"
    made_by = json.loads(stored.first["versions"] or "{}")
    if stored.first["identity"] not in (None, identity(stored.spec, task.readings_sha256, made_by)):
        package = package_of(task.run.estimator.name)
        which = "the readings" if task.readings_sha256 else "its spec or versions, as the store has them,"
        which += f" or the version of {package.rpartition(' ')[0]}, now {package}," if package else ""
        yield f"{which} cannot be what it was made from: its identity is another"


def _flat(value: Any, path: str = "") -> dict[str, Any]:
    """Return nested values by dotted path; an item of a list by its number."""
    if isinstance(value, list):
        value = dict(enumerate(value))
    if isinstance(value, Mapping):
        return {k: v for key, item in value.items() for k, v in _flat(item, f"{path}.{key}".lstrip(".")).items()}
    return {path: value}


# -- then and now -----------------------------------------------------------------------------------------------------


def reproduce_all(runs: Sequence[Stored], data: Path | str | None = None, jobs: int = 0) -> tuple[list[Again], bool]:
    """Return what became of stored runs, and whether it is all of them; a progress bar stands on a terminal meanwhile.

    Interrupted (KeyboardInterrupt), it returns what is known so far.
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
    """Run stored runs again in worker processes, and yield what became of each; nothing is kept.

    First come those that cannot be run here, then the others, as they end.

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
    """Return a row as a store would give it back: NaN is nothing."""
    return {
        name: None if isinstance(row.get(name), float) and math.isnan(row[name]) else row.get(name) for name in COLUMNS
    }


def compare(stored: Stored, done: Stored, remarks: tuple[str, ...] = ()) -> Again:
    """Return how a run compares with the same run before."""
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
    """Return all of a row that its spec, readings, versions and kind of machine determine.

    A run that was out of time ended by the clock: no more than that it did can come out again.
    """
    if row["status"] not in FINAL and (row["cause"] or "").startswith("out of time"):
        return {name: row[name] for name in ("status", "cause")}
    outcome = {name: row[name] for name in COMPARED}
    for part in PARTS:
        outcome |= _flat(json.loads(row[part] or "{}"), part)
    return outcome


def changed_facts(stored: Stored) -> list[Difference]:
    """Return what of commit, code, versions and machine is not today's."""
    then, today = stored.made_by, facts(provenance())
    return [Difference(name, then.get(name), today[name]) for name in today if then.get(name) != today[name]]
