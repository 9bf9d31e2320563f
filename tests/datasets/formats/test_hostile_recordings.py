"""Files that want to hurt: every reader keeps to some megabytes and seconds, and says what is wrong."""

from __future__ import annotations

import bz2
import gzip
import json
import sqlite3
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from fathom.datasets import DatasetError
from fathom.datasets.formats import ros2_database, topics, unpacking
from fathom.datasets.formats.ardupilot import ArduPilotRecording
from fathom.datasets.formats.imc import ImcRecording, parse_definitions
from fathom.datasets.formats.mcap_file import McapRecording
from fathom.datasets.formats.recording import Recording, Wanted
from fathom.datasets.formats.ros_bag import RosRecording
from fathom.datasets.formats.ros_messages import RosExtractor, definitions_of, numeric_fields
from fathom.datasets.formats.ros_messages import parse_definitions as parse_messages
from google.protobuf import descriptor_pb2
from limited import limited
from mcap.writer import Writer
from written_imc import message as imc_message

ZEROS = bytes(100 << 20)
MEGABYTES = 80
"""Of address space: less than what is claimed or would be unpacked."""
PACK: dict[str, Callable[[], bytes]] = {
    "bz2": lambda: bz2.compress(ZEROS[: 10 << 20]) * 10,
    "lz4": lambda: lz4.frame.compress(ZEROS),
    "zstd": lambda: zstandard.compress(ZEROS),
}


@pytest.fixture(autouse=True)
def little_to_spare(monkeypatch):
    """1 MiB in place of 64, so that bombs can be small."""
    monkeypatch.setattr(unpacking, "SPARE_BYTES", 1 << 20)


def refused(recording: Recording, folder: Path, says: str, column: str = "x") -> None:
    """Reading and listing end in time, and reading says why."""
    with pytest.raises(DatasetError, match=says):
        limited(lambda: recording.read(folder, [Wanted("/a", None, (column,))]), MEGABYTES)
    listed(recording, folder)


def listed(recording: Recording, folder: Path) -> list[Any]:
    def contents() -> list[Any]:
        try:
            return recording.contents(folder)
        except DatasetError:
            return []

    return limited(contents, MEGABYTES)


# ----------------------------------------------------------------------------------------------------------- ROS 1 bags


def record(data: bytes, length: int | None = None, **fields: bytes) -> bytes:
    head = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items()
    )
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data) if length is None else length) + data


def connection(definition: str, number: int = 0, topic: bytes = b"/a") -> bytes:
    about = record(b"", type=b"p/A", message_definition=definition.encode())
    size = struct.unpack_from("<I", about)[0]
    return record(about[4 : 4 + size], op=b"\7", conn=struct.pack("<I", number), topic=topic)


def bag(path: Path, *records: bytes) -> RosRecording:
    path.write_bytes(b"#ROSBAG V2.0\n" + b"".join(records))
    return RosRecording(format="ros", file=path.name)


SENT = record(struct.pack("<d", 1.0), op=b"\2", conn=bytes(4), time=bytes(8))


@pytest.mark.parametrize("compression", PACK)
def test_a_chunk_of_a_bag_that_unpacks_to_much_is_refused(tmp_path, compression):
    chunk = record(PACK[compression](), op=b"\5", compression=compression.encode())
    refused(bag(tmp_path / "x.bag", connection("float64 x"), SENT, chunk), tmp_path, "unpack to more than 100 times")


def test_many_small_bombs_are_one_large_one(tmp_path):
    chunk = record(bz2.compress(ZEROS[: 1 << 20]), op=b"\5", compression=b"bz2")
    refused(bag(tmp_path / "x.bag", connection("float64 x"), SENT, *[chunk] * 100), tmp_path, "unpack to more than")


@pytest.mark.parametrize("op", [b"\2", b"\5", b"\7", b"\4", b"\0"])
def test_a_length_that_a_record_of_a_bag_only_claims_costs_nothing(tmp_path, op):
    huge = record(b"x", 2**32 - 1, op=op, conn=bytes(4), time=bytes(8), compression=b"none", count=b"\xff" * 4)
    recording = bag(tmp_path / "x.bag", connection("float64 x"), SENT, huge)
    found = limited(lambda: recording.read(tmp_path, [Wanted("/a", None, ("x",))]), MEGABYTES)
    assert found.columns[0]["x"].tolist() == [1.0]
    assert "cut off 4294967294 bytes before a record's end" in found.notes[0]


@pytest.mark.parametrize("name", ["x.bag", "x.mcap", "x.db3", "x.lsf", "x.bin", "x.db3.zstd"])
def test_zeros_are_no_records(tmp_path, name):
    magic = {"x.bag": b"#ROSBAG V2.0\n", "x.mcap": b"\x89MCAP0\r\n", "x.db3": b"SQLite format 3\0"}.get(name, b"")
    with (tmp_path / name).open("wb") as file:
        file.write(magic)
        file.truncate(20_000_000)
    kinds: dict[str, Any] = {"mcap": McapRecording, "lsf": ImcRecording, "bin": ArduPilotRecording}
    suffix = name.rpartition(".")[2]
    recording = kinds.get(suffix, RosRecording)(format="x", file=name)
    wanted = {"lsf": "Depth", "bin": "IMU"}.get(suffix, "/a")
    with pytest.raises(DatasetError, match=r"contains no whole|cannot be"):
        limited(lambda: recording.read(tmp_path, [Wanted(wanted, None, ("x",))]), 200)


# -------------------------------------------------------------------------------------------------- definitions of ROS


def in_one_another(levels: int, fields: int, last: str) -> str:
    """A type of fields ** levels fields, in some kilobytes."""
    names = [f"T{level}" for level in range(levels)] + [last]
    parts = ["\n".join(f"{names[level + 1]} f{i}" for i in range(fields)) for level in range(levels)]
    parts = [part if level == 0 else f"MSG: p/T{level}\n{part}" for level, part in enumerate(parts)]
    return "\n===\n".join([*parts, *(["MSG: p/Empty\n"] if last == "Empty" else [])])


DEFINITIONS = {
    "fields": in_one_another(9, 20, "float64"),
    "types without fields": in_one_another(9, 20, "Empty"),
    "depth": in_one_another(2000, 1, "float64"),
    "length of a path": "\n===\n".join(f"MSG: p/T{i}\nT{i + 1} {'f' * 500}" for i in range(40)),
    "a long text": "float64 x\n" * 200_000,
    "fields of one name": "float64 x\nfloat64 x\n",
    "a length of many digits": f"float64[{'9' * 5000}] x\n",
}


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_a_definition_that_grows_is_refused(tmp_path, kind):
    text = DEFINITIONS[kind]
    text = text.removeprefix("MSG: p/T0\n") if kind == "length of a path" else text
    refused(bag(tmp_path / "x.bag", connection(text), SENT), tmp_path, "more than|two fields|not a line", "nothing")


IDL = "module p {{ module msg {{ {} struct A {{ {} double x; }}; }}; }};"


@pytest.mark.parametrize(
    ("constant", "annotation", "says"),
    [
        ("const long K = ((((1))));", "", "an expression in parentheses"),
        ("", "@default (value=((((1)))))", "an expression in parentheses"),
        (" " * 100_000, "", "more than 100000 characters of IDL"),
        ("/*" * 40_000, "", "cannot be understood"),
    ],
)
def test_idl_that_takes_the_parser_for_ever_is_refused(constant, annotation, says):
    text = IDL.format(constant, annotation)
    with pytest.raises(DatasetError, match=says):
        limited(lambda: definitions_of(text, "ros2idl", "p/msg/A", "x"), MEGABYTES)


def test_parentheses_in_text_comments_and_annotations_of_idl_are_no_expressions():
    text = IDL.format("/* (a) */ // (b)\n", '@verbatim (language="comment", text="const (m) \\" (") @unit (value="m")')
    assert definitions_of(text, "ros2idl", "p/msg/A", "x") == {"p/A": (("x", "float64", None),)}


def test_many_topics_of_large_types_are_listed_in_time(tmp_path):
    text = in_one_another(4, 9, "float64")  # 6561 fields
    records = [connection(text, number, b"/%d" % number) for number in range(300)]
    sent = [record(b"", op=b"\2", conn=struct.pack("<I", number), time=bytes(8)) for number in range(300)]
    held = listed(bag(tmp_path / "x.bag", *records, *sent), tmp_path)
    assert len(held) == 300
    assert sum(len(info.fields) for info in held) < 120_000


def test_more_topics_than_any_recorder_writes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(topics, "MOST_CHANNELS", 100)
    records = [connection("float64 x", number) for number in range(101)]
    refused(bag(tmp_path / "x.bag", SENT, *records), tmp_path, "more than 100 topics")


def test_elements_without_a_byte_are_not_counted_one_by_one():
    text = "A[900000000] a\n===\nMSG: p/A\nB[900000000] b\n===\nMSG: p/B\nC[900000000] c\n===\nMSG: p/C\n"
    extract = RosExtractor(parse_messages(f"float64 x\n{text}", "p/M", "x"), "p/M", ["x"], "ros1", "x")
    with pytest.raises(Exception, match="has no end"):
        limited(lambda: extract(bytes(8)), MEGABYTES)
    few = text.replace("900000000", "100000")
    extract = RosExtractor(parse_messages(f"byte[100000] y\nfloat64 x\n{few}", "p/M", "x"), "p/M", ["x"], "ros1", "x")
    assert limited(lambda: extract(bytes(100_008)), MEGABYTES) == [0.0]
    assert numeric_fields(parse_messages(text, "p/M", "x"), "p/M", "x") == ()


# ----------------------------------------------------------------------------------------------------------------- MCAP


def mcap(path: Path, schema: tuple[str, bytes] | None = None, message: bytes = b'{"x": 1}', more: bytes = b"") -> Any:
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        number = writer.register_schema("p.M0", schema[0], schema[1]) if schema else 0
        channel = writer.register_channel("/a", schema[0] if schema else "json", number)
        writer.add_message(channel, 1, message, 1)
        stream.write(more)
        writer.finish()
    return McapRecording(format="mcap", file=path.name)


def chunk(compression: str, data: bytes, size: int = 0) -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_chunk_of_an_mcap_file_that_unpacks_to_much_is_refused(tmp_path, compression):
    recording = mcap(tmp_path / "x.mcap", more=chunk(compression, PACK[compression](), len(ZEROS)))
    refused(recording, tmp_path, "unpack to more than 100 times their size")


@pytest.mark.parametrize("claims", [2**63, 2**64 - 1, 2**33])
def test_a_size_that_a_record_of_an_mcap_file_only_claims_costs_nothing(tmp_path, claims):
    inner = [chunk("", b"x", claims), chunk("zstd", b"x", claims), chunk("", struct.pack("<BQ", 5, claims))]
    for more in (*inner, struct.pack("<BQ", 5, claims), struct.pack("<BQ", 6, claims) + b"x"):
        recording = mcap(tmp_path / "x.mcap", more=more)
        found = limited(lambda r=recording: r.read(tmp_path, [Wanted("/a", None, ("x",))]), MEGABYTES)
        assert found.columns[0]["x"].tolist() == [1]
        assert found.notes


def protobuf(levels: int, fields: int) -> bytes:
    F = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="p.proto", package="p", syntax="proto3")
    for level in range(levels + 1):
        kind = file.message_type.add(name=f"M{level}")
        for i in range(fields):
            if level < levels:
                of = f".p.M{level + 1}"
                kind.field.add(name=f"f{i}", number=i + 1, type=F.TYPE_MESSAGE, label=F.LABEL_OPTIONAL, type_name=of)
            else:
                kind.field.add(name=f"f{i}", number=i + 1, type=F.TYPE_DOUBLE, label=F.LABEL_OPTIONAL)
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


@pytest.mark.parametrize(("levels", "fields"), [(10, 20), (90, 1), (20_000, 0)])
def test_types_of_protocol_buffers_in_one_another_are_bounded(tmp_path, levels, fields):
    recording = mcap(tmp_path / "x.mcap", ("protobuf", protobuf(levels, fields)), b"")
    refused(recording, tmp_path, "no numeric field of|more than 10000 types")


@pytest.mark.parametrize(
    "message",
    [b"[" * 100_000, b'{"a":' * 900 + b"1" + b"}" * 900, b'{"x": %s}' % (b"9" * 5000), b'{"x": %s}' % (b"9" * 400)],
)
def test_json_that_is_deep_or_huge_is_a_damaged_message(tmp_path, message):
    refused(mcap(tmp_path / "x.mcap", None, message), tmp_path, "are not what|no numeric field|Infinity|finite")


def test_numbers_that_no_float_holds_do_not_copy_all_rows_each_time(tmp_path):
    with (tmp_path / "x.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for n in range(20_000):
            writer.add_message(channel, n, b'{"x": 1.5}' if n % 3 else b'{"x": 1%s}' % (b"0" * 310), n)
        writer.finish()
    recording = McapRecording(format="mcap", file="x.mcap")
    found = limited(lambda: recording.read(tmp_path, [Wanted("/a", None, ("x",))]), MEGABYTES, 10)
    assert len(found.columns[0]["x"]) == 13_333


# --------------------------------------------------------------------------------------------------------------- SQLite

MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)"
TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)"
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i"
SCHEMAS = {
    "generated": (TOPICS, MESSAGES.replace("data", "data GENERATED ALWAYS AS (zeroblob(900000000))")),
    "generated topics": (TOPICS.replace("name", "name GENERATED ALWAYS AS (zeroblob(900000000))"), MESSAGES),
    "default": (TOPICS, MESSAGES.replace("data", f"data DEFAULT x'{'00' * 1000}'")),
    "view": (TOPICS, f"CREATE VIEW messages AS {ENDLESS} AS id, 1 AS topic_id, 1 AS timestamp, x'' AS data FROM n"),
    "view of topics": (f"CREATE VIEW topics AS {ENDLESS} AS id, '/a' AS name, 1 AS type FROM n", MESSAGES),
    "virtual": (TOPICS, "CREATE VIRTUAL TABLE messages USING fts4(topic_id, timestamp, data)"),
    "without rows": (TOPICS, MESSAGES + " WITHOUT ROWID"),
    "another rowid": (TOPICS, MESSAGES.replace("data", "data, RowId")),
    "no data": (TOPICS, MESSAGES.replace("data", "date")),
}


@pytest.mark.parametrize("kind", SCHEMAS)
def test_only_plain_tables_are_read(tmp_path, kind):
    with sqlite3.connect(tmp_path / "x.db3") as database:
        for statement in SCHEMAS[kind]:
            database.execute(statement)
        if "topics" not in kind:
            database.execute("INSERT INTO topics VALUES (1, '/a', 'p/A', 'cdr')")
        if kind == "generated":
            database.execute("INSERT INTO messages(id, topic_id, timestamp) VALUES (1, 1, 1)")
    database.close()
    refused(RosRecording(format="ros", file="x.db3"), tmp_path, r"x\.db3: ")


def test_a_statement_that_takes_more_steps_than_its_file_has_rows_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(ros2_database, "SPARE_STEPS", 0)
    monkeypatch.setattr(ros2_database, "STEPS_PER_BYTE", 0)
    with sqlite3.connect(tmp_path / "x.db3") as database:
        database.execute(TOPICS)
        database.execute(MESSAGES)
        database.execute("INSERT INTO topics VALUES (1, '/a', 'p/A', 'cdr')")
        database.executemany("INSERT INTO messages VALUES (?, 1, 1, x'')", ((n,) for n in range(1, 30_000)))
    database.close()
    (held,) = RosRecording(format="ros", file="x.db3").contents(tmp_path)
    assert 0 < held.count < 20_000


def test_pages_that_are_each_others_children_many_times_are_read_once(tmp_path):
    """Every inner page names its first child in place of all: of some pages, 50^3 paths lead to the same rows."""
    page = 512
    with sqlite3.connect(tmp_path / "x.db3") as database:
        database.execute(f"PRAGMA page_size = {page}")
        database.execute(TOPICS)
        database.execute(MESSAGES)
        database.execute("INSERT INTO topics VALUES (1, '/a', 'p/A', 'cdr'), (2, '/b', 'p/A', 'cdr')")
        rows = ((n, n, bytes(20)) for n in range(1, 60_000))
        database.executemany("INSERT INTO messages VALUES (?, 2, ?, ?)", rows)
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    database.close()
    data = bytearray((tmp_path / "x.db3").read_bytes())
    depth, at = 0, (root - 1) * page
    while data[at] == 5:  # an inner page of a table
        (count,) = struct.unpack_from(">H", data, at + 3)
        cells = [at + cell for cell in struct.unpack_from(f">{count}H", data, at + 12)]
        first = bytes(data[cells[0] : cells[0] + 4])
        for place in (*cells, at + 8):
            data[place : place + 4] = first
        depth, at = depth + 1, (int.from_bytes(first, "big") - 1) * page
    assert depth == 3
    (tmp_path / "x.db3").write_bytes(data)
    recording = RosRecording(format="ros", file="x.db3")
    assert [info.count < 50 for info in listed(recording, tmp_path)] == [True]
    refused(recording, tmp_path, "rows are out of order")


def test_a_packed_database_that_is_a_bomb_is_refused(tmp_path):
    (tmp_path / "x.db3.zstd").write_bytes(PACK["zstd"]())
    refused(RosRecording(format="ros", file="x.db3.zstd"), tmp_path, "unpack to more than 100 times their size")


# ------------------------------------------------------------------------------------------------------------------ IMC


def test_sync_words_that_begin_no_message_take_a_time_that_grows_with_the_file(tmp_path):
    good = imc_message("Depth", 1.0, 2.5)
    (tmp_path / "x.lsf").write_bytes(good + struct.pack("<HHH", 0xFE54, 0, 65535) * 1_000_000 + bytes(70_000))
    recording = ImcRecording(format="imc", file="x.lsf")
    recording.contents(tmp_path)  # compiles
    found = limited(lambda: recording.read(tmp_path, [Wanted("Depth", None, ("timestamp",))]), 200)
    assert found.columns[0]["timestamp"].tolist() == [1.0]


@pytest.mark.parametrize("name", ["x.lsf.gz", "x.zip"])
def test_a_packed_log_that_is_a_bomb_is_refused(tmp_path, name):
    if name == "x.zip":
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("x.lsf", ZEROS[: 20 << 20])
    else:
        (tmp_path / name).write_bytes(gzip.compress(ZEROS[: 20 << 20]))
    recording = ImcRecording(format="imc", file=name, member="x.lsf" if name == "x.zip" else None)
    with pytest.raises(DatasetError, match="unpacks to more than 100 times its size"):
        limited(lambda: recording.contents(tmp_path), MEGABYTES)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_that_python_unpacks_at_once_are_refused(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "x.zip", "w", method) as archive:
        archive.writestr("x.lsf", ZEROS[: 1 << 20])
    with pytest.raises(DatasetError, match="only stored and deflated"):
        ImcRecording(format="imc", file="x.zip", member="x.lsf").contents(tmp_path)


def test_definitions_of_messages_are_bounded(tmp_path):
    (tmp_path / "x.lsf").write_bytes(imc_message("Depth", 1.0, 2.5))
    (tmp_path / "IMC.xml.gz").write_bytes(gzip.compress(np.random.default_rng(1).bytes(9 << 20), 0))
    recording = ImcRecording(format="imc", file="x.lsf", definitions="IMC.xml.gz")
    with pytest.raises(DatasetError, match="more than 8 MiB"):
        limited(lambda: recording.contents(tmp_path), MEGABYTES)


def test_a_message_without_a_field_of_fixed_size_has_its_stamp(tmp_path):
    (tmp_path / "x.lsf").write_bytes(imc_message("Depth", 1.5, 2.5))
    (tmp_path / "IMC.xml").write_text("<m><message abbrev='Depth' id='265'><field type='plaintext'/></message></m>")
    recording = ImcRecording(format="imc", file="x.lsf", definitions="IMC.xml")
    found = recording.read(tmp_path, [Wanted("Depth", None, ("timestamp",))])
    assert found.columns[0]["timestamp"].tolist() == [1.5]
    assert [info.fields for info in recording.contents(tmp_path)] == [()]


@pytest.mark.parametrize(
    ("xml", "says"),
    [
        ("<!DOCTYPE m [<!ENTITY a 'aaaa'><!ENTITY b '&a;&a;'>]><m>&b;</m>", "it has entities"),
        ("<m><message abbrev='A' id='1'/><message abbrev='A' id='2'/></m>", "the message A or its number 2"),
        ("<m><message abbrev='A' id='1'/><message abbrev='B' id='1'/></m>", "the message B or its number 1"),
        (f"<m><message abbrev='A' id='{'9' * 5000}'/></m>", "not a list of IMC messages"),
        ("<m>" + "<a>" * 100_000, "not a list of IMC messages"),
    ],
)
def test_definitions_that_mislead_are_refused(xml, says):
    with pytest.raises(DatasetError, match=says):
        limited(lambda: parse_definitions(xml.encode(), "x"), MEGABYTES)


# ------------------------------------------------------------------------------------------------------------ ArduPilot


def test_layouts_that_change_all_the_time_are_read(tmp_path):
    from written_ardupilot import definition, head, message

    imu = message("IMU", 1, 0, *[0.0] * 6, 0, 0, 20.0, 1, 1, 0, 0)
    other = definition("IMU", columns="TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHy")
    (tmp_path / "x.bin").write_bytes(head() + (definition("IMU") + imu + other + imu) * 1000)
    recording = ArduPilotRecording(format="ardupilot", file="x.bin")
    found = limited(lambda: recording.read(tmp_path, [Wanted("IMU", 0, ("GyrX",))]), MEGABYTES)
    assert len(found.columns[0]["GyrX"]) == 2000


# --------------------------------------------------------------------------------------------------- control characters


def test_names_in_a_file_cannot_write_on_the_terminal(tmp_path):
    recording = bag(tmp_path / "x.bag", connection("float64 x", topic=b"/a\x1b[31m\0"), SENT)
    with pytest.raises(DatasetError) as error:
        recording.read(tmp_path, [Wanted("/a", None, ("x",))])
    assert str(error.value).isprintable()
    data = json.dumps({"x": 1}).encode()
    with (tmp_path / "x.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for name in ("/a\x1b[31m", "/a"):
            writer.add_message(writer.register_channel(name, "json", 0), 1, data, 1)
        writer.add_message(writer.register_channel("/b\x1b[2J", "json", 0), 1, b"{", 1)
        writer.finish()
    wanted = [Wanted("/a\x1b[31m", None, ("x",)), Wanted("/a", None, ("x",))]
    notes = McapRecording(format="mcap", file="x.mcap").read(tmp_path, wanted).notes
    assert all(note.isprintable() for note in notes)
    with pytest.raises(DatasetError) as error:
        McapRecording(format="mcap", file="x.mcap").read(tmp_path, [Wanted("/b\x1b[2J", None, ("x",))])
    assert str(error.value).isprintable()
    assert np.all([info.count == 1 for info in listed(McapRecording(format="mcap", file="x.mcap"), tmp_path)])
