"""ROS 1 bags (.bag), read from front to back.

Their index is at the end, and missing if the recorder lost its power; so it is only used to count what should be there.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import IO

from ..errors import DatasetError
from .ros_messages import definitions_of, ros_channel, short_name
from .topics import NS, Channel, Message, ScanResult
from .unpacking import Unpacking

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE_DATA, INDEX_DATA, CHUNK, CONNECTION = 2, 4, 5, 7
"""Values of `op`, the kind of a record."""
LONGEST_HEADER = 4 << 20
"""Bytes; the largest holds the definition of a message, some 10 kB."""
_U32 = struct.Struct("<I")


class _DamageError(Exception):
    """A record is not what it should be; reading goes on."""


DAMAGED = (_DamageError, struct.error, KeyError, UnicodeDecodeError)


def ros1_messages(path: Path, topics: Collection[str] | None, found: ScanResult) -> Iterator[Message]:
    """Yield the messages of a ROS 1 bag; damaged parts are skipped and counted in `found.notes`.

    Raises:
        DatasetError: not a ROS 1 bag of version 2.0, or contains no whole message.
    """
    size = path.stat().st_size
    bag = _Bag(path, topics, found)
    with _opened(path) as stream:
        magic = stream.read(len(MAGIC))
        if magic != MAGIC:
            what = "an empty file" if not magic else f"it begins with {magic!r}"
            raise DatasetError(f"{path}: not a ROS 1 bag of version 2.0, nor the folder of a ROS 2 bag: {what}")
        at = len(MAGIC)
        while at < size:
            try:
                head, length = _record_head(stream, size)
            except DAMAGED:
                found.notes.append(f"{path.name}: damaged, or cut off, at byte {at}: nothing is read from there on")
                break
            start = stream.tell()
            yield from bag.record(head, stream, min(length, size - start), whole=start + length <= size)
            if start + length > size:
                found.notes.append(f"{path.name}: cut off {start + length - size} bytes before a record's end")
                break
            at = start + length
            stream.seek(at)
    if not bag.whole:
        raise DatasetError(f"{path}: contains no whole message{'; ' if found.notes else ''}{'; '.join(found.notes)}")
    if bag.damaged:
        found.notes.append(
            f"{path.name}: {bag.damaged} damaged chunks or records; what cannot be read of them is skipped"
        )
    for number, count in bag.indexed.items():
        if number in bag.connections:
            found.count("the index", bag.connections[number].topic, count)


class _Bag:
    """The connections of a ROS 1 bag, while its records are read."""

    def __init__(self, path: Path, topics: Collection[str] | None, found: ScanResult) -> None:
        self.path, self.topics, self.found = path, topics, found
        self.connections: dict[bytes, Channel] = {}
        self.indexed: Counter[bytes] = Counter()
        """Messages by connection, as the index after each chunk counts them."""
        self.whole = self.damaged = 0
        self.unpacking = Unpacking(str(path), path.stat().st_size)

    def record(self, head: Mapping[bytes, bytes], stream: IO[bytes], length: int, *, whole: bool) -> Iterator[Message]:
        """Yield the wanted messages of a record of the file, of which `length` bytes are there."""
        op = head[b"op"][:1]
        if op == bytes([CHUNK]):
            yield from self.chunk(head, stream.read(length), whole=whole)
        elif op in (bytes([CONNECTION]), bytes([MESSAGE_DATA])):
            yield from self.outside(head, stream.read(length))
        elif op == bytes([INDEX_DATA]) and len(head.get(b"count", b"")) == 4:
            (count,) = _U32.unpack(head[b"count"])
            self.indexed[head.get(b"conn", b"")] += min(count, length // 12)  # 12 bytes for each message
        elif head.get(b"index_pos") == bytes(8):
            self.found.notes.append(f"{self.path.name}: the recorder did not finish (no index)")
        elif len(head.get(b"index_pos", b"")) == 8 and not self.connections:
            self._read_connections(stream, int.from_bytes(head[b"index_pos"], "little"))

    def _read_connections(self, stream: IO[bytes], at: int) -> None:
        """Read the connections at the end, where the index has all; those in chunks may be damaged."""
        size = self.path.stat().st_size
        try:
            while at < size:
                stream.seek(at)
                head, length = _record_head(stream, size)
                at = stream.tell() + length
                if head[b"op"] != bytes([CONNECTION]) or at > size:
                    break
                self.inner(head, stream.read(length), 0, length)
        except DAMAGED:  # as well
            return

    def inner(self, head: Mapping[bytes, bytes], data: bytes, start: int, end: int) -> Message | None:
        """Return the message of a record, if it is one, of a wanted topic.

        Raises:
            DAMAGED: damaged.
        """
        op = head[b"op"]
        if op == bytes([CONNECTION]) and head[b"conn"] not in self.connections:
            self.connections[head[b"conn"]] = channel = self._connection(head, data[start:end])
            self.found.add(channel, end - start)
        if op != bytes([MESSAGE_DATA]):
            return None
        channel = self.connections[head[b"conn"]]
        self.whole += 1
        if self.topics is not None and channel.topic not in self.topics:
            return None
        seconds, nanoseconds = struct.unpack("<II", head[b"time"])
        return channel, (seconds * NS + nanoseconds,), data[start:end]

    def outside(self, head: Mapping[bytes, bytes], data: bytes) -> Iterator[Message]:
        """Yield the message of a record outside of a chunk, if it is one, of a wanted topic."""
        try:
            message = self.inner(head, data, 0, len(data))
        except DAMAGED:
            self.damaged += 1
            return
        if message is not None:
            yield message

    def _connection(self, head: Mapping[bytes, bytes], data: bytes) -> Channel:
        about = _header(data)
        topic, kind = head[b"topic"].decode(), about[b"type"].decode()
        text = about[b"message_definition"].decode(errors="replace")
        where = f"{self.path}: {topic}"
        types = cache(partial(definitions_of, text, "ros1msg", kind, where))
        return ros_channel(topic, short_name(kind), types, "ros1", where)

    def chunk(self, head: Mapping[bytes, bytes], data: bytes, *, whole: bool) -> Iterator[Message]:
        """Yield the wanted messages of a chunk, up to where it is damaged."""
        try:
            data = self.unpacking.unpacked(head.get(b"compression", b"none").decode(), data, whole=whole)
        except DatasetError:
            raise
        except Exception:  # the decompressors' many ways to fail
            self.damaged += 1
            return
        at = 0
        while at < len(data):
            try:
                (length,) = _U32.unpack_from(data, at)
                start = at + 4 + length
                (size,) = _U32.unpack_from(data, start)
                start += 4
                if start + size > len(data):
                    raise _DamageError("beyond the chunk")
                fields = _header(data, at + 4, start - 4)
                message = self.inner(fields, data, start, start + size)
            except DAMAGED:
                self.damaged += whole
                return
            if message is not None:
                yield message
            at = start + size


def _record_head(stream: IO[bytes], size: int) -> tuple[dict[bytes, bytes], int]:
    """Return the header of the next record, and how many bytes of data follow.

    Raises:
        DAMAGED: damaged, or the end of the file.
    """
    (length,) = _U32.unpack(stream.read(4))
    if stream.tell() + length > size or length > LONGEST_HEADER:
        raise _DamageError("beyond the file")
    header = _header(stream.read(length))
    if not header[b"op"]:
        raise _DamageError("no kind")
    return header, _U32.unpack(stream.read(4))[0]


def _header(data: bytes, at: int = 0, end: int | None = None) -> dict[bytes, bytes]:
    """Return the fields `name=value` of a header, each with its length before it."""
    fields = {}
    end = len(data) if end is None else end
    if end - at > LONGEST_HEADER:
        raise _DamageError("too long for a header")
    while at < end:
        (length,) = _U32.unpack_from(data, at)
        at += 4
        if at + length > end:
            raise _DamageError("beyond the header")
        name, sign, value = data[at : at + length].partition(b"=")
        if not sign:
            raise _DamageError("no name")
        fields[name] = value
        at += length
    return fields


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
