"""ArduPilot dataflash logs (.BIN): messages of fixed size, whose layouts are in the log itself as FMT messages.

The file is read in chunks and only the wanted messages are kept. There are no checksums: a message is accepted if
another header or the end of the file follows it; anything else is skipped up to the next header. The letters of layouts
are pymavlink's. Its own reader is not used: it keeps 40 bytes of index for every message of the file, decodes one at a
time, and loses the whole log to one damaged FMT (tested with 2.4.50).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from .recording import Messages, Recording, TopicInfo, Wanted, extra, not_found

HEAD = b"\xa3\x95"
FMT = 0x80
"""The number of the messages that describe the others."""
FMT_BODY = struct.Struct("<BB4s16s64s")
HEADER = ","
"""Our name for the first three bytes of a message; no column can have it."""
CHUNK_BYTES = 1 << 20
"""Read at a time: 1 MiB."""
BATCH_BYTES = 1 << 16
"""Collected of one kind before it is decoded by numpy: 64 KiB, some hundred messages or more."""

Alphabet = Mapping[str, tuple[str, float | None, type]]
"""A letter of a layout: its code in `struct`, its scale, and its type in Python; pymavlink's."""


@dataclass(frozen=True)
class Layout:
    """The layout of one kind of message.

    Attributes:
        name: its name in the log.
        rows: one message, header included.
        scales: columns that are stored as scaled integers, and their scales.
    """

    name: str
    rows: np.dtype[Any]
    scales: Mapping[str, float]

    @property
    def fields(self) -> tuple[str, ...]:
        """The columns, in order."""
        return (self.rows.names or ())[1:]

    def is_number(self, column: str) -> bool:
        """Whether a column holds one number; the others are text, or the 32 numbers of a burst."""
        return self.rows[column].kind in "iuf"

    def values(self, rows: NDArray[Any], column: str) -> NDArray[Any]:
        """Return (n,): a column, scaled by the same division as pymavlink's, for equal bits."""
        scale = self.scales.get(column)
        return rows[column].copy() if scale is None else rows[column] / (1 / scale)


def parse_format(message: bytes, alphabet: Alphabet) -> tuple[int, Layout] | None:
    """Return the number and the layout of an FMT message; None if it contradicts itself."""
    number, length, *texts = FMT_BODY.unpack(message[3:])
    name, letters, columns = (text.split(b"\0")[0].decode("latin-1") for text in texts)
    names = columns.split(",") if columns else []
    if not name or len(names) != len(letters) or not all(names) or not set(letters) <= alphabet.keys():
        return None
    try:
        codes = [_numpys(alphabet[letter][0]) for letter in letters]
        rows = np.dtype([(HEADER, "V3"), *zip(names, codes, strict=True)])
    except ValueError:  # two columns of one name
        return None
    scales = {column: alphabet[letter][1] for column, letter in zip(names, letters, strict=True)}
    layout = Layout(name, rows, {column: scale for column, scale in scales.items() if scale is not None})
    return (number, layout) if rows.itemsize == length else None


def _numpys(code: str) -> str:
    """Return numpy's name of a code of `struct`: 64s is S64."""
    return f"S{code[:-1]}" if code.endswith("s") else f"<{code}"


class ArduPilotRecording(Recording):
    """An ArduPilot dataflash log (.BIN). A message's sender is its instance, if the log names the field of it.

    Values are those of pymavlink: latitudes and longitudes in degrees, hundredths divided by 100. The multipliers of
    FMTU concern units only and are not applied (GMS stays in milliseconds).
    """

    host_clock: ClassVar = ("TimeUS", "us")
    suffixes: ClassVar = (".bin",)

    def read(self, folder: Path, wanted: Sequence[Wanted]) -> Messages:
        """Read the wanted messages; see `Recording.read`.

        Raises:
            DatasetError: also for a field that is not a number, or several instances of which none is chosen.
        """
        where = str(self.path(folder))
        scan = _Scan(frozenset(want.message for want in wanted))
        kept = [_Kept(want) for want in wanted]
        for batch in scan.batches(self.path(folder)):
            for one in kept:
                if one.want.message == batch.layout.name:
                    one.add(batch, where)
        for one in kept:
            if one.want.message not in scan.counts:
                raise not_found(where, "message", one.want.message, scan.counts)
        return Messages([one.columns(where) for one in kept], scan.notes())

    def contents(self, folder: Path) -> list[TopicInfo]:
        """Return the messages of the log, by name and instance."""
        found: dict[tuple[str, int | None], TopicInfo] = {}
        times: dict[tuple[str, int | None], tuple[int, int]] = {}
        for batch in _Scan(None).batches(self.path(folder)):
            senders = batch.senders()
            for sender in [None] if senders is None else np.unique(senders).tolist():
                rows = batch.rows if senders is None else batch.rows[senders == sender]
                key = (batch.layout.name, sender)
                count = len(rows) + (found[key].count if key in found else 0)
                if "TimeUS" in batch.layout.fields and batch.layout.rows["TimeUS"].kind in "iu":
                    stamps = [int(rows["TimeUS"].min()), int(rows["TimeUS"].max()), *times.get(key, ())]
                    times[key] = (min(stamps), max(stamps))
                first, last = times.get(key, (0, 0))
                found[key] = TopicInfo(batch.layout.name, "", count, (last - first) * 1e-6, batch.layout.fields, sender)
        return [found[key] for key in sorted(found, key=lambda k: (k[0], k[1] or 0))]


@dataclass(frozen=True)
class _Batch:
    """Some messages of one kind, in the order of the file; `sender_field` holds the instance, if there are several."""

    layout: Layout
    rows: NDArray[Any]
    sender_field: str | None

    def senders(self) -> NDArray[Any] | None:
        return None if self.sender_field is None else self.rows[self.sender_field]


class _Kept:
    """The columns of one `Wanted`, collected batch by batch."""

    def __init__(self, want: Wanted) -> None:
        self.want = want
        self.parts: dict[str, list[NDArray[Any]]] = {column: [] for column in want.columns}
        self.instances: set[int] = set()
        self.count = 0

    def add(self, batch: _Batch, where: str) -> None:
        layout, rows, senders = batch.layout, batch.rows, batch.senders()
        for column in self.want.columns:
            if column not in layout.fields:
                raise not_found(where, f"field of {layout.name} called", column, layout.fields)
            if not layout.is_number(column):
                raise DatasetError(f"{where}: {layout.name}.{column} is not a number; choose another field")
        if senders is not None:
            self.instances |= set(np.unique(senders).tolist())
            if self.want.sender is not None:
                rows = rows[senders == self.want.sender]
        elif self.want.sender is not None:
            raise DatasetError(f"{where}: {layout.name} has no instances; leave `entity` out")
        self.count += len(rows)
        for column, parts in self.parts.items():
            parts.append(layout.values(rows, column))

    def columns(self, where: str) -> dict[str, NDArray[Any]]:
        name, instances = self.want.message, sorted(self.instances)
        if self.want.sender is None and len(instances) > 1:
            raise DatasetError(f"{where}: {name} comes from instances {instances}; choose one, as `entity`")
        if not self.count:
            raise DatasetError(f"{where}: no {name} from instance {self.want.sender}; it comes from {instances}")
        return {column: np.concatenate(self.parts.pop(column)) for column in self.want.columns}


@dataclass
class _Scan:
    """One pass over one file.

    Attributes:
        names: messages to yield; None for all.
        counts: whole messages read so far, by name.
    """

    names: frozenset[str] | None
    counts: dict[str, int] = field(default_factory=dict)
    _layouts: dict[int, Layout] = field(default_factory=dict)
    _lengths: list[int] = field(default_factory=lambda: [0] * 256)
    _sender_fields: dict[int, str] = field(default_factory=dict)
    _gaps: int = 0
    _skipped: int = 0
    _unsound: int = 0
    _cut_off: str | None = None

    def batches(self, path: Path) -> Iterator[_Batch]:
        """Yield the messages, some of one kind at a time, each kind in the order of the file.

        Raises:
            DatasetError: it cannot be opened, or contains no whole message.
        """
        with extra("ardupilot"):
            from pymavlink.DFReader import FORMAT_TO_STRUCT
        self._lengths[FMT] = 3 + FMT_BODY.size
        buffers: dict[int, bytearray] = {}
        try:
            stream = path.open("rb")
        except OSError as error:
            raise DatasetError(f"{path}: cannot be opened: {error.strerror}") from None
        whole = 0
        with stream:
            for number, message in self._messages(stream):
                whole += 1
                if number == FMT:
                    parsed = parse_format(message, FORMAT_TO_STRUCT)
                    if parsed is None:
                        self._unsound += 1
                    elif parsed[1] != self._layouts.get(parsed[0]):
                        yield from self._flushed(parsed[0], buffers)
                        self._define(*parsed)
                    continue
                layout = self._layouts[number]
                self.counts[layout.name] = self.counts.get(layout.name, 0) + 1
                if layout.name == "FMTU":
                    self._name_sender(layout, message)
                if self.names is None or layout.name in self.names:
                    buffer = buffers.setdefault(number, bytearray())
                    buffer += message
                    if len(buffer) >= BATCH_BYTES:
                        yield from self._flushed(number, buffers)
        if not whole:
            raise DatasetError(f"{path}: contains no whole dataflash message; is it an ArduPilot log (.BIN)?")
        for number in list(buffers):
            yield from self._flushed(number, buffers)

    def notes(self) -> tuple[str, ...]:
        """Return what was skipped, one sentence each."""
        notes = [
            (self._gaps, f"ardupilot: {self._gaps} stretches, {self._skipped} bytes, of no whole message skipped"),
            (self._unsound, f"ardupilot: {self._unsound} FMT messages that contradict themselves skipped"),
            (self._cut_off is not None, f"ardupilot: the file ends inside a message{self._cut_off}"),
        ]
        return tuple(note for count, note in notes if count)

    def _define(self, number: int, layout: Layout) -> None:
        if number != FMT:
            self._layouts[number] = layout
            self._lengths[number] = layout.rows.itemsize
            self._sender_fields.pop(number, None)

    def _name_sender(self, layout: Layout, message: bytes) -> None:
        """Take from an FMTU message the field that holds the instance of a kind: the one whose unit is '#'."""
        row = np.frombuffer(message, layout.rows)[0]
        if {"FmtType", "UnitIds"} <= set(layout.fields) and layout.rows["UnitIds"].kind == "S":
            described = self._layouts.get(int(row["FmtType"])) if layout.is_number("FmtType") else None
            at = row["UnitIds"].find(b"#")
            if described is not None and 0 <= at < len(described.fields):
                self._sender_fields[int(row["FmtType"])] = described.fields[at]

    def _flushed(self, number: int, buffers: dict[int, bytearray]) -> Iterator[_Batch]:
        buffer = buffers.pop(number, None)
        if not buffer:
            return
        layout = self._layouts[number]
        sender_field = self._sender_fields.get(number, "I" if "I" in layout.fields else None)
        if sender_field is not None and layout.rows[sender_field].kind not in "iu":
            sender_field = None
        yield _Batch(layout, np.frombuffer(buffer, layout.rows), sender_field)

    def _messages(self, stream: IO[bytes]) -> Iterator[tuple[int, bytes]]:
        """Yield the number and the bytes of every whole message whose layout has been defined before it."""
        data, at, final, in_gap = b"", 0, False, False
        while not final:
            try:
                chunk = stream.read(CHUNK_BYTES)
            except OSError as error:
                chunk, self._cut_off = b"", f" ({error.strerror})"
            final = not chunk
            data, at = data[at:] + chunk, 0
            n = len(data)
            while at + 3 <= n:
                length = self._lengths[data[at + 2]] if data.startswith(HEAD, at) else 0
                end = at + length
                if length and end + 2 > n and not final:
                    break
                if length and end <= n and HEAD.startswith(data[end : end + 2]):
                    yield data[at + 2], data[at:end]
                    at, in_gap = end, False
                    continue
                if length and end > n and self._cut_off is None:
                    self._cut_off = ""
                self._gaps += not in_gap
                in_gap = True
                found = data.find(HEAD, at + 1)
                onward = found if found >= 0 else n - 1  # the last byte may begin a header
                self._skipped += onward - at
                at = onward
        self._skipped += len(data) - at
        self._gaps += at < len(data) and not in_gap
