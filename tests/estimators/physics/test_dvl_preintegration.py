"""The preintegrated DVL finds the way between two keyframes, and its covariance is what Monte Carlo finds."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from fathom.datasets import ImuNoise, Mounting, NavState, Rig
from fathom.estimators import FACTORS
from fathom.estimators.graph.gtsam_border import insert_state, tight_displacement_factor
from fathom.estimators.physics.dvl_preintegration import UNKNOWN_WALK, VelocityWalk, given_rotation, preintegrate_dvl
from fathom.estimators.physics.imu import BLOCK, HELD_RATE, compile_rig, integrate
from fathom.estimators.physics.measurements import tight_dvl_residual
from paths import Path, random_rig, random_rotation
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

DT = 0.01
ZERO = np.zeros(3)


def displacement_of(
    imu: np.ndarray,
    t_ns: np.ndarray,
    v_WB_B: np.ndarray,
    sigma: float,
    b_g: np.ndarray,
    rig: Rig,
    straight: bool,
    start_ns: int = 0,
    walk: np.ndarray = ZERO,
) -> np.ndarray:
    spread = np.full((len(t_ns), 3), sigma)
    return preintegrate_dvl(imu, start_ns, t_ns, v_WB_B, spread, b_g, compile_rig(rig, FACTORS, {}), straight, walk)


def sum_up(
    imu: np.ndarray, t_ns: np.ndarray, v_WB_B: np.ndarray, sigma: float, b_g: np.ndarray, rig: Rig, straight: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Δp̃ and its own covariance."""
    d = displacement_of(imu, t_ns, v_WB_B, sigma, b_g, rig, straight)[0]
    return d["dp"], d["N"][3:, 3:]


def second_of(path: Path, rig: Rig, b_g: np.ndarray, rate_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One second of IMU rows, and the DVL's times and velocities from its start on."""
    imu = path.imu(DT * np.arange(1, 101), DT, rig, np.zeros(3), b_g)
    t_s = np.arange(0.0, 1.0 - 1e-9, 1 / rate_hz)
    v_WB_B = np.einsum("nji,nj->ni", path.R_WB(t_s), path.velocity(t_s, np.zeros(3)))
    return imu, np.round(t_s * 1e9).astype(np.int64), v_WB_B


@pytest.mark.parametrize("seed", range(5))
def test_a_fast_dvl_gives_the_true_displacement(seed: int) -> None:
    """Readings at IMU rate, run straight: only the trapezoid's own error is left."""
    rng = np.random.default_rng(seed)
    rig, path, b_g = random_rig(rng), Path(seed), rng.normal(size=3) * 0.01
    imu, t_ns, v_WB_B = second_of(path, rig, b_g, 100.0)
    start, end = (path.state(t, np.zeros(3), b_g) for t in (0.0, 1.0))
    dp, _ = sum_up(imu, t_ns, v_WB_B, 0.01, b_g, rig, straight=True)
    assert np.linalg.norm(dp - start.R_WB.T @ (end.p_WB_W - start.p_WB_W)) < 3e-4


def test_turning_at_imu_rate_beats_turning_at_dvl_rate() -> None:
    """A noise-free second at 5 Hz, the velocity constant in B: exact for us, a centimetre off for the plain sum."""
    rig = Rig(ImuNoise(1e-4, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2))
    w, v_WB_B = np.array([0.0, 0.0, 0.3]), np.array([1.5, 0.0, 0.0])
    imu = Path(0).imu(DT * np.arange(1, 101), DT, rig, np.zeros(3), np.zeros(3))
    imu["w_WI_I"] = w
    t_ns = (np.arange(5) * 200_000_000).astype(np.int64)
    dp, _ = sum_up(imu, t_ns, np.tile(v_WB_B, (5, 1)), 0.01, np.zeros(3), rig, straight=False)
    true = 1.5 / 0.3 * np.array([np.sin(0.3), 1 - np.cos(0.3), 0.0])
    coarse = sum(0.2 * 1.5 * np.array([np.cos(0.3 * t), np.sin(0.3 * t), 0]) for t in np.arange(5) * 0.2)
    assert np.linalg.norm(dp - true) < 1e-5
    assert np.linalg.norm(coarse - true) > 1e-2


def test_interval_ends_on_the_keyframe_not_on_the_last_reading() -> None:
    rig = Rig(ImuNoise(1e-4, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2))
    imu = Path(0).imu(DT * np.arange(1, 101), DT, rig, np.zeros(3), np.zeros(3))
    imu["w_WI_I"] = 0.0
    t_ns = np.array([130_000_000, 471_000_000], dtype=np.int64)  # the second falls inside an IMU sample
    v_WB_B = np.array([[1.0, 0, 0], [2.0, 0, 0]])
    held, _ = sum_up(imu, t_ns, v_WB_B, 0.01, np.zeros(3), rig, straight=False)
    straight, _ = sum_up(imu, t_ns, v_WB_B, 0.01, np.zeros(3), rig, straight=True)
    assert held[0] == pytest.approx(0.471 * 1.0 + 0.529 * 2.0, abs=1e-12)
    assert straight[0] == pytest.approx(0.130 * 1.0 + 0.341 * 1.5 + 0.529 * 2.0, abs=1e-12)


# --- what the velocity does between readings ------------------------------------------------------------------------


STRAYS = np.array([0.02, 0.05, 0.01])
"""m²/s³ along the axes of B."""


@pytest.mark.parametrize(("straight", "share"), [(False, 3.0), (True, 12.0)])
def test_what_is_lost_between_readings_has_the_closed_form(straight: bool, share: float) -> None:
    """S Δt³/3 held and S Δt³/12 straight, each reading's; before the first and after the last it is always held."""
    rig = Rig(ImuNoise(1e-9, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2))
    imu = Path(0).imu(DT * np.arange(1, 101), DT, rig, ZERO, ZERO)
    imu["w_WI_I"] = 0.0
    t_ns = np.array([100_000_000, 400_000_000, 900_000_000], dtype=np.int64)
    d = displacement_of(imu, t_ns, np.ones((3, 3)), 0.0, ZERO, rig, straight, walk=STRAYS)[0]
    lost = (0.1**3 + 0.1**3) / 3 + (0.3**3 + 0.5**3) / share
    np.testing.assert_allclose(d["N"][3:, 3:], lost * np.diag(STRAYS), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("straight", [False, True])
def test_what_is_lost_is_what_monte_carlo_finds_as_the_vehicle_turns(straight: bool) -> None:
    """A velocity that walks in B at IMU rate, read without noise at 5 Hz."""
    rng, runs = np.random.default_rng(5), 1500
    rig = Rig(ImuNoise(1e-9, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2))
    imu, t_ns, _ = second_of(Path(3), rig, ZERO, 5.0)
    t_ns = np.append(t_ns, 1_000_000_000)
    claimed = displacement_of(imu, t_ns, np.zeros((6, 3)), 0.0, ZERO, rig, straight, walk=STRAYS)[0]["N"][3:, 3:]
    fine_ns, errors = imu["t_ns"] - imu["t_ns"][0], np.empty((runs, 3))
    for run in range(runs):
        v = np.vstack([ZERO, np.cumsum(rng.normal(size=(100, 3)) * np.sqrt(STRAYS * DT), axis=0)])
        true, _ = sum_up(imu, np.append(fine_ns, 1_000_000_000), v, 0.0, ZERO, rig, True)
        errors[run] = sum_up(imu, t_ns, v[::20], 0.0, ZERO, rig, straight)[0] - true
    whitened = np.linalg.solve(np.linalg.cholesky(claimed), errors.T)
    assert np.abs(whitened @ whitened.T / runs - np.eye(3)).max() < 5 / np.sqrt(runs)


def test_a_reading_shared_by_two_sums_leaves_many_of_them_right() -> None:
    """N seconds of n readings each: the noise of all, N n σ² Δt², whoever shares one with his neighbour."""
    rig, sigma = Rig(ImuNoise(1e-9, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2)), 0.02
    imu = Path(0).imu(DT * np.arange(1, 101), DT, rig, ZERO, ZERO)
    imu["w_WI_I"] = 0.0
    t_ns = np.arange(6) * 200_000_000
    _, N_pp = sum_up(imu, t_ns, np.ones((6, 3)), sigma, ZERO, rig, straight=True)
    np.testing.assert_allclose(N_pp, 5 * (sigma * 0.2) ** 2 * np.eye(3), rtol=1e-6, atol=1e-12)


def test_the_walk_is_found_from_the_readings_so_far() -> None:
    """From noisy readings of a walk of known density, by axis; nothing of the noise of a velocity that stays."""
    rng, sigma, dt = np.random.default_rng(2), np.array([0.01, 0.02, 0.005]), 0.2
    t_ns = np.arange(4000) * 200_000_000
    v = np.cumsum(rng.normal(size=(4000, 3)) * np.sqrt(STRAYS * dt), axis=0) + sigma * rng.normal(size=(4000, 3))
    walk, still = VelocityWalk(), VelocityWalk()
    found = [walk.take(t_ns[k : k + 5], v[k : k + 5], np.tile(sigma, (5, 1))) for k in range(0, 4000, 5)]
    noise = sigma * rng.normal(size=(4000, 3))
    none = [still.take(t_ns[k : k + 5], noise[k : k + 5], np.tile(sigma, (5, 1))) for k in range(0, 4000, 5)]
    assert (np.median(found, axis=0) / STRAYS > 0.9).all()
    assert (np.median(found, axis=0) / STRAYS < 1.5).all()  # the larger of two, so a little too large
    assert (np.mean(none, axis=0) < 2 * sigma**2 / dt).all()
    assert (walk.take(t_ns[-5:], v[-5:], np.tile(sigma, (5, 1))) > 0).all()  # readings that are known tell nothing new


def test_before_a_second_reading_the_walk_is_not_taken_for_none() -> None:
    walk = VelocityWalk()
    first = walk.take(np.zeros(1, np.int64), np.ones((1, 3)), np.full((1, 3), 0.01))
    assert (first == UNKNOWN_WALK).all()
    begun = walk.take(np.array([10**9]), np.array([[1.5, 1.0, 1.0]]), np.full((1, 3), 0.01))
    np.testing.assert_allclose(begun, [0.25 - 2e-4, 0.0, 0.0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize(("gyro_density", "sigma"), [(0.0, 0.02), (0.005, 2e-4), (0.01, 0.02)])
def test_covariance_is_what_monte_carlo_finds(gyro_density: float, sigma: float, straight: bool) -> None:
    """DVL noise alone, gyro noise alone (much, so that it shows), and both."""
    rng = np.random.default_rng(1)
    noise = ImuNoise(gyro_density, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2)
    rig, path, runs = Rig(noise, imu=Mounting(random_rig(rng).imu.R_BS)), Path(3), 3000
    imu, t_ns, v_WB_B = second_of(path, rig, np.zeros(3), 5.0)
    clean, claimed = sum_up(imu, t_ns, v_WB_B, sigma, np.zeros(3), rig, straight)
    errors = np.empty((runs, 3))
    for run in range(runs):
        noisy = imu.copy()
        noisy["w_WI_I"] += rng.normal(size=(100, 3)) * gyro_density / np.sqrt(DT)
        velocities = v_WB_B + sigma * rng.normal(size=v_WB_B.shape)
        errors[run] = sum_up(noisy, t_ns, velocities, sigma, np.zeros(3), rig, straight)[0] - clean
    whitened = np.linalg.solve(np.linalg.cholesky(claimed + 1e-18 * np.eye(3)), errors.T)
    assert np.abs(whitened @ whitened.T / runs - np.eye(3)).max() < 5 / np.sqrt(runs)


def test_a_gap_in_the_imu_is_in_the_covariance() -> None:
    """The rate strays by a constant of HELD_RATE over a gap of 0.2 s; the claim, which lets it stray white, is near."""
    rng, runs, gap = np.random.default_rng(4), 3000, slice(30, 50)
    rig, path = Rig(ImuNoise(1e-6, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2), imu=Mounting(random_rotation(rng))), Path(3)
    imu, t_ns, v_WB_B = second_of(path, rig, ZERO, 5.0)
    imu["held_s"][gap] = 0.2
    clean, claimed = sum_up(imu, t_ns, v_WB_B, 1e-6, ZERO, rig, False)
    errors = np.empty((runs, 3))
    for run in range(runs):
        strayed = imu.copy()
        strayed["w_WI_I"][gap] += HELD_RATE * rng.normal(size=3)
        errors[run] = sum_up(strayed, t_ns, v_WB_B, 1e-6, ZERO, rig, False)[0] - clean
    across = np.linalg.svd(claimed)[0][:, :2]  # turning displaces sideways only
    ratio = np.diag(across.T @ (errors.T @ errors / runs) @ across) / np.diag(across.T @ claimed @ across)
    assert (ratio > 0.85).all()
    assert (ratio < 1.15).all()


# --- tight: the displacement given the rotation, and the gyro bias ---------------------------------------------------


def odd_interval(seed: int, rig: Rig, b_g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """IMU rows of 1.3 s, and a DVL of an odd rate whose readings begin before the interval (seed even) or in it."""
    rng = np.random.default_rng([seed, 9])
    start_s, rate_hz = 0.4, rng.uniform(2.1, 9.7)
    imu = Path(seed).imu(start_s + DT * np.arange(1, 131), DT, rig, ZERO, b_g)
    t_s = start_s + (0.11 if seed % 2 else -0.07) + np.arange(0.0, 1.2, 1 / rate_hz)
    v_WB_B = np.einsum("nji,nj->ni", Path(seed).R_WB(t_s), Path(seed).velocity(t_s, ZERO))
    return imu, np.round(t_s * 1e9).astype(np.int64), v_WB_B, round(start_s * 1e9)


@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_bias_jacobians_are_derivatives_of_the_sums(seed: int, straight: bool) -> None:
    rng = np.random.default_rng(seed)
    rig, b_g, h = random_rig(rng), rng.normal(size=3) * 0.02, 1e-4
    imu, t_ns, v_WB_B, start_ns = odd_interval(seed, rig, b_g)

    def at(b: np.ndarray) -> np.ndarray:
        return displacement_of(imu, t_ns, v_WB_B, 0.01, b, rig, straight, start_ns)[0]

    d = at(b_g)
    R_bg, p_bg = np.empty((3, 3)), np.empty((3, 3))
    for k, e in enumerate(h * np.eye(3)):
        up, down = at(b_g + e), at(b_g - e)
        R_bg[:, k] = Rotation.from_matrix(down["dR"].T @ up["dR"]).as_rotvec() / (2 * h)
        p_bg[:, k] = (up["dp"] - down["dp"]) / (2 * h)
    assert np.abs(d["R_bg"] - R_bg).max() < 1e-5
    assert np.abs(d["p_bg"] - p_bg).max() < 5e-5  # of second order in the turn of one sample
    assert np.linalg.norm(p_bg) > 0.1


@pytest.mark.parametrize("seed", range(4))
def test_rotation_is_that_of_the_imu_factor(seed: int) -> None:
    """The same rotation (but for coning), bias Jacobian and covariance as the IMU block's, over a gap as well."""
    rng = np.random.default_rng(seed)
    rig, b_g, block = random_rig(rng), rng.normal(size=3) * 0.02, np.zeros(1, BLOCK)
    imu, t_ns, v_WB_B, start_ns = odd_interval(seed, rig, b_g)
    imu["held_s"][40:60] = 0.2
    integrate(imu, imu[:1], ZERO, b_g, compile_rig(rig, FACTORS, {}), block)
    d, b = displacement_of(imu, t_ns, v_WB_B, 0.01, b_g, rig, False, start_ns)[0], block[0]
    assert np.abs(d["dR"] - b["dR"]).max() < 1e-5
    assert np.allclose(d["R_bg"], b["R_bg"], atol=1e-5)
    assert np.allclose(d["N"][:3, :3], b["N"][:3, :3], rtol=1e-9, atol=0)


def unlike_identity(samples: np.ndarray) -> float:
    """Likelihood ratio of "covariance I, mean zero" for samples (n, k): χ² of k (k + 1) / 2 degrees of freedom."""
    S = samples.T @ samples / len(samples)
    return len(samples) * (np.trace(S) - np.linalg.slogdet(S)[1] - len(S))


@pytest.mark.slow
@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("seed", [1, 2])
def test_joint_covariance_is_what_monte_carlo_finds_and_tight_is_independent_of_the_rotation(
    seed: int, straight: bool
) -> None:
    """Gyro noise as strong as the DVL's, a mounted IMU, sums at a wrong bias; errors of rotation and displacement.

    First together, by the 6 × 6 covariance. Then the tight residual at the true bias, beside the rotation's error.
    """
    rng, runs, sigma, density = np.random.default_rng(seed), 4000, 5e-3, 3e-3
    noise = ImuNoise(density, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2)
    rig, b_g, off = random_rig(rng, noise=noise), rng.normal(size=3) * 0.02, rng.normal(size=3) * 5e-4
    imu, t_ns, v_WB_B, start_ns = odd_interval(seed, rig, b_g)
    clean = displacement_of(imu, t_ns, v_WB_B, sigma, b_g, rig, straight, start_ns)[0]
    R_i, p_i = random_rotation(rng), rng.normal(size=3)
    R_j, p_j = R_i @ clean["dR"], p_i + R_i @ clean["dp"]
    K, C = given_rotation(clean["N"])
    L_N, L_C = np.linalg.cholesky(clean["N"]), np.linalg.cholesky(C)
    joint, tight = np.empty((runs, 6)), np.empty((runs, 3))
    for run in range(runs):
        noisy = imu.copy()
        noisy["w_WI_I"] += rng.normal(size=(len(imu), 3)) * density / np.sqrt(DT)
        velocities = v_WB_B + sigma * rng.normal(size=v_WB_B.shape)
        d = displacement_of(noisy, t_ns, velocities, sigma, b_g, rig, straight, start_ns)[0]
        joint[run, :3] = Rotation.from_matrix(clean["dR"] @ d["dR"].T).as_rotvec()
        joint[run, 3:] = clean["dp"] - d["dp"]
        d = displacement_of(noisy, t_ns, velocities, sigma, b_g + off, rig, straight, start_ns)
        H_i, H_j = np.empty((3, 15)), np.empty((3, 15))
        tight[run] = tight_dvl_residual(R_i, p_i, b_g, R_j, p_j, d, K, H_i, H_j)
    assert unlike_identity(np.linalg.solve(L_N, joint.T).T) < chi2.ppf(0.999, 21)
    apart = np.hstack([joint[:, :3] / np.sqrt(clean["N"][0, 0]), np.linalg.solve(L_C, tight.T).T])
    assert unlike_identity(apart) < chi2.ppf(0.999, 21)


def test_straight_ahead_the_rotation_takes_three_quarters_of_the_gyros_noise_and_all_of_its_bias() -> None:
    """Closed form at constant velocity without turning: variance q v² T²/3 loose and q v² T²/12 tight, across."""
    density, v, T = 1e-3, 1.7, 1.0
    rig = Rig(ImuNoise(density, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2), imu=Mounting(random_rotation(np.random.default_rng(0))))
    imu = Path(0).imu(DT * np.arange(1, 101), DT, rig, ZERO, ZERO)
    imu["w_WI_I"] = 0.0
    d = displacement_of(imu, np.zeros(1, np.int64), np.array([[v, 0.0, 0.0]]), 0.0, ZERO, rig, False)
    K, C = given_rotation(d[0]["N"])
    q = density**2 * T
    assert np.allclose(d[0]["N"][3:, 3:], q * v**2 * T**2 / 3 * np.diag([0, 1, 1]), rtol=1e-3, atol=1e-15)
    assert np.allclose(C, q * v**2 * T**2 / 12 * np.diag([0, 1, 1]), rtol=1e-3, atol=1e-15)
    H_i, H_j = np.empty((3, 15)), np.empty((3, 15))
    tight_dvl_residual(np.eye(3), ZERO, ZERO, np.eye(3), d[0]["dp"], d, K, H_i, H_j)
    assert np.abs(H_i[:, 12:]).max() < 1e-12
    assert np.abs(d[0]["p_bg"]).max() > 0.5


@pytest.mark.parametrize("seed", range(5))
def test_tight_residual_vanishes_on_a_path_at_the_true_bias(seed: int) -> None:
    """Summed at a bias that is off by 2e-3 rad/s, which alone would displace by a millimetre."""
    rng = np.random.default_rng(seed)
    rig, path, b_g, off = random_rig(rng), Path(seed), rng.normal(size=3) * 0.01, np.array([2e-3, -2e-3, 2e-3])
    imu, t_ns, v_WB_B = second_of(path, rig, b_g, 100.0)
    start, end = (path.state(t, ZERO, b_g) for t in (0.0, 1.0))

    def residual(summed_at: np.ndarray) -> np.ndarray:
        d = displacement_of(imu, t_ns, v_WB_B, 0.01, summed_at, rig, straight=True)
        K, _ = given_rotation(d[0]["N"])
        H_i, H_j = np.empty((3, 15)), np.empty((3, 15))
        return tight_dvl_residual(start.R_WB, start.p_WB_W, b_g, end.R_WB, end.p_WB_W, d, K, H_i, H_j)

    assert np.linalg.norm(residual(b_g)) < 3e-4
    assert np.linalg.norm(residual(b_g + off) - residual(b_g)) < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_rotation_and_tight_factor_together_are_the_joint_density(seed: int) -> None:
    """e_Rᵀ N_RR⁻¹ e_R + the tight factor's squared error = eᵀ N⁻¹ e, for any two poses and at any bias."""
    rng = np.random.default_rng(seed)
    rig, b_g = random_rig(rng, noise=ImuNoise(5e-3, 1e-3, 1e-6, 1e-5, 1e-4, 1e-2)), rng.normal(size=3) * 0.02
    imu, t_ns, v_WB_B, start_ns = odd_interval(seed, rig, b_g)
    d = displacement_of(imu, t_ns, v_WB_B, 0.01, b_g, rig, True, start_ns)
    b_i = b_g + 1e-3 * rng.normal(size=3)
    i = NavState(random_rotation(rng), rng.normal(size=3), ZERO, ZERO, b_i)
    turned = d[0]["dR"] @ Rotation.from_rotvec(d[0]["R_bg"] @ (b_i - b_g)).as_matrix()
    e_R = 0.01 * rng.normal(size=3)
    R_j = i.R_WB @ Rotation.from_rotvec(e_R).as_matrix() @ turned
    p_j = i.p_WB_W + i.R_WB @ d[0]["dp"] + 0.02 * rng.normal(size=3)
    e = np.concatenate([e_R, i.R_WB.T @ (p_j - i.p_WB_W) - d[0]["dp"] - d[0]["p_bg"] @ (b_i - b_g)])
    values = gtsam.Values()
    insert_state(values, 0, i, rig.imu.R_BS)
    insert_state(values, 1, NavState(R_j, p_j, ZERO, ZERO, ZERO), rig.imu.R_BS)
    factor = tight_displacement_factor(0, 1, d, compile_rig(rig, FACTORS, {}))
    rotation = e_R @ np.linalg.solve(d[0]["N"][:3, :3], e_R)
    assert rotation + 2 * factor.error(values) == pytest.approx(e @ np.linalg.solve(d[0]["N"], e), rel=1e-9)
