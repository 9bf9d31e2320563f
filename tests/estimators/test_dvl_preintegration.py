"""The preintegrated DVL finds the way between two keyframes, and its covariance is what Monte Carlo finds."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets import ImuNoise, Mounting, Rig
from fathom.estimators import FACTORS
from fathom.estimators.dvl_preintegration import preintegrate_dvl
from fathom.estimators.imu import compile_rig
from paths import Path, random_rig

DT = 0.01


def sum_up(
    imu: np.ndarray, t_ns: np.ndarray, v_WB_B: np.ndarray, sigma: float, b_g: np.ndarray, rig: Rig, straight: bool
) -> tuple[np.ndarray, np.ndarray]:
    spread = np.full((len(t_ns), 3), sigma)
    return preintegrate_dvl(imu, 0, t_ns, v_WB_B, spread, b_g, compile_rig(rig, FACTORS, {}), straight)


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
