"""The tables of an experiment, ready for the terminal, LaTeX and the report to lay out: headings, cells, notes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ...estimators.interface import OUTLIERS
from ..metrics.floor_ratio import OVER
from ..metrics.interval import FEWEST_SEEDS, HOLDS
from ..metrics.scoring import ELLIPSOIDS, LOG_DENSITY, MEDIAN, NIS, WHITENESS
from ..metrics.state_error import BLOCKS
from ..results.intervals import interval_over_seeds
from ..results.paired import out_of_reach
from ..results.summary import Record, groups
from .cells import (
    ABSENT,
    ACCURACY,
    COST,
    KNOWN,
    NEES_NOTE,
    ONLINE,
    Cell,
    absent,
    cell,
    column,
    interval,
    judged,
    lag,
    output_and_lag,
    percent,
    scored_how,
    signed,
    text,
)

Done = Mapping[tuple[Any, ...], Sequence[Record]]
"""By log, label and output, the rows that finished."""

SHORT = {"position": "pos", "attitude": "att", "velocity": "vel", "biases": "bias", "heading": "head"}
"""What narrow columns call blocks and sensors; others have their own names."""


UNITS = {column.unit for column in KNOWN.values()}

MOST_LISTED = 4
"""Names that a sentence lists; with their commas they fill half a line of 80 columns."""


def listed(names: Iterable[str]) -> str:
    """Return different names, the first few of them, with commas: "a, b, c, d and 3 more"."""
    each = list(dict.fromkeys(names))
    more = f" and {len(each) - MOST_LISTED} more" if len(each) > MOST_LISTED else ""
    return ", ".join(each[:MOST_LISTED]) + more


class Line(NamedTuple):
    """One row.

    Attributes:
        name: whose numbers these are.
        output, lag: which output, in words and in short; empty in a table over all outputs.
        lookahead_s: what outputs are sorted by; None goes last.
        section: the score or the log that it is about, in a table of several.
    """

    name: str
    cells: list[Cell]
    output: str = ""
    lag: str = ""
    lookahead_s: float | None = None
    section: str = ""


@dataclass(frozen=True)
class Sheet:
    """A table.

    Attributes:
        title: stands above it.
        note: what its numbers mean, line by line.
        headings: of the names, then of the cells; at most two lines each.
        section: heading of the lines' sections; "" where there are none.
    """

    title: str
    note: Sequence[str]
    headings: Sequence[str]
    lines: Sequence[Line]
    section: str = ""

    @property
    def notes(self) -> list[str]:
        """The note, and a line for each reason why cells are empty: of which columns, and of whom if not of all."""
        return [*self.note, *(f"{ABSENT} {text}" for text in self.reasons)]

    @property
    def reasons(self) -> list[str]:
        """Why cells are empty: "NEES: no ground truth", "heading, drift (eskf): no run finished"."""
        columns: dict[str, list[str]] = {}
        names: dict[str, list[str]] = {}
        for line in self.lines:
            for heading, each in zip(self.headings[1:], line.cells, strict=True):
                if each.why:
                    columns.setdefault(each.why, []).append(_without_unit(heading))
                    names.setdefault(each.why, []).append(line.name)
        every = {line.name for line in self.lines}
        return [
            f"{listed(columns[why])}{f' ({listed(names[why])})' if {*names[why]} < every else ''}: {why}"
            for why in columns
        ]

    def by_output(self) -> dict[str, list[Line]]:
        """Return the lines by section and output, the least lag first: only outputs of equal lag are ranked."""
        sections = list(dict.fromkeys(line.section for line in self.lines))

        def place(line: Line) -> tuple[int, bool, float, bool]:
            seen = line.lookahead_s
            return sections.index(line.section), seen is None, seen or 0.0, not line.output.startswith(ONLINE)

        found: dict[str, list[Line]] = {}
        for line in sorted(self.lines, key=place):
            found.setdefault(", ".join(filter(None, (line.section, line.output))), []).append(line)
        return found


def _without_unit(heading: str) -> str:
    """Return a heading on one line, without its unit."""
    name, _, below = heading.partition("\n")
    return name if below in UNITS else f"{name} {below}".rstrip()


def _line(row: Record, cells: list[Cell], **other: Any) -> Line:
    """Return the line of one output."""
    seen = row["lookahead_s"]
    return Line(row["label"], cells, output_and_lag(row["output"], seen), lag(seen), seen, **other)


def _by_label(summary: Sequence[Record]) -> list[Record]:
    return [row for of_label in groups(summary, "label").values() for row in of_label]


def _runs(row: Record) -> Cell:
    return Cell(f"{row['done']}", row["done"])


def accuracy(summary: Sequence[Record], done: Done | None = None) -> Sheet:
    """Return the main table of one log.

    Args:
        summary: of the log, as `summarise` gives it.
        done: the rows behind it; with them, scores have intervals over seeds.
    """
    note = [scored_how(summary), NEES_NOTE]
    if done is not None:
        enough = max(row["done"] for row in summary) >= FEWEST_SEEDS
        note.append(
            f"[ ]: 95 % interval over seeds; it {HOLDS}" if enough else f"no intervals: they need {FEWEST_SEEDS} seeds"
        )

    def with_interval(score: str, row: Record) -> Cell:
        known = None
        if done is not None and score not in MEDIAN:  # the spread of costs is the machine's, not the seeds'
            known = interval_over_seeds(done[row["log"], row["label"], row["output"]], score)
        low, high = known or (None, None)
        return cell(score, row)._replace(interval=interval(low, high, column(score).text))

    lines = [
        _line(
            row,
            [
                Cell(f"{row['done']}/{row['runs']}", row["done"] / row["runs"]),
                *(with_interval(each.score, row) for each in ACCURACY),
            ],
        )
        for row in _by_label(summary)
    ]
    return Sheet(summary[0]["log"], note, ["estimator", "runs\ndone", *(each.heading for each in ACCURACY)], lines)


def over_floor(summary: Sequence[Record]) -> Sheet | None:
    """Return each RMSE over the posterior Cramér–Rao bound; None where no bound is known."""
    if not any(row[floor] is not None for row in summary for _, floor in OVER.values()):
        return None
    note = [
        "RMSE over the posterior Cramér–Rao bound at the same lag: 1 is the best possible",
        f"[ ]: 95 % interval over seeds, from {FEWEST_SEEDS} seeds on; it {HOLDS}",
    ]

    def ratio(row: Record, block: str) -> Cell:
        value, low, high = (row[f"over_floor_{block}{part}"] for part in ("", "_low", "_high"))
        if value is None:
            return absent(f"over_floor_{block}", row)
        return Cell(f"{value:.3f}", value, interval(low, high, "{:.3f}".format))

    lines = [_line(row, [_runs(row), *(ratio(row, block) for block in OVER)]) for row in _by_label(summary)]
    return Sheet(f"{summary[0]['log']}: RMSE over the floor", note, ["estimator", "runs", *OVER], lines)


def consistency(summary: Sequence[Record]) -> Sheet | None:
    """Return ANEES, NIS and coverage; None where there are none."""
    sensors = [name for name in NIS if any(row[name] is not None for row in summary)]
    times = max((row["anees_times"] or 0 for row in summary), default=0)
    if not sensors and not times:
        return None
    seeds = max(row["done"] for row in summary)
    note = [
        "squared errors over their covariance, per degree of freedom: 1 is consistent, more is overconfident",
        f"ANEES: over {seeds} runs, at {times} fixed times; ▲k, ▼k: at k of them above, below the chi-square interval"
        + ("" if seeds >= FEWEST_SEEDS else "; with so few seeds that interval is wide"),
        ("NIS: over all readings in time, and late ones that a filter replays; " if sensors else "")
        + "position within 1, 2, 3 σ: 68, 95, 99.7 % if consistent",
    ]

    def anees(row: Record, block: str) -> Cell:
        value, above, below = (row[f"anees_{block}{part}"] for part in ("", "_above", "_below"))
        return absent(f"anees_{block}", row) if value is None else judged(value, above, below)

    def within(row: Record) -> Cell:
        shares = [row[f"within_{k}sigma_position"] for k in (1, 2, 3)]
        if None in shares:
            return absent("within_1sigma_position", row)
        percents = (f"{100 * share:.{decimals}f}" for share, decimals in zip(shares, (0, 0, 1), strict=True))
        return Cell(" ".join(percents), shares[0])

    headings = [
        *("estimator", "runs", *(f"ANEES\n{SHORT.get(block, block)}" for block in BLOCKS)),
        *(f"NIS\n{SHORT.get(sensor, sensor)}" for sensor in (name.removeprefix("nis_") for name in sensors)),
        "within\n1, 2, 3 σ",
    ]
    lines = [
        _line(
            row,
            [
                _runs(row),
                *(anees(row, block) for block in BLOCKS),
                *(cell(name, row) for name in sensors),
                within(row),
            ],
        )
        for row in _by_label(summary)
    ]
    return Sheet(f"{summary[0]['log']}: consistency", note, headings, lines)


def prediction(summary: Sequence[Record]) -> Sheet | None:
    """Return scores of the whole stated law, not of its size alone; None where there are none."""
    columns = [name for name in (*LOG_DENSITY, *WHITENESS) if any(row[name] is not None for row in summary)]
    if not columns and all(row["energy_score_m"] is None for row in summary):
        return None
    note = [
        "energy score: of position, error and covariance in one; lower is better",
        f"inside: position errors in the ellipsoids of {', '.join(map(str, ELLIPSOIDS))} %, as many if consistent",
    ]
    if columns:
        note += [
            "log p: density of the readings as predicted, nats per degree of freedom; higher is better",
            "white: correlation of innovations with the ones before; 0 if consistent, ▲ outside its interval (99.9 %)",
        ]

    def inside(row: Record) -> Cell:
        shares = [row[f"inside_{percent}_position"] for percent in ELLIPSOIDS]
        if None in shares:
            return absent("inside_50_position", row)
        return Cell(" ".join(f"{100 * share:.0f}" for share in shares), shares[0])

    def of_sensor(name: str, row: Record) -> Cell:
        return cell(name, row)._replace(mark="▲" if row.get(f"{name}_outside") else "")

    named = {"log_density": "log p", "whiteness": "white"}
    headings = ["estimator", "runs", column("energy_score_m").heading, f"inside\n{', '.join(map(str, ELLIPSOIDS))} %"]
    for name in columns:
        score, _, sensor = name.rpartition("_")
        headings.append(f"{named[score]}\n{SHORT.get(sensor, sensor)}")
    lines = [
        _line(row, [_runs(row), cell("energy_score_m", row), inside(row), *(of_sensor(name, row) for name in columns)])
        for row in _by_label(summary)
    ]
    return Sheet(f"{summary[0]['log']}: what was predicted", note, headings, lines)


def late_or_out(summary: Sequence[Record]) -> Sheet | None:
    """Return what became of late readings and outliers; None where there were none."""
    outliers = [name for name in summary[0] if name.startswith(OUTLIERS)]
    counts = {"readings": "readings", "late": "late", "late_dropped": "late,\ndropped"}
    counts |= {"carried": "carried"} | {name: f"outliers\n{name.removeprefix(OUTLIERS)}" for name in outliers}
    if not any(row[name] for row in summary for name in ("late", "late_dropped", *outliers)):
        return None
    note = [
        "counts over all runs; late: received more than 1 ms after they were true; carried: tied by the IMU to the "
        "keyframe before"
    ]
    if outliers:
        note.append(
            "outliers: rejected by a filter's gate, or beyond the width of a loss; of Gaussian readings Huber's has "
            "18 %, Cauchy's 1.7 %"
        )
    lines = [
        Line(label, [Cell(f"{row[name]:,}", row[name]) for name in counts])
        for (label,), (row, *_) in groups(summary, "label").items()
    ]
    return Sheet(f"{summary[0]['log']}: late readings and outliers", note, ["estimator", *counts.values()], lines)


def cost(summary: Sequence[Record]) -> Sheet | None:
    """Return what each estimator costs; None where none made a step."""
    if not any(row[name] is not None for row in summary for name in COST):
        return None
    lines = [
        Line(label, [cell(name, row) for name in COST]) for (label,), (row, *_) in groups(summary, "label").items()
    ]
    rate = next((row["output_rate_hz"] for row in summary if row["output_rate_hz"] is not None), None)
    note = [
        "medians over runs; × real time: length of the log over the time of all steps and of the finish",
        "step processor: time that the thread had the processor; less than the step where it waited",
        "with outputs: time per IMU sample with "
        + (f"{rate:g} beliefs a second" if rate is not None else "beliefs at a stated rate"),
    ]
    if any(row[name] is not None for row in summary for name in NIS):
        note.append(NOT_COMPARABLE)
    headings = ["estimator", *(column(name).heading for name in COST)]
    return Sheet(f"{summary[0]['log']}: cost", note, headings, lines)


NOT_COMPARABLE = "costs are not comparable: NIS was asked for, which cuts every step in two"


# -- paired differences -----------------------------------------------------------------------------------------------


def differences(paired: Sequence[Record]) -> list[Sheet]:
    """Return a table per baseline of what `paired` found."""
    headings = ["variant", "baseline", "Δ", "95 %", "%", "p\n(Holm)", "r", "seeds"]
    note = _paired_note(paired)
    return [
        Sheet(f"{log}: against {label}", note, headings, [_difference(row) for row in _by_variant(rows)], "score")
        for (log, label), rows in groups(paired, "baseline_log", "baseline_label").items()
    ]


def variant(row: Record) -> str:
    """Return how the variant of a paired record is called beside its baseline: by its label or log, or by both."""
    if row["log"] == row["baseline_log"]:
        return row["label"]
    return row["log"] if row["label"] == row["baseline_label"] else f"{row['log']}: {row['label']}"


def _by_variant(paired: Sequence[Record]) -> list[Record]:
    named = [row | {"variant": variant(row)} for row in paired]
    return [row for rows in groups(named, "variant", "output").values() for row in rows]


def _difference(row: Record) -> Line:
    """Return the line of one score's difference."""
    seen, other = row["lookahead_s"], row["baseline_lookahead_s"]
    both = lag(seen) if lag(seen) == lag(other) else f"{lag(seen)} v. {lag(other)}"
    seeds = Cell(f"{row['pairs']}" if row["pairs"] == row["runs"] else f"{row['pairs']}/{row['runs']}", row["pairs"])
    if row["pairs"]:
        p, r = row["p_holm"], row["rank_biserial"]
        cells = [
            Cell(text(row["baseline"]), row["baseline"]),
            Cell(signed(row["difference"]), row["difference"]),
            _or_absent(interval(row["low"], row["high"], signed), row["low"], f"intervals need {FEWEST_SEEDS} seeds"),
            _or_absent(percent(row["ratio"]), row["ratio"], "a ratio needs numbers above zero"),
            _or_absent(
                "" if p is None else "< 0.0001" if p < 1e-4 else f"{p:.4f}", p, NO_TEST if r is None else ONE_RUN
            ),
            _or_absent("" if r is None else f"{r:+.2f}", r, NO_TEST),
        ]
        output = output_and_lag(row["output"], seen)
        output += "" if lag(seen) == lag(other) else f", against lag {lag(other)}"
    else:
        cells, output = [Cell(ABSENT, why="no seed that both finished")] * 6, "no seed that both finished"
    return Line(variant(row), [*cells, seeds], output, both, seen, column(row["score"]).raw)


ONE_RUN = "no test: both are one configuration under two names"
NO_TEST = f"no test: it needs {FEWEST_SEEDS} seeds of a simulated log that both finished"


def _or_absent(shown: str, value: float | None, why: str) -> Cell:
    """Return the cell of a number, or of none with the reason."""
    return Cell(ABSENT, why=why) if value is None else Cell(shown, value)


def _paired_note(paired: Sequence[Record]) -> list[str]:
    tests = [row for row in paired if row["p_holm"] is not None]
    lines = [f"Δ: variant minus baseline, over the seeds that both finished; 95 %: interval over seeds, which {HOLDS}"]
    if not tests:
        return [*lines, f"neither intervals nor tests: they need {FEWEST_SEEDS} seeds of a simulated log"]
    lines.append(
        f"p: Wilcoxon's signed-rank test over seeds, corrected by Holm for {len(tests)} tests; "
        "r: its rank-biserial correlation, ±1 where all seeds agree"
    )
    too_few = out_of_reach(max(row["pairs"] for row in tests), len(tests))
    return [*lines, too_few] if too_few else lines
