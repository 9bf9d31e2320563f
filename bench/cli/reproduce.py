"""`fathom reproduce`."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import Data, Jobs
from .verb import BAD_INPUT, INTERRUPTED, SOME_FAILED, say


def reproduce(
    result: Annotated[
        str, typer.Argument(metavar="RESULT", help="Folder that `fathom run` wrote, or its name under `results`.")
    ],
    row: Annotated[
        str | None,
        typer.Argument(
            metavar="ROW",
            help='Runs to repeat: "log/label", "log/label/seed", a pattern of these, or the first characters of an '
            "identity; default: all.",
        ),
    ] = None,
    data: Data = None,
    jobs: Jobs = 0,
) -> None:
    """Repeat stored runs and compare their scores, bit for bit.

    The runs are repeated from the specs stored in RESULT, which is not changed. Exit status 0: all are identical; 1:
    some are not, or could not be repeated; 2: nothing ran.
    """
    from ..execution.reproduce import reproduce_all
    from ..output.report.results import find_result
    from ..output.tables.reproduction import print_reproduction
    from ..results.select import choose

    runs = choose(find_result(result), row)
    every, whole = reproduce_all(runs, data, jobs)
    print_reproduction(every)
    if not whole:
        say(f"interrupted after {len(every)} of {len(runs)} runs; nothing was written")
        raise typer.Exit(INTERRUPTED)
    ran = [again for again in every if again.skipped is None]
    if not ran:
        raise typer.Exit(BAD_INPUT)
    if not all(again.is_identical for again in every if again.stored.first["status"] != "absent"):
        raise typer.Exit(SOME_FAILED)
