"""The motion by the IMU alone: level from the accelerometers, rotation from the gyro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from ....datasets.log import Log
from ....datasets.state import Array
from ..streams.channels import seconds
from ..streams.norms import onto_z

LEVEL_S = 2.0
"""The accelerometers are averaged over this. In turns the vehicle's own acceleration tilts the level by a degree or
two, which changes the vertical rate only in second order."""
UPSIDE_DOWN = np.radians(30.0)
"""rad: a mean up that is further than this from B's z is a wrong mounting, and not the vehicle's trim."""

ALONG_AN_AXIS = np.radians(15.0)
"""rad: a mean up that is nearer to an axis of B than this is taken for that axis; a vehicle's trim is less."""


@dataclass(frozen=True, eq=False)
class Inertial:
    """The IMU's samples in L, which is B unless the mounting is so wrong that B's z is not even roughly up.

    Attributes:
        t_s: (n,) ends of the intervals, from the log's start.
        dt_s: (n,) their lengths.
        w_L, f_L: (n, 3) rad/s and m/s².
        up_L: (n, 3) unit vector.
        R_LB: (3, 3) the shortest rotation that takes the axis that is up to z, if one is needed.
        up_B: (3,) the mean up, with the mounting of the description.
        flipped: whether up is up if the IMU's axes are read as forward-right-down instead of forward-left-up.
    """

    t_s: Array
    dt_s: Array
    w_L: Array
    f_L: Array
    up_L: Array
    R_LB: Array
    up_B: Array
    flipped: bool

    @property
    def period_s(self) -> float:
        """Median interval."""
        return float(np.median(self.dt_s))

    def turned(self, h_L: Array | None = None) -> Array:
        """Return the azimuth (n,) rad of an axis h of the body since the start.

        Its rate is (u·w − (u·h)(h·w)) / (1 − (u·h)²), with u up and w the angular rate.
        """
        h = np.array([1.0, 0.0, 0.0]) if h_L is None else h_L
        tilt = self.up_L @ h
        rate = (np.einsum("ni,ni->n", self.up_L, self.w_L) - tilt * (self.w_L @ h)) / np.maximum(1 - tilt**2, 0.1)
        return np.cumsum(rate * self.dt_s, dtype=np.float64)

    def level(self, t_s: Array) -> Array:
        """Return R (k, 3, 3) from L to the level frame of yaw zero, at t_s (k,); without a specific force z is up."""
        up = np.stack([np.interp(t_s, self.t_s, self.up_L[:, i]) for i in range(3)], axis=1)
        size = np.linalg.norm(up, axis=1, keepdims=True)
        up = np.where(size > 1e-6, up / np.maximum(size, 1e-6), np.array([0.0, 0.0, 1.0]))
        x = np.array([1.0, 0.0, 0.0]) - up * up[:, :1]
        x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-6)
        return np.stack([x, np.cross(up, x), up], axis=1)


def inertial_of(log: Log) -> Inertial:
    """Return the IMU's samples in L, with the level."""
    R_BI = np.asarray(log.rig.imu.R_BS)
    t_s = seconds(log, log.imu.t_ns)
    period_s = log.imu.period_ns * 1e-9
    dt_s = np.diff(t_s, prepend=t_s[0] - period_s)
    f_B, w_B = log.imu.f_I @ R_BI.T, log.imu.w_WI_I @ R_BI.T
    size = max(round(LEVEL_S / period_s), 1)
    up_each = uniform_filter1d(f_B, size, axis=0, mode="nearest")
    up_each /= np.maximum(np.linalg.norm(up_each, axis=1, keepdims=True), 1e-9)
    up_B = up_each.mean(axis=0)
    up_B /= max(float(np.linalg.norm(up_B)), 1e-9)
    R_LB, flipped = np.eye(3), False
    if up_B[2] < np.cos(UPSIDE_DOWN):
        other_axes = R_BI @ np.diag([1.0, -1.0, -1.0]) @ R_BI.T
        flipped = bool(other_axes[2] @ up_B > np.cos(ALONG_AN_AXIS))
        R_LB = other_axes if flipped else onto_z(_nearest_axis(up_B))
    return Inertial(t_s, dt_s, w_B @ R_LB.T, f_B @ R_LB.T, up_each @ R_LB.T, R_LB, up_B, flipped)


def cross(a: Array, b: Array) -> Array:
    """a × b, of (n, 3) or (3,) each."""
    return np.asarray(np.cross(a, b), dtype=np.float64)


def headings(log: Log) -> tuple[Array, Array]:
    """Return times (n,) s, and the azimuth (n,) rad of the heading sensor's x axis, unwrapped."""
    assert log.heading is not None
    return seconds(log, log.heading.t_ns), np.unwrap(log.heading.psi)


def yaw_by_heading(log: Log, imu: Inertial) -> tuple[Array, Array]:
    """Return times (n,) s, and the yaw (n,) rad of L by the heading sensor, unwrapped."""
    t_s, psi = headings(log)
    h = np.einsum("nij,j->ni", imu.level(t_s), np.asarray(log.rig.heading.R_BS)[:, 0])
    return t_s, psi - np.unwrap(np.arctan2(h[:, 1], h[:, 0]))


def _nearest_axis(up: Array) -> Array:
    """Return the axis nearest to `up`, or `up` itself if it is far from every axis."""
    best = int(np.argmax(np.abs(up)))
    axis = np.sign(up[best]) * np.eye(3)[best]
    return axis if axis @ up > np.cos(ALONG_AN_AXIS) else up
