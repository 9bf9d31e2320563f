"""The belief a log starts from, out of its own first seconds: what a navigator knows before casting off.

Level comes from the accelerometers, heading from the heading sensor, position from GPS or from the definition of W's
origin, velocity from the DVL; biases are zero with their turn-on sigmas. The belief stands at the end of the window
(at the IMU sample there), and epochs begin after it, so no reading is used twice.

W's origin is the vehicle's place at the start of the log (for geodetic logs: its first fix at or after the start). So
without GPS the position at the end of the window is what the DVL says was travelled since the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .log import AttitudeStream, Log, ReadingStream
from .state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array, Belief, NavState, TimeArray

MOTION_M_S2 = 0.1
"""Sigma of the vehicle's own mean acceleration over the window, which the level mistakes for tilt."""
HEADING_FLOOR_RAD = np.radians(1.0)
"""No heading sensor is believed beyond this: its errors do not average out over a window."""
UNKNOWN_HEADING_RAD = np.pi / np.sqrt(3)
UNKNOWN_SPEED_M_S = 1.5
ORIGIN_SIGMA_M = 0.5
"""How well the vehicle's place at the start of the log is W's origin."""
UNKNOWN_DEPTH_M = 5.0


@dataclass(frozen=True, eq=False)
class Initialisation:
    """A belief, and in sentences how each part of it was got."""

    belief: Belief
    notes: tuple[str, ...]


def initialise(log: Log, window_s: float = 2.0, max_wait_s: float = 10.0) -> Initialisation:
    """Make the belief at the end of the log's first seconds.

    Args:
        log: its truth and its prior are not looked at.
        window_s: how long to listen.
        max_wait_s: the window grows up to this until the heading sensor and the DVL have been heard.
    """
    start_ns = int(log.imu.t_ns[0]) - log.imu.period_ns
    end_ns = _end(log, start_ns, window_s, max_wait_s)
    noise, rig = log.rig.imu_noise, log.rig
    R_BI = np.asarray(rig.imu.R_BS)
    inside = log.imu.t_ns <= end_ns
    R_EB, w_WB_B = _turned(log, inside)
    v_B, v_sigma, said_of_velocity = _velocity(log, start_ns, end_ns)
    f_each_B = log.imu.f_I[inside] @ R_BI.T - np.cross(w_WB_B, v_B)  # less what a turning vehicle feels
    f_B = np.einsum("nij,nj->i", R_EB, f_each_B) / len(R_EB)
    elapsed_s = (end_ns - start_ns) * 1e-9
    notes = [f"prior at {elapsed_s:.2f} s; level from {len(R_EB)} accelerometer samples, turned to the end by the gyro"]

    # f_B = R_WB.T (0, 0, g) when the vehicle does not accelerate
    roll, pitch = np.arctan2(f_B[1], f_B[2]), np.arctan2(-f_B[0], np.hypot(f_B[1], f_B[2]))
    R_level = Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()
    up_B = R_level[2]
    yaw, yaw_sigma, said = _yaw(log, start_ns, end_ns, R_level, float(up_B @ w_WB_B.mean(axis=0)))
    notes.append(said)
    R_WB = Rotation.from_euler("Z", yaw).as_matrix() @ R_level

    notes.append(said_of_velocity)
    v_WB_W = R_WB @ v_B

    # errors by independent causes: accelerometer bias (3), motion (3), yaw (1), velocity (3), place (3), gyro bias (3)
    f_norm = float(np.linalg.norm(f_B)) or 1.0
    tilt = _skew(f_B) / f_norm**2  # theta × f_B = bias + motion
    h_W = R_WB @ np.asarray(rig.heading.R_BS)[:, 0]  # a tilt must not turn it: its azimuth was measured
    level_W = np.array([h_W[0], h_W[1], 0.0])
    tilt = tilt + np.outer(up_B, level_W @ R_WB @ tilt) * h_W[2] / max(float(level_W @ level_W), 1e-3)
    A, sigma = np.zeros((DIM, 16)), np.zeros(16)
    A[THETA, 0:3], A[THETA, 3:6], A[THETA, 6] = tilt @ R_EB.mean(axis=0) @ R_BI, tilt, up_B
    A[ACCEL_BIAS, 0:3] = np.eye(3)
    A[VELOCITY] = -R_WB @ _skew(v_B) @ A[THETA]
    A[VELOCITY, 7:10] = R_WB
    sigma[0:3], sigma[3:6], sigma[6], sigma[7:10] = noise.accel_bias_sigma, MOTION_M_S2, yaw_sigma, v_sigma
    A[GYRO_BIAS, 13:16], sigma[13:16] = np.eye(3), noise.gyro_bias_sigma

    travelled_W = R_WB @ R_EB.mean(axis=0) @ v_B * elapsed_s
    travelled_sigma = float(np.max(v_sigma)) * elapsed_s
    p_WB_W, p_sigma, said = _position(log, end_ns, R_WB, R_EB, v_WB_W, travelled_W, travelled_sigma)
    notes += said
    A[POSITION, 10:13], sigma[10:13] = np.eye(3), p_sigma
    P = (A * sigma**2) @ A.T
    floor = np.repeat([1e-10, 0.0, 0.0, 1e-12, 1e-14], 3)  # positive definite even for a perfect IMU
    P = (P + P.T) / 2 + np.diag(floor)
    state = NavState(R_WB, p_WB_W, v_WB_W, np.zeros(3), np.zeros(3))
    return Initialisation(Belief(end_ns, state, P), tuple(notes))


def _end(log: Log, start_ns: int, window_s: float, max_wait_s: float) -> int:
    """Return the IMU sample's time at which the window ends."""
    end_ns = start_ns + round(window_s * 1e9)
    latest_ns = start_ns + round(max(window_s, max_wait_s) * 1e9)
    for stream in (log.heading, log.dvl):
        rows = _heard(stream, start_ns, latest_ns)
        if stream is not None and len(rows):
            end_ns = max(end_ns, int(stream.received_ns[rows].min()))
    at = int(np.searchsorted(log.imu.t_ns, end_ns))  # the sample that covers the end
    return int(log.imu.t_ns[min(at, max(len(log.imu.t_ns) - 2, 0))])


def _heard(stream: ReadingStream | None, start_ns: int, end_ns: int) -> TimeArray:
    """Return the rows of a stream that became known inside the window."""
    if stream is None:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero((stream.t_ns > start_ns) & (stream.received_ns <= end_ns))


def _yaw(log: Log, start_ns: int, end_ns: int, R_level: Array, yaw_rate: float) -> tuple[float, float, str]:
    """Return yaw of B and its sigma (rad) at the end of the window."""
    rows = _heard(log.heading, start_ns, end_ns)
    if log.heading is None or not len(rows):
        return 0.0, UNKNOWN_HEADING_RAD, "no heading sensor heard: heading unknown"
    z = log.heading.z[rows]
    if isinstance(log.heading, AttitudeStream):
        psi, sigma = np.arctan2(z[:, 3], z[:, 0]), np.nanmin(log.heading.sigma[rows], axis=1)
    else:
        psi, sigma = z[:, 0], log.heading.sigma[rows, 0]
    age_s = (end_ns - log.heading.t_ns[rows]) * 1e-9
    x_H_level = R_level @ np.asarray(log.rig.heading.R_BS)[:, 0]
    turned = psi + yaw_rate * age_s - np.arctan2(x_H_level[1], x_H_level[0])
    yaw = float(np.arctan2(np.sin(turned).mean(), np.cos(turned).mean()))
    drift = log.rig.imu_noise.gyro_bias_sigma * age_s.mean()
    total = np.sqrt(np.mean(sigma**2) + HEADING_FLOOR_RAD**2 + drift**2)
    said = f"heading from {len(rows)} readings, sigma {np.degrees(total):.1f} deg (not averaged down)"
    return yaw, min(float(total), UNKNOWN_HEADING_RAD), said


def _turned(log: Log, inside: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return R_EB (n, 3, 3), from B at each sample to B at the end E of the window, by the gyro; and w_WB_B (n, 3)."""
    w_WB_B = log.imu.w_WI_I[inside] @ np.asarray(log.rig.imu.R_BS).T
    t_ns = log.imu.t_ns[inside]
    dt_s = np.diff(t_ns, prepend=t_ns[0] - log.imu.period_ns) * 1e-9
    steps = Rotation.from_rotvec(w_WB_B * dt_s[:, None]).as_matrix().reshape(-1, 3, 3)
    R_EB = np.empty_like(steps)
    R_EB[-1] = np.eye(3)
    for k in range(len(steps) - 1, 0, -1):
        R_EB[k - 1] = R_EB[k] @ steps[k].T
    return R_EB, w_WB_B


def _velocity(log: Log, start_ns: int, end_ns: int) -> tuple[Array, Array, str]:
    """Return v_WB_B and its sigma (3,) at the end of the window: the median of the DVL's last three readings there.

    They are not turned to the end by the gyro: through a turn a vehicle keeps its velocity in B, not in W.
    """
    rows = _heard(log.dvl, start_ns, end_ns)[-3:]
    if log.dvl is None or not len(rows):
        return np.zeros(3), np.full(3, UNKNOWN_SPEED_M_S), "no DVL heard: velocity unknown, taken as zero"
    v_WB_B = np.median(log.dvl.z[rows], axis=0)
    age_s = (end_ns - log.dvl.t_ns[rows]).mean() * 1e-9
    sigma = np.hypot(np.median(log.dvl.sigma[rows], axis=0), 2 * MOTION_M_S2 * age_s)
    return v_WB_B, np.minimum(sigma, UNKNOWN_SPEED_M_S), f"velocity from {len(rows)} DVL readings"


def _position(
    log: Log, end_ns: int, R_WB: Array, R_EB: Array, v_WB_W: Array, travelled_W: Array, travelled_sigma: float
) -> tuple[Array, Array, list[str]]:
    """Return p_WB_W and its sigma (3,) at the end of the window."""
    start_ns = int(log.imu.t_ns[0]) - log.imu.period_ns
    p_WB_W, sigma = travelled_W.copy(), np.full(3, np.hypot(ORIGIN_SIGMA_M, travelled_sigma))
    notes = ["position zero at the start by definition of W, and what was travelled since"]
    height_known = False
    rows = _heard(log.gps, start_ns, end_ns)
    if log.gps is not None and len(rows):
        row = rows[-1]
        known = np.isfinite(log.gps.sigma[row])
        age_s = (end_ns - int(log.gps.t_ns[row])) * 1e-9
        sample = min(int(np.searchsorted(log.imu.t_ns, log.gps.t_ns[row])), len(R_EB) - 1)
        fix = log.gps.z[row] - R_WB @ R_EB[sample] @ log.rig.gps.p_BS_B + v_WB_W * age_s
        p_WB_W = np.where(known, fix, p_WB_W)
        sigma = np.where(known, np.hypot(log.gps.sigma[row], travelled_sigma), sigma)
        height_known = bool(known[2])
        notes = ["position from the last fix in the window"]
    rows = _heard(log.depth, start_ns, end_ns)
    if log.depth is not None and len(rows):
        p_WB_W[2] = np.median(log.depth.z[rows, 0]) - (R_WB @ log.rig.depth.p_BS_B)[2]
        sigma[2] = np.hypot(np.median(log.depth.sigma[rows, 0]), abs(travelled_W[2]) + 0.02)
        notes.append(f"height from {len(rows)} depth readings")
    elif not height_known:
        p_WB_W[2], sigma[2] = 0.0, UNKNOWN_DEPTH_M
        notes.append("no depth sensor heard: height unknown")
    return p_WB_W, sigma, notes


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
