"""`fathom report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    result: Annotated[
        str, typer.Argument(metavar="RESULT", help="Folder of results, or name of an experiment under `results`.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="HTML file to write; default: RESULT/report.html."),
    ] = None,
) -> None:
    """Write results as one HTML page.

    The page needs no network. It has sortable tables, figures to zoom, and the spec of every run.
    """
    from rich.console import Console

    from ..output.report.page import report as write
    from ..output.report.results import find_result

    folder = find_result(result)
    with Console(stderr=True).status(f"reading {folder}"):
        file = write(folder, out)
    typer.echo(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
