"""`fathom inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import Data, Repair

if TYPE_CHECKING:
    from ...datasets.formats.recording import Recording


def inspect(
    log: Annotated[
        str,
        typer.Argument(
            metavar="LOG",
            help="Name of a recorded log, a folder with a log.yaml, or a description (.yaml). Of a bare recording "
            "(.bag, .db3, .mcap, .jsonl, .bin, .lsf) the messages are listed.",
        ),
    ],
    data: Data = None,
    repair: Repair = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="FILE",
            help="Figure to write (.png, .pdf, .svg), or a folder; default: inspect-NAME.png.",
        ),
    ] = None,
) -> None:
    """Check a log before it is used.

    Prints rates, gaps and values of each sensor, what looks wrong, and how to correct it in log.yaml; draws a figure.
    """
    from rich.console import Console

    from ...datasets.errors import shown
    from ..inspection.contents import print_contents
    from ..inspection.inspecting import description_of, inspect_log, open_to_inspect
    from ..inspection.page import page_file, print_inspection, save_page
    from ..output.tables.terminal import console

    path = Path(log).resolve() if Path(log).is_symlink() else Path(log)
    undescribed = _undescribed(path)
    if undescribed is not None:
        held = undescribed.contents(path.parent)
        print_contents(held, console())
        return
    page_file(out, "")  # refuses before anything is read
    with Console(stderr=True).status(f"inspecting {log}") as status:
        opened, repairs = open_to_inspect(log, data, repair=repair)
        inspection = inspect_log(opened, repairs, description_of(log, data))
        file = page_file(out, opened.name)
        status.update(f"drawing {file}")
        save_page(inspection, file)
    print_inspection(inspection, console())
    typer.echo(shown(f"figure: {file}"))


def _undescribed(path: Path) -> Recording | None:
    """Return the loader of a bare recording: a file, or the folder of a ROS 2 bag."""
    from ...datasets.formats.recording import loader, recording_at

    if (path / "metadata.yaml").is_file() and not (path / "log.yaml").is_file():
        return loader("ros")(format="ros", file=path.name)
    return recording_at(path) if path.is_file() else None
