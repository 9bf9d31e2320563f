"""What `fathom timing --profile` and `--cost` do: run, print, and write tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console

from ...datasets.log import Log
from ...datasets.simulated.scenario import Scenario
from ...datasets.simulated.simulator import simulate
from ...estimators.registry import ESTIMATORS, create, package_of
from ..errors import ExperimentError
from ..execution.sweep import run_experiment
from ..experiment.plan import Experiment
from ..output.figures.drawing import looks_of, save
from ..output.tables import terminal
from ..results.store import provenance
from .cost import EXPERIMENT, cost_markdown, write_cost
from .machine import machine_text
from .profile import ABOUT, REPEATS, draw_profile, profile, profile_table
from .scaling import by_lag, draw_by_lag, draw_over_log, growth_text, over_log

EVERY = "all"
SHORT_S, LONG_S = 90.0, 1200.0
"""How long the logs are: of the split and the lags, and of the course over a log."""
LONGEST_S = {"isam2": 300.0, "batch": 300.0, "fls-batch": 300.0}
"""Of those that would take too long, or grow."""


def print_profile(names: Sequence[str], folder: Path | None) -> bool:
    """Print where the time of these estimators goes, by lag and over a log as well, and draw it.

    Args:
        names: of estimators; "all" for every one of ours.
        folder: where profile.csv and the figures go; results/profile without.

    Returns:
        True.

    Raises:
        EstimatorError: an estimator is not known, or does not come to the end.
        ExperimentError: the folder cannot be made.
    """
    folder = _made(folder or Path("results") / "profile")
    chosen = list(ESTIMATORS) if EVERY in names else list(dict.fromkeys(names))
    estimators = {name: create(name) for name in chosen}
    looks = looks_of(list(ESTIMATORS | estimators))
    console = Console(stderr=True)
    with console.status("") as status:
        log = _survey(SHORT_S)
        profiles = profile(estimators, log, tell=status.update)
        lags = by_lag(estimators, log, tell=status.update)
        courses = {}
        for duration_s in sorted({LONGEST_S.get(name, LONG_S) for name in chosen}):
            some = {name: one for name, one in estimators.items() if LONGEST_S.get(name, LONG_S) == duration_s}
            courses |= over_log(some, _survey(duration_s), tell=status.update)
    files = [folder / "profile.csv"]
    pd.DataFrame([one.record() for one in profiles]).to_csv(files[0], index=False)
    title = f"{log.name}, {log.duration_s:.0f} s"
    files += save(draw_profile(profiles, f"{title}: where the time goes"), folder / "profile")
    files += save(draw_by_lag(lags, looks, f"{title}: steps against lag"), folder / "step-against-lag")
    files += save(draw_over_log(courses, looks, f"{log.name}: steps against time in the log"), folder / "step-over-log")

    out = terminal.console()
    out.print(profile_table(profiles))
    out.print(ABOUT)
    out.print(f"{title}; of each step the quickest of {REPEATS} repeats; µs without probes, shares with them")
    out.print(machine_text(provenance()["machine"], provenance()["versions"]))
    for name in chosen:
        if package_of(name) is not None:
            out.print(f"{name} is not ours: what it calls of ours is told apart, and all else is rest")
    for label, by in lags.items():
        if None not in by:
            out.print(f"{label}, ms per second at lag: " + ", ".join(f"{lag:g} s {ms:.3g}" for lag, ms in by.items()))
    for label, one in courses.items():
        out.print(f"{label}, over {one.t_s[-1] / 60:.0f} minutes: {growth_text(one)}")
    console.print(f"{folder}: {', '.join(file.name for file in files)}", highlight=False)
    return True


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExperimentError(f"{folder}: cannot be made ({error.strerror}); give another --out") from None
    return folder


def _survey(duration_s: float) -> Log:
    return simulate(Scenario(mission="lawnmower", duration_s=duration_s, imu="tactical"), seed=1)


def print_cost(folder: Path | None, out: Path = Path("results")) -> bool:
    """Run what is missing of the experiment `cost`, one run at a time; print the README's table, write it, draw it.

    Args:
        folder: where cost.md, cost.csv and accuracy-cost go; the experiment's own without.
        out: where results are.

    Returns:
        Whether every run came to its end.
    """
    plan = Experiment.load(EXPERIMENT)
    folder = _made(folder or out / plan.name)
    rows = run_experiment(plan, out=out, jobs=1)
    files = write_cost(rows, folder)
    print(cost_markdown(rows), end="")
    Console(stderr=True).print(f"{folder}: {', '.join(file.name for file in files)}", highlight=False)
    return bool((rows["status"] == "done").all())
