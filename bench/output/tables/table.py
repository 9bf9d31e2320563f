"""The tables of an experiment on the terminal and as CSV."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ...files import write_csv
from ...metrics.scoring import by_reason
from ...results.convergence import CONVERGENCE
from ...results.honesty import HONESTY
from ...results.intervals import summarise_with_intervals
from ...results.paired import PAIRED
from ...results.summary import CONSISTENCY, Record, Rows, groups, is_judged, records, summarise
from ...results.summary import consistency as consistency_of
from ...saying import folded
from .. import notices, over_logs, sheets
from ..cells import Cell
from ..remarks import failures, mostly_outside, not_positive, waited
from . import terminal

LETTERS = 80
"""Longest line of what the runs noticed, also where there is more room: longer ones are hard to read."""

COUNTS = ("above", "below", "times", "seeds", "runs", "converged")
"""Columns of counts, which have no decimals where one is absent."""


def write_table(rows: Rows, path: Path) -> None:
    """Write what `summarise_with_intervals` returns as CSV; an absent number is an empty field, and `missing` why."""
    summary = [row | {"missing": json.dumps(by_reason(row["missing"]))} for row in summarise_with_intervals(rows)]
    write_csv(pd.DataFrame(summary), path)


def write_consistency(rows: Rows, path: Path) -> None:
    """Write what `consistency` returns as CSV."""
    write_csv(pd.DataFrame(consistency_of(rows), columns=list(CONSISTENCY)), path)


def write_paired(differences: Sequence[Record], path: Path) -> None:
    """Write what `paired` returns as CSV."""
    write_csv(pd.DataFrame(differences, columns=list(PAIRED)), path)


def write_over_logs(honest: Sequence[Record], converged: Sequence[Record], folder: Path) -> None:
    """Write honesty.csv and convergence.csv: what `results.honesty` and `results.convergence` found."""
    _write_over_logs(honest, HONESTY, folder / "honesty.csv")
    _write_over_logs(converged, CONVERGENCE, folder / "convergence.csv")


def _write_over_logs(found: Sequence[Record], columns: Sequence[str], path: Path) -> None:
    """Write records over logs as CSV; a log is a regime there."""
    table = pd.DataFrame(found, columns=list(columns)).astype(dict.fromkeys({*COUNTS} & {*columns}, "Int64"))
    write_csv(table.rename(columns={"log": "regime", "label": "estimator"}), path)


def print_table(rows: Rows, console: Console | None = None, differences: Sequence[Record] = ()) -> None:
    """Print the tables of each log, the `differences` that `paired` found, and the remarks."""
    console, rows = console or terminal.console(), records(rows)
    print_logs(rows, console)
    print_differences(differences, console)
    print_remarks(rows, console)


def print_logs(rows: Rows, console: Console) -> None:
    """Print the tables of each log, but of none whose recording is not here.

    Accuracy and cost for every log; the floor where it was asked for; consistency and what was predicted where NIS was
    asked for, or seeds are enough for ANEES; late readings and outliers where there were any.
    """
    every = records(rows)
    here = [row for row in every if row["status"] != "absent"]
    for summary in groups(summarise(every if len(here) == len(every) else here), "log").values():
        found = [sheets.accuracy(summary), sheets.over_floor(summary)]
        found += [sheets.consistency(summary), sheets.prediction(summary)] if is_judged(summary) else []
        found.append(sheets.late_or_out(summary))
        for sheet in found:
            if sheet is not None:
                print_sheet(sheet, console)


def print_differences(differences: Sequence[Record], console: Console) -> None:
    """Print a table per baseline; what its columns mean stands under the last one."""
    found = sheets.differences(differences)
    for sheet in found:
        print_sheet(sheet, console, noted=sheet is found[-1])


def print_over_logs(honest: Sequence[Record], converged: Sequence[Record], console: Console) -> None:
    """Print ANEES of all logs in one table, where there are several and seeds are enough, and who converged."""
    for sheet in (over_logs.honesty(honest), over_logs.convergence(converged)):
        if sheet is not None:
            print_sheet(sheet, console)


def print_remarks(rows: Rows, console: Console) -> None:
    """Print a line for each run that did not finish, for results not to be trusted, and for what the runs noticed."""
    every = records(rows)
    for line in failures(every) + mostly_outside(every) + not_positive(summarise(every)):
        _print_line(line, "red", console)
    for line in waited(summarise(every)):
        _print_line(line, "yellow", console)
    for line, routine in notices.lines(every):
        _print_line(line, "dim" if routine else "yellow", console)


def _print_line(line: str, style: str, console: Console) -> None:
    """Print a line, folded between words where it is too long; a longer word stays whole."""
    told = folded(line, min(console.width, LETTERS))
    console.print(told, style=style, highlight=False, markup=False, soft_wrap=True)


def print_sheet(sheet: sheets.Sheet, console: Console, noted: bool = True) -> None:
    """Print a table; on a narrow console in parts, one below the other, so that no number is cut off."""
    whose, columns, title = _whose(sheet), _columns(sheet), sheet.title
    each = (_width(_table(sheet, [*whose, column], console.width), console) for column in columns)
    unfolded = console.width if max(each, default=0) <= console.width else 0
    while columns:
        fitting = len(columns)
        while fitting > 1 and _width(_table(sheet, whose + columns[:fitting], unfolded), console) > console.width:
            fitting -= 1
        console.print(_table(sheet, whose + columns[:fitting], unfolded))
        columns = columns[fitting:]
        sheet = replace(sheet, title=f"{title} (continued)" if title else "")
        if noted and not columns:
            console.print(Text("\n".join(sheet.notes), "table.caption"))
        console.print()


def _width(table: Table, console: Console) -> int:
    """Return how many columns of letters a table needs at least."""
    return console.measure(table, options=console.options.update_width(terminal.ANY_WIDTH)).minimum


def _whose(sheet: sheets.Sheet) -> list[tuple[str, ...]]:
    """Return the columns that tell, with the names, what a line is about: heading and texts of each."""
    lines = sheet.lines
    found = [("look-\nahead", *(line.lag for line in lines))] if any(line.lag for line in lines) else []
    return found + ([(sheet.section, *(line.section for line in lines))] if sheet.section else [])


def _columns(sheet: sheets.Sheet) -> list[tuple[str, ...]]:
    """Return the columns of numbers: heading and texts of each."""
    columns = []
    for k, heading in enumerate(sheet.headings[1:]):
        cells = [line.cells[k] for line in sheet.lines]
        width = max((len(cell.mark) for cell in cells), default=0)
        columns.append((heading, *(" ".join(_parts(cell, width)) for cell in cells)))
    return columns


def _parts(cell: Cell, width: int) -> Iterator[str]:
    """Yield what stands in a cell; marks are as wide as the widest of their column."""
    yield cell.text
    if width:
        yield f"{cell.mark:<{width}}"
    if cell.interval:
        yield cell.interval


def _table(sheet: sheets.Sheet, columns: Sequence[Sequence[str]], width: int) -> Table:
    """Lay out some columns of a table for a console of this width, with the names before them, each name once."""
    headings = [sheet.headings[0], *(column[0] for column in columns)]
    tall = any("\n" in heading for heading in headings)
    shown, above = [], ""
    for heading in headings:
        top, below = heading.split("\n") if "\n" in heading else ("", heading)
        shown.append(f"{'' if top == above else top}\n{below}" if tall else below)
        above = top
    names = [line.name for line in sheet.lines]
    table = terminal.plain_table(shown[0], names, sheet.title, width)
    for heading, (_, *texts) in zip(shown[1:], columns, strict=True):
        width = max(map(cell_len, (*heading.split("\n"), *texts)))
        table.add_column(heading, justify="right", no_wrap=True, min_width=width)
    for name, before, *texts in zip(names, ["", *names], *(column[1:] for column in columns), strict=False):
        table.add_row(Text("" if name == before else name), *map(Text, texts))
    return table
