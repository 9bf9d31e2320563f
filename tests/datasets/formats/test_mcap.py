"""MCAP files: every encoding gives back what was written; what is damaged is told; absent fields are not zeros."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fathom.datasets import DatasetError
from fathom.datasets.described.opening import open_log
from fathom.datasets.formats.mcap_file import McapRecording
from fathom.datasets.formats.recording import Wanted
from google.protobuf import descriptor_pb2, timestamp_pb2
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from written import allocated, assert_half_is_read_and_reported, assert_the_same, damaged, log_or_error, write_mcap

ENCODINGS = ["protobuf", "ros2", "ros1", "json"]


def read(folder: Path, topic: str, *columns: str, file: str = "log.mcap") -> dict[str, Any]:
    (found,) = McapRecording(format="mcap", file=file).read(folder, [Wanted(topic, None, columns)]).columns
    return dict(found)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_mcap_file_gives_back_the_log_it_was_written_from(log, tmp_path, encoding):
    assert_the_same(log, open_log(write_mcap(log, tmp_path / "log", encoding)))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("encoding", ["protobuf", "ros2"])
def test_any_compression_reads_the_same(small, tmp_path, encoding, compression):
    folder = write_mcap(small, tmp_path / "log", encoding, compression=compression, chunk_size=5000)
    assert_the_same(small, open_log(folder))


def test_a_file_without_chunks_and_summary_reads_the_same(small, tmp_path):
    bare = {"use_chunking": False, "use_statistics": False, "use_summary_offsets": False, "repeat_channels": False}
    assert_the_same(small, open_log(write_mcap(small, tmp_path / "log", "json", **bare, repeat_schemas=False)))


def test_rows_come_in_the_order_of_the_log_time(tmp_path):
    def write(writer: Writer) -> None:
        channel = writer.register_channel("/a", "json", 0)
        for log_ns in (3, 1, 2):
            writer.add_message(channel, log_ns, json.dumps({"x": log_ns * 10}).encode(), log_ns + 100)

    write_plain(tmp_path, write)
    found = read(tmp_path, "/a", "x", "log_time", "publish_time")
    assert {name: values.tolist() for name, values in found.items()} == {
        "x": [10, 20, 30], "log_time": [1, 2, 3], "publish_time": [101, 102, 103],
    }  # fmt: skip
    assert all(values.dtype == np.int64 for values in found.values())


def write_plain(folder: Path, fill: Any) -> None:
    with (folder / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        fill(writer)
        writer.finish()


# ---------------------------------------------------------------------------------------------------------- encodings


def sample_class() -> Any:
    """A message with what numbers can be: an enumeration, an optional one, a large one, in one another, repeated."""
    from google.protobuf import descriptor_pool, message_factory

    F = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="sample.proto", package="p", syntax="proto3")
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    inner = file.message_type.add(name="Inner")
    inner.field.add(name="v", number=1, type=F.TYPE_FLOAT, label=F.LABEL_OPTIONAL)
    inner.field.add(name="n", number=2, type=F.TYPE_SINT32, label=F.LABEL_OPTIONAL)
    mode = file.enum_type.add(name="Mode")
    mode.value.add(name="OFF", number=0)
    mode.value.add(name="ON", number=3)
    sample = file.message_type.add(name="Sample")
    sample.field.add(name="mode", number=1, type=F.TYPE_ENUM, label=F.LABEL_OPTIONAL, type_name=".p.Mode")
    sample.field.add(name="big", number=2, type=F.TYPE_UINT64, label=F.LABEL_OPTIONAL)
    sample.field.add(name="inner", number=3, type=F.TYPE_MESSAGE, label=F.LABEL_OPTIONAL, type_name=".p.Inner")
    sample.field.add(name="many", number=4, type=F.TYPE_MESSAGE, label=F.LABEL_REPEATED, type_name=".p.Inner")
    sample.field.add(name="name", number=5, type=F.TYPE_STRING, label=F.LABEL_OPTIONAL)
    stamp = ".google.protobuf.Timestamp"
    sample.field.add(name="stamps", number=6, type=F.TYPE_MESSAGE, label=F.LABEL_REPEATED, type_name=stamp)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("p.Sample"))


@pytest.fixture
def samples(tmp_path):
    from mcap_protobuf.writer import Writer as ProtobufWriter

    Sample = sample_class()
    with (tmp_path / "log.mcap").open("wb") as stream, ProtobufWriter(stream) as writer:
        full = {"mode": 3, "big": 2**64 - 1, "inner": {"v": 0.5, "n": -7}, "many": [{"v": 1.0}, {"v": 2.0}]}
        stamp = {"seconds": 1_700_000_000, "nanos": 123_456_789}
        writer.write_message("/s", Sample(**full, stamps=[stamp, stamp]), log_time=1, publish_time=1)
        writer.write_message("/s", Sample(many=[{"v": 3.0}, {}], stamps=[stamp]), log_time=2, publish_time=2)
    return tmp_path


def test_numbers_of_protocol_buffers_keep_their_kind(samples):
    found = read(samples, "/s", "mode", "big", "many.1.v", "stamps.0")
    assert {name: (values.dtype.kind, values.tolist()) for name, values in found.items()} == {
        "mode": ("i", [3, 0]),
        "big": ("u", [2**64 - 1, 0]),
        "many.1.v": ("f", [2.0, 0.0]),
        "stamps.0": ("i", [1_700_000_000_123_456_789] * 2),
    }


def test_a_message_left_out_is_not_a_zero(samples):
    np.testing.assert_array_equal(read(samples, "/s", "inner.v")["inner.v"], [0.5, np.nan])
    held = McapRecording(format="mcap", file="log.mcap").read(samples, [Wanted("/s", None, ("inner.n", "log_time"))])
    assert held.columns[0]["log_time"].tolist() == [1]
    assert held.notes == ("/s: 1 damaged messages skipped, the first is message 1: it has no 'inner.n'",)


@pytest.mark.parametrize(
    ("column", "error"),
    [
        ("many.2.v", "/s: message 0: 'many.2.v' has 2 elements"),
        ("stamps.1", "/s: message 1: 'stamps.1' has 1 elements"),
        ("name", "no numeric field of p.Sample called 'name'"),
        ("many.v", "called 'many.v'; did you mean 'many.0.v'"),
        ("inner", "called 'inner'; did you mean 'inner.[vn]'"),
        ("bgi", "called 'bgi'; did you mean 'big'"),
    ],
)
def test_what_a_message_does_not_hold_is_named(samples, column, error):
    with pytest.raises(DatasetError, match=error):
        read(samples, "/s", column)


def test_json_numbers_stay_integers_until_one_is_not(tmp_path):
    messages = [
        {"a": 2**62 + 1, "b": 1, "t": {"sec": 5, "nsec": 7}},
        {"a": 3, "b": 1.5, "t": {"sec": 6, "nsec": 8}, "c": 1},
    ]

    def write(writer: Writer) -> None:
        channel = writer.register_channel("/j", "json", 0)
        for i, message in enumerate(messages):
            writer.add_message(channel, i, json.dumps(message).encode(), i)

    write_plain(tmp_path, write)
    found = read(tmp_path, "/j", "a", "b", "c", "t")
    assert found["a"].dtype == np.int64
    assert found["a"].tolist() == [2**62 + 1, 3]
    assert found["b"].tolist() == [1.0, 1.5]
    np.testing.assert_array_equal(found["c"], [np.nan, 1.0])
    assert found["t"].tolist() == [5_000_000_007, 6_000_000_008]
    with pytest.raises(DatasetError, match="no numeric field called 'd'"):
        read(tmp_path, "/j", "d")
    with pytest.raises(DatasetError, match=r"no numeric field called 't\.sec\.x'"):
        read(tmp_path, "/j", "t.sec.x")


def test_a_topic_of_two_types_is_refused(tmp_path):
    def write(writer: Writer) -> None:
        for i, kind in enumerate(("a.A", "b.B")):
            schema = writer.register_schema(kind, "jsonschema", b"{}")
            writer.add_message(writer.register_channel("/t", "json", schema), i, b'{"x": 1}', i)

    write_plain(tmp_path, write)
    with pytest.raises(DatasetError, match=r"/t: messages of two types, a\.A and b\.B"):
        read(tmp_path, "/t", "x")


def test_an_encoding_that_is_not_supported_is_named(tmp_path):
    def write(writer: Writer) -> None:
        writer.add_message(writer.register_channel("/f", "flatbuffer", 0), 1, b"x", 1)

    write_plain(tmp_path, write)
    with pytest.raises(DatasetError, match="messages encoded as 'flatbuffer' are not supported"):
        read(tmp_path, "/f", "x")


# ------------------------------------------------------------------------------------------------- damage and errors


def test_a_cut_file_gives_what_is_whole_and_is_reported(log, tmp_path):
    folder = write_mcap(log, tmp_path / "log", "protobuf", chunk_size=50_000)
    assert_half_is_read_and_reported(log, folder, "log.mcap", "damaged, or cut off")


def test_a_damaged_chunk_is_passed_over_and_counted(log, tmp_path):
    folder = write_mcap(log, tmp_path / "log", "ros2", chunk_size=100_000, compression=CompressionType.NONE)
    data = bytearray((folder / "log.mcap").read_bytes())
    data[data.index(log.imu.f_I[3000, 0].tobytes())] ^= 0x04  # in a number: only the checksum tells
    (folder / "log.mcap").write_bytes(bytes(data))
    back = open_log(folder)
    assert 0 < len(log.imu.t_ns) - len(back.imu.t_ns) < 1000
    assert np.isin(back.imu.f_I, log.imu.f_I).all()
    assert "log.mcap: 1 damaged chunks or records skipped" in back.notes


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(100), b"#ROSBAG V2.0\n"])
def test_what_is_no_mcap_file_is_refused(tmp_path, content):
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(DatasetError, match=r"log\.mcap: (not|contains no whole message)"):
        read(tmp_path, "/a", "x")


def test_a_missing_extra_is_named(small, tmp_path, monkeypatch):
    folder = write_mcap(small, tmp_path / "log")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "mcap.records", None)
        with pytest.raises(DatasetError, match=r"pip install 'fathom-bench\[mcap\]'"):
            open_log(folder)
    monkeypatch.setitem(sys.modules, "mcap_protobuf.decoder", None)
    with pytest.raises(DatasetError, match=r"pip install 'fathom-bench\[mcap\]'"):
        open_log(folder)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_contents_lists_the_topics(small, tmp_path, encoding):
    folder = write_mcap(small, tmp_path / "log", encoding)
    held = {h.message: h for h in McapRecording(format="mcap", file="log.mcap").contents(folder)}
    assert {name: h.count for name, h in held.items()} == {
        "/imu": len(small.imu.t_ns), **{f"/{name}": len(stream) for name, stream in small.streams.items()},
    }  # fmt: skip
    if encoding != "json":
        fields = set(held["/dvl"].fields)
        assert {"z.0", "sigma.0", "stamp" if encoding == "protobuf" else "header.stamp"} <= fields


@pytest.mark.slow
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_what_is_not_wanted_costs_no_memory(tmp_path, compression):
    """160 MB of other messages around 20,000 small ones."""
    n, other = 20_000, np.random.default_rng(1).bytes(800_000)
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start()
        a, b = writer.register_channel("/a", "json", 0), writer.register_channel("/b", "json", 0)
        for i in range(n):
            writer.add_message(a, i, b'{"x": 1.5}', i)
            if i % 100 == 0:
                writer.add_message(b, i, other, i)
        writer.finish()
    read(tmp_path, "/a", "log_time")  # imports
    with allocated() as peak:
        found = read(tmp_path, "/a", "x", "log_time")
    wanted = sum(values.nbytes for values in found.values())
    assert wanted == n * 16
    assert peak() < 4 * wanted + 6_000_000  # a few chunks of the file


@pytest.fixture(scope="session")
def fuzzed(small, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzzed")
    plain = {"compression": CompressionType.NONE, "enable_crcs": False}
    files = {encoding: write_mcap(small, folder / encoding, encoding) for encoding in ENCODINGS}
    files |= {f"{e}-plain": write_mcap(small, folder / f"{e}-plain", e, **plain) for e in ENCODINGS}
    return {name: (folder, (folder / "log.mcap").read_bytes()) for name, folder in files.items()}


@pytest.mark.slow
@settings(max_examples=80, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32), which=st.sampled_from([*ENCODINGS, *(f"{e}-plain" for e in ENCODINGS)]))
def test_a_damaged_file_gives_a_log_or_an_error(fuzzed, seed, which):
    folder, data = fuzzed[which]
    (folder / "log.mcap").write_bytes(damaged(data, seed))
    log_or_error(folder, repair=True)
