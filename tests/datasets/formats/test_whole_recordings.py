"""What a recording holds is read whole, or it is told what is missing: journals, split bags, counts, cuts."""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.bench.inspection.contents import print_contents
from fathom.datasets import DatasetError
from fathom.datasets.formats.mcap_file import McapRecording
from fathom.datasets.formats.recording import Messages, Wanted
from fathom.datasets.formats.ros_bag import RosRecording
from fathom.datasets.formats.topics import TopicRecording
from mcap.writer import CompressionType, Writer
from rich.console import Console
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_typestore

N = 40
"""Messages of each recording here: /a with n/10 in every one."""
NS = 1_000_000_000
DEFINITION = "MSG: p/A\nfloat64 x\n"


def read(folder: Path, kind: type[TopicRecording] = RosRecording, **options: Any) -> tuple[list[float], Messages]:
    format_ = "ros" if kind is RosRecording else "mcap"
    found = kind(format=format_, **options).read(folder, [Wanted("/a", None, ("x",))])
    return found.columns[0]["x"].tolist(), found


def tenths(*numbers: int) -> list[float]:
    return [n / 10 for n in range(*numbers)]


# ------------------------------------------------------------------------------------------------------------- SQLite


def database(path: Path, numbers: range = range(N), topic: str = "/a") -> Path:
    """A .db3 of plain CDR messages."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        connection.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
        connection.execute("INSERT INTO topics VALUES (1, ?, 'p/msg/A', 'cdr')", (topic,))
        insert(connection, numbers)
    connection.close()
    (path.parent / "A.msg").write_text(DEFINITION)
    return path


def insert(connection: sqlite3.Connection, numbers: range) -> None:
    rows = [(n * NS, b"\0\1\0\0" + struct.pack("<d", n / 10)) for n in numbers]
    connection.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", rows)


def metadata(folder: Path, files: list[str], counts: dict[str, int], **more: Any) -> None:
    topics = [{"topic_metadata": {"name": name, "type": "p/msg/A"}, "message_count": n} for name, n in counts.items()]
    about = {"relative_file_paths": files, "topics_with_message_count": topics, **more}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": about}))


def lose_power(source: Path, target: Path, numbers: range, journal: str = "WAL") -> Path:
    """A copy of the folder as it lies there while the recorder has written more, and not closed its database."""
    connection = sqlite3.connect(source, isolation_level=None)
    connection.execute(f"PRAGMA journal_mode = {journal}")
    connection.execute("PRAGMA wal_autocheckpoint = 0")
    connection.execute("PRAGMA cache_size = 1")
    connection.execute("BEGIN")
    insert(connection, numbers)
    if journal == "WAL":
        connection.execute("COMMIT")
    shutil.copytree(source.parent, target)
    connection.close()
    return target


@pytest.mark.parametrize("by", ["file", "folder"])
def test_what_is_in_the_write_ahead_log_is_read(tmp_path, by):
    database(tmp_path / "bag" / "x.db3", range(10))
    folder = lose_power(tmp_path / "bag" / "x.db3", tmp_path / "lost", range(10, N))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"x.db3-wal", "x.db3-shm"} <= before.keys()
    found, messages = read(folder, file="x.db3" if by == "file" else ".", definitions=("A.msg",))
    assert found == tenths(N)
    assert messages.notes == ("x.db3: the recorder did not finish; what is in x.db3-wal is read with it",)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before, (
        "nothing is written beside a recording"
    )


def test_a_database_that_is_all_in_its_write_ahead_log_is_read(tmp_path):
    (tmp_path / "bag").mkdir()
    connection = sqlite3.connect(tmp_path / "bag" / "x.db3")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    connection.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
    connection.execute("INSERT INTO topics VALUES (1, '/a', 'p/msg/A', 'cdr')")
    insert(connection, range(N))
    connection.commit()
    shutil.copytree(tmp_path / "bag", tmp_path / "lost")
    connection.close()
    (tmp_path / "lost" / "A.msg").write_text(DEFINITION)
    assert read(tmp_path / "lost", file="x.db3", definitions=("A.msg",))[0] == tenths(N)


def test_a_write_ahead_log_beside_the_target_of_a_link_is_read(tmp_path):
    database(tmp_path / "bag" / "x.db3", range(10))
    folder = lose_power(tmp_path / "bag" / "x.db3", tmp_path / "lost", range(10, N))
    (tmp_path / "linked.db3").symlink_to(folder / "x.db3")
    assert read(tmp_path, file="linked.db3", definitions=("lost/A.msg",))[0] == tenths(N)


def test_a_journal_that_is_a_link_is_not_followed(tmp_path):
    database(tmp_path / "x.db3")
    (tmp_path / "elsewhere").write_bytes(b"somebody's")
    (tmp_path / "x.db3-wal").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=r"x\.db3-wal: a link"):
        read(tmp_path, file="x.db3", definitions=("A.msg",))


def test_what_a_rollback_journal_takes_back_is_not_read(tmp_path):
    database(tmp_path / "bag" / "x.db3", range(N))
    folder = lose_power(tmp_path / "bag" / "x.db3", tmp_path / "lost", range(N, 3000), "DELETE")
    found, messages = read(folder, file="x.db3", definitions=("A.msg",))
    assert found == tenths(N)
    assert messages.notes == ("x.db3: the recorder did not finish; what is in x.db3-journal is read with it",)


def test_a_copy_that_has_no_room_says_what_to_do(tmp_path, monkeypatch):
    database(tmp_path / "bag" / "x.db3", range(10))
    folder = lose_power(tmp_path / "bag" / "x.db3", tmp_path / "lost", range(10, N))

    def full(source: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(DatasetError, match=r"x\.db3: cannot be copied to .*No space left on device; set TMPDIR"):
        read(folder, file="x.db3", definitions=("A.msg",))


def test_fewer_messages_than_metadata_counts_are_told(tmp_path):
    database(tmp_path / "x.db3")
    metadata(tmp_path, ["x.db3"], {"/a": N + 60, "/b": 7})
    for file in (".", "x.db3"):
        found, messages = read(tmp_path, file=file, definitions=("A.msg",))
        assert found == tenths(N)
        assert messages.notes == ("/a: 60 of the 100 messages that metadata.yaml counts are missing",)
    metadata(tmp_path, ["x.db3"], {"/a": N})
    assert read(tmp_path, file=".", definitions=("A.msg",))[1].notes == ()


def test_the_list_of_topics_says_what_is_missing(tmp_path):
    database(tmp_path / "x.db3")
    with sqlite3.connect(tmp_path / "x.db3") as connection:
        connection.execute("INSERT INTO topics VALUES (2, '/b', 'p/msg/A', 'cdr')")
    connection.close()
    metadata(tmp_path, ["x.db3"], {"/a": 100, "/b": 7})
    held = RosRecording(format="ros", file=".", definitions=("A.msg",)).contents(tmp_path)
    assert [(info.message, info.count, info.missing) for info in held] == [("/a", N, 60), ("/b", 0, 7)]
    console = Console(file=io.StringIO(), width=100)
    print_contents(held, console)
    assert "/a: 60 of the 100 messages that the recording counts are missing." in console.file.getvalue()
    with pytest.raises(DatasetError, match=r"no message of /b in the recording; metadata\.yaml counts 7"):
        RosRecording(format="ros", file=".", definitions=("A.msg",)).read(tmp_path, [Wanted("/b", None, ("x",))])


def test_a_split_bag_is_read_in_its_files(tmp_path):
    for part in range(12):  # 10 comes after 9, also without metadata.yaml
        database(tmp_path / f"x_{part}.db3", range(3 * part, 3 * part + 3))
    assert read(tmp_path, file=".", definitions=("A.msg",))[0] == tenths(36)
    metadata(tmp_path, [f"x_{part}.db3" for part in range(12)], {"/a": 36})
    found, messages = read(tmp_path, file=".", definitions=("A.msg",))
    assert (found, messages.notes) == (tenths(36), ())
    found, messages = read(tmp_path, file="x_1.db3", definitions=("A.msg",))
    assert messages.notes == ("x_1.db3: one of 12 files of a bag; name its folder to read all",)


def test_files_that_metadata_does_not_name_or_names_twice_are_told(tmp_path):
    (tmp_path / "x.bag").touch()
    for part in range(3):
        database(tmp_path / f"x_{part}.db3", range(3 * part, 3 * part + 3))
    metadata(tmp_path, ["x_0.db3", "x_2.db3"], {"/a": 6})
    found, messages = read(tmp_path, file=".", definitions=("A.msg",))
    assert len(found) == 6
    assert messages.notes[0].endswith(": not read, since metadata.yaml does not name them: x_1.db3")
    with pytest.raises(DatasetError, match="`more` names a file twice"):
        read(tmp_path, file="x.bag", more=("y.bag", "x.bag"))
    metadata(tmp_path, ["x_0.db3", "x_0.db3"], {"/a": 6})
    with pytest.raises(DatasetError, match="a file is named twice"):
        read(tmp_path, file=".", definitions=("A.msg",))


def test_a_file_that_lies_there_packed_and_unpacked_is_read_once(tmp_path):
    import zstandard

    database(tmp_path / "x.db3")
    (tmp_path / "x.db3.zstd").write_bytes(zstandard.compress((tmp_path / "x.db3").read_bytes()))
    found, messages = read(tmp_path, file=".", definitions=("A.msg",))
    assert found == tenths(N)
    assert messages.notes == ("x.db3.zstd: not read, since it lies there unpacked as well",)


def test_messages_of_no_topic_are_told(tmp_path):
    database(tmp_path / "x.db3")
    with sqlite3.connect(tmp_path / "x.db3") as connection:
        connection.execute("UPDATE messages SET topic_id = 9 WHERE id > 30")
    connection.close()
    found, messages = read(tmp_path, file="x.db3", definitions=("A.msg",))
    assert (len(found), messages.notes) == (30, ("x.db3: 10 messages of no topic that it names are left out",))


def test_a_compression_that_is_not_known_is_refused(tmp_path):
    database(tmp_path / "x.db3")
    metadata(tmp_path, ["x.db3"], {"/a": N}, compression_mode="MESSAGE", compression_format="lz4")
    with pytest.raises(DatasetError, match="compressed as 'lz4'; only zstd"):
        read(tmp_path, file=".", definitions=("A.msg",))


# -------------------------------------------------------------------------------------------------- MCAP and ROS 1 bags


def mcap(path: Path, compression: CompressionType, chunk_size: int = 1 << 20) -> bytearray:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=chunk_size)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for n in range(N):
            writer.add_message(channel, n, b'{"x": %.1f}' % (n / 10), n)
        writer.finish()
    return bytearray(path.read_bytes())


def test_fewer_messages_than_the_summary_of_a_file_counts_are_told(tmp_path):
    data = mcap(tmp_path / "x.mcap", CompressionType.NONE, 300)
    data[data.index(b'{"x": 1.0}') + 6] ^= 1  # its chunk no longer fits its checksum
    (tmp_path / "x.mcap").write_bytes(data)
    found, messages = read(tmp_path, McapRecording, file="x.mcap")
    lost = N - len(found)
    assert 0 < lost < 20
    assert f"/a: {lost} of the {N} messages that the summary counts are missing" in messages.notes


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_is_cut_off_is_read_to_the_cut(tmp_path, compression):
    rng = np.random.default_rng(1)
    with (tmp_path / "x.mcap").open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=1 << 22)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for n in range(4000):  # incompressible, so that the cut is in the middle of what is packed
            writer.add_message(channel, n, b'{"x": %.1f, "y": "%s"}' % (n / 10, rng.bytes(60).hex().encode()), n)
        writer.finish()
    data = (tmp_path / "x.mcap").read_bytes()
    (tmp_path / "x.mcap").write_bytes(data[: len(data) // 2])
    found, messages = read(tmp_path, McapRecording, file="x.mcap")
    assert 500 < len(found) < 3000
    assert found == tenths(len(found))
    assert "x.mcap: damaged, or cut off: nothing is read from there on" in messages.notes[0]


def bag(path: Path, compression: str | None) -> bytearray:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer1(path)
    if compression is not None:
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    kind, rng = "geometry_msgs/msg/PointStamped", np.random.default_rng(1)
    types = store.types
    with writer:
        connection = writer.add_connection("/a", kind, typestore=store)
        for n in range(10_000):
            header = types["std_msgs/msg/Header"](0, types["builtin_interfaces/msg/Time"](0, 0), rng.bytes(60).hex())
            point = types["geometry_msgs/msg/Point"](n / 10, 0.0, 0.0)
            writer.write(connection, n, store.serialize_ros1(types[kind](header, point), kind))
    return bytearray(path.read_bytes())


def read_bag(folder: Path) -> tuple[list[float], Messages]:
    found = RosRecording(format="ros", file="x.bag").read(folder, [Wanted("/a", None, ("point.x",))])
    return found.columns[0]["point.x"].tolist(), found


@pytest.mark.parametrize("compression", [None, "bz2", "lz4"])
def test_a_bag_that_is_cut_off_is_read_to_the_cut(tmp_path, compression):
    data = bag(tmp_path / "x.bag", compression)
    (tmp_path / "x.bag").write_bytes(data[: len(data) * 2 // 3])
    found, messages = read_bag(tmp_path)
    assert 4000 < len(found) < 8000
    assert found == tenths(len(found))
    assert "x.bag: cut off" in messages.notes[0]


def test_fewer_messages_than_the_index_of_a_bag_counts_are_told(tmp_path):
    data = bag(tmp_path / "x.bag", "bz2")
    data[data.index(b"BZh9") + 5000] ^= 0xFF
    (tmp_path / "x.bag").write_bytes(data)
    found, messages = read_bag(tmp_path)
    assert messages.notes[-1] == f"/a: {10_000 - len(found)} of the 10000 messages that the index counts are missing"
