"""Writing files: the error where it fails, and files that are whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import ExperimentError


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


def flush_folder(folder: Path) -> None:
    """Put on the disk which names a folder holds; do nothing where the system cannot flush folders."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
