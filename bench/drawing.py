"""Style of all figures: one look per estimator, panels, axes, legends, and the files they are saved as.

Figures are made for a journal's page: one or two columns wide, letters of 7 and 8 points, TrueType fonts in the PDF.
Markers and dashes repeat what colours say, for grey prints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from textwrap import fill, wrap
from typing import NamedTuple
from warnings import catch_warnings, filterwarnings

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#B8A000")
"""Colours of Okabe & Ito, distinct to readers with any colour vision; black is the truth."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1, 1, 1)))
COLUMN_IN, WIDTH_IN = 3.5, 7.16
"""One column of a journal's page, and both."""
TITLE_PT, TEXT_PT = 8, 7
"""Points: journals ask for at least 6 to 7 in print."""
LETTER_IN = 0.6 / 72
"""Width of a letter per point of its size, on the safe side."""
DPI = 300
"""Of PNG files; journals ask for at least 300."""
LONGEST = 46
"""A label with more letters than this is wrapped in the legend: half of a page's width."""


class Look(NamedTuple):
    """How one estimator is drawn in every figure."""

    colour: str
    marker: str
    dash: str | tuple[int, tuple[float, ...]]


def looks_of(labels: Sequence[str]) -> dict[str, Look]:
    """Give each label a look; no two share colour and marker until there are 64, colour and dash until there are 32."""
    markers = [m for shift in range(len(MARKERS)) for m in MARKERS[shift:] + MARKERS[:shift]]
    dashes = [DASHES[(k + k // len(PALETTE)) % len(DASHES)] for k in range(len(PALETTE) * len(DASHES))]
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
    with rc_context({"axes.labelsize": TITLE_PT, "axes.titlesize": TITLE_PT, "font.size": TEXT_PT}):
        grid = figure.subplots(lines, columns, squeeze=False, sharex=share_x, height_ratios=heights)
    panels: list[Axes] = list(grid.ravel())
    for axes in panels:
        axes.tick_params(labelsize=TEXT_PT)
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def plain(text: str) -> str:
    """Escape a text for matplotlib: "$" begins no mathematics, and a leading "_" does not hide a label."""
    return text.replace("$", r"\$").replace("_", " _", 1) if text.startswith("_") else text.replace("$", r"\$")


def narrow(text: str, letters: int, lines: int = 3) -> str:
    """Wrap a text into at most so many lines of so many letters, escaped for matplotlib."""
    return plain("\n".join(wrap(text, letters, max_lines=lines, placeholder=" …")))


def title_above(figure: Figure, title: str) -> None:
    """Put a title above all panels, in as many lines as it needs."""
    letters = int(figure.get_figwidth() / (TITLE_PT * LETTER_IN))
    figure.suptitle("\n".join(plain(fill(line, letters)) for line in title.splitlines()), fontsize=TITLE_PT)


def legend_below(figure: Figure, handles: Sequence[Artist], most: int = 4) -> None:
    """Put a legend below all panels, in as many columns as have room, and let the figure grow by it."""
    names = [fill(str(handle.get_label()), LONGEST) for handle in handles]
    for artist, name in zip(handles, names, strict=True):
        artist.set_label(name)
    longest = max((len(line) for name in names for line in name.splitlines()), default=0)
    columns = min(most, max(1, int(figure.get_figwidth() / (0.5 + longest * TEXT_PT * LETTER_IN))))
    lines = sum(max(name.count("\n") + 1 for name in names[k : k + columns]) for k in range(0, len(names), columns))
    figure.set_figheight(figure.get_figheight() + 0.1 + lines * 1.7 * TEXT_PT / 72)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=TEXT_PT, handlelength=2.6
    )


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


def handle(
    label: str, marker: str, colour: str, filled: bool, line: str | tuple[int, tuple[float, ...]] = "none"
) -> Line2D:
    """Return the legend entry of an estimator."""
    face = colour if filled else "white"
    style = {"marker": marker, "markersize": 4.5, "markerfacecolor": face, "linestyle": line, "linewidth": 1.0}
    return Line2D([], [], color=colour, label=plain(label), **style)


def look_handle(label: str, look: Look) -> Line2D:
    """Return the legend entry of an estimator that is drawn as a line with markers."""
    return handle(label, look.marker, look.colour, True, look.dash)


def band_handle(label: str, alpha: float) -> Line2D:
    """Return the legend entry of a grey band."""
    return Line2D([], [], color="black", alpha=alpha, linewidth=6, label=label)


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PDF, with its fonts as TrueType, and as PNG, and return the files."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    files = [Path(f"{stem}.pdf"), Path(f"{stem}.png")]
    with rc_context({"pdf.fonttype": 42}), catch_warnings():
        filterwarnings("ignore", "Glyph .* missing from", UserWarning)  # a name in letters that the font has not
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # computed once, for both files
        for file in files:
            figure.savefig(file, dpi=DPI, metadata={"CreationDate": None} if file.suffix == ".pdf" else {})
    return files
