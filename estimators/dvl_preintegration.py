"""Preintegrated DVL: the displacement between two keyframes, from DVL velocities turned by the gyro.

    Δp̃_ij = Σ_k ΔR̃_ik v_b,k Δt                                                     [DESIGN, eq. 5]

in the axes of B at keyframe i. The rotation runs at IMU rate; the DVL's velocity is held from one reading to the next
(or runs straight from one to the next), and over what is left, so that the sum ends exactly on keyframe j.

This is the loose variant: the rotation is taken from the gyro at the current bias, and the covariance has the noise of
the DVL and of the gyro, but no correlation with the IMU factor beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..datasets.state import Array, TimeArray
from .so3 import exp, product, transform


@njit(cache=True)
def preintegrate_dvl(
    imu: NDArray[Any],
    start_ns: int,
    t_ns: TimeArray,
    v_WB_B: Array,
    sigma: Array,
    b_g: Array,
    rig: NDArray[Any],
    straight: bool,
) -> tuple[Array, Array]:
    """Sum DVL velocities over a block of IMU samples.

    Args:
        imu: IMU_SAMPLE rows from keyframe i to keyframe j.
        start_ns: time of keyframe i.
        t_ns: (n,) times of the DVL readings, increasing, n ≥ 1; the first also stands for what comes before it.
        v_WB_B: (n, 3) m/s.
        sigma: (n, 3) m/s, independent from reading to reading.
        b_g: (3,) rad/s, gyro bias, in the IMU's axes.
        rig: RIG record of length 1.
        straight: between readings the velocity runs straight from one to the next; otherwise it is held.

    Returns:
        Δp̃_ij (3,) m and its covariance (3, 3) m². A rotation error φ made at time s displaces by
        −[Δp̃(T) − Δp̃(s)]× φ; the noise of reading k by Σ ΔR Δt over the time that it is held.
    """
    g, n = rig[0], len(t_ns)
    capacity = len(imu) + n
    position, duration = np.empty((capacity, 3)), np.empty(capacity)
    weight = np.zeros((n, 3, 3))  # Σ ΔR Δt by reading
    R, dp, k, piece = np.eye(3), np.zeros(3), 0, 0
    now_ns = start_ns
    for row in range(len(imu)):
        w = transform(g.R_BI, imu[row].w_WI_I - b_g)
        while now_ns < imu[row].t_ns:
            while k + 1 < n and t_ns[k + 1] <= now_ns:
                k += 1
            until_ns = imu[row].t_ns
            if k + 1 < n and t_ns[k + 1] < until_ns:
                until_ns = t_ns[k + 1]
            if t_ns[k] > now_ns and t_ns[k] < until_ns:
                until_ns = t_ns[k]
            dt = (until_ns - now_ns) * 1e-9
            R_dt = dt * product(R, exp(0.5 * dt * w))
            share = 0.0
            if straight and k + 1 < n and now_ns >= t_ns[k]:
                share = (0.5 * (now_ns + until_ns) - t_ns[k]) / (t_ns[k + 1] - t_ns[k])
            step = transform(R_dt, (1.0 - share) * v_WB_B[k])
            weight[k] += (1.0 - share) * R_dt
            if share > 0.0:
                step += transform(R_dt, share * v_WB_B[k + 1])
                weight[k + 1] += share * R_dt
            position[piece], duration[piece] = dp + 0.5 * step, dt
            piece += 1
            dp = dp + step
            R = product(R, exp(dt * w))
            now_ns = until_ns

    cov = np.zeros((3, 3))
    for k in range(n):
        for i in range(3):
            for j in range(3):
                for m in range(3):
                    cov[i, j] += weight[k, i, m] * sigma[k, m] ** 2 * weight[k, j, m]
    for m in range(piece):
        u = dp - position[m]
        cov += g.gyro_density**2 * duration[m] * ((u @ u) * np.eye(3) - np.outer(u, u))
    return dp, cov
