"""Short versions of the shipped experiments, and the small tables of them that results/reference keeps.

`python -m fathom.bench.execution.reference [EXPERIMENT]...` writes them anew. A short version has every estimator and
score of its experiment, and is smaller by SHORT, SHORT_SEEDS, LEFT_OUT and LOGS_LEFT_OUT. Recorded logs are taken
whole, or not at all.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from ...datasets.simulated.scenario import Scenario
from ...estimators.interface import Estimator
from ..experiment.plan import Experiment, LogSpec, Run, shipped_experiments
from ..experiment.variants import changed
from ..results.store import Store
from ..results.summary import Record, groups, records, summarise
from .task import Task
from .worker import WorkerCache

SHORT = {
    "duration_s": 40.0,
    "surface_for_s": 12.0,
    "depth_m": 3.0,
    "shallow_m": 1.0,
    "leg_m": 10.0,
    "turn_radius_m": 4.0,
}
"""What a mission has at most of each, so that it still goes down, turns and comes up; outages keep their share."""

SHORT_SEEDS = {"relinearisation": 1, "delays": 1, "cost": 1, "honesty": 1, "initial_error": 1}
"""How many of an experiment's seeds, the first ones; two if not listed."""

LEFT_OUT = {
    "delays": ("fls-batch lag 3", "isam2", "batch"),
    "cost": ("fls-batch lag 10",),
}
"""Labels whose runs would take as long as all the others: they solve whole logs, or long windows, again and again."""

LOGS_LEFT_OUT = {
    "honesty": ("heading unknown 60°", "an hour, one surfacing"),
    "initial_error": tuple(f"wrong by {angle}°" for angle in (60, 90, 120, 150, 180)),
}
"""Logs that are not for a comparison to 1e-6, as estimators refuse the start, or a rounding decides where they end; and
those that are no other mission when they are short."""

SHORT_RECORDED = ("lauv_noptilus2_2015", "comma2k19_example1")
"""The recorded logs of two minutes at most."""

COLUMNS = {
    "log": None,
    "label": None,
    "output": None,
    "lookahead_s": None,
    "runs": None,
    "done": None,
    "ate_rmse_m": "m, over all seeds",
    "ate_least_m": "of the best seed",
    "ate_most_m": "of the worst",
    "heading_rmse_deg": "°",
    "drift_end_percent": "%",
    "rpe_rmse_m": "m",
    "nees_position": "3 if consistent",
    "floor_position_m": "m",
    "nis_dvl": "",
    "nis_depth": "",
    "nis_gps": "",
    "nis_heading": "",
    "late": None,
    "late_dropped": None,
}
"""Of a reference table; nothing in it depends on how fast a machine is."""


def shortened(experiment: Experiment) -> Experiment:
    """Return the short version of a shipped experiment."""
    estimators = [each for each in experiment.estimators if each.label not in LEFT_OUT.get(experiment.name, ())]
    kept = [log for log in experiment.logs if log.name not in LOGS_LEFT_OUT.get(experiment.name, ())]
    logs = [_short(log) for log in kept if log.scenario is not None or log.log in SHORT_RECORDED]
    seeds = experiment.seeds[: SHORT_SEEDS.get(experiment.name, 2)]
    return replace(experiment, logs=tuple(logs), estimators=tuple(estimators), seeds=seeds)


def _short(log: LogSpec) -> LogSpec:
    """Return a simulated log as SHORT allows; a recorded one as it is."""
    if log.scenario is None:
        return log
    scenario = Scenario.from_dict(log.scenario)
    less: dict[str, Any] = {name: min(most, getattr(scenario, name)) for name, most in SHORT.items()}
    if scenario.gps is not None and scenario.gps.faults.outages_s:
        share = less["duration_s"] / scenario.duration_s
        outages_s = [[share * start_s, share * end_s] for start_s, end_s in scenario.gps.faults.outages_s]
        less["gps"] = changed(log.scenario["gps"], {"faults.outages_s": outages_s})
    return replace(log, scenario=log.scenario | less)


class _Untimed(WorkerCache):
    """Runs one thing after the other in this process; as nothing is timed, nothing is warmed up."""

    def estimator(self, task: Task) -> Estimator:
        return task.run.estimator.create()


def short_rows(name: str, data: Path | None = None, chosen: Callable[[Run], bool] = lambda run: True) -> pd.DataFrame:
    """Run the short version of a shipped experiment and return its rows.

    Args:
        name: of the experiment.
        data: where recorded logs are; they are left out without.
        chosen: which of its runs.
    """
    experiment, bench = shortened(Experiment.load(name)), _Untimed()
    runs = [run for run in experiment.runs() if chosen(run) and (run.log.scenario is not None or data is not None)]
    with TemporaryDirectory(prefix="fathom-") as scratch, Store(Path(scratch) / "runs.sqlite") as store:
        for run in runs:
            store.write(bench.execute(Task.of(experiment, run, data)).rows)
        return store.read()


def reference_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the reference table of rows; a column without any number is left out."""
    every = groups(records(rows), "log", "label", "output")
    full = [record | _extremes(every[record["log"], record["label"], record["output"]]) for record in summarise(rows)]
    return pd.DataFrame(full, columns=list(COLUMNS)).dropna(axis="columns", how="all")


def _extremes(rows: list[Record]) -> Record:
    """Return the least and the greatest ATE of the seeds."""
    each = [row["ate_rmse_m"] for row in rows if row["status"] == "done" and row["ate_rmse_m"] is not None]
    return {"ate_least_m": min(each, default=None), "ate_most_m": max(each, default=None)}


def write_reference(name: str, folder: Path, data: Path | None = None) -> Path:
    """Run the short version of an experiment and write its table to `folder`."""
    path = folder / f"{name}.csv"
    table = reference_table(short_rows(name, data))
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False, float_format="%.9g")
    return path


def main() -> None:
    """Write the tables of the experiments that are named, or of all; recordings are looked for in FATHOM_DATA."""
    import os

    data = Path(os.environ["FATHOM_DATA"]) if os.environ.get("FATHOM_DATA") else None
    for name in sys.argv[1:] or shipped_experiments():
        print(write_reference(name, Path("results/reference"), data))


if __name__ == "__main__":
    main()
