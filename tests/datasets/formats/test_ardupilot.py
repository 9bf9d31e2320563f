"""Dataflash logs: read as pymavlink's own reader reads them, in chunks of any size, damaged or not."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fathom.datasets import DatasetError, Log
from fathom.datasets.described.opening import open_log
from fathom.datasets.formats import ardupilot as module
from fathom.datasets.formats.ardupilot import ArduPilotRecording
from fathom.datasets.formats.recording import Wanted
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import GpsSpec, ImuSpec
from hypothesis import given, settings
from hypothesis import strategies as st
from written import FUZZ
from written_ardupilot import MESSAGES, definition, head, message, units, write_ardupilot

FILE = "00000001.BIN"
IMU = ("TimeUS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")


@pytest.fixture(scope="module")
def voyage() -> Log:
    """20 s, 50 Hz, at the surface and under, starting at an hour of uptime."""
    scenario = Scenario(
        duration_s=20, imu=ImuSpec(rate_hz=50), surface_for_s=16, start_ns=3600 * 10**9, gps=GpsSpec(rate_hz=2)
    )
    return simulate(scenario, seed=5)


@pytest.fixture(scope="module")
def written(voyage: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ardupilot(voyage, tmp_path_factory.mktemp("ardupilot"))


def imu(i: int, instance: int = 0) -> bytes:
    return message("IMU", 1000 * i, instance, 0.1, 0.2, 0.3, i, 0.0, -9.8, 0, 0, 20.0, 1, 1, 1000, 1000)


def read(folder: Path, data: bytes, *wanted: Wanted) -> tuple[list[Any], tuple[str, ...]]:
    (folder / FILE).write_bytes(data)
    messages = ArduPilotRecording(format="ardupilot", file=FILE).read(folder, wanted)
    return list(messages.columns), messages.notes


def times(folder: Path, data: bytes) -> tuple[list[int], tuple[str, ...]]:
    columns, notes = read(folder, data, Wanted("IMU", 0, ("TimeUS",)))
    return (columns[0]["TimeUS"] // 1000).tolist(), notes


def test_a_simulated_log_comes_back_to_the_resolution_of_the_fields(voyage, written):
    log = open_log(written)
    np.testing.assert_array_equal(log.imu.t_ns, voyage.imu.t_ns)
    np.testing.assert_array_equal(log.imu.w_WI_I, voyage.imu.w_WI_I.astype(np.float32))
    np.testing.assert_array_equal(log.imu.f_I, voyage.imu.f_I.astype(np.float32))
    for name, tolerance in {"dvl": 1e-6, "depth": 1e-6, "gps": 0.008, "heading": 1e-4}.items():
        ours, theirs = log.streams[name], voyage.streams[name]
        np.testing.assert_array_equal(ours.t_ns, theirs.t_ns)
        turn = 2 * np.pi if name == "heading" else np.inf
        off = np.abs(ours.z - theirs.z)
        assert np.minimum(off, np.abs(turn - off)).max() < tolerance, name
        np.testing.assert_allclose(ours.sigma, theirs.sigma)
    assert log.truth is not None
    assert voyage.truth is not None
    np.testing.assert_array_equal(log.truth.t_ns, voyage.truth.t_ns)
    np.testing.assert_allclose(log.truth.p_WB_W, voyage.truth.p_WB_W, atol=0.008)
    np.testing.assert_allclose(log.truth.R_WB, voyage.truth.R_WB, atol=1e-6)
    assert not [note for note in log.notes if note.startswith("ardupilot")]


def test_every_number_is_pymavlinks(written):
    """pymavlink's own reader, message by message, against ours: all fields of all instances, to the bit."""
    mavutil = pytest.importorskip("pymavlink.mavutil")
    theirs: dict[tuple[str, int | None], list[Any]] = {}
    reader = mavutil.mavlink_connection(str(written / FILE))
    while (one := reader.recv_match()) is not None:
        instance = one.fmt.instance_field
        theirs.setdefault((one.get_type(), instance and getattr(one, instance)), []).append(one)
    reader.close()
    compared = 0
    recording = ArduPilotRecording(format="ardupilot", file=FILE)
    held = {(h.message, h.sender): h for h in recording.contents(written)}
    assert held.keys() == theirs.keys() - {("FMT", None)}
    for key in set(held) - {("FMTU", None), ("UNIT", None), ("MSG", None)}:
        columns = held[key].fields
        assert columns == tuple(theirs[key][0].get_fieldnames())
        ours = recording.read(written, [Wanted(*key, columns)]).columns[0]
        assert held[key].count == len(theirs[key])
        for column in columns:
            expected = [getattr(one, column) for one in theirs[key]]
            assert ours[column].tolist() == expected, (key, column)
            compared += 1
    assert compared > 80
    assert {("IMU", 0), ("IMU", 1), ("BARO", 1), ("GPS", 0), ("VISO", None)} <= held.keys()


def test_letters_that_a_simulation_has_no_use_for_are_read_as_pymavlink_reads_them(tmp_path):
    pytest.importorskip("pymavlink.DFReader")
    data = head() + message("ODD", 1.5, -3, -300, -(2**40), 19, 1e-300) + message("XKF1", 7, 1, -1.23, 4.5, 359.99,
        *[0.5] * 7, -0.01, 0.02, 0.03, -123.45)  # fmt: skip
    (odd, xkf), notes = read(tmp_path, data, Wanted("ODD", None, ("Half", "Byte", "Word", "Long", "Double")),
                             Wanted("XKF1", 1, ("TimeUS", "Roll", "Yaw", "OH")))  # fmt: skip
    assert notes == ()
    assert {name: value.tolist() for name, value in odd.items()} == {
        "Half": [1.5], "Byte": [-3], "Word": [-300], "Long": [-(2**40)], "Double": [1e-300]
    }  # fmt: skip
    assert odd["Long"].dtype.kind == "i"
    assert {name: value.tolist() for name, value in xkf.items()} == {
        "TimeUS": [7], "Roll": [-1.23], "Yaw": [359.99], "OH": [-123.45]
    }  # fmt: skip


def test_what_a_log_holds_is_named_by_name_and_instance(voyage, written):
    held = {(h.message, h.sender): h for h in ArduPilotRecording(format="ardupilot", file=FILE).contents(written)}
    assert list(held) == sorted(held, key=lambda key: (key[0], key[1] or 0))
    assert held["IMU", 1].count == len(voyage.imu.t_ns)
    assert held["IMU", 1].span_s == pytest.approx((voyage.imu.t_ns[-1] - voyage.imu.t_ns[0]) * 1e-9)
    assert held["IMU", 1].fields[:3] == ("TimeUS", "I", "GyrX")


def test_a_time_that_is_no_whole_number_spans_nothing(tmp_path):
    """A damaged letter makes the microseconds a float64, and these bits are no number."""
    data = head() + definition("ATT", letters="dccccCCCCB") + message("ATT", 2**64 - 1, *[0.0] * 8, 0)
    (tmp_path / FILE).write_bytes(data)
    held = {h.message: h for h in ArduPilotRecording(format="ardupilot", file=FILE).contents(tmp_path)}
    assert (held["ATT"].count, held["ATT"].span_s) == (1, 0.0)


@pytest.mark.parametrize("chunk_bytes", [1, 2, 3, 7, 64, 1000])
def test_chunks_of_any_size_give_the_same_messages(tmp_path, monkeypatch, chunk_bytes):
    junk = {7: b"junk", 12: b"\xa3", 20: b"\xa3\x95", 21: b"\xa3\x95\x00", 30: imu(99)[:40]}
    data = head() + b"".join(imu(i) + junk.get(i, b"") for i in range(40)) + b"\xa3"
    whole = times(tmp_path, data)
    assert whole[0] == [i for i in range(40) if i not in (7, 12)]
    monkeypatch.setattr(module, "CHUNK_BYTES", chunk_bytes)
    monkeypatch.setattr(module, "BATCH_BYTES", 100)
    assert times(tmp_path, data) == whole


def test_bytes_between_messages_are_passed_over_and_reported(tmp_path):
    data = head() + imu(1) + imu(2) + b"junk\xa3\x95\x00\xa3" + imu(3) + imu(4)
    values, notes = times(tmp_path, data)
    assert values == [1, 3, 4]  # message 2 has no other behind it: it may have been cut
    assert notes == (f"ardupilot: 1 stretches, {len(imu(2)) + 8} bytes, of no whole message skipped",)


def test_a_message_that_lost_its_tail_takes_no_bytes_of_the_next(tmp_path):
    data = head() + imu(1) + imu(2)[:-9] + imu(3) + imu(4)
    values, notes = times(tmp_path, data)
    assert values == [1, 3, 4]
    assert notes == (f"ardupilot: 1 stretches, {len(imu(2)) - 9} bytes, of no whole message skipped",)


@pytest.mark.parametrize("cut", [1, 2, 3, 30])
def test_a_truncated_tail_is_reported(tmp_path, cut):
    values, notes = times(tmp_path, head() + imu(1) + imu(2) + imu(3)[:cut])
    assert values == [1, 2]
    assert notes[0] == f"ardupilot: 1 stretches, {cut} bytes, of no whole message skipped"
    assert ("ardupilot: the file ends inside a message" in notes) == (cut >= 3)


def test_a_format_that_contradicts_itself_spoils_only_its_own_messages(tmp_path):
    """pymavlink's reader gives up on such a file."""
    broken = definition("BARO", length=0) + definition("ATT", letters="Qcc?cCCCCB") + definition("AHR2", columns="a,a")
    data = broken + head()[89:] + imu(1) + imu(2)
    assert times(tmp_path, data)[0] == [1, 2]
    assert "ardupilot: 3 FMT messages that contradict themselves skipped" in times(tmp_path, data)[1]


def test_a_kind_may_change_its_layout_on_the_way(tmp_path):
    """Two logs one behind the other: of an older firmware's IMU (float64), then of a newer's."""
    number = MESSAGES["IMU"][0]
    older = definition("IMU", letters="QBdddddd", columns="TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", length=3 + 57)
    rows = np.zeros(3, [("h", "V3"), ("t", "<u8"), ("i", "u1"), ("x", "<f8", 6)])
    rows["h"], rows["t"] = bytes([0xA3, 0x95, number]), [1000, 2000, 3000]
    data = head() + older + units("IMU") + rows.tobytes() + definition("IMU") + units("IMU") + imu(4) + imu(5)
    assert times(tmp_path, data) == ([1, 2, 3, 4, 5], ())


def test_without_units_a_field_called_i_is_the_instance(tmp_path):
    data = definition("FMT") + definition("IMU") + imu(1) + imu(2, 1) + imu(3)
    assert times(tmp_path, data) == ([1, 3], ())


@pytest.mark.parametrize(
    ("want", "error"),
    [
        (Wanted("IMUU", None, ("TimeUS",)), "no message 'IMUU'; did you mean 'IMU'"),
        (Wanted("BARO", None, ("TimeUS",)), "no message 'BARO'"),
        (Wanted("IMU", 0, ("GyrXX",)), "no field of IMU called 'GyrXX'; did you mean 'GyrX'.*found AH"),
        (Wanted("IMU", 7, ("TimeUS",)), r"no IMU from instance 7; it comes from \[0, 1\]"),
        (Wanted("IMU", None, ("TimeUS",)), r"IMU comes from instances \[0, 1\]; choose one, as `entity`"),
        (Wanted("ATT", 0, ("Yaw",)), "ATT has no instances; leave `entity` out"),
        (Wanted("MSG", None, ("Message",)), "MSG.Message is not a number"),
        (Wanted("ISBD", None, ("x",)), "ISBD.x is not a number"),
    ],
)
def test_what_is_not_in_the_log_is_named(tmp_path, want, error):
    att = message("ATT", 1, *[0.0] * 8, 0)
    data = head() + message("MSG", 0, "hello") + message("ISBD", 1, 2, 3, *[bytes(64)] * 3) + imu(1) + imu(2, 1) + att
    with pytest.raises(DatasetError, match=error) as caught:
        read(tmp_path, data, want)
    assert str(caught.value).startswith(str(tmp_path / FILE))


@pytest.mark.parametrize("data", [b"", b"\xa3", b"\xa3\x95\x80" * 50, b"not a log at all " * 99, imu(1)])
def test_what_is_no_log_is_called_so(tmp_path, data):
    with pytest.raises(DatasetError, match=rf"{FILE}: contains no whole dataflash message"):
        times(tmp_path, data)


def test_a_file_that_is_not_there_is_named(written):
    with pytest.raises(DatasetError, match=r"no such file; did you mean '00000001\.BIN'"):
        ArduPilotRecording(format="ardupilot", file="00000002.BIN").contents(written)
    with pytest.raises(DatasetError, match="cannot be opened"):
        ArduPilotRecording(format="ardupilot", file=".").contents(written)


MEASURE = """
import resource, sys
from pathlib import Path
from fathom.datasets.formats.ardupilot import ArduPilotRecording
from fathom.datasets.formats.recording import Wanted
import pymavlink.DFReader
loader = ArduPilotRecording(format="ardupilot", file="big.BIN")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
columns = loader.read(Path(sys.argv[1]), [Wanted("BARO", 1, ("TimeUS", "Alt"))]).columns[0]
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) * (1 if sys.platform == "darwin" else 1024), len(columns["Alt"]))
"""


@pytest.mark.slow
def test_memory_is_that_of_what_is_wanted(tmp_path):
    """40 MB of log of which 0.1 MB is wanted: the file is neither held nor indexed."""
    other = b"".join(imu(i) for i in range(1000))
    wanted = b"".join(message("BARO", i, 1, 1.5, 1.0, 2.0, 0.0, 7, 0.0, 20.0, 1) for i in range(10))
    with (tmp_path / "big.BIN").open("wb") as file:
        file.write(head())
        for _ in range(700):
            file.write(other + wanted)
    size = (tmp_path / "big.BIN").stat().st_size
    ran = subprocess.run([sys.executable, "-c", MEASURE, str(tmp_path)], capture_output=True, text=True, check=True)
    grown, rows = map(int, ran.stdout.split())
    assert rows == 7000
    assert grown < 12e6 < size / 3


@pytest.fixture(scope="module")
def short(voyage: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The voyage's first two seconds."""
    end_ns = voyage.imu.t_ns[0] + 2 * 10**9

    def cut(stream: Any) -> Any:
        rows = stream.t_ns < end_ns
        return dataclasses.replace(stream, **{k: v[rows] for k, v in vars(stream).items() if isinstance(v, np.ndarray)})

    parts = {name: cut(getattr(voyage, name)) for name in ("imu", "dvl", "depth", "gps", "heading", "truth")}
    return write_ardupilot(dataclasses.replace(voyage, prior=None, **parts), tmp_path_factory.mktemp("short"))


def opens_or_says_why(folder: Path) -> None:
    try:
        ArduPilotRecording(format="ardupilot", file=FILE).contents(folder)
        log = open_log(folder, repair=True)
    except DatasetError as error:
        assert str(folder) in str(error)  # noqa: PT017  (either way will do)
        return
    assert isinstance(log, Log)


@pytest.mark.slow
@settings(FUZZ, max_examples=100)
@given(data=st.data())
def test_a_damaged_log_gives_a_log_or_an_error(short, data, capsys):
    raw = (short / FILE).read_bytes()
    in_head = data.draw(st.booleans())
    at = data.draw(st.integers(0, len(head()) if in_head else len(raw)))
    cut = data.draw(st.sampled_from([0, 1, 3, 50, 1000, 10**6]))
    junk = data.draw(st.one_of(st.binary(max_size=12), st.sampled_from([b"\xa3\x95\x80" * 40, bytes(2000)])))
    folder = short / "damaged"
    folder.mkdir(exist_ok=True)
    (folder / FILE).write_bytes(raw[:at] + junk + raw[at + cut :])
    (folder / "log.yaml").write_bytes((short / "log.yaml").read_bytes())
    opens_or_says_why(folder)
    assert capsys.readouterr() == ("", "")
