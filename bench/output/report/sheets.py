"""The tables of an experiment as the page shows them: the numbers and headings of the terminal, and what to sort by."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ...metrics import BLOCKS
from ...metrics.floor_ratio import OVER
from ...metrics.scoring import INNOVATIONS, MEDIAN
from ...results.intervals import interval_over_seeds
from ...results.paired import FEWEST_SEEDS
from ...results.summary import OUTLIERS, Record, groups
from ..tables.table import (
    ABSENT,
    BLOCK_HEADINGS,
    NIS_HEADINGS,
    SHOWN,
    _anees,
    _both_lookaheads,
    _caption,
    _cell,
    _difference,
    _lookahead,
    _paired_caption,
    _ratio,
    _three_figures,
    _within,
    score_name,
    who,
)

Value = float | int | str | None
Done = Mapping[tuple[Any, ...], Sequence[Record]]
"""By log, label and output, the rows that came to their end."""

COST_HEADINGS = {
    "step_median_us": "step median",
    "step_p99_us": "step p99",
    "real_time_factor": "× real time",
    "us_per_imu_sample": "µs per IMU sample",
    "peak_mb": "peak memory MB",
}


class Cell(NamedTuple):
    """What stands in a table: its text, what it is sorted by (None goes last), and its interval over seeds."""

    text: str
    value: Value = None
    interval: str = ""


class Line(NamedTuple):
    """One row: who it is of, its cells, and which run it tells of, by its place among all runs; None for no one run."""

    name: str
    cells: list[Cell]
    run: int | None = None


@dataclass(frozen=True)
class Sheet:
    """A table that can be sorted, each group within itself: what is of unequal look-ahead is never ranked together.

    Attributes:
        title: stands above it.
        note: what its numbers mean, line by line.
        headings: of the columns, that of the row's name first.
        groups: rows by the name of their group, "" for a table without groups.
    """

    title: str
    note: Sequence[str]
    headings: Sequence[str]
    groups: Mapping[str, list[Line]]


def joined(headings: Iterable[str]) -> Iterator[str]:
    """Give each heading in one line; one that begins on its second goes on under that before: "step\\np99"."""
    first = ""
    for heading in headings:
        top, _, below = heading.partition("\n")
        first = top.strip() or first
        yield f"{first} {below.strip()}".strip()


def by_lookahead(rows: Iterable[Record]) -> dict[str, list[Record]]:
    """Return the rows by how much of the future they have seen, the least first; what nobody knows last."""
    found = groups(rows, "output", "lookahead_s")
    known = sorted((key for key in found if key[1] is not None), key=lambda key: (key[1], key[0] != "online"))
    return {seen(*key): found[key] for key in [*known, *(key for key in found if key[1] is None)]}


def seen(output: str, lookahead_s: float | None) -> str:
    """Return in words how much of the future an output has seen."""
    if lookahead_s is None:
        return "nothing was said"
    ahead = "all of the log" if math.isinf(lookahead_s) else f"{lookahead_s:g} s ahead"
    return f"sees {ahead}: {output}"


def number(name: str, row: Record) -> Cell:
    """Return the cell of a score, as the terminal writes it."""
    return Cell(_cell(name, row[name]), row[name])


def accuracy(summary: Sequence[Record], done: Done) -> Sheet:
    """Return the table that every log has.

    Args:
        summary: of one log, as `summarise` gives it.
        done: the rows behind it, for the intervals.
    """
    first = next((row for row in summary if row["truth_kind"] is not None), summary[0])
    note = [_caption(first)]
    if max(row["done"] for row in summary) >= FEWEST_SEEDS:
        note.append("[ ]: 95 % bootstrap interval over seeds (with 20 it holds in some 90 % of cases)")
    else:
        note.append(f"no intervals: they need {FEWEST_SEEDS} seeds")

    def cell(name: str, row: Record) -> Cell:
        # of how long a step took a median over seeds is shown, whose spread is the machine's
        found = None if name in MEDIAN else interval_over_seeds(done[row["log"], row["label"], row["output"]], name)
        scale = 3 if name == "nees_position" else 1
        text = "" if found is None else f"[{_three_figures(found[0] / scale)}, {_three_figures(found[1] / scale)}]"
        return number(name, row)._replace(interval=text)

    lines = {
        group: [
            Line(
                row["label"],
                [Cell(f"{row['done']}/{row['runs']}", row["done"] / row["runs"]), *(cell(name, row) for name in SHOWN)],
            )
            for row in of
        ]
        for group, of in by_lookahead(summary).items()
    }
    return Sheet(summary[0]["log"], note, ["estimator", "runs done", *joined(SHOWN.values())], lines)


def over_floor(summary: Sequence[Record]) -> Sheet | None:
    """Return each RMSE over the posterior Cramér–Rao bound; None where that is not known."""
    if not any(row[floor] is not None for row in summary for _, floor in OVER.values()):
        return None
    note = [
        "RMSE over the posterior Cramér–Rao bound of that look-ahead: 1 is the best there can be",
        f"[ ]: 95 % bootstrap interval over seeds, from {FEWEST_SEEDS} on",
    ]
    lines = {
        group: [
            Line(
                row["label"],
                [Cell(str(row["done"]), row["done"])]
                + [Cell(_ratio(row, block), row[f"over_floor_{block}"]) for block in OVER],
            )
            for row in of
        ]
        for group, of in by_lookahead(summary).items()
    }
    return Sheet(f"{summary[0]['log']}: over the floor", note, ["estimator", "runs", *OVER], lines)


def honesty(summary: Sequence[Record]) -> Sheet | None:
    """Return ANEES, NIS and coverage; None where there are none."""
    sensors = [name for name in INNOVATIONS if any(row[name] is not None for row in summary)]
    times = max((row["anees_times"] or 0 for row in summary), default=0)
    if not sensors and not times:
        return None
    seeds = max(row["done"] for row in summary)
    note = [
        "squared errors over what the covariance says, by degree of freedom: 1 is honest, more is overconfident",
        f"ANEES: over {seeds} runs, at {times} fixed times; ▲k, ▼k: at k of them above, below the chi-square interval"
        + ("" if seeds >= FEWEST_SEEDS else "; with so few seeds that interval is wide"),
        "NIS: over all readings that came in time. Position within 1, 2, 3 σ: 68, 95, 99.7 % are due",
    ]
    headings = ["estimator", "runs", *joined(BLOCK_HEADINGS), *(f"NIS {NIS_HEADINGS[name]}" for name in sensors)]
    lines = {
        group: [
            Line(
                row["label"],
                [Cell(str(row["done"]), row["done"])]
                + [Cell(_anees(row, block).strip(), row[f"anees_{block}"]) for block in BLOCKS]
                + [number(name, row) for name in sensors]
                + [Cell(_within(row), row["within_1sigma_position"])],
            )
            for row in of
        ]
        for group, of in by_lookahead(summary).items()
    }
    return Sheet(f"{summary[0]['log']}: honesty", note, [*headings, "within 1, 2, 3 σ, %"], lines)


def late_or_out(summary: Sequence[Record]) -> Sheet | None:
    """Return what became of late readings and outliers; None where there were none."""
    outliers = [name for name in summary[0] if name.startswith(OUTLIERS)]
    columns = {"readings": "readings", "late_used": "late, used", "late_dropped": "late, dropped", "carried": "carried"}
    columns |= {name: f"outliers {name.removeprefix(OUTLIERS)}" for name in outliers}
    if not any(row[name] for row in summary for name in ("late_used", "late_dropped", *outliers)):
        return None
    note = ["over all runs; carried: tied to the keyframe before by the IMU"]
    if outliers:
        note.append(
            "outliers: beyond a filter's gate or a loss's width; of honest readings Huber has 18 %, Cauchy 1.7 %"
        )
    lines = [
        Line(label, [Cell(f"{row[name]:,}", row[name]) for name in columns])
        for (label,), (row, *_) in groups(summary, "label").items()
    ]
    return Sheet(
        f"{summary[0]['log']}: late readings and outliers", note, ["estimator", *columns.values()], {"": lines}
    )


def cost(summary: Sequence[Record]) -> Sheet | None:
    """Return what each estimator costs; None where nobody came to a step."""
    if not any(row[name] is not None for row in summary for name in MEDIAN):
        return None
    lines = [
        Line(label, [number(name, row) for name in MEDIAN]) for (label,), (row, *_) in groups(summary, "label").items()
    ]
    note = ["medians over runs; × real time: length of the log over all steps and the finish"]
    if any(row[name] is not None for row in summary for name in INNOVATIONS):
        note.append("NIS was asked for, which cuts every step in two: these costs are not to be compared with others")
    headings = ["estimator", *(COST_HEADINGS.get(name, name) for name in MEDIAN)]
    return Sheet(f"{summary[0]['log']}: cost", note, headings, {"": lines})


def differences(paired: Sequence[Record]) -> list[Sheet]:
    """Return a table per baseline, of what `paired` found; a group per score and look-ahead."""
    sheets = []
    headings = ["variant", "baseline", "Δ", "95 %", "%", "p (Holm)", "r", "seeds"]
    note = _paired_caption(paired).splitlines() if paired else []
    for (log, label), of_baseline in groups(paired, "baseline_log", "baseline_label").items():
        lines: dict[str, list[Line]] = {}
        for row in of_baseline:
            texts = _difference(row)[1:]
            values = [
                *(row["baseline"], row["difference"], row["low"], row["ratio"]),
                *(row["p_holm"], row["rank_biserial"], row["pairs"]),
            ]
            ahead = f"sees {_both_lookaheads(row)} ahead" if row["pairs"] else "no seed that both came to the end of"
            group = f"{score_name(row['score'])}, {ahead}"
            cells = [Cell(text, value) for text, value in zip(texts, values, strict=True)]
            lines.setdefault(group, []).append(Line(who(row), cells))
        sheets.append(Sheet(f"{log}: against {label}", note, headings, lines))
    return sheets


def runs(rows: Sequence[Record]) -> Sheet:
    """Return every run with its scores, and the first letters of its identity."""
    lines: dict[str, list[Line]] = {}
    places = {id(row): place for place, row in enumerate(rows)}
    for (log,), of_log in groups(rows, "log").items():
        for group, of in by_lookahead(of_log).items():
            lines[f"{log}, {group}"] = [
                Line(
                    row["label"],
                    [
                        Cell(ABSENT if row["seed"] is None else f"{row['seed']:.0f}", row["seed"]),
                        Cell(row["status"] or ABSENT, row["status"]),
                        *(number(name, row) for name in SHOWN),
                        Cell((row["identity"] or ABSENT)[:8], row["identity"]),
                    ],
                    places[id(row)],
                )
                for row in of
            ]
    note = ["each on its own, not pooled; a row opens to its spec, its counts and where it was made"]
    return Sheet("Every run", note, ["estimator", "seed", "ended", *joined(SHOWN.values()), "identity"], lines)


def lookahead(row: Record) -> str:
    """Return how much of the future a row has seen, as a legend says it."""
    return _lookahead(row)
