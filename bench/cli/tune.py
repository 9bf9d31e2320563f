"""`fathom tune`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .options import Data, ExperimentName, Jobs, Repair, Results
from .verb import SOME_FAILED, on_interrupt, say


class Output(StrEnum):
    """Which trajectory of an estimator is scored."""

    online = "online"
    smoothed = "smoothed"


def tune(
    experiment: ExperimentName,
    estimator: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Estimator to tune; required if the experiment has several.")
    ] = None,
    train: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help='Training logs: pattern of a log\'s name, or of "log/seed"; repeatable.'),
    ] = None,
    held_out: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Logs held out for the final check, likewise; repeatable."),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Sensor (or gyro, accel) whose noise factor is searched; repeatable; default: all."
        ),
    ] = None,
    trials: Annotated[
        int,
        typer.Option(
            min=2, metavar="N", help="Number of trials, each with one factor per sensor; in the first, all are 1."
        ),
    ] = 60,
    score: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Score to minimise, from `fathom list scores`; of NEES, NIS and coverage, the distance from the "
            "expected value.",
        ),
    ] = "ate_rmse_m",
    output: Annotated[Output, typer.Option(help="Score the online or the smoothed trajectory.")] = Output.online,
    span: Annotated[
        float, typer.Option(min=1.01, metavar="SPAN", help="Factors are searched from 1/SPAN to SPAN.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the search.")] = 0,
    data: Data = None,
    out: Results = Path("results"),
    jobs: Jobs = 0,
    repair: Repair = False,
) -> None:
    """Search for better noise settings of an estimator.

    The search multiplies the noise of each sensor by a factor, and compares factors on training logs. The best are then
    checked once on held-out logs. Without --train, --held-out or `tune:` in the experiment, the first half of the seeds
    of a simulated log is used for training. An interrupted search continues with the same command.
    """
    from ..experiment.plan import Experiment, SplitPatterns
    from ..tuning.objective import Objective
    from ..tuning.outcome import judge, print_outcome, run_with_bar, write_outcome
    from ..tuning.search import searching
    from ..tuning.tuning import prepare

    plan, patterns = Experiment.load(experiment), SplitPatterns(tuple(train or ()), tuple(held_out or ()))
    objective = Objective(score, output.value)
    tuning = prepare(plan, estimator, patterns, sensor or (), objective, (1 / span, span), seed, out, data, repair)
    with (
        on_interrupt(f"interrupted: finished trials are kept in {tuning.folder}; the same command continues"),
        searching(tuning) as search,
    ):
        for note in search.notes:
            say(note)
        run_with_bar(search, trials, jobs)
        outcome = judge(search)
    files = write_outcome(outcome)
    print_outcome(outcome)
    say(f"{tuning.folder}: {', '.join(file.name for file in files)}, study.sqlite, runs.sqlite")
    if outcome.lost:
        raise typer.Exit(SOME_FAILED)
