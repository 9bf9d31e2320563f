"""Preintegrated DVL: the displacement between two keyframes, from DVL velocities turned by the gyro.

    Δp̃_ij = Σ_k ΔR̃_ik v_b,k Δt                                                     [DESIGN, eq. 5]

in the axes of B at keyframe i. The rotation runs at IMU rate; the DVL's velocity is held from one reading to the next
(or runs straight from one to the next), and over what is left, so that the sum ends exactly on keyframe j.

A rotation error φ (B_i axes) that the gyro makes at time s turns all that comes later, and displaces by −[u]× φ with
u = Δp̃(T) − Δp̃(s). So the errors of Δp̃ and of ΔR̃ go together, and the IMU factor beside knows of the latter:

- loose: Δp̃ at the gyro bias of the moment, with its whole covariance, as if it were independent of the IMU factor. What
  the bias is off by is in no covariance.
- tight: the density of Δp̃ given the rotation between the two keyframes. With the IMU factor's rotation, which is the
  same gyro's, it makes the joint density of the two. For gyro noise of variance q at each sample

      r = r_p + ū × r_R        C = C_dvl + Σ q [u − ū]× [u − ū]×ᵀ        ū = Σ q u / Σ q

  the rotation that the gyro missed, r_R, is laid evenly over the interval, and only the scatter about it is noise. Both
  r_p and r_R follow the gyro bias of keyframe i to first order; a constant one is nearly an even rotation, too.
  The gyro noise that Δp̃ shares with the velocity and position of the IMU factor, given its rotation, is left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...datasets.state import Array, TimeArray
from .imu import HELD_RATE
from .so3 import exp, product, skew, transform

DISPLACEMENT = np.dtype(
    [
        ("dR", "f8", (3, 3)),  # ΔR̃ = R_ij, by the gyro
        ("dp", "f8", (3,)),  # Δp̃, m
        ("b_g", "f8", (3,)),  # gyro bias they were summed with
        ("R_bg", "f8", (3, 3)),  # ΔR̃(b_g + d) ≈ ΔR̃ Exp(R_bg d)
        ("p_bg", "f8", (3, 3)),  # Δp̃(b_g + d) ≈ Δp̃ + p_bg d
        ("N", "f8", (6, 6)),  # covariance of (φ, Δp) in B_i axes, with true ΔR = Exp(φ) ΔR̃
    ]
)


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
) -> NDArray[Any]:
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
        A DISPLACEMENT record of length 1. The noise of reading k displaces by Σ ΔR Δt over the time that it is held;
        a bias d is the rotation error −ΔR R_BI dt d at each sample.
    """
    g, n = rig[0], len(t_ns)
    capacity = len(imu) + n
    position, turn, q = np.empty((capacity, 3)), np.empty((capacity, 3, 3)), np.empty(capacity)  # piece by piece
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
            position[piece], turn[piece] = dp + 0.5 * step, R_dt
            q[piece] = (g.gyro_density**2 + HELD_RATE**2 * imu[row].held_s) * dt
            piece += 1
            dp = dp + step
            R = product(R, exp(dt * w))
            now_ns = until_ns

    out = np.zeros(1, DISPLACEMENT)
    d = out[0]
    turned, u_turned, qu = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)  # Σ dt ΔR, Σ dt [u]× ΔR and Σ q u
    N_pp = np.zeros((3, 3))
    for k in range(n):
        for i in range(3):
            for j in range(3):
                for m in range(3):
                    N_pp[i, j] += weight[k, i, m] * sigma[k, m] ** 2 * weight[k, j, m]
    for m in range(piece):
        u = dp - position[m]
        turned += turn[m]
        u_turned += product(skew(u), turn[m])
        qu += q[m] * u
        N_pp += q[m] * ((u @ u) * np.eye(3) - np.outer(u, u))

    d.dR[:], d.dp[:], d.b_g[:] = R, dp, b_g
    d.R_bg[:] = -product(R.T, product(turned, g.R_BI))
    d.p_bg[:] = product(u_turned, g.R_BI)
    d.N[0:3, 0:3] = q[:piece].sum() * np.eye(3)
    d.N[0:3, 3:6], d.N[3:6, 0:3] = skew(qu), -skew(qu)
    d.N[3:6, 3:6] = N_pp
    return out


@njit(cache=True)
def given_rotation(N: Array) -> tuple[Array, Array]:
    """Return K (3, 3) m/rad and C (3, 3) m²: given φ, the error of Δp has mean K φ and covariance C.

    K = N_pφ N_φφ⁻¹ = −[ū]× and C = N_pp − K N_φp, N being that of a DISPLACEMENT. Gyro noise is isotropic, so N_φφ is
    a multiple of I; a perfect gyro has none, and then there is nothing to lay anywhere.
    """
    K = N[3:, :3] / N[0, 0] if N[0, 0] > 0.0 else np.zeros((3, 3))
    return K, N[3:, 3:] - product(K, N[:3, 3:])
