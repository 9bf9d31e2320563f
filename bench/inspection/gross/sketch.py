"""A log on a coarse grid of times: means of the IMU, the level, and every other stream interpolated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.fitting import Mask, Plane
from ..streams.channels import imu_period_ns, seconds

FINEST_S = 0.5
"""Vibration averages out over it, and a vehicle still tilts and turns within a few of them."""
MOST_CELLS = 2000
"""Rows of the grid at most, so that a check takes milliseconds; it is 1.8 s fine in an hour."""
FEWEST_CELLS = 20
"""In ten seconds a vehicle hardly turns, and nothing is compared."""
MOST_POSES = 4000
"""Poses of the truth used: two for each cell of the grid."""
LEVEL_S = 2.0
"""The accelerometers are averaged over this for the level, as in `inertial`."""
FASTER, SLOW_M_S = 4.0, 0.5
"""Of the median speed, and m/s beside it: what is faster is an outlier, or the mark of a row without a reading."""
SILENT_S = 5.0
"""A gap in a stream that is longer is not interpolated: half a minute of way at 1 m/s would be made up."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """A log on a grid of n times; I is the IMU, all else is in B or W.

    Attributes:
        log: the log.
        t_s: (n,) middles of the cells, s from the log's start.
        w_I, f_I: (n, 3) means over each cell, rad/s and m/s².
        up_I: (n, 3) unit vectors, up by the accelerometers averaged over LEVEL_S.
        turned_I: (n, 3) rad, integral of the gyro from the first cell, axis by axis.
    """

    log: Log
    t_s: Array
    w_I: Array
    f_I: Array
    up_I: Array
    turned_I: Array

    @cached_property
    def step_s(self) -> float:
        """Median step of the grid."""
        return float(np.median(np.diff(self.t_s)))

    @cached_property
    def up_B(self) -> Array:  # noqa: N802 - a vector, in our notation
        """(n, 3) up in B axes, with the mounting of the description."""
        return self.up_I @ np.asarray(self.log.rig.imu.R_BS).T

    @cached_property
    def yaw(self) -> Array:
        """(n,) rad: the yaw by the gyro, zero at the first cell."""
        rate = np.einsum("ni,ni->n", self.up_I, self.w_I)
        return np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(self.t_s))])

    def on_grid(self, t_s: Array, values: Array) -> Array:
        """Return values (m,) or (m, k) of a stream at t_s (m,) on the grid."""
        if values.ndim == 1:
            return np.interp(self.t_s, t_s, values)
        return np.stack([np.interp(self.t_s, t_s, column) for column in values.T], axis=1)

    def heard(self, t_s: Array) -> Mask:
        """Return which cells (n,) lie between two readings at t_s (m,) that are no more than SILENT_S apart."""
        after = np.searchsorted(t_s, self.t_s).clip(1, len(t_s) - 1)
        apart = t_s[after] - t_s[after - 1]
        return (apart < max(SILENT_S, 3 * self.step_s)) & (self.t_s >= t_s[0]) & (self.t_s <= t_s[-1])

    @cached_property
    def velocity(self) -> tuple[Array, Mask] | None:
        """v_WB_B (n, 3) m/s by the DVL, unmeasured axes as zero, and where it is heard (n,); None without.

        Rows far faster than usual, and zeros amid way, hold no reading. A DVL of which an axis never changes counts as
        absent.
        """
        dvl = self.log.dvl
        if dvl is None or len(dvl) < 30:
            return None
        known = np.isfinite(dvl.sigma).any(axis=0)
        speed = np.linalg.norm(dvl.z * known, axis=1)
        good = speed < FASTER * np.median(speed) + SLOW_M_S
        moved = np.flatnonzero(speed > 0)
        if len(moved):
            good &= (speed > 0) | (np.interp(np.arange(len(speed)), moved, speed[moved]) < SLOW_M_S)
        stuck = (dvl.z == dvl.z[0]).all(axis=0) & (dvl.z[0] != 0)
        if np.count_nonzero(good) < 30 or (stuck & known).any():
            return None
        t_s = seconds(self.log, dvl.t_ns[good])
        return self.on_grid(t_s, dvl.z[good] * known), self.heard(t_s)

    @cached_property
    def heading(self) -> tuple[Array, Array, Mask] | None:
        """The heading sensor's times (m,) s, its angles (m,) rad, unwrapped, and where it is heard (n,)."""
        heading = self.log.heading
        if heading is None or len(heading) < 30:
            return None
        t_s = seconds(self.log, heading.t_ns)
        return t_s, np.unwrap(heading.psi), self.heard(t_s)

    @cached_property
    def truth_yaw(self) -> tuple[Array, Array, Mask] | None:
        """When (m,) s, the yaw (m,) rad by the truth, and where it is known (n,); None without an attitude."""
        truth = self.log.truth
        if truth is None or len(truth) < 30:
            return None
        every = slice(None, None, max(len(truth) // MOST_POSES, 1))
        R, t_s = truth.R_WB[every], seconds(self.log, truth.t_ns[every])
        known = np.isfinite(R[:, 0, 0])
        if np.count_nonzero(known) < 30:
            return None
        return t_s[known], np.unwrap(np.arctan2(R[known, 1, 0], R[known, 0, 0])), self.heard(t_s[known])

    def level_velocity(self, v_B: Array) -> tuple[Plane, Array]:
        """Return (n,) the velocity in the level frame of yaw zero, forward + i left, and its vertical part (n,)."""
        up = self.up_B
        x = np.array([1.0, 0.0, 0.0]) - up * up[:, :1]
        x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-6)
        y = np.cross(up, x)
        forward, left, climb = (np.einsum("ni,ni->n", axis, v_B) for axis in (x, y, up))
        return forward + 1j * left, climb


def sketch_of(log: Log) -> Sketch | None:
    """Return a log on a coarse grid; None if it has fewer than FEWEST_CELLS."""
    period_s = imu_period_ns(log.imu) * 1e-9
    step_s = max(FINEST_S, log.duration_s / MOST_CELLS)
    size = max(round(step_s / period_s), 1)
    n = len(log.imu.t_ns) // size * size
    if n // size < FEWEST_CELLS:
        return None
    t_s = seconds(log, log.imu.t_ns[:n].reshape(-1, size)[:, [0, -1]]).mean(axis=1) - period_s / 2
    weight = np.full(size, 1 / size)
    w_I, f_I = (weight @ x[:n].reshape(-1, size, 3) for x in (log.imu.w_WI_I, log.imu.f_I))
    up_I = _smooth(f_I, max(round(LEVEL_S / step_s), 1) | 1)
    up_I /= np.maximum(np.linalg.norm(up_I, axis=1, keepdims=True), 1e-9)
    steps = (w_I[1:] + w_I[:-1]) / 2 * np.diff(t_s)[:, None]
    return Sketch(log, t_s, w_I, f_I, up_I, np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))


def _smooth(x: Array, size: int) -> Array:
    """Return the running mean (n, k) over `size` rows, fewer at the ends."""
    summed = np.vstack([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    row = np.arange(len(x))
    first, last = np.maximum(row - size // 2, 0), np.minimum(row - size // 2 + size, len(x))
    return (summed[last] - summed[first]) / (last - first)[:, None]
