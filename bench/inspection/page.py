"""The inspection on one page: as text, and as a figure."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING
from warnings import catch_warnings, filterwarnings

from ...datasets.errors import DatasetError, shown
from ..drawing import empty_figure
from ..files import writing
from .inspecting import Inspection

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

FORMATS = (".png", ".pdf", ".svg")
COLUMNS = 3
"""Panels side by side; with PANEL_IN a page as wide as a landscape A4 sheet, 12.6 in."""
PANEL_IN = (4.2, 2.7)
"""Inches, width and height of one panel: wide enough for three legend entries."""


def print_inspection(inspection: Inspection, console: Console) -> None:
    """Print the facts of every check, then what looks wrong and how to fix it."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    for check in inspection.checks:
        if not check.facts:
            continue
        console.print(Text(check.title, style="bold"))
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        table.add_column()
        for name, value in check.facts.items():
            table.add_row(Text(name), Text(value))
        console.print(Padding(table, (0, 0, 1, 2), expand=False))
    if not inspection.findings:
        console.print(Text("Nothing looks wrong.", style="bold"))
        return
    console.print(Text("What looks wrong", style="bold"))
    table = Table.grid(padding=(0, 1))
    table.add_column(justify="right")
    table.add_column()
    for number, finding in enumerate(inspection.findings, start=1):
        table.add_row(Text(f"{number}."), Text(finding.message))
        if finding.fix:
            for line in finding.fix.split("\n"):
                table.add_row("", Text(f"→ log.yaml: {line}", style="cyan"))
        if finding.hint:
            table.add_row("", Text(f"→ {finding.hint}", style="cyan"))
    console.print(Padding(table, (0, 0, 0, 1), expand=False))


def draw_inspection(inspection: Inspection) -> Figure:
    """Draw a panel for every check that has one."""
    drawn = [check for check in inspection.checks if check.draw is not None]
    lines = max(-(-len(drawn) // COLUMNS), 1)
    figure, panels = empty_figure(lines, COLUMNS, COLUMNS * PANEL_IN[0], lines * PANEL_IN[1] + 0.4, share_x=False)
    for axes, check in zip(panels, drawn, strict=False):
        assert check.draw is not None
        check.draw(axes)
        wrong = len(check.findings)
        axes.set_title(
            check.title + (f": {wrong} wrong" if wrong else ""), fontsize=9, weight="bold" if wrong else None
        )
        axes.set_xlabel(axes.get_xlabel(), fontsize=8)
        axes.set_ylabel(axes.get_ylabel(), fontsize=8)
    for axes in panels[len(drawn) :]:
        axes.remove()
    log, count = inspection.log, len(inspection.findings)
    said = (
        "nothing looks wrong" if not count else f"{count} things look wrong" if count > 1 else "one thing looks wrong"
    )
    figure.suptitle(f"{shown(log.name)}, {log.duration_s:.0f} s: {said}", fontsize=11, parse_math=False)
    return figure


def page_file(out: Path | None, name: str) -> Path:
    """Return the path of the figure of the log called `name`.

    Args:
        out: a file; or a folder, for inspect-NAME.png in it; or None, for that in the current folder.
        name: of the log.

    Raises:
        DatasetError: the suffix is not one of FORMATS.
    """
    if out is None or out.is_dir() or not out.suffix:
        plain = re.sub(r"[^\w.=+-]+", "_", name)
        return (out or Path()) / f"inspect-{plain}.png"
    if out.suffix.lower() not in FORMATS:
        raise DatasetError(f"{out}: a figure is one of {', '.join(FORMATS)}; or give a folder")
    return out


def save_page(inspection: Inspection, file: Path) -> None:
    """Write the figure, in the format of the file's suffix.

    Raises:
        DatasetError: it cannot be written.
    """
    undated = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(file.suffix.lower(), {})
    with writing(file, "; choose another place by -o", error=DatasetError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with catch_warnings():  # letters that the font lacks are shown as boxes
            filterwarnings("ignore", message="Glyph", category=UserWarning)
            draw_inspection(inspection).savefig(file, dpi=130, metadata=undated)
