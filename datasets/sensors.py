"""The simulated aiding sensors: each reads the exact motion through its mounting, with noise of the stated size."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .log import DepthStream, DvlStream, GpsStream, HeadingStream, ReadingStream
from .motion import Motion
from .quantities import DEGREE
from .random_streams import random_stream
from .rig import Mounting, Rig
from .scenario import DepthSpec, DvlSpec, GpsSpec, HeadingSpec, Scenario, SensorSpec
from .state import Array, TimeArray

Kind = TypeVar("Kind", bound=ReadingStream)

ANTENNA_AWASH_M = -0.05
"""The antenna hears GPS while it is higher than this; a little water over it does not yet drown the signal."""


def ticks(rate_hz: float, duration_s: float) -> TimeArray:
    """Return k / rate_hz for k ≥ 1 up to duration_s, in ns, each rounded by itself."""
    count = math.floor(duration_s * rate_hz * (1 + 1e-12))
    return np.rint(np.arange(1, count + 1) * (1e9 / rate_hz)).astype(np.int64)


def read(kind: type[Kind], scenario: Scenario, seed: int, motion: Motion) -> Kind | None:
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


def late(scenario: Scenario) -> list[str]:
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
