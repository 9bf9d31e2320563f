"""The contents of a recording without a log.yaml: its messages, their rates and their fields."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ...datasets.errors import shown
from ...datasets.formats.recording import TopicInfo


def print_contents(held: Sequence[TopicInfo], console: Console) -> None:
    """Print one row per kind of message; the fields are the columns that a log.yaml can name."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in ("message", "type", "from", "n", "Hz", "fields"):
        table.add_column(heading, justify="right" if heading in ("from", "n", "Hz") else "left", overflow="fold")
    for each in held:
        rate = f"{(each.count - 1) / each.span_s:.2f}" if each.span_s > 0 else "–"
        sender = "" if each.sender is None else str(each.sender)
        row = (each.message, each.kind, sender, f"{each.count:,}", rate, " ".join(each.fields))
        table.add_row(*map(Text, map(shown, row)))
    console.print(table)
    for each in held:
        if each.missing:
            counted = (
                f"{each.missing} of the {each.count + each.missing} messages that the recording counts are missing."
            )
            console.print(Text(f"{shown(each.message)}: {counted}"))
    console.print("No log.yaml describes it yet: docs/your-own-log.md shows how.", highlight=False)
