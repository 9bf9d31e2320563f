"""The simulated aiding sensors: each reads the exact motion through its mounting, with noise of the simulated size."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..log import DepthStream, DvlStream, GpsStream, HeadingStream, ReadingStream
from ..quantities import DEGREE
from ..rig import Mounting
from ..state import Array, TimeArray
from .faults import arrives, mar, repeated
from .janus import read_dvl
from .motion import Motion
from .random_streams import random_stream
from .scenario import Scenario
from .sea import Sea
from .specs import DepthSpec, GpsSpec, HeadingSpec, SensorSpec, as_told

Kind = TypeVar("Kind", bound=ReadingStream)

ANTENNA_AWASH_M = -0.05
"""GPS is received while the antenna is higher than this over the water, m: centimetres of water let it pass."""
WATCH_S = 0.1
"""Step at which submersions of the antenna are sampled, s; a tenth of GPS's usual period."""


def ticks(rate_hz: float, duration_s: float) -> TimeArray:
    """Return k / rate_hz for k ≥ 1 up to duration_s, in ns, each rounded by itself."""
    count = math.floor(duration_s * rate_hz * (1 + 1e-12))
    return np.rint(np.arange(1, count + 1) * (1e9 / rate_hz)).astype(np.int64)


def read(kind: type[Kind], scenario: Scenario, seed: int, motion: Motion) -> Kind | None:
    """Return one sensor's readings, or None where it is not aboard.

    Noise is drawn for every tick, whether or not it gives a reading.
    """
    spec: SensorSpec | None = getattr(scenario, kind.name)
    if spec is None:
        return None
    sensor, faults = kind.name, spec.faults
    rng = partial(random_stream, scenario.mission, seed=seed)
    t_ns = ticks(spec.rate_hz, scenario.duration_s)
    true_s = t_ns * 1e-9 - faults.clock_offset_s
    z, error, sigma = READ[kind](scenario, spec, scenario.mountings[sensor], motion, true_s, seed)
    z = mar(z + scenario.noise_scale * error, faults, rng(f"{sensor}_outliers"))
    heard = np.isfinite(z).all(axis=1) & arrives(t_ns, faults, rng(f"{sensor}_dropouts"))
    rows = repeated(heard, faults, rng(f"{sensor}_repeats"))
    t_ns, z = scenario.start_ns + t_ns[heard], z[rows]
    if kind is HeadingStream:
        z = np.arctan2(np.sin(z), np.cos(z))
    return kind(
        t_ns, t_ns + _delays(spec, heard, rng(f"{sensor}_disorder")), z, np.broadcast_to(sigma, error.shape)[rows]
    )


def _delays(spec: SensorSpec, heard: NDArray[np.bool_], rng: np.random.Generator) -> TimeArray:
    """Return how long each reading that is heard is on its way, ns: delay_s, and uniformly up to disorder_s more.

    It is counted from the stamp: a clock that is ahead makes the way look shorter, down to none.
    """
    more_s = spec.disorder_s * rng.random(len(heard))
    way_s = np.maximum(spec.delay_s + more_s[heard] - spec.faults.clock_offset_s, 0.0)
    return np.rint(way_s * 1e9).astype(np.int64)


# Each reader returns what the sensor would say without noise (n, k), NaN where it hears nothing, its error (n, k), and
# the sigma that it tells, (k,) or (n, k).


def _read_depth(
    scenario: Scenario, spec: DepthSpec, depth: Mounting, motion: Motion, t_s: Array, seed: int
) -> tuple[Array, Array, Array]:
    p_WP_W, sea = _point(motion, depth, t_s), Sea.of(scenario, seed)
    z_m, told = p_WP_W[:, 2], np.array([as_told(spec).sigma_m])
    if sea is not None:
        z_m = z_m - sea.rise_m(t_s, p_WP_W)
    error = spec.sigma_m * random_stream(scenario.mission, "depth", seed).standard_normal((len(t_s), 1))
    if sea is not None and scenario.waves is not None and scenario.waves.told and spec.told.sigma_m is None:
        told = np.hypot(spec.sigma_m, sea.swell_sigma_m(z_m, 1 / spec.rate_hz))[:, None]
    z_m = spec.faults.scale * z_m
    if sea is not None and scenario.tide is not None and scenario.tide.told:
        z_m = z_m + sea.tide_m(t_s)
    return z_m[:, None], error, told


def _read_gps(
    scenario: Scenario, spec: GpsSpec, gps: Mounting, motion: Motion, t_s: Array, seed: int
) -> tuple[Array, Array, Array]:
    p_WG_W = _point(motion, gps, t_s)
    heard = _afloat(scenario, gps, motion, t_s, seed)
    if spec.reacquisition_s:
        watch_s = np.arange(*scenario.reach_s, WATCH_S)
        awash_s = np.concatenate([[-np.inf], watch_s[~_afloat(scenario, gps, motion, watch_s, seed)]])
        heard &= t_s - awash_s[np.searchsorted(awash_s, t_s, side="right") - 1] >= spec.reacquisition_s
    sigma, told = (
        np.array([each.horizontal_sigma_m, each.horizontal_sigma_m, each.vertical_sigma_m])
        for each in (spec, as_told(spec))
    )
    error = sigma * random_stream(scenario.mission, "gps", seed).standard_normal((len(t_s), 3))
    return np.where(heard[:, None], p_WG_W, np.nan), error, told


def _afloat(scenario: Scenario, gps: Mounting, motion: Motion, t_s: Array, seed: int) -> NDArray[np.bool_]:
    """Return when (n,) the antenna is out of the water."""
    p_WG_W, sea = _point(motion, gps, t_s), Sea.of(scenario, seed)
    above_m = p_WG_W[:, 2] if sea is None else p_WG_W[:, 2] - sea.rise_m(t_s, p_WG_W * [1, 1, 0])
    return above_m > ANTENNA_AWASH_M


def _read_heading(
    scenario: Scenario, spec: HeadingSpec, heading: Mounting, motion: Motion, t_s: Array, seed: int
) -> tuple[Array, Array, Array]:
    (R_WB, _, _), faults = motion.pose(t_s), spec.faults
    x_H_W = R_WB @ heading.R_BS[:, 0]
    psi = np.arctan2(x_H_W[:, 1:2], x_H_W[:, :1])
    if faults.soft_iron_deg:
        psi += faults.soft_iron_deg * DEGREE * np.sin(2 * (psi - faults.soft_iron_axis_deg * DEGREE))
    psi += faults.bias_deg * DEGREE
    error = spec.sigma_deg * DEGREE * random_stream(scenario.mission, "heading", seed).standard_normal((len(t_s), 1))
    return psi, error, np.array([as_told(spec).sigma_deg * DEGREE])


def _point(motion: Motion, mounting: Mounting, t_s: Array) -> Array:
    """Return the path p_WS_W (n, 3) of a sensor."""
    R_WB, p_WB_W, _ = motion.pose(t_s)
    return p_WB_W + R_WB @ mounting.p_BS_B


READ: dict[type[ReadingStream], Callable[..., tuple[Array, Array, Array]]] = {
    DvlStream: read_dvl,
    DepthStream: _read_depth,
    GpsStream: _read_gps,
    HeadingStream: _read_heading,
}
