"""How the time of a step depends on the lag, and on the time in the log; the latter should be constant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...datasets.log import Log
from ...datasets.state import Array, TimeArray
from ...estimators.interface import Estimator
from ..drawing import WIDTH_IN, Look, empty_figure, handle, logarithmic
from ..metrics.interval import interval
from .passes import Stopwatch, quickest, stopwatch

LAGS_S = (1.0, 3.0, 10.0, 30.0)
"""Each about three times the one before."""
PIECES = 24
"""Pieces of equal length that a log is cut into: of 20 minutes, 50 s each, with 250 keyframes."""
TEN_MINUTES_S = 600.0
"""s."""

Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps of one estimator on one log; of each the quickest of the repeats, whose work is the same.

    Attributes:
        t_s: (epochs,) from the start of the log.
        step_ns: (epochs,).
    """

    t_s: Array
    step_ns: TimeArray

    def ms_per_s(self, begin_s: float, end_s: float) -> float:
        """Return the time of the steps in (begin_s, end_s], ms per second of voyage."""
        inside = (self.t_s > begin_s) & (self.t_s <= end_s)
        return float(self.step_ns[inside].sum()) * 1e-6 / (end_s - begin_s)


def step_times(process: Stopwatch, log: Log, estimator: Estimator, repeats: int = 3) -> Steps:
    """Return the step times of an estimator that is compiled."""
    timed = quickest([process.run(log, estimator) for _ in range(repeats)])
    return Steps(1e-9 * timed.t_ns.astype(np.float64), timed.step_ns)


def by_lag(
    estimators: Mapping[str, Estimator],
    log: Log,
    lags_s: Sequence[float] = LAGS_S,
    repeats: int = 3,
    tell: Tell = lambda doing: None,
) -> dict[str, dict[float | None, float]]:
    """Return the time of each estimator's steps, ms per second of voyage, by its lag (None: it has none).

    Only steps after the longest window is full count.
    """
    found: dict[str, dict[float | None, float]] = {}
    full_s, end_s = max(lags_s), log.duration_s
    with stopwatch() as process:
        for label, estimator in estimators.items():
            process.warm_up(estimator)
            lagged: Any = estimator
            variants: dict[float | None, Estimator] = {None: estimator}
            if hasattr(estimator, "lag_s"):
                variants = {lag_s: dataclasses.replace(lagged, lag_s=lag_s) for lag_s in lags_s}
            found[label] = {}
            for lag_s, variant in variants.items():
                tell(f"{label}: lag {lag_s or 0:g} s")
                found[label][lag_s] = step_times(process, log, variant, repeats).ms_per_s(full_s, end_s)
    return found


@dataclass(frozen=True, eq=False)
class Course:
    """How the time of steps changes as the log goes on.

    Attributes:
        t_s: (pieces,) middle of each piece of the log.
        ms_per_s: (pieces,) time of its steps, ms per second of voyage.
        growth: increase in ten minutes, as a share of the mean, with its 95 % interval over the pieces.
    """

    t_s: Array
    ms_per_s: Array
    growth: tuple[float, float, float]


def course(steps: Steps, from_s: float, pieces: int = PIECES) -> Course:
    """Return the course of the steps after from_s, the time at which the window is full."""
    edges = np.linspace(from_s, float(steps.t_s[-1]), pieces + 1)
    cost = np.array([steps.ms_per_s(a, b) for a, b in pairwise(edges)])
    t_s = 0.5 * (edges[:-1] + edges[1:])
    growth = _growth(t_s, cost)
    return Course(t_s, cost, (growth, *(interval((t_s, cost), _growth) or (growth, growth))))


def _growth(t_s: Array, cost: Array) -> float:
    """Slope by least squares, per ten minutes and relative to the mean."""
    t = t_s - t_s.mean()
    return float(t @ cost / (t @ t) * TEN_MINUTES_S / cost.mean()) if t.any() else 0.0


def over_log(
    estimators: Mapping[str, Estimator], log: Log, repeats: int = 3, tell: Tell = lambda doing: None
) -> dict[str, Course]:
    """Return the course of each estimator's steps over a log, from the time at which its window is full."""
    found = {}
    with stopwatch() as process:
        for label, estimator in estimators.items():
            tell(f"{label}: {log.duration_s / 60:.0f} minutes")
            process.warm_up(estimator)
            steps = step_times(process, log, estimator, repeats)
            found[label] = course(steps, min(float(getattr(estimator, "lag_s", 0.0)), 0.5 * log.duration_s))
    return found


def draw_by_lag(found: Mapping[str, Mapping[float | None, float]], looks: Mapping[str, Look], title: str) -> Figure:
    """Draw the time of steps against the lag; an estimator without a lag is a horizontal line."""
    figure, (axes,) = empty_figure(1, 1, WIDTH_IN, 4.0)
    for label, by in found.items():
        look = looks[label]
        if None in by:
            axes.axhline(by[None], color=look.colour, linestyle=look.dash, linewidth=1.0)
        else:
            axes.plot(
                [lag_s or 0.0 for lag_s in by],
                list(by.values()),
                color=look.colour,
                marker=look.marker,
                linestyle="-",
                linewidth=1.0,
            )
    logarithmic(axes, "xy")
    axes.set(xlabel="lag, s", ylabel="steps, ms per second of voyage")
    axes.set_title(title, fontsize=9)
    handles = [
        handle(label, "" if None in by else looks[label].marker, looks[label].colour, True, "-")
        for label, by in found.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def draw_over_log(courses: Mapping[str, Course], looks: Mapping[str, Look], title: str) -> Figure:
    """Draw the time of steps against the time in the log; the legend has the growth in ten minutes."""
    figure, (axes,) = empty_figure(1, 1, WIDTH_IN, 4.2)
    handles = []
    for label, one in courses.items():
        look = looks[label]
        axes.plot(one.t_s / 60, one.ms_per_s, color=look.colour, linestyle=look.dash, linewidth=1.0)
        axes.plot(one.t_s / 60, one.ms_per_s, color=look.colour, marker=look.marker, markersize=3, linestyle="none")
        handles.append(handle(f"{label}: {growth_text(one)}", look.marker, look.colour, True, "-"))
    logarithmic(axes, "y")
    axes.set(xlabel="time in the log, minutes", ylabel="steps, ms per second of voyage")
    axes.set_title(title, fontsize=9)
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def growth_text(one: Course) -> str:
    """Return the growth in ten minutes with its interval, as text."""
    value, low, high = (100 * share for share in one.growth)
    return f"{value:+.1f} % [{low:+.1f}, {high:+.1f}] in ten minutes"
