"""What a description makes of numbers: sensors apart, axes apart, DVLs askew, places on the globe, joined messages."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError, Log
from fathom.datasets.described import description as description_module
from fathom.datasets.described.opening import open_log
from fathom.datasets.described.rows import apart as means_apart
from fathom.datasets.formats.recording import Messages, Recording, TopicInfo, Wanted
from fathom.datasets.log import AttitudeStream
from scipy.spatial.transform import Rotation

NOISE = dict.fromkeys(
    ("gyro_density", "accel_density", "gyro_walk", "accel_walk", "gyro_bias_sigma", "accel_bias_sigma"), 1e-3
)
IMU: dict[str, Any] = {
    "table": {"file": "imu.csv"},
    "time": {"column": "t"},
    "gyro": {"columns": ["gx", "gy", "gz"], "unit": "rad/s"},
    "accel": {"columns": ["ax", "ay", "az"], "unit": "m/s^2"},
    "noise": NOISE,
}
SEMI_MAJOR_M, SEMI_MINOR_M = 6378137.0, 6356752.314245


def write(folder: Path, name: str, columns: Mapping[str, Any]) -> None:
    rows = zip(*(np.asarray(values, float).tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    (folder / name).write_text("\n".join(lines) + "\n")


def opened(folder: Path, streams: Mapping[str, Any], repair: bool = False, **parts: Any) -> Log:
    described = {"streams": {"imu": IMU} | dict(streams), **parts}
    (folder / "log.yaml").write_text(yaml.safe_dump(copy.deepcopy(described)))
    return open_log(folder, repair=repair)


def changed(part: Mapping[str, Any], **changes: Any) -> dict[str, Any]:
    return {key: value for key, value in {**part, **changes}.items() if value is not None}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An IMU at rest, 10 Hz, 100 s to 110 s."""
    t = 100 + np.arange(101) / 10
    zero = np.zeros(len(t))
    write(tmp_path, "imu.csv", {"t": t, "gx": zero, "gy": zero, "gz": zero, "ax": zero, "ay": zero, "az": zero + 9.8})
    return tmp_path


# -- gyro and accelerometer apart


ACCEL_SOURCE = {"table": {"file": "accel.csv"}, "time": {"column": "stamp", "unit": "ms"}}
SLOPE = np.array([0.3, -0.2, 0.1])


def apart(folder: Path, t_gyro: Any, t_accel: Any, accel: Any = None) -> None:
    t_gyro, t_accel = np.asarray(t_gyro), np.asarray(t_accel)
    write(folder, "imu.csv", {"t": t_gyro, "gx": t_gyro * 0.1, "gy": t_gyro * 0.2, "gz": t_gyro * 0.3})
    f = np.outer(t_accel, SLOPE) if accel is None else accel
    write(folder, "accel.csv", {"stamp": t_accel * 1e3, "ax": f[:, 0], "ay": f[:, 1], "az": f[:, 2]})


def test_an_accelerometer_apart_is_put_to_the_gyros_times_linearly(folder):
    """What changes linearly is met exactly, at other rates, other phases and other units of time."""
    t_gyro = 100.03 + np.arange(80) / 8
    apart(folder, t_gyro, 100 + np.arange(111) / 10)
    imu = opened(folder, {"imu": {**IMU, "accel_source": ACCEL_SOURCE, "axes": "FRD"}}).imu
    np.testing.assert_array_equal(imu.t_ns, np.rint(t_gyro * 1e9))
    np.testing.assert_allclose(imu.f_I, np.outer(t_gyro, SLOPE * [1, -1, -1]), rtol=1e-12)
    np.testing.assert_allclose(imu.w_WI_I, np.outer(t_gyro, [0.1, -0.2, -0.3]), rtol=1e-12)


def test_at_common_times_the_accelerometers_own_samples_are_taken(folder):
    t = 100 + np.arange(50) / 4
    f = np.random.default_rng(2).normal(size=(50, 3))
    apart(folder, t, t, f)
    log = opened(folder, {"imu": {**IMU, "accel_source": ACCEL_SOURCE}})
    np.testing.assert_allclose(log.imu.f_I, f, rtol=1e-15)
    assert not log.notes


def test_gyro_samples_without_an_accelerometer_beside_them_are_dropped_and_counted(folder):
    t_accel = 101 + np.arange(81) / 10
    t_accel = t_accel[(t_accel < 103.95) | (t_accel > 105.05)]  # 3.9 and 5.1 s are left: a gap of 1.2 s
    t_gyro = 100.05 + np.arange(100) / 10
    apart(folder, t_gyro, t_accel)
    log = opened(folder, {"imu": {**IMU, "accel_source": ACCEL_SOURCE}})
    beside = ((t_gyro > 101) & (t_gyro < 103.9)) | ((t_gyro > 105.1) & (t_gyro < 109))
    np.testing.assert_array_equal(log.imu.t_ns, np.rint(t_gyro[beside] * 1e9))
    np.testing.assert_allclose(log.imu.f_I, np.outer(t_gyro[beside], SLOPE), rtol=1e-12)
    dropped = np.count_nonzero(~beside)
    assert log.notes == (f"imu: {dropped} rows of the gyro without the accelerometer's beside them dropped",)


def test_a_gap_is_crossed_where_the_gyro_meets_its_very_ends(folder):
    """At a sample of the accelerometer nothing is interpolated, however long the gap behind it."""
    t_accel = np.array([100, 100.5, 101, 104, 104.5, 105])
    apart(folder, t_accel, t_accel)
    log = opened(folder, {"imu": {**IMU, "accel_source": ACCEL_SOURCE}})
    assert len(log.imu.t_ns) == 6
    np.testing.assert_allclose(log.imu.f_I, np.outer(t_accel, SLOPE), rtol=1e-12)


def test_each_of_the_two_has_its_own_clock_and_its_own_validity(folder):
    t = 100 + np.arange(60) / 10
    apart(folder, t, t)
    rows = (folder / "accel.csv").read_text().splitlines()
    rows = [f"{row},{'ok' if i == 0 else 0 if i in (11, 12) else 1}" for i, row in enumerate(rows)]
    (folder / "accel.csv").write_text("\n".join(rows) + "\n")
    source = {"table": {"file": "accel.csv"}, "time": {"column": "stamp", "unit": "ms", "clock_offset_s": 0.05},
              "valid": {"column": "ok", "values": [1]}}  # fmt: skip
    log = opened(folder, {"imu": {**IMU, "accel_source": source, "every": 3}})
    assert "imu: 2 rows invalid dropped" in log.notes
    held = np.delete(t, [10, 11]) + 0.05
    after = np.searchsorted(held, t).clip(1, len(held) - 1)
    beside = (t > held[0]) & (t < held[-1]) & (held[after] - held[after - 1] < 0.2)
    three = t[beside][: np.count_nonzero(beside) // 3 * 3].reshape(-1, 3)
    np.testing.assert_array_equal(log.imu.t_ns, np.rint(three[:, 2] * 1e9))
    dt = np.minimum(np.diff(three.ravel(), prepend=three[0, 0] - 0.1), 0.15).reshape(-1, 3)
    mean = (three * dt).sum(axis=1) / dt.sum(axis=1)
    np.testing.assert_allclose(log.imu.f_I, np.outer(mean - 0.05, SLOPE), rtol=1e-9)


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ({**ACCEL_SOURCE, "time": {"column": "stmp"}}, r"accel.csv: no column 'stmp'; did you mean 'stamp'"),
        ({"table": {"file": "acel.csv"}, "time": {"column": "t"}}, r"acel.csv: no such file; did you mean 'accel.csv'"),
        ({**ACCEL_SOURCE, "every": 2}, r"unknown key `streams.imu.accel_source.every`.*known: table, message, time"),
        ({"time": {"column": "stamp"}}, r"streams.imu.accel_source.*give one of `table` and `message`"),
        ({"table": {"file": "accel.csv"}}, r"missing key `streams.imu.accel_source.time`"),
    ],
)
def test_what_is_wrong_with_the_accelerometers_source_is_named(folder, source, error):
    t = 100 + np.arange(30) / 10
    apart(folder, t, t)
    with pytest.raises(DatasetError, match=error):
        opened(folder, {"imu": {**IMU, "accel_source": source}})


def test_one_accelerometer_row_is_not_enough(folder):
    apart(folder, [100.0, 100.1, 100.2], [100.1])
    with pytest.raises(DatasetError, match="imu: 1 accelerometer rows, at least 2 are needed"):
        opened(folder, {"imu": {**IMU, "accel_source": ACCEL_SOURCE}})


# -- a DVL that measures along some axes, or sits askew


DVL: dict[str, Any] = {
    "table": {"file": "dvl.csv"},
    "time": {"column": "t"},
    "velocity": {"columns": ["a", "b", "c"], "unit": "m/s"},
    "sigma_m_s": 0.1,
}


@pytest.fixture
def velocities(folder: Path) -> Any:
    v = np.random.default_rng(4).normal(size=(20, 3))
    s = np.random.default_rng(5).uniform(0.1, 1, (20, 3))
    write(folder, "dvl.csv", {"t": 100 + np.arange(20) / 4, **dict(zip("abc", v.T, strict=True)),
                              **dict(zip(("sa", "sb", "sc"), s.T, strict=True))})  # fmt: skip
    return v


@pytest.mark.parametrize(
    ("measures", "axes", "rows"),
    [(["x"], "FLU", {0: 1}), (["x"], "FRD", {0: 1}), (["z", "x"], "FRD", {2: -1, 0: 1}), (["y"], "FRD", {1: -1}),
     (["y", "x", "z"], "FLU", {1: 1, 0: 1, 2: 1})],
)  # fmt: skip
def test_an_axis_that_is_not_measured_is_zero_with_an_infinite_sigma(folder, velocities, measures, axes, rows):
    k = len(measures)
    quantity = {"columns": list("abc")[:k], "unit": "m/s"}
    part = changed(DVL, velocity=quantity, measures=measures, axes=axes, sigma_m_s=[0.1, 0.2, 0.3][:k])
    dvl = opened(folder, {"dvl": part}).dvl
    assert dvl is not None
    for axis in range(3):
        if axis in rows:
            which = list(rows).index(axis)
            np.testing.assert_array_equal(dvl.z[:, axis], rows[axis] * velocities[:, which])
            np.testing.assert_array_equal(dvl.sigma[:, axis], [0.1, 0.2, 0.3][which])
        else:
            np.testing.assert_array_equal(dvl.z[:, axis], 0.0)
            assert np.isinf(dvl.sigma[:, axis]).all()


def test_sigma_row_by_row_is_of_the_measured_axes(folder, velocities):
    two = changed(DVL, velocity={"columns": ["a", "b"], "unit": "m/s"}, measures=["z", "y"], sigma_m_s=None)
    both = opened(folder, {"dvl": {**two, "sigma": {"columns": ["sa", "sb"], "unit": "cm/s"}}}).dvl
    one = opened(folder, {"dvl": {**two, "sigma": {"columns": ["sa"], "unit": "m/s"}}}).dvl
    s = np.random.default_rng(5).uniform(0.1, 1, (20, 3))
    assert both is not None
    assert one is not None
    np.testing.assert_allclose(both.sigma, np.stack([np.full(20, np.inf), s[:, 1] / 100, s[:, 0] / 100], axis=1))
    np.testing.assert_allclose(one.sigma, np.stack([np.full(20, np.inf), s[:, 0], s[:, 0]], axis=1))
    with pytest.raises(DatasetError, match="dvl: sigma: expected 2 columns"):
        opened(folder, {"dvl": {**two, "sigma": {"columns": ["sa", "sb", "sc"], "unit": "m/s"}}})


@pytest.mark.parametrize("axes", ["FLU", "FRD"])
@pytest.mark.parametrize("seed", range(4))
def test_a_dvl_askew_is_turned_with_its_sigma(folder, velocities, axes, seed):
    """Against what a mounting says: a velocity of the body, seen in the sensor's axes, comes back."""
    yaw, pitch, roll = np.random.default_rng(seed).uniform(-80, 80, 3)
    sigma = np.array([0.1, 0.5, 2.0])
    mounting = {"yaw_deg": float(yaw), "pitch_deg": float(pitch), "roll_deg": float(roll)}
    dvl = opened(folder, {"dvl": changed(DVL, axes=axes, mounting=mounting, sigma_m_s=sigma.tolist())}).dvl
    c, s = np.cos(np.radians([yaw, pitch, roll])), np.sin(np.radians([yaw, pitch, roll]))
    R = np.array([[c[0], -s[0], 0], [s[0], c[0], 0], [0, 0, 1]])
    R = R @ np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]]) @ np.array([[1, 0, 0], [0, c[2], -s[2]],
                                                                                [0, s[2], c[2]]])  # fmt: skip
    flip = np.diag([1.0, -1, -1]) if axes == "FRD" else np.eye(3)
    assert dvl is not None
    np.testing.assert_allclose((flip @ R.T @ dvl.z.T).T, velocities, atol=1e-12)
    np.testing.assert_allclose(dvl.sigma[0], np.sqrt(np.diag(R @ np.diag(sigma**2) @ R.T)), rtol=1e-12)
    by_matrix = opened(folder, {"dvl": changed(DVL, axes=axes, mounting={"R_BS": R.tolist()})}).dvl
    assert by_matrix is not None
    np.testing.assert_allclose(by_matrix.z, dvl.z, atol=1e-12)


def test_an_axis_of_infinite_sigma_stays_alone_where_the_mounting_leaves_it_its_axis(folder, velocities):
    """Turned about the vertical, a DVL whose vertical velocity counts for nothing still has two good axes."""
    for yaw in (30.0, 90.0, 180.0):
        part = changed(DVL, sigma_m_s=[0.3, 0.4, float("inf")], mounting={"yaw_deg": yaw})
        dvl = opened(folder, {"dvl": part}).dvl
        assert dvl is not None
        a = np.radians(yaw)
        expected = np.hypot([0.3 * np.cos(a), 0.3 * np.sin(a)], [0.4 * np.sin(a), 0.4 * np.cos(a)])
        np.testing.assert_allclose(dvl.sigma, np.tile([*expected, np.inf], (20, 1)))


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"measures": ["x", "w", "z"]}, r"streams.dvl.measures\[1\]`: .*'x', 'y' or 'z'.*found 'w'"),
        ({"measures": ["x", "x", "z"]}, r"streams.dvl`: measures: an axis is named twice"),
        ({"measures": []}, r"streams.dvl.measures"),
        ({"measures": ["x", "y"]}, r"velocity: expected 2 columns, found 3"),
        ({"velocity": {"columns": ["a"], "unit": "m/s"}}, r"velocity: expected 3 columns, found 1"),
        ({"sigma_m_s": [0.1, 0.2]}, r"sigma_m_s: expected 3 numbers, found 2"),
        ({"sigma_m_s": [0.1, 0.2, 0.0]}, r"streams.dvl.sigma_m_s"),
        (
            {"mounting": {"translation_m": [0.1, 0, 0]}},
            r"mounting: the DVL is the origin of B; give the other sensors'",
        ),
        (
            {"measures": ["x"], "velocity": {"columns": ["a"], "unit": "m/s"}, "mounting": {"yaw_deg": 5}},
            r"mounting: only a velocity measured along all three axes can be rotated",
        ),
        ({"mounting": {"R_BS": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}}, r"R_BS must be a 3 × 3 rotation"),
        ({"mounting": {"R_BS": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "yaw_deg": 3}}, r"give R_BS or the angles, not both"),
        ({"mounting": {"yaw": 3}}, r"unknown key `streams.dvl.mounting.yaw`; did you mean 'yaw_deg'"),
        ({"outliers": {"above": 1.0, "components": [3]}}, r"streams.dvl.outliers.components\[0\]"),
        ({"velocity": {"columns": ["a", "b", "c"], "unit": "m/s", "scale": [1, 2]}}, "scale: expected one number or 3"),
    ],
)
def test_what_a_dvl_cannot_be_is_refused_before_anything_is_read(folder, changes, error):
    with pytest.raises(DatasetError, match=error) as caught:
        opened(folder, {"dvl": changed(DVL, **changes)})
    assert str(caught.value).startswith(str(folder / "log.yaml"))


def test_outliers_are_of_the_columns_that_are_there(folder, velocities):
    part = changed(DVL, velocity={"columns": ["a"], "unit": "m/s"}, measures=["x"], outliers={"above": 1.0})
    dvl = opened(folder, {"dvl": part}).dvl
    assert dvl is not None
    np.testing.assert_array_equal(dvl.z[:, 0], velocities[np.abs(velocities[:, 0]) <= 1, 0])
    part["outliers"] = {"above": 1.0, "components": [1]}
    with pytest.raises(DatasetError, match="dvl: outliers: it has 1 components only"):
        opened(folder, {"dvl": part})


# -- readings that are means of the last seconds


@pytest.mark.parametrize(("jitter_s", "every"), [(0.0, 1), (0.004, 1), (0.0, 2)])
def test_a_mean_is_of_its_middle_and_means_that_overlap_are_left_out(folder, jitter_s: float, every: int) -> None:
    """A trailing mean over a second of what changes linearly is what there was half a second before."""
    stamp = 101.5 + np.arange(80) / 10
    stamp[1::2] += jitter_s
    depth = 7.0 + 0.3 * (stamp - 0.5)
    write(folder, "depth.csv", {"t": stamp, "d": depth})
    part = {"table": {"file": "depth.csv"}, "time": {"column": "t"}, "depth": {"columns": ["d"], "unit": "m"}}
    part |= {"positive": "down", "sigma_m": 0.1, "averaged_over_s": 1.0, "every": every}
    log = opened(folder, {"depth": part})
    read = log.depth
    t_s = read.t_ns * 1e-9
    np.testing.assert_allclose(read.z[:, 0], -(7.0 + 0.3 * t_s), atol=1e-6)
    assert np.all(read.received_ns - read.t_ns == 500_000_000)
    assert len(read) == np.ceil(8 / every)
    assert np.diff(t_s).min() > every * (1.0 - 0.011)
    assert "depth: means over 1 s; 8 of 80 rows kept, which do not overlap" in log.notes


def test_readings_that_do_not_overlap_are_all_kept() -> None:
    t_ns = np.arange(20) * 1_500_000_000
    assert means_apart(t_ns, 1.0).all()
    assert np.flatnonzero(means_apart(t_ns, 1.6)).tolist() == list(range(0, 20, 2))
    assert means_apart(t_ns[:1], 9.0).tolist() == [True]
    assert means_apart(t_ns[:0], 9.0).tolist() == []


def test_what_is_kept_of_overlapping_means_has_white_errors() -> None:
    """White noise at 100 Hz, a mean of the last 100 ten times a second: neighbours share 0.9, kept ones none."""
    rng = np.random.default_rng(0)
    summed = np.concatenate([[0.0], np.cumsum(rng.standard_normal(400_000))])
    ends = np.arange(100, 400_001, 10)
    means, t_ns = (summed[ends] - summed[ends - 100]) / 100, ends * 10_000_000
    kept = means[means_apart(t_ns, 1.0)]
    shared = [np.corrcoef(x[1:], x[:-1])[0, 1] for x in (means, kept)]
    assert shared[0] == pytest.approx(0.9, abs=0.02)
    assert abs(shared[1]) < 3.3 / np.sqrt(len(kept))
    assert len(kept) == 4000


# -- earth-centred places, velocities and attitudes


def enu_from_ecef(latitude_deg: float, longitude_deg: float) -> Any:
    """The text book's two turns: about z by 90° + longitude, then about x by 90° − latitude."""
    return Rotation.from_euler("ZX", [90 + longitude_deg, 90 - latitude_deg], degrees=True).as_matrix().T


def surface(latitude_deg: Any, longitude_deg: Any, height_m: Any = 0.0) -> Any:
    """ECEF by the parametric latitude: tan β = (b/a) tan φ."""
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    beta = np.arctan2(SEMI_MINOR_M * np.sin(phi), SEMI_MAJOR_M * np.cos(phi))
    normal = np.stack(np.broadcast_arrays(np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)), -1)
    on = np.stack(np.broadcast_arrays(SEMI_MAJOR_M * np.cos(beta) * np.cos(lam), SEMI_MAJOR_M * np.cos(beta)
                  * np.sin(lam), SEMI_MINOR_M * np.sin(beta)), -1)  # fmt: skip
    return on + normal * np.asarray(height_m)[..., None]


def ecef_part(p: Any) -> dict[str, Any]:
    return {"table": {"file": "ecef.csv"}, "time": {"column": "t"}, "frame": "ECEF",
            "position": {"columns": ["x", "y", "z"], "unit": "km"}}  # fmt: skip


@pytest.mark.parametrize(("lat", "lon"), [(0.0, 0.0), (-33.9, 151.2), (78.2, -15.6)])
def test_earth_centred_places_are_those_that_geodetic_ones_say(folder, lat, lon):
    """East and north of the origin over the ellipsoid, to the curvature; and the height above it."""
    rng = np.random.default_rng(8)
    lats, lons, up = lat + rng.uniform(-1e-3, 1e-3, 9), lon + rng.uniform(-1e-3, 1e-3, 9), rng.uniform(-30, 30, 9)
    lats[0], lons[0] = lat, lon
    p = surface(lats, lons, up) / 1e3
    place = {"latitude": "lat", "longitude": "lon", "altitude": {"columns": ["h"], "unit": "m"}}
    geodetic = {"table": {"file": "ecef.csv"}, "time": {"column": "t"}, "sigma_m": 1.0, "geodetic": place}
    columns = {"t": 100 + np.arange(9), **dict(zip("xyz", p.T, strict=True)), "lat": lats, "lon": lons, "h": up}
    write(folder, "ecef.csv", columns)
    log = opened(folder, {"gps": geodetic}, truth={**ecef_part(p), "kind": "reference"})
    ecef = opened(folder, {"gps": {**ecef_part(p), "sigma_m": [1.0, 2.0, 3.0]}})
    assert ecef.gps is not None
    assert log.gps is not None
    assert log.truth is not None
    assert ecef.origin == pytest.approx((lat, lon), abs=1e-9)
    expected = (enu_from_ecef(lat, lon) @ (surface(lats, lons) - surface(lat, lon)).T).T
    expected[:, 2] = up
    np.testing.assert_allclose(ecef.gps.z, expected, atol=1e-6)
    np.testing.assert_allclose(log.gps.z, expected, atol=1e-6)
    np.testing.assert_allclose(log.truth.p_WB_W, expected, atol=1e-6)
    np.testing.assert_array_equal(ecef.gps.sigma[0], [1.0, 2.0, 3.0])


def test_earth_centred_velocities_and_attitudes_are_turned_at_the_origin(folder):
    lat, lon = 37.7, -122.5
    v_W = np.random.default_rng(1).normal(size=(6, 3))
    R_WB = Rotation.random(6, random_state=2).as_matrix()
    C = enu_from_ecef(lat, lon)
    p = surface(np.full(6, lat), np.full(6, lon), 5.0) / 1e3
    frd = np.diag([1.0, -1, -1])
    q = np.roll(Rotation.from_matrix(C.T @ R_WB @ frd).as_quat(), 1, axis=1)
    columns = {"t": 100 + np.arange(6), **dict(zip("xyz", p.T, strict=True)),
               **dict(zip(("vx", "vy", "vz"), C.T @ v_W.T, strict=True)),
               **dict(zip(("q0", "q1", "q2", "q3"), q.T, strict=True))}  # fmt: skip
    write(folder, "ecef.csv", columns)
    attitude = {"columns": ["q0", "q1", "q2", "q3"], "form": "quaternion_wxyz", "world": "ECEF", "axes": "FRD"}
    truth = {**ecef_part(p), "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s"}, "attitude": attitude}
    log = opened(folder, {}, truth=truth)
    assert log.truth is not None
    np.testing.assert_allclose(log.truth.v_WB_W, v_W, atol=1e-12)
    np.testing.assert_allclose(log.truth.R_WB, R_WB, atol=1e-12)
    np.testing.assert_allclose(log.truth.p_WB_W, [[0, 0, 5.0]] * 6, atol=1e-6)

    heading = {"table": {"file": "ecef.csv"}, "time": {"column": "t"}, "attitude": attitude, "sigma_deg": 1.0}
    given = opened(folder, {"heading": heading}, origin={"latitude_deg": lat, "longitude_deg": lon}).heading
    found = opened(folder, {"heading": heading}, truth=truth).heading
    for stream in (given, found):
        assert isinstance(stream, AttitudeStream)
        np.testing.assert_allclose(stream.z.reshape(-1, 3, 3), R_WB, atol=1e-12)
    with pytest.raises(DatasetError, match="heading: ECEF axes need W's origin; give `origin`"):
        opened(folder, {"heading": heading})


def test_a_receiver_without_a_fix_is_not_at_the_centre_of_the_earth(folder):
    p = surface(np.full(5, 40.0), np.full(5, 3.0)) / 1e3
    p[2] = 0.0
    write(folder, "ecef.csv", {"t": 100 + np.arange(5), **dict(zip("xyz", p.T, strict=True))})
    part = {**ecef_part(p), "sigma_m": 1.0}
    with pytest.raises(DatasetError, match=r"gps: row 2 \(1 in all\): no place on earth: \(0, 0, 0\) m, ECEF"):
        opened(folder, {"gps": part})
    log = opened(folder, {"gps": part}, repair=True)
    assert log.gps is not None
    np.testing.assert_array_equal(log.gps.t_ns, np.array([100, 101, 103, 104]) * 10**9)
    np.testing.assert_allclose(log.gps.z, 0.0, atol=1e-6)


def test_an_earth_centred_place_is_one_by_itself(folder):
    part = {**ecef_part(None), "sigma_m": 1.0, "geodetic": {"latitude": "a", "longitude": "b"}}
    with pytest.raises(DatasetError, match="ECEF positions are global already: leave `geodetic` out"):
        opened(folder, {"gps": part})


# -- messages


class Invented(Recording):
    """A recording that holds what a test says."""

    host_clock: ClassVar = ("host", "ms")
    held: ClassVar[dict[str, dict[str, Any]]] = {}
    asked: ClassVar[list[Wanted]] = []

    def read(self, folder: Path, wanted: Sequence[Wanted]) -> Messages:
        Invented.asked = list(wanted)
        found = [{c: np.asarray(self.held[want.message][c]) for c in want.columns} for want in wanted]
        return Messages(found, ("invented: told",))

    def contents(self, folder: Path) -> list[TopicInfo]:
        return []


@pytest.fixture
def invented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(description_module, "loader", lambda name: Invented)
    (tmp_path / "file").touch()
    return tmp_path


def from_messages(folder: Path, streams: Mapping[str, Any]) -> Log:
    return opened(folder, streams, recording={"format": "invented", "file": "file"})


JOINED = {
    **{key: IMU[key] for key in ("noise",)},
    "message": {"names": ["Gyro", "Accel"], "clock": {"field": "dev", "wraps_at_s": 8}},
    "time": {"column": "device"},
    "gyro": {"columns": ["Gyro.x", "Gyro.y", "Gyro.z"], "unit": "rad/s"},
    "accel": {"columns": ["Accel.x", "Accel.y", "Accel.z"], "unit": "m/s^2"},
}


def invent(gyro_rows: Any, accel_rows: Any) -> Any:
    """Gyro and accelerometer of one device at 10 Hz whose clock wraps at 8 s; the host's stamps, ms, are 3 ms late."""
    tick = np.arange(200)
    device = (5 + tick / 10) % 8
    host = 1e6 + tick * 100 + 3
    values = np.random.default_rng(3).normal(size=(2, 200, 3))
    for name, rows, v, late in (("Gyro", gyro_rows, values[0], 0.0), ("Accel", accel_rows, values[1], 20.0)):
        Invented.held[name] = {"host": (host + late)[rows].astype(np.int64), "dev": device[rows],
                               **dict(zip("xyz", v[rows].T, strict=True))}  # fmt: skip
    return values


def test_messages_of_one_device_are_joined_where_its_clock_agrees(invented):
    keep = np.ones(200, bool)
    keep[[5, 50, 51, 120]] = False
    gyro, accel = invent(keep, np.roll(keep, 7))
    both = keep & np.roll(keep, 7)
    imu = from_messages(invented, {"imu": JOINED}).imu
    np.testing.assert_array_equal(imu.w_WI_I, gyro[both])
    np.testing.assert_array_equal(imu.f_I, accel[both])
    np.testing.assert_allclose(imu.t_ns * 1e-9, 1000.003 + np.flatnonzero(both) / 10, atol=1e-6)


def test_each_message_is_asked_for_once_and_only_for_what_is_needed(invented):
    invent(slice(None), slice(None))
    Invented.held["Depth"] = {"host": 1e6 + np.arange(9) * 1000, "value": np.arange(9.0), "flag": np.ones(9)}
    depth = {"message": {"names": ["Depth"]}, "time": {"column": "host", "unit": "ms"}, "sigma_m": 1.0,
             "depth": {"columns": ["value"], "unit": "m"}, "valid": {"column": "flag", "values": [1]}}  # fmt: skip
    log = from_messages(invented, {"imu": JOINED, "depth": depth})
    assert "invented: told" in log.notes
    assert [(want.message, set(want.columns)) for want in Invented.asked] == [
        ("Gyro", {"host", "dev", "x", "y", "z"}),
        ("Accel", {"host", "dev", "x", "y", "z"}),
        ("Depth", {"host", "value", "flag"}),
    ]


def test_gyro_and_accelerometer_may_be_two_messages_whose_fields_are_called_alike(invented):
    gyro, accel = invent(slice(None), slice(None))
    time = {"column": "host", "unit": "ms"}
    part = {**JOINED, "message": {"names": ["Gyro"]}, "time": time,
            "gyro": {"columns": ["x", "y", "z"], "unit": "rad/s"},
            "accel": {"columns": ["x", "y", "z"], "unit": "m/s^2"},
            "accel_source": {"message": {"names": ["Accel"]}, "time": {**time, "clock_offset_s": -0.02}}}  # fmt: skip
    imu = from_messages(invented, {"imu": part}).imu
    np.testing.assert_array_equal(imu.w_WI_I, gyro)
    np.testing.assert_allclose(imu.f_I, accel, rtol=1e-14)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        (
            {"message": {"names": ["Gyro", "Accel"]}},
            "several messages are joined on a device clock: `clock` is missing",
        ),
        ({"message": {"names": []}}, "streams.imu.message.names"),
        ({"gyro": {"columns": ["x", "y", "z"], "unit": "rad/s"}}, "column 'x': expected `Name.field` of one of Gyro"),
        ({"message": {"names": ["Gyro"], "clock": {"field": "dev"}}}, "missing key `streams.imu.message.clock.wraps"),
    ],
)
def test_what_is_wrong_with_joined_messages_is_named(invented, changes, error):
    invent(slice(None), slice(None))
    with pytest.raises(DatasetError, match=error) as caught:
        from_messages(invented, {"imu": {**JOINED, **changes}})
    assert str(caught.value).startswith(str(invented))


def test_messages_that_share_no_device_time_are_refused(invented):
    invent(slice(None), slice(None))
    Invented.held["Accel"]["dev"] = Invented.held["Accel"]["dev"] + 0.05
    with pytest.raises(DatasetError, match=r"file: Gyro and Accel have no device time in common"):
        from_messages(invented, {"imu": JOINED})


def test_messages_without_a_recording_are_refused(folder):
    with pytest.raises(
        DatasetError, match="streams name messages, but `recording` does not say which file they are in"
    ):
        opened(folder, {"imu": JOINED})


def test_a_source_of_the_accelerometer_in_messages_needs_a_recording_too(folder):
    with pytest.raises(
        DatasetError, match="streams name messages, but `recording` does not say which file they are in"
    ):
        opened(folder, {"imu": {**IMU, "accel_source": {"message": {"names": ["A"]}, "time": {"column": "t"}}}})
