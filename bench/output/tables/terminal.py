"""Where tables are printed: as wide as the terminal, and 120 columns where there is none."""

from __future__ import annotations

from rich.console import Console

WIDTH = 120
"""Columns where there is no terminal: the widest table of the packaged experiments fits."""


def console() -> Console:
    """Return a console on standard output."""
    there = Console()
    return there if there.is_terminal else Console(width=WIDTH)
