"""The distribution of step times: the share of steps that take longer than a given time, on logarithmic axes."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from ...results.step_time import StepTimes, machine_name, pooled_steps, usual_machine
from ...results.summary import Record, groups
from ..cells import STEP_TIME
from .drawing import COLUMN_IN, Look, empty_figure, legend_below, logarithmic, look_handle, title_above

MARKED = (0.5, 0.99)
"""Quantiles with a marker, the columns of the main table; a third marker stands at the longest step."""


def step_times(rows: Sequence[Record]) -> tuple[dict[str, StepTimes], str | None]:
    """Return the step times of each estimator on one log, by label, and the machine: the one with the most runs.

    Runs on other machines and runs that did not finish are left out.
    """
    done = [row for row in rows if row["status"] == "done" and row["output"] == "online"]
    machine = usual_machine(done)
    here = groups([row for row in done if row["machine"] == machine], "label")
    pooled = {label: pooled_steps(of_label) for (label,), of_label in here.items()}
    return {label: times for label, times in pooled.items() if times is not None}, machine


def draw_step_times(rows: Sequence[Record], looks: dict[str, Look], title: str) -> Figure:
    """Draw the share of steps that took longer than a time against that time, by estimator of one log; seeds pooled.

    Markers stand at the median, the 99th percentile and the longest step. The title names their machine.
    """
    every, machine = step_times(rows)
    figure, (axes,) = empty_figure(1, 1, COLUMN_IN, 2.6)
    for label, times in every.items():
        look = looks[label]
        t_us, share = times.longer()
        axes.plot(t_us, share, color=look.colour, linestyle=look.dash, linewidth=1.0)
        marks = [(times.quantile_us(q), 1 - q) for q in MARKED if times.steps * (1 - q) >= 1]
        marks.append((times.max_us, 1 / times.steps))
        axes.plot(*zip(*marks, strict=True), color=look.colour, marker=look.marker, markersize=4, linestyle="none")
    logarithmic(axes, "xy")
    axes.yaxis.set_major_locator(LogLocator())
    axes.set_ylim(top=1.3)
    axes.set(xlabel=STEP_TIME, ylabel="share of steps that take longer")
    runs = max(times.runs for times in every.values())
    others = {row["machine"] for row in rows if row.get("step_histogram")} - {machine}
    left_out = f" (runs on {len(others)} other machine{'s' if len(others) > 1 else ''} left out)" if others else ""
    over = f"{runs} runs each" if runs > 1 else "one run each"
    title_above(
        figure, f"{title}: step times, {over}\nmarkers: median, p99, longest\n{machine_name(machine)}{left_out}"
    )
    legend_below(figure, [look_handle(label, looks[label]) for label in every], most=3)
    return figure
