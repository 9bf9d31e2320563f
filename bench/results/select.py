"""Selection of the runs of a store by log, label, seed or identity."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

from ...datasets.errors import nearest
from ..errors import ExperimentError
from .machine import DECIDES
from .rows import whole_spec
from .store import load_runs
from .summary import Record, groups, records

SHORTEST_HASH = 4
"""How many letters of an identity name a run."""


@dataclass(frozen=True)
class Stored:
    """One run of a store.

    Attributes:
        rows: one per output.
    """

    rows: tuple[Record, ...]

    @property
    def first(self) -> Record:
        """The first row; columns of the run are the same in all."""
        return self.rows[0]

    @property
    def name(self) -> str:
        """ "log/label/seed", or "log/label" of a recorded log."""
        return f"{self.group}/{self.first['seed']}" if self.first["seed"] is not None else self.group

    @property
    def group(self) -> str:
        """ "log/label": the same for every seed."""
        return f"{self.first['log']}/{self.first['label']}"

    @cached_property
    def spec(self) -> dict[str, Any]:
        """Everything that the run's numbers depend on, except readings and versions."""
        return json.loads(whole_spec(self.first["spec"], self.first["seed"]) or "{}")

    @cached_property
    def made_by(self) -> dict[str, Any]:
        """Commit, code, versions and machine, as `facts` gives them."""
        return facts(self.first)


def facts(origin: Mapping[str, str]) -> dict[str, Any]:
    """Return commit, code, versions, and what decides of the machine, from a row or `provenance`; {fact: value}."""
    of_machine = json.loads(origin["machine"] or "{}")
    return {
        "commit": origin["commit_id"],
        **json.loads(origin["versions"] or "{}"),
        **{name.replace("_", " "): of_machine.get(name) for name in DECIDES},
    }


def choose(folder: Path, row: str | None = None) -> list[Stored]:
    """Return the runs of a store: all, or those that `row` names.

    Args:
        folder: holds runs.sqlite.
        row: "log/label" or "log/label/seed"; a pattern of one of these, of a log or of a label; or the first letters
            of a run's identity.

    Raises:
        ExperimentError: no store, an empty one, or nothing of that name; or letters that several runs begin with.
    """
    by_name = groups(records(load_runs(folder, shared_specs=True)), "log", "label", "seed")
    runs = [Stored(tuple(rows)) for rows in by_name.values()]
    if not runs:
        raise ExperimentError(f"{folder}: no runs in it yet; `fathom run` makes them")
    if row is None:
        return runs

    def names(run: Stored) -> tuple[str, ...]:
        return run.first["log"], run.first["label"], run.group, run.name

    chosen = [run for run in runs if row in (run.group, run.name)]
    chosen = chosen or [run for run in runs if any(fnmatchcase(name, row) for name in names(run))]
    if not chosen and len(row) >= SHORTEST_HASH:
        chosen = [run for run in runs if (run.first["identity"] or "").startswith(row.lower())]
        if len({run.first["identity"] for run in chosen}) > 1:
            candidates = ", ".join(f"{run.first['identity'][: len(row) + 4]} {run.name}" for run in chosen)
            raise ExperimentError(f"{row}: several runs begin so: {candidates}")
    if not chosen:
        known = list(dict.fromkeys(name for run in runs for name in names(run)))
        every = ", ".join(dict.fromkeys(run.group for run in runs))
        raise ExperimentError(
            f"{row}: no such row in {folder}{nearest(row, known)}; expected log/label, log/label/seed, a pattern, "
            f"or {SHORTEST_HASH} letters of an identity; there are: {every}"
        )
    return chosen
