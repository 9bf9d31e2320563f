"""The command `fathom`. Each verb imports what it needs when it runs, so that `fathom --help` answers at once."""

from __future__ import annotations

import typer

from .inspect_ import inspect
from .list_ import list_
from .report import report
from .reproduce import reproduce
from .run import run
from .score import score
from .simulate import simulate
from .stdout import set_up
from .timing import timing
from .tune import tune
from .verb import Verb

app = typer.Typer(
    help="Filter or smoother? A benchmark for underwater navigation.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for name, verb in (
    ("run", run),
    ("report", report),
    ("reproduce", reproduce),
    ("list", list_),
    ("simulate", simulate),
    ("inspect", inspect),
    ("tune", tune),
    ("score", score),
):
    app.command(name, cls=Verb)(verb)
app.add_typer(timing, name="timing")


def main() -> None:
    """Run the command line."""
    set_up()
    app()


if __name__ == "__main__":
    main()
