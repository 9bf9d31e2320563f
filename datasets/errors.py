"""`DatasetError`, the one exception of this package that a caller might catch, and the wording of hints."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from importlib.metadata import EntryPoint
from pathlib import Path


class DatasetError(ValueError):
    """A log, a description or a trajectory file cannot be used; the message says what, where and what to do."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the known name closest to `name`, or "" if none is close; ignores case."""
    folded = {other.casefold(): other for other in known}
    close = difflib.get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean {folded[close[0]]!r}?" if close else ""


def nearest_file(path: Path, *, folders: bool = False) -> str:
    """Return `nearest` for a missing file, among the files (and folders) next to it."""
    beside = path.parent.iterdir() if path.parent.is_dir() else []
    return nearest(path.name, [other.name for other in beside if folders or other.is_file()])


def one_line(error: Exception) -> str:
    """Return the class and the message of an error, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def not_loaded(point: EntryPoint, error: Exception) -> str:
    """Return that an entry point of an installed package cannot be loaded, and why."""
    package = point.dist.name if point.dist else point.value
    return f"cannot be loaded from the package {package!r}: {one_line(error)}"
