"""The runs on the page: how each ended, its spec, machine and versions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from ...metrics.floor_ratio import FLOORS
from ...metrics.scoring import COSTS, INNOVATIONS, SCORES
from ...results.summary import UNFINISHED, Record, groups
from ..cells import ABSENT, Cell, against, spans
from ..sheets import Line, Sheet

ALL_SCORES = (*SCORES, *FLOORS, *INNOVATIONS, *COSTS)
ENDS = ("done", *UNFINISHED)


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
            Cell(cause or "no cause is recorded", cause),
        ]
        lines.append(Line(log, cells))
    return Sheet("By log, estimator and cause", [], ["log", "estimator", "seeds", "status", "at, s", "cause"], lines)


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


PLACE = ("commit_id", "versions", "machine")


def details(rows: Sequence[Record]) -> dict[str, Any]:
    """Return what the page's script opens under each row; specs (without the seed) and places are there once."""
    specs: dict[str, int] = {}
    places: dict[tuple[Any, ...], int] = {}
    each = []
    for row in rows:
        spec = _loads(row["spec"])
        spec.pop("seed", None)
        text = json.dumps(spec)
        place = tuple(row[name] for name in PLACE)
        each.append(
            {
                "spec": specs.setdefault(text, len(specs)),
                "place": places.setdefault(place, len(places)),
                "seed": row["seed"],
                "identity": row["identity"],
                "estimator": row["estimator"],
                "cause": row["cause"],
                "failed_at_s": row["failed_at_s"],
                "start": row["start"],
                "started": row["started"],
                "finished": row["finished"],
                "trajectory": row["trajectory"],
                "counts": _loads(row["counts"]),
                "notes": _loads(row["notes"]),
                "scores": [None if row[name] is None else str(row[name]) for name in ALL_SCORES],
            }
        )
    return {
        "scores": ALL_SCORES,
        "specs": [json.loads(text) for text in specs],
        "places": [
            {"commit": commit, "versions": _loads(versions), "machine": _loads(machine)}
            for commit, versions, machine in places
        ],
        "runs": each,
    }


def _loads(text: str | None) -> Any:
    """Return what a JSON column holds; an empty dict for none, and the text itself where it is no JSON."""
    try:
        return json.loads(text) if text else {}
    except ValueError:
        return {"unreadable": text}
