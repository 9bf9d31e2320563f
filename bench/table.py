"""The numbers of an experiment as people read them: seeds pooled, on the terminal and in table.csv."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean, median
from textwrap import shorten
from typing import Any, TypeAlias

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .metrics import pooled_rmse

Record: TypeAlias = dict[str, Any]
"""One row, absent values being None."""

POOLED = {"ate_rmse_m": "n_scored", "heading_rmse_deg": "n_scored", "rpe_rmse_m": "n_rpe", "drms_m": "n_scored"}
"""Root mean squares are pooled over seeds before the root, each with its own count."""

MEAN = ("drift_end_percent", "drift_max_percent", "outage_percent", "segment_percent", "cep50_m", "anees_position")
MEDIAN = ("step_median_us", "step_p99_us", "real_time_factor", "us_per_imu_sample", "peak_mb")
SAME = ("estimator", "lookahead_s", "truth_kind", "align", "dims")

SHOWN = {
    "ate_rmse_m": "ATE\nm",
    "heading_rmse_deg": "heading\n°",
    "drift_end_percent": "drift\n%",
    "rpe_rmse_m": "RPE\nm",
    "anees_position": "NEES\n/3",
    "step_median_us": "step\nmedian",
    "step_p99_us": "\np99",
    "real_time_factor": "× real\ntime",
}
ABSENT = "–"
CAUSE_WIDTH = 160


def records(rows: pd.DataFrame) -> list[Record]:
    """Return the rows of a table of runs as plain Python."""
    return [
        {str(name): None if pd.isna(value) else value for name, value in row.items()} for row in rows.to_dict("records")
    ]


def groups(rows: Iterable[Record], *keys: str) -> dict[tuple[Any, ...], list[Record]]:
    """Return the rows by these keys, in order of first appearance."""
    found: dict[tuple[Any, ...], list[Record]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def summarise(rows: pd.DataFrame) -> list[Record]:
    """Return one record per log, estimator and output, over the seeds that came to their end.

    Squared errors are pooled before the root; percentages, CEP50 and NEES are averaged; of costs, the median is taken.
    `runs` and `done` say over how many; where none is done, the numbers are None.
    """
    every = records(rows)
    runs = {key: len(groups(of, "seed")) for key, of in groups(every, "log", "label").items()}
    summary = []
    for (log, label, output), group in groups(every, "log", "label", "output").items():
        done = [row for row in group if row["status"] == "done"]
        record: Record = {"log": log, "label": label, "output": output}
        record |= {name: next((row[name] for row in group if row[name] is not None), None) for name in SAME}
        record |= _rpe_step(group)
        record |= {"runs": runs[log, label], "done": len(done)}
        record |= {count: sum(row[count] or 0 for row in done) for count in ("n_scored", "n_rpe")}
        record |= {name: _pooled(done, name, count) for name, count in POOLED.items()}
        record |= {name: _over_seeds(fmean, done, name) for name in MEAN}
        record |= {name: _over_seeds(median, done, name) for name in MEDIAN}
        summary.append(record)
    return summary


def _rpe_step(group: Sequence[Record]) -> Record:
    """Return which RPE a group's is, from its spec; None where that does not tell."""
    scores = json.loads(group[-1]["spec"] or "{}").get("scores", {})
    return {name: scores.get(name) for name in ("rpe_delta", "rpe_unit", "rpe_pairs")}


def _pooled(done: Sequence[Record], name: str, count: str) -> float | None:
    known = [row for row in done if row[name] is not None]
    return pooled_rmse([row[name] for row in known], [row[count] for row in known]) if known else None


def _over_seeds(statistic: Callable[[list[float]], float], done: Sequence[Record], name: str) -> float | None:
    known = [row[name] for row in done if row[name] is not None]
    return statistic(known) if known else None


def write_table(rows: pd.DataFrame, path: Path) -> None:
    """Write what `summarise` returns as CSV; an absent number is an empty field."""
    pd.DataFrame(summarise(rows)).to_csv(path, index=False)


def print_table(rows: pd.DataFrame, console: Console | None = None) -> None:
    """Print one table per log, then what did not come to its end, and whose readings were mostly of no use."""
    if console is None:
        console = Console()
        if not console.is_terminal:
            console = Console(width=120)
    for summary in groups(summarise(rows), "log").values():
        console.print(_table(summary))
        console.print()
    for line in failures(rows) + mostly_outside(rows):
        console.print(line, style="red", highlight=False, markup=False, soft_wrap=True)


def failures(rows: pd.DataFrame) -> list[str]:
    """Return a line for each run that is not done, naming it; a recording that is not here has one line in all."""
    lines = []
    for (log, label, seed), (row, *_) in groups(records(rows), "log", "label", "seed").items():
        if row["status"] == "absent":
            lines.append(f"{log}: {row['cause']}")
        elif row["status"] != "done":
            of_seed = "" if seed is None else f" seed {seed}"
            when = "" if row["failed_at_s"] is None else f" at {row['failed_at_s']:.1f} s"
            lines.append(f"{log} / {label}{of_seed}: {row['status']}{when}: {shorten(row['cause'], CAUSE_WIDTH)}")
    return list(dict.fromkeys(lines))


def mostly_outside(rows: pd.DataFrame) -> list[str]:
    """Return a line for each log that a run came to the end of with most of its readings outside the IMU's time."""
    lines = {}
    for row in records(rows):
        counts = json.loads(row["counts"] or "{}")
        outside, readings = counts.get("readings_outside", 0), counts.get("readings", math.inf)
        if row["status"] == "done" and outside > readings / 2:
            lines[row["log"]] = f"{row['log']}: {outside} of {readings} readings lay outside the log; mend their clock"
    return list(lines.values())


def _table(summary: Sequence[Record]) -> Table:
    first = next((row for row in summary if row["truth_kind"] is not None), summary[0])
    table = Table(
        title=Text(first["log"], "table.title"),
        caption=Text(_caption(first), "table.caption"),
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("estimator", overflow="fold", min_width=14)
    table.add_column("sees\nahead", justify="right", no_wrap=True)
    table.add_column("runs\ndone", justify="right", no_wrap=True)
    for heading in SHOWN.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for (label,), of_label in groups(summary, "label").items():
        for k, row in enumerate(of_label):
            numbers = (_cell(name, row[name]) for name in SHOWN)
            table.add_row(Text("" if k else label), _lookahead(row), f"{row['done']}/{row['runs']}", *numbers)
    return table


def _caption(row: Record) -> str:
    if row["truth_kind"] is None:
        return "nothing to score against"
    against = "the truth" if row["truth_kind"] == "truth" else f"a {row['truth_kind']} (another filter's output)"
    delta, unit, pairs = row["rpe_delta"], row["rpe_unit"], row["rpe_pairs"]
    step = "" if delta is None else f"; RPE over {delta:g} {unit}, {pairs} pairs"
    return f"against {against}; alignment: {row['align']}; ATE and RPE in {row['dims']}{step}; drift is horizontal"


def _lookahead(row: Record) -> str:
    seen = row["lookahead_s"]
    if seen is None:
        return ABSENT
    return "all" if math.isinf(seen) else f"{seen:g} s"


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return ABSENT
    if name == "anees_position":
        return _three_figures(value / 3)
    if name in ("step_median_us", "step_p99_us"):
        return f"{_three_figures(value)} µs" if value < 1000 else f"{_three_figures(value / 1000)} ms"
    return _three_figures(value)


def _three_figures(value: float) -> str:
    """Return a number with three figures that count, at most four of them decimals."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.1e}"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(decimals, 4)}f}"
