"""The files that readers may open.

Regular ones, since a pipe waits for ever and a device has no end. Of those that a description names, only what lies in
its folder or in the data folder: it may come from somebody else, and errors quote what they read.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from .errors import DatasetError, nearest_file

_data: ContextVar[Path | None] = ContextVar("data", default=None)


@contextmanager
def also_in(data: Path | None) -> Iterator[None]:
    """Let `inside` take files of the data folder as well."""
    before = _data.set(data)
    try:
        yield
    finally:
        _data.reset(before)


def inside(folder: Path, name: str, *, or_folder: bool = False) -> Path:
    """Return the path of an existing regular file (or a folder, where a format allows one) that a description names.

    Args:
        folder: of the description, or of its recording.
        name: as the description states it; `~`, variables, patterns and addresses mean nothing here.
        or_folder: whether it may be a folder.

    Raises:
        DatasetError: it lies neither in `folder` nor in the data folder, once links are followed; or as `regular_file`.
    """
    path, data = folder / name, _data.get()
    try:
        real, roots = path.resolve(), [root.resolve() for root in (folder, data) if root is not None]
    except (OSError, RuntimeError, ValueError):  # a circle of links, a null character in the name
        return regular_file(path, or_folder=or_folder)
    if not any(real.is_relative_to(root) for root in roots):
        where = "the log's folder" if data is None else "the log's folder and the data folder"
        raise DatasetError(f"{path}: outside {where}, where a log.yaml reads no file; put a copy there")
    return regular_file(path, or_folder=or_folder)


def regular_file(path: Path, *, or_folder: bool = False) -> Path:
    """Return the path of an existing regular file (or a folder, where a format allows one); links are followed.

    Raises:
        DatasetError: there is no such file, with the nearest one that exists; or it is something else.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file{nearest_file(path, folders=or_folder)}") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise DatasetError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if stat.S_ISREG(mode) or (or_folder and stat.S_ISDIR(mode)):
        return path
    found = "a folder" if stat.S_ISDIR(mode) else "a pipe, a device or a socket"
    raise DatasetError(f"{path}: expected a file, found {found}")
