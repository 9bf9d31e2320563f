"""The runs on the page: how each ended, its spec, machine and versions."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

from ...metrics.floor_ratio import FLOORS
from ...metrics.scoring import COSTS, INNOVATIONS, SCORES
from ...results.summary import UNFINISHED, Record, groups
from ..cells import ABSENT, ACCURACY, Cell, against, cell, output_and_lag, spans
from ..remarks import NO_CAUSE
from ..sheets import Line, Sheet

ALL_SCORES = (*SCORES, *FLOORS, *INNOVATIONS, *COSTS)
ENDS = ("done", *UNFINISHED)
PLACE = ("commit_id", "versions", "machine")
ABOUT = ("seed", "identity", "estimator", "cause", "failed_at_s", "start", "started", "finished", "trajectory")
SHOWN_OF_IDENTITY = 8
"""Letters of a run's identity that a table shows: enough to tell millions of runs apart."""
EXACT = 2000
"""With more rows the page holds six digits of each score: all 17 would be most of its size."""
BLOCK = 500
"""Rows that are unpacked together, where one of them is opened: some milliseconds."""
MOST_CAUSES = 200
"""Of runs that did not finish: more are too many to look through."""


def each_run(rows: Sequence[Record]) -> list[Record]:
    """Return one row per run, of those of its outputs."""
    return [row for row, *_ in groups(rows, "log", "label", "seed").values()]


def facts(rows: Sequence[Record]) -> list[tuple[str, str]]:
    """Return the facts below the title: how many runs ended how, on which logs and seeds, scored how."""
    runs = each_run(rows)
    ends = {end: sum(row["status"] == end for row in runs) for end in ENDS}
    counts = [f"{count} {end}" for end, count in ends.items() if count or end == "done"]
    seeds = sorted({int(row["seed"]) for row in runs if row["seed"] is not None})
    scored = [row for row in rows if row["truth_kind"] is not None]
    logs, labels = groups(runs, "log"), groups(runs, "label")
    found = [
        ("runs", f"{len(runs)}: {', '.join(counts)}"),
        ("logs", str(len(logs)) if len(logs) > 1 else next(iter(logs))[0]),
        ("estimators", str(len(labels))),
        ("seeds", spans(seeds) or "none: recorded logs only"),
        ("alignment", ", ".join(dict.fromkeys(str(row["align"]) for row in scored)) or "no ground truth"),
    ]
    return [*found, ("against", _against(scored) or ABSENT)]


def _against(scored: Sequence[Record]) -> str:
    """Return what errors are taken against; where it is not the same for all logs, on how many logs which."""
    kinds = groups(scored, "truth_kind")
    if len(kinds) == 1:
        return against(next(iter(kinds))[0])
    logs = {kind: len(groups(of, "log")) for (kind,), of in kinds.items()}
    return "; ".join(f"{against(kind)}: {n} log{'s' if n > 1 else ''}" for kind, n in logs.items())


def failures(rows: Sequence[Record]) -> Sheet | None:
    """Return the runs that did not finish, each cause once; None where all did."""
    lost = [row for row in each_run(rows) if row["status"] != "done"]
    if not lost:
        return None
    lines = []
    for (log, label, status, cause), of in groups(lost, "log", "label", "status", "cause").items():
        seeds = sorted(int(row["seed"]) for row in of if row["seed"] is not None)
        times = sorted(row["failed_at_s"] for row in of if row["failed_at_s"] is not None)
        when = " to ".join(dict.fromkeys(f"{t:.1f}" for t in times[:: max(len(times) - 1, 1)])) or ABSENT
        cells = [
            Cell(label, label),
            Cell(spans(seeds) or ABSENT, seeds[0] if seeds else None),
            Cell(str(status), str(status)),
            Cell(when, times[0] if times else None),
            Cell(cause or NO_CAUSE, cause),
        ]
        lines.append(Line(log, cells))
    hidden = len(lines) - MOST_CAUSES
    note = [f"and {hidden} more; the table of runs has them all"] if hidden > 0 else []
    headings = ["log", "estimator", "seeds", "status", "at, s", "cause"]
    return Sheet("By log, estimator and cause", note, headings, lines[:MOST_CAUSES])


def environments(rows: Sequence[Record]) -> list[dict[str, Any]]:
    """Return by which commit, versions and machine runs were made, and how many."""
    return [
        {
            "runs": len(of),
            "commit": commit or "not recorded",
            "versions": _loads(versions),
            "machine": _loads(machine),
            "first": min((row["finished"] for row in of if row["finished"]), default=ABSENT),
            "last": max((row["finished"] for row in of if row["finished"]), default=ABSENT),
        }
        for (commit, versions, machine), of in groups(each_run(rows), *PLACE).items()
    ]


def details(rows: Sequence[Record]) -> tuple[dict[str, Any], Iterator[list[Record]]]:
    """Return what the page's script opens under each row: what many rows share, and the rows in blocks.

    Specs (without the seed) and places are there once.
    """
    specs: dict[str, int] = {}
    places: dict[tuple[Any, ...], int] = {}
    of_spec = {text: specs.setdefault(_seedless(text), len(specs)) for text in {row["spec"]: None for row in rows}}
    for row in rows:
        places.setdefault(tuple(row[name] for name in PLACE), len(places))
    common = {
        "block": BLOCK,
        "scores": ALL_SCORES,
        "specs": [json.loads(text) for text in specs],
        "places": [
            {"commit": commit, "versions": _loads(versions), "machine": _loads(machine)}
            for commit, versions, machine in places
        ],
    }
    write = str if len(rows) <= EXACT else "{:.6g}".format

    def detail(row: Record) -> Record:
        return {
            "spec": of_spec[row["spec"]],
            "place": places[tuple(row[name] for name in PLACE)],
            **{name: row[name] for name in ABOUT},
            "counts": _loads(row["counts"]),
            "notes": _loads(row["notes"]),
            "scores": [None if row[name] is None else write(row[name]) for name in ALL_SCORES],
        }

    return common, ([detail(row) for row in rows[k : k + BLOCK]] for k in range(0, len(rows), BLOCK))


def table(rows: Sequence[Record]) -> tuple[dict[str, Any], list[str]]:
    """Return the table of all runs, column by column as the page's script reads it, and why numbers are missing in it.

    Names stand there once; `why` of a score is a place among the reasons, 0 where there is a number.
    """
    lines = {
        key: Line("", [], output_and_lag(*key[1:]), lookahead_s=key[2], section=key[0])
        for (key,) in groups(({"key": _group(row)} for row in rows), "key")
    }
    named = Sheet("", [], [], list(lines.values()), "log").by_output()
    group_of = {id(line): k for k, of in enumerate(named.values()) for line in of}
    labels, statuses, whys = _Places(), _Places(), _Places()
    whys[""]
    scores = []
    for column in ACCURACY:
        cells = [cell(column.score, row) for row in rows]
        values = [each.value for each in cells]
        scores.append(
            {
                "text": [each.text for each in cells],
                "value": values if len(rows) <= EXACT else [v if v is None else float(f"{v:.6g}") for v in values],
                "why": [whys[each.why] for each in cells],
            }
        )
    content = {
        "groups": list(named),
        "group": [group_of[id(lines[_group(row)])] for row in rows],
        "label": [labels[row["label"]] for row in rows],
        "seed": [None if row["seed"] is None else int(row["seed"]) for row in rows],
        "status": [statuses[row["status"] or ABSENT] for row in rows],
        "scores": scores,
        "identity": [(row["identity"] or ABSENT)[:SHOWN_OF_IDENTITY] for row in rows],
    }
    return content | {"labels": list(labels), "statuses": list(statuses), "whys": list(whys)}, list(whys)[1:]


class _Places(dict[str, int]):
    """The place of each text among those that were asked for, in the order of first appearance."""

    def __missing__(self, text: str) -> int:
        self[text] = len(self)
        return self[text]


def _group(row: Record) -> tuple[str, str, float | None]:
    return row["log"], row["output"], row["lookahead_s"]


def heading(rows: int, whys: Sequence[str]) -> Sheet:
    """Return the table of all runs without its lines, which the page's script makes."""
    note = ["one by one, not pooled; a row opens to its spec, its counts and where it was made"]
    if rows > EXACT:
        note.append("of so many rows, scores have six digits; runs.sqlite has all")
    note += [f"{ABSENT}: {'; '.join(whys)}"] if whys else []
    headings = ["estimator", "seed", "status", *(each.heading for each in ACCURACY), "identity"]
    return Sheet("Every run", note, headings, [], "log")


@lru_cache(maxsize=1000)
def _loads(text: str | None) -> Any:
    """Return what a JSON column holds; an empty dict for none, and the text itself where it is no JSON."""
    try:
        return json.loads(text) if text else {}
    except ValueError:
        return {"unreadable": text}


def _seedless(text: str | None) -> str:
    spec = _loads(text)
    return json.dumps({key: value for key, value in spec.items() if key != "seed"} if isinstance(spec, dict) else spec)
