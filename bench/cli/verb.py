"""Exit of every verb: bad input is a line per complaint on standard error and status 2; Ctrl-C is status 130."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer
from typer.core import TyperCommand

SOME_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
"""Exit statuses; 130 is what shells report for a command that Ctrl-C ended (128 + SIGINT)."""


class Verb(TyperCommand):
    """A command that reports what a user can correct, a line for each complaint. Bugs of ours keep their traceback."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; an invalid choice is reported without pydantic's prefix."""
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            if isinstance(message := getattr(error, "message", None), str):
                error.message = message.removeprefix("Value error, ")  # type: ignore[attr-defined]
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            with on_interrupt("interrupted"):
                return super().invoke(ctx)
        except MemoryError as error:
            detail = f" ({error})" if str(error) else ""
            refuse(
                f"not enough memory{detail}; end other programs, or give less: fewer --jobs, a shorter log", SOME_FAILED
            )
        except ValueError as error:
            from ...datasets.errors import FathomError
            from ..errors import StoppedError

            if not isinstance(error, FathomError):
                raise
            refuse(str(error), SOME_FAILED if isinstance(error, StoppedError) else BAD_INPUT)


@contextmanager
def on_interrupt(message: str) -> Iterator[None]:
    """On Ctrl-C, print what is kept and exit with status 130."""
    try:
        yield
    except KeyboardInterrupt:
        say(message)
        raise typer.Exit(INTERRUPTED) from None


def refuse(message: str, status: int = BAD_INPUT) -> None:
    """Print why nothing was run, or why it stopped, and exit."""
    say(f"fathom: {message}")
    raise typer.Exit(status) from None


def say(message: str) -> None:
    """Print on standard error."""
    from ..saying import say as print_line

    print_line(message)
