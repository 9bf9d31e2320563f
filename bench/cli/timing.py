"""`fathom timing` and its verbs; see docs/timing.md and docs/cost.md."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from .verb import SOME_FAILED, Verb, on_interrupt, refuse

FORMER = {"--against": "against REV", "--profile": "profile NAME", "--cost": "cost", "--counters": "counters"}
"""What were options are verbs now."""


class Verbs(TyperGroup):
    """The verbs of `fathom timing`; options without a verb are refused by a line that names the verb."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line."""
        if args and args[0].startswith("-") and args[0] not in ("-h", "--help"):
            given = [argument.partition("=")[0] for argument in args]
            verb = next((verb for option, verb in FORMER.items() if option in given), "budgets")
            refuse(f"{args[0]}: a verb comes first: `fathom timing {verb}`; `fathom timing --help` lists the verbs")
        return super().parse_args(ctx, args)


timing = typer.Typer(
    cls=Verbs,
    help="Measure how fast fathom is.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
Only = Annotated[str | None, typer.Option(metavar="GLOB", help="Measure only what matches this pattern.")]
File = Annotated[
    Path | None, typer.Option("-o", "--out", metavar="FILE", help="Also write the results to this JSON file.")
]


@timing.command(cls=Verb)
def budgets(
    only: Only = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with status 1 if a budget is missed.")] = False,
    out: File = None,
) -> None:
    """Measure the budgets of speed and memory."""
    from ..timing.budget_rows import BUDGETS
    from ..timing.budgets import print_budgets

    if not print_budgets(BUDGETS, only, out) and strict:
        raise typer.Exit(SOME_FAILED)


@timing.command(cls=Verb)
def against(
    revision: Annotated[str, typer.Argument(metavar="REV", help="Revision that git knows: HEAD~1, a tag, a branch.")],
    short: Annotated[bool, typer.Option("--short", help="Fewer benchmarks: a minute or two.")] = False,
    only: Only = None,
    limit: Annotated[
        float, typer.Option(min=1.0, metavar="RATIO", help="Largest ratio of times that is accepted.")
    ] = 1.10,
    pairs: Annotated[
        int, typer.Option(min=0, metavar="N", help="Pairs of processes; 0: five, or three with --short.")
    ] = 0,
    rounds: Annotated[
        int, typer.Option(min=0, metavar="N", help="Turns A B B A per pair; 0: four, or three with --short.")
    ] = 0,
    out: File = None,
) -> None:
    """Compare speed with another revision.

    The working tree is compared as it is, uncommitted changes included. Exit status 1: something is slower, that is,
    its whole confidence interval is above --limit.
    """
    from ..timing.comparison import print_comparison

    if not print_comparison(revision, only, short, limit, rounds, pairs, out):
        raise typer.Exit(SOME_FAILED)


@timing.command(cls=Verb)
def profile(
    names: Annotated[list[str], typer.Argument(metavar="NAME", help='Estimators; "all" for every one of ours.')],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Folder for table and figures; default: results/profile."),
    ] = None,
) -> None:
    """Show where an estimator's time goes.

    The time is split by stage, by lag, and over the length of a log.
    """
    from ..timing.profile import print_profile

    print_profile(names, out)


@timing.command(cls=Verb)
def cost(
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Folder for table and figure; default: results/cost."),
    ] = None,
) -> None:
    """Make the table of costs in the README, and its figure."""
    from ..timing.cost import print_cost

    with on_interrupt("interrupted: finished runs are kept; the same command continues"):
        good = print_cost(out)
    if not good:
        raise typer.Exit(SOME_FAILED)


@timing.command(cls=Verb)
def counters(only: Only = None, out: File = None) -> None:
    """Count the work per step.

    Factors, callbacks, calls and allocations are counted. Unlike times, the counts do not depend on the machine.
    """
    from ..timing.counters import print_counters

    print_counters(only, out)
