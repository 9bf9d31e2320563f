"""One seed's estimates beside the truth: tracks from above, and position errors over time with their 3σ bounds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ....datasets.state import POSITION
from ...drawing import (
    COLUMN_IN,
    TEXT_PT,
    TITLE_PT,
    WIDTH_IN,
    Look,
    band_handle,
    empty_figure,
    legend_below,
    look_handle,
    narrow,
    title_above,
)
from ..cells import DIRECTIONS, ONLINE, SMOOTHED, TIME
from ..estimates import Track, error_m, has_bounds, is_near

MARKS = 6
"""How many markers a track has."""
MOST_ROWS = 6
"""More estimators than this do not fit one page of errors."""
SMOOTHED_LINE: dict[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": (0, (1, 1.2))}
BOUND: dict[str, Any] = {"color": "black", "linewidth": 0.5, "linestyle": (0, (6, 2))}


def draw_tracks(tracks: Sequence[Track], looks: dict[str, Look], title: str) -> Figure:
    """Draw the tracks from above, equal axes; smoothed tracks are thin, with open markers."""
    truth = next((track.truth for track in tracks if track.truth is not None), None)
    kind = next((track.truth_kind for track in tracks if track.truth is not None), "truth")
    near = [track.estimate.p_WB_W[:, :2] for track in tracks if is_near(track)]
    near += [truth.p_WB_W[:, :2]] if truth is not None else []
    inside = np.concatenate(near) if near else np.zeros((1, 2))
    wide, high = np.ptp(inside, axis=0).clip(1e-3)
    figure, (axes,) = empty_figure(1, 1, COLUMN_IN, 0.7 + 2.9 * float(np.clip(high / wide, 0.4, 1.3)))
    handles = []
    if truth is not None:
        axes.plot(*truth.p_WB_W[:, :2].T, color="black", linewidth=2.4, alpha=0.35)
        axes.plot(*truth.p_WB_W[0, :2], marker="o", color="black", markersize=5, linestyle="none")
        handles.append(Line2D([], [], color="black", linewidth=2.4, alpha=0.35, label=kind))
        handles.append(Line2D([], [], color="black", marker="o", markersize=5, linestyle="none", label="start"))
    labels = list(looks)
    for track in tracks:
        online, look, place = track.output == ONLINE, looks[track.label], labels.index(track.label)
        points = len(track.estimate.t_ns)
        every = max(1, points // MARKS)
        first = int((place + (0.5 if not online else 0.0)) / len(labels) * every)  # so that none hides another's
        axes.plot(
            *track.estimate.p_WB_W[:, :2].T,
            color=look.colour,
            linestyle=look.dash if online else "-",
            linewidth=1.0 + 0.8 * (1 - place / len(labels)) if online else 0.5,  # so that those below show
            marker=look.marker,
            markersize=3.5,
            markeredgewidth=0.5,
            markerfacecolor=look.colour if online else "white",
            markevery=(min(first, points - 1), every),
        )
    axes.dataLim.update_from_data_xy(inside, ignore=True)  # a track that got lost may leave the figure
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{DIRECTIONS[0]} (m)", ylabel=f"{DIRECTIONS[1]} (m)")
    title_above(figure, f"{title}: tracks{_aligned(tracks)}")
    drawn = dict.fromkeys(track.label for track in tracks)
    handles += [look_handle(label, looks[label]) for label in drawn]
    if any(track.output == SMOOTHED for track in tracks):
        open_marker = {"marker": "o", "markersize": 3.5, "markerfacecolor": "white", "markeredgewidth": 0.5}
        handles.append(Line2D([], [], color="black", linewidth=0.5, label=SMOOTHED, **open_marker))
    legend_below(figure, handles, most=3)
    return figure


def pages_of(tracks: Sequence[Track]) -> Iterator[list[Track]]:
    """Yield the tracks that have a truth, as many estimators at a time as fit a page of `draw_errors`."""
    known = [track for track in tracks if track.truth is not None]
    labels = list(dict.fromkeys(track.label for track in known))
    for k in range(0, len(labels), MOST_ROWS):
        yield [track for track in known if track.label in labels[k : k + MOST_ROWS]]


def draw_errors(tracks: Sequence[Track], looks: dict[str, Look], title: str) -> Figure:
    """Draw the position error over time by axis, a row per estimator, with ±3σ where the track was not aligned."""
    tracks = [track for track in tracks if track.truth is not None]
    labels = list(dict.fromkeys(track.label for track in tracks))
    known = [axis for axis in range(3) if any(np.isfinite(error_m(track)[:, axis]).any() for track in tracks)] or [0]
    figure, panels = empty_figure(len(labels), len(known), WIDTH_IN, 0.6 + 1.15 * len(labels))
    grid = np.reshape(np.array(panels, dtype=object), (len(labels), len(known)))
    for track in tracks:
        for axes, axis in zip(grid[labels.index(track.label)], known, strict=True):
            _draw_error(axes, track, axis, looks[track.label].colour)
    for label, row in zip(labels, grid, strict=True):
        row[0].set_ylabel(narrow(label, 18), fontsize=TEXT_PT)
    for axes, axis in zip(grid[0], known, strict=True):
        axes.set_title(f"{DIRECTIONS[axis]} error (m)", fontsize=TITLE_PT)
    for axes in grid[-1]:
        axes.set_xlabel(TIME)
    title_above(figure, f"{title}: errors{_aligned(tracks)}")
    smoothed = [track for track in tracks if track.output == SMOOTHED]
    handles = [Line2D([], [], color="black", linewidth=1.0, label=ONLINE)]
    if any(has_bounds(track) for track in tracks if track.output == ONLINE):
        handles.append(band_handle(f"±3σ, {ONLINE}", 0.2))
    if smoothed:
        handles.append(Line2D([], [], **SMOOTHED_LINE, label=SMOOTHED))
    if any(has_bounds(track) for track in smoothed):
        handles.append(Line2D([], [], **BOUND, label=f"±3σ, {SMOOTHED}"))
    legend_below(figure, handles)
    return figure


def _draw_error(axes: Axes, track: Track, axis: int, colour: str) -> None:
    online = track.output == ONLINE
    t_s = (track.estimate.t_ns - track.estimate.t_ns[0]) * 1e-9
    if has_bounds(track):
        assert track.estimate.P is not None
        variance = track.estimate.P[:, POSITION, POSITION][:, axis, axis]
        there = np.isfinite(variance)  # some smoothers keep the covariance of some states only
        t_there_s, bound = t_s[there], 3 * np.sqrt(variance[there].clip(min=0))
        if online:
            axes.fill_between(t_there_s, -bound, bound, color=colour, alpha=0.2, linewidth=0)
        else:
            axes.plot(t_there_s, bound, **BOUND)
            axes.plot(t_there_s, -bound, **BOUND)
    style = {"color": colour, "linewidth": 1.0} if online else SMOOTHED_LINE
    axes.plot(t_s, error_m(track)[:, axis], **style)
    axes.axhline(0, color="black", linewidth=0.4)


def _aligned(tracks: Sequence[Track]) -> str:
    modes = {track.align for track in tracks} - {"none"}
    return f" (aligned: {', '.join(sorted(modes))})" if modes else ""
