"""The simulated IMU: means of the exact motion at its own point, biases and white noise."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from ..log import ImuStream
from ..rig import ImuNoise, Mounting
from ..state import Array, TimeArray
from .faults import arrives, mar, repeated
from .motion import Motion
from .random_streams import random_stream
from .scenario import Scenario


def sample_imu(scenario: Scenario, seed: int, motion: Motion, edges_ns: TimeArray, biases: Array) -> ImuStream:
    """Return the IMU's samples: means of the motion, plus bias and white noise, with the IMU's faults.

    Args:
        scenario: what is simulated.
        seed: of the noise and the faults.
        motion: of B.
        edges_ns: (n + 1,) where the intervals begin and end by the IMU's clock, from the start.
        biases: (n + 1, 6) of (f, w) at the edges; a sample carries that of its interval's beginning.
    """
    faults, noise = scenario.imu.faults, scenario.imu.figures
    rng = partial(random_stream, scenario.mission, seed=seed)
    true_ns = edges_ns - round(faults.clock_offset_s * 1e9)
    signal = np.hstack(
        mean_imu(motion, scenario.mountings["imu"], scenario.gravity_m_s2, true_ns, scenario.earth_rate_rad_s)
    )
    white = simulate_white_noise(noise, edges_ns, rng("imu_noise")) * scenario.noise_scale
    samples = mar(signal * faults.scale + biases[:-1] + white, faults, rng("imu_outliers"))
    t_ns = edges_ns[1:]
    heard = arrives(t_ns, faults, rng("imu_dropouts"))
    rows = repeated(heard, faults, rng("imu_repeats"))
    return ImuStream(scenario.start_ns + t_ns[heard], samples[rows, 3:], samples[rows, :3])


def mean_imu(
    motion: Motion, imu: Mounting, gravity: float, edges_ns: TimeArray, earth_rate_W: Array
) -> tuple[Array, Array]:
    """Return the means of f_I and of the rate that a gyro senses, in I axes, over each interval, (n, 3), without noise.

    The mean is Gauss–Legendre's of two nodes, whose error is of fourth order in the interval (below 1e-9 of the signal
    at 100 Hz).

    Args:
        motion: of B.
        imu: where the IMU really sits.
        gravity: m/s².
        edges_ns: (n + 1,) where the intervals begin and end, from the start.
        earth_rate_W: (3,) rad/s.
    """
    half_s = np.diff(edges_ns) * 0.5e-9
    middle_s = edges_ns[:-1] * 1e-9 + half_s
    f_B, sensed_B = np.zeros((len(half_s), 3)), np.zeros((len(half_s), 3))
    for node in (-1 / math.sqrt(3), 1 / math.sqrt(3)):
        f_node, w_node = specific_force(motion, middle_s + node * half_s, imu.p_BS_B, gravity, earth_rate_W)
        f_B += 0.5 * f_node
        sensed_B += 0.5 * w_node
    return f_B @ imu.R_BS, sensed_B @ imu.R_BS


def specific_force(
    motion: Motion, t_s: Array, p_BI_B: Array, gravity: float, earth_rate_W: Array
) -> tuple[Array, Array]:
    """Return the specific force at a point of the body and the rate that a gyro senses, (n, 3) in B axes, at t_s (n,).

    f = R_BW (a_WB_W − g_W) + alpha × l + w × (w × l), with l = p_BI_B and w = w_WB_B. Where W turns with the Earth, at
    Ω, Coriolis adds R_BW (2 Ω × v_WI_W), and the gyro senses w + R_BW Ω; the centrifugal force is part of gravity.
    """
    R_WB, w_WB_B, alpha_WB_B = motion.attitude(t_s)
    a_W = motion.acceleration(t_s) + np.array([0.0, 0.0, gravity])
    turned_B = _cross(w_WB_B, p_BI_B)
    sensed_B = w_WB_B
    if earth_rate_W.any():
        v_WI_W = motion.velocity(t_s) + np.einsum("nij,nj->ni", R_WB, turned_B)
        a_W += 2 * np.cross(earth_rate_W, v_WI_W)
        sensed_B = w_WB_B + earth_rate_W @ R_WB
    f_B = np.einsum("nji,nj->ni", R_WB, a_W)
    f_B += _cross(alpha_WB_B, p_BI_B) + _cross(w_WB_B, turned_B)
    return f_B, sensed_B


def _cross(a: Array, b: Array) -> Array:
    """Return a × b for a (n, 3) and b (3,) or (n, 3); several times faster than numpy's."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def simulate_biases(
    noise: ImuNoise, edges_ns: TimeArray, rng: np.random.Generator, correlation_s: float | None = None
) -> Array:
    """Return (b_a, b_g), (n + 1, 6), at the edges: a draw at turn-on, and what is added to it in run.

    In run the bias walks; or, with correlation_s = T, it is a first-order Gauss–Markov process that the same noise K
    drives, db = −b/T dt + K dW, which has a standard deviation of K √(T / 2) in the long run, and starts at zero.
    """
    draws = rng.standard_normal((len(edges_ns), 6))
    draws[0] *= _six(noise.accel_bias_sigma, noise.gyro_bias_sigma)
    dt_s = np.diff(edges_ns) * 1e-9
    walk = _six(noise.accel_walk, noise.gyro_walk)
    if correlation_s is None:
        draws[1:] *= np.sqrt(dt_s)[:, None] * walk
        return np.cumsum(draws, axis=0)
    from scipy.signal import lfilter

    draws[1:] *= np.sqrt(-0.5 * correlation_s * np.expm1(-2 * dt_s / correlation_s))[:, None] * walk
    decay = math.exp(-float(np.mean(dt_s)) / correlation_s)  # intervals differ by a nanosecond at most
    biases = np.repeat(draws[:1], len(draws), axis=0)
    biases[1:] += lfilter([1.0], [1.0, -decay], draws[1:], axis=0)
    return biases


def simulate_white_noise(noise: ImuNoise, edges_ns: TimeArray, rng: np.random.Generator) -> Array:
    """Return white noise of (f, w), (n, 6): the mean of a density over an interval dt has sigma = density / √dt."""
    draws = rng.standard_normal((len(edges_ns) - 1, 6))
    return draws * _six(noise.accel_density, noise.gyro_density) / np.sqrt(np.diff(edges_ns) * 1e-9)[:, None]


def _six(accel: float, gyro: float) -> Array:
    """Return one figure per axis, in the order of (b_a, b_g)."""
    return np.repeat([accel, gyro], 3)
