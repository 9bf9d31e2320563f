"""Gross faults: each is found by what caused it, its advice is a valid log.yaml, and with it the finding is gone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from fathom.bench.inspection.findings.advice import in_words, put, resolve, resolved
from fathom.bench.inspection.findings.finding import Finding
from fathom.bench.inspection.gross.gross import gross_check, quick_findings
from fathom.bench.inspection.gross.readings import reading_findings
from fathom.bench.inspection.gross.sketch import sketch_of
from fathom.bench.inspection.gross.vertical import climb_scale
from fathom.bench.inspection.inspecting import inspect_log, open_to_inspect
from fathom.datasets import Log, Scenario, open_log, simulate
from fathom.datasets.described.description import read_description
from fathom.datasets.described.folder import write_folder
from fathom.datasets.described.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from fathom.datasets.log import AttitudeStream, HeadingStream, ImuStream, ReadingStream
from fathom.datasets.simulated.imu_grades import IMU_GRADES
from fathom.datasets.simulated.missions import MISSIONS
from fathom.datasets.state import Array
from scipy.spatial.transform import Rotation

PORTO = (41.185, -8.706)
SWAPPED_YZ = np.diag([1.0, -1.0, -1.0])


@cache
def sail(mission: str = "lawnmower", seed: int = 1, imu: str = "industrial", duration_s: float = 600.0) -> Log:
    dials = {"mission": mission, "duration_s": duration_s, "imu": {"noise": imu, "rate_hz": 25.0}}
    log = simulate(Scenario.from_dict(dials), seed=seed)
    assert log.truth is not None
    return replace(log, prior=None, truth=log.truth.select(slice(None, None, 10)))


def imu(gyro: Any = 1.0, accel: Any = 1.0, late_s: float = 0.0) -> Callable[[Log], Log]:
    """What multiplies the readings of gyro and accelerometer, in the IMU's axes, and a shift of its clock."""

    def of(log: Log) -> Log:
        w, f = (x @ m if np.ndim(m) else x * m for x, m in ((log.imu.w_WI_I, gyro), (log.imu.f_I, accel)))
        return replace(log, imu=ImuStream(log.imu.t_ns + round(late_s * 1e9), w, f))

    return of


def stream(name: str, scale: Any = 1.0, late_s: float = 0.0, order: Any = slice(None)) -> Callable[[Log], Log]:
    """The same of an aiding sensor."""

    def of(log: Log) -> Log:
        old: ReadingStream = getattr(log, name)
        shift = round(late_s * 1e9)
        new = type(old)(old.t_ns + shift, old.received_ns + shift, old.z[:, order] * scale, old.sigma)
        return replace(log, **{name: new})

    return of


def raised(name: str, up_m: float) -> Callable[[Log], Log]:
    """The heights of a sensor moved up."""

    def of(log: Log) -> Log:
        up = np.array([0.0, 0.0, up_m])
        old: ReadingStream = getattr(log, name)
        return replace(log, **{name: type(old)(old.t_ns, old.received_ns, old.z + up[-old.width :], old.sigma)})

    return of


def turned(name: str, degrees: float) -> Callable[[Log], Log]:
    """A DVL, or a heading sensor, turned counter-clockwise."""

    def of(log: Log) -> Log:
        old: ReadingStream = getattr(log, name)
        a = np.radians(degrees)
        c, s = np.cos(a), np.sin(a)
        z = old.z @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) if name == "dvl" else old.z + a
        return replace(log, **{name: type(old)(old.t_ns, old.received_ns, z, old.sigma)})

    return of


def heading(of_psi: Callable[[Array], Array]) -> Callable[[Log], Log]:
    def of(log: Log) -> Log:
        old = log.heading
        assert isinstance(old, HeadingStream)
        return replace(log, heading=HeadingStream(old.t_ns, old.received_ns, of_psi(old.z), old.sigma))

    return of


def sigma(name: str, factor: float) -> Callable[[Log], Log]:
    def of(log: Log) -> Log:
        old: ReadingStream = getattr(log, name)
        return replace(log, **{name: type(old)(old.t_ns, old.received_ns, old.z, old.sigma * factor)})

    return of


def without(*names: str) -> Callable[[Log], Log]:
    return lambda log: replace(log, **dict.fromkeys(names))


PLACE = {"latitude": 1, "longitude": 2}
ALTITUDE = {"columns": [3], "unit": "m", "offset": 2}
FAULTS: dict[str, tuple[tuple[Callable[[Log], Log], ...], str, str]] = {
    # what is done to a right log, the stream blamed, and words of the finding
    "accelerometer in g": ((imu(accel=1 / 9.80665),), "imu", "it is in g"),
    "gravity upside down": ((imu(accel=-1.0),), "imu", "the sign of the accelerometer is wrong"),
    "gyro in degrees": ((imu(gyro=180 / np.pi),), "imu", "deg"),
    "gyro read as degrees": ((imu(gyro=np.pi / 180),), "imu", "rad"),
    "gyro of 0.6": ((imu(gyro=0.6),), "imu", "scale is off"),
    "gyro of 1.4": ((imu(gyro=1.4),), "imu", "scale is off"),
    "gyro's vertical axis": ((imu(np.diag([1, 1, 0.6])), without("truth")), "imu", "z axis"),
    "gyro negated": ((imu(gyro=-1.0),), "imu", "the sign of the gyro is wrong"),
    "left-handed x": ((imu(np.diag([-1, 1, 1]), np.diag([-1, 1, 1])),), "imu", "left-handed"),
    "left-handed y": ((imu(np.diag([1, -1, 1]), np.diag([1, -1, 1])),), "imu", "left-handed"),
    "left-handed z": ((imu(np.diag([1, 1, -1]), np.diag([1, 1, -1])),), "imu", "left-handed"),
    "gyro x negated": ((imu(np.diag([-1, 1, 1])),), "imu", "x of the gyro is negated"),
    "accelerometer y negated": ((imu(accel=np.diag([1, -1, 1])),), "imu", "y of the accelerometer is negated"),
    "gyro FRD": ((imu(SWAPPED_YZ),), "imu", "y and z of the gyro are negated"),
    "accelerometer FRD": ((imu(accel=SWAPPED_YZ),), "imu", "y and z of the accelerometer are negated"),
    "IMU FRD": ((imu(SWAPPED_YZ, SWAPPED_YZ),), "imu", "points down in the body"),
    "gyro's columns exchanged": ((imu(np.eye(3)[[1, 0, 2]]),), "imu", "must be read as (y, x, z)"),
    "IMU turned by 90°": ((imu(*2 * [np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])]),), "imu", "yaw on the vehicle"),
    "IMU turned by 180°": ((imu(*2 * [np.diag([-1.0, -1.0, 1.0])]),), "imu", "yaw on the vehicle"),
    "gyro of 0.6 alone": ((imu(gyro=0.6), without("heading", "truth")), "imu", "scale is off"),
    "IMU's clock": ((imu(late_s=18.0),), "imu", "18.0 s late"),
    "compass for yaw": ((heading(lambda psi: np.pi / 2 - psi),), "heading", "compass"),
    "heading in radians": ((heading(lambda psi: np.radians(np.angle(np.exp(1j * psi)))),), "heading", "radians"),
    "heading in degrees": ((heading(lambda psi: np.degrees(psi)),), "heading", "degrees are read as radians"),
    "heading late": ((stream("heading", late_s=18.0),), "heading", "18.0 s late"),
    "heading turned by 20°": ((turned("heading", 20.0),), "heading", "must be turned by -20"),
    "heading turned": ((turned("heading", 90.0),), "heading", "must be turned by -"),
    "DVL turned by 90°": ((turned("dvl", 90.0),), "dvl", "its yaw on the vehicle"),
    "DVL turned by 180°": ((turned("dvl", 180.0),), "dvl", "its yaw on the vehicle"),
    "DVL turned by 45°": ((turned("dvl", 45.0),), "dvl", "its yaw on the vehicle"),
    "DVL in cm/s": ((stream("dvl", 100.0),), "dvl", "ratio of cm/s"),
    "DVL in mm/s": ((stream("dvl", 1000.0),), "dvl", "ratio of mm/s"),
    "GPS late": ((stream("gps", late_s=18.0), without("truth")), "gps", "18 leap seconds"),
    "GPS early": ((stream("gps", late_s=-18.0), without("truth")), "gps", "s early"),
    "GPS a minute late": ((stream("gps", late_s=60.0), without("truth")), "gps", "s late"),
    "GPS west for east": ((stream("gps", [-1, 1, 1]),), "gps", "hemisphere W"),
    "GPS south for north": ((stream("gps", [1, -1, 1]),), "gps", "hemisphere S"),
    "GPS both": ((stream("gps", [-1, -1, 1]),), "gps", "S and W"),
    "GPS NED": ((stream("gps", [1, 1, -1], order=[1, 0, 2]),), "gps", "east and north are exchanged"),
    "depth turned over": ((stream("depth", -1.0),), "depth", "up and down are exchanged"),
    "depth in mm": ((stream("depth", 1000.0),), "depth", "ratio of mm"),
    "depth in bar": ((stream("depth", 0.1),), "depth", "ratio of bar"),
    "depth late": ((stream("depth", late_s=18.0),), "depth", "s late"),
    "depth with the atmosphere in it": ((raised("depth", -10.2),), "depth", "pressure of the atmosphere"),
    "depth without truth": (
        (raised("depth", 4.0), without("truth")),
        "depth",
        "m above the sea surface where the GPS",
    ),
    "depth by the truth": ((raised("depth", -10.0), without("gps")), "depth", "atmosphere is in its depths"),
    "depth in the air": ((raised("depth", 5.0), without("gps", "truth")), "depth", "m above the surface: its zero is"),
    "GPS heights": ((raised("gps", 50.0),), "gps", "above the ellipsoid"),
    "depth's sigma": ((sigma("depth", 1e-3),), "depth", "times the stated sigma"),
    "heading's sigma": ((sigma("heading", 1e4),), "heading", "no sensor's"),
}


def marred(what: str) -> Log:
    log = sail()
    for fault in FAULTS[what][0]:
        log = fault(log)
    return log


def found_in(folder: Path) -> tuple[Finding, ...]:
    description = read_description(folder / "log.yaml")
    return tuple(resolved(finding, description) for finding in quick_findings(open_log(folder)))


def apply(folder: Path, finding: Finding) -> None:
    """Put the lines of a fix into log.yaml, as they are."""
    raw = yaml.safe_load((folder / "log.yaml").read_text())
    for line in finding.fix.split("\n"):
        path, value = line.split(": ", 1)
        *parents, last = path.split(".")
        part = raw
        for key in parents:
            part = part.setdefault(key, {})
        part[last] = yaml.safe_load(value)
    (folder / "log.yaml").write_text(yaml.safe_dump(raw))


@pytest.mark.parametrize("what", FAULTS)
def test_a_gross_fault_is_found_and_its_advice_mends_it(what: str, tmp_path: Path) -> None:
    _, blamed, words = FAULTS[what]
    folder = write_folder(marred(what), tmp_path / "log")
    findings = found_in(folder)
    assert {finding.stream for finding in findings} == {blamed}, findings
    assert any(words in finding.message for finding in findings), findings
    for finding in findings:
        assert finding.fix, finding
        apply(folder, finding)
    assert found_in(folder) == ()


@pytest.mark.parametrize("what", ["left-handed y", "GPS early", "depth turned over", "depth with the atmosphere in it"])
def test_inspect_says_it_too_and_blames_no_other_stream(what: str, tmp_path: Path) -> None:
    _, blamed, words = FAULTS[what]
    folder = write_folder(marred(what), tmp_path / "log")
    inspection = inspect_log(*open_to_inspect(folder), read_description(folder / "log.yaml"))
    assert {finding.stream for finding in inspection.findings} == {blamed}
    assert any(words in finding.message for finding in inspection.findings)


def test_gravity_that_is_not_there_is_found() -> None:
    (finding,) = quick_findings(imu(accel=0.0)(sail()))
    assert "gravity was removed" in finding.message


TRUTH: dict[str, tuple[Callable[[Array], Array], float, str]] = {
    "late": (lambda p: p, 18.0, "18.0 s late"),
    "early": (lambda p: p, -2.0, "2.0 s early"),
    "west for east": (lambda p: p * [-1, 1, 1], 0.0, "hemisphere W"),
    "NED": (lambda p: p[:, [1, 0, 2]] * [1, 1, -1], 0.0, "east and north are exchanged"),
    "too high": (
        lambda p: p + np.array([0, 0, 30]),
        0.0,
        "+30.00 m (median) against the depth sensor's throughout, which is at the",
    ),
    "upside down": (lambda p: p * [1, 1, -1], 0.0, "up and down are exchanged"),
}


@pytest.mark.parametrize("what", TRUTH)
def test_a_truth_that_is_grossly_wrong_is_found(what: str) -> None:
    of_p, late_s, words = TRUTH[what]
    log = sail()
    assert log.truth is not None
    p, t_ns = of_p(log.truth.p_WB_W), log.truth.t_ns + round(late_s * 1e9)
    (finding,) = quick_findings(replace(log, truth=replace(log.truth, p_WB_W=p, t_ns=t_ns, v_WB_W=None)))
    assert finding.stream == "truth"
    assert words in finding.message


def geodetic(folder: Path, log: Log, **columns: Any) -> Path:
    """Write a log with fixes as latitude and longitude, read from the columns given."""
    write_folder(replace(log, truth=None), folder)
    assert log.gps is not None
    latitude, longitude = (np.array([np.radians(x)]) for x in PORTO)
    at_origin = ecef_from_geodetic(latitude, longitude, np.zeros(1))
    flat = np.column_stack([log.gps.z[:, :2], np.zeros(len(log.gps))])
    lat, lon, _ = geodetic_from_ecef(at_origin + flat @ enu_axes(latitude, longitude)[0])
    table = pd.read_parquet(folder / "gps.parquet").assign(lat=np.degrees(lat), lon=np.degrees(lon))
    table.assign(west=-table["lon"]).to_parquet(folder / "gps.parquet")
    raw = yaml.safe_load((folder / "log.yaml").read_text())
    del raw["streams"]["gps"]["position"]
    raw["streams"]["gps"]["geodetic"] = {"latitude": "lat", "longitude": "lon"} | columns
    (folder / "log.yaml").write_text(yaml.safe_dump(raw))
    return folder


def test_a_height_whose_zero_nothing_tells_is_told_and_not_guessed() -> None:
    log = without("gps")(sail())
    (finding,) = quick_findings(raised("depth", -4.0)(log))
    assert (finding.stream, finding.fix) == ("truth", "")
    assert "nothing tells which" in finding.message


def test_fixes_of_an_acoustic_system_do_not_show_the_surface() -> None:
    """They are heard at any depth, and at a constant one they are told apart in words."""
    log = without("truth")(sail())
    assert log.truth is None
    assert log.gps is not None
    assert log.depth is not None
    truth = sail().truth
    assert truth is not None
    p = truth.p_WB_W[::10]
    everywhere = type(log.gps)(
        truth.t_ns[::10], truth.t_ns[::10], p, np.broadcast_to([1.5, 1.5, np.inf], p.shape).copy()
    )
    assert quick_findings(replace(log, gps=everywhere)) == ()
    z = np.full_like(log.depth.z, -5.0) + 0.01 * np.random.default_rng(1).standard_normal(log.depth.z.shape)
    level = type(log.depth)(log.depth.t_ns, log.depth.received_ns, z, log.depth.sigma)
    (finding,) = quick_findings(replace(log, gps=everywhere, depth=level, dvl=None))
    assert "acoustic" in finding.hint


@pytest.mark.parametrize(
    ("path", "there", "line"),
    [
        ("truth", {"geodetic": PLACE, "height_m": -0.15}, "truth.height_m: 9.85"),
        (
            "truth",
            {"frame": "NED", "position": {"columns": [1, 2, 3], "unit": "cm"}},
            "truth.position.offset: [0, 0, -1000]",
        ),
        ("truth", {"geodetic": {**PLACE, "altitude": ALTITUDE}}, "truth.geodetic.altitude.offset: 12"),
        ("truth", {"frame": "ECEF", "position": {"columns": [1, 2, 3], "unit": "m"}}, None),
    ],
)
def test_a_height_is_raised_in_the_key_that_states_it(
    path: str, there: dict[str, Any], line: str | None, tmp_path: Path
) -> None:
    raw = yaml.safe_load((write_folder(sail(), tmp_path / "log") / "log.yaml").read_text())
    put(raw, path, {"table": {"file": "x.csv"}, "time": {"column": "t"}, **there})
    assert resolve(f"{path}: raise 10.0", raw) == (None if line is None else [line])


def test_latitude_and_longitude_that_are_exchanged_are_found(tmp_path: Path) -> None:
    folder = geodetic(tmp_path / "log", sail(), latitude="lon", longitude="lat")
    (finding,) = found_in(folder)
    assert "swapped" in finding.message
    apply(folder, finding)
    assert yaml.safe_load((folder / "log.yaml").read_text())["streams"]["gps"]["geodetic"]["latitude"] == "lat"
    assert found_in(folder) == ()


def test_a_lost_hemisphere_is_found_and_no_compass_blamed(tmp_path: Path) -> None:
    (finding,) = found_in(geodetic(tmp_path / "log", sail(), longitude="west"))
    assert finding.stream == "gps"
    assert "hemisphere W" in finding.message


@pytest.mark.parametrize(
    "columns",
    [{"longitude": "west"}, {"scale": [-1, 1]}, {"scale": [-1, -1]}, {"latitude": "lon", "longitude": "lat"}],
)
def test_fixes_far_from_a_stated_origin_are_brought_near_by_signs_or_order(
    columns: dict[str, Any], tmp_path: Path
) -> None:
    folder = geodetic(tmp_path / "log", sail(), **columns)
    raw = yaml.safe_load((folder / "log.yaml").read_text())
    raw["origin"] = {"latitude_deg": PORTO[0], "longitude_deg": PORTO[1]}
    (folder / "log.yaml").write_text(yaml.safe_dump(raw))
    (finding,) = found_in(folder)
    assert "km from W's origin, and near it with" in finding.message
    apply(folder, finding)
    assert found_in(folder) == ()


def test_fixes_that_no_sign_brings_near_are_only_told(tmp_path: Path) -> None:
    folder = geodetic(tmp_path / "log", sail())
    raw = yaml.safe_load((folder / "log.yaml").read_text())
    raw["origin"] = {"latitude_deg": 10.0, "longitude_deg": 20.0}
    (folder / "log.yaml").write_text(yaml.safe_dump(raw))
    (finding,) = found_in(folder)
    assert finding.fix == ""
    assert "another's" in finding.message


def test_leap_seconds_are_advised_exactly(tmp_path: Path) -> None:
    (finding,) = found_in(write_folder(marred("GPS late"), tmp_path / "log"))
    assert finding.fix == "streams.gps.time.clock_offset_s: -18"


TUM = {"truth": {"tum": "truth.tum"}}
HEMISPHERES = {"latitude": "lat", "longitude": "lon", "north_south": "ns"}


@pytest.mark.parametrize(
    ("fix", "there", "hint"),
    [
        ("truth.frame: NED  # or ENU, whichever it is not", TUM, "exchange x and y, and negate z"),
        ("truth: mirror latitude", TUM, "negate y"),
        ("streams.heading.heading.unit: rad", {"streams.heading.attitude.form": "matrix"}, "form, axes and world"),
        ("streams.gps: mirror latitude", {"streams.gps.geodetic": HEMISPHERES}, "the right letter into the column ns"),
    ],
)
def test_advice_for_a_key_that_is_none_of_the_log_is_in_words(fix: str, there: dict[str, Any], hint: str) -> None:
    raw: dict[str, Any] = {}
    for path, value in there.items():
        put(raw, path, value)
    assert hint in in_words(fix, raw)


def test_an_attitude_that_hardly_turns_is_not_told_as_a_heading_in_radians() -> None:
    log = sail()
    assert log.heading is not None
    psi = np.radians(np.angle(np.exp(1j * log.heading.z[:, 0])))
    R = Rotation.from_rotvec(np.outer(psi, [0, 0, 1])).as_matrix().reshape(-1, 9)
    attitude = AttitudeStream(log.heading.t_ns, log.heading.received_ns, R, np.full((len(R), 3), 0.01))
    (finding,) = quick_findings(replace(log, heading=attitude, truth=None))
    assert finding.stream == "heading"
    assert finding.fix == ""
    assert "form" in finding.hint


def test_zeros_of_a_dvl_blame_no_other_stream() -> None:
    log = sail()
    assert log.dvl is not None
    z = np.where((np.arange(len(log.dvl)) % 50 < 10)[:, None], 0.0, log.dvl.z)
    zeroed = replace(log, dvl=type(log.dvl)(log.dvl.t_ns, log.dvl.received_ns, z, log.dvl.sigma))
    assert {finding.stream for finding in quick_findings(zeroed)} <= {"dvl"}


def test_a_stuck_piece_of_the_depth_is_no_scale() -> None:
    log = sail()
    assert log.depth is not None
    rows = np.arange(len(log.depth))
    first = int(np.argmin(np.gradient(np.convolve(log.depth.z[:, 0], np.ones(50) / 50, "same"))[50:-50])) + 50
    stuck = (rows >= first) & (rows < first + len(rows) // 10)
    z = np.where(stuck[:, None], log.depth.z[first], log.depth.z)
    depth = type(log.depth)(log.depth.t_ns, log.depth.received_ns, z, log.depth.sigma)
    sketch, as_it_was = (sketch_of(replace(log, depth=each)) for each in (depth, log.depth))
    assert sketch is not None
    assert as_it_was is not None
    assert climb_scale(sketch) == pytest.approx(climb_scale(as_it_was), abs=0.01)


def w_first(R: Array) -> Array:
    """Attitudes (n, 3, 3) whose quaternions are written x, y, z, w and read w, x, y, z."""
    return Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), -1, axis=1)).as_matrix()


def test_quaternions_read_from_the_wrong_end_are_found() -> None:
    log = sail()
    assert log.truth is not None
    (finding,) = quick_findings(replace(log, truth=replace(log.truth, R_WB=w_first(log.truth.R_WB))))
    assert finding.stream == "truth"
    assert finding.fix.startswith("truth.attitude.form: ")
    R = w_first(log.truth.R_WB).reshape(-1, 9)
    attitude = AttitudeStream(log.truth.t_ns, log.truth.t_ns, R, np.full((len(R), 3), 0.01))
    (finding,) = quick_findings(replace(log, heading=attitude, truth=None))
    assert finding.fix.startswith("streams.heading.attitude.form: ")


def test_a_truth_in_other_axes_is_found() -> None:
    log = sail()
    assert log.truth is not None
    (finding,) = quick_findings(replace(log, truth=replace(log.truth, R_WB=log.truth.R_WB * [1, -1, -1])))
    assert finding.stream == "truth"
    assert "is tilted by 17" in finding.message


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_milliseconds_taken_for_seconds_are_found(factor: float) -> None:
    log = sail()
    assert log.dvl is not None
    t_ns = (log.dvl.t_ns * factor).astype(np.int64)
    dvl = type(log.dvl)(t_ns, t_ns, log.dvl.z, log.dvl.sigma)
    (finding,) = quick_findings(replace(log, dvl=dvl))
    assert finding.stream == "dvl"
    assert f"last {factor:g} times as long" in finding.message


def test_what_does_not_show_is_not_guessed() -> None:
    steady = Scenario(mission="transit", duration_s=120.0, wobble_deg=0.0, leg_m=1e4, depth_m=1.0)
    log = replace(simulate(steady, seed=1), truth=None)
    assert log.gps is not None
    mirrored = type(log.gps)(log.gps.t_ns, log.gps.received_ns, log.gps.z * [-1, 1, 1], log.gps.sigma)
    assert not [finding for finding in gross_check(replace(log, gps=mirrored)).findings if finding.fix]


@pytest.mark.parametrize(
    ("mission", "grade"), [("lawnmower", "consumer"), ("helix", "tactical"), ("box", "navigation")]
)
def test_a_right_log_gives_no_alarm(mission: str, grade: str) -> None:
    assert quick_findings(sail(mission, imu=grade)) == ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("grade", IMU_GRADES)
@pytest.mark.parametrize("mission", MISSIONS)
def test_no_right_log_gives_an_alarm(mission: str, grade: str, seed: int) -> None:
    assert quick_findings(sail(mission, seed, grade, [120.0, 900.0][seed])) == ()


def test_recorded_logs_give_no_alarm(recorded_data: Path) -> None:
    names = [path.name for path in sorted(recorded_data.iterdir()) if path.is_dir()]
    assert {name: quick_findings(open_log(name, recorded_data)) for name in names} == dict.fromkeys(names, ())


def rows(name: str, begin: int, end: int, value: Any) -> Callable[[Log], Log]:
    """Rows of a stream, or of "gyro" or "accel", set to a value; None repeats the first of them."""

    def of(log: Log) -> Log:
        inertial = {"gyro": log.imu.w_WI_I, "accel": log.imu.f_I}
        z = (inertial[name] if name in inertial else log.streams[name].z).copy()
        z[begin:end] = z[begin] if value is None else value
        if name in inertial:
            return replace(log, imu=ImuStream(log.imu.t_ns, *{**inertial, name: z}.values()))
        old: ReadingStream = getattr(log, name)
        return replace(log, **{name: type(old)(old.t_ns, old.received_ns, z, old.sigma)})

    return of


def some(name: str, every: int, value: float) -> Callable[[Log], Log]:
    """Every so many rows of a stream set to a value."""

    def of(log: Log) -> Log:
        old: ReadingStream = getattr(log, name)
        z = old.z.copy()
        z[::every] = value
        return replace(log, **{name: type(old)(old.t_ns, old.received_ns, z, old.sigma)})

    return of


READINGS: dict[str, tuple[Callable[[Log], Log], str, str]] = {
    "a mark in 4 %": (some("dvl", 25, -32.768), "dvl", "hold -32.768 m/s"),
    "a mark of integers": (some("dvl", 25, -32768.0), "dvl", "hold -32768 m/s"),
    "three marks": (rows("dvl", 100, 103, -32.768), "dvl", "3 rows of dvl"),
    "zeros": (some("dvl", 10, 0.0), "dvl", "exactly zero on every axis"),
    "a fix far off": (rows("gps", 30, 31, [1e3, 0.0, 0.0]), "gps", "stand out of their neighbours"),
    "a gyro's spike": (rows("gyro", 4000, 4001, 30.0), "imu", "stand out of their neighbours"),
    "a gyro of zeros": (imu(gyro=0.0), "imu", "gyro never changes"),
    "a dead axis": (imu(gyro=np.diag([1.0, 1.0, 0.0])), "imu", "gyro z is 0 rad/s in every row"),
    "a dead axis of the DVL": (stream("dvl", [1.0, 0.0, 1.0]), "dvl", "dvl y is 0 m/s in every row"),
    "a dead DVL": (stream("dvl", 0.0), "dvl", "dvl never changes"),
    "a dead depth sensor": (stream("depth", 0.0), "depth", "depth never changes"),
    "a dead heading": (stream("heading", 0.0), "heading", "heading never changes"),
    "a stuck gyro": (rows("gyro", 2000, 2500, None), "imu", "gyro is stuck from 80.0 to"),
    "a gyro of zeros for 20 s": (rows("gyro", 2000, 2500, 0.0), "imu", "gyro is stuck from"),
    "a stuck accelerometer": (rows("accel", 2000, 2500, None), "imu", "accel is stuck from 80.0 to"),
    "a stuck DVL": (rows("dvl", 300, 400, None), "dvl", "dvl is stuck from"),
    "a stuck heading": (rows("heading", 300, 400, None), "heading", "heading is stuck from"),
    "a stuck depth sensor": (rows("depth", 600, 800, None), "depth", "depth is stuck from"),
    "a stated sigma of a knot and more": (sigma("dvl", 500.0), "dvl", "its readings hardly count"),
}


@pytest.mark.parametrize("what", READINGS)
def test_a_gross_reading_is_found_alone(what: str) -> None:
    spoil, blamed, words = READINGS[what]
    (finding,) = quick_findings(spoil(sail()))
    assert finding.stream == blamed
    assert words in finding.message
    assert "every" not in finding.hint


@pytest.mark.parametrize("what", ["a mark in 4 %", "a fix far off", "a stuck DVL", "a dead depth sensor"])
def test_a_gross_reading_causes_no_second_finding(what: str) -> None:
    spoil, blamed, words = READINGS[what]
    (finding,) = inspect_log(spoil(sail())).findings
    assert finding.stream == blamed
    assert words in finding.message


def at_rest(name: str, begin: int, end: int, step: float) -> Callable[[Log], Log]:
    """A stream in steps, which stays at one of them between two rows and goes on from there without a leap."""

    def of(log: Log) -> Log:
        old: ReadingStream = getattr(log, name)
        z = np.rint(old.z / step) * step
        z[begin:end] = z[begin]
        z[end:] += z[begin] - z[end]
        return replace(log, **{name: type(old)(old.t_ns, old.received_ns, z, old.sigma)})

    return of


def test_what_may_rest_is_not_called_stuck() -> None:
    log = sail()
    assert log.dvl is not None
    stopping = np.clip(np.abs(np.arange(len(log.dvl)) - 1000) / 50 - 2, 0.0, 1.0)
    for still in (
        at_rest("depth", 600, 800, 0.01),
        at_rest("heading", 300, 400, 0.01),
        stream("dvl", stopping[:, None]),
        stream("dvl", [1.0, 0.0, 0.0]),
    ):
        assert not reading_findings(still(log))
