"""What `fathom run` leaves beside the store, and says on the terminal."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import typer
from rich.console import Console

from ..errors import ExperimentError
from ..execution.sweep import Outcome, outdated, rows_of
from ..experiment.plan import Experiment
from ..results.paired import paired
from ..results.store import load_runs
from .figures.figures import draw_figures
from .report.page import NoExtraError, write_report
from .report.results import keep_plan
from .tables.latex import write_latex
from .tables.table import print_table, write_consistency, write_paired, write_table

say = partial(typer.echo, err=True)


def print_log(rows: pd.DataFrame, plan: Experiment) -> None:
    """Print the tables of a log whose runs have all ended, while others still run."""
    print_table(rows_of(rows, plan.runs()))


def present(outcome: Outcome, plan: Experiment, folder: Path, printed: Collection[str] = ()) -> None:
    """Write the CSV files and the figures of all that was run of this plan, and print what `print_log` has not.

    Args:
        outcome: of the sweep.
        plan: what was run.
        folder: of the experiment's results.
        printed: logs whose tables are printed already.
    """
    rows = outcome.rows
    every = rows_of(load_runs(folder), plan.runs())
    others = every.loc[~every["identity"].isin(rows["identity"])]
    old = others.index[outdated(others, plan)]
    every = every.drop(old)
    differences = paired(every, plan.comparisons(), plan.compare)
    try:
        write_table(every, folder / "table.csv")
        write_latex(every, folder / "table.tex")
        write_consistency(every, folder / "consistency.csv")
        write_paired(differences, folder / "paired.csv")
        figures = draw_figures(every, folder, differences)
    except OSError as error:
        raise ExperimentError(f"{folder}: cannot be written ({error}); the runs are in runs.sqlite") from None
    say(f"{folder}: runs.sqlite, table.csv, table.tex, consistency.csv, paired.csv, {len(figures)} figures")
    _write_report(every, plan, folder, differences)
    shown = set(zip(rows["log"], rows["label"], strict=True))
    print_table(
        rows.loc[~rows["log"].isin(printed)],
        differences=[row for row in differences if (row["log"], row["label"]) in shown],
    )
    if outcome.standing:
        say(f"{outcome.standing} runs were done already; --force does them again")
    if outcome.renewed:
        say(f"{outcome.renewed} runs were done under another spec, log or version, and made anew")
    if len(old):
        say(f"{len(old)} rows of another spec or version are left out of the files; without --only they are renewed")
    for log, cause in outcome.kept.items():
        say(f"{log}: {cause}; its rows are from an earlier run")


def _write_report(rows: pd.DataFrame, plan: Experiment, folder: Path, differences: list[dict[str, Any]]) -> None:
    """Write report.html, or say how to get it; what was asked goes beside it."""
    keep_plan(plan, folder)
    try:
        with Console(stderr=True).status("writing report.html"):
            file = write_report(rows, folder, differences)
    except NoExtraError as missing:
        say(f"no report.html: {missing}")
    else:
        say(f"{file}: tables, figures and every run, for a browser")
