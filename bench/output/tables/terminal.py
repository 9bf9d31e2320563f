"""Where tables are printed: as wide as the terminal, and 120 columns where there is none."""

from __future__ import annotations

from rich.console import Console

WIDTH = 120
"""Columns of output to a file or a pipe: enough for the tables of README."""


def console() -> Console:
    """Return a console on standard output."""
    there = Console()
    return there if there.is_terminal else Console(width=WIDTH)
