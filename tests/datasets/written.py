"""Writers of a log in other people's formats, by those formats' own libraries: the recording, and its log.yaml."""

from __future__ import annotations

import json
import random
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
import pandas as pd
import yaml
from fathom.datasets import DatasetError, Log
from fathom.datasets.described.folder import write_folder
from fathom.datasets.described.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from fathom.datasets.described.opening import open_log
from fathom.datasets.log import ImuStream
from hypothesis import HealthCheck, settings

READING = "std_msgs/Header header\nfloat64[] z\nfloat64[] sigma\n"
"""A reading of any aiding sensor, with its sigma, so that what is written is what is read."""
NS = 1_000_000_000
Row = tuple[int, int, list[float], list[float]]
"""When it was true, when it was received (ns), and the numbers: gyro and accel, or z and sigma."""


def first_seconds(log: Log, seconds: float) -> Log:
    """The beginning of a log, for tests that open many."""
    end_ns = log.imu.t_ns[0] + round(seconds * NS)
    imu = ImuStream(*(values[log.imu.t_ns <= end_ns] for values in (log.imu.t_ns, log.imu.w_WI_I, log.imu.f_I)))
    streams = {}
    for name, s in log.streams.items():
        early = s.received_ns <= end_ns
        if early.any():
            streams[name] = replace(s, **{k: getattr(s, k)[early] for k in ("t_ns", "received_ns", "z", "sigma")})
    return replace(log, imu=imu, truth=None, **{name: streams.get(name) for name in log.streams})


def geodetic_places(p_W: np.ndarray, latitude: float, longitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude (rad) of the ellipsoid's points above or below p_W (n, 3), of W's origin given."""
    at = np.array(latitude), np.array(longitude)
    start, axes = ecef_from_geodetic(*at, np.array(0.0)), enu_axes(*at)
    local = p_W * [1.0, 1.0, 0.0]
    for _ in range(5):
        lat, lon, height = geodetic_from_ecef(start + local @ axes)
        local[:, 2] -= height
    return lat, lon


def write_arrays(log: Log, folder: Path) -> Path:
    """Write every stream as one array of its times and one of each other column."""
    write_folder(log, folder)
    described = yaml.safe_load((folder / "log.yaml").read_text())
    for name, part in described["streams"].items():
        table = pd.read_parquet(folder / part["table"]["file"])
        (folder / part["table"]["file"]).unlink()
        (folder / name).mkdir()
        for column in table:
            np.save(folder / name / f"{column}.npy", table[column].to_numpy())
        part["table"] = {"arrays": {str(column): f"{name}/{column}.npy" for column in table}}
    (folder / "log.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return folder


def rows(log: Log) -> dict[str, list[Row]]:
    """The rows of each stream."""
    imu = log.imu
    found = {"imu": list(zip(imu.t_ns.tolist(), imu.t_ns.tolist(), imu.w_WI_I.tolist(), imu.f_I.tolist(), strict=True))}
    for name, s in log.streams.items():
        found[name] = list(zip(s.t_ns.tolist(), s.received_ns.tolist(), s.z.tolist(), s.sigma.tolist(), strict=True))
    return found


def in_time_order(log: Log) -> Iterator[tuple[str, Row]]:
    """All rows as they were received."""
    both = [(name, row) for name, stream in rows(log).items() for row in stream]
    yield from sorted(both, key=lambda item: item[1][1])


def describe(log: Log, folder: Path, recording: dict[str, Any], paths: dict[str, Any]) -> Path:
    """Write log.yaml: that of the log's own folder, with messages for tables.

    Args:
        paths: `stamp`, `gyro` and `accel` (three each), and `z` and `sigma` without an index.
    """
    write_folder(log, folder)
    described = yaml.safe_load((folder / "log.yaml").read_text())
    for name, part in described["streams"].items():
        (folder / part.pop("table")["file"]).unlink()
        part["message"] = {"names": [f"/{name}"]}
        part["time"] = {"column": paths["stamp"], "unit": "ns"}
        if name == "imu":
            part["gyro"]["columns"], part["accel"]["columns"] = paths["gyro"], paths["accel"]
            continue
        part["time"]["received"] = "log_time"
        for key, value in part.items():
            if isinstance(value, dict) and key not in ("message", "time", "mounting"):
                base = paths["sigma"] if key == "sigma" else paths["z"]
                value["columns"] = [f"{base}.{i}" for i in range(len(value["columns"]))]
    described["recording"] = recording
    (folder / "log.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return folder


ROS_PATHS = {
    "stamp": "header.stamp",
    "gyro": [f"angular_velocity.{a}" for a in "xyz"],
    "accel": [f"linear_acceleration.{a}" for a in "xyz"],
    "z": "z",
    "sigma": "sigma",
}


def ros_store(version: Literal[1, 2]) -> Any:
    """rosbags' types, and our reading."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(READING, "fathom_msgs/msg/Reading"))
    return store


def ros_messages(log: Log, store: Any, version: Literal[1, 2]) -> Iterator[tuple[str, int, Any]]:
    """Stream, record time and message of every row."""
    types = store.types
    Imu, Reading = types["sensor_msgs/msg/Imu"], types["fathom_msgs/msg/Reading"]
    Vector3, Quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    for name, (t_ns, received_ns, first, second) in in_time_order(log):
        stamp = types["builtin_interfaces/msg/Time"](t_ns // NS, t_ns % NS)
        number = {"seq": 0} if version == 1 else {}
        header = types["std_msgs/msg/Header"](**number, stamp=stamp, frame_id=f"{name}_link")
        if name == "imu":
            none = np.zeros(9)
            message = Imu(header, Quaternion(0.0, 0.0, 0.0, 1.0), none, Vector3(*first), none, Vector3(*second), none)
        else:
            message = Reading(header, np.array(first), np.array(second))
        yield name, received_ns, message


def write_ros1(log: Log, folder: Path, compression: str | None = None) -> Path:
    """Write a ROS 1 bag."""
    from rosbags.rosbag1 import Writer

    store, connections = ros_store(1), {}
    describe(log, folder, {"format": "ros", "file": "log.bag"}, ROS_PATHS)
    writer = Writer(folder / "log.bag")
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        for name, t_ns, message in ros_messages(log, store, 1):
            kind = message.__msgtype__
            if name not in connections:
                connections[name] = writer.add_connection(f"/{name}", kind, typestore=store)
            writer.write(connections[name], t_ns, store.serialize_ros1(message, kind))
    return folder


def write_ros2(log: Log, folder: Path, storage: Literal["sqlite3", "mcap"] = "sqlite3", compress: str = "") -> Path:
    """Write a ROS 2 bag; `compress`: "", "file" or "message"."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store, connections = ros_store(2), {}
    describe(log, folder, {"format": "ros", "file": "bag"}, ROS_PATHS)
    writer = Writer(folder / "bag", version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compress:
        writer.set_compression(CompressionMode[compress.upper()], CompressionFormat.ZSTD)
    with writer:
        for name, t_ns, message in ros_messages(log, store, 2):
            kind = message.__msgtype__
            if name not in connections:
                connections[name] = writer.add_connection(f"/{name}", kind, typestore=store)
            writer.write(connections[name], t_ns, store.serialize_cdr(message, kind))
    return folder


def write_mcap(
    log: Log, folder: Path, encoding: Literal["protobuf", "ros2", "ros1", "json"] = "protobuf", **options: Any
) -> Path:
    """Write an MCAP file; `options` are those of `mcap`'s writer."""
    paths = ROS_PATHS if encoding in ("ros1", "ros2") else {
        "stamp": "stamp", "gyro": [f"gyro.{a}" for a in "xyz"], "accel": [f"accel.{a}" for a in "xyz"],
        "z": "z", "sigma": "sigma",
    }  # fmt: skip
    describe(log, folder, {"format": "mcap", "file": "log.mcap"}, paths)
    write: Callable[..., None] = {"protobuf": _protobuf, "json": _json}.get(encoding, _ros_in_mcap)
    with (folder / "log.mcap").open("wb") as stream:
        write(log, stream, encoding, options)
    return folder


def _ros_in_mcap(log: Log, stream: Any, encoding: str, options: dict[str, Any]) -> None:
    if encoding == "ros1":
        _ros1_in_mcap(log, stream, options)
        return
    from mcap_ros2.writer import Writer

    store = ros_store(2)
    with Writer(stream, **options) as writer:
        schemas = {
            kind: writer.register_msgdef(kind, store.generate_msgdef(kind, ros_version=2)[0])
            for kind in ("sensor_msgs/msg/Imu", "fathom_msgs/msg/Reading")
        }
        for name, (t_ns, received_ns, first, second) in in_time_order(log):
            stamp = {"sec": t_ns // NS, "nanosec": t_ns % NS}
            message: dict[str, Any] = {"header": {"stamp": stamp, "frame_id": name}}
            if name == "imu":
                message["angular_velocity"] = dict(zip("xyz", first, strict=True))
                message["linear_acceleration"] = dict(zip("xyz", second, strict=True))
            else:
                message |= {"z": first, "sigma": second}
            kind = "sensor_msgs/msg/Imu" if name == "imu" else "fathom_msgs/msg/Reading"
            writer.write_message(f"/{name}", schemas[kind], message, log_time=received_ns, publish_time=received_ns)


def _ros1_in_mcap(log: Log, stream: Any, options: dict[str, Any]) -> None:
    from mcap.writer import Writer

    store, channels = ros_store(1), {}
    writer = Writer(stream, **options)
    writer.start(profile="ros1")
    for name, t_ns, message in ros_messages(log, store, 1):
        kind = message.__msgtype__
        if name not in channels:
            text, _ = store.generate_msgdef(kind, ros_version=1)
            schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", text.encode())
            channels[name] = writer.register_channel(f"/{name}", "ros1", schema)
        writer.add_message(channels[name], t_ns, bytes(store.serialize_ros1(message, kind)), t_ns)
    writer.finish()


def _json(log: Log, stream: Any, _: str, options: dict[str, Any]) -> None:
    from mcap.writer import Writer

    writer, channels = Writer(stream, **options), {}
    writer.start()
    for name, (t_ns, received_ns, first, second) in in_time_order(log):
        if name not in channels:
            channels[name] = writer.register_channel(f"/{name}", "json", 0)
        message: dict[str, Any] = {"stamp": {"sec": t_ns // NS, "nsec": t_ns % NS}}
        if name == "imu":
            xyz = [dict(zip("xyz", values, strict=True)) for values in (first, second)]
            message |= {"gyro": xyz[0], "accel": xyz[1]}
        else:
            message |= {"z": first, "sigma": second}
        writer.add_message(channels[name], received_ns, json.dumps(message).encode(), received_ns)
    writer.finish()


def protobuf_classes() -> tuple[Any, Any]:
    """Our IMU sample and reading in Protocol Buffers."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(name="fathom.proto", package="fathom", syntax="proto3")
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    F = descriptor_pb2.FieldDescriptorProto
    one, many = F.LABEL_OPTIONAL, F.LABEL_REPEATED
    stamp = ("stamp", F.TYPE_MESSAGE, one, ".google.protobuf.Timestamp")
    vector = ("gyro", F.TYPE_MESSAGE, one, ".fathom.Vector3"), ("accel", F.TYPE_MESSAGE, one, ".fathom.Vector3")
    messages = {
        "Vector3": [(a, F.TYPE_DOUBLE, one, "") for a in "xyz"],
        "Imu": [stamp, *vector],
        "Reading": [stamp, ("z", F.TYPE_DOUBLE, many, ""), ("sigma", F.TYPE_DOUBLE, many, "")],
    }
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for number, (field, kind, label, of) in enumerate(fields, 1):
            message.field.add(name=field, number=number, type=kind, label=label, type_name=of or None)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return tuple(message_factory.GetMessageClass(pool.FindMessageTypeByName(f"fathom.{n}")) for n in ("Imu", "Reading"))


def _protobuf(log: Log, stream: Any, _: str, options: dict[str, Any]) -> None:
    from mcap_protobuf.writer import Writer

    Imu, Reading = protobuf_classes()
    with Writer(stream, **options) as writer:
        for name, (t_ns, received_ns, first, second) in in_time_order(log):
            stamp = {"seconds": t_ns // NS, "nanos": t_ns % NS}
            if name == "imu":
                xyz = [dict(zip("xyz", values, strict=True)) for values in (first, second)]
                message = Imu(stamp=stamp, gyro=xyz[0], accel=xyz[1])
            else:
                message = Reading(stamp=stamp, z=first, sigma=second)
            writer.write_message(f"/{name}", message, log_time=received_ns, publish_time=received_ns)


def write_json_lines(log: Log, folder: Path) -> Path:
    """Write a file with one JSON object a line."""
    paths = {"stamp": "stamp", "gyro": [f"gyro.{i}" for i in range(3)], "accel": [f"accel.{i}" for i in range(3)]}
    describe(log, folder, {"format": "jsonlines", "file": "log.jsonl"}, {**paths, "z": "z", "sigma": "sigma"})
    with (folder / "log.jsonl").open("w") as file:
        for name, (t_ns, received_ns, first, second) in in_time_order(log):
            values = {"gyro": first, "accel": second} if name == "imu" else {"z": first, "sigma": second}
            file.write(json.dumps({"type": f"/{name}", "stamp": t_ns, "log_time": received_ns, **values}) + "\n")
    return folder


WRITERS: dict[str, Callable[[Log, Path], Path]] = {
    "ros1": write_ros1,
    "ros2-sqlite": lambda log, folder: write_ros2(log, folder, "sqlite3"),
    "ros2-mcap": lambda log, folder: write_ros2(log, folder, "mcap"),
    "mcap-protobuf": lambda log, folder: write_mcap(log, folder, "protobuf"),
    "mcap-ros2": lambda log, folder: write_mcap(log, folder, "ros2"),
    "mcap-ros1": lambda log, folder: write_mcap(log, folder, "ros1"),
    "jsonlines": write_json_lines,
    "mcap-json": lambda log, folder: write_mcap(log, folder, "json"),
}
"""Every format that holds a log bit for bit: a float64 stays one, and so does a nanosecond."""


FUZZ = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
"""Damage of any kind, the same at every run."""
LONGEST_S = 20.0
"""No damage may keep a reader busier than this."""


def log_or_error(folder: Path, *, repair: bool = False) -> None:
    """Damage is an error or a log, nothing else, and soon."""
    start = perf_counter()
    with suppress(DatasetError):
        assert isinstance(open_log(folder, repair=repair), Log)
    assert perf_counter() - start < LONGEST_S


@contextmanager
def allocated() -> Iterator[Callable[[], int]]:
    """The peak of what Python allocates meanwhile, bytes; asked for afterwards."""
    peak = 0
    tracemalloc.start()
    try:
        yield lambda: peak
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def copied(source: Path, target: Path) -> Path:
    """A copy of a written log, to be damaged."""
    shutil.copytree(source, target)
    return target


def assert_the_same(a: Log, b: Log) -> None:
    for name in ("t_ns", "w_WI_I", "f_I"):
        np.testing.assert_array_equal(getattr(a.imu, name), getattr(b.imu, name), strict=True)
    assert a.streams.keys() == b.streams.keys()
    for name, stream in a.streams.items():
        for field in ("t_ns", "received_ns", "z", "sigma"):
            np.testing.assert_array_equal(getattr(stream, field), getattr(b.streams[name], field), strict=True)


def assert_half_is_read_and_reported(log: Log, folder: Path, file: str, says: str) -> None:
    """Cut the file of a log in the middle: what is whole is read, and a note says that the rest is missing."""
    data = (folder / file).read_bytes()
    (folder / file).write_bytes(data[: len(data) // 2])
    cut = open_log(folder)
    n = len(cut.imu.t_ns)
    assert 2000 < n < 4000
    np.testing.assert_array_equal(cut.imu.f_I, log.imu.f_I[:n])
    assert any(f"{file}: {says}" in note for note in cut.notes)


def damaged(data: bytes, seed: int) -> bytes:
    """The same bytes, some of them flipped, overwritten, cut out, put in, or cut off."""
    rng, mutable = random.Random(seed), bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 6])):
        at = min(int(len(mutable) * rng.random() ** rng.choice([1, 4])), len(mutable) - 1)
        how = rng.randrange(5)
        if how == 0:
            mutable[at] ^= 1 << rng.randrange(8)
        elif how == 1:
            mutable[at : at + 4] = rng.choice([bytes(4), b"\xff" * 4, rng.randbytes(4)])
        elif how == 2:
            del mutable[at : at + rng.randrange(1, 200)]
        elif how == 3:
            mutable[at:at] = rng.randbytes(rng.randrange(1, 60))
        else:
            del mutable[max(at, 1) :]
        if not mutable:
            break
    return bytes(mutable)
