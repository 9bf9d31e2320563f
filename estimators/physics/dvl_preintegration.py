"""Preintegrated DVL: the displacement between two keyframes, from DVL velocities turned by the gyro.

    Δp̃_ij = Σ_k ΔR̃_ik v_B,k Δt_k                                                   [docs/conventions.md (5)]

in the axes of B at keyframe i. The rotation runs at IMU rate; the DVL's velocity runs straight from one reading to the
next (or is held), and is held over what is left, so that the sum ends exactly on keyframe j.

What the velocity does between readings is taken for a random walk in B, of density S. Held over a time T it is then off
by a displacement of variance S T³/3; run straight between two readings, by S T³/12, that of a Brownian bridge. S is
found from the readings themselves (`VelocityWalk`).

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

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.epochs import DVL
from ...datasets.state import Array, TimeArray
from .blocks import clear, identity
from .imu import HELD_RATE, over_world, turn_by
from .so3 import product_into, skew_into, transform_into
from .state import POSITION_0, THETA_0

MANOEUVRE_S = 10.0
"""How long a vehicle is taken to manoeuvre alike, s: fifty readings of a usual DVL, which find S to a fifth."""

OUTLIER_SIGMAS = 4.0
"""What a difference counts for at most in the memory, over what is usual there: one right one in 16,000 is larger."""

UNKNOWN_WALK = 0.1
"""m²/s³: S before a second reading has come; a vehicle that gets under way gains 0.3 m/s in a second."""

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


@compiled
def preintegrate_dvl(
    imu: NDArray[Any],
    start_ns: int,
    t_ns: TimeArray,
    v_WB_B: Array,
    sigma: Array,
    b_g: Array,
    rig: NDArray[Any],
    straight: bool,
    walk: Array,
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
        straight: between readings the velocity runs straight from one to the next; otherwise it is held. A reading
            at keyframe i or j is then in two sums, and its variance counts twice in each: the sum of many is right.
        walk: (3,) m²/s³, S of the velocity between readings, by axis of B.

    Returns:
        A DISPLACEMENT record of length 1. The noise of reading k displaces by Σ ΔR Δt over the time that it is held;
        a bias d is the rotation error −ΔR R_BI dt d at each sample.
    """
    g, n = rig[0], len(t_ns)
    R_BI = g.R_BI[:]
    capacity = len(imu) + n
    position, turn, q = np.empty((capacity, 3)), np.empty((capacity, 3, 3)), np.empty(capacity)  # piece by piece
    weight = np.zeros((n, 3, 3))  # Σ ΔR Δt by reading
    over, over_s = np.zeros((n + 1, 3, 3)), np.zeros(n + 1)  # Σ ΔR Δt and Σ Δt after each reading; first, before all
    vectors, matrices = np.zeros((3, 3)), np.empty((2, 3, 3))
    w_I, w, dp = vectors[0], vectors[1], vectors[2]
    R, R_mid = matrices[0], matrices[1]
    identity(R)
    k, piece, now_ns = 0, 0, start_ns
    for row in range(len(imu)):
        sample = imu[row]
        for i in range(3):
            w_I[i] = sample.w_WI_I[i] - b_g[i]
        transform_into(R_BI, w_I, w)
        while now_ns < sample.t_ns:
            while k + 1 < n and t_ns[k + 1] <= now_ns:
                k += 1
            until_ns = _end_of_piece(now_ns, sample.t_ns, t_ns, k)
            dt = (until_ns - now_ns) * 1e-9
            share, ahead = 0.0, k  # of the next reading
            between = k + 1 if now_ns >= t_ns[k] else 0
            over_s[between] += dt
            if straight and 0 < between < n:
                share, ahead = (0.5 * (now_ns + until_ns) - t_ns[k]) / (t_ns[k + 1] - t_ns[k]), k + 1
            for i in range(3):
                for j in range(3):
                    R_mid[i, j] = R[i, j]
            turn_by(R_mid, w, 0.5 * dt)
            for i in range(3):
                step = 0.0
                for j in range(3):
                    R_dt = dt * R_mid[i, j]
                    turn[piece, i, j] = R_dt
                    over[between, i, j] += R_dt
                    weight[k, i, j] += (1.0 - share) * R_dt
                    weight[ahead, i, j] += share * R_dt
                    step += R_dt * ((1.0 - share) * v_WB_B[k, j] + share * v_WB_B[ahead, j])
                position[piece, i] = dp[i] + 0.5 * step
                dp[i] += step
            q[piece] = (g.gyro_density**2 + HELD_RATE**2 * sample.held_s) * dt
            piece += 1
            turn_by(R, w, dt)
            now_ns = until_ns

    out = np.empty(1, DISPLACEMENT)
    d = out[0]
    for i in range(3):
        d.dp[i], d.b_g[i] = dp[i], b_g[i]
        for j in range(3):
            d.dR[i, j] = R[i, j]
    _spread(turn, position, q, piece, R_BI, out)
    for k in range(n):
        shared = straight and (t_ns[k] <= start_ns or t_ns[k] >= now_ns)
        _add_noise(weight[k], sigma[k] ** 2, 2.0 if shared else 1.0, d.N[:])
    for k in range(n + 1):
        lost = 1.0 / 3.0
        if straight and 0 < k < n:
            lost -= over_s[k] / (4e-9 * (t_ns[k] - t_ns[k - 1]))
        _add_noise(over[k], walk, lost * over_s[k], d.N[:])
    return out


@inner
def _add_noise(W: Array, variance: Array, scale: float, N: Array) -> None:
    """Add scale W diag(variance) Wᵀ to the covariance of the displacement in N (6, 6)."""
    for i in range(3):
        for j in range(3):
            for m in range(3):
                N[POSITION_0 + i, POSITION_0 + j] += scale * W[i, m] * variance[m] * W[j, m]


@inner
def _end_of_piece(now_ns: int, until_ns: int, t_ns: TimeArray, k: int) -> int:
    """Return where the piece that begins at now_ns ends: at the end of the IMU sample, or at a DVL reading before it.

    Reading k is the one in force at now_ns, or the first of all where that is still to come.
    """
    if k + 1 < len(t_ns) and t_ns[k + 1] < until_ns:
        until_ns = t_ns[k + 1]
    if t_ns[k] > now_ns and t_ns[k] < until_ns:
        until_ns = t_ns[k]
    return until_ns


@inner
def _spread(turn: Array, position: Array, q: Array, pieces: int, R_BI: Array, out: NDArray[Any]) -> None:
    """Fill the bias Jacobians, and what gyro noise does to N, of a displacement whose dR and dp are there.

    A rotation impulse φ (B_i axes) at time s turns all that comes later: it adds −[u]× φ to Δp, u = Δp(T) − Δp(s). So
    gyro noise, isotropic and of variance q, has cov(Δp) = Σ q (u·u I − u uᵀ) and cov(φ, Δp) = Σ q [u]×.

    Args:
        turn: (pieces, 3, 3) ΔR Δt of each piece.
        position: (pieces, 3) Δp in its middle.
        q: (pieces,) variance of its gyro noise, rad².
        pieces: how many there are.
        R_BI: mounting of the IMU.
        out: DISPLACEMENT record of length 1.
    """
    d, vectors, matrices = out[0], np.zeros((2, 3)), np.zeros((4, 3, 3))
    N, u, qu = d.N[:], vectors[0], vectors[1]
    turned, u_turned, N_pp, S = matrices[0], matrices[1], matrices[2], matrices[3]  # Σ dt ΔR and Σ dt [u]× ΔR
    q_sum = 0.0
    for m in range(pieces):
        uu = 0.0
        for i in range(3):
            u[i] = d.dp[i] - position[m, i]
            qu[i] += q[m] * u[i]
            uu += u[i] * u[i]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            N_pp[i, i] += q[m] * uu
            for j in range(3):
                turned[i, j] += turn[m, i, j]
                u_turned[i, j] += u[a] * turn[m, b, j] - u[b] * turn[m, a, j]
                N_pp[i, j] -= q[m] * u[i] * u[j]
        q_sum += q[m]

    product_into(turned, R_BI, S)
    product_into(u_turned, R_BI, d.p_bg[:])
    for i in range(3):
        for j in range(3):
            d.R_bg[i, j] = 0.0
            for m in range(3):
                d.R_bg[i, j] -= d.dR[m, i] * S[m, j]
    clear(N)
    skew_into(qu, S)
    for i in range(3):
        N[THETA_0 + i, THETA_0 + i] = q_sum
        for j in range(3):
            N[THETA_0 + i, POSITION_0 + j], N[POSITION_0 + j, THETA_0 + i] = S[i, j], S[i, j]
            N[POSITION_0 + i, POSITION_0 + j] = N_pp[i, j]


class VelocityWalk:
    """The density S of the velocity's walk between readings, found from the differences of those that have come.

        S = Σ (Δv² − σ₁² − σ₂²) / Σ Δt,  by axis of B, not below 0                       [docs/conventions.md (18)]

    It is the larger of two: that of the interval itself, for a manoeuvre that has just begun, and one that forgets with
    MANOEUVRE_S, for an interval of few readings. An outlier is kept out of the second, and makes the covariance of its
    own interval large, so that a sum protects itself. Both know the readings up to the interval's end and no later one.
    """

    def __init__(self) -> None:
        self._squares, self._time_s = np.zeros(3), 0.0
        self._last: tuple[int, Array, Array] | None = None

    def take(self, t_ns: TimeArray, v_WB_B: Array, sigma: Array) -> Array:
        """Return S (3,) m²/s³ for the interval of these readings; they are those of `preintegrate_dvl`."""
        own, own_s = np.zeros(3), 0.0
        for at_ns, v, variance in zip(t_ns.tolist(), v_WB_B, sigma**2, strict=True):
            if self._last is not None:
                then_ns, v_then, variance_then = self._last
                if at_ns <= then_ns:  # it is known
                    continue
                dt = (at_ns - then_ns) * 1e-9
                square = (v - v_then) ** 2 - variance - variance_then
                own, own_s = own + square, own_s + dt
                if self._time_s > 0.0:
                    usual = np.maximum(self._squares / self._time_s, 0.0) * dt + variance + variance_then
                    square = np.minimum(square, OUTLIER_SIGMAS**2 * usual)
                kept = math.exp(-dt / MANOEUVRE_S)
                self._squares, self._time_s = kept * self._squares + square, kept * self._time_s + dt
            self._last = at_ns, v, variance
        walk = np.zeros(3) if self._time_s > 0.0 else np.full(3, UNKNOWN_WALK)
        for squares, time_s in ((own, own_s), (self._squares, self._time_s)):
            if time_s > 0.0:
                walk = np.maximum(walk, squares / time_s)
        return walk


def preintegrate_readings(
    readings: NDArray[Any], imu: NDArray[Any], start_ns: int, R_i: Array, b_g: Array, rig: NDArray[Any],
    straight: bool, walk: VelocityWalk,
) -> NDArray[Any]:  # fmt: skip
    """Sum the DVL's READING rows, in the order of their times, over the interval of a smoother that begins at R_i.

    The other arguments, and what is returned, are those of `preintegrate_dvl`; `imu` still has the Earth's rate in it.
    """
    t_ns, v_WB_B = readings["t_ns"].copy(), readings["z"][:, :3].copy()
    sigma = rig["inflate"][0, DVL] * readings["sigma"]
    imu, S = over_world(imu, R_i, b_g, rig), walk.take(t_ns, v_WB_B, sigma)
    return preintegrate_dvl(imu, start_ns, t_ns, v_WB_B, sigma, b_g, rig, straight, S)


@compiled
def given_rotation(N: Array) -> tuple[Array, Array]:
    """Return K (3, 3) m/rad and C (3, 3) m²: given φ, the error of Δp has mean K φ and covariance C.

    K = N_pφ N_φφ⁻¹ = −[ū]× and C = N_pp − K N_φp, N being that of a DISPLACEMENT. Gyro noise is isotropic, so N_φφ is
    a multiple of I; a perfect gyro has none, and then there is nothing to lay anywhere.
    """
    K, C = np.zeros((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = N[POSITION_0 + i, POSITION_0 + j]
            if N[THETA_0, THETA_0] > 0.0:
                K[i, j] = N[POSITION_0 + i, THETA_0 + j] / N[THETA_0, THETA_0]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                C[i, j] -= K[i, k] * N[THETA_0 + k, POSITION_0 + j]
    return K, C
