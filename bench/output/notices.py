"""What the runs noticed of their logs and readings, by log and kind, the worst first: a table, sentences, lines."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from textwrap import shorten
from typing import Any

from ...datasets.notes import KINDS
from ..results.summary import Record, groups
from .cells import ABSENT, Cell, text
from .sheets import Line, Sheet, listed

WORDS = {
    "damage": "damage",
    "check": "check",
    "silent": "silent",
    "dropped": "left out on reading",
    "repaired": "changed on reading",
    "start": "start",
    "overclaims": "claims more than it knows",
    "height": "height",
    "earth": "the Earth's rotation",
    "gap": "IMU gaps bridged",
    "outside": "outside the IMU's time",
    "late_dropped": "late and dropped",
    "gated": "gated, or given less weight",
    "late": "late",
    "merged": "merged",
    "carried": "carried by the IMU",
    "void": "measuring nothing",
}
"""What lines and tables call each kind of note, the worst first."""
assert list(WORDS) == [kind for kind in KINDS if kind != "about"]
PLACES = {kind: place for place, kind in enumerate(WORDS)}
ROUTINE = ("outside", "late", "merged", "carried", "void")
"""Kinds that are no fault of a log; the terminal has one line for each, of the log where it is most."""
IN_WORDS = ("damage", "check", "silent", "repaired", "start", "overclaims", "height", "earth")
"""Kinds whose sentences say more than a number."""
TEXT_LETTERS = 150
"""Of a note's sentence in a line: two lines of a terminal of 80 columns."""
MOST_TEXTS = 5
"""Different sentences that a cell of the report holds; a run's row has them all."""
LEAST_SHARE = 1e-3
"""Shown as a number: of less it is enough to know that it is little."""


@dataclass(frozen=True)
class Notice:
    """One kind of note on one log, over all its runs.

    Attributes:
        stream: which sensor; "" for the whole log.
        texts: the different sentences.
        count, of, seconds: of the run with the largest share; None where not known.
        label: the estimator of that run, where others have another count; of a note without a count, every estimator
            that has it, where others do not; else "".
        varies: whether seeds or estimators have other counts.
    """

    log: str
    kind: str
    stream: str
    texts: tuple[str, ...]
    count: int | None
    of: int | None
    seconds: float | None
    label: str
    varies: bool

    @property
    def share(self) -> float:
        """Of `of`; 0 where that is not known."""
        return (self.count or 0) / self.of if self.of else 0.0

    @property
    def amount(self) -> str:
        """How many of how many: "up to 12 of 340 (3.5 %)"."""
        if self.count is None:
            return ABSENT
        what = "" if self.stream else " readings"
        percent = f"{100 * self.share:.1f} %" if self.share >= LEAST_SHARE else f"under {100 * LEAST_SHARE:g} %"
        share = f" of {self.of:,}{what} ({percent})" if self.of else what
        seconds = "" if self.seconds is None else f", {text(self.seconds)} s in all"
        return f"{'up to ' if self.varies else ''}{self.count:,}{share}{seconds}"


def notices(rows: Sequence[Record]) -> list[Notice]:
    """Return what the runs noticed, the worst kinds first, each log by log; of a note's sensor and kind one."""
    found: list[Notice] = []
    for (log,), of_log in groups(rows, "log").items():
        runs = [row for row, *_ in groups(of_log, "label", "seed").values() if row["notes"]]
        for (kind, stream), each in _by_kind(runs).items():
            found.append(_notice(log, kind, stream, each, len({row["label"] for row in of_log})))
    return sorted(found, key=lambda notice: PLACES[notice.kind])


def _by_kind(runs: Sequence[Record]) -> dict[tuple[str, str], list[tuple[Record, dict[str, Any]]]]:
    """Return notes and their runs by kind and sensor; the notes of one kind and sensor of a run in one."""
    found: dict[tuple[str, str], list[tuple[Record, dict[str, Any]]]] = {}
    for row in runs:
        for key, note in _of_run(row["notes"]).items():
            found.setdefault(key, []).append((row, note))
    return found


@lru_cache(maxsize=256)
def _of_run(notes: str) -> dict[tuple[str, str], dict[str, Any]]:
    """Return a run's notes by kind and sensor: their texts, and their counts added up."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for note in json.loads(notes):
        if note["kind"] not in WORDS:
            continue
        key = (note["kind"], note.get("stream", ""))
        kept = found.setdefault(key, {"texts": [], "of": note.get("of")})
        kept["texts"].append(note["text"])
        for name in ("count", "seconds"):
            if name in note:
                kept[name] = kept.get(name, 0) + note[name]
    return found


def _notice(log: str, kind: str, stream: str, each: Sequence[tuple[Record, dict[str, Any]]], labels: int) -> Notice:
    def amount(pair: tuple[Record, dict[str, Any]]) -> tuple[float, int]:
        count = pair[1].get("count") or 0
        return count / (pair[1]["of"] or 1), count

    row, worst = max(each, key=amount)
    counts = {(note.get("count"), note["of"]) for _, note in each}
    by_label = {run["label"]: note.get("count") for run, note in each if run["seed"] == row["seed"]}
    same = len(by_label) == labels and len(set(by_label.values())) == 1
    texts = tuple(dict.fromkeys(text for _, note in each for text in note["texts"]))
    label = "" if same else row["label"] if worst.get("count") is not None else ", ".join(by_label)
    return Notice(
        log, kind, stream, texts, worst.get("count"), worst["of"], worst.get("seconds"), label, len(counts) > 1
    )


def lines(rows: Sequence[Record]) -> Iterator[tuple[str, bool]]:
    """Yield lines for the terminal, the worst first, and whether each is routine; logs that say the same share one."""
    for kind, logs in _by_kind_and_log(rows).items():
        if kind in ROUTINE:
            most = max(chain.from_iterable(logs.values()), key=lambda notice: (notice.share, notice.count or 0))
            more = f" (the most of {len(logs)} logs)" if len(logs) > 1 else ""
            yield f"{most.log}: {_sentence(kind, [most])}{more}", True
            continue
        said: dict[str, list[str]] = {}
        for log, of_log in logs.items():
            said.setdefault(_sentence(kind, of_log), []).append(log)
        for sentence, named in said.items():
            yield f"{listed(named)}: {sentence}", False


def _by_kind_and_log(rows: Sequence[Record]) -> dict[str, dict[str, list[Notice]]]:
    found: dict[str, dict[str, list[Notice]]] = {}
    for notice in notices(rows):
        found.setdefault(notice.kind, {}).setdefault(notice.log, []).append(notice)
    return found


def _sentence(kind: str, of: Sequence[Notice]) -> str:
    """Return what the notices of one log and kind say, on one line."""
    if kind not in IN_WORDS:
        amounts = (
            f"{notice.stream} {notice.amount}{f' by {notice.label}' if notice.label else ''}"
            for notice in sorted(of, key=lambda notice: -notice.share)
        )
        return f"{WORDS[kind]}: {'; '.join(amount.strip() for amount in amounts)}"
    texts = list(dict.fromkeys(text for notice in of for text in notice.texts))
    more = f" (and {len(texts) - 1} more, in the report)" if len(texts) > 1 else ""
    by = f" ({of[0].label})" if of[0].label else ""
    return f"{WORDS[kind]}{by}: {shorten(texts[0], TEXT_LETTERS, placeholder=' …')}{more}"


def sentences(rows: Sequence[Record]) -> list[str]:
    """Return a sentence per kind, for the notes of a printed table of one log."""
    return [_sentence(kind, [*chain.from_iterable(logs.values())]) for kind, logs in _by_kind_and_log(rows).items()]


def sheet(rows: Sequence[Record]) -> Sheet | None:
    """Return all that the runs noticed as a table; None where there is nothing."""
    found = notices(rows)
    if not found:
        return None
    table = [
        Line(
            notice.log,
            [
                Cell(WORDS[notice.kind], PLACES[notice.kind]),
                Cell(notice.stream or "whole log", notice.stream or "whole log"),
                Cell(notice.amount, notice.share),
                Cell(notice.label or "all", notice.label or "all"),
                Cell("; ".join(notice.texts[:MOST_TEXTS]), notice.texts[0]),
            ],
        )
        for notice in found
    ]
    note = ["the worst first; up to: of the run with the largest share, where seeds or estimators differ"]
    return Sheet("What the runs noticed", note, ["log", "kind", "about", "how many", "estimator", "in words"], table)
