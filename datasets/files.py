"""The files that readers may open: regular ones, since a pipe waits for ever and a device has no end."""

from __future__ import annotations

import stat
from pathlib import Path

from .errors import DatasetError, nearest_file


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
