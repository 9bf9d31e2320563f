"""Honesty at a glance: ANEES of every estimator and log, a panel for each block, with the band of consistent ones."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...drawing import (
    TITLE_PT,
    WIDTH_IN,
    Look,
    band_handle,
    empty_figure,
    handle,
    legend_below,
    narrow,
    title_above,
)
from ...metrics.state_error import BLOCKS
from ...results.honesty import band_of
from ...results.summary import Record, groups
from ..cells import NEES_OVER_DOF, ONLINE, SMOOTHED

LEAST, MOST = 0.3, 30.0
"""Ends of the axis: the band of fifty seeds reaches from 0.7 to 1.4, and beyond 30 it does not matter how far."""
LINE_IN = 0.055
"""Height of one output's line: a marker and a gap."""
BAND_ALPHA = 0.12
"""Pale, as markers stand on it."""
LETTERS = 22
"""Of a log's name in one line, beside the first panel."""


def draw_honesty(rows: Sequence[Record], looks: dict[str, Look]) -> Figure:
    """Draw the mean ANEES of each output; the grey band is where 99 % of consistent ones stay at all times.

    Online is filled, smoothed is open. A triangle at an edge is beyond it, a cross stands for an output of which no run
    finished.

    Args:
        rows: what `results.honesty.compared` returns.
        looks: by label.
    """
    by_log = {log: list(groups(of, "label", "output").values()) for (log,), of in groups(rows, "log").items()}
    lines = sum(len(of) + 1 for of in by_log.values())
    figure, panels = empty_figure(1, len(BLOCKS), WIDTH_IN, 0.9 + LINE_IN * lines)
    for block, axes in zip(BLOCKS, panels, strict=True):
        band = band_of(rows, block)
        if band is not None:
            axes.axvspan(*band, color="black", alpha=BAND_ALPHA, linewidth=0)
        axes.axvline(1.0, color="black", linewidth=0.4)
        axes.set(xscale="log", xlim=(LEAST, MOST), ylim=(lines, -1))
        axes.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
        axes.minorticks_off()
        axes.set_title(block, fontsize=TITLE_PT)
        axes.grid(visible=False, axis="y")
        _draw(axes, by_log, block, looks)
    panels[len(BLOCKS) // 2].set_xlabel(NEES_OVER_DOF)
    times, seeds = (max(row[name] or 0 for row in rows) for name in ("times", "seeds"))
    title_above(figure, f"ANEES: mean over {times} fixed times, {seeds} seeds")
    labels = dict.fromkeys(row["label"] for row in rows)
    handles = [handle(label, looks[label].marker, looks[label].colour, filled=True) for label in labels]
    handles.append(handle(SMOOTHED, "o", "black", filled=False))
    handles.append(band_handle("99 % band", BAND_ALPHA))
    handles.append(handle("no run finished", "x", "black", filled=True))
    legend_below(figure, handles)
    return figure


def _draw(axes: Axes, by_log: dict[str, list[list[Record]]], block: str, looks: dict[str, Look]) -> None:
    """Draw one block: a line for each output, an empty one between logs, whose names stand at the left panel."""
    line, middles = 0, []
    for outputs in by_log.values():
        middles.append(line + (len(outputs) - 1) / 2)
        for of in outputs:
            row = next(row for row in of if row["block"] == block)
            look = looks[row["label"]]
            face = look.colour if row["output"] == ONLINE else "white"
            style = {"color": look.colour, "markerfacecolor": face, "markersize": 3, "markeredgewidth": 0.7}
            value, marker = row["anees"], look.marker
            if value is None:
                value, marker = MOST, "" if row["seeds"] else "x"
            elif not LEAST < value < MOST:
                value, marker = (MOST, ">") if value >= MOST else (LEAST, "<")
            axes.plot(value, line, marker=marker, linestyle="none", clip_on=False, **style)
            line += 1
        axes.axhline(line, color="black", linewidth=0.3, alpha=0.4)
        line += 1
    place = axes.get_subplotspec()
    if place is not None and place.is_first_col():
        axes.set_yticks(middles, [narrow(log, LETTERS) for log in by_log])
    else:
        axes.set_yticks([])
    axes.tick_params(axis="y", length=0)
