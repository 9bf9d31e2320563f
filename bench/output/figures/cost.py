"""Accuracy against cost: ATE against computing time, a panel per log."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from ...results.summary import Record, groups
from ..cells import COMPUTING, ONLINE, SMOOTHED, column
from .drawing import COLUMN_IN, TITLE_PT, WIDTH_IN, Look, empty_figure, handle, legend_below, logarithmic, narrow


def priced(summary: Sequence[Record]) -> list[Record]:
    """Return the records that have both an accuracy and a cost."""
    return [row for row in summary if row["ate_rmse_m"] is not None and row["real_time_factor"] is not None]


def draw_costs(summary: Sequence[Record], looks: dict[str, Look]) -> Figure:
    """Draw ATE against computing time per second of the log, a panel per log: online filled, smoothed open."""
    logs = groups(summary, "log")
    columns = min(2, len(logs))
    lines = math.ceil(len(logs) / columns)
    width_in = WIDTH_IN if columns > 1 else COLUMN_IN
    figure, panels = empty_figure(lines, columns, width_in, 0.3 + 2.4 * lines, share_x=False)
    for axes in panels[len(logs) :]:
        axes.remove()
    for axes, ((log,), of_log) in zip(panels, logs.items(), strict=False):
        for (label,), of_label in groups(of_log, "label").items():
            look = looks[label]
            x_ms = [1000 / row["real_time_factor"] for row in of_label]
            y_m = [row["ate_rmse_m"] for row in of_label]
            axes.plot(x_ms, y_m, color=look.colour, linewidth=0.8)
            for x, y, row in zip(x_ms, y_m, of_label, strict=True):
                face, size = (look.colour, 6) if row["output"] == ONLINE else ("white", 4)
                style = {"marker": look.marker, "markersize": size, "markerfacecolor": face, "linestyle": "none"}
                axes.plot(x, y, color=look.colour, **style)
        first = of_log[0]
        settings = f"alignment {first['align']}, {first['dims']}, {first['truth_kind']}"
        axes.set_title(f"{narrow(log, 50)}\n{settings}", fontsize=TITLE_PT)
        axes.set_xlabel(COMPUTING)
        axes.set_ylabel(column("ate_rmse_m").axis)
        axes.margins(0.12)
        logarithmic(axes, "xy")
    handles = [handle(label, looks[label].marker, looks[label].colour, True) for (label,) in groups(summary, "label")]
    if any(row["output"] == SMOOTHED for row in summary):
        handles.append(handle(SMOOTHED, "o", "black", False))
    legend_below(figure, handles)
    return figure
