"""The effect of each variant: its scores over its baseline's as bars with intervals; a figure per baseline's log."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator

from ...drawing import TEXT_PT, TITLE_PT, WIDTH_IN, Look, empty_figure, legend_below, logarithmic, narrow, title_above
from ...results.paired import ALPHA
from ...results.summary import Record, groups
from ..cells import ONLINE, SMOOTHED, column, percent
from ..sheets import variant

BAR = 0.72
"""Height of a bar, in lines."""
WIDE = 4.0
"""Where ratios span more than this factor, their axis is logarithmic: bars near 1 would be too short to see."""
LETTERS = 30
"""In a line of a variant's name: a third of the figure's width."""
MINUS = "\N{MINUS SIGN}"


def draw_ablation(differences: Sequence[Record], looks: dict[str, Look], title: str) -> Figure:
    """Draw the ratio of each score to its baseline's as a bar from 1, with its interval: a row of panels per baseline.

    Online bars are filled, smoothed ones open. Beside a bar stands the change of the score in percent, in brackets
    where the test, corrected for the number of tests, is not significant at 5 %.

    Args:
        differences: records of `paired` whose ratio is known, of one baseline's log.
        looks: by label; a baseline's colour is that of its variants' bars.
        title: the log's name.
    """
    scores = list(dict.fromkeys(row["score"] for row in differences))
    baselines = groups(differences, "baseline_label")
    lines = {label: _lines(rows) for (label,), rows in baselines.items()}
    heights = [len(of) + 2.5 for of in lines.values()]
    line_in = 0.25 if any(len(name) > LETTERS for of in lines.values() for name, _ in of) else 0.17
    figure, panels = empty_figure(
        len(lines), len(scores), WIDTH_IN, 0.5 + line_in * sum(heights), share_x=False, heights=heights
    )
    for k, (label, of_baseline) in enumerate(lines.items()):
        row_of_panels = panels[k * len(scores) : (k + 1) * len(scores)]
        for axes, score in zip(row_of_panels, scores, strict=True):
            bars = [(y, row) for y, (_, rows) in enumerate(of_baseline) for row in rows if row["score"] == score]
            _draw(axes, bars, looks[label].colour)
            axes.set_ylim(len(of_baseline) - 0.4, -0.6)
            axes.set_yticks([])
            axes.grid(visible=False, axis="y")
            if k == 0:
                axes.set_title(column(score).name, fontsize=TITLE_PT)
        row_of_panels[0].set_yticks(range(len(of_baseline)), [narrow(name, LETTERS, 2) for name, _ in of_baseline])
        row_of_panels[0].tick_params(axis="y", length=0)
        row_of_panels[0].set_ylabel(f"against\n{narrow(label, 18)}", fontsize=TEXT_PT)
    for axes in panels[-len(scores) :]:
        axes.set_xlabel("ratio to the baseline")
    seeds = [row["pairs"] for row in differences if row["low"] is not None]
    over = f", {max(seeds)} seeds, 95 % intervals" if seeds else ""
    title_above(figure, f"{title}: what each variant changes{over}")
    handles = [Patch(facecolor="#555555", edgecolor="#555555", label=ONLINE)]
    if any(row["output"] == SMOOTHED for row in differences):
        handles.append(Patch(facecolor="white", edgecolor="#555555", label=SMOOTHED))
    if seeds:
        handles.append(Patch(facecolor="none", label="in brackets: not significant (Holm's p is 0.05 or more)"))
    legend_below(figure, handles)
    return figure


def _lines(differences: Sequence[Record]) -> list[tuple[str, list[Record]]]:
    """Return one baseline's lines from the top: what stands before each, and its records."""
    named = [row | {"variant": variant(row)} for row in differences]
    return [
        ("" if k else name, rows)
        for (name,), of_name in groups(named, "variant").items()
        for k, rows in enumerate(groups(of_name, "output").values())
    ]


def _draw(axes: Axes, bars: Sequence[tuple[int, Record]], colour: str) -> None:
    """Draw one score's bars, each at its height y."""
    ends = [1.0]
    for y, row in bars:
        ratio, low, high = row["ratio"], row["ratio_low"] or row["ratio"], row["ratio_high"] or row["ratio"]
        face = colour if row["output"] == ONLINE else "white"
        axes.barh(y, ratio - 1, left=1, height=BAR, facecolor=face, edgecolor=colour, linewidth=0.9)
        if row["ratio_low"] is not None:
            whiskers = {"color": "black", "elinewidth": 0.9, "capsize": 1.8, "capthick": 0.9}
            axes.errorbar(ratio, y, xerr=[[max(0.0, ratio - low)], [max(0.0, high - ratio)]], fmt="none", **whiskers)
        significant = row["p_holm"] is None or row["p_holm"] < ALPHA
        change = (percent(ratio) if ratio >= 10 else f"{percent(ratio)} %").replace("-", MINUS)
        style = {"va": "center", "fontsize": TEXT_PT, "textcoords": "offset points"}
        axes.annotate(change if significant else f"({change})", (max(1.0, ratio, high), y), (3, 0), **style)
        ends += [low, high]
    axes.axvline(1, color="black", linewidth=0.8)
    low, high = min(ends), max(ends)
    if high / low > WIDE:
        logarithmic(axes, "x")
        room = high / low
        axes.set_xlim(low / room**0.05, high * room**0.55)  # room for the numbers beside the bars
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if room < 30 else (1.0,)))
    else:
        room = max(high - low, 0.02)
        axes.set_xlim(low - 0.05 * room, high + 0.55 * room)
        axes.xaxis.set_major_locator(MaxNLocator(4))
