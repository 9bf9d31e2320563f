"""The console for tables: as wide as the terminal, or 120 columns without a terminal."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

WIDTH = 120
"""Columns of output to a file or a pipe: enough for the tables of README."""
NAME_WIDTH = 14
"""The names of estimators are not folded to less than this many letters: they would be hard to read."""


def console() -> Console:
    """Return a console on standard output."""
    there = Console()
    return there if there.is_terminal else Console(width=WIDTH)


def plain_table(names: str, title: str | None = None) -> Table:
    """Return a table without frames that has one column yet: of names, which are folded where there is no room."""
    table = Table(
        title=None if title is None else Text(title, "table.title"),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column(names, overflow="fold", min_width=NAME_WIDTH)
    return table
