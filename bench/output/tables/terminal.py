"""The console for tables: as wide as the terminal, or 120 columns without a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from ....datasets.errors import shown

WIDTH = 120
"""Columns of output to a file or a pipe: enough for the tables of README."""
ANY_WIDTH = 10_000
"""More letters than any table is wide; in less room rich gives the width after cutting."""
NAME_WIDTH = 14
"""The column of names has at least this many letters: narrower, names would be hard to read."""
LONGEST_WORD = 32
"""Words of a name with more letters are folded: beside a longer one, 80 columns leave no room for two numbers."""
NAME_SHARE = 0.4
"""Of a console's width for names: the rest holds four or five numbers."""


def console() -> Console:
    """Return a console on standard output."""
    there = Console()
    there = there if there.is_terminal else Console(width=WIDTH)
    there.push_render_hook(Plain())
    return there


class Plain(RenderHook):
    """Passes on all that a console prints with its text as `shown` gives it."""

    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        """Return the same, each with plain text."""
        return [_PlainText(each) for each in renderables]


@dataclass(frozen=True)
class _PlainText:
    of: ConsoleRenderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
        for segment in console.render(self.of, options):
            text = "\n".join(map(shown, segment.text.split("\n")))
            yield segment if segment.control else segment._replace(text=text)


def plain_table(heading: str, names: Sequence[str], title: str | None = None, width: int = 0) -> Table:
    """Return a table without frames that has one column yet: of names, folded between words where there is no room.

    Args:
        heading, title: of the column, and of the table.
        names: of the rows.
        width: of the console. Names are not folded within NAME_SHARE of it.
    """
    longest = max((cell_len(word) for name in names for word in name.split()), default=0)
    whole = min(max(map(cell_len, names), default=0), int(NAME_SHARE * width))
    table = Table(
        title=None if title is None else Text(title, "table.title"),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column(heading, overflow="fold", min_width=max(NAME_WIDTH, min(longest, LONGEST_WORD), whole))
    return table
