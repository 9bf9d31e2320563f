"""Shared by the verbs of `fathom timing`: progress, selection by pattern, a JSON file, the machine in words."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, TypeVar

from ..errors import ExperimentError
from ..files import writing
from ..results.store import provenance

Named = TypeVar("Named")
COLOUR = {
    "slower": "red",
    "broken": "red",
    "slower?": "yellow",
    "faster": "green",
    "missed": "red",
    "not measured": "yellow",
}
"""Of a verdict."""
PACKAGES = ("python", "numpy", "numba", "gtsam")
"""What decides how fast we are, beside our own code."""


class TimingError(ExperimentError):
    """Nothing can be measured: no such revision, no such name, a file that cannot be written."""


def select(known: Sequence[Named], only: str | None) -> list[Named]:
    """Return those whose name or group matches a pattern.

    Raises:
        TimingError: none does.
    """
    if only is None:
        return list(known)
    names = [(each, (getattr(each, "name", str(each)), getattr(each, "group", ""))) for each in known]
    chosen = [each for each, of in names if any(fnmatch(name, only) for name in of)]
    if not chosen:
        raise TimingError(f"--only {only!r} matches nothing; there are: {'; '.join(of[0] for _, of in names)}")
    return chosen


def save(out: Path | None, content: Mapping[str, Any]) -> None:
    """Write what was measured, with machine and versions, as JSON.

    Raises:
        TimingError: the file cannot be written.
    """
    if out is None:
        return
    of = provenance()
    made = {"commit": of["commit_id"], "versions": json.loads(of["versions"]), "machine": machine()}
    with writing(out, error=TimingError):
        out.write_text(json.dumps({**content, **made}, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def made(folder: Path) -> Path:
    """Return the folder, which is there now.

    Raises:
        TimingError: it cannot be made.
    """
    with writing(folder, "; give another --out", "made", TimingError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def machine() -> dict[str, Any]:
    """Return what decides how fast a machine is, without its name."""
    of = json.loads(provenance()["machine"])
    return {"cpu": of["cpu"], "cores": of["cores"], "system": f"{platform.system()} {platform.machine()}"}


def machine_text(about: str, versions: str) -> str:
    """Return machine and versions in a line, from the JSON that `provenance` gives of each."""
    of, known = json.loads(about), json.loads(versions)
    packages = ", ".join(f"{name} {known[name]}" for name in PACKAGES if name in known)
    return f"{of['cpu']}, {of['cores']} cores; {packages}"


@contextmanager
def progress() -> Iterator[Any]:
    """Give a function to call with what is being done and the share that is finished; draws a bar on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    console = Console(stderr=True)
    above = sys.stdout.isatty()  # lines that are printed meanwhile go above the bar; into a file they go as they are
    with Progress(*columns, console=console, redirect_stdout=above, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)
