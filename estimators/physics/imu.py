"""The IMU block: from samples to a motion with its covariance, once, for every estimator.

An IMU at the lever arm l = p_BI_B senses its own point I. The block integrates I's motion from raw samples, with coning
and sculling corrections, and moves it to B at the two ends:

    Δv_B = Δv_I + ω_i × l − ΔR (ω_j × l)        Δp_B = Δp_I + (ω_i × l) T + l − ΔR l

Term by term this is what the centripetal and the tangential acceleration of I add up to, the gyro being differenced
for the latter: the difference telescopes, so only the rates ω_i and ω_j at the ends are left. Each is the mean over the
last sample before its moment, so v_B lags by half a sample's turn of l, which does not accumulate.

Nor does their noise, one gyro sample each: ω_i's leaves with the block what it came with, as part of v_B at i, and
ω_j's is fresh. A covariance that took both as process noise would grow with every block, however short. So neither is
in N: P is of v_B but for the rate noise of the moment, `rate_cov`, which is added where v_B is compared with a reading
of it and where a belief is handed out. (A single block's Δv, taken alone, has it twice.)

Increments are free of gravity (Forster et al. 2017, doi:10.1109/TRO.2016.2597321, eq. 33) and in the axes of B at the
block's start, i:

    R_j = R_i ΔR        v_j = v_i + g T + R_i Δv        p_j = p_i + v_i T + ½ g T² + R_i Δp

An IMU senses its motion over the celestial frame C, the stars; W turns under it with the Earth, at Ω = w_CW_W (where
`earth_rotation` says so; else Ω = 0). Over C, in the axes that W has at i and about the place that B has at i, all of
this holds as it stands, lever arm included, but that gravity turns with W. Back over W, with E = Exp(−Ω T),

    R_j = E R_i ΔR        p_j = p_i + E u        v_j = E (v_i + g₁ + R_i Δv) − Ω × E u        u = v_i T + g₂ + R_i Δp
    g₁ = ∫ Exp(Ω t) g dt = g T + T²/2 Ω×g + T³/6 Ω×Ω×g        g₂ = ∫ g₁ dt = T²/2 g + T³/6 Ω×g + T⁴/24 Ω×Ω×g

(to the order of Ω²), in which are Coriolis' −2 Ω × v and how the sum of f turns over W. Left out is the centrifugal
force of u and of the lever arm, that of p_i being part of gravity: Ω² (v T / 2 + |l|), 5e-9 m/s² at a metre.

Coning, sculling: Savage 1998, doi:10.2514/2.4228 and 2.4242, the forms for one sample and the one before it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...datasets.epochs import IMU_SAMPLE
from ...datasets.rig import Rig
from ...datasets.state import ACCEL_BIAS, GYRO_BIAS, POSITION, THETA, VELOCITY, Array
from .so3 import cross, exp, exp_into, inverse_transform, product, product_into, right_jacobian, skew, transform

HELD_RATE = 0.1
"""rad/s: how far the rate may stray, for the whole of a gap, from the sample that is held over it."""
HELD_ACCEL = 0.5
"""m/s²: the same for the specific force."""

RIG = np.dtype(
    [
        ("R_BI", "f8", (3, 3)),
        ("p_BI_B", "f8", (3,)),
        ("p_BP_B", "f8", (3,)),
        ("p_BG_B", "f8", (3,)),
        ("R_BH", "f8", (3, 3)),
        ("gyro_density", "f8"),
        ("accel_density", "f8"),
        ("gyro_walk", "f8"),
        ("accel_walk", "f8"),
        ("gravity", "f8"),
        ("w_CW_W", "f8", (3,)),  # the Earth's rate, rad/s; zero where its turning is left out
        ("rate_cov", "f8", (3, 3)),  # covariance of ω × l from the noise of one gyro sample, m²/s²
        ("inflate", "f8", (5,)),  # factor on sigma by kind of reading; inf: not used
    ]
)

STATE = np.dtype(
    [
        ("R_WB", "f8", (3, 3)),
        ("p_WB_W", "f8", (3,)),
        ("v_WB_W", "f8", (3,)),
        ("b_a", "f8", (3,)),
        ("b_g", "f8", (3,)),
        ("P", "f8", (15, 15)),
    ]
)

BLOCK = np.dtype(
    [
        ("T", "f8"),  # s
        ("dR", "f8", (3, 3)),  # ΔR = R_ij
        ("dv", "f8", (3,)),  # Δv, m/s
        ("dp", "f8", (3,)),  # Δp, m
        ("b_a", "f8", (3,)),  # biases it was integrated with
        ("b_g", "f8", (3,)),
        ("R_bg", "f8", (3, 3)),  # ΔR(b_g + d) ≈ ΔR Exp(R_bg d)
        ("v_ba", "f8", (3, 3)),
        ("v_bg", "f8", (3, 3)),
        ("p_ba", "f8", (3, 3)),
        ("p_bg", "f8", (3, 3)),
        ("N", "f8", (9, 9)),  # covariance of (φ, Δp, Δv) in B_i axes, with true ΔR = Exp(φ) ΔR
        ("bias_walk", "f8", (2,)),  # variance that b_a and b_g gain over the block
        ("w_CW_W", "f8", (3,)),  # rate at which W turned meanwhile, rad/s
    ]
)


def compile_rig(
    rig: Rig, factors: frozenset[str], inflate: dict[str, float], earth_rotation: bool = False
) -> NDArray[Any]:
    """Return the rig as one RIG record; sensors that are not in `factors` get an infinite sigma.

    Raises:
        DatasetError: earth_rotation, of a rig whose latitude is not known.
    """
    record = np.zeros(1, RIG)
    noise = rig.imu_noise
    record["R_BI"], record["p_BI_B"], record["p_BP_B"] = rig.imu.R_BS, rig.imu.p_BS_B, rig.depth.p_BS_B
    record["p_BG_B"], record["R_BH"] = rig.gps.p_BS_B, rig.heading.R_BS
    record["gyro_density"] = noise.gyro_density * inflate.get("gyro", 1.0)
    record["accel_density"] = noise.accel_density * inflate.get("accel", 1.0)
    record["gyro_walk"], record["accel_walk"], record["gravity"] = noise.gyro_walk, noise.accel_walk, rig.gravity
    if earth_rotation:
        record["w_CW_W"] = rig.w_CW_W
    for kind, sensor in enumerate(("dvl", "depth", "gps", "heading", "heading")):
        record["inflate"][0, kind] = inflate.get(sensor, 1.0) if sensor in factors else np.inf
    return record


@njit(cache=True)
def integrate(
    imu: NDArray[Any], before: NDArray[Any], b_a: Array, b_g: Array, rig: NDArray[Any], out: NDArray[Any]
) -> None:
    """Integrate a block of samples into `out`, a BLOCK record of length 1.

    Args:
        imu: IMU_SAMPLE rows of the block; none gives the block of zero length.
        before: one IMU_SAMPLE row, the sample that ends where the block begins (at the log's start: the first itself).
        b_a, b_g: (3,) biases to remove, in the IMU's axes.
        rig: RIG record of length 1.
        out: filled. Its N has white noise only: what the biases' walk adds to the motion within a block of T seconds
            is (walk T / density)²/3 of it, less than 1e-3 for any IMU of note at T = 1 s.
    """
    g, block, n = rig[0], out[0], len(imu)
    arm = g.p_BI_B
    R_mid, v_mid, p_mid = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))  # at the middle of each sample
    R, half, turn, push, drift = np.eye(3), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    v, p, w_x_f, T = np.zeros(3), np.zeros(3), np.empty(3), 0.0
    rates, forces, dts = unbiased(imu, before, b_a, b_g, g.R_BI)
    for k in range(n):
        dt = dts[k + 1]
        slope = dt**3 / (6.0 * (dts[k] + dt)) if dt > 0.0 else 0.0  # dt²/12 where both samples last equally long
        w0, f0, w, f = rates[k], forces[k], rates[k + 1], forces[k + 1]
        for i in range(3):
            w_x_f[i] = w[(i + 1) % 3] * f[(i + 2) % 3] - w[(i + 2) % 3] * f[(i + 1) % 3]
        for i in range(3):
            m, o = (i + 1) % 3, (i + 2) % 3
            w_x_w_x_f = w[m] * w_x_f[o] - w[o] * w_x_f[m]
            coning = w0[m] * w[o] - w0[o] * w[m]
            sculling = w0[m] * f[o] - w0[o] * f[m] + f0[m] * w[o] - f0[o] * w[m]
            turn[i] = 0.5 * (dt * w[i] + slope * coning)
            push[i] = dt * f[i] + 0.5 * dt**2 * w_x_f[i] + dt**3 / 6.0 * w_x_w_x_f + slope * sculling
            drift[i] = 0.5 * dt**2 * f[i] + dt**3 / 6.0 * w_x_f[i] + dt**4 / 24.0 * w_x_w_x_f
        exp_into(turn, half)
        product_into(R, half, R_mid[k])
        for i in range(3):
            dv = R[i, 0] * push[0] + R[i, 1] * push[1] + R[i, 2] * push[2]
            dp = R[i, 0] * drift[0] + R[i, 1] * drift[1] + R[i, 2] * drift[2]
            v_mid[k, i] = v[i] + 0.5 * dv
            p_mid[k, i] = p[i] + 0.5 * dt * v[i] + 0.25 * dp
            p[i] += dt * v[i] + dp
            v[i] += dv
        product_into(R_mid[k], half, R)
        T += dt

    c_i, c_j = cross(rates[0], arm), cross(rates[n], arm)
    v_end, p_end = v - transform(R, c_j), p - transform(R, arm)
    block.T, block.dR[:], block.b_a[:], block.b_g[:], block.w_CW_W[:] = T, R, b_a, b_g, g.w_CW_W
    block.dv[:] = v_end + c_i
    block.dp[:] = p_end + T * c_i + arm
    _spread(imu, R_mid, v_mid, p_mid, v_end, p_end, rig, out)


@njit(cache=True)
def unbiased(
    imu: NDArray[Any], before: NDArray[Any], b_a: Array, b_g: Array, R_BI: Array
) -> tuple[Array, Array, Array]:
    """Return rates and forces (n + 1, 3) in B axes without their biases, and durations; `before` comes first."""
    n = len(imu)
    rates, forces, dts = np.empty((n + 1, 3)), np.empty((n + 1, 3)), np.empty(n + 1)
    for k in range(n + 1):
        row = before[0] if k == 0 else imu[k - 1]
        dts[k] = row.dt_s
        for i in range(3):
            rates[k, i] = forces[k, i] = 0.0
            for j in range(3):
                rates[k, i] += R_BI[i, j] * (row.w_WI_I[j] - b_g[j])
                forces[k, i] += R_BI[i, j] * (row.f_I[j] - b_a[j])
    return rates, forces, dts


@njit(cache=True)
def _spread(
    imu: NDArray[Any], R_mid: Array, v_mid: Array, p_mid: Array, v_end: Array, p_end: Array,
    rig: NDArray[Any], out: NDArray[Any],
) -> None:  # fmt: skip
    """Fill the bias Jacobians and the covariance N of a block, from its response to an impulse at each sample.

    A rotation impulse φ (B_i axes) at time s turns all that comes later: it adds −[u]× φ to Δv and −[w]× φ to Δp, with

        u = Δv(T) − Δv(s)        w = Δp(T) − Δp(s) − Δv(s) (T − s)

    and an impulse of specific force adds itself to Δv and (T − s) times itself to Δp. A gyro bias d is the impulse
    −ΔR R_BI dt d at each sample; gyro noise, being isotropic, is an impulse of variance q = gyro_density² dt I, so that

        cov(Δv, Δp) = Σ q [u]× [w]×ᵀ = Σ q (u·w I − w uᵀ),        cov(φ, Δv) = Σ q [u]×,        and so on.
    """
    g, block, n = rig[0], out[0], len(imu)
    R, T, N = block.dR, block.T, block.N
    turned, lifted = np.zeros((3, 3)), np.zeros((3, 3))  # Σ dt ΔR and Σ dt (T − s) ΔR
    u_turned, w_turned = np.zeros((3, 3)), np.zeros((3, 3))  # Σ dt [u]× ΔR and Σ dt [w]× ΔR
    u, w, s_u, s_w = np.empty(3), np.empty(3), np.zeros(3), np.zeros(3)
    gyro = accel = accel_1 = accel_2 = uu = uw = ww = 0.0  # Σ q, and Σ q_a (T − s)^0, 1, 2, Σ q u·u, ...
    N[:] = 0.0
    remains = T
    for k in range(n):
        dt, held = imu[k].dt_s, imu[k].held_s
        remains -= 0.5 * dt  # now T − s, s being the middle of the sample
        for i in range(3):
            u[i] = v_end[i] - v_mid[k, i]
            w[i] = p_end[i] - p_mid[k, i] - remains * v_mid[k, i]
        for j in range(3):
            x, y, z = dt * R_mid[k, 0, j], dt * R_mid[k, 1, j], dt * R_mid[k, 2, j]
            turned[0, j] += x
            turned[1, j] += y
            turned[2, j] += z
            lifted[0, j] += remains * x
            lifted[1, j] += remains * y
            lifted[2, j] += remains * z
            u_turned[0, j] += u[1] * z - u[2] * y
            u_turned[1, j] += u[2] * x - u[0] * z
            u_turned[2, j] += u[0] * y - u[1] * x
            w_turned[0, j] += w[1] * z - w[2] * y
            w_turned[1, j] += w[2] * x - w[0] * z
            w_turned[2, j] += w[0] * y - w[1] * x

        q = g.gyro_density**2 * dt + HELD_RATE**2 * held * dt  # sums to (HELD_RATE gap)², however the gap is split
        q_a = g.accel_density**2 * dt + HELD_ACCEL**2 * held * dt
        gyro += q
        accel += q_a
        accel_1 += q_a * remains
        accel_2 += q_a * remains * remains
        for i in range(3):
            uu += q * u[i] * u[i]
            uw += q * u[i] * w[i]
            ww += q * w[i] * w[i]
            s_u[i] += q * u[i]
            s_w[i] += q * w[i]
            for j in range(3):
                N[3 + i, 3 + j] -= q * w[i] * w[j]
                N[3 + i, 6 + j] -= q * u[i] * w[j]
                N[6 + i, 6 + j] -= q * u[i] * u[j]
        remains -= 0.5 * dt

    for i in range(3):
        N[i, i] = gyro
        N[3 + i, 3 + i] += ww + accel_2
        N[3 + i, 6 + i] += uw + accel_1
        N[6 + i, 6 + i] += uu + accel
    N[0:3, 3:6] = skew(s_w)
    N[0:3, 6:9] = skew(s_u)
    N[3:6, 0:3], N[6:9, 0:3], N[6:9, 3:6] = N[0:3, 3:6].T, N[0:3, 6:9].T, N[3:6, 6:9].T

    L_BI = product(skew(g.p_BI_B), g.R_BI)  # ω = R_BI (w − b_g), and d(ω × l) = [l]× R_BI d
    turned_BI = product(turned, g.R_BI)
    block.R_bg[:] = -product(R.T, turned_BI)
    block.v_ba[:], block.p_ba[:] = -turned_BI, -product(lifted, g.R_BI)
    block.v_bg[:] = product(u_turned, g.R_BI) + L_BI - product(R, L_BI)
    block.p_bg[:] = product(w_turned, g.R_BI) + T * L_BI
    block.bias_walk[0], block.bias_walk[1] = g.accel_walk**2 * T, g.gyro_walk**2 * T


@njit(cache=True)
def predict(block: NDArray[Any], state: NDArray[Any], gravity: float, F: Array, out: NDArray[Any]) -> None:
    """Carry a state over a block, to first order in the change of its biases since the block was integrated.

    Args:
        block: BLOCK record of length 1.
        state: STATE record of length 1, at the block's start; its P is not read.
        gravity: m/s², positive.
        F: (15, 15), filled with the derivative of the end's error by the start's.
        out: STATE record of length 1, filled but for P.
    """
    b, s, e = block[0], state[0], out[0]
    T, R_i = b.T, s.R_WB
    d_a, d_g = s.b_a - b.b_a, s.b_g - b.b_g
    phi = transform(b.R_bg, d_g)
    dR = product(b.dR, exp(phi))
    dv = b.dv + transform(b.v_ba, d_a) + transform(b.v_bg, d_g)
    dp = b.dp + transform(b.p_ba, d_a) + transform(b.p_bg, d_g)

    F[:] = 0.0
    F[THETA, THETA] = dR.T
    F[THETA, GYRO_BIAS] = product(right_jacobian(phi), b.R_bg)
    F[POSITION, THETA] = -product(R_i, skew(dp))
    F[POSITION, ACCEL_BIAS] = product(R_i, b.p_ba)
    F[POSITION, GYRO_BIAS] = product(R_i, b.p_bg)
    F[VELOCITY, THETA] = -product(R_i, skew(dv))
    F[VELOCITY, ACCEL_BIAS] = product(R_i, b.v_ba)
    F[VELOCITY, GYRO_BIAS] = product(R_i, b.v_bg)
    for i in range(3):
        F[3 + i, 3 + i] = F[6 + i, 6 + i] = F[9 + i, 9 + i] = F[12 + i, 12 + i] = 1.0
        F[3 + i, 6 + i] = T

    p_j = s.p_WB_W + T * s.v_WB_W + transform(R_i, dp)
    v_j = s.v_WB_W + transform(R_i, dv)
    p_j[2] -= 0.5 * gravity * T * T
    v_j[2] -= gravity * T
    R_j = product(R_i, dR)
    if b.w_CW_W.any():
        turn_world(b.w_CW_W, T, gravity, s.p_WB_W, R_j, p_j, v_j, F)
    e.R_WB[:] = R_j
    e.p_WB_W[:], e.v_WB_W[:], e.b_a[:], e.b_g[:] = p_j, v_j, s.b_a, s.b_g


@njit(cache=True)
def turn_world(
    w_CW_W: Array, T: float, gravity: float, p_i: Array, R_j: Array, p_j: Array, v_j: Array, F: Array
) -> None:
    """Turn W, for T seconds, under a motion over C that began at p_i; changes R_j, p_j, v_j and F (15, 15) in place.

    The error theta is on the right of R, where E does not touch it; of p and v, E u and all else is linear.
    """
    E = exp(-T * w_CW_W)
    w_x_g = cross(w_CW_W, np.array([0.0, 0.0, -gravity]))
    w_x_w_x_g = cross(w_CW_W, w_x_g)
    u = transform(E, p_j - p_i + T**3 / 6.0 * w_x_g + T**4 / 24.0 * w_x_w_x_g)
    v = transform(E, v_j + T**2 / 2.0 * w_x_g + T**3 / 6.0 * w_x_w_x_g)
    R_j[:], p_j[:], v_j[:] = product(E, R_j), p_i + u, v - cross(w_CW_W, u)
    for j in range(15):
        if j < 3 or j >= 6:  # by p_i, p_j changes as it did, and v_j not at all
            of_u = transform(E, F[POSITION, j])
            F[VELOCITY, j] = transform(E, F[VELOCITY, j]) - cross(w_CW_W, of_u)
            F[POSITION, j] = of_u


@njit(cache=True)
def over_world(imu: NDArray[Any], R_i: Array, b_g: Array, rig: NDArray[Any]) -> NDArray[Any]:
    """Return IMU_SAMPLE rows with the rates over W alone, less R_IW w_CW_W of the Earth that the gyro senses as well.

    Args:
        imu: rows of a block.
        R_i: R_WB at its start.
        b_g: (3,) gyro bias, rad/s; it stays in the rates.
        rig: RIG record of length 1.
    """
    g, R = rig[0], R_i.copy()
    if not g.w_CW_W.any():
        return imu
    rows = imu.copy()
    for k in range(len(rows)):
        w_CB_B, dt = transform(g.R_BI, rows[k].w_WI_I - b_g), rows[k].dt_s
        w_CW_B = inverse_transform(product(R, exp(0.5 * dt * w_CB_B)), g.w_CW_W)
        rows[k].w_WI_I[:] -= inverse_transform(g.R_BI, w_CW_B)
        R = product(R, exp(dt * (w_CB_B - w_CW_B)))
    return rows


@njit(cache=True)
def process_noise(block: NDArray[Any], R_i: Array, Q: Array) -> None:
    """Fill Q (15, 15): what the block's noise adds to the error covariance at its end; R_i is R_WB at its start.

    How W turns meanwhile is left out: it is 1e-4 of Q.
    """
    b = block[0]
    Q[:] = 0.0
    G = (b.dR.T.copy(), R_i.copy(), R_i.copy())
    for i in range(3):
        for j in range(3):
            N_ij = b.N[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
            Q[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = product(product(G[i], N_ij), G[j].T)
    for i in range(3):
        Q[9 + i, 9 + i] = b.bias_walk[0]
        Q[12 + i, 12 + i] = b.bias_walk[1]


@njit(cache=True)
def sandwich(F: Array, P: Array) -> Array:
    """F P Fᵀ for an F of `predict`, whose lower 6 rows are (0, I); symmetric to the last bit."""
    FP = np.empty((15, 15))
    for i in range(9):
        for j in range(15):
            total = 0.0
            for k in range(15):
                total += F[i, k] * P[k, j]
            FP[i, j] = total
    FP[9:] = P[9:]
    out = np.empty((15, 15))
    for i in range(15):
        for j in range(min(i + 1, 9)):
            total = 0.0
            for k in range(15):
                total += FP[i, k] * F[j, k]
            out[i, j] = out[j, i] = total
        for j in range(9, i + 1):
            out[i, j] = out[j, i] = FP[i, j]
    return out


def first_sample(imu: NDArray[Any], rig: NDArray[Any]) -> NDArray[Any]:
    """Return the row to stand before a log's first block: its first two samples, run straight on to its beginning.

    Also settles the rig's rate_cov, now that the IMU's period is known.
    """
    if not len(imu):
        return np.zeros(1, IMU_SAMPLE)
    if rig["p_BI_B"].any():
        L = skew(rig["p_BI_B"][0])
        rig["rate_cov"] = rig["gyro_density"][0] ** 2 / imu["period_s"][0] * (L @ L.T)
    row = imu[:1].copy()
    if len(imu) > 1:
        for name in ("w_WI_I", "f_I"):
            row[name] = 1.5 * imu[name][0] - 0.5 * imu[name][1]
    return row
