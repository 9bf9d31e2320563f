"""MCAP files: messages in Protocol Buffers, ROS 2's CDR, ROS 1's bytes, or JSON.

A file is read from front to back, chunk by chunk. Its index is not used: it is at the end of the file, and missing if
the recorder lost its power.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, one_line
from .json_lines import JsonExtractor
from .recording import extra, not_found
from .ros_messages import Definitions, Types, definitions_of, ros_channel, short_name
from .topics import (
    MOST_FIELDS,
    MOST_LEVELS,
    NS,
    Channel,
    MalformedMessage,
    Message,
    ScanResult,
    ShortArray,
    TopicRecording,
)
from .unpacking import Unpacking

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 2, 3, 4, 5, 6, 11
"""Opcodes of the records that are read (MCAP specification, "Records"); 0 is none."""
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
"""Of a chunk: times of its first and last message, its size and checksum unpacked, and the length of what follows."""
_LENGTH = struct.Struct("<Q")
MOST_TYPES = 10_000
"""Types in a schema of Protocol Buffers; each makes a class of Python of some 3 kB."""
_TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")


class McapRecording(TopicRecording):
    """An MCAP file. Messages are topics; `log_time` is when each was recorded, `publish_time` when it was sent."""

    host_clock = ("log_time", "ns")
    suffixes: ClassVar = (".mcap",)
    stamps: ClassVar = ("log_time", "publish_time")

    def messages(self, folder: Path, topics: Collection[str] | None, found: ScanResult) -> Iterator[Message]:
        """Yield the messages of a file; see `TopicRecording.messages`."""
        return mcap_messages(self.path(folder), {}, topics, found)


def mcap_messages(
    plain: Path, types: Types, topics: Collection[str] | None, found: ScanResult, path: Path | None = None
) -> Iterator[Message]:
    """Yield the messages of an MCAP file; damaged parts are skipped and counted in `found.notes`.

    Args:
        plain: the file.
        path: its name in errors, if different.
        types: definitions of ROS messages that the file does not define itself.

    Raises:
        DatasetError: not an MCAP file, or it contains no whole message.
    """
    path = plain if path is None else path
    try:
        stream = plain.open("rb")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    with stream:
        magic = stream.read(len(MAGIC))
        if magic != MAGIC:
            what = f"it begins with {magic!r}" if magic else "an empty file"
            raise DatasetError(f"{path}: not an MCAP file: {what}")
        at, size, opcode = len(MAGIC), plain.stat().st_size, -1
        reading = _Reading(path, types, topics, found, size)
        while at + _RECORD.size <= size and opcode != FOOTER:
            opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
            start, at = at + _RECORD.size, at + _RECORD.size + length
            if opcode == 0 or (at > size and opcode != CHUNK):
                break
            if opcode == CHUNK:
                yield from reading.packed(stream.read(min(length, size - start)), whole=at <= size)
            elif opcode in (SCHEMA, CHANNEL, MESSAGE, STATISTICS):
                yield from reading.records(opcode, stream.read(length))
            stream.seek(min(at, size))
    if opcode != FOOTER:
        found.notes.append(f"{path.name}: damaged, or cut off: nothing is read from there on (of {size} bytes)")
    if reading.damaged:
        found.notes.append(f"{path.name}: {reading.damaged} damaged chunks or records skipped")
    if not reading.whole:
        notes = "; ".join(["", *found.notes])
        raise DatasetError(f"{path}: contains no whole message{notes}")


class _Reading:
    """The schemas and channels of a file, while its records are read."""

    def __init__(self, path: Path, types: Types, topics: Collection[str] | None, found: ScanResult, size: int) -> None:
        with extra("mcap"):
            import mcap.records
            from mcap.data_stream import ReadDataStream
        self.of_mcap: Any = mcap.records
        self.stream = ReadDataStream
        self.path, self.types, self.topics, self.found = path, types, topics, found
        self.unpacking = Unpacking(str(path), size, "mcap")
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, Channel] = {}
        self.wanted: set[int] = set()
        self.whole = self.damaged = 0

    def packed(self, chunk: bytes, *, whole: bool) -> Iterator[Message]:
        """Yield the wanted messages of a chunk; of one that is not whole, those that are there."""
        try:
            _, _, size, checksum, length = _CHUNK.unpack_from(chunk)
            at = _CHUNK.size + length
            compression = chunk[_CHUNK.size : at].decode()
            data = chunk[at + _LENGTH.size :][: _LENGTH.unpack_from(chunk, at)[0]]
            data = self.unpacking.unpacked(compression, data, whole=whole)
            if whole and (crc32(data) != checksum if checksum else len(data) != size):
                raise ValueError("not what was packed")
        except DatasetError:
            raise
        except Exception:  # the decompressors' many ways to fail
            self.damaged += whole
            return
        at = 0
        while at < len(data):
            if at + _RECORD.size > len(data):
                self.damaged += whole
                return
            opcode, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if opcode == 0 or at + length > len(data):
                self.damaged += whole
                return
            yield from self.records(opcode, data, at, length)
            at += length

    def records(self, opcode: int, data: bytes, at: int = 0, length: int | None = None) -> Iterator[Message]:
        """Yield the message of a record, if it is one of a wanted topic; register what else it says."""
        length = len(data) if length is None else length
        if opcode == MESSAGE and length >= _MESSAGE.size:
            number, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, at)
            body = data[at + _MESSAGE.size : at + length] if number in self.wanted else b""
            yield from self.message(number, log_ns, publish_ns, body)
        elif opcode == MESSAGE:
            self.damaged += 1
        elif opcode in (SCHEMA, CHANNEL, STATISTICS):
            kinds = {SCHEMA: "Schema", CHANNEL: "Channel", STATISTICS: "Statistics"}
            try:
                record = getattr(self.of_mcap, kinds[opcode]).read(self.stream(BytesIO(data[at : at + length])))
                self.define(record)
            except DatasetError:
                raise
            except Exception:  # the reader's many ways to fail
                self.damaged += 1

    def message(self, number: int, log_ns: int, publish_ns: int, data: bytes) -> Iterator[Message]:
        """Yield a message, if it is of a wanted topic."""
        channel = self.channels.get(number)
        if channel is None:
            self.damaged += 1
            return
        self.whole += 1
        if self.topics is None or channel.topic in self.topics:
            yield channel, (log_ns, publish_ns), data

    def define(self, record: Any) -> None:
        """Register a schema or a channel, or what the statistics count."""
        if isinstance(record, self.of_mcap.Schema):
            if record.id not in self.schemas:
                self.found.keep(len(record.data), self.path)
                self.schemas[record.id] = record
        elif isinstance(record, self.of_mcap.Statistics):
            for number, count in record.channel_message_counts.items():
                if number in self.channels:
                    self.found.count("the summary", self.channels[number].topic, count)
        elif record.id not in self.channels:
            channel = _channel(record, self.schemas.get(record.schema_id), self.types, self.path)
            self.channels[record.id] = channel
            if self.topics is not None and channel.topic in self.topics:
                self.wanted.add(record.id)
            self.found.add(channel, 0)


def _channel(record: Any, schema: Any, types: Types, path: Path) -> Channel:
    """Return the channel of a record, with the reader of its messages."""
    where = f"{path}: {record.topic}"
    kind = "" if schema is None else schema.name
    if record.message_encoding in ("cdr", "ros1"):

        @cache
        def known() -> Types:
            if schema is None or not schema.data:
                return types
            text = schema.data.decode(errors="replace")
            return Definitions(definitions_of(text, schema.encoding, kind, where), types)

        serialisation = "cdr" if record.message_encoding == "cdr" else "ros1"
        return ros_channel(record.topic, short_name(kind), known, serialisation, where)
    if record.message_encoding == "protobuf":
        return _protobuf_channel(record.topic, kind, schema, where)
    if record.message_encoding == "json":
        return Channel(record.topic, kind, tuple, lambda wanted: JsonExtractor(wanted, where))

    def refuse(*_: object) -> Any:
        raise DatasetError(f"{where}: messages encoded as {record.message_encoding!r} are not supported")

    return Channel(record.topic, kind, tuple, refuse)


# -------------------------------------------------------------------------------------------------- Protocol Buffers


def _protobuf_channel(topic: str, kind: str, schema: Any, where: str) -> Channel:
    @cache
    def decoder() -> Callable[[bytes], Any]:
        with extra("mcap"):
            from google.protobuf.descriptor_pb2 import FileDescriptorSet
            from mcap_protobuf.decoder import DecoderFactory
        try:
            if schema is not None:
                _refuse_many_types(FileDescriptorSet.FromString(schema.data))
            decode = DecoderFactory().decoder_for("protobuf", schema)
            if decode is None:
                raise ValueError(f"its schema is {None if schema is None else schema.encoding!r}")
            decode(b"")
        except Exception as error:  # a damaged schema: protobuf's many ways to fail
            what = one_line(error)[:200]
            raise DatasetError(f"{where}: the definition of {kind} cannot be understood: {what}") from None
        return decode

    def fields() -> tuple[str, ...]:
        return tuple(_protobuf_fields(decoder()(b"").DESCRIPTOR))

    return Channel(topic, kind, fields, lambda wanted: ProtobufExtractor(decoder(), wanted, where))


def _refuse_many_types(files: Any) -> None:
    found = [kind for file in files.file for kind in file.message_type]
    for kind in found:  # grows meanwhile
        found += kind.nested_type
        if len(found) > MOST_TYPES:
            raise ValueError(f"it has more than {MOST_TYPES} types")


def _protobuf_fields(descriptor: Any) -> Iterator[str]:
    """Yield the paths of a type's numeric fields, at most MOST_FIELDS; for a repeated field, that of its first element.

    A type may contain itself: it is listed once.
    """
    left = MOST_FIELDS

    def walk(descriptor: Any, prefix: str, above: tuple[str, ...]) -> Iterator[str]:
        nonlocal left
        if descriptor.full_name in above or len(above) > MOST_LEVELS:
            return
        for field in descriptor.fields:
            left -= 1
            if left < 0:
                return
            path = f"{prefix}{field.name}.0" if _repeated(field) else prefix + field.name
            if field.message_type is None:
                if _code(field) is not None:
                    yield path
            elif field.message_type.full_name in _TIMES:
                yield path
            elif not field.message_type.GetOptions().map_entry:
                yield from walk(field.message_type, f"{path}.", (*above, descriptor.full_name))

    yield from walk(descriptor, "", ())


def _repeated(field: Any) -> bool:
    return field.is_repeated if hasattr(field, "is_repeated") else field.label == field.LABEL_REPEATED


def _code(field: Any) -> str | None:
    """Return the struct code of a numeric field; None for another."""
    number = field.cpp_type
    floats, unsigned = (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT), (field.CPPTYPE_UINT64,)
    others = (field.CPPTYPE_STRING, field.CPPTYPE_MESSAGE)
    return "d" if number in floats else "Q" if number in unsigned else None if number in others else "q"


class ProtobufExtractor:
    """Extracts wanted numbers from messages of one type of Protocol Buffers; an `Extractor`.

    An absent float is NaN; a message without a wanted integer or time is malformed.
    """

    def __init__(self, decode: Callable[[bytes], Any], wanted: Sequence[str], where: str) -> None:
        """Compile the reader.

        Raises:
            DatasetError: a column that is not a numeric field of the type (with the nearest).
        """
        self._decode = decode
        descriptor = decode(b"").DESCRIPTOR
        self._wanted = tuple(wanted)
        self.codes: list[str] = []
        self._paths = []
        for column in wanted:
            steps, code = _protobuf_path(descriptor, column)
            if code is None:
                known = _protobuf_fields(descriptor)
                raise not_found(where, f"numeric field of {descriptor.full_name} called", column, known)
            self._paths.append((column, steps, code))
            self.codes.append("q" if code == "time" else code)

    def __call__(self, data: bytes) -> list[Any]:
        """Return the numbers, in the order of the columns."""
        try:
            message = self._decode(data)
        except Exception as error:  # protobuf's DecodeError, and what its versions raise besides
            raise MalformedMessage(one_line(error)) from None
        return [_protobuf_value(message, column, steps, code) for column, steps, code in self._paths]

    def columns(self, raw: Sequence[NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the columns by name."""
        return dict(zip(self._wanted, raw, strict=True))


Path_ = tuple[tuple[str, bool, int | None], ...]
"""Steps into a message: field, whether it may be absent, and the index if it is repeated."""


def _protobuf_path(descriptor: Any, column: str) -> tuple[Path_, str | None]:
    """Return the steps to a number and its code; None if there is no such number."""
    steps: list[tuple[str, bool, int | None]] = []
    names = column.split(".")
    while names:
        field = None if descriptor is None else descriptor.fields_by_name.get(names.pop(0))
        if field is None:
            return (), None
        index = None
        if _repeated(field):
            if not names or not (names[0].isascii() and names[0].isdecimal()):
                return (), None
            index = int(names.pop(0))
        steps.append((field.name, field.has_presence, index))
        descriptor = field.message_type
        if descriptor is None:
            return tuple(steps), None if names else _code(field)
        if descriptor.full_name in _TIMES and not names:
            return tuple(steps), "time"
        if descriptor.GetOptions().map_entry:
            return (), None
    return (), None


def _protobuf_value(message: Any, column: str, steps: Path_, code: str) -> Any:
    value = message
    for name, optional, index in steps:
        if optional and not value.HasField(name):
            if code == "d":
                return np.nan
            raise MalformedMessage(f"it has no {column!r}")
        value = getattr(value, name)
        if index is not None:
            if index >= len(value):
                raise ShortArray(column, len(value))
            value = value[index]
    return value.seconds * NS + value.nanos if code == "time" else value
