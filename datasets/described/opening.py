"""Open a log: by the name of a catalog entry, by folder, or by a description beside its data."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import DatasetError, nearest
from ..files import also_in
from ..log import Log
from .conversion import build_log
from .description import read_description

CATALOG = Path(__file__).parents[1] / "catalog"
"""Where the descriptions lie that come with this package."""


class RecordingNotFound(DatasetError):  # noqa: N818  (named as FileNotFoundError's kin, without the suffix)
    """The description is in the catalog, but its recording was not found."""


def catalog_names() -> list[str]:
    """Return the names of the logs whose descriptions come with this package."""
    return sorted(path.stem for path in CATALOG.glob("*.yaml"))


def open_log(name_or_folder: str | Path, data: str | Path | None = None, *, repair: bool = False) -> Log:
    """Open a log.

    Args:
        name_or_folder: a folder with a log.yaml, by its path or by its name in `data`; or a catalog entry's name, or
            its recording's folder; or a description file (.yaml), whose files lie in `data`, or next to it.
        data: folder whose subfolders are the recordings; FATHOM_DATA when left out.
        repair: drop rows that are not finite or out of order, at most half of a stream, and count them in the log's
            notes, instead of an error.

    A description names files in its folder, or in the data folder; it reads no others.

    Raises:
        RecordingNotFound: the catalog entry is known, its recording is missing.
        DatasetError: anything else, naming what, where, and the nearest known name.
    """
    try:
        file, folder = find_log(name_or_folder, data)
        with also_in(_recordings(data)):
            return build_log(read_description(file), folder, repair=repair)
    except (OSError, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{name_or_folder}: cannot be opened: {error}") from None


def find_log(name_or_folder: str | Path, data: str | Path | None = None) -> tuple[Path, Path]:
    """Return a log's description (.yaml) and the folder of its files; arguments and errors are those of `open_log`."""
    path, root = Path(name_or_folder), _recordings(data)
    if (path / "log.yaml").is_file():
        return path / "log.yaml", path
    if path.suffix == ".yaml" and path.is_file():
        return path, path.parent if data is None else Path(data)
    if root is not None and (root / path / "log.yaml").is_file():
        return root / path / "log.yaml", root / path
    if str(name_or_folder) in catalog_names():
        return _catalogued(str(name_or_folder), data)
    if path.is_dir():
        if path.resolve().name in catalog_names():  # the recording's own folder
            return CATALOG / f"{path.resolve().name}.yaml", path
        raise DatasetError(
            f"{path}: no log.yaml in this folder; it describes the files (see fathom.datasets.described.description)"
        )
    names = catalog_names()
    hint = nearest(str(name_or_folder), names)
    within = "" if root is None else f" nor a folder with a log.yaml in {root}"
    raise DatasetError(
        f"{name_or_folder}: no such log{hint}; neither a folder{within} nor a known name ({', '.join(names)})"
    )


def _recordings(data: str | Path | None) -> Path | None:
    """Return the folder of recordings: `data`, else FATHOM_DATA; None where neither is set."""
    root = data if data is not None else os.environ.get("FATHOM_DATA") or None
    return None if root is None else Path(root)


def _catalogued(name: str, data: str | Path | None) -> tuple[Path, Path]:
    root = _recordings(data)
    if root is None:
        raise RecordingNotFound(f"{name}: the folder of recordings is not set; use --data DIR or set FATHOM_DATA")
    folder = root / name
    if not folder.is_dir():
        whence = "--data" if data is not None else "FATHOM_DATA"
        raise RecordingNotFound(
            f"{name}: no folder {folder} ({whence}); point --data or FATHOM_DATA at its parent folder"
        )
    return CATALOG / f"{name}.yaml", folder
