"""Waves against the equations of fluid motion, and what vehicle and sensors make of them."""

import dataclasses

import numpy as np
import pytest
from fathom.bench.execution.drive import run_log
from fathom.datasets import DatasetError
from fathom.datasets.mounting import MountingSpec
from fathom.datasets.simulated.faults import HeadingFaults
from fathom.datasets.simulated.missions import fly
from fathom.datasets.simulated.motion import AFLOAT_M
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.sea import Sea
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DepthTold, GpsSpec, HeadingSpec, ImuSpec, TideSpec, WavesSpec
from fathom.datasets.state import POSITION
from fathom.estimators import create
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

WAVES = WavesSpec(height_m=1.0, period_s=6.0, towards_deg=130.0)


def sea_of(
    waves: WavesSpec | None = WAVES, tide: TideSpec | None = None, seed: int = 1, mission: str = "lawnmower"
) -> Sea:
    sea = Sea.of(Scenario(mission=mission, waves=waves, tide=tide), seed)
    assert sea is not None
    return sea


def somewhere(seed: int, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 600, n), rng.uniform([-300, -300, -15], [300, 300, -0.5], (n, 3))


# -- the water


def test_water_is_accelerated_by_the_gradient_of_its_pressure():
    """Euler's equation, linear: a = −g ∇rise, with p = ρ g (rise − z)."""
    sea, (t_s, p), h = sea_of(), somewhere(0), 1e-3
    a = (sea.displacement(t_s + h, p) - 2 * sea.displacement(t_s, p) + sea.displacement(t_s - h, p)) / h**2
    gradient = np.stack(
        [(sea.rise_m(t_s, p + h * e) - sea.rise_m(t_s, p - h * e)) / (2 * h) for e in np.eye(3)], axis=1
    )
    np.testing.assert_allclose(a, -9.81 * gradient, atol=1e-6)
    np.testing.assert_allclose(sea.slope(t_s, p), gradient[:, :2], atol=1e-8)
    assert np.abs(a).max() > 0.1


def test_water_is_not_compressed():
    sea, (t_s, p), h = sea_of(), somewhere(1), 1e-3
    divergence = sum(
        (sea.displacement(t_s, p + h * e) - sea.displacement(t_s, p - h * e))[:, i] / (2 * h)
        for i, e in enumerate(np.eye(3))
    )
    np.testing.assert_allclose(divergence, 0, atol=1e-8)


def test_waves_have_the_height_and_the_energy_period_of_their_spectrum():
    sea, t_s = sea_of(), np.arange(0, 50_000, 0.7)
    eta = sea.rise_m(t_s, np.zeros((len(t_s), 3)))
    assert 4 * np.std(eta) == pytest.approx(1.0, rel=0.02)
    # m₋₁ / m₀ of a Bretschneider spectrum is 0.857 of its peak's period
    assert np.mean(2 * np.pi / sea.frequency_rad_s) == pytest.approx(0.857 * 6.0, rel=0.01)
    assert np.mean(sea.frequency_rad_s < 2 * np.pi / 6.0) == pytest.approx(np.exp(-1.25), abs=1 / 16)


def test_waves_run_in_the_stated_direction():
    """Seen from a point that runs along with the longest wave, that wave stands still."""
    sea = sea_of()
    i = int(np.argmin(sea.frequency_rad_s))
    lone = Sea(
        *(x[i : i + 1] for x in (sea.amplitude_m, sea.frequency_rad_s, sea.phase_rad)), sea.direction, 9.81, None
    )
    t_s, celerity = np.linspace(0, 60, 50), 9.81 / sea.frequency_rad_s[i]
    towards = np.array([np.cos(np.radians(130)), np.sin(np.radians(130)), 0])
    assert np.ptp(lone.rise_m(t_s, celerity * np.outer(t_s, towards))) < 1e-9
    assert np.ptp(lone.rise_m(t_s, -celerity * np.outer(t_s, towards))) > 0.1


# -- the vehicle


def calm_and_rough(**values) -> tuple[Scenario, Scenario]:
    return Scenario(noise_scale=0.0, **values), Scenario(noise_scale=0.0, waves=WAVES, **values)


def test_the_truth_contains_the_waves_and_its_derivatives_match():
    calm, rough = calm_and_rough(duration_s=300)
    motion, still, h = fly(rough, 2), fly(calm, 2), 1e-3
    t_s = np.random.default_rng(0).uniform(0, 300, 300)
    before, now, after = motion.at(t_s - h), motion.at(t_s), motion.at(t_s + h)
    np.testing.assert_allclose(now.v_WB_W, (after.p_WB_W - before.p_WB_W) / (2 * h), atol=2e-6)
    np.testing.assert_allclose(now.a_WB_W, (after.v_WB_W - before.v_WB_W) / (2 * h), atol=5e-6)
    turned = Rotation.from_matrix(before.R_WB.transpose(0, 2, 1) @ after.R_WB).as_rotvec()
    np.testing.assert_allclose(now.w_WB_B, turned / (2 * h), atol=5e-6)
    moved = now.p_WB_W - still.position(t_s)
    expected = sea_of(seed=2).displacement(t_s, still.position(t_s))
    np.testing.assert_allclose(moved, expected, atol=0.02)
    assert np.abs(moved).max() > 0.3


def test_a_vehicle_afloat_rides_on_the_waves():
    """As the water does that would be there in a flat sea: the wave moves both along by as much as a wave's height."""
    calm, rough = (fly(scenario, 1) for scenario in calm_and_rough(duration_s=60, surface_for_s=60))
    t_s = np.linspace(0, 8, 200)
    height_m = rough.position(t_s)[:, 2]
    draught_m = height_m - sea_of().rise_m(t_s, calm.position(t_s) * [1, 1, 0])
    assert np.ptp(height_m) > 0.5
    np.testing.assert_allclose(draught_m, AFLOAT_M, atol=0.03)


def test_heave_fades_with_depth_as_each_wave_does():
    calm, rough = calm_and_rough(mission="transit", duration_s=6000, surface_every_s=6000, depth_m=8.0)
    t_s = np.arange(200, 5800, 0.5)
    heave_m = fly(rough, 1).position(t_s)[:, 2] - fly(calm, 1).position(t_s)[:, 2]
    sea = sea_of(mission="transit")
    k = sea.frequency_rad_s**2 / 9.81
    expected = np.sqrt(np.mean(np.exp(-2 * k * 8.1))) / 4
    assert np.std(heave_m) == pytest.approx(expected, rel=0.05)
    assert expected < 0.6 / 4


def test_a_leaning_vehicle_feels_no_force_sideways():
    """It lies on surfaces of equal pressure, and floats: what it feels is square to them (all but its own way)."""
    side = {}
    for towards in (30, 120):
        values = {"mission": "transit", "wobble_deg": 0, "duration_s": 300, "surface_for_s": 300, "speed_m_s": 0.02}
        rough = Scenario(noise_scale=0, waves=WavesSpec(height_m=0.3, towards_deg=towards), **values)
        log = simulate(Scenario.from_dict(rough.to_dict() | {"imu": {"mounting": {}}}), 1)
        afloat = slice(0, 6000)
        slope = sea_of(rough.waves, mission=rough.mission).slope(
            log.truth.t_ns[afloat] * 1e-9, log.truth.p_WB_W[afloat]
        )
        side[towards] = np.std(log.imu.f_I[afloat, :2], axis=0) / (9.81 * np.std(np.linalg.norm(slope, axis=1)))
    assert side[120][1] < 0.1  # waves abeam: roll
    assert side[30][0] < 0.1  # waves ahead: pitch
    assert side[120][0] < 0.1


# -- the sensors


def test_a_pressure_sensor_hardly_sees_the_waves_that_it_rides():
    _, rough = calm_and_rough(mission="transit", duration_s=600, surface_every_s=600, depth_m=3.0, wobble_deg=0)
    log = simulate(rough, 1)
    level = (log.depth.t_ns > 100e9) & (log.depth.t_ns < 500e9)
    rows = np.searchsorted(log.truth.t_ns, log.depth.t_ns[level])
    heave_m = log.truth.p_WB_W[rows, 2]
    assert np.std(heave_m) > 0.12
    assert np.std(log.depth.z[level]) < 0.15 * np.std(heave_m)


def test_the_depth_sensor_reads_the_pressure_above_it():
    _, rough = calm_and_rough(mission="yo-yo", duration_s=120, depth=DepthSpec(rate_hz=5))
    log, sea = simulate(rough, 3), sea_of(seed=3, mission=rough.mission)
    rows = np.searchsorted(log.truth.t_ns, log.depth.t_ns)
    p = log.truth.p_WB_W[rows] + log.truth.R_WB[rows] @ log.rig.depth.p_BS_B
    np.testing.assert_allclose(log.depth.z[:, 0], p[:, 2] - sea.rise_m(log.depth.t_ns * 1e-9, p), atol=1e-9)


def test_tide_carries_the_vehicle_and_is_not_seen_by_its_depth_sensor():
    tide = TideSpec(amplitude_m=2.0, period_h=6.0, phase_deg=40.0)
    plain, tidal = (simulate(Scenario(duration_s=1200, noise_scale=0.0, tide=x), 1) for x in (None, tide))
    t_s = plain.truth.t_ns * 1e-9
    rise_m = 2.0 * (np.sin(2 * np.pi * t_s / 21600 + np.radians(40)) - np.sin(np.radians(40)))
    np.testing.assert_allclose(tidal.truth.p_WB_W - plain.truth.p_WB_W, np.outer(rise_m, [0, 0, 1]), atol=1e-6)
    np.testing.assert_allclose(tidal.depth.z, plain.depth.z, atol=1e-6)
    np.testing.assert_allclose(tidal.gps.z[-1, 2] - plain.gps.z[-1, 2], rise_m[-1], atol=1e-6)
    assert rise_m[-1] > 0.4


def test_a_tide_over_a_recorded_path_shows_in_the_depth_alone():
    path = simulate(Scenario(duration_s=60, imu=ImuSpec(rate_hz=5)), 1).truth
    base = {"mission": "recorded", "duration_s": 60, "noise_scale": 0.0, "gps": None}
    plain, tidal = (simulate(Scenario(**base, tide=x), 1, path) for x in (None, TideSpec(period_h=1.0)))
    assert np.array_equal(plain.truth.p_WB_W, tidal.truth.p_WB_W)
    rise_m = np.sin(2 * np.pi * tidal.depth.t_ns * 1e-9 / 3600)
    np.testing.assert_allclose((plain.depth.z - tidal.depth.z)[:, 0], rise_m, atol=1e-12)


def test_a_tide_that_is_told_is_in_the_depth_readings():
    scenario = Scenario(duration_s=1200, noise_scale=0.0, tide=TideSpec(amplitude_m=2.0, period_h=6.0, told=True))
    log = simulate(scenario, 1)
    rows = np.searchsorted(log.truth.t_ns, log.depth.t_ns)
    p_WP_W = log.truth.p_WB_W[rows] + log.truth.R_WB[rows] @ log.rig.depth.p_BS_B
    np.testing.assert_allclose(log.depth.z[:, 0], p_WP_W[:, 2], atol=1e-9)
    assert np.ptp(log.truth.p_WB_W[:, 2]) > 20


@pytest.mark.parametrize(("z_m", "period_s"), [(-0.1, 0.1), (-8.0, 0.1), (-0.1, 1.0)])
def test_waves_are_told_as_the_least_white_noise_that_no_mean_of_them_exceeds(z_m: float, period_s: float) -> None:
    """Against the means of many readings of 14 hours of waves at one place, over windows of every length."""
    sea, told = sea_of(), sea_of().swell_sigma_m(np.array([z_m]), period_s)[0]
    t_s = np.arange(0, 50_000, period_s)
    rise_m = sea.rise_m(t_s, np.tile([0.0, 0.0, z_m], (len(t_s), 1)))
    summed = np.concatenate([[0.0], np.cumsum(rise_m)])
    counts = np.unique(np.geomspace(1, 100 / period_s, 60).astype(int))
    share = np.array([np.var((summed[n:] - summed[:-n]) / n) * n for n in counts]) / told**2
    assert 0.75 < share.max() < 1.01


def test_waves_are_in_the_depth_sensors_sigma_unless_the_scenario_leaves_them_out():
    log = simulate(Scenario(duration_s=60, waves=WAVES), 1)
    untold = simulate(Scenario(duration_s=60, waves=dataclasses.replace(WAVES, told=False)), 1)
    fixed = simulate(Scenario(duration_s=60, waves=WAVES, depth=DepthSpec(told=DepthTold(sigma_m=0.3))), 1)
    assert np.all(untold.depth.sigma == 0.02)
    assert np.all(fixed.depth.sigma == 0.3)
    z = simulate(Scenario(duration_s=60, waves=WAVES, noise_scale=0.0), 1).depth.z[:, 0]
    np.testing.assert_allclose(log.depth.sigma[:, 0], np.hypot(0.02, sea_of().swell_sigma_m(z, 0.1)))
    for other in (untold, fixed):
        assert np.array_equal(other.depth.z, log.depth.z)


def test_an_estimator_of_waves_that_are_told_does_not_overclaim_its_height():
    """Twelve seeds, early and late; of waves that are not told the same sum is hundreds of times larger."""
    squared = []
    for seed in range(12):
        log = simulate(Scenario(mission="transit", duration_s=40, waves=WAVES, heading=None), seed)
        track = run_log(log, create("eskf")).online
        for t_s in (2, 10, 40):
            row = np.searchsorted(track.t_ns, t_s * 10**9)
            true = log.truth.p_WB_W[np.searchsorted(log.truth.t_ns, track.t_ns[row]), 2]
            squared.append((track.p_WB_W[row, 2] - true) ** 2 / track.P[row, POSITION, POSITION][2, 2])
    assert sum(squared) < chi2.ppf(0.999, len(squared))


def antenna_above_m(log, sea: Sea | None) -> np.ndarray:
    p = log.truth.p_WB_W + log.truth.R_WB @ log.rig.gps.p_BS_B
    return p[:, 2] - (0 if sea is None else sea.rise_m(log.truth.t_ns * 1e-9, p * [1, 1, 0]))


def test_gps_is_heard_while_the_antenna_is_above_the_waves():
    low = MountingSpec((-0.25, 0.0, 0.06))
    steep = Scenario(duration_s=300, waves=WavesSpec(height_m=1.5), gps=GpsSpec(rate_hz=10, mounting=low))
    log = simulate(steep, 1)
    afloat = antenna_above_m(log, sea_of(steep.waves))[10::10] > -0.05
    assert np.array_equal(log.gps.t_ns, log.truth.t_ns[10::10][afloat])
    assert np.count_nonzero(np.diff(afloat.astype(int))) > 4  # washed over, now and then


@pytest.mark.parametrize("waves", [None, WAVES])
def test_gps_needs_its_time_after_every_dive(waves):
    spec, plain = GpsSpec(rate_hz=2, reacquisition_s=12.0), GpsSpec(rate_hz=2)
    slow, prompt = (simulate(Scenario(duration_s=600, waves=waves, gps=gps), 1) for gps in (spec, plain))
    above = antenna_above_m(slow, None if waves is None else sea_of(waves)) > -0.05
    t_s = slow.truth.t_ns * 1e-9
    since_s = t_s - np.maximum.accumulate(np.where(above, -np.inf, t_s))
    assert np.array_equal(slow.gps.t_ns, slow.truth.t_ns[50::50][(since_s >= 12.0)[50::50]])
    assert slow.gps.t_ns[0] == 500_000_000  # it begins with a fix
    kept = np.isin(prompt.gps.t_ns, slow.gps.t_ns)
    assert np.array_equal(slow.gps.z, prompt.gps.z[kept])
    assert 20 < (~kept).sum() < 0.7 * len(kept)


def test_soft_iron_deviates_a_heading_twice_around():
    soft = HeadingSpec(faults=HeadingFaults(soft_iron_deg=3.0, soft_iron_axis_deg=20.0, bias_deg=1.0))
    plain, bent = (
        simulate(Scenario(mission="box", duration_s=600, heading=spec, noise_scale=0.0), 1).heading.z
        for spec in (HeadingSpec(), soft)
    )
    deviation_deg = np.degrees(np.angle(np.exp(1j * (bent - plain)))) - 1.0
    np.testing.assert_allclose(deviation_deg, 3.0 * np.sin(2 * (plain - np.radians(20))), atol=1e-9)
    assert deviation_deg.max() > 2.5
    assert deviation_deg.min() < -2.5


# -- notes, and what is refused


def test_the_sea_is_noted():
    scenario = Scenario(
        duration_s=20,
        waves=WAVES,
        tide=TideSpec(),
        gps=GpsSpec(reacquisition_s=5),
        heading=HeadingSpec(faults=HeadingFaults(soft_iron_deg=2)),
    )
    assert simulate(scenario, 1).notes[1:] == (
        "waves: told True, height_m 1, period_s 6, towards_deg 130.",
        "tide: told False, amplitude_m 1, period_h 12.42, phase_deg 0.",
        "gps: reacquisition_s 5.",
        "heading faults: soft_iron_deg 2.",
    )


def test_waves_draw_from_no_other_stream():
    calm, rough = (simulate(Scenario(duration_s=30, waves=waves), 4) for waves in (None, WAVES))
    assert np.array_equal(calm.truth.b_a, rough.truth.b_a)
    quiet = simulate(Scenario(duration_s=30, waves=WAVES, noise_scale=0.0), 4)
    still = simulate(Scenario(duration_s=30, noise_scale=0.0), 4)
    np.testing.assert_allclose(rough.dvl.z - quiet.dvl.z, calm.dvl.z - still.dvl.z, atol=1e-12)
    np.testing.assert_allclose(rough.imu.f_I - quiet.imu.f_I, calm.imu.f_I - still.imu.f_I, atol=1e-12)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"waves": {"height": 1}}, ["waves.height", "did you mean 'height_m'"]),
        ({"waves": {"height_m": 3, "period_s": 5}}, ["waves 3 m high", "break", "height_m at most 2.6"]),
        ({"waves": {"period_s": 1}}, ["waves.period_s", "greater than or equal to 4"]),
        ({"tide": {"amplitude_m": -1}}, ["tide.amplitude_m", "greater than 0"]),
        ({"gps": {"reacquisition_s": -1}}, ["gps.reacquisition_s"]),
    ],
)
def test_a_bad_sea_is_refused_by_name(values, words):
    with pytest.raises(DatasetError) as caught:
        Scenario.from_dict(values, source="here.yaml")
    for word in ["here.yaml", *words]:
        assert word in str(caught.value)
