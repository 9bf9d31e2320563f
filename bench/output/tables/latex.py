"""The main tables of an experiment in LaTeX, for print; of all packages they need `booktabs` alone.

One table per log, with online and smoothed estimates in blocks of their own, for the two are not to be ranked together.
A number has three significant digits, as on the terminal, and beside it the ends of its interval over seeds.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from ...metrics.interval import FEWEST_SEEDS, HOLDS
from ...results.intervals import TABLED, summarise_with_intervals
from ...results.step_time import machine_name
from ...results.summary import UNFINISHED, Record, Rows, file_names, groups, records
from .. import notices
from ..cells import ACCURACY, NEES_NOTE, Column, digits, lag, scored_how, spans
from ..sheets import NOT_COMPARABLE, accuracy
from .latex_text import escape

ABSENT = "--"
LONG = 24
"""Labels with more letters than this are broken into lines: a column of 29 mm holds so many."""

COSTS = ("step_median_us", "step_p99_us", "real_time_factor")


def write_latex(rows: Rows, path: Path) -> None:
    r"""Write what `summarise_with_intervals` returns as LaTeX: a `table*` per log, to be \input by a paper."""
    path.write_text(latex(rows), encoding="ascii")


def latex(rows: Rows) -> str:
    """Return a `table*` per log whose recording was there, see `write_latex`."""
    rows = records(rows)
    every = [row for row in rows if row["status"] != "absent"]
    summary = groups(summarise_with_intervals(rows), "log")
    labels = file_names(f"{row['experiment']}-{row['log']}" for row in every)
    tables = []
    for (experiment, log), of_log in groups(every, "experiment", "log").items():
        tables.append(_table(summary[log,], of_log, f"tab:{labels[f'{experiment}-{log}']}"))
    return "\n".join(["% \\usepackage{booktabs}", *tables]) + "\n"


def _table(summary: Sequence[Record], rows: Sequence[Record], label: str) -> str:
    long = any(len(row["label"]) > LONG for row in summary)
    heads = [("", "estimator"), ("look-", "ahead"), ("runs", "done"), *map(_heading, ACCURACY)]
    lines = [
        r"\begin{table*}[tbp]",
        r"\centering",
        rf"\caption{{{_caption(summary, rows)}}}",
        rf"\label{{{label}}}",
        r"\smallskip",
        r"\footnotesize",
        r"\setlength{\tabcolsep}{3pt}",
        rf"\renewcommand{{\arraystretch}}{{{1.4 if _has_intervals(summary) else 1.1}}}",
        rf"\begin{{tabular}}{{@{{}}{'p{29mm}' if long else 'l'}rl{'r' * len(ACCURACY)}@{{}}}}",
        r"\toprule",
        *(_line(escape(head[k]) for head in heads) for k in (0, 1)),
    ]
    ranked = [column for column in ACCURACY if not (column.score in COSTS and _is_examined(rows))]
    for (output,), block in groups(summary, "output").items():
        bold = {column.score: _best(block, column) for column in ranked}
        title = rf"\multicolumn{{{len(heads)}}}{{@{{}}l}}{{\emph{{{escape(output.capitalize())}}}}}"
        lines += [r"\midrule", _line([title])]
        for row in block:
            numbers = (_cell(row, column, row["label"] in bold.get(column.score, ())) for column in ACCURACY)
            seen = ABSENT if row["lookahead_s"] is None else lag(row["lookahead_s"])
            lines.append(_line([_label(row["label"], long), seen, _runs(row), *numbers]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}"])


def _heading(column: Column) -> tuple[str, str]:
    """Return the two lines above a column; times are all in µs here, so that they can be compared at a glance."""
    if column.unit:
        return column.name, f"({column.unit})"
    top, below = column.heading.split("\n")
    return top, below


def _line(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _label(label: str, long: bool) -> str:
    text = escape(label)
    if long:
        breakable = re.sub(r"(\\_|/|-)(?=[^\W_])", r"\1\\allowbreak{}", text)
        return rf"\raggedright {breakable}"
    return f"{{}}{text}" if text.startswith(("[", "*")) else text  # `\\` before it would take that for its own


def _runs(row: Record) -> str:
    ends = [f"{row[status]} {status}" for status in UNFINISHED if row[status]]
    return ", ".join([f"{row['done']}/{row['runs']}", *ends])


def _best(block: Sequence[Record], column: Column) -> set[str]:
    """Return the labels whose number is the best of a block, as printed; none where there is nothing to rank.

    An estimator that did not finish every run is not ranked: only the runs that went well would count.
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
    """Return a number in LaTeX's mathematics, with three significant digits, at most four of them decimals.

    The ends of its interval, minus the number, stand below and above it, with as many decimals.
    """
    if not math.isfinite(value):
        return r"\infty" if value > 0 else r"-\infty"
    exponent, decimals = digits(value)
    scale = 10.0**exponent
    text = f"{value / scale:,.{decimals}f}".replace(",", "{,}")
    text = rf"\mathbf{{{text}}}" if bold else text
    if low is not None and high is not None:
        below, above = (f"{(end - value) / scale:+,.{decimals}f}".replace(",", "{,}") for end in (low, high))
        text += f"_{{{below}}}^{{{above}}}"
    return rf"{text} \times 10^{{{exponent}}}" if exponent else text


# -- the caption ------------------------------------------------------------------------------------------------------


def _caption(summary: Sequence[Record], rows: Sequence[Record]) -> str:
    """Return what a reader must know to compare the numbers: seeds, alignment, intervals, machine, ranking."""
    seeds = sorted({row["seed"] for row in rows if row["seed"] is not None})
    sentences = [f"{summary[0]['log']}: {_seeds(seeds)}; {scored_how(summary)}"]
    if len(seeds) > 1:
        sentences.append("RMSEs are pooled over seeds before the root; drift and NEES are means, costs medians")
    if _has_intervals(summary):
        sentences.append(f"Beside a number: the ends of its 95 % interval over seeds, minus the number; it {HOLDS}")
    elif len(seeds) > 1:
        sentences.append(f"Intervals need {FEWEST_SEEDS} seeds")
    sentences.append(NEES_NOTE)
    machines = dict.fromkeys(machine_name(row["machine"]) for row in rows if row["step_median_us"] is not None)
    if machines:
        sentences.append(f"Costs on {' and '.join(machines)}")
    if _is_examined(rows):
        sentences.append(NOT_COMPARABLE)
    sentences += notices.sentences(rows)
    sentences += [f"No {reason}" for reason in accuracy(summary).reasons]
    sentences.append(
        "Bold: the best online and the best smoothed number, as printed, of estimators that finished every run;"
        " NEES is not ranked"
    )
    first, *others = sentences
    return escape(". ".join([first, *(f"{sentence[0].upper()}{sentence[1:]}" for sentence in others)]) + ".")


def _seeds(seeds: Sequence[int]) -> str:
    """Return how many seeds there are, and which."""
    return f"{len(seeds)} seed{'s' if len(seeds) > 1 else ''} ({spans(seeds)})" if seeds else "one run of a recording"


def _has_intervals(summary: Sequence[Record]) -> bool:
    return any(row[f"{score}_low"] is not None for row in summary for score in TABLED)


def _is_examined(rows: Sequence[Record]) -> bool:
    """Whether NIS was asked for: each epoch was then handed over in two steps, which changes the costs."""
    return any(json.loads(spec or "{}").get("scores", {}).get("nis", False) for spec in {row["spec"] for row in rows})
