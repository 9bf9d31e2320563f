"""Detection of rest at the start of a log: the IMU is quiet, and other sensors show no velocity and no rotation.

A gyro cannot distinguish a slow steady turn from its bias, nor an accelerometer steady motion from rest.
(Ictineu hovers with a DVL's zero velocity and a gyro's near zero rate, while its compass turns by 0.6 °/s: the gyro's
bias happens to cancel it.) So a quiet IMU is not enough: another sensor must show zero velocity, and another a
constant heading.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ...datasets.log import AttitudeStream, Log
from ...datasets.rig import EARTH_RATE_RAD_S
from ...datasets.state import Array, TimeArray
from .window import heard

SCATTER = 1.7
"""Samples may scatter by this much more than the rig's noise; their means over BLOCK_S by SCATTER_OF_MEANS more."""
SCATTER_OF_MEANS = 3.0
"""The same for means over BLOCK_S, of which low-frequency noise is a larger part."""
BLOCK_S = 0.5
"""s: vibration averages out over it."""
REST_M_S = 0.01
"""At rest a vehicle sways by this much, and a sensor's mean is off by this much more than its noise explains."""
REST_RAD_S = 1e-3
"""The same in rotation: 0.06 °/s."""
VOUCHES_M_S = 0.2
"""A velocity known no better than this cannot distinguish rest from motion."""
SIGMAS = 3.5
"""Normal noise exceeds it once in 2,000."""


def rest_s(log: Log, start_ns: int, longest_s: float, step_s: float = 1.0) -> float:
    """Return for how long the log is at rest from start_ns on, s, at most longest_s; 0.0 if it is not.

    The first step_s in which rest is no longer found, and the one before it, in which it may have ended, do not count.
    """
    ends_s = np.arange(2 * step_s, longest_s + 0.5 * step_s, step_s)
    for end_s in ends_s:
        if not is_at_rest(log, start_ns, start_ns + round(end_s * 1e9)):
            return max(float(end_s) - 2 * step_s, 0.0)
    return longest_s


def is_at_rest(log: Log, start_ns: int, end_ns: int) -> bool:
    """Return whether the vehicle rests from start_ns to end_ns, as sensors of velocity and of heading confirm."""
    velocity = mean_velocity(log, start_ns, end_ns)
    if velocity is None or not is_quiet(log, start_ns, end_ns):
        return False
    v, sigma = velocity
    if (np.abs(v) > REST_M_S + SIGMAS * sigma).any() or sigma.max() > VOUCHES_M_S:
        return False
    turn = heading_rate(log, start_ns, end_ns)
    if turn is None:
        return bool(sigma.max() <= REST_M_S)
    return abs(turn[0]) <= REST_RAD_S + SIGMAS * turn[1]


def is_quiet(log: Log, start_ns: int, end_ns: int) -> bool:
    """Return whether the IMU shows only its noise, and the gyro at most its turn-on bias."""
    imu, noise = log.imu, log.rig.imu_noise
    inside = (imu.t_ns > start_ns) & (imu.t_ns <= end_ns)
    n = int(inside.sum())
    if not n:
        return False
    dt_s = float(np.median(imu.sampling_ns[inside])) * 1e-9
    size = max(round(BLOCK_S / dt_s), 2)
    if n < 2 * size:
        return False
    for samples, density in ((imu.w_WI_I[inside], noise.gyro_density), (imu.f_I[inside], noise.accel_density)):
        sigma = density / np.sqrt(dt_s)
        means = samples[: n // size * size].reshape(-1, size, 3).mean(axis=1)
        if (samples.std(axis=0, ddof=1) > SCATTER * sigma).any():
            return False
        if (means.std(axis=0, ddof=1) > SCATTER_OF_MEANS * sigma / np.sqrt(size)).any():
            return False
    rate, elapsed_s = imu.w_WI_I[inside].mean(axis=0), n * dt_s
    sigma = np.sqrt(noise.gyro_bias_sigma**2 + EARTH_RATE_RAD_S**2 + noise.gyro_density**2 / elapsed_s)
    return bool((np.abs(rate) <= SIGMAS * sigma).all())


def mean_velocity(log: Log, start_ns: int, end_ns: int) -> tuple[Array, Array] | None:
    """Return the mean velocity and its sigma (m/s) of every axis that is measured, by the DVL, else by GPS fixes."""
    if log.dvl is not None and len(rows := heard(log.dvl, start_ns, end_ns)):
        z, weight = log.dvl.z[rows], 1 / log.dvl.sigma[rows] ** 2
        total = weight.sum(axis=0)
        measured = total > 0
        if measured.any():
            return (weight * z).sum(axis=0)[measured] / total[measured], 1 / np.sqrt(total[measured])
    if log.gps is not None and len(rows := heard(log.gps, start_ns, end_ns)) > 2:
        p, sigma = log.gps.z[rows, :2], log.gps.sigma[rows, :2].max()
        slope, spread_s = _slope(log.gps.t_ns[rows], p)
        return slope, np.full(2, sigma / spread_s)
    return None


def heading_rate(log: Log, start_ns: int, end_ns: int) -> tuple[float, float] | None:
    """Return the rate of the heading sensor and its sigma (rad/s); None if it has too few readings.

    Of a full attitude it is the rate about any axis, which is not negative. The scatter about a steady turn gives the
    sigma, since the stated sigma may include slowly varying errors.
    """
    rows = heard(log.heading, start_ns, end_ns)
    if log.heading is None or len(rows) < 4:
        return None
    if isinstance(log.heading, AttitudeStream):
        R_WH = log.heading.z[rows].reshape(-1, 3, 3)
        angles = Rotation.from_matrix(R_WH[0].T @ R_WH).as_rotvec()
    else:
        angles = np.unwrap(log.heading.psi[rows])[:, None]
    rate, spread_s = _slope(log.heading.t_ns[rows], angles)
    t_s = (log.heading.t_ns[rows] - log.heading.t_ns[rows].mean()) * 1e-9
    left = angles - angles.mean(axis=0) - np.outer(t_s - t_s.mean(), rate)
    scatter = np.sqrt(np.einsum("nk,nk->k", left, left).max() / (len(rows) - 2))
    return float(rate[0]) if len(rate) == 1 else float(np.linalg.norm(rate)), float(scatter / spread_s)


def _slope(t_ns: TimeArray, values: Array) -> tuple[Array, float]:
    """Return the slopes (k,) of values (n, k) over time, per s, and √Σ (t − mean)², s."""
    t_s = (t_ns - t_ns[0]) * 1e-9
    t_s = t_s - t_s.mean()
    spread = float(t_s @ t_s)
    return t_s @ values / spread, float(np.sqrt(spread))
