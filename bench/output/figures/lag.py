"""Accuracy, floor and cost against lag: one figure per log on which one estimator ran at several lags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...drawing import WIDTH_IN, Look, empty_figure, handle, legend_below, logarithmic, title_above
from ...metrics.floor_ratio import OVER
from ...results.summary import Record, groups
from ..cells import COMPUTING, ONLINE, SMOOTHED, column, lag

FEWEST_LAGS = 3
"""Two points are no curve."""


def lag_curve(summary: Sequence[Record]) -> str | None:
    """Return the estimator that one log's records hold at three lags or more; None if no estimator does."""
    for (name,), of_name in groups(summary, "estimator").items():
        lags = [row["lookahead_s"] for row in of_name if row["output"] == SMOOTHED]
        if len(lags) == len(set(lags)) >= FEWEST_LAGS:  # two variants at one lag are no curve
            return name
    return None


def draw_lag_curve(summary: Sequence[Record], looks: dict[str, Look], title: str) -> Figure:
    """Draw RMSE (pooled over seeds) and cost of one log against lag.

    The estimator that ran at several lags is the curve: online filled, smoothed open. Filters stand at 0 with a line
    across, other smoothers at their lag. The thick black line is the floor, where it is known.
    """
    curve = lag_curve(summary)
    ahead = {row["label"]: row["lookahead_s"] for row in summary if row["output"] == SMOOTHED}
    ticks = sorted({*ahead.values(), 0.0})
    figure, panels = empty_figure(2, 2, WIDTH_IN, 4.8)
    curve_last = sorted(summary, key=lambda row: row["estimator"] == curve)  # other sensors have another floor
    for axes, (block, (score, floor)) in zip(panels, OVER.items(), strict=False):
        bound = {row["lookahead_s"]: row[floor] for row in curve_last if row[floor] is not None}
        known = [seen for seen in ticks if seen in bound]
        axes.plot([ticks.index(seen) for seen in known], [bound[seen] for seen in known], color="black", linewidth=1.6)
        _draw(axes, summary, looks, ahead, ticks, curve, score)
        axes.set_ylabel(f"{block} error ({column(score).unit})")
    priced = [row | {"cost": 1e3 / row["real_time_factor"]} for row in summary if row["real_time_factor"]]
    online = [row for row in priced if row["output"] == ONLINE]
    _draw(panels[3], online, looks, ahead, ticks, curve, "cost")
    panels[3].set_ylabel(COMPUTING)
    for axes in panels:
        logarithmic(axes, "y")
        axes.set_xticks(range(len(ticks)), [lag(seen).removesuffix(" s") for seen in ticks])
    for axes in panels[2:]:
        axes.set_xlabel("lag (s)")
    runs = max(row["done"] for row in summary)
    over = f"{runs} seeds" if runs > 1 else "one run"
    title_above(figure, f"{title}: root mean square errors, floor and cost against lag, {over}")
    shown = [rows[0] for (name,), rows in groups(summary, "estimator").items() if name == curve]
    shown += [rows[0] for (name, _), rows in groups(summary, "estimator", "label").items() if name != curve]
    handles = [
        handle(
            row["estimator"] if row["estimator"] == curve else row["label"],
            looks[row["label"]].marker,
            looks[row["label"]].colour,
            True,
            "-" if row["estimator"] == curve else "none" if row["label"] in ahead else _across(looks[row["label"]]),
        )
        for row in shown
    ]
    handles.append(handle(SMOOTHED, "o", "black", False))
    if any(row[floor] is not None for row in summary for _, floor in OVER.values()):
        handles.append(Line2D([], [], color="black", linewidth=1.6, label="floor (Cramér–Rao)"))
    legend_below(figure, handles)
    return figure


def _across(look: Look) -> Any:
    """Return the dash of a filter's line; the curve alone is a full one."""
    return (0, (8, 2)) if look.dash == "-" else look.dash


def _draw(
    axes: Axes,
    summary: Sequence[Record],
    looks: dict[str, Look],
    ahead: dict[str, float],
    ticks: Sequence[float],
    curve: str | None,
    score: str,
) -> None:
    """Draw one score of every estimator: the curve, points at the lags of smoothers, and lines of filters."""
    rows = [row for row in summary if row[score] is not None]
    own = [row for row in rows if row["estimator"] == curve and row["label"] in ahead]
    for (output,), of_output in groups(own, "output").items():
        look = looks[own[0]["label"]]
        points = sorted((ticks.index(ahead[row["label"]]), row[score]) for row in of_output)
        face = look.colour if output == ONLINE else "white"
        style = {"marker": look.marker, "markerfacecolor": face, "markersize": 5, "linewidth": 1.0}
        axes.plot(*zip(*points, strict=True), color=look.colour, **style)
    for row in rows:
        look = looks[row["label"]]
        if row["label"] not in ahead:
            axes.axhline(row[score], color=look.colour, linestyle=_across(look), linewidth=1.0)
            axes.plot(0, row[score], color=look.colour, marker=look.marker, markersize=5, linestyle="none")
        elif row["estimator"] != curve:
            face = look.colour if row["output"] == ONLINE else "white"
            at = ticks.index(ahead[row["label"]])
            axes.plot(
                at,
                row[score],
                color=look.colour,
                marker=look.marker,
                markersize=5,
                markerfacecolor=face,
                linestyle="none",
            )
