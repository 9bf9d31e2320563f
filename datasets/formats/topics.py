"""Recordings whose messages are topics: ROS bags and MCAP files, read in one pass into compact columns.

A container yields the bytes of one message after another; the type of the message gives the positions of the wanted
numbers in them. Only these are kept, packed side by side, so a recording needs no more memory than its wanted columns.
"""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, shown
from ..state import TimeArray
from .recording import Messages, Recording, TopicInfo, Wanted, not_found

NS = 1_000_000_000
"""Nanoseconds per second."""
MOST_CHANNELS = 10_000
"""In a recording; a busy vehicle has some hundred topics."""
MOST_DEFINITIONS = 64 << 20
"""Bytes of all definitions of messages in a recording: 64 MiB; that of one type has some 10 kB."""
MOST_FIELDS, MOST_LEVELS = 10_000, 50
"""Of one type, or object of JSON, with all that it contains, and types in one another; large ones have some hundred
fields, and the deepest of ROS has 6 levels. Few lines can contain one another often."""
MOST_FIELDS_LISTED = 100_000
"""In the contents of a recording; a message has some 50."""
LEAST_COST = 100
"""Fields that listing a topic counts as at least, for types that are refused after a long look."""


class MalformedMessage(Exception):  # noqa: N818  (about one message; reading goes on)
    """The bytes of a message do not fit its type."""


class ShortArray(Exception):  # noqa: N818  (the same)
    """An array of a message is shorter than the wanted index."""

    def __init__(self, path: str, length: int) -> None:
        super().__init__(f"{path!r} has {length} elements")


class Extractor(Protocol):
    """Extracts the wanted numbers from the bytes of messages of one type."""

    @property
    def codes(self) -> Sequence[str]:
        """Return the types of the numbers, as codes of `struct`."""
        ...

    def __call__(self, data: bytes) -> Sequence[Any]:
        """Return the numbers.

        Raises:
            MalformedMessage, ShortArray, struct.error: the message does not contain them.
        """
        ...

    def columns(self, raw: Sequence[NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the wanted columns, from one array per code."""
        ...


@dataclass(frozen=True, eq=False)
class Channel:
    """One writer's messages of one topic.

    Attributes:
        kind: the name of their type.
        fields: lists the numeric fields; of an array, its first element.
        extractor: from wanted columns to their extractor; raises the error of `not_found` for an unknown column.
    """

    topic: str
    kind: str
    fields: Callable[[], tuple[str, ...]]
    extractor: Callable[[Sequence[str]], Extractor]


Message = tuple[Channel, tuple[int, ...], bytes]
"""A channel, the container's stamps (ns), and the bytes."""


@dataclass
class ScanResult:
    """The channels and notes that a pass over a recording has found so far."""

    channels: list[Channel] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    counts: dict[str, Counter[str]] = field(default_factory=dict)
    """Who counted the messages of the topics (an index, metadata), and how many."""
    _kept: int = 0

    def add(self, channel: Channel, definition: int) -> None:
        """Add a channel, of which a definition of so many bytes is kept."""
        if len(self.channels) >= MOST_CHANNELS:
            raise DatasetError(f"{channel.topic}: more than {MOST_CHANNELS} topics, which no recorder writes")
        self.keep(definition, channel.topic)
        self.channels.append(channel)

    def keep(self, definition: int, where: object) -> None:
        """Count the bytes of definitions that are kept."""
        self._kept += definition
        if self._kept > MOST_DEFINITIONS:
            raise DatasetError(f"{where}: definitions of messages of more than {MOST_DEFINITIONS >> 20} MiB in all")

    def count(self, source: str, topic: str, messages: int) -> None:
        """Add to what a source counts of a topic."""
        self.counts.setdefault(source, Counter())[topic] += messages

    def missing(self, topic: str, read: int) -> tuple[int, str]:
        """Return how many messages more a source counts than are read, the most of any, and who; 0 if none does."""
        return max(((counts[topic] - read, source) for source, counts in self.counts.items()), default=(0, ""))


class Rows:
    """Rows of numbers, packed in one growing array of bytes, without an object per row."""

    def __init__(self, codes: Sequence[str]) -> None:
        self._codes = list(codes)
        self._struct = struct.Struct("<" + "".join(codes))
        self._bytes = bytearray()

    def __len__(self) -> int:
        return len(self._bytes) // self._struct.size

    def append(self, values: Sequence[Any]) -> None:
        """Append a row; an integer column becomes one of floats when a float is appended."""
        try:
            self._bytes += self._struct.pack(*values)
        except struct.error:
            if not self._widened(values):  # a number that no float64 can hold
                raise
            self._bytes += self._struct.pack(*values)

    def arrays(self) -> list[NDArray[Any]]:
        """Return the columns, (n,) each."""
        table = np.frombuffer(self._bytes, self._dtype())
        return [np.array(table[name]) for name in table.dtype.names or ()]

    def _dtype(self) -> np.dtype[Any]:
        return np.dtype([(f"c{i}", "<" + code) for i, code in enumerate(self._codes)])

    def _widened(self, values: Sequence[Any]) -> bool:
        """Make floats of the integer columns in which a value is none; return whether there was such a column."""
        whole = [isinstance(value, int) and -(2**63) <= value < 2**63 for value in values]
        codes = [
            "d" if code == "q" and not is_whole else code for code, is_whole in zip(self._codes, whole, strict=True)
        ]
        if codes == self._codes:
            return False
        before = np.frombuffer(bytes(self._bytes), self._dtype())
        self._codes, self._struct = codes, struct.Struct("<" + "".join(codes))
        self._bytes = bytearray(before.astype(self._dtype()).tobytes())
        return True


class TopicRecording(Recording):
    """A recording of topics; subclasses read the messages from the files."""

    stamps: ClassVar[tuple[str, ...]] = ("log_time",)
    """Columns that the container adds to every message: int64 ns. Rows are sorted by the first."""

    @abstractmethod
    def messages(self, folder: Path, topics: Collection[str] | None, found: ScanResult) -> Iterator[Message]:
        """Yield the messages of these topics (None: of all) in the order of the file; also fill `found`.

        Raises:
            DatasetError: not a recording of this format, or nothing whole in it.
        """

    def read(self, folder: Path, wanted: Sequence[Wanted]) -> Messages:
        """Read the wanted topics; see `Recording.read`."""
        where = str(self.path(folder))
        for want in wanted:
            if want.sender is not None:
                raise DatasetError(f"{where}: {want.message}: topics have no `entity`; leave it out")
        tables = {want.message: _Table(want, where, self.stamps) for want in wanted}
        found = ScanResult()
        for channel, stamps, data in self.messages(folder, tables.keys(), found):
            tables[channel.topic].add(channel, stamps, data)
        notes = list(found.notes)
        for name, table in tables.items():
            missing, source = found.missing(name, table.count)
            if not table.channels:
                known = {channel.topic for channel in found.channels}
                if name in known:
                    counted = [f"{source} counts {missing}"] if missing > 0 else []
                    raise DatasetError("; ".join([f"{where}: no message of {name} in the recording", *counted, *notes]))
                raise not_found(where, "topic", name, known)
            if missing > 0:
                notes.append(
                    f"{name}: {missing} of the {missing + table.count} messages that {source} counts are missing"
                )
            notes += table.notes()
        return Messages([tables[want.message].columns() for want in wanted], tuple(map(shown, notes)))

    def contents(self, folder: Path) -> list[TopicInfo]:
        """Return the topics of the recording."""
        found = ScanResult()
        spans: dict[str, tuple[Channel, int, int, int]] = {}
        for channel, stamps, _ in self.messages(folder, None, found):
            _, count, first, last = spans.get(channel.topic, (channel, 0, stamps[0], stamps[0]))
            spans[channel.topic] = channel, count + 1, min(first, stamps[0]), max(last, stamps[0])
        infos, left = [], MOST_FIELDS_LISTED
        for topic, (channel, count, first, last) in spans.items():
            fields = _fields(channel) if left > 0 else ()
            left -= max(len(fields), LEAST_COST)
            missing, _ = found.missing(topic, count)
            infos.append(TopicInfo(topic, channel.kind, count, (last - first) / NS, fields, missing=max(missing, 0)))
        lost = {channel.topic: channel.kind for channel in found.channels if channel.topic not in spans}
        counted = {topic: found.missing(topic, 0)[0] for topic in lost}
        infos += [TopicInfo(topic, lost[topic], 0, 0.0, (), missing=n) for topic, n in counted.items() if n > 0]
        return sorted(infos, key=lambda info: info.message)


def _fields(channel: Channel) -> tuple[str, ...]:
    """Return the numeric fields of a topic; empty if its type is not defined, which is an error only when read."""
    try:
        return channel.fields()
    except DatasetError:
        return ()


class _Table:
    """The wanted columns of one topic, and the rows read so far."""

    def __init__(self, want: Wanted, where: str, stamps: tuple[str, ...]) -> None:
        self.want, self.where, self.stamps = want, f"{where}: {want.message}", stamps
        self.fields = [column for column in want.columns if column not in stamps]
        self.channels: dict[Channel, Extractor] = {}
        self.rows: Rows | None = None
        self.malformed, self.first_malformed = 0, ""

    @property
    def count(self) -> int:
        """Messages so far, damaged ones included."""
        return self.malformed + (0 if self.rows is None else len(self.rows))

    def add(self, channel: Channel, stamps: tuple[int, ...], data: bytes) -> None:
        extract = self.channels.get(channel) or self._opened(channel)
        rows = self.rows
        assert rows is not None
        try:
            rows.append((*stamps, *extract(data)))
        except ShortArray as error:
            row = len(rows) + self.malformed
            raise DatasetError(f"{self.where}: message {row}: {error}, and a later one is wanted") from None
        except (MalformedMessage, struct.error, RecursionError) as error:
            self.first_malformed = self.first_malformed or f"message {len(rows)}: {error}"
            self.malformed += 1

    def _opened(self, channel: Channel) -> Extractor:
        extract = channel.extractor(self.fields)
        first = next(iter(self.channels), channel)
        codes = [*["Q"] * len(self.stamps), *extract.codes]
        if self.rows is None:
            self.rows = Rows(codes)
        elif first.kind != channel.kind or list(self.channels[first].codes) != list(extract.codes):
            raise DatasetError(f"{self.where}: messages of two types, {first.kind} and {channel.kind}")
        self.channels[channel] = extract
        return extract

    def notes(self) -> list[str]:
        """Return what was skipped.

        Raises:
            DatasetError: most messages do not fit their type.
        """
        if not self.malformed:
            return []
        assert self.rows is not None
        kind = next(iter(self.channels)).kind
        if self.malformed > len(self.rows):
            count = self.malformed + len(self.rows)
            raise DatasetError(
                f"{self.where}: {self.malformed} of {count} messages are not what {kind or 'their type'} is defined "
                f"as, the first is {self.first_malformed}; is the definition that of the recording?"
            )
        return [f"{self.want.message}: {self.malformed} damaged messages skipped, the first is {self.first_malformed}"]

    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Return the wanted columns, in the order of the container's first stamp."""
        assert self.rows is not None
        raw = self.rows.arrays()
        stamps = dict(zip(self.stamps, map(_signed, raw), strict=False))
        columns = stamps | next(iter(self.channels.values())).columns(raw[len(self.stamps) :])
        t_ns = stamps[self.stamps[0]]
        if (t_ns[1:] < t_ns[:-1]).any():
            order = np.argsort(t_ns, kind="stable")
            columns = {name: values[order] for name, values in columns.items()}
        return {column: columns[column] for column in dict.fromkeys(self.want.columns)}


def _signed(values: NDArray[Any]) -> TimeArray:
    """Return int64 if the values fit; larger stamps are invalid times, and are reported later on."""
    return values.astype(np.int64) if values.max(initial=0) < 2**63 else values
