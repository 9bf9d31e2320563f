"""ROS 1 bags (.bag) and ROS 2 bags (a folder, .db3 or .mcap), without ROS.

ROS 1 bags are read from front to back, without their index: it is at the end, and missing if the recorder lost its
power. ROS 2 bags in SQLite seldom contain the definitions of their messages. Those of ROS itself come with `rosbags`,
by distribution, and those of common DVLs with this package.
"""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache, partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import IO, Any

import yaml

from ..errors import DatasetError, nearest, nearest_file
from ..files import inside
from .mcap_file import mcap_messages
from .recording import extra
from .ros_messages import Definition, Definitions, Types, definitions_of, parse_definitions, ros_channel, short_name
from .topics import NS, Channel, Message, ScanResult, TopicRecording

MAGIC_1 = b"#ROSBAG V2.0\n"
MESSAGE_DATA, CHUNK, CONNECTION = 2, 5, 7
"""Values of `op`, the kind of a record of a ROS 1 bag."""
DISTRO = "humble"
"""The ROS 2 distribution whose definitions are used if a bag does not name one."""
_U32 = struct.Struct("<I")


class RosRecording(TopicRecording):
    """A ROS bag, version 1 or 2. Messages are topics; `log_time` is when each was recorded."""

    host_clock = ("log_time", "ns")
    suffixes = (".bag", ".bag.active", ".db3")

    more: tuple[str, ...] = ()
    """Further files of a split ROS 1 bag, in their order; the folder of a ROS 2 bag names its own."""
    distro: str | None = None
    """ROS 2 distribution whose definitions are used for a bag without its own; by default the bag's, else humble."""
    definitions: tuple[str, ...] = ()
    """Files of further definitions: `…/package/msg/Name.msg`, or many in one, under lines `MSG: package/Name`."""

    def messages(self, folder: Path, topics: Collection[str] | None, found: ScanResult) -> Iterator[Message]:
        """Yield the messages of a bag; see `TopicRecording.messages`."""
        path = self.path(folder)
        if path.name == "metadata.yaml":
            path = path.parent
        if path.is_dir() or path.suffix in (".db3", ".mcap", ".zstd"):
            if self.more:
                raise DatasetError(f"{path}: `more` is for split ROS 1 bags; give a ROS 2 bag's folder instead")
            types = Definitions(own_definitions(folder, self.definitions), shipped_definitions())
            yield from _ros2_messages(path, types, self.distro, topics, found)
            return
        for name in (self.file, *self.more):
            part = self.model_copy(update={"file": name}).path(folder)
            yield from ros1_messages(part, topics, found)


def own_definitions(folder: Path, files: Sequence[str]) -> dict[str, Definition]:
    """Return the definitions in the user's files."""
    types: dict[str, Definition] = {}
    for file in files:
        path = inside(folder, file)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path}: cannot be read: {error}") from None
        packages = [part for part in path.resolve().parts[:-1] if part != "msg"]
        read = parse_definitions(text, f"{packages[-1]}/{path.stem}", str(path))
        types |= {kind: fields for kind, fields in read.items() if fields or "MSG:" not in text}
    return types


@cache
def shipped_definitions() -> dict[str, Definition]:
    """Return the definitions of common DVLs, which are not part of ROS."""
    path = Path(__file__).parent / "ros_definitions" / "dvl.msg"
    return parse_definitions(path.read_text(encoding="utf-8"), "", str(path))


class _Distribution(dict[str, Definition]):
    """Definitions of a ROS 2 distribution, looked up on demand."""

    def __init__(self, asked: str | None, recorded: str, where: str) -> None:
        """`asked` is the user's distribution; without one, that of the recording is used, if known."""
        super().__init__()
        self._asked, self._recorded, self._where = asked, recorded, where

    def __missing__(self, kind: str) -> Definition:
        store = self._store()
        name = kind.replace("/", "/msg/")
        if name not in store.fielddefs:
            raise KeyError(kind)
        text, _ = store.generate_msgdef(name, ros_version=2)
        self.update(parse_definitions(text, kind, self._where))
        return self[kind]

    def _store(self) -> Any:
        with extra("ros"):
            from rosbags.typesys import Stores, get_typestore
        known = {store.value.removeprefix("ros2_"): store for store in Stores if store.value.startswith("ros2_")}
        distro = self._asked or (self._recorded if self._recorded in known else DISTRO)
        if distro not in known:
            hint = nearest(distro, known)
            raise DatasetError(f"{self._where}: no ROS 2 distribution {distro!r}{hint} (known: {', '.join(known)})")
        return get_typestore(known[distro])


# ------------------------------------------------------------------------------------------------------------- ROS 1


def ros1_messages(path: Path, topics: Collection[str] | None, found: ScanResult) -> Iterator[Message]:
    """Yield the messages of a ROS 1 bag; damaged parts are skipped and counted in `found.notes`.

    Raises:
        DatasetError: not a ROS 1 bag of version 2.0, or contains no whole message.
    """
    size = path.stat().st_size
    bag = _Bag(path, topics, found)
    with _opened(path) as stream:
        magic = stream.read(len(MAGIC_1))
        if magic != MAGIC_1:
            what = "an empty file" if not magic else f"it begins with {magic!r}"
            raise DatasetError(f"{path}: not a ROS 1 bag of version 2.0, nor the folder of a ROS 2 bag: {what}")
        at = len(MAGIC_1)
        while at < size:
            try:
                head, length = _record_head(stream, size)
            except (struct.error, ValueError):
                found.notes.append(f"{path.name}: damaged, or cut off, at byte {at}: nothing is read from there on")
                break
            start = stream.tell()
            op = head.get(b"op", b"\0")[:1]
            if op == bytes([CHUNK]):
                yield from bag.chunk(head, stream.read(length), whole=start + length <= size)
            elif op in (bytes([CONNECTION]), bytes([MESSAGE_DATA])):
                yield from bag.outside(head, stream.read(length))
            elif head.get(b"index_pos") == bytes(8):
                found.notes.append(f"{path.name}: the recorder did not finish (no index)")
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


class _Bag:
    """The connections of a ROS 1 bag, while its records are read."""

    def __init__(self, path: Path, topics: Collection[str] | None, found: ScanResult) -> None:
        self.path, self.topics, self.found = path, topics, found
        self.connections: dict[bytes, Channel] = {}
        self.whole = self.damaged = 0

    def record(self, head: Mapping[bytes, bytes], data: bytes, start: int, end: int) -> Message | None:
        """Return the message of a record, if it is one, of a wanted topic.

        Raises:
            struct.error, KeyError, ValueError: damaged.
        """
        op = head[b"op"]
        if op == bytes([CONNECTION]) and head[b"conn"] not in self.connections:
            self.connections[head[b"conn"]] = channel = self._connection(head, data[start:end])
            self.found.channels.append(channel)
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
            message = self.record(head, data, 0, len(data))
        except (struct.error, KeyError, ValueError):
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
            data = _decompressed(head.get(b"compression", b"none"), data)
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
                    raise ValueError("beyond the chunk")
                fields = _header(data, at + 4, start - 4)
                message = self.record(fields, data, start, start + size)
            except (struct.error, KeyError, ValueError):
                self.damaged += whole
                return
            if message is not None:
                yield message
            at = start + size


def _record_head(stream: IO[bytes], size: int) -> tuple[dict[bytes, bytes], int]:
    """Return the header of the next record, and how many bytes of data follow.

    Raises:
        struct.error, ValueError: damaged, or the end of the file.
    """
    (length,) = _U32.unpack(stream.read(4))
    if stream.tell() + length > size:
        raise ValueError("beyond the file")
    header = _header(stream.read(length))
    return header, _U32.unpack(stream.read(4))[0]


def _header(data: bytes, at: int = 0, end: int | None = None) -> dict[bytes, bytes]:
    """Return the fields `name=value` of a header, each with its length before it."""
    fields = {}
    end = len(data) if end is None else end
    while at < end:
        (length,) = _U32.unpack_from(data, at)
        at += 4
        if at + length > end:
            raise ValueError("beyond the header")
        name, sign, value = data[at : at + length].partition(b"=")
        if not sign:
            raise ValueError("no name")
        fields[name] = value
        at += length
    return fields


def _decompressed(compression: bytes, data: bytes) -> bytes:
    if compression == b"bz2":
        return bz2.decompress(data)
    if compression == b"lz4":
        with extra("ros"):
            import lz4.frame
        return lz4.frame.decompress(data)
    if compression != b"none":
        raise ValueError(f"unknown compression {compression!r}")
    return data


# ------------------------------------------------------------------------------------------------------------- ROS 2


def _ros2_messages(
    path: Path, types: Types, distro: str | None, topics: Collection[str] | None, found: ScanResult
) -> Iterator[Message]:
    for part in path.iterdir() if path.is_dir() else ():
        inside(path, part.name, or_folder=True)
    about = _metadata(path) if path.is_dir() else {}
    files = _files(path, about) if path.is_dir() else [path]
    known = Definitions(types, _Distribution(distro, str(about.get("ros_distro")), str(path)))
    compressed = str(about.get("compression_mode")).upper() == "MESSAGE"
    yielded = False
    problems = []
    for file in files:
        with _uncompressed(file) as plain:
            read = _sqlite_messages if plain.suffix == ".db3" else _mcap_messages
            try:
                for channel, stamps, data in read(plain, file, known, topics, found):
                    yielded = True
                    yield channel, stamps, _zstd(data) if compressed and topics is not None else data
            except DatasetError as error:  # a note where there are other messages, of this file or another
                problems.append(str(error))
    if problems and not yielded:
        raise DatasetError("; ".join(problems))
    found.notes += problems


def _metadata(path: Path) -> dict[str, Any]:
    """Return the contents of metadata.yaml; empty if the recorder did not finish and write it."""
    file = path / "metadata.yaml"
    if not file.is_file():
        return {}
    try:
        about = yaml.safe_load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        return {str(key): value for key, value in about.items()}
    except Exception as error:  # YAML's and our own: it is not what it should be
        raise DatasetError(f"{file}: not the metadata of a ROS 2 bag: {' '.join(str(error).split())[:200]}") from None


def _files(path: Path, about: Mapping[str, Any]) -> list[Path]:
    """Return the files of a bag, in their order."""
    named = about.get("relative_file_paths")
    if named is None:
        held = sorted(p for p in path.iterdir() if p.suffix in (".db3", ".mcap", ".zstd"))
        if not held:
            raise DatasetError(f"{path}: not a ROS 2 bag: it holds no metadata.yaml, .db3 or .mcap")
        return sorted(held, key=lambda p: (len(p.name), p.name))
    if not isinstance(named, list) or not all(isinstance(name, str) for name in named):
        raise DatasetError(f"{path / 'metadata.yaml'}: `relative_file_paths`: expected a list of names")
    files = [path / PurePosixPath(name).name for name in named]
    for file in files:
        if not file.is_file():
            hint = nearest_file(file, folders=True)
            raise DatasetError(f"{file}: no such file, but metadata.yaml names it{hint}")
    return files


@contextmanager
def _uncompressed(file: Path) -> Iterator[Path]:
    """Yield the file, or what a `.zstd` holds, in a temporary one."""
    if file.suffix != ".zstd":
        yield file
        return
    with extra("ros"):
        import zstandard
    with TemporaryDirectory() as folder:
        plain = Path(folder) / file.stem
        try:
            with file.open("rb") as source, plain.open("wb") as target:
                zstandard.ZstdDecompressor().copy_stream(source, target)
        except (OSError, zstandard.ZstdError) as error:
            raise DatasetError(f"{file}: cannot be decompressed: {error}") from None
        yield plain


def _zstd(data: bytes) -> bytes:
    """Return a message decompressed; a damaged one is empty, which does not fit its type."""
    with extra("ros"):
        import zstandard
    try:
        return zstandard.ZstdDecompressor().decompress(data)
    except (zstandard.ZstdError, MemoryError):
        return b""


def _sqlite_messages(
    plain: Path, path: Path, types: Types, topics: Collection[str] | None, found: ScanResult
) -> Iterator[Message]:
    """Yield the messages of a SQLite database; `path` is its name in errors, `plain` the uncompressed file."""
    row = before = 0
    try:
        with closing(sqlite3.connect(f"{plain.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            database.text_factory = lambda text: text.decode(errors="replace")
            channels = _sqlite_channels(database, path, types)
            found.channels += channels.values()
            chosen = [i for i, channel in channels.items() if topics is None or channel.topic in topics]
            data = "data" if topics is not None else "x''"
            some = ",".join(map(str, chosen))
            rows = database.execute(
                f"SELECT id, topic_id, timestamp, {data} FROM messages WHERE topic_id IN ({some}) ORDER BY id"
            )
            for row, topic, t_ns, data in rows:
                if row <= before or not isinstance(t_ns, int) or t_ns < 0 or not isinstance(data, bytes):
                    raise ValueError("rows are out of order, or not what they should be")
                before = row
                yield channels[topic], (t_ns,), data
    except (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError) as error:
        if isinstance(error, DatasetError):
            raise
        how = f"nothing is read after row {before}" if before else "cannot be read"
        raise DatasetError(f"{path}: {how}: {error}") from None


def _sqlite_channels(database: sqlite3.Connection, path: Path, types: Types) -> dict[int, Channel]:
    """Return the channels by their number."""
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not {"topics", "messages"} <= tables:
        raise DatasetError(f"{path}: not a ROS 2 bag: no tables `topics` and `messages` in it")
    carried = {}
    if "message_definitions" in tables:
        rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        carried = {short_name(str(kind)): (str(encoding), str(text)) for kind, encoding, text in rows if text}
    channels = {}
    for number, topic, kind, written in database.execute("SELECT id, name, type, serialization_format FROM topics"):
        if written != "cdr":
            raise DatasetError(f"{path}: {topic}: serialised as {written!r}; only CDR is supported")
        channels[int(number)] = _cdr_channel(str(topic), str(kind), carried.get(short_name(str(kind))), types, path)
    return channels


def _cdr_channel(topic: str, kind: str, carried: tuple[str, str] | None, types: Types, path: Path) -> Channel:
    where = f"{path}: {topic}"

    @cache
    def known() -> Types:
        if carried is None or carried[0] not in ("ros2msg", "ros2idl"):
            return types
        return Definitions(definitions_of(carried[1], carried[0], kind, where), types)

    return ros_channel(topic, short_name(kind), known, "cdr", where)


def _mcap_messages(
    plain: Path, path: Path, types: Types, topics: Collection[str] | None, found: ScanResult
) -> Iterator[Message]:
    for channel, (log_ns, _), data in mcap_messages(plain, types, topics, found, path):
        yield channel, (log_ns,), data


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
