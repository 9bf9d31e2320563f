"""Anybody's files, described by a log.yaml, become a log in our frames and units; what is wrong is named."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import Belief, DatasetError, ImuNoise, Log, Mounting, NavState, Rig, Trajectory
from fathom.datasets.described.folder import write_folder
from fathom.datasets.described.opening import RecordingNotFound, catalog_names, open_log
from fathom.datasets.described.order import stray
from fathom.datasets.log import AttitudeStream, DepthStream, DvlStream, GpsStream, HeadingStream, ImuStream
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from written import FUZZ, log_or_error

NOISE = {
    "gyro_density": 1e-4, "accel_density": 1e-3, "gyro_walk": 1e-6, "accel_walk": 1e-5, "gyro_bias_sigma": 1e-3,
    "accel_bias_sigma": 1e-2,
}  # fmt: skip
DESCRIPTION: dict[str, Any] = {
    "streams": {
        "imu": {
            "table": {"file": "imu.txt", "delimiter": "whitespace", "comment": "%", "header": False},
            "time": {"column": 0},
            "gyro": {"columns": [1, 2, 3], "unit": "deg/s"},
            "accel": {"columns": [4, 5, 6], "unit": "g"},
            "axes": "FRD",
            "noise": NOISE,
        },
        "dvl": {
            "table": {"file": "dvl.csv"},
            "time": {"column": "stamp_ms", "unit": "ms", "delay_s": 0.25, "clock_offset_s": 1.0},
            "velocity": {"columns": ["vx", "vy", "vz"], "unit": "cm/s"},
            "axes": "FRD",
            "valid": {"column": "ok", "values": [1, 3]},
            "outliers": {"above": 2.0, "components": [0, 1]},
            "sigma_m_s": [0.01, 0.01, 0.02],
        },
        "depth": {
            "table": {"file": "depth.csv"},
            "time": {"row_rate_hz": 4, "start_s": 100},
            "depth": {"columns": ["counts"], "unit": "cm", "scale": 0.5, "offset": -10},
            "sigma_m": 0.01,
            "every": 2,
        },
        "gps": {
            "table": {"file": "gps.csv", "delimiter": ";"},
            "time": {"column": "t"},
            "geodetic": {"latitude": "lat", "longitude": "lon", "unit": "ddmm"},
            "sigma_m": 2.0,
        },
        "heading": {
            "table": {"file": "heading.csv"},
            "time": {"column": "t"},
            "heading": {"columns": ["deg"], "unit": "deg"},
            "add_deg": -3.0,
            "sigma_deg": 2.0,
            "mounting": {"yaw_deg": 90.0, "translation_m": [0.1, 0.2, 0.3]},
        },
    },
    "truth": {
        "table": {"file": "gps.csv", "delimiter": ";"},
        "time": {"column": "t"},
        "geodetic": {"latitude": "lat", "longitude": "lon", "unit": "ddmm"},
        "height_m": -1.0,
    },
}
FILES = {
    "imu.txt": "% gyro deg/s, accel g\n" + "".join(f"{100 + i / 10:.3f}\t 90 180  0 0.5 0 -1 \r\n" for i in range(20)),
    "dvl.csv": "stamp_ms,vx,vy,vz,ok\n99500,100,50,10,1\n99750,100,50,10,0\n100000.5,300,0,0,1\n100250,-20,nan,0,2\n"
    "100500,150,-50,-10,3\n",
    "depth.csv": "counts\n20\n40\n60\n80\n100\n",
    "gps.csv": "t;lat;lon\n99.0;4212.0000;306.0000\n100.5;4212.0600;306.0000\n101.5;4212.0600;306.0600\n",
    "heading.csv": "t,deg\n100.0,3\n100.5,93\n101.0,183\n",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, newline="")
    describe(tmp_path, {})
    return tmp_path


def describe(folder: Path, changes: dict[str, Any]) -> Path:
    """Write DESCRIPTION with changes by dotted key; None takes a key out."""
    described = copy.deepcopy(DESCRIPTION)
    for path, value in changes.items():
        *parents, last = path.split(".")
        part = described
        for key in parents:
            part = part[key]
        if value is None:
            part.pop(last, None)
        else:
            part[last] = value
    (folder / "log.yaml").write_text(yaml.safe_dump(described))
    return folder


def some_log(seed: int, *, attitude: bool = False) -> Log:
    """A log of random numbers, with everything a log can have."""
    rng = np.random.default_rng(seed)
    n, t0 = 40, 1_700_000_000_123_456_789

    def mounting() -> Mounting:
        return Mounting(Rotation.random(random_state=rng.integers(99)).as_matrix(), rng.normal(size=3))

    def times(k: int) -> Any:
        return t0 + np.cumsum(rng.integers(1, 10**9, k))

    def stream(kind: Any, k: int) -> Any:
        t_ns = times(k)
        z, sigma = rng.normal(size=(k, kind.width)), rng.uniform(0.1, 1, (k, kind.residual_width))
        if kind is AttitudeStream:
            z = Rotation.random(k, random_state=3).as_matrix().reshape(k, 9)
        z.flat[0] = z.flat[0] if kind is AttitudeStream else -0.0
        if kind is GpsStream:
            sigma[:, 2] = np.inf
        return kind(t_ns, t_ns + rng.integers(0, 10**9, k), z, sigma)

    R = Rotation.random(n, random_state=7).as_matrix()
    P = np.array([rng.normal(size=(15, 15)) for _ in range(n)])
    P = P + P.transpose(0, 2, 1)
    truth = Trajectory(times(n), R, *(rng.normal(size=(n, 3)) for _ in range(4)), P, lookahead_s=np.inf)
    state = NavState(R[0], *(rng.normal(size=3) for _ in range(4)))
    root = rng.normal(size=(15, 15))
    return Log(
        name="some: log",
        rig=Rig(ImuNoise(*rng.uniform(1e-6, 1, 6)), mounting(), mounting(), mounting(), mounting(), 9.8123456789),
        imu=ImuStream(times(n), rng.normal(size=(n, 3)) * 1e-7, rng.normal(size=(n, 3)) * 1e3),
        dvl=stream(DvlStream, 9),
        depth=stream(DepthStream, 8),
        gps=stream(GpsStream, 7),
        heading=stream(AttitudeStream if attitude else HeadingStream, 6),
        truth=truth,
        truth_kind="reference",
        prior=Belief(t0, state, root @ root.T),
        notes=("one: of ümlauts, 'quotes'", "two"),
        origin=(41.123456789012345, -8.7),
        max_wait_s=7.5,
    )


def arrays_of(log: Log) -> dict[str, Any]:
    """Every array and number of a log, by name."""
    found: dict[str, Any] = {f"imu.{k}": v for k, v in vars(log.imu).items()}
    for name, stream in log.streams.items():
        found |= {f"{name}.{k}": v for k, v in vars(stream).items()}
    for part in ("imu", "depth", "gps", "heading"):
        found |= {f"rig.{part}.{k}": v for k, v in vars(getattr(log.rig, part)).items()}
    found |= {f"noise.{k}": v for k, v in vars(log.rig.imu_noise).items()}
    found["gravity"] = log.rig.gravity
    if log.truth is not None:
        found |= {f"truth.{k}": v for k, v in vars(log.truth).items() if v is not None}
    if log.prior is not None:
        found |= {f"prior.{k}": v for k, v in vars(log.prior.state).items()}
        found |= {"prior.P": log.prior.P, "prior.t_ns": log.prior.t_ns}
    return found


@pytest.mark.parametrize("fmt", ["parquet", "csv"])
@pytest.mark.parametrize("attitude", [False, True])
def test_a_written_folder_opens_to_the_same_bits(tmp_path, fmt, attitude):
    log = some_log(3, attitude=attitude)
    again = open_log(write_folder(log, tmp_path / "log", fmt))
    before, after = arrays_of(log), arrays_of(again)
    assert before.keys() == after.keys()
    for name, value in before.items():
        a, b = np.asarray(value), np.asarray(after[name])
        assert a.dtype == b.dtype, name
        assert a.tobytes() == b.tobytes(), name
    assert (log.name, log.notes, log.origin, log.truth_kind, log.max_wait_s) == (
        again.name, again.notes, again.origin, again.truth_kind, again.max_wait_s
    )  # fmt: skip
    assert type(again.heading) is type(log.heading)


def test_a_log_without_extras_stays_without_them(tmp_path):
    full = some_log(4)
    log = Log(name="bare", rig=full.rig, imu=full.imu)
    again = open_log(write_folder(log, tmp_path))
    assert (again.streams, again.truth, again.prior, again.origin, again.notes) == ({}, None, None, None, ())


def test_units_axes_and_delimiters_are_converted_at_the_door(folder):
    log = open_log(folder)
    assert log.name == folder.name
    np.testing.assert_array_equal(log.imu.t_ns[:3], [100_000_000_000, 100_100_000_000, 100_200_000_000])
    np.testing.assert_allclose(log.imu.w_WI_I[0], [np.pi / 2, -np.pi, 0])
    np.testing.assert_allclose(log.imu.f_I[0], [4.903325, 0, 9.80665])


def test_a_delayed_stamp_is_the_reception_and_the_row_was_true_before(folder):
    dvl = open_log(folder).dvl
    assert dvl is not None
    np.testing.assert_array_equal(dvl.received_ns, [100_500_000_000, 101_500_000_000])
    np.testing.assert_array_equal(dvl.received_ns - dvl.t_ns, [250_000_000] * 2)


def test_invalid_rows_and_outliers_are_dropped_and_counted_without_repair(folder):
    log = open_log(folder)
    assert log.dvl is not None
    np.testing.assert_allclose(log.dvl.z, [[1.0, -0.5, -0.1], [1.5, 0.5, 0.1]])
    assert "dvl: 2 rows invalid dropped" in log.notes
    assert "dvl: 1 rows over 2 m/s dropped" in log.notes


def test_rows_can_be_timed_by_their_index_scaled_and_decimated(folder):
    depth = open_log(folder).depth
    assert depth is not None
    np.testing.assert_array_equal(depth.t_ns, [100_000_000_000, 100_500_000_000, 101_000_000_000])
    np.testing.assert_allclose(depth.z[:, 0], [0.0, -0.2, -0.4], atol=1e-15)


def test_a_compass_becomes_yaw_with_its_declination(folder):
    heading = open_log(folder).heading
    assert heading is not None
    np.testing.assert_allclose(heading.z[:, 0], np.radians([90.0, 0.0, -90.0]), atol=1e-12)
    np.testing.assert_allclose(heading.sigma, np.radians(2.0))


def test_a_mounting_in_degrees_takes_the_sensors_axes_to_the_body(folder):
    mounting = open_log(folder).rig.heading
    np.testing.assert_allclose(mounting.R_BS @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_array_equal(mounting.p_BS_B, [0.1, 0.2, 0.3])


def test_the_origin_is_the_first_fix_after_the_imu_starts(folder):
    log = open_log(folder)
    assert log.gps is not None
    assert log.truth is not None
    np.testing.assert_allclose(log.origin, [42.201, 3.1])
    np.testing.assert_allclose(log.gps.z, [[0, -111.07, 0], [0, 0, 0], [82.6, 0, 0]], atol=0.1)
    assert np.isinf(log.gps.sigma[:, 2]).all()
    np.testing.assert_array_equal(log.truth.p_WB_W[:, 2], -1.0)
    assert np.isnan(log.truth.R_WB).all()


def test_a_given_origin_is_used(folder):
    describe(folder, {"origin": {"latitude_deg": 42.2, "longitude_deg": 3.1}})
    log = open_log(folder)
    assert log.gps is not None
    assert log.origin == (42.2, 3.1)
    np.testing.assert_allclose(log.gps.z[0], [0, 0, 0], atol=1e-6)


def test_ned_positions_become_enu(folder):
    (folder / "local.csv").write_text("t,n,e,d\n100,1,2,3\n101,4,5,6\n")
    local = {"table": {"file": "local.csv"}, "time": {"column": "t"}, "frame": "NED",
             "position": {"columns": ["n", "e", "d"], "unit": "m"}}  # fmt: skip
    describe(folder, {"truth": local, "streams.gps": {**local, "sigma_m": 1.0}})
    log = open_log(folder)
    assert log.truth is not None
    assert log.gps is not None
    np.testing.assert_array_equal(log.truth.p_WB_W, [[2, 1, -3], [5, 4, -6]])
    np.testing.assert_array_equal(log.gps.z, log.truth.p_WB_W)


@pytest.mark.parametrize("form", ["roll_pitch_yaw", "quaternion_wxyz", "quaternion_xyzw", "matrix"])
def test_every_form_of_attitude_tells_the_same_and_ned_becomes_enu(folder, form):
    # nose east, 20° up, rolled 10° to starboard: said in NED/FRD, expected in ENU/FLU
    roll, pitch, yaw = np.radians([10.0, 20.0, 90.0])
    R_ned = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    q = R_ned.as_quat()
    values = {"roll_pitch_yaw": [roll, pitch, yaw], "quaternion_xyzw": q, "quaternion_wxyz": np.roll(q, 1),
              "matrix": R_ned.as_matrix().ravel()}[form]  # fmt: skip
    (folder / "a.csv").write_text("100," + ",".join(map(repr, map(float, values))) + "\n")
    attitude = {"columns": [*range(1, len(values) + 1)], "form": form, "world": "NED", "axes": "FRD"}
    table = {"file": "a.csv", "header": False}
    part = {"table": table, "time": {"column": 0}, "sigma_deg": 1.0, "attitude": attitude}
    describe(folder, {"streams.heading": part})
    heading = open_log(folder).heading
    assert isinstance(heading, AttitudeStream)
    R_WH = heading.z.reshape(3, 3)
    forward = [np.cos(pitch), 0, np.sin(pitch)]
    np.testing.assert_allclose(R_WH[:, 0], forward, atol=1e-9)
    assert R_WH[2, 1] == pytest.approx(np.cos(pitch) * np.sin(roll))  # port side up


def test_a_tum_file_can_be_the_truth(folder):
    (folder / "truth.tum").write_text("100.5 1 2 3 0 0 0 1\n101.5 2 2 3 0 0 1 0\n")
    describe(folder, {"truth": {"tum": "truth.tum", "kind": "reference"}})
    log = open_log(folder)
    assert log.truth is not None
    assert log.truth_kind == "reference"
    np.testing.assert_array_equal(log.truth.p_WB_W[:, 0], [1, 2])


WRONG: list[tuple[dict[str, Any], str]] = [
    (
        {"streams.dvl.velocty": {"columns": [1], "unit": "m/s"}},
        r"unknown key `streams.dvl.velocty`; did you mean 'velocity'",
    ),
    ({"streems": {}}, r"unknown key `streems`; did you mean 'streams'"),
    ({"streams.imu": None}, r"missing key `streams.imu`"),
    ({"streams.imu.noise.gyro_density": None}, r"missing key `streams.imu.noise.gyro_density`"),
    ({"streams.dvl.velocity.unit": "cm/sec"}, r"streams.dvl.velocity.*unknown unit 'cm/sec'.*did you mean 'cm/s'"),
    ({"streams.dvl.velocity.columns": ["vx", "vy"]}, r"expected 3 columns, found 2"),
    ({"streams.dvl.time.column": "stamp"}, r"dvl.csv: no column 'stamp'; did you mean 'stamp_ms'.*found stamp_ms, vx"),
    ({"streams.imu.gyro.columns": [1, 2, 30]}, r"imu.txt: no column 30.*found 0, 1"),
    ({"streams.dvl.table.file": "dlv.csv"}, r"dlv.csv: no such file; did you mean 'dvl.csv'"),
    ({"streams.dvl.axes": "RFU"}, r"streams.dvl.axes.*'FLU' or 'FRD'.*RFU"),
    ({"streams.dvl.sigma_m_s": -1.0}, r"streams.dvl.sigma_m_s"),
    (
        {"streams.dvl.sigma_m_s": None},
        r"streams.dvl.*give one of `sigma_m_s`, `sigma` \(columns\) and `variance` \(columns\)",
    ),
    ({"streams.dvl.table.encoding": "utf-99"}, r"unknown encoding 'utf-99'"),
    ({"streams.dvl.time.unit": "min"}, r"streams.dvl.time.unit"),
    ({"streams.dvl.time.row_rate_hz": 5}, r"give one of `column` and `row_rate_hz`"),
    ({"streams.dvl.message": {"names": ["GroundVelocity"]}}, r"give one of `table` and `message`"),
    ({"truth.height_m": None}, r"no height"),
    ({"truth.tum": "truth.tum"}, r"give one of `tum`"),
    ({"truth": {"tum": "none.tum"}}, r"none.tum: no such file"),
    ({"truth": {"trajectory": "none.csv"}}, r"none.csv: no such file"),
    ({"truth": {"trajectory": "gps.csv"}}, r"gps.csv"),
    ({"gravity": -9.81}, r"gravity must be in m/s² and positive"),
    ({"origin": {"latitude_deg": 91, "longitude_deg": 0}}, r"origin.latitude_deg"),
    ({"streams.dvl.time.clock_offset_s": 1e300}, r"streams.dvl.time.clock_offset_s.*less than"),
    ({"streams.dvl.time.delay_s": 1e300}, r"streams.dvl.time.delay_s.*less than"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[next(iter(c)) + f"-{i}" for i, (c, _) in enumerate(WRONG)])
def test_what_is_wrong_in_a_description_is_named(folder, changes, message):
    describe(folder, changes)
    with pytest.raises(DatasetError, match=message):
        open_log(folder)


@pytest.mark.parametrize("bad", ["nan", "inf", "", "-inf"])
def test_a_number_that_is_not_finite_is_refused_or_repaired(folder, bad):
    (folder / "depth.csv").write_text(f"counts,x\n20,1\n40,1\n{bad},1\n80,1\n")
    with pytest.raises(DatasetError, match=r"depth: row 2 \(1 in all\): column 'counts' is -?(nan|inf).*--repair"):
        open_log(folder)
    log = open_log(folder, repair=True)
    assert any(note.startswith("depth: 1 rows not finite (repair)") for note in log.notes)


@pytest.mark.parametrize(("stamp", "how"), [("100.0", "repeats"), ("99.5", "comes before")])
def test_times_out_of_order_are_refused_or_repaired(folder, stamp, how):
    (folder / "heading.csv").write_text(f"t,deg\n99.0,3\n100.0,3\n{stamp},93\n101.0,183\n")
    with pytest.raises(DatasetError, match=rf"heading: row 2 \(1 in all\): time \d+ ns {how} the row above.*--repair"):
        open_log(folder)
    log = open_log(folder, repair=True)
    assert len(log.streams["heading"]) == 3
    np.testing.assert_allclose(log.streams["heading"].z[:, 0], np.radians([90, 90, -90]), atol=1e-12)
    assert "heading: 1 rows out of order (repair) dropped" in log.notes


@pytest.mark.parametrize("stamp", ["soon", "nan", "1e99", "1e999999999"])
def test_a_time_that_is_none_is_refused_or_repaired(folder, stamp):
    (folder / "heading.csv").write_text(f"t,deg\n100.0,3\n{stamp},93\n101.0,183\n")
    with pytest.raises(DatasetError, match=r"heading: row 1 \(1 in all\): time is"):
        open_log(folder)
    assert len(open_log(folder, repair=True).streams["heading"]) == 2


def test_text_among_numbers_is_named_with_its_row(folder):
    (folder / "depth.csv").write_text("counts\n20\nforty\n")
    with pytest.raises(
        DatasetError, match=r"depth: row 1 \(1 in all\): column 'counts' holds 'forty', not a number; --repair"
    ):
        open_log(folder)


def test_a_quaternion_that_is_none_is_refused_or_repaired(folder):
    (folder / "a.csv").write_text("100,0,0,0,1\n101,0,0,0,2\n102,0,0,1,0\n")
    part = {"table": {"file": "a.csv", "header": False}, "time": {"column": 0}, "sigma_deg": 1.0,
            "attitude": {"columns": [1, 2, 3, 4], "form": "quaternion_xyzw"}}  # fmt: skip
    describe(folder, {"streams.heading": part})
    with pytest.raises(DatasetError, match=r"heading: row 1 \(1 in all\): not a unit quaternion \(\|q\| = 2\)"):
        open_log(folder)
    log = open_log(folder, repair=True)
    np.testing.assert_array_equal(log.streams["heading"].t_ns, [100_000_000_000, 102_000_000_000])


def test_two_columns_of_one_name_are_refused(folder):
    (folder / "depth.csv").write_text("counts, counts\n20,1\n")
    with pytest.raises(DatasetError, match="2 columns are named 'counts'"):
        open_log(folder)


def test_rows_may_end_in_a_delimiter_but_not_have_more_fields_than_the_header(folder):
    (folder / "heading.csv").write_text("t,deg\n100.0,3,\n100.5,93,\n")
    assert len(open_log(folder).streams["heading"]) == 2
    (folder / "heading.csv").write_text("t,deg\n100.0,3,7\n100.5,93,\n")
    with pytest.raises(DatasetError, match="header names 2 columns, the rows have 3"):
        open_log(folder)


def test_a_truth_without_a_place_is_refused(folder):
    truth = some_log(6).truth
    assert truth is not None
    table = truth.to_pandas()
    table.loc[3, "p_WB_W_y"] = np.nan
    table.to_csv(folder / "truth.csv", index=False)
    describe(folder, {"truth": {"trajectory": "truth.csv"}})
    with pytest.raises(DatasetError, match=r"truth.csv: row 3 \(1 in all\): position is"):
        open_log(folder)


def test_bytes_of_another_encoding_are_named(folder):
    (folder / "depth.csv").write_bytes(b"counts\n20\n# caf\xe9\n")
    with pytest.raises(DatasetError, match=r"depth.csv: byte 15 is not utf-8.*latin-1"):
        open_log(folder)
    describe(folder, {"streams.depth.table.encoding": "latin-1", "streams.depth.table.comment": "#"})
    assert len(open_log(folder).streams["depth"]) == 1


def test_an_unknown_name_gets_its_nearest():
    with pytest.raises(DatasetError, match="no such log; did you mean 'ictineu_stpere_2004'"):
        open_log("ictineu_st_pere_2004")


def test_a_folder_without_a_description_is_reported(tmp_path):
    with pytest.raises(DatasetError, match=r"no log\.yaml in this folder"):
        open_log(tmp_path)


def test_a_recording_that_is_not_there_is_its_own_error(tmp_path, monkeypatch):
    monkeypatch.delenv("FATHOM_DATA", raising=False)
    for name in catalog_names():
        with pytest.raises(RecordingNotFound, match="use --data DIR or set FATHOM_DATA"):
            open_log(name)
        with pytest.raises(RecordingNotFound, match=f"no folder {tmp_path}/{name}"):
            open_log(name, tmp_path)
        monkeypatch.setenv("FATHOM_DATA", str(tmp_path / "x"))
        with pytest.raises(RecordingNotFound, match="FATHOM_DATA"):
            open_log(name)
        monkeypatch.delenv("FATHOM_DATA")


def test_a_description_elsewhere_describes_files_in_place(folder, tmp_path_factory):
    away = tmp_path_factory.mktemp("away") / "mine.yaml"
    away.write_text((folder / "log.yaml").read_text())
    assert len(open_log(away, folder).imu.t_ns) == 20


def test_bytes_of_utf16_are_called_so(folder):
    (folder / "depth.csv").write_text("counts\n20\n", encoding="utf-16")
    with pytest.raises(DatasetError, match=r"depth.csv: byte 0 is not utf-8; set `encoding` \(utf-16\?\)"):
        open_log(folder)
    describe(folder, {"streams.depth.table.encoding": "utf-16"})
    assert len(open_log(folder).streams["depth"]) == 1


def test_a_folder_that_holds_a_log_is_not_written_over(tmp_path):
    log = some_log(8)
    (tmp_path / "gps.parquet").write_text("mine")
    with pytest.raises(DatasetError, match=r"holds a gps.parquet already"):
        write_folder(log, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["gps.parquet"]
    (tmp_path / "gps.parquet").unlink()
    write_folder(log, tmp_path, "csv")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(DatasetError, match=r"holds a log.yaml already"):
        write_folder(some_log(9), tmp_path)
    assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}


def test_nothing_is_written_through_a_link_and_nothing_stays_of_what_fails(tmp_path, monkeypatch):
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "dvl.parquet").symlink_to(tmp_path / "elsewhere.parquet")
    with pytest.raises(DatasetError, match=r"holds a dvl.parquet already"):
        write_folder(some_log(8), tmp_path / "log")
    (tmp_path / "log" / "dvl.parquet").unlink()
    monkeypatch.setattr("yaml.safe_dump", lambda *_, **__: "\udc80")  # the last file cannot be written
    with pytest.raises(UnicodeEncodeError):
        write_folder(some_log(8), tmp_path / "log")
    assert not [*(tmp_path / "log").iterdir(), *tmp_path.glob("elsewhere*")]


PRIOR: dict[str, Any] = {
    "t_ns": 100 * 10**9,
    "R_WB": np.eye(3).tolist(),
    **{name: [0.0, 0.0, 0.0] for name in ("p_WB_W", "v_WB_W", "b_a", "b_g")},
    "P": np.diag([1e-6, 0.0, 1e6] * 5).tolist(),
}


def damaged(row: int, column: int, value: float) -> Any:
    P = np.array(PRIOR["P"])
    P[row, column] = value
    return P.tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R_WB": np.diag([1.0, 1.0, -1.0]).tolist()}, "R_WB is not a rotation"),
        ({"P": damaged(0, 0, -1e-6)}, "P is not symmetric and positive semi-definite"),
        ({"P": damaged(0, 2, 0.1)}, "P is not symmetric and positive semi-definite"),
        ({"P": (1e-6 * (2 * np.eye(15) - 1)).tolist()}, "P is not symmetric and positive semi-definite"),
        ({"P": damaged(3, 3, float("nan"))}, r"prior.P\[3\]\[3\]"),
        ({"t_ns": 10**30}, "prior.t_ns"),
        ({"t_ns": 102 * 10**9}, r"prior: t_ns, 102.000 s, lies outside the IMU's time, 100.000 s to 101.900 s"),
        ({"t_ns": 99 * 10**9}, r"prior: t_ns, 99.000 s, lies outside the IMU's time"),
    ],
)
def test_a_prior_that_cannot_be_is_refused_and_one_with_zeros_is_not(folder, change, message):
    describe(folder, {"prior": PRIOR})
    prior = open_log(folder).prior
    assert prior is not None
    np.testing.assert_array_equal(prior.P, PRIOR["P"])
    describe(folder, {"prior": PRIOR | change})
    with pytest.raises(DatasetError, match=message):
        open_log(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"streams.dvl.time.clock_offset_s": 1000.0},
            "dvl: 1099.250 s to 1100.250 s lies wholly outside the IMU's time",
        ),
        ({"streams.heading.time.unit": "ms"}, "heading: 0.100 s to 0.101 s lies wholly outside the IMU's time"),
        ({"truth": {"tum": "late.tum"}}, "truth: 1100.500 s to 1101.500 s lies wholly outside the IMU's time"),
    ],
)
def test_a_clock_that_shares_no_time_with_the_imu_is_refused(folder, changes, message):
    (folder / "late.tum").write_text("1100.5 1 2 3 0 0 0 1\n1101.5 2 2 3 0 0 1 0\n")
    describe(folder, changes)
    with pytest.raises(DatasetError, match=message + r", 100.000 s to 101.900 s; .*clock_offset_s.*unit") as error:
        open_log(folder)
    assert str(error.value).startswith(str(folder))


def test_the_window_of_the_log_and_that_of_a_stream_count_from_the_first_imu_sample(folder):
    whole = open_log(folder)
    describe(folder, {"from_s": 0.5, "until_s": 1.5, "streams.heading.until_s": 0.9, "max_wait_s": 4.0})
    log = open_log(folder)
    assert whole.max_wait_s is None
    assert log.max_wait_s == 4.0
    assert log.imu.t_ns.tolist() == [100_500_000_000 + i * 100_000_000 for i in range(10)]
    assert log.heading is not None
    assert log.heading.t_ns.tolist() == [100_500_000_000]
    assert log.truth is not None
    assert log.truth.t_ns.tolist() == [100_500_000_000]
    assert "imu: 10 of 20 rows are outside the window from 0.5 s until 1.5 s and left out" in log.notes
    assert "heading: 2 of 3 rows are outside the window from 0.5 s until 0.9 s and left out" in log.notes
    np.testing.assert_allclose(log.gps.z[0, :2], 0.0, atol=1e-6)  # the origin is the first fix that is left
    (folder / "own.tum").write_text("100.1 1 2 3 0 0 0 1\n100.7 2 2 3 0 0 0 1\n")
    describe(folder, {"from_s": 0.5, "truth": {"tum": "own.tum"}})
    assert open_log(folder).truth.t_ns.tolist() == [100_700_000_000]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"from_s": 5.0}, r"imu: 20 of 20 rows are outside the window from 5 s; change `from_s` or `until_s`"),
        ({"from_s": 1.0, "until_s": 1.0}, r"until_s \(1\) must be greater than from_s \(1\)"),
        ({"streams.gps.from_s": -1.0}, r"`streams.gps.from_s`: expected greater than or equal to 0, found -1.0"),
        ({"until_s": 1.0, "streams.heading.time.unit": "ms"}, r"heading: 0.100 s to 0.101 s lies wholly outside"),
    ],
)
def test_a_window_that_leaves_nothing_is_refused(folder, changes, message):
    describe(folder, changes)
    with pytest.raises(DatasetError, match=message):
        open_log(folder)


def test_a_truth_without_rows_is_refused(folder):
    (folder / "empty.csv").write_text("t,x,y,z\n")
    position = {"columns": ["x", "y", "z"], "unit": "m"}
    describe(folder, {"truth": {"table": {"file": "empty.csv"}, "time": {"column": "t"}, "position": position}})
    with pytest.raises(DatasetError, match=r"truth: no rows"):
        open_log(folder)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("R_WB_00", 5.0, r"truth.csv: trajectory: row 3 \(1 in all\): R_WB is not a rotation"),
        ("R_WB_00", np.nan, r"truth.csv: trajectory: row 3 \(1 in all\): R_WB is not a rotation"),
        ("t_ns", np.nan, r"truth.csv: trajectory: row 3: t_ns is nan, not a time"),
        ("t_ns", -9e18, r"truth.csv: trajectory: row 3: t_ns is -9e\+18, not a time"),
        ("p_WB_W_x", None, r"truth.csv: trajectory: missing columns: p_WB_W_x"),
    ],
)
def test_a_truth_of_ours_that_cannot_be_is_refused(folder, column, value, message):
    truth = some_log(6).truth
    assert truth is not None
    table = truth.to_pandas()
    if value is None:
        table = table.drop(columns=column)
    else:
        table[column] = table[column].astype(float)
        table.loc[3, column] = value
    table.to_csv(folder / "truth.csv", index=False)
    describe(folder, {"truth": {"trajectory": "truth.csv"}})
    with pytest.raises(DatasetError, match=message):
        open_log(folder)


def test_a_truth_of_ours_may_leave_attitudes_unknown(folder):
    t_ns = np.array([100, 101]) * 10**9
    truth = Trajectory(t_ns, np.stack([np.eye(3), np.full((3, 3), np.nan)]), np.zeros((2, 3)))
    truth.to_pandas().to_csv(folder / "truth.csv", index=False)
    describe(folder, {"truth": {"trajectory": "truth.csv"}})
    opened = open_log(folder).truth
    assert opened is not None
    np.testing.assert_array_equal(opened.R_WB, truth.R_WB)


def test_a_difference_of_times_that_overflows_is_still_out_of_order():
    t_ns = np.array([9 * 10**18, -9 * 10**18])
    with pytest.raises(DatasetError, match="row 1: time -9000000000000000000 is not after"):
        Trajectory(t_ns, np.stack([np.eye(3)] * 2), np.zeros((2, 3)))


@pytest.mark.parametrize("row", [0, 5, 19])
def test_one_spike_in_time_costs_one_row(folder, row):
    lines = FILES["imu.txt"].splitlines()
    stamp, rest = lines[row + 1].split("\t")
    lines[row + 1] = f"{float(stamp) + (1000 if row < 19 else -1000):.3f}\t{rest}"
    (folder / "imu.txt").write_text("\n".join(lines))
    how = "is ahead of rows below" if row < 19 else "comes before the row above"
    with pytest.raises(DatasetError, match=rf"imu: row {row} \(1 in all\): time -?\d+ ns {how}"):
        open_log(folder)
    log = open_log(folder, repair=True)
    expected = np.delete(100 * 10**9 + np.arange(20) * 10**8, row)
    np.testing.assert_array_equal(log.imu.t_ns, expected)


@pytest.mark.parametrize("seed", range(20))
def test_no_more_rows_are_dropped_for_order_than_must_be(seed):
    t_ns = np.random.default_rng(seed).integers(0, 9, 9)
    left = t_ns[~stray(t_ns)]
    assert (np.diff(left) > 0).all()
    runs = (c for k in range(len(left) + 1, 10) for c in itertools.combinations(t_ns.tolist(), k))
    assert not any(all(a < b for a, b in itertools.pairwise(run)) for run in runs)


def test_times_that_run_backwards_are_no_repair(folder):
    lines = FILES["imu.txt"].splitlines()
    (folder / "imu.txt").write_text("\n".join([lines[0], *reversed(lines[1:])]))
    with pytest.raises(DatasetError, match="imu: 19 of 20 rows are out of order, too many to drop"):
        open_log(folder, repair=True)


def test_repeated_rows_are_repaired_however_many_they_are(folder):
    (folder / "heading.csv").write_text("t,deg\n" + "".join(f"{100 + i // 5},3\n" for i in range(10)))
    assert len(open_log(folder, repair=True).streams["heading"]) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1403636579763555584 0 0 0 0 0 0 1", "line 1: not a time in seconds: '1403636579763555584'; this looks like"),
        ("1732960000000 0 0 0 0 0 0 1", "line 1: not a time in seconds: '1732960000000'; this looks like milliseconds"),
        ("1e999999999 0 0 0 0 0 0 1", "line 1: not a time in seconds: '1e999999999'"),
        ("nan 0 0 0 0 0 0 1", "line 1: not a time in seconds: 'nan'"),
        ("soon 0 0 0 0 0 0 1", "line 1: not numbers: 'soon"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "trajectory: row 1: time 1000000000 is not after the row above"),
    ],
)
def test_what_is_wrong_in_a_tum_file_names_the_file(tmp_path, text, message):
    path = tmp_path / "a.tum"
    path.write_text(text)
    with pytest.raises(DatasetError) as error:
        Trajectory.from_tum(path)
    assert str(error.value).startswith(f"{path}: {message}")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("none.tum", "no such file"),
        ("", "expected a file, found a folder"),
        ("x" * 300, "cannot be read: File name too long"),
        ("a\0b", "cannot be read: embedded null byte"),
    ],
)
def test_a_tum_file_that_cannot_be_read_is_one_line(tmp_path, name, why):
    with pytest.raises(DatasetError) as error:
        Trajectory.from_tum(tmp_path / name)
    assert str(error.value) == f"{tmp_path / name}: {why}".replace("\0", r"\x00")


def test_errors_of_the_rig_and_the_imu_name_the_log(folder):
    describe(folder, {"gravity": 1.0})
    with pytest.raises(DatasetError) as error:
        open_log(folder)
    assert str(error.value).startswith(f"{folder}: rig: gravity")
    describe(folder, {})
    (folder / "imu.txt").write_text(FILES["imu.txt"].splitlines()[1])
    with pytest.raises(DatasetError) as error:
        open_log(folder)
    assert str(error.value).startswith(f"{folder}: imu: 1 samples")


def test_a_log_is_found_by_its_name_in_the_folder_of_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    t_ns = np.arange(1, 5) * 10**7
    imu = ImuStream(t_ns, np.zeros((4, 3)), np.zeros((4, 3)))
    write_folder(Log("mine", Rig(ImuNoise(**NOISE)), imu), tmp_path / "data" / "mine")
    monkeypatch.delenv("FATHOM_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    assert np.array_equal(open_log("mine", tmp_path / "data").imu.t_ns, t_ns)
    assert np.array_equal(open_log("mine", "data").imu.t_ns, t_ns)
    with pytest.raises(DatasetError, match="mine: no such log; neither a folder nor a known name"):
        open_log("mine")
    monkeypatch.setenv("FATHOM_DATA", str(tmp_path / "data"))
    assert open_log("mine").name == "mine"
    with pytest.raises(DatasetError, match=r"nor a folder with a log\.yaml in .*data nor a known name"):
        open_log("mien")


@pytest.mark.slow
@FUZZ
@given(data=st.data(), repair=st.booleans())
def test_a_damaged_description_gives_a_log_or_an_error(folder, data, repair):
    text = yaml.safe_dump(DESCRIPTION)
    at = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 12))
    junk = data.draw(st.text(alphabet="[]{}:,-!&*\"'%\n 019.einfanx\x00é", max_size=6))
    (folder / "log.yaml").write_text(text[:at] + junk + text[at + length :], encoding="utf-8")
    log_or_error(folder, repair=repair)


@pytest.mark.slow
@FUZZ
@given(data=st.data(), repair=st.booleans(), name=st.sampled_from(sorted(FILES)))
def test_a_damaged_table_gives_a_log_or_an_error(folder, data, repair, name):
    describe(folder, {})
    raw = FILES[name].encode()
    at = data.draw(st.integers(0, len(raw)))
    length = data.draw(st.integers(0, 30))
    junk = data.draw(
        st.one_of(st.binary(max_size=8), st.text('0123456789,;.-e\n\t infa"', max_size=12).map(str.encode))
    )
    (folder / name).write_bytes(raw[:at] + junk + raw[at + length :])
    log_or_error(folder, repair=repair)
    (folder / name).write_bytes(raw)


@pytest.mark.slow
@FUZZ
@given(at=st.integers(0, 3000), junk=st.binary(min_size=1, max_size=40))
def test_a_damaged_parquet_file_gives_a_log_or_an_error(tmp_path_factory, at, junk):
    folder = tmp_path_factory.mktemp("parquet")
    full = some_log(5)
    write_folder(Log(name="x", rig=full.rig, imu=full.imu, depth=full.depth), folder)
    raw = bytearray((folder / "depth.parquet").read_bytes())
    at %= len(raw)
    raw[at : at + len(junk)] = junk
    (folder / "depth.parquet").write_bytes(bytes(raw))
    log_or_error(folder)
