"""Arguments and options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ExperimentName = Annotated[
    str, typer.Argument(metavar="EXPERIMENT", help="Name of a shipped experiment, or YAML file.")
]
Data = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", envvar="FATHOM_DATA", help="Folder with the recorded logs, each in a folder of its name."
    ),
]
Results = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for results.")]
Jobs = Annotated[int, typer.Option(min=0, metavar="N", help="Number of worker processes; 0: one per core.")]
Repair = Annotated[
    bool, typer.Option("--repair", help="Drop bad rows of a log, at most half of a stream, and report how many.")
]
