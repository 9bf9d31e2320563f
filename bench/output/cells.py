"""Shared by all tables and figures: columns, how a value becomes text, and the words for outputs, lags and axes.

The terminal, LaTeX, the report and the figures lay out what stands here; none of them names or formats a score itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from ..metrics.floor_ratio import OVER
from ..metrics.scoring import INNOVATIONS
from ..results.summary import Record, why_missing

ABSENT = "–"
ONLINE, SMOOTHED = "online", "smoothed"

TIME = "time (s)"
COMPUTING = "computing time (ms per second of log)"
STEP_TIME = "time of one step (µs)"
NEES_OVER_DOF = "NEES / dof"
DIRECTIONS = ("east", "north", "up")


# -- numbers ----------------------------------------------------------------------------------------------------------


def digits(value: float) -> tuple[int, int]:
    """Return (exponent, decimals) of a finite number: three significant digits, at most four of them decimals.

    From 1e-4 to 1e6 the exponent is 0; beyond, one decimal stands before a power of ten.
    """
    if value == 0:
        return 0, 0
    exponent = math.floor(math.log10(abs(value)))
    return (0, min(4, max(0, 2 - exponent))) if 1e-4 <= abs(value) < 1e6 else (exponent, 1)


def text(value: float) -> str:
    """Return a number with the digits that `digits` gives it."""
    if not math.isfinite(value):
        return f"{value:g}"
    exponent, decimals = digits(value)
    return f"{value:.1e}" if exponent else f"{value:,.{decimals}f}"


def signed(value: float) -> str:
    """Return a number with its sign."""
    return f"{'+' if value > 0 else ''}{text(value)}"


def interval(low: float | None, high: float | None, write: Callable[[float], str] = text) -> str:
    """Return an interval in brackets; nothing where it is not known."""
    return "" if low is None or high is None else f"[{write(low)}, {write(high)}]"


def percent(ratio: float | None) -> str:
    """Return by how many percent a ratio is above or below 1; from ten on, the factor: "× 12.0"."""
    if ratio is None:
        return ABSENT
    change = 100 * (ratio - 1)
    return f"× {text(ratio)}" if ratio >= 10 else f"{change:+.0f}" if change >= 100 else f"{change:+.1f}"


def lag(lookahead_s: float | None) -> str:
    """Return how much of the future an estimate has seen: "0 s", "3 s", "all"."""
    return ABSENT if lookahead_s is None else "all" if math.isinf(lookahead_s) else f"{lookahead_s:g} s"


def output_and_lag(output: str, lookahead_s: float | None) -> str:
    """Return in words which output this is: "online", "smoothed, lag 3 s", "smoothed, whole log"."""
    if lookahead_s is None:
        return "no output"
    if math.isinf(lookahead_s):
        return f"{output}, whole log"
    return output if output == ONLINE and lookahead_s == 0 else f"{output}, lag {lag(lookahead_s)}"


def spans(numbers: Iterable[int]) -> str:
    """Return sorted integers with runs of them as their ends: "1–3, 5"."""
    pieces: list[list[int]] = []
    for number in numbers:
        if pieces and number == pieces[-1][-1] + 1:
            pieces[-1].append(number)
        else:
            pieces.append([number])
    return ", ".join(f"{piece[0]}–{piece[-1]}" if len(piece) > 1 else f"{piece[0]}" for piece in pieces)


# -- columns ----------------------------------------------------------------------------------------------------------


class Column(NamedTuple):
    """A column of numbers.

    Attributes:
        score: what a record calls it.
        name, unit: as headings, axes and captions call it.
        best: which number is the best; None where numbers are not ranked.
        divisor: tables show the score over this.
    """

    score: str
    name: str
    unit: str = ""
    best: Callable[[Iterable[float]], float] | None = min
    divisor: float = 1.0

    @property
    def heading(self) -> str:
        """Two lines: name and unit. Times have their unit beside each number, so their name takes both lines."""
        return f"{self.name}\n{self.unit}" if self.unit not in ("", "µs") else "\n".join(self.name.rsplit(" ", 1))

    @property
    def axis(self) -> str:
        """Name and unit as an axis shows them."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    @property
    def raw(self) -> str:
        """Name and unit of the score itself, before it is divided."""
        return self.name if self.divisor != 1.0 else f"{self.name} {self.unit}".rstrip()

    def text(self, value: float) -> str:
        """Return a value of the score as tables show it; a time in µs, from 1000 on in ms."""
        if self.unit == "µs":
            return f"{text(value)} µs" if value < 1000 else f"{text(value / 1000)} ms"
        return text(value / self.divisor)


ACCURACY = (
    Column("ate_rmse_m", "ATE", "m"),
    Column("heading_rmse_deg", "heading", "°"),
    Column("drift_end_percent", "drift", "%"),
    Column("rpe_rmse_m", "RPE", "m"),
    Column("nees_position", "NEES", "/dof", best=None, divisor=3.0),
    Column("step_median_us", "step median", "µs"),
    Column("step_p99_us", "step p99", "µs"),
    Column("real_time_factor", "× real time", best=max),
)
"""The main table."""

OTHERS = (
    Column("rotation_rmse_deg", "rotation", "°"),
    Column("velocity_rmse_m_s", "velocity", "m/s"),
    Column("drift_max_percent", "largest drift", "%"),
    Column("outage_percent", "outage drift", "%"),
    Column("energy_score_m", "energy score", "m"),
    Column("step_cpu_median_us", "step processor", "µs"),
    Column("us_per_imu_sample", "per IMU sample", "µs"),
    Column("us_per_imu_sample_with_outputs", "with outputs", "µs"),
    Column("peak_mb", "peak memory", "MB"),
)
"""What other tables and figures show."""

COST = (
    *("step_median_us", "step_cpu_median_us", "step_p99_us", "real_time_factor"),
    *("us_per_imu_sample", "us_per_imu_sample_with_outputs", "peak_mb"),
)
"""The scores of the table of costs."""

KNOWN = {column.score: column for column in (*ACCURACY, *OTHERS)}


def column(score: str) -> Column:
    """Return the column of a score; one that no table has is called by its own name."""
    return KNOWN.get(score, Column(score, score))


# -- cells ------------------------------------------------------------------------------------------------------------


class Cell(NamedTuple):
    """What stands in a table.

    Attributes:
        text: what is shown.
        value: what the column is sorted by; None goes last.
        interval: over seeds, in brackets.
        mark: a verdict beside the number.
        why: why there is no number.
    """

    text: str
    value: float | int | str | None = None
    interval: str = ""
    mark: str = ""
    why: str = ""


def cell(score: str, row: Record) -> Cell:
    """Return the cell of a score."""
    value = row[score]
    return absent(score, row) if value is None else Cell(column(score).text(value), value)


def absent(score: str, row: Record) -> Cell:
    """Return the cell of a score that is not known, with the reason.

    Args:
        score: what is missing.
        row: of a run, or of a summary.
    """
    return Cell(ABSENT, why=_reason(score, row))


def _reason(score: str, row: Record) -> str:
    if not (row["done"] if "done" in row else row["status"] == "done"):
        return "no run finished"
    missing = row["missing"] if isinstance(row["missing"], dict) else why_missing(row)
    if score in missing:
        return missing[score]
    if score in INNOVATIONS:
        return "no innovations (smoothed, or late readings that a smoother ties)"
    if score.startswith("over_floor_"):
        return missing.get(OVER[score.removeprefix("over_floor_")][1], "no floor of this output")
    return missing.get(score.replace("anees_", "nees_"), "not defined for this run")


def judged(value: float, above: int, below: int) -> Cell:
    """Return the cell of an ANEES, marked by how many of its times lie above and below the interval."""
    return Cell(text(value), value, mark=(f"▲{above}" if above else "") + (f"▼{below}" if below else ""))


# -- captions ---------------------------------------------------------------------------------------------------------


NEES_NOTE = "NEES: of position, per degree of freedom; 1 is consistent, more is overconfident"


def against(truth_kind: str) -> str:
    """Return what errors are taken against."""
    return "ground truth" if truth_kind == "truth" else f"a {truth_kind}, which is not ground truth"


def scored_how(summary: Iterable[Record]) -> str:
    """Return how the scores of one log were taken: against what, aligned how, over which step.

    Args:
        summary: of one log, as `summarise` gives it.
    """
    row = next((row for row in summary if row["truth_kind"] is not None), None)
    if row is None:
        return "no ground truth to score against"
    delta, unit, pairs = row["rpe_delta"], row["rpe_unit"], row["rpe_pairs"]
    step = "" if delta is None else f"; RPE over {delta:g} {unit}, {pairs} pairs"
    return (
        f"against {against(row['truth_kind'])}; alignment: {row['align']}; ATE and RPE in {row['dims']}{step}; "
        "drift is horizontal"
    )
