"""The numbers of an experiment on the terminal and as CSV."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import shorten

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ...metrics import BLOCKS
from ...metrics.floor_ratio import OVER
from ...metrics.scoring import INNOVATIONS
from ...results.intervals import summarise_with_intervals
from ...results.paired import FEWEST_SEEDS, PAIRED
from ...results.summary import CONSISTENCY, OUTLIERS, Record, consistency, groups, is_judged, records, summarise
from . import terminal

SHOWN = {
    "ate_rmse_m": "ATE\nm",
    "heading_rmse_deg": "heading\n°",
    "drift_end_percent": "drift\n%",
    "rpe_rmse_m": "RPE\nm",
    "nees_position": "NEES\n/3",
    "step_median_us": "step\nmedian",
    "step_p99_us": "\np99",
    "real_time_factor": "× real\ntime",
}
SCORE_NAMES: dict[str, str] = {name: " ".join(heading.split()) for name, heading in SHOWN.items()} | {
    "rotation_rmse_deg": "rotation °",
    "velocity_rmse_m_s": "velocity m/s",
    "drift_max_percent": "worst drift %",
    "outage_percent": "outage %",
    "nees_position": "NEES",
    "step_median_us": "step µs",
    "step_p99_us": "step p99 µs",
}
"""What paired tables and figures call scores, see `score_name`."""
BLOCK_HEADINGS = ("ANEES   \npos", "\natt", "\nvel", "\nbias", "\nall")
NIS_HEADINGS = {"nis_dvl": "dvl", "nis_depth": "depth", "nis_gps": "gps", "nis_heading": "head"}
ABSENT = "–"
CAUSE_WIDTH = 160
"""Characters of a cause of failure: two lines of most terminals; the store has all of it."""


def write_table(rows: pd.DataFrame, path: Path) -> None:
    """Write what `summarise_with_intervals` returns as CSV; an absent number is an empty field."""
    pd.DataFrame(summarise_with_intervals(rows)).to_csv(path, index=False)


def write_consistency(rows: pd.DataFrame, path: Path) -> None:
    """Write what `consistency` returns as CSV."""
    pd.DataFrame(consistency(rows), columns=list(CONSISTENCY)).to_csv(path, index=False)


def write_paired(differences: Sequence[Record], path: Path) -> None:
    """Write what `paired` returns as CSV."""
    pd.DataFrame(differences, columns=list(PAIRED)).to_csv(path, index=False)


def print_table(rows: pd.DataFrame, console: Console | None = None, differences: Sequence[Record] = ()) -> None:
    """Print the tables of each log, then what did not come to its end, and whose readings were mostly of no use.

    Accuracy and cost for every log; the floor where it was asked for; honesty where NIS was asked for, or seeds are
    enough for ANEES; late readings and outliers where there were any; then the `differences` that `paired` found, a
    table per baseline.
    """
    console = console or terminal.console()
    every = summarise(rows)
    for summary in groups(every, "log").values():
        for table in (_accuracy(summary), _floor(summary), _honesty(summary), _late_or_out(summary)):
            if table is not None:
                console.print(table)
                console.print()
    for table in _paired(differences):
        console.print(table)
        console.print()
    for line in failures(rows) + mostly_outside(rows) + not_positive(every):
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


def not_positive(summary: Sequence[Record]) -> list[str]:
    """Return a line for each estimator whose covariance is not positive definite somewhere."""
    return [
        f"{row['log']} / {row['label']} {row['output']}: {row['n_not_positive']} covariances are not positive definite"
        for row in summary
        if row["n_not_positive"]
    ]


def _accuracy(summary: Sequence[Record]) -> Table:
    first = next((row for row in summary if row["truth_kind"] is not None), summary[0])
    table = _empty(first["log"], _caption(first), ("sees\nahead", "runs\ndone", *SHOWN.values()))
    for (label,), of_label in groups(summary, "label").items():
        for k, row in enumerate(of_label):
            numbers = (_cell(name, row[name]) for name in SHOWN)
            table.add_row(Text("" if k else label), _lookahead(row), f"{row['done']}/{row['runs']}", *numbers)
    return table


def _floor(summary: Sequence[Record]) -> Table | None:
    """RMSE over the posterior Cramér–Rao bound; None where that is not known."""
    if not any(row[floor] is not None for row in summary for _, floor in OVER.values()):
        return None
    caption = (
        "RMSE over the posterior Cramér–Rao bound of that look-ahead, with a 95 % bootstrap interval over seeds\n"
        "(from 5 seeds on; with 20 it holds in 91 % of cases)"
    )
    table = _empty(f"{summary[0]['log']}: over the floor", caption, ("sees\nahead", "runs", *OVER))
    for (label,), of_label in groups(summary, "label").items():
        for k, row in enumerate(of_label):
            ratios = (_ratio(row, block) for block in OVER)
            table.add_row(Text("" if k else label), _lookahead(row), f"{row['done']}", *ratios)
    return table


def _ratio(row: Record, block: str) -> str:
    ratio, low, high = (row[f"over_floor_{block}{part}"] for part in ("", "_low", "_high"))
    if ratio is None:
        return ABSENT
    return f"{ratio:.3f}" if low is None else f"{ratio:.3f} [{low:.3f}, {high:.3f}]"


def _honesty(summary: Sequence[Record]) -> Table | None:
    """ANEES, NIS and coverage; None where there is not enough."""
    if not is_judged(summary):
        return None
    sensors = [name for name in INNOVATIONS if any(row[name] is not None for row in summary)]
    times = max((row["anees_times"] or 0 for row in summary), default=0)
    caption = (
        "squared errors over what the covariance says, by degree of freedom: 1 is honest, more is overconfident\n"
        f"ANEES: over the runs, at {times} fixed times; ▲k, ▼k: at k of them above, below the chi-square interval\n"
        "NIS: over all readings that came in time. Position within 1, 2, 3 σ: 68, 95, 99.7 % are due"
    )
    headings = ["sees\nahead", "runs", *(f"{name}   " for name in BLOCK_HEADINGS)]
    headings += [f"{'' if k else 'NIS'}\n{NIS_HEADINGS[name]}" for k, name in enumerate(sensors)]
    table = _empty(f"{summary[0]['log']}: honesty", caption, [*headings, "within\n1, 2, 3 σ"])
    for (label,), of_label in groups(summary, "label").items():
        for k, row in enumerate(of_label):
            numbers = [_anees(row, block) for block in BLOCKS]
            numbers += [_cell(name, row[name]) for name in sensors]
            table.add_row(Text("" if k else label), _lookahead(row), f"{row['done']}", *numbers, _within(row))
    return table


def _anees(row: Record, block: str) -> str:
    value, above, below = (row[f"anees_{block}{part}"] for part in ("", "_above", "_below"))
    if value is None:
        return f"{ABSENT}   "
    mark = (f"▲{above}" if above else "") + (f"▼{below}" if below else "")
    return f"{_three_figures(value)} {mark:<2}"


def _within(row: Record) -> str:
    shares = [row[f"within_{k}sigma_position"] for k in (1, 2, 3)]
    if None in shares:
        return ABSENT
    return " ".join(f"{100 * share:.{digits}f}" for share, digits in zip(shares, (0, 0, 1), strict=True))


def _late_or_out(summary: Sequence[Record]) -> Table | None:
    """What became of late readings and outliers; None where there were none."""
    outliers = [name for name in summary[0] if name.startswith(OUTLIERS)]
    columns = {
        "readings": "readings",
        "late_used": "late,\nused",
        "late_dropped": "late,\ndropped",
        "carried": "carried",
    }
    columns |= {name: f"outliers\n{name.removeprefix(OUTLIERS)}" for name in outliers}
    if not any(row[name] for row in summary for name in ("late_used", "late_dropped", *outliers)):
        return None
    caption = "over all runs; carried: tied to the keyframe before by the IMU"
    if outliers:
        caption += (
            "\noutliers: beyond a filter's gate or a loss's width; of honest readings Huber has 18 %, Cauchy 1.7 %"
        )
    table = _empty(f"{summary[0]['log']}: late readings and outliers", caption, columns.values())
    for (label,), (row, *_) in groups(summary, "label").items():
        table.add_row(Text(label), *(f"{row[name]:,}" for name in columns))
    return table


def _paired(differences: Sequence[Record]) -> list[Table]:
    """Return a table per baseline; what its columns mean stands under the last one."""
    tables = []
    headings = ("sees\nahead", "\nscore", "\nbaseline", "\nΔ", "\n95 %", "\n%", "p\n(Holm)", "\nr", "\nseeds")
    for (log, label), of_baseline in groups(differences, "baseline_log", "baseline_label").items():
        table = _empty(f"{log}: against {label}", "", headings, "variant")
        before = None
        named = [row | {"who": who(row), "ahead": _both_lookaheads(row)} for row in of_baseline]
        for (name, ahead), rows in groups(named, "who", "ahead").items():
            for k, row in enumerate(rows):
                table.add_row(Text("" if k or name == before else name), "" if k else ahead, *_difference(row))
            before = name
        tables.append(table)
    if tables:
        tables[-1].caption = Text(_paired_caption(differences), "table.caption")
    return tables


def score_name(score: str) -> str:
    """Return what a paired table or figure calls a score: its own name, where SCORE_NAMES has no shorter one."""
    return SCORE_NAMES.get(score, score)


def who(row: Record) -> str:
    """Return how the variant of a paired record is called beside its baseline: by its label or log, or by both."""
    if row["log"] == row["baseline_log"]:
        return row["label"]
    return row["log"] if row["label"] == row["baseline_label"] else f"{row['log']}: {row['label']}"


def _both_lookaheads(row: Record) -> str:
    own, other = _lookahead(row), _lookahead({"lookahead_s": row["baseline_lookahead_s"]})
    return own if own == other else f"{own} v. {other}"


def _difference(row: Record) -> list[str]:
    """Return the cells of one score's difference."""
    seeds = f"{row['pairs']}" if row["pairs"] == row["runs"] else f"{row['pairs']}/{row['runs']}"
    name = score_name(row["score"])
    if not row["pairs"]:
        return [name, *[ABSENT] * 6, seeds]
    interval = ABSENT if row["low"] is None else f"[{_signed(row['low'])}, {_signed(row['high'])}]"
    p, r = row["p_holm"], row["rank_biserial"]
    return [
        name,
        _three_figures(row["baseline"]),
        _signed(row["difference"]),
        interval,
        percent(row["ratio"]),
        ABSENT if p is None else "< 0.0001" if p < 1e-4 else f"{p:.4f}",
        ABSENT if r is None else f"{r:+.2f}",
        seeds,
    ]


def _signed(value: float) -> str:
    return f"{'+' if value > 0 else ''}{_three_figures(value)}"


def percent(ratio: float | None) -> str:
    """Return by how much a ratio is more or less than 1; from ten times on, how many times."""
    if ratio is None:
        return ABSENT
    change = 100 * (ratio - 1)
    return f"× {_three_figures(ratio)}" if ratio >= 10 else f"{change:+.0f}" if change >= 100 else f"{change:+.1f}"


def _paired_caption(differences: Sequence[Record]) -> str:
    tests = [row for row in differences if row["p_holm"] is not None]
    lines = [
        "Δ: variant less baseline, over the seeds both ended; 95 %: bootstrap over seeds (with 20, right in 90 %)",
        f"p: Wilcoxon's signed-rank test over seeds, corrected by Holm for {len(tests)} tests;"
        " r: its rank-biserial correlation, ±1 where all seeds agree",
    ]
    if not tests:
        return f"{lines[0]}\nneither intervals nor tests: they need {FEWEST_SEEDS} seeds of a simulated log"
    least = min(len(tests) * 2.0 ** (1 - row["pairs"]) for row in tests)
    if least > 0.05:
        lines.append(f"so many tests on so few seeds give no p under {min(1.0, least):.2g}: take more, or compare less")
    return "\n".join(lines)


def _empty(title: str, caption: str, headings: Iterable[str], first: str = "estimator") -> Table:
    """Return a table without rows; its first column says of whom."""
    table = Table(
        title=Text(title, "table.title"),
        caption=Text(caption, "table.caption"),
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column(first, overflow="fold", min_width=14)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
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
    if name == "nees_position":
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
