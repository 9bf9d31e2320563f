"""ROS 1 bags (.bag, `ros1_bag`) and ROS 2 bags (a folder, .db3 or .mcap), without ROS.

ROS 2 bags in SQLite (`ros2_database`) seldom contain the definitions of their messages. Those of ROS itself come with
`rosbags`, by distribution, and those of common DVLs with this package.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from ..errors import DatasetError, nearest, nearest_file, one_line
from ..files import inside, regular_file
from .mcap_file import mcap_messages
from .recording import extra
from .ros1_bag import ros1_messages
from .ros2_database import sqlite_messages
from .ros_messages import MOST_DEFINITION, Definition, Definitions, Types, parse_definitions
from .topics import Message, ScanResult, TopicRecording
from .unpacking import Unpacking
from .yaml_file import read_yaml

DISTRO = "humble"
"""The ROS 2 distribution whose definitions are used if a bag does not name one."""
SUFFIXES = (".db3", ".mcap", ".zstd")
"""Of the files of a ROS 2 bag; .zstd comes after another."""


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
        if path.is_dir() or path.suffix in SUFFIXES:
            if self.more:
                raise DatasetError(f"{path}: `more` is for split ROS 1 bags; give a ROS 2 bag's folder instead")
            types = Definitions(own_definitions(folder, self.definitions), shipped_definitions())
            yield from _ros2_messages(path, types, self.distro, topics, found)
            return
        names = (self.file, *self.more)
        if len(set(names)) < len(names):
            raise DatasetError(f"{path}: `more` names a file twice")
        for name in names:
            part = self.model_copy(update={"file": name}).path(folder)
            yield from ros1_messages(part, topics, found)


def own_definitions(folder: Path, files: Sequence[str]) -> dict[str, Definition]:
    """Return the definitions in the user's files."""
    types: dict[str, Definition] = {}
    for file in files:
        path = inside(folder, file)
        if path.stat().st_size > MOST_DEFINITION:
            raise DatasetError(f"{path}: larger than {MOST_DEFINITION} bytes; that is no definition of messages")
        try:
            text = path.read_text(encoding="utf-8-sig")
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


# ------------------------------------------------------------------------------------------------------------- ROS 2


def _ros2_messages(
    path: Path, types: Types, distro: str | None, topics: Collection[str] | None, found: ScanResult
) -> Iterator[Message]:
    for part in path.iterdir() if path.is_dir() else ():
        inside(path, part.name, or_folder=True)
    about = _metadata(path) if path.is_dir() else _metadata_beside(path, found)
    files = _files(path, about, found) if path.is_dir() else [path]
    known = Definitions(types, _Distribution(distro, str(about.get("ros_distro")), str(path)))
    compressed = str(about.get("compression_mode")).upper() == "MESSAGE"
    if compressed and str(about.get("compression_format")) != "zstd":
        raise DatasetError(f"{path}: compressed as {about.get('compression_format')!r:.60}; only zstd is supported")
    for topic, count in _counted(about):
        found.count("metadata.yaml", topic, count)
    yielded = False
    problems = []
    for file in files:
        unpacking = Unpacking(str(file), file.stat().st_size)
        with _uncompressed(file, unpacking) as plain:
            read = sqlite_messages if plain.suffix == ".db3" else _mcap_messages
            try:
                for channel, stamps, data in read(plain, file, known, topics, found):
                    yielded = True
                    packed = compressed and topics is not None
                    yield channel, stamps, _unpacked(unpacking, data) if packed else data
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
    content = read_yaml(file)
    about = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(about, dict):
        raise DatasetError(f"{file}: not the metadata of a ROS 2 bag: no `rosbag2_bagfile_information`")
    return {str(key): value for key, value in about.items()}


def _metadata_beside(file: Path, found: ScanResult) -> dict[str, Any]:
    """Return the metadata of a bag that is this one file; empty if there is none, or the bag has other files too."""
    try:
        about = _metadata(file.parent)
    except DatasetError:  # of something else: the file is asked for without its folder
        return {}
    named = about.get("relative_file_paths")
    names = [PurePosixPath(name).name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    if file.name not in names:
        return {}
    if len(names) > 1:
        found.notes.append(f"{file.name}: one of {len(names)} files of a bag; name its folder to read all")
        about.pop("topics_with_message_count", None)
    return about


def _counted(about: Mapping[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield the topics of metadata.yaml and their numbers of messages."""
    every = about.get("topics_with_message_count")
    for each in every if isinstance(every, list) else ():
        topic = each.get("topic_metadata") if isinstance(each, dict) else None
        if isinstance(topic, dict) and type(each.get("message_count")) is int:
            yield str(topic.get("name")), each["message_count"]


def _files(path: Path, about: Mapping[str, Any], found: ScanResult) -> list[Path]:
    """Return the files of a bag, in their order."""
    held = sorted((p for p in path.iterdir() if p.suffix in SUFFIXES), key=lambda p: (len(p.name), p.name))
    twice = {p.name for p in held if p.suffix == ".zstd" and p.with_suffix("") in held}
    named = about.get("relative_file_paths")
    if named is None:
        if not held:
            raise DatasetError(f"{path}: not a ROS 2 bag: it holds no metadata.yaml, .db3 or .mcap")
        found.notes += [f"{name}: not read, since it lies there unpacked as well" for name in sorted(twice)]
        return [regular_file(p) for p in held if p.name not in twice]
    where = path / "metadata.yaml"
    if not isinstance(named, list) or not all(isinstance(name, str) for name in named):
        raise DatasetError(f"{where}: `relative_file_paths`: expected a list of names")
    names = [PurePosixPath(name).name for name in named]
    if len(set(names)) < len(names):
        raise DatasetError(f"{where}: `relative_file_paths`: a file is named twice")
    for file in (path / name for name in names):
        if not file.is_file():
            hint = nearest_file(file, folders=True)
            raise DatasetError(f"{file}: no such file, but metadata.yaml names it{hint}")
    others = [p.name for p in held if p.name not in (*names, *twice) and f"{p.name}.zstd" not in names]
    if others:
        found.notes.append(f"{path.name}: not read, since metadata.yaml does not name them: {', '.join(others[:9])}")
    return [path / name for name in names]


@contextmanager
def _uncompressed(file: Path, unpacking: Unpacking) -> Iterator[Path]:
    """Yield the file, or what a `.zstd` holds, in a temporary one."""
    if file.suffix != ".zstd":
        yield file
        return
    with TemporaryDirectory(prefix="fathom-") as folder:
        plain = Path(folder) / file.stem
        try:
            with file.open("rb") as source, plain.open("wb") as target:
                for piece in unpacking.pieces("zstd", source, file.stat().st_size):
                    target.write(piece)
        except DatasetError:
            raise
        except Exception as error:  # zstandard's, and those of files
            raise DatasetError(f"{file}: cannot be decompressed: {one_line(error)}") from None
        yield plain


def _unpacked(unpacking: Unpacking, data: bytes) -> bytes:
    """Return a message unpacked; a damaged one is empty, which does not fit its type."""
    try:
        return unpacking.unpacked("zstd", data)
    except DatasetError:
        raise
    except Exception:  # zstandard's, and its memory's
        return b""


def _mcap_messages(
    plain: Path, path: Path, types: Types, topics: Collection[str] | None, found: ScanResult
) -> Iterator[Message]:
    for channel, (log_ns, _), data in mcap_messages(plain, types, topics, found, path):
        yield channel, (log_ns,), data
