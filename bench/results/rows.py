"""The rows of a store: their columns, and how they are read; one that cannot be read is a failed run and says so."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeAlias

import pandas as pd

from ...datasets.notes import KINDS
from ..metrics.floor_ratio import FLOORS
from ..metrics.scoring import COSTS, INNOVATIONS, SCORES
from .step_time import EDGES_NS

Row: TypeAlias = Mapping[str, Any]

NAMES = {"experiment": "TEXT", "log": "TEXT", "label": "TEXT", "seed": "INTEGER", "output": "TEXT"}
"""Columns that name a row: seed is NULL for a recorded log; output is "online" or "smoothed"."""

OUTCOME = {
    "status": "TEXT",  # one of STATUSES
    "cause": "TEXT",
    "traceback": "TEXT",  # of the error that ended the run
    "failed_at_s": "REAL",
    "lookahead_s": "REAL",
    "truth_kind": "TEXT",
    "align": "TEXT",
    "dims": "TEXT",
    "duration_s": "REAL",
    "start": "TEXT",  # where the prior came from: "given", "static", "moving", ...
}
HONESTY = {
    "nees_at": "TEXT",  # JSON: NEES by block at times fixed beforehand, see `consistency.nees_at`
    "nis_dof": "TEXT",  # JSON: degrees of freedom of each sensor's NIS
}
TIMES = {
    "step_histogram": "TEXT",  # JSON: how many steps took how long, see `step_time.step_histogram`
}
ORIGIN = {
    "identity": "TEXT",  # see `identity`
    "estimator": "TEXT",
    "spec": "TEXT",  # JSON
    "counts": "TEXT",  # JSON
    "notes": "TEXT",  # JSON: a list, see `datasets.notes.as_data`
    "missing": "TEXT",  # JSON: why scores are not there, {reason: [score, ...]}
    "trajectory": "TEXT",  # file under trajectories/
    "truth_trajectory": "TEXT",  # likewise, at the same times
    "started": "TEXT",
    "finished": "TEXT",
    "commit_id": "TEXT",
    "versions": "TEXT",  # JSON
    "machine": "TEXT",  # JSON
}
COLUMNS = NAMES | OUTCOME | dict.fromkeys([*SCORES, *FLOORS, *INNOVATIONS, *COSTS], "REAL") | HONESTY | TIMES | ORIGIN
STATUSES = ("done", "diverged", "failed", "absent")
TYPES: dict[str, frozenset[type]] = {
    "TEXT": frozenset({str, type(None)}),
    "REAL": frozenset({float, type(None)}),
    "INTEGER": frozenset({int, type(None)}),
}
"""What the values of a column may be. SQLite itself takes any value in any column."""


class OtherColumnsError(sqlite3.DatabaseError):
    """The table `runs` is not of this version; says what to do."""


def check_columns(connection: sqlite3.Connection) -> None:
    """Raise OtherColumnsError where the table has other columns, and DatabaseError where there is no table."""
    there = {row[1] for row in connection.execute("PRAGMA table_info(runs)")}
    if not there:
        raise sqlite3.DatabaseError("no table `runs` in it")
    for what, names in (("lacks", COLUMNS.keys() - there), ("has an unknown", there - COLUMNS.keys())):
        if names:
            raise OtherColumnsError(
                f"another version wrote it: it {what} column {min(names)}; read it with that version, or move it away "
                "and run the experiment again"
            )


def read_rows(connection: sqlite3.Connection, log: str | None = None) -> pd.DataFrame:
    """Return the rows of an open store, or those of one log.

    A row that cannot be read (it is damaged, or another version wrote its texts) is a failed run without scores, whose
    cause names the column. The specs of an estimator's seeds are one text, without the seed, which `whole_spec` puts
    back: as texts of their own they would be most of the memory.
    """
    check_columns(connection)
    chosen = "" if log is None else "WHERE log IS :log"
    query = f"SELECT {', '.join(COLUMNS)} FROM runs {chosen} ORDER BY rowid"
    texts: dict[str, str] = {}  # most texts are the same in many rows
    connection.text_factory = lambda text: text.decode("utf-8", "replace")
    columns: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    try:
        for row in connection.execute(query, {"log": log}):
            for (name, column), value in zip(columns.items(), row, strict=True):
                if name == "spec":
                    value = _without_seed(value, columns["seed"][-1])
                column.append(texts.setdefault(value, value) if isinstance(value, str) else value)
    finally:
        connection.text_factory = str
    del texts
    _replace_unreadable(columns)
    kinds = {"TEXT": "object", "REAL": "float64", "INTEGER": "Int64"}
    return pd.DataFrame({name: pd.Series(columns.pop(name), dtype=kinds[kind]) for name, kind in COLUMNS.items()})


def _without_seed(spec: Any, seed: Any) -> Any:
    part = f'"seed": {seed}, '
    return spec.replace(part, "") if isinstance(spec, str) and spec.count(part) == 1 else spec


def whole_spec(spec: str | None, seed: int | None) -> str | None:
    """Return the spec of a row of `read_rows` with its seed, as JSON; None where the row has no spec."""
    if not spec or spec == "{}":
        return spec
    return json.dumps({"seed": seed} | json.loads(spec))  # a spec of another seed keeps it


def run_keys(rows: pd.DataFrame) -> list[tuple[str, str, int | None]]:
    """Return log, label and seed of each row, as `Run.key` has them; the seed is None for a recorded log."""
    seeds = rows["seed"].astype(object).where(rows["seed"].notna(), None)
    return list(zip(rows["log"], rows["label"], seeds, strict=True))


# -- rows that cannot be read -----------------------------------------------------------------------------------------


def _replace_unreadable(columns: dict[str, list[Any]]) -> None:
    """Make a failed run of every row that holds what no row may hold; `columns` are changed in place."""
    for place, why in _unreadable(columns).items():
        kept = {name: columns[name][place] for name in NAMES}
        names = {name: value if type(value) in TYPES[NAMES[name]] else None for name, value in kept.items()}
        identity = columns["identity"][place]
        for name, values in columns.items():
            values[place] = None if name not in NAMES or name == "seed" else names[name] or "unreadable"
        columns["seed"][place] = names["seed"]
        columns["identity"][place] = identity if isinstance(identity, str) else None
        columns["status"][place] = "failed"
        columns["cause"][place] = f"its row in the store cannot be read: {why}; `fathom run` repeats the run"


def _unreadable(columns: Mapping[str, list[Any]]) -> dict[int, str]:
    """Return which rows cannot be read, and why."""
    found: dict[int, str] = {}
    for name, kind in COLUMNS.items():
        if not set(map(type, columns[name])) <= TYPES[kind]:
            wrong = (k for k, value in enumerate(columns[name]) if type(value) not in TYPES[kind])
            found |= {k: f"{name} is no {kind}" for k in wrong if k not in found}
    for name, allowed in {**dict.fromkeys(("experiment", "log", "label", "output")), "status": STATUSES}.items():
        for k, value in enumerate(columns[name]):
            if value is None or (allowed is not None and value not in allowed):
                found.setdefault(k, f"{name} is {value!r:.40}")
    for name, is_right in PARTS.items():
        wrong_texts = _texts_that_are_not(columns[name], is_right)
        if wrong_texts:
            wrong = (k for k, value in enumerate(columns[name]) if value in wrong_texts)
            found |= {k: f"{name} is not what this version writes there" for k in wrong if k not in found}
    return found


def _texts_that_are_not(values: Collection[Any], is_right: Callable[[Any], bool]) -> set[str]:
    """Return which of these texts are no JSON, or not of the right shape; None and other values are passed over."""
    wrong = set()
    for text in {value for value in values if isinstance(value, str)}:
        try:
            right = is_right(json.loads(text))
        except (ValueError, RecursionError):
            right = False
        if not right:
            wrong.add(text)
    return wrong


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def _has_counts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_number, value.values()))


def _has_scores(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("scores", {}), dict)


def _has_notes(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_note, value))


def _is_note(value: Any) -> bool:
    numbers = ("count", "of", "share", "seconds")
    return (
        isinstance(value, dict)
        and value.get("kind") in KINDS
        and all(isinstance(value.get(name, ""), str) for name in ("text", "stream"))
        and all(_is_number(value[name]) for name in numbers if name in value)
        and "text" in value
    )


def _has_reasons(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in value.values()
    )


def _is_mapping(value: Any) -> bool:
    return isinstance(value, dict)


def _has_histogram(value: Any) -> bool:
    return _has_counts(value) and all(k.isdecimal() and int(k) < len(EDGES_NS) - 1 for k in value)


def _has_nees(value: Any) -> bool:
    if value == {}:
        return True
    if not (isinstance(value, dict) and all(isinstance(each, list) for each in value.values()) and "t_s" in value):
        return False
    numbers = all(x is None or _is_number(x) for each in value.values() for x in each)
    return numbers and len({len(each) for each in value.values()}) == 1


PARTS: dict[str, Callable[[Any], bool]] = {
    "nees_at": _has_nees,
    "nis_dof": _has_counts,
    "step_histogram": _has_histogram,
    "spec": _has_scores,
    "counts": _has_counts,
    "notes": _has_notes,
    "missing": _has_reasons,
    "versions": _is_mapping,
    "machine": _is_mapping,
}
"""Columns that hold JSON, and what is right in them."""
