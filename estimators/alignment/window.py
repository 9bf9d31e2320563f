"""The IMU samples of an interval, integrated backwards from its end: rotation, and change of velocity.

E is B at the end of the interval. With φ(t) the rotation error that a gyro bias makes between t and the end, and γ
gravity in E, the rotation at t, and the velocity u of the IMU in E axes, are to first order in the biases

    R_EB(t) = Exp(φ) R̃_EB(t)        φ = Φ(t) b_g        Φ(t) = ∫_t R̃_EB R_BI dt
    u(t) = u − ∫_t (R_EB (f_B − R_BI b_a) + γ) dt = u − push + Φ b_a − push_bg b_g − γ · left

At rest the rotation is zero by definition, so the gyro and its bias have no effect on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...datasets.log import Log, ReadingStream
from ...datasets.state import Array, TimeArray
from ..physics.so3 import skew


@dataclass(frozen=True, eq=False)
class Window:
    """The times in an interval: its start, and the end of each IMU sample, split at the times of aiding readings.

    Attributes:
        t_ns: (n,) times.
        left_s: (n,) s, from each time to the end.
        R_EB: (n, 3, 3), from B at each time to B at the end, by the gyro.
        w_WB_B: (n, 3) rad/s, of the sample that ends at each time.
        held: Φ (n, 3, 3) s.
        turn: the derivative (n, 3, 3) s of φ by b_g: Φ, or zero at rest.
        push: (n, 3) m/s, ∫ R̃_EB f_B dt from each time to the end.
        push_bg: (n, 3, 3) m, its derivative by b_g; that by b_a is −Φ.
    """

    t_ns: TimeArray
    left_s: Array
    R_EB: Array
    w_WB_B: Array
    held: Array
    turn: Array
    push: Array
    push_bg: Array

    @classmethod
    def of(cls, log: Log, start_ns: int, end_ns: int, *, at_rest: bool = False) -> Window:
        """Return the interval from start_ns to end_ns."""
        imu, R_BI = log.imu, np.asarray(log.rig.imu.R_BS)
        moments = [imu.t_ns, *(stream.t_ns for stream in log.streams.values()), np.array([start_ns, end_ns])]
        t_ns = np.unique(np.concatenate(moments))
        t_ns = t_ns[(t_ns >= start_ns) & (t_ns <= end_ns)]
        sample = np.searchsorted(imu.t_ns, t_ns[1:]).clip(0, len(imu.t_ns) - 1)  # the one that covers each interval
        dt_s = np.diff(t_ns) * 1e-9
        w_B, f_B = imu.w_WI_I[sample] @ R_BI.T * (not at_rest), imu.f_I[sample] @ R_BI.T

        back = Rotation.from_rotvec(-w_B * dt_s[:, None]).as_matrix()
        R_EB = np.empty((len(t_ns), 3, 3))
        R_EB[-1] = np.eye(3)
        for k in range(len(back) - 1, -1, -1):
            R_EB[k] = R_EB[k + 1] @ back[k]
        R_middle = R_EB[1:] @ Rotation.from_rotvec(-0.5 * w_B * dt_s[:, None]).as_matrix()

        held = to_the_end(R_middle @ R_BI * dt_s[:, None, None])
        turn = held * (not at_rest)
        pushes = np.einsum("nij,nj->ni", R_middle, f_B) * dt_s[:, None]
        push_bg = to_the_end(-skew(pushes) @ (0.5 * (turn[1:] + turn[:-1])))
        left_s = (end_ns - t_ns) * 1e-9
        return cls(t_ns, left_s, R_EB, np.concatenate([w_B[:1], w_B]), held, turn, to_the_end(pushes), push_bg)

    @property
    def length_s(self) -> float:
        """From the start to the end, s."""
        return float(self.left_s[0])

    def heard(self, stream: ReadingStream | None) -> TimeArray:
        """Return the rows of a stream that were taken after the start and received by the end."""
        return heard(stream, int(self.t_ns[0]), int(self.t_ns[-1]))

    def moments(self, t_ns: TimeArray) -> TimeArray:
        """Return the indices of times in t_ns."""
        return np.searchsorted(self.t_ns, t_ns)

    def way(self, v_WB_B: Array) -> tuple[Array, Array]:
        """Return the position of B relative to its last one, (n, 3) m in E axes, and its derivative by b_g, (n, 3, 3).

        Args:
            v_WB_B: (n, 3) m/s at the times.
        """
        dt_s = np.diff(self.t_ns)[:, None] * 1e-9
        v_E = np.einsum("nij,nj->ni", self.R_EB, v_WB_B)
        steps = 0.5 * (v_E[1:] + v_E[:-1]) * dt_s
        return -to_the_end(steps), to_the_end(skew(steps) @ (0.5 * (self.turn[1:] + self.turn[:-1])))


def heard(stream: ReadingStream | None, start_ns: int, end_ns: int) -> TimeArray:
    """Return the rows of a stream that were taken after start_ns and received by end_ns, and measure anything."""
    if stream is None:
        return np.zeros(0, dtype=np.int64)
    inside = (stream.t_ns > start_ns) & (stream.received_ns <= end_ns)
    return np.flatnonzero(inside & np.isfinite(stream.sigma).any(axis=1))


def to_the_end(steps: Array) -> Array:
    """Return the sums of steps (n − 1, ...) from each of n times to the last, (n, ...)."""
    sums = np.zeros((len(steps) + 1, *steps.shape[1:]))
    sums[:-1] = np.cumsum(steps[::-1], axis=0)[::-1]
    return sums
