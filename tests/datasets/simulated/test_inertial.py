"""The simulated IMU against the definitions: what it reports of an exact motion, and how noisy it is."""

import dataclasses

import numpy as np
import pytest
from fathom.datasets import ImuNoise, Log, Trajectory
from fathom.datasets.mounting import MountingSpec
from fathom.datasets.simulated.faults import ImuFaults
from fathom.datasets.simulated.imu import simulate_biases, simulate_white_noise
from fathom.datasets.simulated.imu_grades import IMU_GRADES
from fathom.datasets.simulated.missions import fly
from fathom.datasets.simulated.random_streams import random_stream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import MISSIONS, ImuSpec, TideSpec, WavesSpec
from scipy.spatial.transform import Rotation
from variances import assert_variance

# -- what the IMU reports


@pytest.mark.parametrize("mission", MISSIONS)
def test_samples_are_means_of_the_imus_own_motion(mission):
    """Dense quadrature over the path of the IMU's point, differentiated twice: no formula of the simulator's."""
    scenario = Scenario(mission=mission, duration_s=60, noise_scale=0.0)
    log, motion = simulate(scenario, 3), fly(scenario, 3)
    imu, h = log.rig.imu, 2e-3

    def point(t_s):
        R_WB, p_WB_W, _ = motion.pose(t_s)
        return p_WB_W + R_WB @ imu.p_BS_B

    for k in (0, 1, 1503, 2950, 4444, 5999):
        t_s = np.linspace(k * 0.01, (k + 1) * 0.01, 101)
        a_WI_W = (point(t_s + h) - 2 * point(t_s) + point(t_s - h)) / h**2
        R_WI = motion.pose(t_s)[0] @ imu.R_BS
        f_I = np.einsum("nji,nj->ni", R_WI, a_WI_W + np.array([0, 0, 9.81]))
        before, after = motion.pose(t_s - h)[0] @ imu.R_BS, motion.pose(t_s + h)[0] @ imu.R_BS
        w_WI_I = Rotation.from_matrix(before.transpose(0, 2, 1) @ after).as_rotvec() / (2 * h)
        np.testing.assert_allclose(log.imu.f_I[k], np.trapezoid(f_I, t_s, axis=0) / 0.01, atol=2e-6)
        np.testing.assert_allclose(log.imu.w_WI_I[k], np.trapezoid(w_WI_I, t_s, axis=0) / 0.01, atol=1e-6)


def skew(v: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), v)


def mechanise(log: Log, w_WB_B: np.ndarray, earth_rate_W: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Free inertial navigation of the IMU's own point, with coning and sculling by the sample before (Savage 1998).

    Rotation within a sample is kept to second order: the term α × (α × β) / 6 alone is 28 to 100 mm in 10 minutes.
    W turns with the Earth at Ω: attitude by exp(−Ω t), velocity by −Ω dt × Δv / 2 in each sample, and by −2 Ω × v.
    Returns R_WB and p_WB_W at the truth's times, from the truth at the first, where the body's rate is w_WB_B.
    """
    dt, R_BI, p_BI_B = log.imu.period_ns * 1e-9, log.rig.imu.R_BS, log.rig.imu.p_BS_B
    earth_W = np.zeros(3) if earth_rate_W is None else earth_rate_W
    alpha, beta = log.imu.w_WI_I * dt, log.imu.f_I * dt
    last_alpha, last_beta = (np.vstack([2 * x[0] - x[1], x[:-1]]) for x in (alpha, beta))
    rotation = Rotation.from_rotvec(alpha + np.cross(last_alpha, alpha) / 12).as_matrix()
    R_0I = np.concatenate([np.eye(3)[None], rotation])
    shift = 1
    while shift < len(R_0I):  # products of all before, by doubling
        R_0I[shift:] = R_0I[:-shift] @ R_0I[shift:]
        shift *= 2
    turned_back = Rotation.from_rotvec(-np.outer(np.arange(len(R_0I)) * dt, earth_W)).as_matrix()
    R_WI = turned_back @ log.truth.R_WB[0] @ R_BI @ R_0I
    turned, turned_twice = np.cross(alpha, beta), np.cross(alpha, np.cross(alpha, beta))
    sculling = turned / 2 + turned_twice / 6 + (np.cross(last_alpha, beta) + np.cross(last_beta, alpha)) / 12
    dv = np.einsum("nij,nj->ni", R_WI[:-1], beta + sculling)
    dv += -dt / 2 * np.cross(earth_W, dv) - [0, 0, 9.81 * dt]
    twice = beta / 2 + turned / 6 + turned_twice / 24 - (beta - last_beta) / 12
    dp = dt * np.einsum("nij,nj->ni", R_WI[:-1], twice) - [0, 0, 9.81 * dt**2 / 2]

    coriolis = np.eye(3) - 2 * dt * skew(earth_W) + 2 * dt**2 * skew(earth_W) @ skew(earth_W)
    v = np.empty((len(R_0I), 3))
    v[0] = log.truth.v_WB_W[0] + log.truth.R_WB[0] @ np.cross(w_WB_B, p_BI_B)
    dv -= dt * np.cross(earth_W, dv)
    for k in range(len(dv)):
        v[k + 1] = coriolis @ v[k] + dv[k]
    dp -= dt**2 * np.cross(earth_W, v[:-1])
    p_0 = log.truth.p_WB_W[0] + log.truth.R_WB[0] @ p_BI_B
    p = p_0 + np.concatenate([np.zeros((1, 3)), np.cumsum(v[:-1] * dt + dp, axis=0)])
    R_WB = R_WI @ R_BI.T
    return R_WB, p - R_WB @ p_BI_B


def assert_returns(scenario: Scenario, seed: int, path: Trajectory | None = None) -> None:
    log = simulate(scenario, seed, path)
    R_WB, p_WB_W = mechanise(log, fly(scenario, seed, path).attitude(np.zeros(1))[1][0], scenario.earth_rate_rad_s)
    assert np.linalg.norm(p_WB_W - log.truth.p_WB_W, axis=1).max() < 5e-3
    assert Rotation.from_matrix(R_WB[-1].T @ log.truth.R_WB[-1]).magnitude() < 1e-7
    assert np.ptp(log.truth.p_WB_W, axis=0).max() > 15  # it had been somewhere


TEN_MINUTES = {"duration_s": 600, "noise_scale": 0.0}


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "mission",
    [pytest.param(name, marks=[] if name in ("lawnmower", "yo-yo") else pytest.mark.slow) for name in MISSIONS],
)
def test_free_inertial_navigation_returns_within_5_mm_after_10_minutes(mission, seed):
    assert_returns(Scenario(mission=mission, **TEN_MINUTES), seed)


@pytest.mark.slow
def test_free_inertial_navigation_along_a_recorded_path_returns_within_5_mm():
    flown = simulate(Scenario(mission="yo-yo", duration_s=620, imu=ImuSpec(rate_hz=5)), 2).truth
    assert_returns(Scenario(mission="recorded", path_start_s=9, **TEN_MINUTES), 0, flown)


@pytest.mark.slow
@pytest.mark.parametrize("mission", MISSIONS)
def test_free_inertial_navigation_through_waves_and_tide_returns_within_5_mm(mission):
    """At 200 Hz: at 100 Hz the mechanisation's own error, which goes with the cube of the interval, is 5 mm."""
    sea = {"waves": WavesSpec(height_m=1.0, period_s=5.0, towards_deg=200), "tide": TideSpec(amplitude_m=2)}
    assert_returns(Scenario(mission=mission, imu=ImuSpec(rate_hz=200), **TEN_MINUTES, **sea), 1)


@pytest.mark.parametrize("latitude_deg", [50.0, -20.0])
@pytest.mark.parametrize("mission", ["lawnmower", pytest.param("yo-yo", marks=pytest.mark.slow)])
def test_free_inertial_navigation_on_a_turning_earth_returns_within_5_mm(mission, latitude_deg):
    assert_returns(Scenario(mission=mission, latitude_deg=latitude_deg, **TEN_MINUTES), 1)


def test_a_gyro_on_a_turning_earth_sees_15_degrees_an_hour():
    """A vehicle that hardly moves, and the definition: north and up components by latitude, seen in the IMU's axes."""
    still, turning = (
        simulate(Scenario(mission="transit", duration_s=60, noise_scale=0.0, latitude_deg=x), 1) for x in (None, 35.0)
    )
    sensed_I = turning.imu.w_WI_I - still.imu.w_WI_I
    np.testing.assert_allclose(np.degrees(np.linalg.norm(sensed_I, axis=1)) * 3600, 15.041, atol=1e-3)
    middle = fly(Scenario(mission="transit", duration_s=60), 1).pose((np.arange(6000) + 0.5) * 0.01)[0]
    expected_W = np.radians(15.041 / 3600) * np.array([0, np.cos(np.radians(35)), np.sin(np.radians(35))])
    np.testing.assert_allclose(sensed_I, expected_W @ middle @ still.rig.imu.R_BS, atol=1e-9)
    assert "latitude 35°" in turning.notes[0]
    assert turning.origin == (35.0, 0.0)
    assert still.origin is None
    for name in ("p_WB_W", "R_WB", "v_WB_W"):
        assert np.array_equal(getattr(still.truth, name), getattr(turning.truth, name))
    assert np.array_equal(still.dvl.z, turning.dvl.z)


def test_coriolis_pushes_an_accelerometer_by_twice_its_velocity_across_the_earths_rate():
    scenario = Scenario(duration_s=60, noise_scale=0.0, imu=ImuSpec(mounting=MountingSpec((2.0, 0, 0))))
    still, turning = (simulate(dataclasses.replace(scenario, latitude_deg=x), 1) for x in (None, 90.0))
    motion, h, t_s = fly(scenario, 1), 1e-4, (np.arange(6000) + 0.5) * 0.01

    def point(t_s):
        R_WB, p_WB_W, _ = motion.pose(t_s)
        return p_WB_W + R_WB @ [2.0, 0, 0]

    v_WI_W = (point(t_s + h) - point(t_s - h)) / (2 * h)
    push_W = 2 * 7.292e-5 * np.stack([-v_WI_W[:, 1], v_WI_W[:, 0], 0 * t_s], axis=1)  # at the pole: to the right is −
    expected_B = np.einsum("nji,nj->ni", motion.pose(t_s)[0], push_W)
    np.testing.assert_allclose(turning.imu.f_I - still.imu.f_I, expected_B, atol=1e-8)
    assert np.abs(expected_B).max() > 1e-4


def test_a_level_imu_at_rest_feels_gravity_upwards():
    scenario = Scenario(noise_scale=0.0, wobble_deg=0.0, duration_s=20, imu=ImuSpec(mounting=MountingSpec()))
    f_B = simulate(scenario, 0).imu.f_I[0]
    np.testing.assert_allclose(f_B, [0, 0, 9.81], atol=0.05)


# -- noise and biases


@pytest.mark.parametrize("grade", IMU_GRADES)
def test_imu_noise_has_the_stated_densities(grade):
    """Means over 1 s have sigma = density, and single samples density / √dt: white in between."""
    noise = IMU_GRADES[grade]
    edges_ns = np.arange(0, 601) * 10_000_000
    white = np.concatenate([simulate_white_noise(noise, edges_ns, np.random.default_rng(seed)) for seed in range(40)])
    for columns, density in ((slice(0, 3), noise.accel_density), (slice(3, 6), noise.gyro_density)):
        assert_variance(white[:, columns], density / np.sqrt(0.01))
        assert_variance(white[:, columns].reshape(-1, 100, 3).mean(axis=1), density)


@pytest.mark.parametrize("grade", IMU_GRADES)
def test_biases_start_and_walk_as_stated(grade):
    noise = IMU_GRADES[grade]
    edges_ns = np.arange(0, 101) * 10_000_000
    b = np.stack([simulate_biases(noise, edges_ns, np.random.default_rng(seed)) for seed in range(300)])
    for columns, sigma, walk in (
        (slice(0, 3), noise.accel_bias_sigma, noise.accel_walk),
        (slice(3, 6), noise.gyro_bias_sigma, noise.gyro_walk),
    ):
        assert_variance(b[:, 0, columns], sigma)
        assert_variance(b[:, -1, columns] - b[:, 0, columns], walk)  # after 1 s


def test_the_log_is_signal_plus_bias_plus_noise():
    noisy, quiet = (simulate(Scenario(duration_s=120, noise_scale=scale), 6) for scale in (1.0, 0.0))
    noise = noisy.rig.imu_noise
    gyro = noisy.imu.w_WI_I - quiet.imu.w_WI_I - noisy.truth.b_g[:-1]
    accel = noisy.imu.f_I - quiet.imu.f_I - noisy.truth.b_a[:-1]
    assert_variance(gyro, noise.gyro_density * 10)
    assert_variance(accel, noise.accel_density * 10)
    assert np.linalg.norm(noisy.truth.b_a[0]) > 0.1 * noise.accel_bias_sigma
    assert np.array_equal(noisy.truth.p_WB_W, quiet.truth.p_WB_W)


def test_a_sample_carries_the_bias_of_its_intervals_beginning():
    """So much walk and so little noise that one step either way would show."""
    imu = ImuNoise(1e-9, 1e-9, 0.1, 0.1, 1e-3, 1e-3)
    walking, quiet = (simulate(Scenario(duration_s=20, imu=imu, noise_scale=scale), 6) for scale in (1.0, 0.0))
    np.testing.assert_allclose(walking.imu.w_WI_I - quiet.imu.w_WI_I, walking.truth.b_g[:-1], rtol=0, atol=1e-7)
    np.testing.assert_allclose(walking.imu.f_I - quiet.imu.f_I, walking.truth.b_a[:-1], rtol=0, atol=1e-7)


# -- Allan deviations


def allan_variance(samples: np.ndarray, m: int) -> float:
    """Of means over m samples (n, k): half the mean square of successive differences, without overlap."""
    n = len(samples) // m
    means = samples[: n * m].reshape(n, m, -1).mean(axis=1)
    return float(0.5 * np.mean(np.diff(means, axis=0) ** 2))


def assert_allan(of_seed, expected: float, seeds: int = 30) -> None:
    """The mean over seeds is the theory's, within 4.5 of its standard errors."""
    found = np.array([of_seed(seed) for seed in range(seeds)])
    assert abs(found.mean() - expected) < 4.5 * found.std(ddof=1) / np.sqrt(seeds)
    assert found.std(ddof=1) / np.sqrt(seeds) < 0.1 * expected  # which is worth something


STILL = dataclasses.replace(IMU_GRADES["tactical"], gyro_walk=4e-6, accel_walk=1e-4)
"""Walks so strong that they show within minutes."""
AXES = {"accel": slice(0, 3), "gyro": slice(3, 6)}


@pytest.mark.parametrize("tau_s", [1, 60])
@pytest.mark.parametrize("sensor", AXES)
def test_allan_deviation_recovers_density_and_walk(sensor, tau_s):
    """σ²(τ) = N² / τ + K² τ / 3 (IEEE 952): the first governs at 1 s, the second at 60 s."""
    density, walk = getattr(STILL, f"{sensor}_density"), getattr(STILL, f"{sensor}_walk")
    edges_ns = np.arange(6001) * 100_000_000

    def of_seed(seed):
        noise = simulate_biases(STILL, edges_ns, np.random.default_rng(seed))[:-1] + simulate_white_noise(
            STILL, edges_ns, np.random.default_rng([1, seed])
        )
        return allan_variance(noise[:, AXES[sensor]], 10 * tau_s)

    assert_allan(of_seed, density**2 / tau_s + walk**2 * tau_s / 3)
    assert (density**2 / tau_s > walk**2 * tau_s / 3) == (tau_s == 1)


@pytest.mark.parametrize("tau_s", [2, 20, 100])
def test_allan_deviation_recovers_gauss_markov_biases(tau_s):
    """σ²(τ) = (K T)² / τ · (1 − T / 2τ (3 − 4 e^(−τ/T) + e^(−2τ/T))), IEEE 952, B.9; in steady state."""
    T, edges_ns = 10.0, np.arange(12001) * 100_000_000
    expected = (STILL.gyro_walk * T) ** 2 / tau_s
    expected *= 1 - T / (2 * tau_s) * (3 - 4 * np.exp(-tau_s / T) + np.exp(-2 * tau_s / T))

    def of_seed(seed):
        return allan_variance(
            simulate_biases(STILL, edges_ns, np.random.default_rng(seed), T)[1000:, AXES["gyro"]], 10 * tau_s
        )

    assert_allan(of_seed, expected)


def test_gauss_markov_biases_start_at_turn_on_and_are_bounded():
    T, edges_ns = 2.0, np.arange(0, 301) * 100_000_000
    b = np.stack([simulate_biases(STILL, edges_ns, np.random.default_rng(seed), T) for seed in range(300)])
    walking = np.stack([simulate_biases(STILL, edges_ns, np.random.default_rng(seed)) for seed in range(300)])
    assert np.array_equal(b[:, 0], walking[:, 0])
    in_run = b - b[:, :1]
    for sensor, axes in AXES.items():
        K = getattr(STILL, f"{sensor}_walk")
        assert_variance(in_run[:, 1, axes], K * np.sqrt(T / 2 * (1 - np.exp(-0.2 / T))))
        assert_variance(in_run[:, -1, axes], K * np.sqrt(T / 2))
        correlation = np.sum(in_run[:, -1, axes] * in_run[:, -21, axes]) / np.sum(in_run[:, -1, axes] ** 2)
        assert correlation == pytest.approx(np.exp(-1), abs=4.5 / np.sqrt(900))


def test_gauss_markov_biases_with_a_long_memory_walk():
    edges_ns = np.arange(0, 1001) * 10_000_000
    walk, memory = (simulate_biases(STILL, edges_ns, np.random.default_rng(1), T) for T in (None, 1e7))
    scale = np.std(walk, axis=0)
    np.testing.assert_allclose(memory / scale, walk / scale, rtol=0, atol=1e-5)


def test_the_logs_truth_holds_the_gauss_markov_biases():
    log = simulate(Scenario(duration_s=30, imu=ImuSpec(STILL, faults=ImuFaults(bias_correlation_s=5.0))), 3)
    expected = simulate_biases(STILL, np.arange(3001) * 10_000_000, random_stream("lawnmower", "imu_bias", 3), 5.0)
    assert np.array_equal(np.hstack([log.truth.b_a, log.truth.b_g]), expected)
    assert "imu faults: bias_correlation_s 5." in log.notes


def test_better_grades_are_better():
    grades = [dataclasses.astuple(IMU_GRADES[g]) for g in ("consumer", "industrial", "tactical", "navigation")]
    gyro = np.array(grades)[:, [0, 2, 4]]
    assert (np.diff(gyro, axis=0) < 0).all()
