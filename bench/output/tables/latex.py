"""The numbers of an experiment as LaTeX tables for print; of all packages they need `booktabs` alone.

One table per log, what was said at once and what was said with hindsight apart, for the two are not to be ranked
together. A number has three figures, as on the terminal, and beside it the ends of its interval over seeds.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from ...results.intervals import TABLED, summarise_with_intervals
from ...results.paired import FEWEST_SEEDS
from ...results.step_time import machine_name
from ...results.summary import UNFINISHED, Record, file_names, groups, records
from .latex_text import escape
from .table import _caption

ABSENT = "--"
LONG = 24
"""Longer labels than this are broken into lines."""


class Column(NamedTuple):
    """One column of numbers: its score, what stands above it in two lines, and which number is the best."""

    score: str
    heading: tuple[str, str]
    best: Callable[[Iterable[float]], float] | None = min
    divisor: float = 1.0


COLUMNS = (
    Column("ate_rmse_m", ("ATE", "(m)")),
    Column("heading_rmse_deg", ("heading", "(°)")),
    Column("drift_end_percent", ("drift", "(%)")),
    Column("rpe_rmse_m", ("RPE", "(m)")),
    Column("nees_position", ("NEES", "per dof"), best=None, divisor=3.0),
    Column("step_median_us", ("step p50", "(µs)")),
    Column("step_p99_us", ("step p99", "(µs)")),
    Column("real_time_factor", ("× real", "time"), best=max),
)
COSTS = ("step_median_us", "step_p99_us", "real_time_factor")
BLOCKS = {"online": "Online", "smoothed": "Smoothed"}


def write_latex(rows: pd.DataFrame, path: Path) -> None:
    r"""Write what `summarise_with_intervals` returns as LaTeX: a `table*` per log, to be \input by a paper."""
    path.write_text(latex(rows), encoding="ascii")


def latex(rows: pd.DataFrame) -> str:
    """Return a `table*` per log whose recording was there, see `write_latex`."""
    every = [row for row in records(rows) if row["status"] != "absent"]
    summary = groups(summarise_with_intervals(rows), "log")
    labels = file_names(f"{row['experiment']}-{row['log']}" for row in every)
    tables = []
    for (experiment, log), of_log in groups(every, "experiment", "log").items():
        tables.append(_table(summary[log,], of_log, f"tab:{labels[f'{experiment}-{log}']}"))
    return "\n".join(["% \\usepackage{booktabs}", *tables]) + "\n"


def _table(summary: Sequence[Record], rows: Sequence[Record], label: str) -> str:
    long = any(len(row["label"]) > LONG for row in summary)
    heads = [("", "estimator"), ("sees", "ahead"), ("runs", "done"), *(column.heading for column in COLUMNS)]
    lines = [
        r"\begin{table*}[tbp]",
        r"\centering",
        rf"\caption{{{_caption_of(summary, rows)}}}",
        rf"\label{{{label}}}",
        r"\smallskip",
        r"\footnotesize",
        r"\setlength{\tabcolsep}{3pt}",
        rf"\renewcommand{{\arraystretch}}{{{1.4 if _has_intervals(summary) else 1.1}}}",
        rf"\begin{{tabular}}{{@{{}}{'p{29mm}' if long else 'l'}rl{'r' * len(COLUMNS)}@{{}}}}",
        r"\toprule",
        *(_line(escape(head[k]) for head in heads) for k in (0, 1)),
    ]
    ranked = [column for column in COLUMNS if not (column.score in COSTS and _is_examined(rows))]
    for (output,), block in groups(summary, "output").items():
        bold = {column.score: _best(block, column) for column in ranked}
        lines += [r"\midrule", _line([rf"\multicolumn{{{len(heads)}}}{{@{{}}l}}{{\emph{{{BLOCKS[output]}}}}}"])]
        for row in block:
            numbers = (_cell(row, column, row["label"] in bold.get(column.score, ())) for column in COLUMNS)
            lines.append(_line([_label(row["label"], long), _lookahead(row), _runs(row), *numbers]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}"])


def _line(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _label(label: str, long: bool) -> str:
    text = escape(label)
    if long:
        breakable = re.sub(r"(\\_|/|-)(?=[^\W_])", r"\1\\allowbreak{}", text)
        return rf"\raggedright {breakable}"
    return f"{{}}{text}" if text.startswith(("[", "*")) else text  # `\\` before it would take that for its own


def _lookahead(row: Record) -> str:
    seen = row["lookahead_s"]
    return ABSENT if seen is None else "all" if math.isinf(seen) else f"{seen:g} s"


def _runs(row: Record) -> str:
    ends = [f"{row[status]} {status}" for status in UNFINISHED if row[status]]
    return ", ".join([f"{row['done']}/{row['runs']}", *ends])


def _best(block: Sequence[Record], column: Column) -> set[str]:
    """Return the labels whose number is the best of a block, as printed; none where there is nothing to rank.

    What did not come to the end of every run is not ranked: it would be judged by the runs that went well.
    """
    most = max(row["runs"] for row in block)
    values = {
        row["label"]: row[column.score]
        for row in block
        if row["done"] == most and row[column.score] is not None and math.isfinite(row[column.score])
    }
    if column.best is None or len(values) < 2:
        return set()
    best = number(column.best(values.values()))
    return {label for label, value in values.items() if number(value) == best}


def _cell(row: Record, column: Column, bold: bool) -> str:
    value = row[column.score]
    if value is None:
        return ABSENT
    low, high = (row.get(f"{column.score}{end}") for end in ("_low", "_high"))
    return f"${number(value / column.divisor, low, high, bold)}$"


def number(value: float, low: float | None = None, high: float | None = None, bold: bool = False) -> str:
    """Return a number in LaTeX's mathematics, with three figures that count, at most four of them decimals.

    The ends of its interval, less itself, stand below and above it, with as many decimals.
    """
    if not math.isfinite(value):
        return r"\infty" if value > 0 else r"-\infty"
    exponent = 0 if value == 0 or 1e-4 <= abs(value) < 1e6 else math.floor(math.log10(abs(value)))
    scale = 10.0**exponent
    figures = 0 if value == 0 else 1 if exponent else max(0, 2 - math.floor(math.log10(abs(value))))
    decimals = min(figures, 4)
    text = f"{value / scale:,.{decimals}f}".replace(",", "{,}")
    text = rf"\mathbf{{{text}}}" if bold else text
    if low is not None and high is not None:
        below, above = (f"{(end - value) / scale:+,.{decimals}f}".replace(",", "{,}") for end in (low, high))
        text += f"_{{{below}}}^{{{above}}}"
    return rf"{text} \times 10^{{{exponent}}}" if exponent else text


# -- the caption ------------------------------------------------------------------------------------------------------


def _caption_of(summary: Sequence[Record], rows: Sequence[Record]) -> str:
    """Return what a reader must know to compare the numbers: seeds, alignment, what they are and which are bold."""
    scored = next((row for row in summary if row["truth_kind"] is not None), summary[0])
    seeds = sorted({row["seed"] for row in rows if row["seed"] is not None})
    sentences = [f"{summary[0]['log']}: {_seeds(seeds)}; {_caption(scored)}"]
    if len(seeds) > 1:
        sentences.append("RMSEs are pooled over seeds before the root, drift and NEES are means, costs medians")
    if _has_intervals(summary):
        sentences.append(
            "Beside a number: the ends of its 95 % interval, less itself"
            " (bootstrap over seeds, bias-corrected and accelerated)"
        )
    elif len(seeds) > 1:
        sentences.append(f"Intervals need {FEWEST_SEEDS} seeds")
    sentences.append("NEES is of position: 1 is honest, more is overconfident")
    machines = dict.fromkeys(machine_name(row["machine"]) for row in rows if row["step_median_us"] is not None)
    if machines:
        sentences.append(f"Costs on {' and '.join(machines)}")
    if _is_examined(rows):
        sentences.append("they are not to be compared, for NIS was taken")
    sentences.append(
        "Bold: the best at once and the best with hindsight, as printed, of those that ended every run;"
        " NEES is not ranked"
    )
    return escape(". ".join(sentences) + ".")


def _seeds(seeds: Sequence[int]) -> str:
    """Return how many seeds there are, and which: runs of three or more as their ends."""
    if not seeds:
        return "one run of a recording"
    starts = [seeds[0], *(b for a, b in pairwise(seeds) if b != a + 1)]
    ends = [*(a for a, b in pairwise(seeds) if b != a + 1), seeds[-1]]
    which = [f"{a}" if a == b else f"{a}, {b}" if b == a + 1 else f"{a}–{b}" for a, b in zip(starts, ends, strict=True)]
    return f"{len(seeds)} seed{'s' if len(seeds) > 1 else ''} ({', '.join(which)})"


def _has_intervals(summary: Sequence[Record]) -> bool:
    return any(row[f"{score}_low"] is not None for row in summary for score in TABLED)


def _is_examined(rows: Sequence[Record]) -> bool:
    """Whether NIS was asked for: epochs were then handed over in halves."""
    return any(json.loads(row["spec"] or "{}").get("scores", {}).get("nis", False) for row in rows)
