"""Budgets, numbers that must not be exceeded or fallen short of, and `fathom timing budgets`, which measures them.

Nearly all are ratios, both sides measured within one command and taking turns. Where both sides are one thread of ours,
processor time is compared, so that a busy machine does not matter much. The rows stand in `budget_rows`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from ..output.tables.terminal import console
from .printing import COLOUR, progress, save, select


@dataclass(frozen=True)
class Measured:
    """Numbers, one per round, and a remark on them."""

    values: tuple[float, ...]
    note: str = ""

    @property
    def median(self) -> float:
        """The number that is compared with the limit."""
        return float(np.median(self.values))


@dataclass(frozen=True)
class Budget:
    """One row of the table of budgets.

    Attributes:
        name: numerator and denominator.
        limit: the number asked for.
        least: whether it is the least allowed (else the most).
        measure: measures it.
        obstacle: why it is missed, where that is known.
        unit: of the number; empty for a ratio.
    """

    name: str
    limit: float
    least: bool
    measure: Callable[[], Measured]
    obstacle: str = ""
    unit: str = ""

    def holds(self, measured: Measured) -> bool:
        """Return whether the median keeps to the limit."""
        return measured.median >= self.limit if self.least else measured.median <= self.limit


def take_turns(over: Callable[[], object], under: Callable[[], object], rounds: int) -> tuple[float, ...]:
    """Return the ratio of two calls' processor times, one per round A B B A, of the faster of each two."""

    def spent(call: Callable[[], object]) -> float:
        started = time.process_time()
        call()
        return time.process_time() - started

    ratios = []
    for _ in range(rounds):
        a, b, c, d = spent(over), spent(under), spent(under), spent(over)
        ratios.append(min(a, d) / min(b, c))
    return tuple(ratios)


def print_budgets(known: Sequence[Budget], only: str | None, out: Path | None) -> bool:
    """Measure budgets, print each as soon as it is measured, save them, and return whether all hold.

    Interrupted, it saves what it has and raises KeyboardInterrupt.
    """
    chosen = select(known, only)
    width = max(len(budget.name) for budget in chosen)
    terminal = console()

    def line(cells: Sequence[str], style: str = "") -> None:
        name, limit, median, extent, verdict = cells
        terminal.print(Text(f"{name:{width}}  {limit:>9}  {median:>8}  {extent:>15}  {verdict}".rstrip(), style))

    line(("what over what", "budget", "measured", "from – to", "verdict"), "bold")
    rows: list[dict[str, Any]] = []
    try:
        with progress() as advance:
            for k, budget in enumerate(chosen):
                advance(budget.name, k / len(chosen))
                rows.append(_row(budget))
                line(_cells(budget, rows[-1]), COLOUR.get(rows[-1]["verdict"], ""))
                if rows[-1]["note"]:
                    terminal.print(Text(f"    {rows[-1]['note']}"))
    finally:
        save(out, {"budgets": rows})
    terminal.print("median of the rounds, in which both sides take turns; then the least and the largest round")
    return all(row["verdict"] == "holds" for row in rows)


def _row(budget: Budget) -> dict[str, Any]:
    """Measure a budget, and return what is saved of it."""
    limit = f"{'≥' if budget.least else '≤'} {budget.limit:g} {budget.unit}".rstrip()
    row = {"name": budget.name, "budget": limit, "verdict": "not measured", "note": "", "values": []}
    try:
        measured = budget.measure()
    except ModuleNotFoundError as error:
        return row | {"note": f"{error.name} is not installed: pip install 'fathom-bench[dev]'"}
    holds = budget.holds(measured)
    note = "; ".join(filter(None, (measured.note, "" if holds else budget.obstacle)))
    return row | {"verdict": "holds" if holds else "missed", "note": note, "values": list(measured.values)}


def _cells(budget: Budget, row: dict[str, Any]) -> tuple[str, str, str, str, str]:
    values = row["values"]
    if not values:
        return row["name"], row["budget"], "–", "–", row["verdict"]
    median = f"{np.median(values):.3g} {budget.unit}".rstrip()
    return row["name"], row["budget"], median, f"{min(values):.3g} – {max(values):.3g}", row["verdict"]
