"""Writing files: the error where it fails, files that are whole or not there, and tables that are safe to open."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..datasets.errors import shown
from .errors import ExperimentError

if TYPE_CHECKING:
    import pandas as pd

FORMULA = re.compile("'*[=+\\-@\\t\\r＝＋－＠]")
"""How a cell begins that a spreadsheet would compute, behind any apostrophes that `write_csv` puts before."""


@contextmanager
def writing(
    path: Path, advice: str = "", what: str = "written", error: type[ValueError] = ExperimentError
) -> Iterator[None]:
    """Raise ExperimentError, or another error, in place of an OSError; `advice` follows what cannot be done."""
    try:
        yield
    except OSError as failure:
        at = "" if failure.filename in (None, str(path)) else f", {failure.filename}"
        raise error(f"{path}: cannot be {what} ({failure.strerror}{at}){advice}") from None


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under another name first, so that it is never there in part; it is on the disk when this returns.

    Raises:
        OSError: it cannot be written; then nothing of it is left.
    """
    unfinished = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise
    flush_folder(path.parent)


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV. Text is written as `shown` gives it; where it would be a formula, an apostrophe precedes.

    Raises:
        OSError: it cannot be written.
    """
    texts = [name for name in table if table[name].dtype.kind not in "iufbM"]
    safe = table.assign(**{str(name): table[name].map(_harmless) for name in texts})
    safe.rename(columns=_harmless).to_csv(path, index=False)


def from_csv(text: str) -> str:
    """Return the text that `write_csv` put into a cell, as it was shown."""
    return text[1:] if text.startswith("'") and FORMULA.match(text) else text


def _harmless(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    with suppress(ValueError):
        float(value)
        return value
    text = shown(value)
    return f"'{text}" if FORMULA.match(text) else text


def flush_folder(folder: Path) -> None:
    """Put on the disk which names a folder holds; do nothing where the system cannot flush folders."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
