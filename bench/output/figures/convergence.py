"""Convergence from wrong starts: the share of runs that converge, log by log, and how accurate and honest these are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import takewhile

import numpy as np
from matplotlib.figure import Figure

from ...drawing import WIDTH_IN, Look, empty_figure, legend_below, logarithmic, look_handle, narrow, plain, title_above
from ...results.convergence import limits
from ...results.summary import Record, groups
from ..cells import NEES_OVER_DOF, ONLINE

TICK_PT = 6
"""Points of the logs' names, of which eight stand below a third of a page's width."""
BESIDE = 0.06
"""Of the distance between two logs: by so much the estimators' points stand side by side, as all shares may be 1."""


def draw_convergence(rows: Sequence[Record], looks: dict[str, Look]) -> Figure:
    """Draw share with its 95 % interval, ATE, and ANEES of the attitude, each against the logs in their order.

    Fixed-lag smoothers are drawn by their online output, smoothers over the whole log by their only one.

    Args:
        rows: what `results.convergence.convergence` returns.
        looks: by label.
    """
    logs = list(dict.fromkeys(row["log"] for row in rows))
    common = _shared_words(logs)
    drawn = [row for row in rows if row["output"] == ONLINE or row["lookahead_s"] in (None, math.inf)]
    labels = list(dict.fromkeys(row["label"] for row in drawn))
    figure, panels = empty_figure(1, 3, WIDTH_IN, 2.3)
    for (label,), of in groups(drawn, "label").items():
        look, shift = looks[label], BESIDE * (labels.index(label) - (len(labels) - 1) / 2)
        style = {"color": look.colour, "marker": look.marker, "linestyle": look.dash, "markersize": 3, "linewidth": 0.8}
        at = [logs.index(row["log"]) + shift for row in of]
        share = [row["share"] for row in of]
        reach = [[row["share"] - row["low"] for row in of], [row["high"] - row["share"] for row in of]]
        panels[0].errorbar(at, share, yerr=reach, elinewidth=0.5, **style)
        for axes, name in zip(panels[1:], ("ate_rmse_m", "anees_attitude"), strict=True):
            axes.plot(at, [math.nan if row[name] is None else row[name] for row in of], **style)
    panels[0].set(ylabel="share that converges", ylim=(-0.05, 1.05))
    panels[1].set_ylabel("ATE of these (m)")
    panels[2].set_ylabel(f"attitude of these: {NEES_OVER_DOF}")
    for axes in panels[1:]:
        if any(np.isfinite(np.asarray(line.get_ydata(), float)).any() for line in axes.lines):
            logarithmic(axes, "y")
    panels[2].axhline(1, color="black", linewidth=0.4)
    for axes in panels:
        axes.set_xticks(
            range(len(logs)), [narrow(log.removeprefix(common).strip(), 12) for log in logs], fontsize=TICK_PT
        )
        axes.set_xlabel(plain(common))
    runs = max(row["runs"] for row in rows)
    title_above(figure, f"runs whose attitude error stays below {limits(rows)}, of {runs} seeds")
    legend_below(figure, [look_handle(label, looks[label]) for label in labels])
    return figure


def _shared_words(names: Sequence[str]) -> str:
    """Return the words with which all of several names begin; the axis says them once."""
    each = zip(*(name.split() for name in names), strict=False)
    return " ".join(words[0] for words in takewhile(lambda words: len({*words}) == 1, each)) if len(names) > 1 else ""
