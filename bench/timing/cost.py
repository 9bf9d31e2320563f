"""The cost of each estimator, from the runs of an experiment: the README's table, and accuracy against cost."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console

from ..drawing import WIDTH_IN, Look, empty_figure, handle, logarithmic, looks_of, save
from ..execution.sweep import run_experiment
from ..experiment.plan import Experiment
from ..files import write_csv
from ..metrics import pooled_rmse
from ..results.intervals import interval_over_seeds
from ..results.summary import Record, groups, records
from .printing import machine_text, made

EXPERIMENT = "cost"
LAGS_S = (3.0, 10.0, 30.0)
"""The lags of the main experiment, and a long one."""
COLUMNS = (
    "estimator",
    "µs per IMU sample",
    "of the processor",
    "with 10 beliefs a second",
    *(f"ms per keyframe, lag {lag_s:g} s" for lag_s in LAGS_S),
    "whole log",
    "× real time",
    "memory, MB",
)
BEGIN, END = "<!-- cost: fathom timing cost -->", "<!-- /cost -->"
"""The table stands between these two lines of a page."""


def cost_records(rows: pd.DataFrame) -> list[Record]:
    """Return the cost of each estimator at each of its lags: medians over its runs, made one at a time.

    Each has `estimator`, `lag_s` (0: none; infinite: the whole log), `us_per_imu_sample`, `ms_per_keyframe` (None for
    an estimator without keyframes), `real_time_factor`, `peak_mb`, `runs`. Steps and `finish` count, beliefs only in
    `us_per_imu_sample_with_outputs`; `cpu_us_per_imu_sample` is processor time.
    """
    done = [row for row in records(rows) if row["status"] == "done" and row["total_s"] is not None]
    found = []
    for (label,), of_label in groups(done, "label").items():
        runs = [of_seed[0] for of_seed in groups(of_label, "seed").values()]
        keyframes = [json.loads(row["counts"]).get("keyframes", 0) for row in runs]
        per_keyframe = [1e3 * row["total_s"] / n for row, n in zip(runs, keyframes, strict=True) if n]
        found.append(
            {
                "label": label,
                "estimator": runs[0]["estimator"],
                "lag_s": max(row["lookahead_s"] for row in of_label),
                "us_per_imu_sample": median(row["us_per_imu_sample"] for row in runs),
                "cpu_us_per_imu_sample": median(r["us_per_imu_sample"] * r["cpu_s"] / r["total_s"] for r in runs),
                "us_per_imu_sample_with_outputs": _median([row["us_per_imu_sample_with_outputs"] for row in runs]),
                "ms_per_keyframe": median(per_keyframe) if per_keyframe else None,
                "real_time_factor": median(row["real_time_factor"] for row in runs),
                "peak_mb": _median([row["peak_mb"] for row in runs]),
                "runs": len(runs),
            }
        )
    return found


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def cost_markdown(rows: pd.DataFrame) -> str:
    """Return the table in Markdown, between its two marks, with the machine and the versions under it.

    An estimator that ran at several lags has one line. Columns that are not by lag are for the first of LAGS_S.
    """
    costs = cost_records(rows)
    lines = [BEGIN, "", _line(COLUMNS), _line(["---", *["---:"] * (len(COLUMNS) - 1)])]
    for (name,), of_name in groups(costs, "estimator").items():
        first = min(of_name, key=lambda row: row["lag_s"])
        by_lag = {row["lag_s"]: row["ms_per_keyframe"] for row in of_name}
        lines.append(
            _line(
                [
                    f"`{name}`",
                    _figures(first["us_per_imu_sample"]),
                    _figures(first["cpu_us_per_imu_sample"]),
                    _figures(first["us_per_imu_sample_with_outputs"]),
                    *(_figures(by_lag.get(lag_s)) for lag_s in LAGS_S),
                    _figures(by_lag.get(math.inf)),
                    _figures(first["real_time_factor"]),
                    _figures(first["peak_mb"]),
                ]
            )
        )
    lines += ["", _conditions(rows, costs), END]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _figures(value: float | None) -> str:
    """Return a number with two significant figures, or a dash."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{float(f'{value:.2g}'):,g}"


def _conditions(rows: pd.DataFrame, costs: Sequence[Record]) -> str:
    """Return machine, versions and runs that the numbers are from, in words."""
    run = [row for row in records(rows) if row["status"] == "done"]
    machines = " and ".join(sorted({machine_text(row["machine"], row["versions"]) for row in run}))
    logs = ", ".join(sorted({f"{row['log']}, {row['duration_s']:.0f} s" for row in run}))
    return (
        f"{machines}; one thread, one run at a time. Median of {max(r['runs'] for r in costs)} seeds of {logs}; "
        "compiled before. Steps and `finish`, all divided by IMU samples, or by keyframes; what is not by lag is at "
        f"{LAGS_S[0]:g} s. With beliefs: every estimator is charged for as many. Memory is what the run adds to the "
        "process at its peak."
    )


def draw_accuracy_cost(rows: pd.DataFrame) -> Figure:
    """Draw ATE against computing per second of voyage, a panel per log: online filled, smoothed open.

    One look per estimator; its lags are joined. The bars are 95 % intervals over seeds, where they are enough.
    """
    done = [row for row in records(rows) if row["status"] == "done" and row["ate_rmse_m"] is not None]
    looks = looks_of([name for (name,) in groups(done, "estimator")])
    logs = groups(done, "log")
    columns = min(2, len(logs))
    lines = math.ceil(len(logs) / columns)
    figure, panels = empty_figure(lines, columns, WIDTH_IN, 1.3 + 3.4 * lines, share_x=False)
    for axes in panels[len(logs) :]:
        axes.remove()
    for axes, ((log,), of_log) in zip(panels, logs.items(), strict=False):
        for (name, output), of_output in groups(of_log, "estimator", "output").items():
            _draw_line(axes, of_output, looks[name], output == "online")
        first = of_log[0]
        axes.set_title(f"{log}, {first['duration_s']:.0f} s, {len(groups(of_log, 'seed'))} seeds", fontsize=9)
        axes.set(xlabel="computing, ms per second of voyage", ylabel="ATE, m")
        axes.margins(0.1)
        logarithmic(axes, "xy")
    handles = [handle(name, look.marker, look.colour, True) for name, look in looks.items()]
    if any(row["output"] == "smoothed" for row in done):
        handles.append(handle("smoothed", "o", "black", False))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def _draw_line(axes: Any, rows: Sequence[Record], look: Look, online: bool) -> None:
    """Draw one output of an estimator, its lags joined and, if it is smoothed, named."""
    points = []
    for (label,), runs in groups(rows, "label").items():
        x_ms = median(1e3 / row["real_time_factor"] for row in runs)
        points.append((x_ms, *_pooled_with_interval(runs), runs[0]["lookahead_s"], label))
    x, y, low, high, ahead, _ = zip(*sorted(points), strict=True)
    errors = np.array([np.subtract(y, low), np.subtract(high, y)])
    style = {"marker": look.marker, "markersize": 6 if online else 5, "linewidth": 0.8, "elinewidth": 0.7}
    face = look.colour if online else "white"
    axes.errorbar(x, y, yerr=errors, color=look.colour, markerfacecolor=face, linestyle="-", **style)
    if not online and len(x) > 1:
        for x_ms, y_m, seen in zip(x, y, ahead, strict=True):
            axes.annotate(
                f"{seen:g} s", (x_ms, y_m), (3, -9), textcoords="offset points", fontsize=6, color=look.colour
            )


def _pooled_with_interval(runs: Sequence[Record]) -> tuple[float, float, float]:
    """Return the ATE pooled over the seeds, and its 95 % interval; of few seeds it has no width."""
    pooled = pooled_rmse([row["ate_rmse_m"] for row in runs], [row["n_scored"] for row in runs])
    return pooled, *(interval_over_seeds(runs, "ate_rmse_m") or (pooled, pooled))


def write_cost(rows: pd.DataFrame, folder: Path) -> list[Path]:
    """Write cost.md, cost.csv and the figure accuracy-cost into the folder; return the files."""
    page, table = folder / "cost.md", folder / "cost.csv"
    page.write_text(cost_markdown(rows), encoding="utf-8")
    write_csv(pd.DataFrame(cost_records(rows)), table)
    return [page, table, *save(draw_accuracy_cost(rows), folder / "accuracy-cost")]


def print_cost(folder: Path | None, out: Path = Path("results")) -> bool:
    """Run what is missing of the experiment `cost`, one run at a time; print, write and draw the README's table.

    Args:
        folder: for cost.md, cost.csv and accuracy-cost; default: that of the experiment.
        out: folder for results.

    Returns:
        Whether every run reached its end.
    """
    plan = Experiment.load(EXPERIMENT)
    folder = made(folder or out / plan.name)
    rows = run_experiment(plan, out=out, jobs=1)
    files = write_cost(rows, folder)
    print(cost_markdown(rows), end="")
    Console(stderr=True).print(f"{folder}: {', '.join(file.name for file in files)}", highlight=False)
    return bool((rows["status"] == "done").all())
