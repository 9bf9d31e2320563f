"""The cross-sensor checks: silent on clean logs, right about planted faults, and mended by what they propose."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.bench.drawing import empty_figure
from fathom.bench.inspection.between.clock import fit_clocks
from fathom.bench.inspection.between.cross_checks import cross_checks
from fathom.bench.inspection.between.lever_arm import products
from fathom.bench.inspection.between.pair_check import Delay
from fathom.bench.inspection.findings.advice import resolved
from fathom.bench.inspection.findings.finding import Check, Finding
from fathom.bench.inspection.findings.fitting import Estimate, blocks_of, least_squares
from fathom.datasets import Log, Scenario, Trajectory, open_log, simulate
from fathom.datasets.described.description import read_description
from fathom.datasets.described.folder import write_folder
from fathom.datasets.described.opening import CATALOG
from fathom.datasets.log import DvlStream, ImuStream
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.slow  # whole runs and searches: seconds each

MISSIONS = ("lawnmower", "yo-yo", "helix", "box", "transit")
ICTINEU, LAUV = "ictineu_stpere_2004", "lauv_noptilus2_2015"


def sail(seed: int = 3, **dials: Any) -> Log:
    dials = {"mission": "lawnmower", "duration_s": 300, "imu": "industrial", **dials}
    return simulate(Scenario.from_dict(dials), seed=seed)


def findings(log: Log) -> list[Finding]:
    return [finding for check in cross_checks(log) for finding in check.findings]


def fact(checks: list[Check], title: str, name: str) -> tuple[float, float]:
    """The value and the sigma of a fact, as the page shows them."""
    (check,) = (check for check in checks if check.title == title)
    return numbers(check.facts[name])


def numbers(text: str) -> tuple[float, float]:
    found = re.search(r"(-?[\d.]+) ± ([\d.]+)", text)
    assert found is not None, text
    return float(found[1]), float(found[2])


def change(description: dict[str, Any], path: str, value: Any) -> None:
    *parents, last = path.split(".")
    part = description
    for key in parents:
        part = part.setdefault(key, {})
    if value is None:
        part.pop(last, None)
    else:
        part[last] = value


def rewrite(file: Path, changes: dict[str, Any]) -> Path:
    description = yaml.safe_load(file.read_text())
    for path, value in changes.items():
        change(description, path, value)
    file.write_text(yaml.safe_dump(description))
    return file


def fix(file: Path, finding: Finding) -> None:
    """Put the lines that a finding proposes for a description into it, as they are."""
    proposed = resolved(finding, read_description(file))
    assert proposed.fix, finding
    lines = (line.split(": ", 1) for line in proposed.fix.split("\n"))
    rewrite(file, {path: yaml.safe_load(value) for path, value in lines})


# (a) clean logs


@pytest.mark.parametrize(("mission", "imu"), [("lawnmower", "consumer"), ("yo-yo", "tactical")])
def test_a_clean_log_gives_no_finding(mission: str, imu: str) -> None:
    assert findings(sail(seed=11, mission=mission, imu=imu)) == []


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mission", MISSIONS)
@pytest.mark.parametrize("imu", ["consumer", "industrial", "tactical", "navigation"])
def test_no_clean_log_gives_a_finding(mission: str, imu: str, seed: int) -> None:
    assert findings(sail(seed=seed, mission=mission, imu=imu)) == []


@pytest.mark.parametrize("absent", ["heading", "gps", "depth", "dvl"])
def test_a_log_without_a_sensor_is_checked_by_the_others(absent: str) -> None:
    checks = cross_checks(sail(**{absent: None}))
    assert not [finding for check in checks for finding in check.findings]
    assert not [c.title for c in checks if absent in c.title.lower() and "heading" not in absent]


def test_a_car_has_no_depth_no_heading_and_a_dvl_of_one_axis() -> None:
    log = sail(heading=None, depth=None, dvl={"faults": {"scale": 1.03}})
    assert log.dvl is not None
    sigma = log.dvl.sigma.copy()
    sigma[:, 1:] = np.inf
    wheels = DvlStream(log.dvl.t_ns, log.dvl.received_ns, log.dvl.z * [1.0, np.pi, np.pi], sigma)
    checks = cross_checks(replace(log, dvl=wheels))
    value, sigma_of_it = fact(checks, PATH, "scale that the DVL needs")
    assert abs(value - 1 / 1.03) < max(3 * sigma_of_it, 0.002)  # what was not measured is taken for zero
    (velocity,) = (check for check in checks if check.title == VELOCITY)
    assert [velocity.facts[f"DVL less truth, {axis}"] for axis in ("left", "up")] == ["not measured"] * 2
    found = {finding.fix.split(": ")[0] for check in checks for finding in check.findings}
    assert found == {"streams.dvl.velocity.scale"}


def test_odd_logs_are_checked_as_far_as_they_go() -> None:
    log = sail()
    assert log.truth is not None
    bare = Trajectory(log.truth.t_ns[::10], np.full_like(log.truth.R_WB[::10], np.nan), log.truth.p_WB_W[::10])
    dead = ImuStream(log.imu.t_ns, 0 * log.imu.w_WI_I, 0 * log.imu.f_I + [0.0, 0.0, -9.8])
    cut = sail(
        imu={"noise": "industrial", "faults": {"outages_s": [[60, 63]]}}, dvl={"faults": {"outages_s": [[100, 160]]}}
    )
    for odd in (replace(log, truth=None), replace(log, truth=bare), cut, sail(duration_s=20)):
        assert findings(odd) == []
    titles = {check.title: check for check in cross_checks(replace(log, imu=dead, dvl=None, truth=None))}
    assert "not observable" in titles["gyro against heading"].facts["heading by gyro, slope"]


def test_every_panel_draws_itself() -> None:
    drawn = 0
    for check in cross_checks(sail()):
        if check.draw is not None:
            _, (axes,) = empty_figure(1, 1, 4, 3)
            check.draw(axes)
            drawn += axes.has_data()
    assert drawn >= 6


# (b) faults that the simulator plants

LATE = {"faults": {"clock_offset_s": 0.4}}
EARLY = {"faults": {"clock_offset_s": -0.4}}
CLOCK = "clocks: {} later than the IMU by"
PATH, VELOCITY = "DVL against the positions of the truth", "DVL against the velocity of the truth"
PLANTED: dict[str, tuple[dict[str, Any], str, str, float]] = {
    # dials, the stream found, "check: fact", its true value
    "dvl late": ({"dvl": LATE}, "dvl", CLOCK.format("dvl"), 0.4),
    "imu late": ({"imu": {"noise": "industrial", "faults": {"clock_offset_s": 0.4}}}, "imu", CLOCK.format("dvl"), -0.4),
    "dvl scale": ({"dvl": {"faults": {"scale": 1.03}}}, "dvl", f"{PATH}: scale that the DVL needs", 1 / 1.03),
    "heading offset": (
        {"heading": {"faults": {"bias_deg": -5}}},
        "heading",
        "heading against truth: heading less truth",
        -5.0,
    ),
    "imu turned": (
        {"imu": {"noise": "industrial", "faults": {"misalignment_deg": [0, 0, 5]}}},  # about its own z, which is down
        "imu",
        "IMU against DVL: DVL's axes in the IMU's as mounted, yaw",
        5.0,
    ),
    "dvl early": ({"dvl": EARLY}, "dvl", CLOCK.format("dvl"), -0.4),
    "heading late": ({"heading": LATE}, "heading", CLOCK.format("heading"), 0.4),
    "depth late": ({"mission": "yo-yo", "depth": LATE}, "depth", CLOCK.format("depth"), 0.4),
    "dvl turned": (
        {"dvl": {"faults": {"misalignment_deg": [0, 0, 4]}}},
        "dvl",
        f"{VELOCITY}: DVL's axes in the truth's, yaw",
        4.0,
    ),
    "dvl pitched": (
        {"dvl": {"faults": {"misalignment_deg": [0, 3, 0]}}},
        "dvl",
        f"{VELOCITY}: DVL's axes in the truth's, pitch",
        3.0,
    ),
    "gyro scale": (
        {"imu": {"noise": "industrial", "faults": {"gyro_scale": [1.1, 1.1, 1.1]}}},
        "imu",
        "gyro against heading: heading by gyro, slope",
        1 / 1.1,
    ),
    "depth scale": (
        {"mission": "yo-yo", "depth": {"faults": {"scale": 1.05}}},
        "depth",
        "depth against truth: depth sensor by truth, slope",
        1.05,
    ),
}


@pytest.mark.parametrize("what", PLANTED)
def test_a_planted_fault_is_found_with_its_size(what: str) -> None:
    dials, stream, where, true = PLANTED[what]
    checks = cross_checks(sail(**dials))
    value, sigma = fact(checks, *where.split(": "))
    assert abs(value - true) < 3 * sigma
    nominal = 1.0 if "scale" in where or "slope" in where else 0.0
    assert abs(true - nominal) > 5 * sigma
    found = {finding.stream for check in checks for finding in check.findings}
    assert found == ({"dvl", "imu"} if "axes in the truth" in where else {stream})


@pytest.mark.parametrize("seed", [3, 4])
def test_the_lever_arm_is_found_where_turning_excites_it(seed: int) -> None:
    checks = cross_checks(sail(seed, imu={"noise": "industrial", "faults": {"lever_arm_error_m": [0.4, -0.3, 0.3]}}))
    (check,) = (check for check in checks if check.title == "IMU against DVL")
    said = check.facts["IMU's place from the DVL"].split(", ")
    for text, true in zip(said, (-0.35 + 0.4, 0.05 - 0.3, 0.12 + 0.3), strict=True):
        value, sigma = numbers(text)
        assert abs(value - true) < 3 * sigma
        assert sigma < 0.05
    (finding,) = check.findings
    assert finding.fix.startswith("streams.imu.mounting.translation_m: ")


def test_a_steady_course_says_that_the_lever_arm_is_not_observable() -> None:
    log = sail(mission="transit", wobble_deg=0.0, leg_m=1e4, surface_every_s=1e5, surface_for_s=1e-3, depth_m=1.0)
    (check,) = (check for check in cross_checks(log) if check.title == "IMU against DVL")
    assert all(
        "not observable" in value for name, value in check.facts.items() if name in ("IMU's place from the DVL",)
    )
    assert check.findings == ()


@pytest.mark.parametrize("mission", ["lawnmower", "box"])
def test_a_truth_of_another_point_is_found_and_no_sensor_blamed(mission: str) -> None:
    log = sail(mission=mission)
    assert log.truth is not None
    p = log.truth.p_WB_W + log.truth.R_WB @ [1.5, -0.5, 0.0]
    (finding,) = findings(replace(log, truth=replace(log.truth, p_WB_W=p, v_WB_W=None)))
    assert finding.stream == "truth"
    found = [float(each) for each in re.findall(r"(-?[\d.]+) ±", finding.message)]
    np.testing.assert_allclose(found, [-1.5, 0.5], atol=0.05)


def test_a_truth_by_another_clock_is_found() -> None:
    log = sail()
    assert log.truth is not None
    late = replace(log.truth, t_ns=log.truth.t_ns + 300_000_000)
    (finding,) = findings(replace(log, truth=late))
    assert finding.stream == "truth"
    assert float(finding.fix.removeprefix("truth.time.clock_offset_s: ")) == pytest.approx(-0.3, abs=0.02)


# (b) descriptions that are wrong

WRONG: dict[str, tuple[dict[str, Any], str]] = {
    # what the description says, what a finding proposes to change
    "compass for yaw": ({"streams.heading.convention": "compass"}, "streams.heading.convention"),
    "dvl axes": ({"streams.dvl.axes": "FRD"}, "streams.dvl.axes"),
    "dvl late": ({"streams.dvl.time.clock_offset_s": 0.3}, "streams.dvl.time.delay_s"),
    "heading turned": ({"streams.heading.add_deg": 6.0}, "streams.heading.add_deg"),
    "imu mounting": (
        {"streams.imu.mounting": {"yaw_deg": -90, "translation_m": [-0.35, 0.05, 0.12]}},
        "streams.imu.mounting",
    ),
    "heading in degrees": ({"streams.heading.heading.unit": "deg"}, "streams.heading.heading.unit"),
    "gyro in degrees": ({"streams.imu.gyro.unit": "deg/s"}, "streams.imu.gyro.unit"),
    "gyro mirrored": ({"streams.imu.gyro.scale": [1, 1, -1]}, "streams.imu.gyro.scale"),
    "dvl in cm": ({"streams.dvl.velocity.unit": "cm/s"}, "streams.dvl.velocity.unit"),
    "imu axes": ({"streams.imu.axes": "FRD"}, "streams.imu.axes"),
    "gps frame": ({"streams.gps.frame": "NED"}, "streams.gps.frame"),
    "depth sign": ({"streams.depth.positive": "down"}, "streams.depth.positive"),
    "depth offset": ({"streams.depth.depth.offset": 0.7}, "streams.depth.depth.offset"),
    "heading early": ({"streams.heading.time.clock_offset_s": -0.3}, "streams.heading.time.clock_offset_s"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(sail(), tmp_path_factory.mktemp("log") / "clean")


@pytest.mark.parametrize("what", WRONG)
def test_what_a_finding_proposes_makes_it_vanish(written: Path, tmp_path: Path, what: str) -> None:
    changes, path = WRONG[what]
    file = tmp_path / "log.yaml"
    file.write_text((written / "log.yaml").read_text())
    rewrite(file, changes)
    found = findings(open_log(file, data=written))
    proposed = {finding.fix: finding for finding in found if finding.fix.startswith(path)}
    assert len(proposed) == 1, found
    fix(file, *proposed.values())
    assert findings(open_log(file, data=written)) == []


# (c) recorded logs, through descriptions that miss one of their corrections


def naive(tmp_path: Path, data: Path, name: str, changes: dict[str, Any]) -> Log:
    if not (data / name).is_dir():
        pytest.skip(f"no {data / name}")
    file = tmp_path / "naive.yaml"
    file.write_text((CATALOG / f"{name}.yaml").read_text())
    return open_log(rewrite(file, changes), data=data / name)


def test_the_declination_of_lauv_is_found(tmp_path: Path, recorded_data: Path) -> None:
    checks = cross_checks(naive(tmp_path, recorded_data, LAUV, {"streams.heading.add_deg": None}))
    (finding,) = (f for check in checks for f in check.findings if f.stream == "heading")
    assert float(finding.fix.split(": ")[1].split()[0]) == pytest.approx(-2.6, abs=0.1)


def test_the_offset_of_lauvs_reference_height_is_found(tmp_path: Path, recorded_data: Path) -> None:
    z = {"truth.position": {"columns": ["x", "y", "z"], "unit": "m"}}
    log = naive(tmp_path, recorded_data, LAUV, z)
    description = read_description(tmp_path / "naive.yaml")
    (finding,) = (resolved(f, description) for f in findings(log) if f.fix.startswith("truth: raise"))
    assert "reference" in finding.message
    offset = yaml.safe_load(finding.fix.split(": ", 1)[1].split("#")[0])
    np.testing.assert_allclose(offset, [0, 0, 57.547], atol=0.001)
    log = naive(tmp_path, recorded_data, LAUV, {**z, "truth.position.offset": offset})
    assert not [f for f in findings(log) if "raise" in f.fix]


def test_lauvs_reference_does_not_climb_as_it_says(tmp_path: Path, recorded_data: Path) -> None:
    checks = cross_checks(naive(tmp_path, recorded_data, LAUV, {}))
    value, sigma = fact(checks, "reference against itself", "velocity less what the positions do, up")
    assert value == pytest.approx(-0.04, abs=max(3 * sigma, 0.005))
    assert "truth.velocity: null" in {f.fix for check in checks for f in check.findings}


def test_the_heading_offset_of_ictineu_is_found(tmp_path: Path, recorded_data: Path) -> None:
    checks = cross_checks(naive(tmp_path, recorded_data, ICTINEU, {"streams.heading.add_deg": None}))
    turn, sigma = fact(checks, PATH, "turn of the DVL's path onto the truth's")
    assert abs(turn + 4.4) < 3 * sigma
    scale, sigma = fact(checks, PATH, "scale that the DVL needs")
    assert abs(scale - 1.028) < 3 * sigma
    assert [f.fix.split("#")[0].strip() for c in checks for f in c.findings] == ["streams.heading.add_deg: 4.4"]


def test_the_gyro_bias_of_ictineu_is_found_and_its_compass_is_disturbed(tmp_path: Path, recorded_data: Path) -> None:
    changes = {"streams.imu.noise.gyro_bias_sigma": 1e-3, "streams.heading.every": None, "streams.heading.sigma_deg": 2}
    checks = cross_checks(naive(tmp_path, recorded_data, ICTINEU, changes))
    bias, sigma = fact(checks, "gyro against heading", "gyro bias about the vertical")
    assert abs(bias + 0.0114) < max(3 * sigma, 0.0003)  # z down in its file, up in ours
    mends = {f.fix.split(": ")[0] for check in checks for f in check.findings}
    assert mends == {"streams.imu.noise.gyro_bias_sigma", "streams.heading.sigma_deg"}


def test_the_late_dvl_of_ictineu_does_not_show_in_its_streams(tmp_path: Path, recorded_data: Path) -> None:
    """Its own compass shows it, which no stream carries; what cannot be told is not told."""
    checks = cross_checks(naive(tmp_path, recorded_data, ICTINEU, {"streams.dvl.time.delay_s": None}))
    assert [f for check in checks for f in check.findings] == []
    titles = {check.title: check for check in checks}
    assert "not observable" in titles["IMU against DVL"].facts["delay, mounting, lever arm"]
    assert "not observable" in titles[PATH].facts["DVL later than the yaw by"]


# the tools


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_a_sigma_equals_the_scatter_for_noise_of_any_colour(colour: float) -> None:
    rng = np.random.default_rng(5)
    n, z = 1200, []
    x = np.sin(np.arange(n) / 40)
    for _ in range(200):
        white = rng.standard_normal(n + 200)
        noise = np.asarray(lfilter([1.0], [1.0, -colour], white))[200:]
        fit = least_squares({"slope": x, "offset": np.ones(n)}, 3 * x + noise, blocks_of(n))
        assert fit is not None
        z.append((fit["slope"].value - 3) / fit["slope"].sigma)
    assert 0.7 < np.std(z) < 1.4  # Student's t of 11 degrees of freedom: 1.11


def test_what_the_data_do_not_fix_has_a_sigma_that_is_reported() -> None:
    rng = np.random.default_rng(2)
    t = np.linspace(0, 1, 600)
    fit = least_squares({"a": t, "b": t * (1 + 1e-9)}, t + 0.01 * rng.standard_normal(600), blocks_of(600))
    assert fit is not None
    assert not fit["a"].known_to(1.0)


def test_products_of_rotations_are_those_of_a_loop() -> None:
    steps = Rotation.random(57, random_state=4).as_matrix()
    one_by_one = [np.eye(3)]
    for step in steps:
        one_by_one.append(one_by_one[-1] @ step)
    np.testing.assert_allclose(products(steps), one_by_one, atol=1e-12)


def test_clocks_are_chained_to_the_imu_and_a_contradiction_is_seen() -> None:
    def delay(late: str, than: str, by: float) -> Delay:
        return Delay(late, than, Estimate(by, 0.01))

    chain = [delay("heading", "imu", 0.1), delay("dvl", "heading", 0.2), delay("gps", "truth position", 1.0)]
    story = fit_clocks(chain)
    assert {name: round(late.value, 6) for name, late in story.late.items()} == {"heading": 0.1, "dvl": 0.3}
    assert story.agrees
    again = fit_clocks([*chain, delay("dvl", "imu", 0.31)])
    assert again.agrees
    assert again.late["dvl"].sigma < story.late["dvl"].sigma
    assert not fit_clocks([*chain, delay("dvl", "imu", 0.9)]).agrees


@pytest.mark.parametrize(
    ("estimate", "unit", "text"),
    [
        (Estimate(1.234, 0.056), "m", "1.234 ± 0.056 m"),
        (Estimate(-0.004, 0.5), "", "0.00 ± 0.50"),
        (Estimate(-3.21e-8, 1.23e-8), "rad/s", "-3.2e-08 ± 1.2e-08 rad/s"),
        (Estimate(0.0, np.inf), "m", "not observable"),
    ],
)
def test_an_estimate_is_shown_to_two_digits_of_its_sigma(estimate: Estimate, unit: str, text: str) -> None:
    assert estimate.text(unit) == text


def test_what_is_not_observable_has_a_sigma_with_or_without_a_unit() -> None:
    assert Estimate(1.0, 0.15).text_if(0.3) == "not observable here (sigma 0.15)"
    assert Estimate(1.0, 0.15).text_if(0.3, "s") == "not observable here (sigma 0.15 s)"
