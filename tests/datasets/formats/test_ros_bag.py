"""ROS bags: what was written is what is read, bit for bit; what is damaged is told; nothing but the wanted is kept."""

from __future__ import annotations

import sqlite3
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError
from fathom.datasets.described.opening import open_log
from fathom.datasets.formats.recording import Wanted
from fathom.datasets.formats.ros_bag import RosRecording, shipped_definitions
from fathom.datasets.formats.ros_messages import RosExtractor, numeric_fields, parse_definitions, short_name
from fathom.datasets.formats.topics import MalformedMessage
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from written import (
    allocated,
    assert_half_is_read_and_reported,
    assert_the_same,
    copied,
    damaged,
    log_or_error,
    ros_store,
    write_ros1,
    write_ros2,
)

NS = 1_000_000_000


def read(folder: Path, topic: str, *columns: str, **options: Any) -> dict[str, Any]:
    (found,) = RosRecording(format="ros", **options).read(folder, [Wanted(topic, None, columns)]).columns
    return dict(found)


@pytest.mark.parametrize("compression", [None, "bz2", "lz4"])
def test_a_ros_1_bag_gives_back_the_log_it_was_written_from(log, tmp_path, compression):
    assert_the_same(log, open_log(write_ros1(log, tmp_path / "log", compression)))


@pytest.mark.parametrize(
    ("storage", "compress"), [("sqlite3", ""), ("mcap", ""), ("sqlite3", "file"), ("sqlite3", "message")]
)
def test_a_ros_2_bag_gives_back_the_log_it_was_written_from(log, tmp_path, storage, compress):
    assert_the_same(log, open_log(write_ros2(log, tmp_path / "log", storage, compress)))


def test_a_ros_2_bag_without_its_metadata_reads_the_same(small, tmp_path):
    folder = write_ros2(small, tmp_path / "log")
    (folder / "bag" / "metadata.yaml").unlink()
    assert_the_same(small, open_log(folder))


# ---------------------------------------------------------------------------------------------------- single numbers


def some_message(store: Any, kind: str, rng: np.random.Generator) -> Any:
    """A message with random numbers, strings and lengths."""
    values = []
    for _, (node, what) in store.fielddefs[kind][1]:
        values.append(some_value(store, int(node), what, rng))
    return store.types[kind](*values)


def some_value(store: Any, node: int, what: Any, rng: np.random.Generator) -> Any:
    if node == 2:  # a message
        return some_message(store, what, rng)
    if node == 1:
        base = what[0]
        if base == "string":
            return "x" * int(rng.integers(0, 9))
        if base == "bool":
            return bool(rng.integers(2))
        if base.startswith("float"):
            return float(np.float32(rng.normal()))
        return int(rng.integers(0, 100))
    (inner, base), length = what
    count = length if node == 3 else 3
    if inner == 2 or base[0] == "string":
        return [some_value(store, int(inner), base, rng) for _ in range(count)]
    dtype = {"bool": "bool", "byte": "uint8", "char": "uint8"}.get(base[0], base[0])
    return rng.integers(0, 100, count).astype(dtype)


def at(message: Any, path: str) -> Any:
    for step in path.split("."):
        message = message[int(step)] if step.isdecimal() else getattr(message, step)
    return message.sec * NS + message.nanosec if hasattr(message, "sec") else message


KINDS = ["sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/FluidPressure",
         "sensor_msgs/msg/MagneticField", "geometry_msgs/msg/TwistWithCovarianceStamped", "sensor_msgs/msg/Joy",
         "sensor_msgs/msg/JointState", "sensor_msgs/msg/PointCloud2", "diagnostic_msgs/msg/DiagnosticArray",
         "trajectory_msgs/msg/JointTrajectory", "geometry_msgs/msg/PoseArray"]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["ros1", "cdr", "cdr-be"])
def test_every_number_of_a_message_is_the_one_that_rosbags_finds(kind, how):
    store = get_typestore(Stores.ROS1_NOETIC if how == "ros1" else Stores.ROS2_HUMBLE)
    text, _ = store.generate_msgdef(kind, ros_version=1 if how == "ros1" else 2)
    types = parse_definitions(text, kind, "x")
    paths = numeric_fields(types, kind, "x")
    paths += tuple(path.replace(".0", ".2") for path in paths if ".0" in path and "PointField" not in path)
    paths = tuple(dict.fromkeys(paths))
    rng = np.random.default_rng(7)
    extract = RosExtractor(types, kind, paths[::-1], "ros1" if how == "ros1" else "cdr", "x")
    for _ in range(5):
        message = some_message(store, kind, rng)
        if how == "ros1":
            data = bytes(store.serialize_ros1(message, kind))
        else:
            data = bytes(store.serialize_cdr(message, kind, little_endian=how == "cdr"))
        found = extract.columns([np.array([value]) for value in extract(data)])
        assert {path: values[0] for path, values in found.items()} == {path: at(message, path) for path in paths}
        for cut in (data[:-1] if how == "ros1" else data[:-4], data + bytes(4)):
            with pytest.raises((MalformedMessage, struct.error)):
                extract(cut)


def test_definitions_are_read_as_ros_writes_them():
    text = """# a comment
uint8 MODE_A=1   # a constant
string NAME = a # b
Header header
float64[9] covariance  # nine
string<=10[<=3] names
Beam[<=4] beams
float32 gain 1.5
===
MSG: other_msgs/msg/Beam
int64 id
"""
    types = parse_definitions(text, "a_msgs/msg/A", "x")
    assert types["a_msgs/A"] == (
        ("header", "std_msgs/Header", None),
        ("covariance", "float64", 9),
        ("names", "string", -1),
        ("beams", "a_msgs/Beam", -1),
        ("gain", "float32", None),
    )
    assert types["other_msgs/Beam"] == (("id", "int64", None),)
    with pytest.raises(DatasetError, match="not a line of a message definition: '\\?\\?'"):
        parse_definitions("??", "a/A", "x")
    assert short_name("sensor_msgs/msg/Imu") == short_name("sensor_msgs/Imu") == "sensor_msgs/Imu"


def test_a_type_that_contains_itself_is_refused():
    types = parse_definitions("A a", "p/A", "x")
    with pytest.raises(DatasetError, match="p/A contains itself"):
        RosExtractor(types, "p/A", ["a.a"], "cdr", "x")


# ------------------------------------------------------------------------------------- bags that define no messages


def dvl_store() -> Any:
    """rosbags' types with the DVL messages that this package ships, from the same text."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, fields in shipped_definitions().items():
        if kind:
            lines = [f"{base}{'' if n is None else '[]' if n < 0 else f'[{n}]'} {name}" for name, base, n in fields]
            store.register(get_types_from_msg("\n".join(lines), kind.replace("/", "/msg/")))
    return store


def drop_definitions(folder: Path) -> None:
    """Leave the bag as older recorders do: without definitions of its messages."""
    with sqlite3.connect(folder / "bag" / "bag.db3") as database:
        database.execute("DROP TABLE message_definitions")
    database.close()


def write_dvl(folder: Path, kind: str, beams: list[int]) -> Any:
    """A bag of DVL messages in SQLite, without definitions."""
    store, rng = dvl_store(), np.random.default_rng(1)
    messages = []
    with Writer2(folder / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/dvl", kind, typestore=store)
        for i, count in enumerate(beams):
            message = some_message(store, kind, rng)
            if hasattr(message, "beams"):
                message.beams = [some_message(store, kind.replace("DVL", "DVLBeam"), rng) for _ in range(count)]
            messages.append(message)
            writer.write(connection, i * NS, store.serialize_cdr(message, kind))
    drop_definitions(folder)
    return messages


@pytest.mark.parametrize("kind", ["dvl_msgs/msg/DVL", "cola2_msgs/msg/DVL", "marine_acoustic_msgs/msg/Dvl"])
def test_common_dvl_messages_need_no_definition(tmp_path, kind):
    messages = write_dvl(tmp_path, kind, [4, 4])
    beam = "beam_velocity.1" if "marine" in kind else "beams.1.velocity"
    found = read(tmp_path, "/dvl", "velocity.y", beam, "header.stamp", file="bag")
    for column, values in found.items():
        assert values.tolist() == [at(message, column) for message in messages]
    assert found["header.stamp"].dtype == np.int64


def test_a_field_may_change_its_length_but_not_end_before_the_index(tmp_path):
    messages = write_dvl(tmp_path, "dvl_msgs/msg/DVL", [4, 5, 3, 2])
    found = read(tmp_path, "/dvl", "beams.1.distance", file="bag")
    assert found["beams.1.distance"].tolist() == [message.beams[1].distance for message in messages]
    with pytest.raises(DatasetError, match=r"/dvl: message 3: 'beams' has 2 elements"):
        read(tmp_path, "/dvl", "beams.2.distance", file="bag")


def test_an_unknown_type_names_the_option_that_helps(small, tmp_path):
    folder = write_ros2(small, tmp_path / "log")
    drop_definitions(folder)
    with pytest.raises(
        DatasetError, match=r"no definition of the type fathom_msgs/Reading; name its \.msg.*`definitions`"
    ):
        open_log(folder)
    held = {h.message: h for h in RosRecording(format="ros", file="bag").contents(folder)}
    assert (held["/dvl"].kind, held["/dvl"].fields) == ("fathom_msgs/Reading", ())
    assert "angular_velocity.x" in held["/imu"].fields
    (folder / "fathom_msgs" / "msg").mkdir(parents=True)
    (folder / "fathom_msgs" / "msg" / "Reading.msg").write_text(
        "std_msgs/Header header\nfloat64[] z\nfloat64[] sigma\n"
    )
    described = yaml.safe_load((folder / "log.yaml").read_text())
    described["recording"]["definitions"] = ["fathom_msgs/msg/Reading.msg"]
    (folder / "log.yaml").write_text(yaml.safe_dump(described))
    assert_the_same(small, open_log(folder))
    with pytest.raises(DatasetError, match="no ROS 2 distribution 'humbel'; did you mean 'humble'"):
        read(folder, "/imu", "angular_velocity.x", file="bag", distro="humbel")


def test_a_wrong_definition_is_reported_and_not_misread(small, tmp_path):
    folder = write_ros2(small, tmp_path / "log")
    drop_definitions(folder)
    (folder / "my.msg").write_text("MSG: fathom_msgs/Reading\nstd_msgs/Header header\nfloat64[] z\nfloat64[3] sigma\n")
    with pytest.raises(DatasetError, match="/dvl: 12 of 12 messages are not what fathom_msgs/Reading is defined as"):
        read(folder, "/dvl", "z.0", file="bag", definitions=("my.msg",))


# ------------------------------------------------------------------------------------------------- damage and errors


@pytest.fixture(scope="session")
def ros1(small, tmp_path_factory):
    return write_ros1(small, tmp_path_factory.mktemp("written") / "ros1")


def test_an_unfinished_bag_gives_what_is_whole_and_is_reported(log, tmp_path):
    folder = write_ros1(log, tmp_path / "log")
    assert_half_is_read_and_reported(log, folder, "log.bag", "cut off")


def test_a_cut_chunk_gives_its_whole_messages(small, ros1, tmp_path):
    folder = copied(ros1, tmp_path / "x")  # so short that it is one chunk
    data = (folder / "log.bag").read_bytes()
    (folder / "log.bag").write_bytes(data[: len(data) // 2])
    n = len(read(folder, "/imu", "log_time", file="log.bag")["log_time"])
    assert 0.3 < n / len(small.imu.t_ns) < 0.7


def test_a_bag_without_an_index_reads_like_one_with(small, ros1, tmp_path):
    folder = copied(ros1, tmp_path / "x")
    data = (folder / "log.bag").read_bytes()
    where = data.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack("<Q", data[where : where + 8])
    (folder / "log.bag").write_bytes(data[:where] + bytes(8) + data[where + 8 : index])
    back = open_log(folder)
    assert_the_same(small, back)
    assert "log.bag: the recorder did not finish (no index)" in back.notes


def test_a_damaged_chunk_is_passed_over_and_counted(log, tmp_path):
    folder = write_ros1(log, tmp_path / "log", "bz2")
    data = bytearray((folder / "log.bag").read_bytes())
    chunks = [i for i in range(len(data)) if data[i : i + 4] == b"BZh9"]
    assert len(chunks) > 2
    data[chunks[1] + 100] ^= 0xFF
    (folder / "log.bag").write_bytes(bytes(data))
    back = open_log(folder)
    assert 0 < len(back.imu.t_ns) < len(log.imu.t_ns)
    assert np.isin(back.imu.t_ns, log.imu.t_ns).all()
    assert any("log.bag: 1 damaged chunks" in note for note in back.notes)


def test_a_split_bag_is_read_in_its_parts(small, ros1, tmp_path):
    folder = copied(ros1, tmp_path / "x")
    store = ros_store(1)
    imu = store.types["sensor_msgs/msg/Imu"]
    with Writer1(folder / "second.bag") as writer:
        connection = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        message = some_message(store, imu.__msgtype__, np.random.default_rng(1))
        writer.write(connection, 99 * NS, store.serialize_ros1(message, imu.__msgtype__))
    found = read(folder, "/imu", "log_time", file="log.bag", more=("second.bag",))
    assert found["log_time"].tolist() == [*small.imu.t_ns.tolist(), 99 * NS]


@pytest.mark.parametrize(
    ("topic", "column", "error"),
    [
        ("/imuu", "header.stamp", "no topic '/imuu'; did you mean '/imu'"),
        ("/imu", "angular_velocity.w", "no numeric field of sensor_msgs/Imu called 'angular_velocity.w'; did you mean"),
        ("/imu", "header.frame_id", "no numeric field of sensor_msgs/Imu called 'header.frame_id'"),
        ("/imu", "orientation_covariance", "did you mean 'orientation_covariance.0'"),
        ("/imu", "orientation_covariance.9", "called 'orientation_covariance.9'"),
        ("/imu", "angular_velocity", "called 'angular_velocity'"),
    ],
)
def test_what_is_not_in_the_bag_is_named(ros1, topic, column, error):
    with pytest.raises(DatasetError, match=error):
        read(ros1, topic, column, file="log.bag")


@pytest.mark.parametrize("content", [b"", b"#ROSBAG V1.2\n", b"SQLite format 3\0" + bytes(900), bytes(4000)])
@pytest.mark.parametrize("name", ["x.bag", "x.db3", "x.mcap", "x.db3.zstd"])
def test_what_is_no_bag_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=name):
        read(tmp_path, "/imu", "log_time", file=name)
    with pytest.raises(DatasetError):
        read(tmp_path, "/imu", "log_time", file=".")


def test_a_missing_extra_is_named(ros1, tmp_path, monkeypatch, small):
    folder = write_ros2(small, tmp_path / "log")
    drop_definitions(folder)
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(DatasetError, match=r"pip install 'fathom-bench\[ros\]'"):
        open_log(folder)
    assert_the_same(small, open_log(ros1))  # needs nothing but Python where nothing is compressed


def test_messages_have_no_entity(ros1):
    with pytest.raises(DatasetError, match="topics have no `entity`"):
        RosRecording(format="ros", file="log.bag").read(ros1, [Wanted("/imu", 3, ("log_time",))])


def test_contents_lists_the_topics(small, ros1):
    held = {h.message: h for h in RosRecording(format="ros", file="log.bag").contents(ros1)}
    assert held.keys() == {"/imu", *(f"/{name}" for name in small.streams)}
    imu = held["/imu"]
    assert (imu.kind, imu.count) == ("sensor_msgs/Imu", len(small.imu.t_ns))
    assert imu.span_s == pytest.approx(np.ptp(small.imu.t_ns) * 1e-9)
    assert {"header.stamp", "orientation.w", "linear_acceleration_covariance.0"} <= set(imu.fields)


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 2])
def test_what_is_not_wanted_costs_no_memory(tmp_path, version):
    """160 MB of images around 8 MB of IMU samples; 3 columns of them are wanted."""
    store = ros_store(version)
    types, rng, n = store.types, np.random.default_rng(1), 20_000
    image = types["sensor_msgs/msg/CompressedImage"]
    message = some_message(store, "sensor_msgs/msg/Imu", rng)
    picture = some_message(store, "sensor_msgs/msg/CompressedImage", rng)
    picture.data = rng.integers(0, 255, 800_000).astype(np.uint8)
    if version == 1:
        writer, serialise = Writer1(tmp_path / "x"), store.serialize_ros1
    else:
        writer, serialise = Writer2(tmp_path / "x", version=9), store.serialize_cdr
    with writer:
        imu_data, image_data = serialise(message, "sensor_msgs/msg/Imu"), serialise(picture, image.__msgtype__)
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        camera = writer.add_connection("/camera", image.__msgtype__, typestore=store)
        for i in range(n):
            writer.write(imu, i * 1000, imu_data)
            if i % 100 == 0:
                writer.write(camera, i * 1000, image_data)
    read(tmp_path, "/imu", "log_time", file="x")  # imports
    with allocated() as peak:
        found = read(tmp_path, "/imu", "log_time", "header.stamp", "angular_velocity.x", file="x")
    wanted = sum(values.nbytes for values in found.values())
    assert wanted == n * 24
    assert peak() < 4 * wanted + 4_000_000  # a few chunks of the file, of which each holds an image


DAMAGED = ["ros1", "ros1-bz2", "sqlite", "metadata", "packed", "packed-messages", "journal"]


@pytest.fixture(scope="session")
def fuzzed(small, ros1, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzzed")
    bags = {"ros1": (copied(ros1, folder / "ros1"), "log.bag")}
    bags["ros1-bz2"] = (write_ros1(small, folder / "bz2", "bz2"), "log.bag")
    bags["sqlite"] = (write_ros2(small, folder / "sqlite"), "bag/bag.db3")
    bags["metadata"] = (write_ros2(small, folder / "metadata", "mcap"), "bag/metadata.yaml")
    bags["packed"] = (write_ros2(small, folder / "packed", "sqlite3", "file"), "bag/bag.db3.zstd")
    bags["packed-messages"] = (write_ros2(small, folder / "packed-messages", "sqlite3", "message"), "bag/bag.db3")
    write_ros2(small, folder / "closed")
    with sqlite3.connect(folder / "closed" / "bag" / "bag.db3") as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("UPDATE messages SET timestamp = timestamp + 1")
        database.commit()
        bags["journal"] = (copied(folder / "closed", folder / "journal"), "bag/bag.db3-wal")
    database.close()
    return {name: (folder, folder / file, (folder / file).read_bytes()) for name, (folder, file) in bags.items()}


@pytest.mark.slow
@settings(max_examples=80, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32), which=st.sampled_from(DAMAGED))
def test_a_damaged_bag_gives_a_log_or_an_error(fuzzed, seed, which):
    folder, file, data = fuzzed[which]
    file.write_bytes(damaged(data, seed))
    log_or_error(folder, repair=True)


# ------------------------------------------------------------------------------------------------------ a recorded one


def test_huskys_axes_are_the_vehicles(recording):
    """Gravity is felt upwards, the gyro turns with the wheels, the accelerometer with speed times yaw rate."""
    folder = recording("husky_rl_test1_2015")
    log = open_log("husky_rl_test1_2015", folder.parent)
    assert len(log.imu.t_ns) == 11_865
    R_BI = np.asarray(log.rig.imu.R_BS)
    f_B, w_B = log.imu.f_I @ R_BI.T, log.imu.w_WI_I @ R_BI.T
    assert abs(f_B[:, 2].mean() - 9.8) < 0.05
    odometry = RosRecording(format="ros", file="test1.bag").read(
        folder,
        [Wanted("/husky_velocity_controller/odom", None, ("header.stamp", "log_time", "twist.twist.angular.z"))],
    )
    wheels = odometry.columns[0]
    late_ns = 350_000_000
    rate = np.interp(wheels["header.stamp"] - late_ns, log.imu.t_ns, w_B[:, 2])
    assert np.corrcoef(rate, wheels["twist.twist.angular.z"])[0, 1] > 0.95
    speed = np.interp(log.imu.t_ns, log.dvl.t_ns, log.dvl.z[:, 0])
    second = np.ones(30) / 30
    felt, centripetal = np.convolve(f_B[:, 1], second, "same"), np.convolve(speed * w_B[:, 2], second, "same")
    assert 0.7 < np.polyfit(centripetal, felt, 1)[0] < 1.2
    assert 0.6 < np.polyfit(np.gradient(np.convolve(speed, second, "same"), log.imu.t_ns * 1e-9)[50:-50],
                            np.convolve(f_B[:, 0], second, "same")[50:-50], 1)[0] < 1.2  # fmt: skip
