"""Recordings: formats whose files hold many kinds of messages, one loader each; other packages bring more.

A loader is the model of the part `recording` of a log.yaml: its fields are the keys that its format has there, and it
reads what the streams ask for, in one pass from front to back, keeping nothing else. What the messages mean (units,
frames, mountings, noise) stands in log.yaml, so a loader knows a file format and no vehicle.
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

from ..errors import DatasetError, nearest, nearest_file, not_loaded

LOADERS = {
    "ardupilot": "ardupilot:ArduPilotRecording",
    "imc": "imc:ImcRecording",
    "mcap": "mcap_file:McapRecording",
    "ros": "ros_bag:RosRecording",
}
"""Our formats: module and class. Other people's join by the entry-point group `fathom.loaders`."""


@dataclass(frozen=True)
class Wanted:
    """What a description asks of one kind of message.

    Attributes:
        message: the message's name, or its topic.
        sender: which of several senders of this name; any where None.
        columns: fields of the message, and what the format adds to them.
    """

    message: str
    sender: int | None
    columns: tuple[str, ...]


@dataclass(frozen=True)
class Held:
    """A kind of message that a recording holds: its name, its type, how often, over which time (s), and its fields."""

    message: str
    kind: str
    count: int
    span_s: float
    fields: tuple[str, ...]
    sender: int | None = None


@dataclass(frozen=True)
class Messages:
    """What a recording gave.

    Attributes:
        columns: for each Wanted in turn, its columns by name, (n,) each; integers stay integers.
        notes: what was passed over, in sentences.
    """

    columns: Sequence[Mapping[str, NDArray[Any]]]
    notes: tuple[str, ...] = field(default=())


class Recording(BaseModel):
    """A loader, configured: where the recording is and what its format wants to know.

    Subclasses add their format's keys and fill in `read` and `contents`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    host_clock: ClassVar[tuple[str, str]]
    """The column of the host's stamps that every message of this format has, and its unit (s, ms, us or ns)."""
    suffixes: ClassVar[tuple[str, ...]] = ()
    """How the names of such files end, in small letters."""

    format: str
    file: str
    """Path inside the folder of the log."""

    @abstractmethod
    def read(self, folder: Path, wanted: Sequence[Wanted]) -> Messages:
        """Read the file once.

        Raises:
            DatasetError: no such file, message, sender or field (with the nearest known), or not one whole message.
        """

    @abstractmethod
    def contents(self, folder: Path) -> list[Held]:
        """Return what the file holds, in the order of its names.

        Raises:
            DatasetError: no such file, or not of this format.
        """

    def path(self, folder: Path) -> Path:
        """Return where the recording lies.

        Raises:
            DatasetError: it is not there; names the nearest file that is.
        """
        path = folder / self.file
        if not path.exists():
            raise DatasetError(f"{path}: no such file{nearest_file(path, folders=True)}")
        return path


def known_formats() -> list[str]:
    """Return the names of our formats and of those that installed packages bring."""
    return sorted(LOADERS.keys() | _plugins().keys())


def loader(name: object) -> type[Recording]:
    """Return the loader of a format, ours or an installed package's; ours win.

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
        return point.load()
    except Exception as error:  # whatever somebody's module does when it is imported
        raise DatasetError(f"format {name!r}: {not_loaded(point, error)}") from error


def recording_at(path: Path) -> Recording | None:
    """Return the loader of a file that nobody has described, by how its name ends; None where that tells nothing."""
    others = sorted(_plugins().keys() - LOADERS.keys())
    for name in [*LOADERS, *others]:  # nobody else's package is imported where ours can help
        kind = loader(name)
        if path.name.lower().endswith(kind.suffixes or ("\0",)):
            return kind(format=name, file=path.name)
    return None


def _plugins() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="fathom.loaders")}


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Name the extra that is missed when an import inside fails.

    Raises:
        DatasetError: instead of ImportError.
    """
    try:
        yield
    except ImportError as error:
        raise DatasetError(f"{error}; this format needs an extra: pip install 'fathom-bench[{name}]'") from None


def not_held(where: str, what: str, name: str, known: Iterable[str]) -> DatasetError:
    """Return the error for a message or field that is not there: "no topic '/imu'; did you mean '/imu/data'?"."""
    names = sorted(map(str, known))
    found = ", ".join(names[:40]) + (", …" if len(names) > 40 else "")
    return DatasetError(f"{where}: no {what} {name!r}{nearest(name, names)}; found {found or 'none'}")
