"""Output of `fathom run`, on the terminal and in files: tables as runs finish, figures and report at the end."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pandas as pd
from rich.console import Console

from ..execution.sweep import TABLES, Outcome, outdated, rows_of
from ..experiment.plan import Experiment
from ..files import writing
from ..results.convergence import convergence
from ..results.honesty import honesty
from ..results.paired import paired
from ..results.rows import run_keys
from ..results.store import load_runs
from ..results.summary import Record, Records, Rows, groups, records
from ..saying import say
from .remarks import absence
from .tables import terminal
from .tables.latex import write_latex
from .tables.table import (
    print_differences,
    print_logs,
    print_over_logs,
    print_remarks,
    write_consistency,
    write_over_logs,
    write_paired,
    write_table,
)


def print_log(rows: pd.DataFrame, plan: Experiment) -> None:
    """Print the tables of logs whose runs are all finished, before other logs are.

    Args:
        rows: of the store, all of these logs, in any order.
        plan: gives the order of estimators.
    """
    print_logs(rows_of(rows, plan.runs()), terminal.console())


def present(outcome: Outcome, plan: Experiment, folder: Path, printed: Collection[str] = ()) -> None:
    """Print what `print_log` has not, then write tables, figures and report of all runs of this plan.

    Where no log's recording is here, only that is printed, and no file is written.

    Args:
        outcome: of the sweep.
        plan: what was run.
        folder: of the experiment's results.
        printed: logs whose tables are on the terminal already.

    Raises:
        ExperimentError: a file cannot be written.
    """
    rows = outcome.rows
    if set(rows["status"]) == {"absent"}:
        print_remarks(rows, terminal.console())
        return
    stored = rows_of(load_runs(folder, shared_specs=True), plan.runs()) if _lacks_runs(rows, plan) else rows
    others = stored.loc[~stored["identity"].isin(rows["identity"])]
    old = others.index[outdated(others, plan)]
    made = records(rows)
    every = made if stored is rows else records(stored.drop(old))
    shown = set(groups(made, "log", "label"))
    console = terminal.console()
    print_logs(Records(row for row in made if row["log"] not in printed) if printed else made, console)
    differences = paired(every, plan.comparisons(), plan.compare)
    honest, converged = honesty(every), convergence(every)

    def of_shown(found: list[Record]) -> list[Record]:
        return [row for row in found if (row["log"], row["label"]) in shown]

    print_differences(of_shown(differences), console)
    print_over_logs(of_shown(honest), of_shown(converged), console)
    print_remarks(made, console)
    with writing(folder, "; the runs are in runs.sqlite"):
        write_table(every, folder / "table.csv")
        write_latex(every, folder / "table.tex")
        write_consistency(every, folder / "consistency.csv")
        write_over_logs(honest, converged, folder)
        write_paired(differences, folder / "paired.csv")
        figures = _draw_figures(every, folder, differences, honest)
    say(f"{folder}: runs.sqlite, {', '.join(TABLES)}, {figures} figures")
    _write_report(every, plan, folder, differences)
    if outcome.standing:
        say(f"{outcome.standing} runs were finished already; --force repeats them")
    if outcome.renewed:
        say(f"{outcome.renewed} runs were of another spec, log or version, and were repeated")
    if len(old):
        say(f"{len(old)} rows of another spec or version are left out of the files; run without --only to renew them")
    for log, cause in outcome.kept.items():
        say(f"{absence(log, cause)}; its rows are from an earlier run")


def _lacks_runs(rows: pd.DataFrame, plan: Experiment) -> bool:
    """Return whether the plan has runs besides those of these rows: `--only` asks for some of them."""
    return not {run.key for run in plan.runs()} <= set(run_keys(rows))


def _draw_figures(rows: Rows, folder: Path, differences: list[Record], honest: list[Record]) -> int:
    """Draw all figures and return how many files they are; matplotlib takes a second to load, so it waits till here."""
    with Console(stderr=True).status("drawing figures") as status:
        from .figures.figures import draw_figures

        def tell(done: int, total: int) -> None:
            status.update(f"drawing figures: {done} of {total}")

        missing: list[str] = []
        files = draw_figures(rows, folder, differences, tell, missing, honest)
    for sentence in missing:
        say(f"{folder}: {sentence}")
    return len(files)


def _write_report(rows: Rows, plan: Experiment, folder: Path, differences: list[Record]) -> None:
    """Write report.html, or say how to get it; the plan goes beside it."""
    with Console(stderr=True).status("writing report.html"):
        from .report.page import NoExtraError, write_report
        from .report.results import keep_plan

        keep_plan(plan, folder)
        try:
            file = write_report(rows, folder, differences)
        except NoExtraError as missing:
            say(f"no report.html: {missing}")
            return
    say(f"{file}: tables, figures and every run, for a browser")
