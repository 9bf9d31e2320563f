"""Consistency of covariances: NEES over time, averaged over seeds, with its chi-square intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...drawing import (
    TEXT_PT,
    TITLE_PT,
    WIDTH_IN,
    Look,
    band_handle,
    empty_figure,
    legend_below,
    logarithmic,
    look_handle,
    title_above,
)
from ...metrics.consistency import Average, anees_of, interval
from ...metrics.state_error import BLOCKS, DOF
from ...results.summary import Record, groups
from ..cells import NEES_OVER_DOF, ONLINE, SMOOTHED, TIME

POINTWISE = 0.95
"""Of the dark band: a consistent estimator's points lie in it with this probability, each by itself."""
FITS_A_PANEL = 12
"""Lines of a legend that fit in place of a sixth panel."""
WIDEST_IN_A_PANEL = 32
"""Letters of a legend's line that fit there."""


def draw_nees(rows: Sequence[Record], looks: dict[str, Look], title: str) -> Figure:
    """Draw the NEES of each block, averaged over the seeds, at the fixed times of one log, with two chi-square bands.

    A consistent estimator has 95 % of its points in the dark band, each time by itself; 99.9 % of consistent estimators
    stay in the pale band at all times, see `metrics.consistency`. Both bands are those of the estimator with the most
    seeds. Smoothed lines are dotted, with open markers.

    Args:
        rows: of one log.
        looks: by label.
        title: the log's name.
    """
    done = [row for row in rows if row["status"] == "done"]
    lines = {key: anees_of([row["nees_at"] for row in of]) for key, of in groups(done, "label", "output").items()}
    figure, panels = empty_figure(2, 3, WIDTH_IN, 4.0)
    for block, axes in zip(BLOCKS, panels, strict=False):
        averages = {key: of_line[block] for key, of_line in lines.items() if block in of_line}
        for (label, output), average in averages.items():
            online, look = output == ONLINE, looks[label]
            axes.plot(
                average.t_s,
                average.value,
                color=look.colour,
                linestyle=look.dash if online else ":",
                linewidth=0.8,
                marker=look.marker,
                markersize=3.5,
                markeredgewidth=0.7,
                markerfacecolor=look.colour if online else "white",
            )
        axes.axhline(1, color="black", linewidth=0.4)
        if averages:
            _draw_bands(axes, max(averages.values(), key=lambda average: (average.runs.max(), len(average))))
        axes.set_title(f"{block}, {DOF[block]} dof", fontsize=TITLE_PT)
    for axes in panels[3:5]:
        axes.set_xlabel(TIME)
    panels[2].set_xlabel(TIME)
    panels[2].tick_params(labelbottom=True)
    for axes in panels[::3]:
        axes.set_ylabel(NEES_OVER_DOF)
    runs = max((int(average.runs.max()) for of_line in lines.values() for average in of_line.values()), default=0)
    over = f"mean of {runs} seeds" if runs > 1 else "one run"
    title_above(figure, f"{title}: normalised estimation error squared (NEES) over its degrees of freedom, {over}")
    handles = [
        look_handle(label, looks[label]) for label in dict.fromkeys(label for (label, _), of in lines.items() if of)
    ]
    if any(output == SMOOTHED for (_, output), of_line in lines.items() if of_line):
        dotted = {"marker": "o", "markersize": 3.5, "markerfacecolor": "white", "linestyle": ":", "linewidth": 0.8}
        handles.append(Line2D([], [], color="black", label=SMOOTHED, **dotted))
    handles.append(band_handle("95 % of consistent points", 0.25))
    handles.append(band_handle("99.9 % of consistent lines", 0.1))
    panels[5].axis("off")
    if len(handles) <= FITS_A_PANEL and max(len(str(handle.get_label())) for handle in handles) < WIDEST_IN_A_PANEL:
        panels[5].legend(handles=handles, loc="center", frameon=False, fontsize=TEXT_PT)
    else:
        legend_below(figure, handles)
    return figure


def _draw_bands(axes: Axes, average: Average) -> None:
    """Draw where a consistent average lies; the dark band and the points set the scale."""
    low, high = interval(np.array([average.dof.max()]), POINTWISE)
    axes.axhspan(float(low[0]), float(high[0]), color="black", alpha=0.15, linewidth=0)
    logarithmic(axes, "y")
    limits = axes.get_ylim()
    axes.axhspan(average.low.min(), average.high.max(), color="black", alpha=0.1, linewidth=0)
    axes.set_ylim(limits)
