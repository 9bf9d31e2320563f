"""Simulate a log: exact motion, sensors that read it through their mountings, and noise of the stated size."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import DatasetError
from .log import DepthStream, DvlStream, GpsStream, HeadingStream, ImuStream, Log, ReadingStream
from .mission import Motion, fly
from .rig import ImuNoise, Mounting, Rig
from .scenario import DEGREE, DepthSpec, DvlSpec, GpsSpec, HeadingSpec, Scenario, SensorSpec
from .state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array, Belief, TimeArray
from .trajectory import Trajectory

Kind = TypeVar("Kind", bound=ReadingStream)

RANDOM_STREAMS = {
    "mission": 0,
    "imu_noise": 1,
    "imu_bias": 2,
    "dvl": 3,
    "depth": 4,
    "gps": 5,
    "heading": 6,
    "prior": 7,
    "dvl_disorder": 8,
    "depth_disorder": 9,
    "gps_disorder": 10,
    "heading_disorder": 11,
}
"""Every cause of randomness has a stream of its own, so that dropping one changes no other. Never renumber."""

ANTENNA_AWASH_M = -0.05
"""The antenna hears GPS while it is higher than this; a little water over it does not yet drown the signal."""


def simulate(scenario: Scenario, seed: int) -> Log:
    """Return the log of one scenario; the same seed gives the same log, bit for bit, on one machine type.

    Raises:
        DatasetError: the seed is negative.
    """
    if seed < 0:
        raise DatasetError(f"simulate: seed must not be negative, found {seed}")
    motion, rig, start_ns = fly(scenario, random_stream(seed, "mission")), scenario.rig, scenario.start_ns
    imu_ns = ticks(scenario.imu_rate_hz, scenario.duration_s)
    edges_ns = np.concatenate([[0], imu_ns])
    biases = simulate_biases(rig.imu_noise, edges_ns, seed) * scenario.noise_scale
    white = simulate_white_noise(rig.imu_noise, edges_ns, seed) * scenario.noise_scale
    f_I, w_WI_I = mean_imu(motion, rig, edges_ns)

    R_WB, p_WB_W, v_WB_W = motion.pose(edges_ns * 1e-9)
    truth = Trajectory(start_ns + edges_ns, R_WB, p_WB_W, v_WB_W, b_a=biases[:, :3], b_g=biases[:, 3:])
    grade = scenario.imu if isinstance(scenario.imu, str) else "custom"
    return Log(
        name=f"{scenario.mission}-{grade}-s{seed}",
        rig=rig,
        imu=ImuStream(start_ns + imu_ns, w_WI_I + biases[:-1, 3:] + white[:, 3:], f_I + biases[:-1, :3] + white[:, :3]),
        dvl=_stream(DvlStream, scenario, seed, motion),
        depth=_stream(DepthStream, scenario, seed, motion),
        gps=_stream(GpsStream, scenario, seed, motion),
        heading=_stream(HeadingStream, scenario, seed, motion),
        truth=truth,
        prior=draw_prior(scenario, truth, seed),
        notes=(
            f"Simulated: {scenario.mission}, {scenario.duration_s:g} s, {grade} IMU at {scenario.imu_rate_hz:g} Hz, "
            f"seed {seed}, noise scaled by {scenario.noise_scale:g}; the Earth does not turn.",
            *_late(scenario),
        ),
    )


def random_stream(seed: int, cause: str) -> np.random.Generator:
    """Return the generator of one cause of randomness."""
    return np.random.default_rng([seed, RANDOM_STREAMS[cause]])


def ticks(rate_hz: float, duration_s: float) -> TimeArray:
    """Return k / rate_hz for k ≥ 1 up to duration_s, in ns, each rounded by itself."""
    count = math.floor(duration_s * rate_hz * (1 + 1e-12))
    return np.rint(np.arange(1, count + 1) * (1e9 / rate_hz)).astype(np.int64)


def mean_imu(motion: Motion, rig: Rig, edges_ns: TimeArray) -> tuple[Array, Array]:
    """Return the means of f_I and w_WI_I over each interval, (n, 3), without noise.

    f_I = R_IB (R_BW (a_WB_W − g_W) + alpha × l + w × (w × l)), l = p_BI_B. The mean is Gauss–Legendre's of two nodes,
    whose error is of fourth order in the interval (below 1e-9 of the signal at 100 Hz).

    Args:
        motion: of B.
        rig: its IMU's mounting and gravity.
        edges_ns: (n + 1,) where the intervals begin and end, from the start.
    """
    half_s = np.diff(edges_ns) * 0.5e-9
    middle_s = edges_ns[:-1] * 1e-9 + half_s
    f_B, w_WB_B = np.zeros((len(half_s), 3)), np.zeros((len(half_s), 3))
    for node in (-1 / math.sqrt(3), 1 / math.sqrt(3)):
        f_node, w_node = specific_force(motion, middle_s + node * half_s, rig.imu.p_BS_B, rig.gravity)
        f_B += 0.5 * f_node
        w_WB_B += 0.5 * w_node
    return f_B @ rig.imu.R_BS, w_WB_B @ rig.imu.R_BS


def specific_force(motion: Motion, t_s: Array, p_BI_B: Array, gravity: float) -> tuple[Array, Array]:
    """Return the specific force at a point of the body and w_WB_B, both (n, 3) in B axes, at times t_s (n,)."""
    R_WB, w_WB_B, alpha_WB_B = motion.attitude(t_s)
    up_W = np.array([0.0, 0.0, gravity])
    f_B = np.einsum("nji,nj->ni", R_WB, motion.acceleration(t_s) + up_W)
    f_B += _cross(alpha_WB_B, p_BI_B) + _cross(w_WB_B, _cross(w_WB_B, p_BI_B))
    return f_B, w_WB_B


def _cross(a: Array, b: Array) -> Array:
    """Return a × b for a (n, 3) and b (3,) or (n, 3); several times faster than numpy's."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def simulate_biases(noise: ImuNoise, edges_ns: TimeArray, seed: int) -> Array:
    """Return (b_a, b_g), (n + 1, 6), at the edges: a draw at turn-on, then a random walk.

    A sample carries the bias of its interval's beginning.
    """
    draws = random_stream(seed, "imu_bias").standard_normal((len(edges_ns), 6))
    draws[0] *= _six(noise.accel_bias_sigma, noise.gyro_bias_sigma)
    draws[1:] *= np.sqrt(np.diff(edges_ns) * 1e-9)[:, None] * _six(noise.accel_walk, noise.gyro_walk)
    return np.cumsum(draws, axis=0)


def simulate_white_noise(noise: ImuNoise, edges_ns: TimeArray, seed: int) -> Array:
    """Return white noise of (f, w), (n, 6): the mean of a density over an interval dt has sigma = density / √dt."""
    draws = random_stream(seed, "imu_noise").standard_normal((len(edges_ns) - 1, 6))
    return draws * _six(noise.accel_density, noise.gyro_density) / np.sqrt(np.diff(edges_ns) * 1e-9)[:, None]


def _six(accel: float, gyro: float) -> Array:
    return np.repeat([accel, gyro], 3)


def draw_prior(scenario: Scenario, truth: Trajectory, seed: int) -> Belief:
    """Return the belief at the start: its mean is the truth less one draw of the error that its P states.

    The biases' means are zero: their errors were drawn at turn-on.
    """
    noise, prior = scenario.imu_noise, scenario.prior
    sigma = np.empty(DIM)
    sigma[THETA] = prior.attitude_deg * DEGREE
    sigma[POSITION] = prior.position_m
    sigma[VELOCITY] = prior.velocity_mps
    sigma[ACCEL_BIAS] = noise.accel_bias_sigma
    sigma[GYRO_BIAS] = noise.gyro_bias_sigma
    state = truth.state(0)
    error = random_stream(seed, "prior").standard_normal(DIM) * sigma * scenario.noise_scale
    error[ACCEL_BIAS], error[GYRO_BIAS] = state.b_a, state.b_g
    return Belief(int(truth.t_ns[0]), state.retract(-error), np.diag(sigma**2))


def _stream(kind: type[Kind], scenario: Scenario, seed: int, motion: Motion) -> Kind | None:
    """Return one sensor's readings, or None where it is not aboard.

    Noise is drawn for every tick, whether or not it gives a reading.
    """
    spec = getattr(scenario, kind.name)
    if spec is None:
        return None
    t_ns = ticks(spec.rate_hz, scenario.duration_s)
    z, error, sigma = READ[kind](spec, scenario.rig, motion, t_ns * 1e-9, random_stream(seed, kind.name))
    heard = np.isfinite(z).all(axis=1)
    t_ns, z = scenario.start_ns + t_ns[heard], (z + scenario.noise_scale * error)[heard]
    if kind is HeadingStream:
        z = np.arctan2(np.sin(z), np.cos(z))
    return kind(t_ns, t_ns + _delays(spec, kind.name, heard, seed), z, np.tile(sigma, (len(z), 1)))


def _delays(spec: SensorSpec, sensor: str, heard: NDArray[np.bool_], seed: int) -> TimeArray:
    """Return how long each reading that is heard is on its way, ns: delay_s, and uniformly up to disorder_s more."""
    more_s = spec.disorder_s * random_stream(seed, f"{sensor}_disorder").random(len(heard))
    return np.rint((spec.delay_s + more_s[heard]) * 1e9).astype(np.int64)


def _late(scenario: Scenario) -> list[str]:
    """Return a sentence on each sensor whose readings come late."""
    specs = {sensor: getattr(scenario, sensor) for sensor in ("dvl", "depth", "gps", "heading")}
    return [
        f"{sensor} comes {spec.delay_s:g} s late, and up to {spec.disorder_s:g} s more, at random."
        for sensor, spec in specs.items()
        if spec is not None and (spec.delay_s or spec.disorder_s)
    ]


def janus_beams(beam_angle_rad: float) -> Array:
    """Return the unit vectors (4, 3), in B, of beams at azimuths 45°, 135°, … and beam_angle_rad from straight down."""
    azimuth = np.pi / 4 + np.pi / 2 * np.arange(4)
    s, c = math.sin(beam_angle_rad), math.cos(beam_angle_rad)
    return np.stack([s * np.cos(azimuth), s * np.sin(azimuth), np.full(4, -c)], axis=1)


# Each reader returns what the sensor would say without noise (n, k), NaN where it hears nothing, its error (n, k), and
# the standard deviation of the residual (m,).


def _read_dvl(spec: DvlSpec, rig: Rig, motion: Motion, t_s: Array, rng: np.random.Generator) -> tuple[Array, ...]:
    """v_WB_B by least squares from four beam velocities; (AᵀA)⁻¹ is diagonal, so the three errors are independent."""
    R_WB, _, v_WB_W = motion.pose(t_s)
    A = janus_beams(spec.beam_angle_deg * DEGREE)
    beam_error = spec.beam_sigma_mps * rng.standard_normal((len(t_s), 4))
    sigma = spec.beam_sigma_mps * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    return np.einsum("nji,nj->ni", R_WB, v_WB_W), beam_error @ np.linalg.pinv(A).T, sigma


def _read_depth(spec: DepthSpec, rig: Rig, motion: Motion, t_s: Array, rng: np.random.Generator) -> tuple[Array, ...]:
    p_WP_W = _point(motion, rig.depth, t_s)
    return p_WP_W[:, 2:], spec.sigma_m * rng.standard_normal((len(t_s), 1)), np.array([spec.sigma_m])


def _read_gps(spec: GpsSpec, rig: Rig, motion: Motion, t_s: Array, rng: np.random.Generator) -> tuple[Array, ...]:
    p_WG_W = _point(motion, rig.gps, t_s)
    sigma = np.array([spec.horizontal_sigma_m, spec.horizontal_sigma_m, spec.vertical_sigma_m])
    afloat = p_WG_W[:, 2:] > ANTENNA_AWASH_M
    return np.where(afloat, p_WG_W, np.nan), sigma * rng.standard_normal((len(t_s), 3)), sigma


def _read_heading(
    spec: HeadingSpec, rig: Rig, motion: Motion, t_s: Array, rng: np.random.Generator
) -> tuple[Array, ...]:
    R_WB, _, _ = motion.pose(t_s)
    x_H_W = R_WB @ rig.heading.R_BS[:, 0]
    psi = np.arctan2(x_H_W[:, 1:2], x_H_W[:, :1]) + spec.bias_deg * DEGREE
    sigma = np.array([spec.sigma_deg * DEGREE])
    return psi, sigma * rng.standard_normal((len(t_s), 1)), sigma


def _point(motion: Motion, mounting: Mounting, t_s: Array) -> Array:
    """Return the path p_WS_W (n, 3) of a sensor."""
    R_WB, p_WB_W, _ = motion.pose(t_s)
    return p_WB_W + R_WB @ mounting.p_BS_B


READ: dict[type[ReadingStream], Callable[..., tuple[Array, ...]]] = {
    DvlStream: _read_dvl,
    DepthStream: _read_depth,
    GpsStream: _read_gps,
    HeadingStream: _read_heading,
}
