"""Lines on standard error: as plain text, and on a terminal folded between words."""

from __future__ import annotations

import sys
from textwrap import fill

from ..datasets.errors import shown

LEAST_WIDTH = 20
"""Letters of a line on a terminal that says to be narrower, or of no width at all."""


def say(message: str) -> None:
    """Print lines on standard error; where that is a terminal, folded at its width, else whole for a search."""
    width = None
    if sys.stderr.isatty():
        from rich.console import Console

        width = Console(stderr=True).width
    for line in message.splitlines():
        text = shown(line.rstrip())
        print(text if width is None else folded(text, width), file=sys.stderr, flush=True)


def folded(text: str, width: int, indent: int = 2) -> str:
    """Return a text in lines of `width` letters, folded between words; a longer word, as of a path, stays whole.

    Lines after the first begin `indent` further to the right.
    """
    begin = text[: len(text) - len(text.lstrip())]
    return fill(
        text,
        max(width, LEAST_WIDTH),
        subsequent_indent=begin + indent * " ",
        break_on_hyphens=False,
        break_long_words=False,
    )
