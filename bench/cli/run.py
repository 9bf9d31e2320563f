"""`fathom run`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import Data, ExperimentName, Jobs, Repair, Results
from .verb import BAD_INPUT, SOME_FAILED, on_interrupt

if TYPE_CHECKING:
    import pandas as pd


def run(
    experiment: ExperimentName,
    data: Data = None,
    out: Results = Path("results"),
    jobs: Jobs = 0,
    only: Annotated[
        str | None,
        typer.Option(metavar="GLOB", help='Run only what matches: a label, a log\'s name, or "log/label".'),
    ] = None,
    repair: Repair = False,
    force: Annotated[bool, typer.Option("--force", help="Repeat runs that are already finished.")] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Run nothing if something looks grossly wrong in a recorded log.")
    ] = False,
    no_check: Annotated[
        bool, typer.Option("--no-check", help="Do not look for gross faults in recorded logs first.")
    ] = False,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help='Run on a Dask cluster: tcp://host:port, tls://host:port, its scheduler file (.json), or "local" '
            "(starts a cluster of --jobs processes here).",
        ),
    ] = None,
    tls: Annotated[
        tuple[Path, Path, Path] | None,
        typer.Option(
            metavar="CA CERT KEY",
            help="For tls://: PEM files of the authority's certificate, of this process's, and of its private key.",
        ),
    ] = None,
) -> None:
    """Run an experiment and print its tables.

    Every estimator of EXPERIMENT runs on each of its logs. Finished runs are kept. They are repeated only if their
    spec, their log or a version has changed. Recorded logs are first checked for gross faults: gravity, units, axes,
    clocks, coordinates. What is found is printed and kept with the runs.
    """
    from ..errors import ExperimentError, StoppedError
    from ..execution.dask_pool import Tls
    from ..execution.sweep import sweep
    from ..experiment.plan import Experiment
    from ..output.present import present, print_log
    from ..results.paired import out_of_reach
    from ..saying import say

    plan = Experiment.load(experiment)
    if too_few := out_of_reach(len(plan.seeds), plan.least_tests()):
        say(f"{plan.name}: {too_few}")
    folder = out / plan.name
    printed: set[str] = set()

    def print_finished(rows: pd.DataFrame) -> None:
        print_log(rows, plan)
        printed.update(rows["log"])

    with on_interrupt(f"interrupted: finished runs are kept in {folder / 'runs.sqlite'}; the same command continues"):
        certificates = Tls(*tls) if tls else None
        outcome = sweep(
            plan, data, out, jobs, only, repair, force, dask, print_finished, not no_check, strict, certificates
        )
    try:
        present(outcome, plan, folder, printed)
    except ExperimentError as error:
        if outcome.made:
            raise StoppedError(str(error)) from None
        raise
    statuses = set(outcome.rows.loc[~outcome.rows["log"].isin(outcome.kept), "status"])
    if statuses <= {"absent"}:  # nothing was run
        raise typer.Exit(BAD_INPUT)
    if statuses - {"done", "absent"}:
        raise typer.Exit(SOME_FAILED)
