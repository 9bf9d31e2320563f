"""How every figure looks: one look per estimator, panels, axes, and the files they are saved as."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Literal, NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#B8A000")
"""Okabe & Ito's colours, which readers with any colour vision tell apart; black is the truth's."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1, 1, 1)))
WIDTH_IN = 7.2


class Look(NamedTuple):
    """How one estimator is drawn in every figure."""

    colour: str
    marker: str
    dash: str | tuple[int, tuple[float, ...]]


def looks_of(labels: Sequence[str]) -> dict[str, Look]:
    """Give each label a look; no two share colour and marker until there are 64."""
    markers = [m for shift in range(len(MARKERS)) for m in MARKERS[shift:] + MARKERS[:shift]]
    dashes = [dash for dash in DASHES for _ in PALETTE]
    return {
        label: Look(*look)
        for label, look in zip(labels, zip(cycle(PALETTE), cycle(markers), cycle(dashes)), strict=False)
    }


def empty_figure(
    lines: int,
    columns: int,
    width_in: float,
    height_in: float,
    share_x: bool = True,
    heights: Sequence[float] | None = None,
) -> tuple[Figure, list[Axes]]:
    """Return a figure that needs no display, and its axes row by row; `heights` are those of the rows to each other."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    with rc_context({"axes.labelsize": 8, "axes.titlesize": 9}):
        grid = figure.subplots(lines, columns, squeeze=False, sharex=share_x, height_ratios=heights)
    panels: list[Axes] = list(grid.ravel())
    for axes in panels:
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def logarithmic(axes: Axes, which: str) -> None:
    """Make the axes "x", "y" or both logarithmic, with plain numbers at 1, 2 and 5, over at least a factor of four."""
    for name in which:
        axis = axes.xaxis if name == "x" else axes.yaxis
        axes.set(**{f"{name}scale": "log"})
        low, high = axis.get_view_interval()
        middle = math.sqrt(low * high)
        axis.set_view_interval(min(low, middle / 2), max(high, middle * 2), ignore=True)
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high / low < 1e3 else (1.0,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())


def handle(label: str, marker: str, colour: str, filled: bool, line: Literal["none", "-", "--"] = "none") -> Line2D:
    """Return what stands for an estimator in a legend."""
    face = colour if filled else "white"
    return Line2D([], [], marker=marker, color=colour, markerfacecolor=face, linestyle=line, label=label)


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PDF and PNG and return the files."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    files = [Path(f"{stem}.pdf"), Path(f"{stem}.png")]
    for file in files:
        figure.savefig(file, dpi=160, metadata={"CreationDate": None} if file.suffix == ".pdf" else {})
    return files
