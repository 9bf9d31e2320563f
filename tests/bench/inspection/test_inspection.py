"""The inspection finds each fault it can see in one stream, by name, and nothing in a clean log."""

from __future__ import annotations

import dataclasses
import functools
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from fathom.bench.cli.app import app
from fathom.bench.inspection.findings.finding import Finding
from fathom.bench.inspection.gross.gross import gross_check
from fathom.bench.inspection.inspecting import SINGLE, inspect_log, open_to_inspect
from fathom.bench.inspection.page import draw_inspection
from fathom.bench.inspection.streams.allan import FLICKER, allan_deviation, bias_instability, white_density
from fathom.bench.inspection.streams.channels import channels_of
from fathom.bench.inspection.streams.neighbours import noise_sigma, outliers, residuals
from fathom.bench.inspection.streams.norms import gyro_against_gravity, levelled
from fathom.bench.inspection.streams.quantisation import quantisation_of
from fathom.bench.inspection.streams.static import rests
from fathom.datasets import Log
from fathom.datasets.described.folder import write_folder
from fathom.datasets.log import AttitudeStream, DepthStream, DvlStream, ImuStream, ReadingStream
from fathom.datasets.rig import ImuNoise, Rig
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

FATHOM = Path(sys.executable).with_name("fathom")
UPRIGHT = {"imu": {"mounting": {}}}


@functools.lru_cache(maxsize=4)
def sailed(text: str, seed: int) -> Log:
    return simulate(Scenario.from_dict({"duration_s": 100} | yaml.safe_load(text)), seed)


def simulated(seed: int = 3, **keys: Any) -> Log:
    return sailed(yaml.safe_dump(keys), seed)


def wrong(log: Log) -> list[Finding]:
    """What the checks of single streams find, and the gross faults."""
    return [finding for check in (*SINGLE, gross_check) for finding in check(log).findings]


def said(findings: list[Finding] | tuple[Finding, ...], stream: str, words: str) -> Finding:
    """The one finding of a stream that says these words."""
    found = [finding for finding in findings if finding.stream == stream and words in finding.message]
    assert len(found) == 1, [finding.message for finding in findings]
    return found[0]


# a clean log


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    "keys",
    [
        {"mission": "lawnmower", "imu": "consumer"},
        {"mission": "yo-yo", "imu": "industrial"},
        {"mission": "helix", "imu": "tactical"},
        {"mission": "box", "imu": "navigation"},
        {"mission": "transit", "imu": "navigation", "waves": {"height_m": 0.5, "told": False}},
        {"mission": "helix", "speed_m_s": 3.0, "turn_radius_m": 8.0, "imu": "navigation", "duration_s": 300},
        {
            "latitude_deg": 60.0,
            "imu": {"rate_hz": 50.0, "faults": {"bias_correlation_s": 100.0}},
            "tide": {"amplitude_m": 1.0},
        },
        {"dvl": {"rate_hz": 25.0}, "depth": {"rate_hz": 50.0}, "heading": {"rate_hz": 50.0}},
        {"dvl": {"rate_hz": 1.0}, "depth": {"rate_hz": 1.0}, "heading": {"rate_hz": 1.0}},
    ],
    ids=str,
)
def test_nothing_looks_wrong_in_a_clean_log(keys: dict[str, Any], seed: int) -> None:
    inspection = inspect_log(simulated(seed, **keys))
    assert [finding.message for finding in inspection.findings] == []


def test_a_depth_sensor_that_is_told_of_waves_is_said_to_be_right_only_if_its_error_is_slow() -> None:
    (finding,) = inspect_log(simulated(mission="transit", waves={"height_m": 0.5})).findings
    assert "depth scatters from reading to reading by 0.02" in finding.message
    assert "only if most of the error is slow" in finding.message


def test_nothing_looks_wrong_in_a_full_attitude() -> None:
    log = simulated()
    assert log.heading is not None
    turn = log.heading.z * [[0.0, 0.0, 1.0]]
    R_WH = Rotation.from_rotvec(turn).as_matrix().reshape(-1, 9)
    sigma = np.repeat([[np.inf, np.inf, log.heading.sigma[0, 0]]], len(turn), axis=0)
    attitude = AttitudeStream(log.heading.t_ns, log.heading.received_ns, R_WH, sigma)
    assert wrong(dataclasses.replace(log, heading=attitude)) == []


# every fault of one stream that shows in it

FAULTS: list[tuple[str, dict[str, Any], str]] = [
    ("imu", {"dropout_probability": 0.02}, "readings are missing"),
    ("imu", {"outages_s": [[40, 42]]}, "silence of more than 0.1 s; the longest is 2.02 s, from 40.0 s"),
    ("imu", {"gyro_limit_deg_s": 4.0}, "gyro z is clipped"),
    ("imu", {"accel_limit_m_s2": 9.8}, "accel z is clipped"),
    ("imu", {"gyro_quantum_deg_s": 0.5}, "comes in steps of 0.00873 rad/s"),
    ("imu", {"accel_quantum_m_s2": 0.1}, "comes in steps of 0.1 m/s²"),
    ("imu", {"accel_scale": [1.05, 1.05, 1.05]}, "Scale or bias"),
    ("imu", {"misalignment_deg": [90, 0, 0]}, "points 90° off"),
    ("imu", {"misalignment_deg": [180, 0, 0]}, "points down in the body"),
    ("dvl", {"dropout_probability": 0.15}, "readings are missing"),
    ("dvl", {"outages_s": [[40, 60]]}, "silence of more than 5 s; the longest is 20.4 s, from 39.8 s"),
    ("dvl", {"outlier_probability": 0.02}, "stand out of their neighbours"),
    ("dvl", {"repeat_probability": 0.05}, "equal the one before exactly"),
    ("dvl", {"limit_m_s": 1.52}, "dvl x is clipped"),
    ("dvl", {"limit_m_s": 1.2}, "dvl x is 1.2 m/s in every row"),
    ("dvl", {"quantum_m_s": 0.1}, "take only 3 values"),
    ("dvl", {"quantum_m_s": 0.02}, "take only 9 values"),
    ("depth", {"dropout_probability": 0.15}, "readings are missing"),
    ("depth", {"outages_s": [[80, 100]]}, "silence of more than 5 s; the longest is 20.1 s, from 79.9 s"),
    ("depth", {"outlier_probability": 0.02}, "stand out of their neighbours"),
    ("depth", {"repeat_probability": 0.05}, "equal the one before exactly"),
    ("depth", {"limit_m": 15.0}, "depth is clipped"),
    ("depth", {"quantum_m": 0.5}, "comes in steps of 0.5 m"),
    ("depth", {"quantum_m": 5.0}, "takes only 4 values"),
    ("gps", {"outlier_probability": 0.1}, "stand out of their neighbours"),
    ("gps", {"repeat_probability": 0.2}, "equal the one before exactly"),
    ("gps", {"quantum_m": 10.0}, "comes in steps of 10 m"),
    ("heading", {"dropout_probability": 0.15}, "readings are missing"),
    ("heading", {"outages_s": [[0, 20]]}, "silence of more than 5 s; the longest is 20.2 s, from 0.0 s"),
    ("heading", {"outlier_probability": 0.02}, "stand out of their neighbours"),
    ("heading", {"repeat_probability": 0.05}, "equal the one before exactly"),
    ("heading", {"quantum_deg": 5.0}, "comes in steps of 5 °"),
]


@pytest.mark.parametrize(("sensor", "faults", "words"), FAULTS, ids=lambda value: str(value))
def test_a_fault_is_found_by_name_and_nothing_else(sensor: str, faults: dict[str, Any], words: str) -> None:
    keys = {sensor: {"faults": faults}}
    findings = wrong(simulated(surface_for_s=60 if sensor == "gps" else 36, **keys))
    said(findings, sensor, words)
    assert len(findings) == 1 or "clipped" in words  # which befalls other axes, too
    assert {finding.stream for finding in findings} == {sensor}


@pytest.mark.parametrize(
    "faults", [{"heading": {"faults": {"quantum_deg": 5.0}}}, {"imu": {"faults": {"gyro_quantum_deg_s": 0.5}}}]
)
def test_what_coarse_steps_bring_about_is_no_mark_and_no_row_without_reading(faults: dict[str, Any]) -> None:
    """A heading that rests on a step far from the others' median, and a gyro that now and then rounds to zero."""
    findings = wrong(simulated(duration_s=120, surface_for_s=100, **faults))
    assert len(findings) == 1
    assert "comes in steps" in findings[0].message


@pytest.mark.parametrize("words", ["repeat_probability", "outlier_probability"])
def test_gyro_and_accelerometer_are_distinguished(words: str) -> None:
    findings = wrong(simulated(imu={"faults": {words: 0.02}}))
    assert [finding.stream for finding in findings] == ["imu", "imu"]
    assert " gyro readings" in findings[0].message
    assert " accel readings" in findings[1].message


@pytest.mark.parametrize(
    ("keys", "words"),
    [({"delay_s": 0.5}, "0.5 s after they were true"), ({"delay_s": 0.05, "disorder_s": 0.5}, "were overtaken")],
)
def test_late_and_disordered_readings_are_reported(keys: dict[str, Any], words: str) -> None:
    findings = wrong(simulated(dvl=keys))
    assert len(findings) == 1
    assert words in said(findings, "dvl", "after they were true").message


def test_overtaken_readings_are_counted_as_they_are() -> None:
    log = simulated(dvl={"delay_s": 0.05, "disorder_s": 0.5})
    assert log.dvl is not None
    came = log.dvl.received_ns
    overtaken = sum(bool((came[k + 1 :] < came[k]).any()) for k in range(len(came)))
    assert f"and {overtaken} of {len(came)} were overtaken" in said(wrong(log), "dvl", "overtaken").message


def test_a_slow_imu_is_reported() -> None:
    assert len(wrong(simulated(imu={"rate_hz": 10.0}))) == 1
    said(wrong(simulated(imu={"rate_hz": 10.0})), "imu", "The IMU samples at 10 Hz")


def test_stamps_of_reception_are_found_by_their_bunches() -> None:
    log, rng = simulated(), np.random.default_rng(1)
    read_ns = log.imu.t_ns + np.rint(rng.exponential(1e6, len(log.imu.t_ns))).astype(np.int64)
    polled_ns = -(-read_ns // 40_000_000) * 40_000_000  # a host that looks every 40 ms, and reads them one by one
    t_ns = polled_ns + np.arange(len(read_ns)) % 7 * 30_000
    t_ns = np.maximum.accumulate(t_ns) + np.arange(len(t_ns))
    finding = said(wrong(dataclasses.replace(log, imu=dataclasses.replace(log.imu, t_ns=t_ns))), "imu", "in bunches")
    assert "streams.imu.message.clock" in finding.fix


@pytest.mark.parametrize("scattered", [0.25, 0.4])
def test_a_jittering_imu_is_reported(scattered: float) -> None:
    log, rng = simulated(), np.random.default_rng(2)
    off_ns = np.rint(rng.uniform(-0.45, 0.45, len(log.imu.t_ns)) * scattered / 0.4 * 1e7).astype(np.int64)
    imu = dataclasses.replace(log.imu, t_ns=log.imu.t_ns + off_ns)
    findings = [f for f in wrong(dataclasses.replace(log, imu=imu)) if "stamped" in f.message]
    assert len(findings) == 1


# values that are none


def with_dvl(log: Log, z: np.ndarray) -> Log:
    assert log.dvl is not None
    return dataclasses.replace(log, dvl=dataclasses.replace(log.dvl, z=z))


def dvl_of(log: Log) -> DvlStream:
    assert log.dvl is not None
    return log.dvl


def test_zeros_and_marks_of_invalid_rows_are_distinguished_and_kept_out_of_the_outliers() -> None:
    log = simulated()
    z = dvl_of(log).z.copy()
    z[10:200:10] = 0.0
    z[15:200:20] = -32.768
    findings = wrong(with_dvl(log, z))
    assert "19 of 500 rows" in said(findings, "dvl", "exactly zero on every axis").message
    assert "10 rows of dvl hold -32.768 m/s" in said(findings, "dvl", "a mark of rows without").message
    assert len(findings) == 2


def test_an_axis_that_is_always_zero_was_not_measured() -> None:
    log = simulated()
    findings = wrong(with_dvl(log, dvl_of(log).z * [1.0, 0.0, 0.0]))
    assert [finding.message[:5] for finding in findings] == ["dvl y", "dvl z"]


def test_a_sensor_that_never_changes_is_reported() -> None:
    log = simulated()
    assert log.gps is not None
    stuck = dataclasses.replace(log.gps, z=np.repeat(log.gps.z[:1], len(log.gps), axis=0))
    said(wrong(dataclasses.replace(log, gps=stuck)), "gps", "never changes")


def test_fixes_that_say_themselves_that_they_are_none_are_reported() -> None:
    log = simulated()
    assert log.gps is not None
    sigma = log.gps.sigma.copy()
    sigma[5:] = 1200.0
    said(wrong(dataclasses.replace(log, gps=dataclasses.replace(log.gps, sigma=sigma))), "gps", "sigma over 100 m")


def test_a_stretch_of_more_noise_is_listed_with_its_time() -> None:
    log, rng = simulated(dvl={"rate_hz": 20.0}), np.random.default_rng(3)
    z = dvl_of(log).z.copy()
    z[1000:1500] += 0.03 * rng.standard_normal((500, 3))
    finding = said(wrong(with_dvl(log, z)), "dvl", "times as noisy as usual")
    assert "25% of the log, longest from 50 to 75 s" in finding.message


@pytest.mark.parametrize("sensor", ["dvl", "depth", "heading"])
def test_outliers_are_those_that_were_put_in(sensor: str) -> None:
    clean, marred = simulated(), simulated(**{sensor: {"faults": {"outlier_probability": 0.01}}})
    assert clean.streams[sensor].z.shape == marred.streams[sensor].z.shape
    size = np.abs(marred.streams[sensor].z - clean.streams[sensor].z)[2:-2]
    found = outliers(next(c for c in channels_of(marred) if c.name == sensor))[2:-2]
    gross = (size > 10 * clean.streams[sensor].sigma[2:-2]).any(axis=1)
    assert gross.sum() >= 2
    assert found[gross].all()
    assert found[(size == 0).all(axis=1)].mean() < 0.005


@pytest.mark.parametrize("seed", range(5))
def test_the_quantum_of_a_channel_is_the_one_it_was_rounded_to(seed: int) -> None:
    rng = np.random.default_rng(seed)
    quantum, offset = 10.0 ** rng.uniform(-4, 1), rng.uniform(-3, 3)
    x = np.cumsum(rng.standard_normal(500)) * quantum * 10.0 ** rng.uniform(0, 2)
    steps = quantisation_of(np.rint(x / quantum) * quantum + offset)
    assert steps.quantum == pytest.approx(quantum, rel=1e-3)
    assert quantisation_of(x).quantum == 0.0
    assert quantisation_of(x.astype(np.float32).astype(float)).quantum < 1e-5 * quantum * 100


def test_white_noise_is_measured_from_the_values_alone() -> None:
    rng, t_s = np.random.default_rng(4), np.arange(5000) * 0.1
    z = (np.sin(0.7 * t_s) + 0.02 * rng.standard_normal(5000))[:, None]
    t_ns = np.rint(t_s * 1e9).astype(np.int64)
    log = dataclasses.replace(simulated(), depth=DepthStream(t_ns, t_ns, z, np.full_like(z, 0.02)))
    depth = next(c for c in channels_of(log) if c.name == "depth")
    assert noise_sigma(depth)[0] == pytest.approx(0.02, rel=0.06)
    cubic = dataclasses.replace(depth, x=(1.0 + t_s - 0.3 * t_s**2 + 0.01 * t_s**3)[:, None])
    assert np.nanmax(np.abs(residuals(cubic))) < 1e-6


@pytest.mark.parametrize(("factor", "finds"), [(0.2, True), (1.0, False), (5.0, True)])
@pytest.mark.parametrize("sensor", ["dvl", "depth", "heading"])
def test_a_wrongly_stated_sigma_is_reported_and_the_right_one_proposed(sensor: str, factor: float, finds: bool) -> None:
    log = simulated()
    stream: ReadingStream = log.streams[sensor]
    stated = dataclasses.replace(log, **{sensor: dataclasses.replace(stream, sigma=stream.sigma * factor)})
    findings = wrong(stated)
    if not finds:
        assert findings == []
        return
    fix = said(findings, sensor, "scatters from reading to reading").fix.split(", if")[0]
    path, value = fix.split(": ", 1)
    shown = 180 / np.pi if sensor == "heading" else 1.0
    proposed = np.atleast_1d(np.array(yaml.safe_load(value), float)) / shown
    np.testing.assert_allclose(proposed, stream.sigma[0], rtol=0.3)
    assert path.startswith(f"streams.{sensor}.sigma_")


@pytest.mark.parametrize(("factor", "words"), [(0.2, "From sample to sample"), (50.0, "Even with all motion in it")])
def test_a_wrongly_stated_imu_density_is_reported_under_way(factor: float, words: str) -> None:
    log = simulated(imu="consumer")
    noise = log.rig.imu_noise
    off = dataclasses.replace(noise, gyro_density=noise.gyro_density * factor)
    findings = wrong(dataclasses.replace(log, rig=dataclasses.replace(log.rig, imu_noise=off)))
    assert "gyro" in said(findings, "imu", words).message


# at rest

NOISE = ImuNoise(1e-4, 1e-3, 0.0, 0.0, 1e-3, 1e-2)


def at_rest(
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0), noise: ImuNoise = NOISE, stated: ImuNoise = NOISE
) -> Log:
    """Ten seconds of sailing, 120 s of lying still, ten of sailing; white noise at 100 Hz."""
    rng, n = np.random.default_rng(5), 14_000
    t_s = np.arange(n + 1) * 0.01
    ramp = np.clip((10 - t_s) / 3, 0, 1) + np.clip((t_s - 130) / 3, 0, 1)
    swell = 0.1 * ramp**2 * (3 - 2 * ramp)
    R_WI = Rotation.from_euler("xyz", swell[:, None] * np.sin(2.0 * t_s[:, None] + [0.0, 1.0, 2.0]))
    w = (R_WI[:-1].inv() * R_WI[1:]).as_rotvec() / 0.01 + bias + 10 * noise.gyro_density * rng.standard_normal((n, 3))
    f = R_WI[1:].inv().apply([0.0, 0.0, 9.81]) + 10 * noise.accel_density * rng.standard_normal((n, 3))
    imu = ImuStream(np.rint(t_s[1:] * 1e9).astype(np.int64), w, f)
    return Log("still", Rig(stated), imu)


def test_a_stretch_at_rest_is_found_where_it_is() -> None:
    log = at_rest()
    (rest,) = rests(log)
    begin_s, end_s = (log.imu.t_ns[row] * 1e-9 for row in rest)
    assert 10.0 <= begin_s < 12.0
    assert 128.0 < end_s <= 130.0
    assert wrong(log) == []


def test_a_steady_turn_or_way_through_the_water_is_no_rest() -> None:
    log = at_rest()
    t_ns = log.imu.t_ns[::20]
    v = np.repeat([[1.0, 0.0, 0.0]], len(t_ns), axis=0)
    sailing = dataclasses.replace(log, dvl=DvlStream(t_ns, t_ns, v, np.full_like(v, 0.02)))
    assert rests(sailing) == []
    (rest,) = rests(dataclasses.replace(log, dvl=DvlStream(t_ns, t_ns, 0 * v, np.full_like(v, 0.02))))
    v[t_ns < 90_000_000_000] = 0.0
    (shorter,) = rests(dataclasses.replace(log, dvl=DvlStream(t_ns, t_ns, v, np.full_like(v, 0.02))))
    assert shorter.first == rest.first
    assert 88.0 < log.imu.t_ns[shorter.last] * 1e-9 <= 90.0
    rng = np.random.default_rng(8)
    drifting = [0.3, 0.0, 0.0] + 0.15 * rng.standard_normal(v.shape)  # one reading alone does not tell
    assert rests(dataclasses.replace(log, dvl=DvlStream(t_ns, t_ns, drifting, np.full_like(v, 0.15)))) == []
    w = log.imu.w_WI_I + 0.1 * (log.imu.t_ns > 70_000_000_000)[:, None] * [0.0, 0.0, 1.0]
    (before,) = rests(dataclasses.replace(log, imu=dataclasses.replace(log.imu, w_WI_I=w)))
    assert before.first == rest.first
    assert 68.0 < log.imu.t_ns[before.last] * 1e-9 <= 70.0


def test_the_gyro_bias_at_rest_is_reported_where_it_is_beyond_what_is_stated() -> None:
    assert wrong(at_rest((1e-3, -2e-3, 0.5e-3))) == []
    finding = said(wrong(at_rest((1e-3, -8e-3, 0.5e-3))), "imu", "At rest the gyro reads (0.001")
    assert finding.fix.startswith("streams.imu.noise.gyro_bias_sigma: 0.008")


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_wrongly_stated_density_is_reported_at_rest_and_the_right_one_proposed(factor: float) -> None:
    stated = dataclasses.replace(NOISE, accel_density=NOISE.accel_density * factor)
    finding = said(wrong(at_rest(stated=stated)), "imu", "At rest the accel's white noise")
    path, value = finding.fix.split(": ")
    assert path == "streams.imu.noise.accel_density"
    assert float(value) == pytest.approx(NOISE.accel_density, rel=0.15)


# Allan deviation


def test_allan_deviation_is_its_definition_taken_literally() -> None:
    """Half the mean square difference of neighbouring means, over every start (IEEE Std 952)."""
    rng = np.random.default_rng(6)
    rates = 3.0 + rng.standard_normal((4000, 2)) + 0.03 * np.cumsum(rng.standard_normal((4000, 2)), axis=0)
    curve = allan_deviation(rates, 0.02)
    assert len(curve.tau_s) > 20
    for axis, ours in zip(rates.T, curve.deviation.T, strict=True):
        for tau_s, deviation in list(zip(curve.tau_s, ours, strict=True))[::4]:
            m = round(tau_s / 0.02)
            means = np.array([axis[k : k + m].mean() for k in range(len(axis) - m + 1)])
            assert deviation == pytest.approx(np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2)), rel=1e-9)


def test_allan_deviation_of_a_ramp_is_its_slope_over_root_two() -> None:
    t_s = np.arange(1000) * 0.1
    curve = allan_deviation(0.3 * t_s[:, None], 0.1)
    np.testing.assert_allclose(curve.deviation[:, 0], 0.3 * curve.tau_s / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_white_density_is_read_off_despite_bias_walk_and_rounding(seed: int) -> None:
    rng, dt_s, density, walk = np.random.default_rng(seed), 0.01, 2e-3, 1e-4
    n = 60_000
    white = density / np.sqrt(dt_s) * rng.standard_normal((n, 3))
    bias = walk * np.sqrt(dt_s) * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    np.testing.assert_allclose(white_density(allan_deviation(white + bias, dt_s)), density, rtol=0.1)
    rounded = np.rint((white + bias) / 0.01) * 0.01
    np.testing.assert_allclose(white_density(allan_deviation(rounded, dt_s)), density, rtol=0.1)


def test_bias_instability_is_the_floor_of_flicker_noise() -> None:
    """Flicker noise of density B² / (2π f) has an Allan deviation of B √(2 ln 2 / π) at every τ (IEEE Std 952)."""
    rng, n, B = np.random.default_rng(7), 2**17, 0.05
    spectrum = rng.standard_normal(n // 2 + 1) + 1j * rng.standard_normal(n // 2 + 1)
    f_hz = np.fft.rfftfreq(n, 1.0)
    spectrum[0] = 0.0
    # one-sided density S gives E|X_k|² = S n / 2 at 1 Hz; the draws have E|·|² = 2
    spectrum[1:] *= np.sqrt(B**2 / (2 * np.pi * f_hz[1:]) * 2 * n / 4)
    flicker = np.fft.irfft(spectrum, n)[:, None]
    curve = allan_deviation(flicker, 1.0, np.array([30, 100, 300]))
    np.testing.assert_allclose(curve.deviation[:, 0], B * FLICKER, rtol=0.1)
    assert bias_instability(curve)[0] == pytest.approx(B, rel=0.12)


# units, axes and mounting, by a folder whose description is wrong


def described(folder: Path, marred: dict[str, float] | None = None, **changes: Any) -> Path:
    """Write a log of an upright IMU; columns of the file times `marred`, keys of streams.imu changed."""
    write_folder(simulated(**UPRIGHT), folder)
    table = pd.read_parquet(folder / "imu.parquet")
    for prefix, factor in (marred or {}).items():
        table[[f"{prefix}_{axis}" for axis in "xyz"]] *= factor
    table.to_parquet(folder / "imu.parquet")
    return rewritten(folder, {f"streams.imu.{key}": value for key, value in changes.items()})


def rewritten(folder: Path, changes: dict[str, Any]) -> Path:
    """Set keys of a folder's log.yaml, by their paths; mappings are merged."""
    raw = yaml.safe_load((folder / "log.yaml").read_text())
    for path, value in changes.items():
        *parents, key = path.split(".")
        part = functools.reduce(lambda node, name: node[name], parents, raw)
        part[key] = part[key] | value if isinstance(value, dict) and isinstance(part.get(key), dict) else value
    (folder / "log.yaml").write_text(yaml.safe_dump(raw))
    return folder


def mended(folder: Path, finding: Finding) -> Path:
    """Do what a finding proposes."""
    path, value = finding.fix.split(";")[0].split(" (")[0].split(": ", 1)
    proposed = yaml.safe_load(value)
    if path == "streams.imu.mounting":
        proposed |= {"R_BS": None}
    return rewritten(folder, {path: proposed})


def wrong_in(folder: Path) -> list[Finding]:
    return wrong(open_to_inspect(folder)[0])


UP_IS_Y = {
    "gyro": {"columns": ["w_WI_I_x", "w_WI_I_z", "w_WI_I_y"], "scale": [1, 1, -1]},
    "accel": {"columns": ["f_I_x", "f_I_z", "f_I_y"], "scale": [1, 1, -1]},
}


@pytest.mark.parametrize(
    ("marred", "changes", "words"),
    [
        ({"f_I": 1 / 9.80665}, {}, "it is in g"),
        ({"f_I": 1e3 / 9.80665}, {}, "it is in mg"),
        ({"f_I": 1e3}, {}, "it is in mm/s²"),
        ({}, {"accel": {"unit": "g"}}, "it is in m/s² already"),
        ({"w_WI_I": 180 / np.pi}, {}, "degrees are read as radians"),
        ({}, {"gyro": {"unit": "deg/s"}}, "radians are read as degrees"),
        ({}, {"axes": "FRD"}, "points down in the body"),
        ({}, UP_IS_Y, "in the IMU's own axes up is +y"),
        ({}, {"mounting": {"R_BS": [[0, 0, -1], [0, 1, 0], [1, 0, 0]]}}, "points 90° off the body's z axis"),
    ],
    ids=str,
)
def test_what_is_proposed_for_the_imu_mends_it(
    marred: dict[str, float], changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    folder = described(tmp_path / "log", marred, **changes)
    findings = [f for f in wrong_in(folder) if words in f.message]
    assert len(findings) == 1, [f.message for f in wrong_in(folder)]
    fix = findings[0]
    if "FRD" in fix.fix and "axes" in changes:
        fix = dataclasses.replace(fix, fix="streams.imu.axes: FLU")
    assert [f.message for f in wrong_in(mended(folder, fix))] == []


@pytest.mark.parametrize("seed", range(20))
def test_levelling_is_the_least_turn_that_makes_up_point_up(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R_BI = Rotation.random(rng=rng).as_matrix()
    up_B = rng.standard_normal(3)
    up_B /= np.linalg.norm(up_B)
    R_new, square = levelled(R_BI, up_B)
    turn = R_new @ R_BI.T
    f_new = turn @ up_B
    assert (f_new[2] > 1 - 1e-12) != square
    if square:
        np.testing.assert_allclose(np.abs(turn).max(axis=0), 1.0, atol=1e-12)
        assert f_new[2] > 0.9
    else:
        angle = Rotation.from_matrix(turn).magnitude()
        assert angle == pytest.approx(np.arccos(up_B[2]), abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_f_tilts_with_the_gyro_at_any_mounting(seed: int) -> None:
    """A body that rocks on the spot: f is gravity in its axes, found here through rotation matrices."""
    rng, t_s = np.random.default_rng(seed), np.arange(0, 60, 0.01)
    angles = np.stack([0.1 * np.sin(0.9 * t_s), 0.2 * np.sin(0.5 * t_s + 1), 0.4 * t_s], axis=1)
    R_WI = Rotation.from_euler("xyz", angles) * Rotation.random(rng=rng)
    w_I = (R_WI[:-1].inv() * R_WI[1:]).as_rotvec() / 0.01
    f_I = R_WI[1:].inv().apply([0.0, 0.0, 9.81])
    log = Log("rocks", Rig(NOISE), ImuStream(np.rint(t_s[1:] * 1e9).astype(np.int64), w_I, f_I))
    tilting = gyro_against_gravity(log)
    assert tilting.slope == pytest.approx(1.0, abs=0.02)
    assert tilting.correlation > 0.99
    turned = gyro_against_gravity(dataclasses.replace(log, imu=dataclasses.replace(log.imu, w_WI_I=-w_I)))
    assert turned.slope == pytest.approx(-1.0, abs=0.02)


def test_a_gyro_of_the_wrong_sign_is_reported() -> None:
    log = simulated()
    imu = dataclasses.replace(log.imu, w_WI_I=-log.imu.w_WI_I)
    said(wrong(dataclasses.replace(log, imu=imu)), "imu", "f tilts against the gyro")


# what opening had to drop


def broken(folder: Path) -> Path:
    write_folder(simulated(), folder, fmt="csv")
    table = pd.read_csv(folder / "depth.csv")
    table.loc[[100, 101, 102], "z_W"] = np.nan
    table.to_csv(folder / "depth.csv", index=False)
    table = pd.read_csv(folder / "dvl.csv")
    table.loc[[50, 60], "t_ns"] = table.loc[[40, 45], "t_ns"].to_numpy()
    table["received_ns"] = table["t_ns"]
    table.to_csv(folder / "dvl.csv", index=False)
    return folder


def test_what_opening_had_to_drop_is_found_and_only_that(tmp_path: Path) -> None:
    log, repairs = open_to_inspect(broken(tmp_path / "log"))
    findings = inspect_log(log, repairs).checks[0].findings
    assert said(findings, "depth", "3 depth rows are not finite").hint.startswith("streams.depth.valid")
    assert said(findings, "dvl", "2 dvl rows are out of order").hint.startswith("streams.dvl.time")
    again = write_folder(log, tmp_path / "again")
    assert any("(repair)" in note for note in open_to_inspect(again)[0].notes)
    assert open_to_inspect(again)[1] == ()  # its history tells of a repair, but there is nothing to repair


# the recorded logs, described as by a user who has not read their READMEs

MTI = {
    "file": "_040825_1735_MTI.log",
    "delimiter": "whitespace",
    "comment": "%",
    "encoding": "latin-1",
    "header": False,
}
NAIVE_NOISE = {"gyro_density": 2.1e-3, "accel_density": 1e-2, "gyro_walk": 2e-5, "accel_walk": 1e-4}
NAIVE_NOISE |= {"gyro_bias_sigma": 0.02, "accel_bias_sigma": 0.1}
NAIVE_ICTINEU = {
    "name": "ictineu_naive",
    "streams": {
        "imu": {
            "table": MTI,
            "time": {"column": 0},
            "gyro": {"columns": [4, 5, 6], "unit": "rad/s"},
            "accel": {"columns": [7, 8, 9], "unit": "m/s^2"},
            "noise": NAIVE_NOISE,
        },
        "dvl": {
            "table": MTI | {"file": "_040825_1735_DVL.log"},
            "time": {"column": 0},
            "velocity": {"columns": [11, 12, 13], "unit": "cm/s"},
            "sigma_m_s": 0.15,
        },
        "depth": {
            "table": MTI | {"file": "_040825_1735_DVL.log"},
            "time": {"column": 0},
            "depth": {"columns": [26], "unit": "m", "scale": 0.00377225, "offset": -5.43204},
            "sigma_m": 0.03,
        },
    },
}
LIMU = {"names": ["AngularVelocity", "Acceleration"], "entity": 65, "clock": {"field": "time", "wraps_at_s": 64}}
NAIVE_LAUV = {
    "name": "lauv_naive",
    "recording": {
        "format": "imc",
        "file": "samples.zip",
        "member": "auv/Data.lsf",
        "definitions": "auv/IMC.xml.gz",
        "source": 27,
    },
    "streams": {
        "imu": {
            "message": LIMU,
            "time": {"column": "timestamp"},
            "gyro": {"columns": [f"AngularVelocity.{axis}" for axis in "xyz"], "unit": "rad/s"},
            "accel": {"columns": [f"Acceleration.{axis}" for axis in "xyz"], "unit": "m/s^2"},
            "noise": NAIVE_NOISE | {"gyro_density": 4e-4, "accel_density": 4e-3},
        },
        "dvl": {
            "message": {"names": ["GroundVelocity"], "entity": 66},
            "time": {"column": "timestamp"},
            "velocity": {"columns": ["x", "y", "z"], "unit": "m/s"},
            "axes": "FRD",
            "sigma_m_s": [0.06, 0.08, 0.04],
        },
    },
}


def naive(description: dict[str, Any], recording: Path, folder: Path) -> list[Finding]:
    if not recording.is_dir():
        pytest.skip(f"no recording: {recording}")
    (folder / "naive.yaml").write_text(yaml.safe_dump(description))
    log, repairs = open_to_inspect(folder / "naive.yaml", recording)
    assert repairs == ()
    return wrong(log)


def test_ictineu_without_its_corrections_shows_the_findings_of_its_readme(recorded_data: Path, tmp_path: Path) -> None:
    findings = naive(NAIVE_ICTINEU, recorded_data / "ictineu_stpere_2004", tmp_path)
    said(findings, "imu", "The IMU samples at 10 Hz")
    assert said(findings, "imu", "points down in the body").fix.startswith("streams.imu.axes: FRD")
    mark = said(findings, "dvl", "84 rows of dvl hold 327.67 m/s")
    assert 2.0 < float(mark.fix.rsplit(": ", 1)[1]) < 300.0
    said(findings, "dvl", "stand out of their neighbours")
    assert "to 29" in said(findings, "dvl", "times as noisy as usual").message  # the bad half hour is at its end
    said(findings, "depth", "takes only 2 values in 5045 rows")
    assert len(findings) == 6


def test_lauv_by_its_host_clock_shows_the_findings_of_its_readme(recorded_data: Path, tmp_path: Path) -> None:
    findings = naive(NAIVE_LAUV, recorded_data / "lauv_noptilus2_2015", tmp_path)
    assert "5.8%" in said(findings, "imu", "come in bunches").message  # 5.6 % are under 2 ms, a fifth
    said(findings, "imu", "points down in the body")
    said(findings, "dvl", "49 of 497 rows of dvl are exactly zero")
    assert len(findings) == 3


# any log, the page, the command


@pytest.mark.parametrize("rows", [0, 1, 2, 3, 4, 5, 19, 20, 25])
@pytest.mark.parametrize("samples", [2, 3, 25])
def test_short_logs_are_inspected_and_drawn(rows: int, samples: int) -> None:
    log = simulated()
    cut = {
        name: type(s)(s.t_ns[:rows], s.received_ns[:rows], s.z[:rows], s.sigma[:rows])
        for name, s in log.streams.items()
    }
    imu = ImuStream(log.imu.t_ns[:samples], log.imu.w_WI_I[:samples], log.imu.f_I[:samples])
    short = dataclasses.replace(log, imu=imu, truth=None, prior=None, **cut)
    inspection = inspect_log(short)
    if (rows, samples) in ((0, 2), (25, 25)):  # a picture takes a second
        draw_inspection(inspection).canvas.draw()


def test_a_lone_imu_is_inspected() -> None:
    alone = dataclasses.replace(simulated(), dvl=None, depth=None, gps=None, heading=None, truth=None, prior=None)
    assert inspect_log(alone).findings == ()


def of_stream(stream: ReadingStream, rows: Any = slice(None), z: float = 1.0, sigma: float = 1.0) -> ReadingStream:
    """Some rows of a stream, its readings and sigmas multiplied."""
    return type(stream)(
        stream.t_ns[rows], stream.received_ns[rows], stream.z[rows] * z, np.maximum(stream.sigma[rows] * sigma, 1e-320)
    )


def odd(what: str, log: Log) -> Log:
    """A log as written by a converter, not by a vehicle."""
    imu = log.imu
    changed: dict[str, Any] = {
        "no force": {"imu": ImuStream(imu.t_ns, imu.w_WI_I, np.zeros_like(imu.f_I))},
        "nothing moves": {"imu": ImuStream(imu.t_ns, imu.w_WI_I * 0, imu.f_I * 0)}
        | {name: of_stream(stream, z=0.0) for name, stream in log.streams.items()},
        "dvl measures nothing": {"dvl": of_stream(log.streams["dvl"], sigma=np.inf)},
        "dvl in a wrong unit": {"dvl": of_stream(log.streams["dvl"], z=1e-10)},
        "heading never spoke": {"heading": of_stream(log.streams["heading"], slice(0))},
        "no accel noise": {"rig": with_noise(log.rig, accel_density=0.0)},
        "no gyro noise": {"rig": with_noise(log.rig, gyro_density=0.0)},
        "truth without attitude": {
            "truth": dataclasses.replace(log.truth, R_WB=np.full_like(log.truth.R_WB, np.nan)) if log.truth else None
        },
    }[what]
    return dataclasses.replace(log, **changed)


def with_noise(rig: Rig, **densities: float) -> Rig:
    return dataclasses.replace(rig, imu_noise=dataclasses.replace(rig.imu_noise, **densities))


@pytest.mark.slow
@pytest.mark.parametrize(
    "what",
    [
        "no force",
        "nothing moves",
        "dvl measures nothing",
        "dvl in a wrong unit",
        "heading never spoke",
        "no accel noise",
        "no gyro noise",
        "truth without attitude",
    ],
)
def test_odd_logs_are_inspected_and_drawn(what: str) -> None:
    inspection = inspect_log(odd(what, simulated()))
    draw_inspection(inspection).canvas.draw()


def test_noise_where_none_is_stated_is_reported() -> None:
    log = simulated(imu="consumer")
    found = inspect_log(dataclasses.replace(log, rig=with_noise(log.rig, gyro_density=0.0))).findings
    assert "where none is stated" in said(found, "imu", "white noise").message


@pytest.mark.parametrize("factor", [1e40, 1e200])
@pytest.mark.parametrize("what", ["imu", "depth", "sigma", "density"])
def test_numbers_that_nothing_measures_are_one_line_and_exit_2(what: str, factor: float, tmp_path: Path) -> None:
    log = simulated()
    depth = log.streams["depth"]
    changed: dict[str, dict[str, Any]] = {
        "imu": {"imu": ImuStream(log.imu.t_ns, log.imu.w_WI_I * factor, log.imu.f_I)},
        "depth": {"depth": of_stream(depth, z=factor)},
        "sigma": {"depth": of_stream(depth, sigma=1 / factor)},
        "density": {"rig": with_noise(log.rig, gyro_density=factor)},
    }
    folder = write_folder(dataclasses.replace(log, **changed[what]), tmp_path / "log")
    code, out, err = call(folder)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert ("nothing measures" in err) or ("no sensor's" in err)


@pytest.mark.slow
def test_any_name_can_stand_over_the_page(tmp_path: Path) -> None:
    folder = write_folder(dataclasses.replace(simulated(), name="潜水 $x_{ \a [red]"), tmp_path / "log")
    assert call(folder, "-o", tmp_path / "page.png")[0] == 0


def call(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["inspect", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.slow
def test_the_command_prints_facts_findings_and_where_the_figure_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = broken(tmp_path / "log")
    monkeypatch.chdir(tmp_path)
    code, out, _ = call(folder)
    assert code == 0
    assert "dvl      498 at 5 Hz" in out
    assert "What looks wrong" in out
    assert "2. 2 dvl rows are out of order" in out or "1. 2 dvl rows are out of order" in out
    assert "→ streams.dvl.time.column" in out
    assert out.splitlines()[-1] == "figure: inspect-lawnmower-tactical-s3.png"
    assert (tmp_path / "inspect-lawnmower-tactical-s3.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_figure_goes_where_it_is_reported(tmp_path: Path) -> None:
    write_folder(simulated(), tmp_path / "log")
    code, out, _ = call(tmp_path / "log", "-o", tmp_path / "new" / "page.pdf")
    assert code == 0
    assert "Nothing looks wrong." in out
    assert (tmp_path / "new" / "page.pdf").read_bytes().startswith(b"%PDF")
    assert call(tmp_path / "log", "-o", tmp_path / "pages")[0] == 0
    assert (tmp_path / "pages" / "inspect-lawnmower-tactical-s3.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: no such log"),
        (["{log}", "-o", "{log}/page.jpg"], "one of .png, .pdf, .svg"),
        (["{log}", "-o", "{log}/imu.parquet/page.png"], "cannot be written"),
        (["{bad}"], "did you mean 'table'"),
    ],
)
def test_bad_input_is_one_line_a_fault_and_exit_2(arguments: list[str], message: str, tmp_path: Path) -> None:
    write_folder(simulated(), tmp_path / "log")
    (tmp_path / "bad.yaml").write_text("streams: {imu: {tabel: {file: x.csv}}}")
    filled = [argument.format(log=tmp_path / "log", bad=tmp_path / "bad.yaml") for argument in arguments]
    code, out, err = call(*filled)
    assert code == 2
    assert out == ""
    assert message in err
    assert all("no such log" in line or str(tmp_path) in line for line in err.splitlines())


def test_help_answers() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "fathom.bench.cli.app", "inspect", "--help"], capture_output=True, text=True, check=False
    )
    assert shown.returncode == 0
    assert "log.yaml" in shown.stdout


def test_panels_have_one_clock_and_no_tick_labels_on_top_of_each_other() -> None:
    figure = draw_inspection(inspect_log(simulated()))
    figure.canvas.draw()
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert {label for label in labels if label.startswith("time")} == {"time (s)"}
    (noise,) = (axes for axes in figure.axes if axes.get_title().startswith("noise of the aiding sensors"))
    shown = sorted(
        (
            text.get_window_extent()
            for text in noise.get_xticklabels(which="both")
            if text.get_text() and 0 <= noise.transAxes.inverted().transform(text.get_window_extent().p0)[0] <= 1
        ),
        key=lambda box: box.x0,
    )
    assert len(shown) > 1
    assert all(left.x1 < right.x0 for left, right in pairwise(shown))
