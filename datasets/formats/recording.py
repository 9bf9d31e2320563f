"""Recordings: files that hold many kinds of messages. The interface of their loaders, and the registry by format.

A loader is the model of the part `recording` of a log.yaml, and its fields are the keys of its format. It reads the
messages that the streams need, in one pass from front to back, and keeps nothing else. Units, frames, mountings and
noise are stated in log.yaml, so a loader knows a file format and no vehicle. Other packages can add loaders.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, ClassVar

from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from ..errors import DatasetError, load, nearest, not_loaded
from ..files import inside

LOADERS = {
    "ardupilot": "ardupilot:ArduPilotRecording",
    "imc": "imc:ImcRecording",
    "jsonlines": "json_lines:JsonLinesRecording",
    "mcap": "mcap_file:McapRecording",
    "ros": "ros_bag:RosRecording",
}
"""Our formats: module and class. Other packages add theirs by the entry-point group `fathom.loaders`."""


@dataclass(frozen=True)
class Wanted:
    """The columns that a description needs from one kind of message.

    Attributes:
        message: the message's name, or its topic.
        sender: which of several senders of this name; None for any.
        columns: fields of the message, and what the format adds to them.
    """

    message: str
    sender: int | None
    columns: tuple[str, ...]


@dataclass(frozen=True)
class TopicInfo:
    """A kind of message in a recording: name, type, number of messages, time from first to last (s), and fields.

    Attributes:
        sender: which of several senders of this name; None for one.
        missing: messages that the recording counts and does not contain.
    """

    message: str
    kind: str
    count: int
    span_s: float
    fields: tuple[str, ...]
    sender: int | None = None
    missing: int = 0


@dataclass(frozen=True)
class Messages:
    """The messages read from a recording.

    Attributes:
        columns: for each `Wanted`, its columns by name, (n,) each; integers stay integers.
        notes: what was skipped, one sentence each.
    """

    columns: Sequence[Mapping[str, NDArray[Any]]]
    notes: tuple[str, ...] = field(default=())


class Recording(BaseModel):
    """A configured loader: the file, and the keys of its format.

    Subclasses add their format's keys and implement `read` and `contents`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    host_clock: ClassVar[tuple[str, str]]
    """The column of host time stamps that every message of this format has, and its unit (s, ms, us or ns)."""
    suffixes: ClassVar[tuple[str, ...]] = ()
    """Suffixes of such files, in lower case."""

    format: str
    file: str
    """Path inside the folder of the log."""

    @abstractmethod
    def read(self, folder: Path, wanted: Sequence[Wanted]) -> Messages:
        """Read the file once.

        Raises:
            DatasetError: no such file, message, sender or field (with the nearest known), or no whole message.
        """

    @abstractmethod
    def contents(self, folder: Path) -> list[TopicInfo]:
        """Return the kinds of messages in the file, sorted by name.

        Raises:
            DatasetError: no such file, or not of this format.
        """

    def path(self, folder: Path) -> Path:
        """Return the path of the recording.

        Raises:
            DatasetError: it does not exist (with the nearest file that does), is no file or folder, or lies elsewhere.
        """
        return inside(folder, self.file, or_folder=True)


def known_formats() -> list[str]:
    """Return the names of our formats and of those from installed packages."""
    return sorted(LOADERS.keys() | _plugins().keys())


def loader(name: object) -> type[Recording]:
    """Return the loader of a format, ours or an installed package's; ours take precedence.

    Raises:
        DatasetError: unknown format (with the nearest known one), or its package cannot be loaded.
    """
    if isinstance(name, str) and name in LOADERS:
        module, kind = LOADERS[name].split(":")
        return getattr(import_module(f".{module}", __package__), kind)
    known = known_formats()
    if name not in known:
        raise DatasetError(f"no format {name!r}{nearest(str(name), known)} (known: {', '.join(known)})")
    point = _plugins()[str(name)]
    try:
        return load(point)
    except Exception as error:  # importing a foreign module may raise anything
        raise DatasetError(f"format {name!r}: {not_loaded(point, error)}") from error


def recording_at(path: Path) -> Recording | None:
    """Return the loader of a file without a log.yaml, by its suffix; None for an unknown suffix."""
    others = sorted(_plugins().keys() - LOADERS.keys())
    for name in [*LOADERS, *others]:  # other packages are imported only if none of ours fits
        kind = loader(name)
        if path.name.lower().endswith(kind.suffixes or ("\0",)):
            return kind(format=name, file=path.name)
    return None


def _plugins() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="fathom.loaders")}


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Name the missing extra when an import inside fails.

    Raises:
        DatasetError: instead of ImportError.
    """
    try:
        yield
    except ImportError as error:
        raise DatasetError(f"{error}; this format needs an extra: pip install 'fathom-bench[{name}]'") from None


def not_found(where: str, what: str, name: str, known: Iterable[str]) -> DatasetError:
    """Return the error for an unknown message or field: "no topic '/imu'; did you mean '/imu/data'?"."""
    names = sorted(map(str, known))
    found = ", ".join(names[:40]) + (", …" if len(names) > 40 else "")
    return DatasetError(f"{where}: no {what} {name!r}{nearest(name, names)}; found {found or 'none'}")
