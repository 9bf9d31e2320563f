"""Figures of an experiment: tracks, errors and their honesty over time, accuracy against cost; PDF and PNG."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..datasets.state import Array
from ..datasets.trajectory import Trajectory
from .ablation_figure import draw_ablation
from .consistency import FALSE_ALARM, anees_of
from .drawing import WIDTH_IN, Look, empty_figure, handle, logarithmic, looks_of, save
from .lag_figure import draw_lag_curve, lag_curve
from .metrics import BLOCKS, Alignment, ScoreError, align, associate
from .summary import Record, groups, is_judged, records, summarise

AXES = ("east", "north", "up")


class Track(NamedTuple):
    """One run's estimate beside the truth, associated and aligned, or alone where there is no truth."""

    label: str
    output: str
    align: Alignment
    truth: Trajectory | None
    estimate: Trajectory


def draw_figures(rows: pd.DataFrame, folder: Path, differences: Sequence[Record] = ()) -> list[Path]:
    """Draw every figure of an experiment into folder/figures and return the files.

    Args:
        rows: of the store; each simulated log is drawn with the first of its seeds.
        folder: the experiment's, with its trajectories.
        differences: what `paired` found.
    """
    every, summary = records(rows), summarise(rows)
    looks = looks_of([label for (label,) in groups(every, "label")])
    judged = {log for (log,), of_log in groups(summary, "log").items() if is_judged(of_log)}
    files = []
    for (log,), of_log in groups(every, "log").items():
        stem = folder / "figures" / re.sub(r"[^\w.=+-]+", "_", log)
        if log in judged and any(row["nees_at"] for row in of_log):
            files += save(draw_anees(of_log, looks, log), Path(f"{stem}-anees"))
        of_summary = [record for record in summary if record["log"] == log]
        if lag_curve(of_summary) is not None:
            files += save(draw_lag_curve(of_summary, looks, log), Path(f"{stem}-lag"))
        tracks, seed = tracks_of(of_log, folder / "trajectories")
        if not tracks:
            continue
        title = log if seed is None else f"{log}, seed {seed}"
        files += save(draw_tracks(tracks, looks, title), Path(f"{stem}-tracks"))
        if any(track.truth is not None for track in tracks):
            files += save(draw_errors(tracks, looks, title), Path(f"{stem}-errors"))
    known = [row for row in differences if row["ratio"] is not None]
    for (log,), of_log in groups(known, "baseline_log").items():
        stem = folder / "figures" / re.sub(r"[^\w.=+-]+", "_", log)
        files += save(draw_ablation(of_log, looks, log), Path(f"{stem}-ablation"))
    priced = [row for row in summary if row["ate_rmse_m"] is not None and row["real_time_factor"] is not None]
    if priced:
        files += save(draw_costs(priced, looks), folder / "figures" / "accuracy-cost")
    return files


def tracks_of(rows: Sequence[Record], folder: Path) -> tuple[list[Track], int | None]:
    """Read the trajectories of a log's first seed that has any; return (tracks, seed)."""
    saved = [row for row in rows if row["trajectory"] is not None and (folder / row["trajectory"]).is_file()]
    if not saved:
        return [], None
    seed = min((row["seed"] for row in saved if row["seed"] is not None), default=None)
    tracks = [_track(row, folder) for row in saved if row["seed"] == seed]
    return [track for track in tracks if track is not None], seed


def _track(row: Record, folder: Path) -> Track | None:
    estimate = load_trajectory(folder / row["trajectory"])
    if row["truth_trajectory"] is None:
        return Track(row["label"], row["output"], "none", None, estimate)
    try:
        truth, estimate = associate(load_trajectory(folder / row["truth_trajectory"]), estimate)
        return Track(row["label"], row["output"], row["align"], truth, align(truth, estimate, row["align"]))
    except ScoreError:  # it has no score either
        return None


def load_trajectory(path: Path) -> Trajectory:
    """Read a saved trajectory; of its covariance the 3 × 3 blocks are kept, the rest is NaN."""
    table = pd.read_parquet(path)
    if "P_0_0" in table:
        across = [f"P_{i}_{j}" for i in range(15) for j in range(i, 15)]
        table = table.reindex(columns=[*table.columns, *(name for name in across if name not in table)])
    return Trajectory.from_pandas(table)


def draw_tracks(tracks: Sequence[Track], looks: dict[str, Look], title: str) -> Figure:
    """Draw the tracks from above, equal axes; hindsight thin."""
    figure, (axes,) = empty_figure(1, 1, WIDTH_IN, 4.6)
    truth = next((track.truth for track in tracks if track.truth is not None), None)
    if truth is not None:
        axes.plot(*truth.p_WB_W[:, :2].T, color="black", linewidth=2.4, alpha=0.35, label="truth")
        axes.plot(*truth.p_WB_W[0, :2], marker="o", color="black", markersize=5, linestyle="none", label="start")
    labels = list(looks)
    for track in tracks:
        online = track.output == "online"
        width = 1.0 + 1.2 * (1 - labels.index(track.label) / len(labels))  # so that those below show
        axes.plot(
            *track.estimate.p_WB_W[:, :2].T,
            color=looks[track.label].colour,
            linestyle=looks[track.label].dash,
            linewidth=width if online else 0.5,
            label=track.label if online else None,
        )
    inside = [track.estimate.p_WB_W[:, :2] for track in tracks if _is_near(track)]
    inside += [truth.p_WB_W[:, :2]] if truth is not None else []
    if inside:  # a track that got lost may leave the picture
        axes.dataLim.update_from_data_xy(np.concatenate(inside), ignore=True)
        axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.set_title(f"{title}: tracks{_aligned(tracks)}", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize=8)
    return figure


def draw_errors(tracks: Sequence[Track], looks: dict[str, Look], title: str) -> Figure:
    """Draw the position error over time by axis, a row per estimator, with ±3σ where nothing was aligned."""
    tracks = [track for track in tracks if track.truth is not None]
    labels = list(dict.fromkeys(track.label for track in tracks))
    known = [axis for axis in range(3) if any(np.isfinite(_error(track)[:, axis]).any() for track in tracks)]
    figure, panels = empty_figure(len(labels), len(known), WIDTH_IN, 0.9 + 1.15 * len(labels))
    grid = np.reshape(np.array(panels, dtype=object), (len(labels), len(known)))
    for track in tracks:
        for axes, axis in zip(grid[labels.index(track.label)], known, strict=True):
            _draw_error(axes, track, axis, looks[track.label].colour)
    for label, row in zip(labels, grid, strict=True):
        row[0].set_ylabel(f"{fill(label, 14)}\nm", fontsize=7)
    for axes, axis in zip(grid[0], known, strict=True):
        axes.set_title(f"{AXES[axis]} error", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("time, s")
    figure.suptitle(f"{title}: errors{_aligned(tracks)}", fontsize=10)
    lines = [
        Line2D([], [], color="black", linewidth=1.2, label="online"),
    ]
    if any(track.output == "hindsight" for track in tracks):
        lines.append(Line2D([], [], color="black", linewidth=0.8, linestyle=":", label="with hindsight"))
    if any(_has_band(track) for track in tracks):
        lines.append(Line2D([], [], color="black", alpha=0.2, linewidth=6, label="±3σ, online"))
    figure.legend(handles=lines, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def _draw_error(axes: Axes, track: Track, axis: int, colour: str) -> None:
    online = track.output == "online"
    t_s = (track.estimate.t_ns - track.estimate.t_ns[0]) * 1e-9
    if online and _has_band(track):
        assert track.estimate.P is not None
        sigma = np.sqrt(track.estimate.P[:, 3 + axis, 3 + axis].clip(min=0))
        axes.fill_between(t_s, -3 * sigma, 3 * sigma, color=colour, alpha=0.2, linewidth=0)
    if online:
        axes.plot(t_s, _error(track)[:, axis], color=colour, linewidth=1.0)
    else:
        axes.plot(t_s, _error(track)[:, axis], color="black", linewidth=0.8, linestyle=":")
    axes.axhline(0, color="black", linewidth=0.4)


def draw_anees(rows: Sequence[Record], looks: dict[str, Look], title: str) -> Figure:
    """Draw the NEES of each block, averaged over the seeds, at the fixed times of one log, with the band of honesty.

    The band is that of the most seeds that any estimator has; hindsight is open and dotted.
    """
    figure, panels = empty_figure(len(BLOCKS), 1, WIDTH_IN, 1.2 + 1.5 * len(BLOCKS))
    done = [row for row in rows if row["status"] == "done"]
    lines = {key: anees_of([row["nees_at"] for row in of]) for key, of in groups(done, "label", "output").items()}
    for block, axes in zip(BLOCKS, panels, strict=True):
        averages = {key: of_line[block] for key, of_line in lines.items() if block in of_line}
        for (label, output), average in averages.items():
            online, look = output == "online", looks[label]
            style = {"marker": look.marker, "markersize": 4, "markerfacecolor": look.colour if online else "white"}
            axes.plot(
                average.t_s,
                average.value,
                color=look.colour,
                linestyle=look.dash if online else ":",
                linewidth=0.8,
                **style,
            )
        if averages:
            widest = max(averages.values(), key=lambda average: (average.runs.max(), len(average)))
            axes.axhspan(widest.low.min(), widest.high.max(), color="black", alpha=0.12, linewidth=0)
        axes.axhline(1, color="black", linewidth=0.4)
        logarithmic(axes, "y")
        axes.set_ylabel(block)
    panels[-1].set_xlabel("time, s")
    runs = max((int(average.runs.max()) for of_line in lines.values() for average in of_line.values()), default=0)
    figure.suptitle(f"{title}: NEES by degree of freedom, mean of {runs} seeds", fontsize=10)
    drawn = dict.fromkeys(label for (label, _), of_line in lines.items() if of_line)
    handles = [handle(label, looks[label].marker, looks[label].colour, True) for label in drawn]
    if any(output == "hindsight" for _, output in lines):
        handles.append(handle("with hindsight", "o", "black", False))
    band = f"{1 - FALSE_ALARM:.1%} of honest lines stay in here"
    handles.append(Line2D([], [], color="black", alpha=0.12, linewidth=6, label=band))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def draw_costs(summary: Sequence[Record], looks: dict[str, Look]) -> Figure:
    """Draw ATE against computing time per second of voyage, a panel per log; filled online, open with hindsight."""
    logs = groups(summary, "log")
    columns = min(2, len(logs))
    lines = math.ceil(len(logs) / columns)
    figure, panels = empty_figure(lines, columns, WIDTH_IN, 1.1 + 2.4 * lines, share_x=False)
    for axes in panels[len(logs) :]:
        axes.remove()
    for axes, ((log,), of_log) in zip(panels, logs.items(), strict=False):
        for (label,), of_label in groups(of_log, "label").items():
            look = looks[label]
            x_ms = [1000 / row["real_time_factor"] for row in of_label]
            y_m = [row["ate_rmse_m"] for row in of_label]
            axes.plot(x_ms, y_m, color=look.colour, linewidth=0.8)
            for x, y, row in zip(x_ms, y_m, of_label, strict=True):
                face, size = (look.colour, 8) if row["output"] == "online" else ("white", 5)
                style = {"marker": look.marker, "markersize": size, "markerfacecolor": face, "linestyle": "none"}
                axes.plot(x, y, color=look.colour, **style)
        first = of_log[0]
        axes.set_title(f"{log}\nalignment {first['align']}, {first['dims']}, {first['truth_kind']}", fontsize=8)
        axes.set_xlabel("computing, ms per second of voyage")
        axes.set_ylabel("ATE, m")
        axes.margins(0.12)
        logarithmic(axes, "xy")
    handles = [handle(label, looks[label].marker, looks[label].colour, True) for (label,) in groups(summary, "label")]
    if any(row["output"] == "hindsight" for row in summary):
        handles.append(handle("with hindsight", "o", "black", False))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def _error(track: Track) -> Array:
    assert track.truth is not None
    return track.estimate.p_WB_W - track.truth.p_WB_W


def _is_near(track: Track) -> bool:
    """Whether a track keeps within the truth's own extent of it."""
    if track.truth is None:
        return True
    return bool(np.abs(_error(track)[:, :2]).max() < np.ptp(track.truth.p_WB_W[:, :2], axis=0).max())


def _has_band(track: Track) -> bool:
    return track.align == "none" and track.estimate.P is not None


def _aligned(tracks: Sequence[Track]) -> str:
    modes = {track.align for track in tracks} - {"none"}
    return f" (aligned: {', '.join(sorted(modes))})" if modes else ""
