"""The IMU block: from samples to a motion with its covariance, once, for every estimator.

The equations are docs/conventions.md (21) to (34).

An IMU at the lever arm l = p_BI_B senses its own point I. The block integrates I's motion from raw samples, with coning
and sculling corrections, and moves it to B at the two ends:

    Δv_B = Δv_I + ω_i × l − ΔR (ω_j × l)        Δp_B = Δp_I + (ω_i × l) T + l − ΔR l

Term by term this is what the centripetal and the tangential acceleration of I add up to, the gyro being differenced
for the latter: the difference telescopes, so only the rates ω_i and ω_j at the ends are left. A sample is a mean, half
of it late, so its rate is run straight on to its end by the sample before it (`arm_velocity`).

The noise of these rates does not accumulate: ω_i's leaves with the block what it came with, as part of v_B at i, and
ω_j's is fresh. A covariance that took both as process noise would grow with every block, however short. So neither is
in N: P is of v_B but for the rate noise of the moment, `rate_cov`, which is added where v_B is compared with a reading
of it and where a belief is handed out. (A single block's Δv, taken alone, has it twice.)

Increments are free of gravity (Forster et al. 2017, doi:10.1109/TRO.2016.2597321, eq. 33) and in the axes of B at the
block's start, i:

    R_j = R_i ΔR        v_j = v_i + g T + R_i Δv        p_j = p_i + v_i T + ½ g T² + R_i Δp

An IMU senses its motion over the celestial frame C, the stars; W turns under it with the Earth, at Ω = w_CW_W (where
`earth_rotation` lets it; else Ω = 0). Over C, in the axes that W has at i and about the place that B has at i, all of
this holds unchanged, lever arm included, except that gravity turns with W. Back over W, with E = Exp(−Ω T),

    R_j = E R_i ΔR        p_j = p_i + E u        v_j = E (v_i + g₁ + R_i Δv) − Ω × E u        u = v_i T + g₂ + R_i Δp
    g₁ = ∫ Exp(Ω t) g dt = g T + T²/2 Ω×g + T³/6 Ω×Ω×g        g₂ = ∫ g₁ dt = T²/2 g + T³/6 Ω×g + T⁴/24 Ω×Ω×g

(to the order of Ω²), in which are Coriolis' −2 Ω × v and how the sum of f turns over W. Left out is the centrifugal
force of u and of the lever arm, that of p_i being part of gravity: Ω² (v T / 2 + |l|), 5e-9 m/s² at a metre.

Coning, sculling: Savage 1998, doi:10.2514/2.4228 and 2.4242, the forms for one sample and the one before it.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.epochs import IMU_SAMPLE
from ...datasets.rig import Rig
from ...datasets.state import DIM, Array
from .blocks import clear, identity, set_block, set_product
from .so3 import (
    cross_into,
    exp_into,
    inverse_transform_into,
    product_into,
    right_jacobian_into,
    skew,
    skew_into,
    transform_into,
)
from .state import ACCEL_BIAS_0, GYRO_BIAS_0, POSITION_0, THETA_0, VELOCITY_0

EarthRotation = bool | Literal["auto"]
"""Whether an estimator lets W turn with the Earth; "auto": where the rig knows its latitude."""
HELD_RATE = 0.1
"""rad/s: how far the rate may stray, for the whole of a gap, from the sample that is held over it."""
HELD_ACCEL = 0.5
"""m/s²: the same for the specific force."""

RATE_NOISE = 1.5**2 + 0.5**2
"""Variance of the rate at a sample's end, 1½ of it less ½ of the one before, over that of one sample."""

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


def turns_with_earth(rig: Rig, earth_rotation: EarthRotation) -> bool:
    """Return whether W turns with the Earth, by the option; "auto" is where the rig knows its latitude."""
    return rig.latitude_deg is not None if earth_rotation == "auto" else earth_rotation


def compile_rig(
    rig: Rig, factors: frozenset[str], inflate: dict[str, float], earth_rotation: EarthRotation = False
) -> NDArray[Any]:
    """Return the rig as one RIG record; sensors that are not in `factors` get an infinite sigma.

    Raises:
        DatasetError: earth_rotation is True, of a rig whose latitude is not known.
    """
    record = np.zeros(1, RIG)
    noise = rig.imu_noise
    record["R_BI"], record["p_BI_B"], record["p_BP_B"] = rig.imu.R_BS, rig.imu.p_BS_B, rig.depth.p_BS_B
    record["p_BG_B"], record["R_BH"] = rig.gps.p_BS_B, rig.heading.R_BS
    record["gyro_density"] = noise.gyro_density * inflate.get("gyro", 1.0)
    record["accel_density"] = noise.accel_density * inflate.get("accel", 1.0)
    record["gyro_walk"], record["accel_walk"], record["gravity"] = noise.gyro_walk, noise.accel_walk, rig.gravity
    if turns_with_earth(rig, earth_rotation):
        record["w_CW_W"] = rig.w_CW_W
    for kind, sensor in enumerate(("dvl", "depth", "gps", "heading", "heading")):
        record["inflate"][0, kind] = inflate.get(sensor, 1.0) if sensor in factors else np.inf
    return record


@compiled
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
    R_mid, v_mid, p_mid = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))  # at the middle of each sample
    R, half, vectors = np.empty((3, 3)), np.empty((3, 3)), np.zeros((7, 3))
    turn, push, drift, v, p, c_i, c_j = (
        vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5], vectors[6],
    )  # fmt: skip
    identity(R)
    T = 0.0
    rates, forces, dts = unbiased(imu, before, b_a, b_g, g.R_BI[:])
    for k in range(n):
        dt = dts[k + 1]
        increments(rates, forces, dts, k, turn, push, drift)
        for i in range(3):
            turn[i] *= 0.5
        exp_into(turn, half)
        product_into(R, half, R_mid[k])
        for i in range(3):
            dv, dp = 0.0, 0.0
            for j in range(3):
                dv += R[i, j] * push[j]
                dp += R[i, j] * drift[j]
            v_mid[k, i] = v[i] + 0.5 * dv
            p_mid[k, i] = p[i] + 0.5 * dt * v[i] + 0.25 * dp
            p[i] += dt * v[i] + dp
            v[i] += dv
        product_into(R_mid[k], half, R)
        T += dt

    arm_velocity(before[0], rates[0], g, drift, c_i)
    arm_velocity(imu[n - 1] if n else before[0], rates[n], g, drift, c_j)
    block.T = T
    for i in range(3):  # from I to B: v and p are now of the block's end
        for j in range(3):
            block.dR[i, j] = R[i, j]
            v[i] -= R[i, j] * c_j[j]
            p[i] -= R[i, j] * g.p_BI_B[j]
        block.b_a[i], block.b_g[i], block.w_CW_W[i] = b_a[i], b_g[i], g.w_CW_W[i]
        block.dv[i] = v[i] + c_i[i]
        block.dp[i] = p[i] + T * c_i[i] + g.p_BI_B[i]
    _spread(imu, R_mid, v_mid, p_mid, v, p, rig, out)


@compiled
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


@inner
def arm_velocity(row: Any, rate: Array, g: Any, w: Array, out: Array) -> None:
    """Fill out (3,) with ω × l at the end of a sample whose mean is `rate`, rad/s in B; docs/conventions.md (24).

    `g` is one record of RIG, and w (3,) becomes ω, in B.
    """
    for i in range(3):
        w[i] = rate[i]
        for j in range(3):
            w[i] += g.R_BI[i, j] * row.alpha_I[j] * row.after_s
    cross_into(w, g.p_BI_B[:], out)


@compiled
def increments(
    rates: Array, forces: Array, dts: Array, k: int, turn: Array, push: Array, drift: Array
) -> None:  # fmt: skip
    """Fill what the k-th sample adds to the motion, in the axes of B at its beginning: the one step of integration.

    Args:
        rates, forces, dts: of `unbiased`; the sample stands in row k + 1, the one before it in row k.
        turn: (3,) rad, rotation vector, with coning.
        push: (3,) m/s, ∫ f dt, with sculling.
        drift: (3,) m, ∬ f dt dt, without it.
    """
    w0, f0, w, f, dt = rates[k], forces[k], rates[k + 1], forces[k + 1], dts[k + 1]
    slope = dt**3 / (6.0 * (dts[k] + dt)) if dt > 0.0 else 0.0  # dt²/12 where both samples last equally long
    w_x_f = np.empty(3)
    cross_into(w, f, w_x_f)
    for i in range(3):
        m, o = (i + 1) % 3, (i + 2) % 3
        w_x_w_x_f = w[m] * w_x_f[o] - w[o] * w_x_f[m]
        coning = w0[m] * w[o] - w0[o] * w[m]
        sculling = w0[m] * f[o] - w0[o] * f[m] + f0[m] * w[o] - f0[o] * w[m]
        turn[i] = dt * w[i] + slope * coning
        push[i] = dt * f[i] + 0.5 * dt**2 * w_x_f[i] + dt**3 / 6.0 * w_x_w_x_f + slope * sculling
        drift[i] = 0.5 * dt**2 * f[i] + dt**3 / 6.0 * w_x_f[i] + dt**4 / 24.0 * w_x_w_x_f


@inner
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
    T, N, R_BI = block.T, block.N[:], g.R_BI[:]
    matrices, vectors = np.zeros((6, 3, 3)), np.zeros((4, 3))
    turned, lifted = matrices[0], matrices[1]  # Σ dt ΔR and Σ dt (T − s) ΔR
    u_turned, w_turned = matrices[2], matrices[3]  # Σ dt [u]× ΔR and Σ dt [w]× ΔR
    S, L_BI = matrices[4], matrices[5]
    u, w, s_u, s_w = vectors[0], vectors[1], vectors[2], vectors[3]
    gyro = accel = accel_1 = accel_2 = uu = uw = ww = 0.0  # Σ q, and Σ q_a (T − s)^0, 1, 2, Σ q u·u, ...
    clear(N)
    remains = T
    for k in range(n):
        dt, held, R = imu[k].dt_s, imu[k].held_s, R_mid[k]
        remains -= 0.5 * dt  # now T − s, s being the middle of the sample
        for i in range(3):
            u[i] = v_end[i] - v_mid[k, i]
            w[i] = p_end[i] - p_mid[k, i] - remains * v_mid[k, i]
        for i in range(3):
            m, o = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                turned[i, j] += dt * R[i, j]
                lifted[i, j] += dt * remains * R[i, j]
                u_turned[i, j] += dt * (u[m] * R[o, j] - u[o] * R[m, j])
                w_turned[i, j] += dt * (w[m] * R[o, j] - w[o] * R[m, j])

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
                N[POSITION_0 + i, POSITION_0 + j] -= q * w[i] * w[j]
                N[POSITION_0 + i, VELOCITY_0 + j] -= q * u[i] * w[j]
                N[VELOCITY_0 + i, VELOCITY_0 + j] -= q * u[i] * u[j]
        remains -= 0.5 * dt

    for i in range(3):
        N[THETA_0 + i, THETA_0 + i] = gyro
        N[POSITION_0 + i, POSITION_0 + i] += ww + accel_2
        N[POSITION_0 + i, VELOCITY_0 + i] += uw + accel_1
        N[VELOCITY_0 + i, VELOCITY_0 + i] += uu + accel
    skew_into(s_w, S)
    set_block(N, THETA_0, POSITION_0, 1.0, S)
    skew_into(s_u, S)
    set_block(N, THETA_0, VELOCITY_0, 1.0, S)
    for i in range(len(N)):
        for j in range(3 * (i // 3)):
            N[i, j] = N[j, i]

    skew_into(g.p_BI_B[:], S)
    product_into(S, R_BI, L_BI)  # ω = R_BI (w − b_g), and d(ω × l) = [l]× R_BI d
    product_into(turned, R_BI, S)  # from here on S is Σ dt ΔR R_BI
    for i in range(3):
        for j in range(3):
            block.v_ba[i, j] = -S[i, j]
            block.R_bg[i, j], block.p_ba[i, j] = 0.0, 0.0
            block.v_bg[i, j], block.p_bg[i, j] = L_BI[i, j], T * L_BI[i, j]
            for m in range(3):
                block.R_bg[i, j] -= block.dR[m, i] * S[m, j]
                block.p_ba[i, j] -= lifted[i, m] * R_BI[m, j]
                block.v_bg[i, j] += u_turned[i, m] * R_BI[m, j] - block.dR[i, m] * L_BI[m, j]
                block.p_bg[i, j] += w_turned[i, m] * R_BI[m, j]
    block.bias_walk[0], block.bias_walk[1] = g.accel_walk**2 * T, g.gyro_walk**2 * T


@compiled
def predict(block: NDArray[Any], state: NDArray[Any], gravity: float, F: Array, out: NDArray[Any]) -> None:
    """Carry a state over a block, to first order in the change of its biases since the block was integrated.

    Args:
        block: BLOCK record of length 1.
        state: STATE record of length 1, at the block's start; its P is not read.
        gravity: m/s², positive.
        F: (15, 15), filled with the derivative of the end's error by the start's.
        out: STATE record of length 1, filled but for P; may be `state`.
    """
    b, s, e = block[0], state[0], out[0]
    T, R_i = b.T, s.R_WB[:]
    vectors, matrices = np.empty((7, 3)), np.empty((4, 3, 3))
    d_a, d_g, phi, dv, dp = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    p_j, v_j = vectors[5], vectors[6]
    turn, dR, R_j, S = matrices[0], matrices[1], matrices[2], matrices[3]
    for i in range(3):
        d_a[i], d_g[i] = s.b_a[i] - b.b_a[i], s.b_g[i] - b.b_g[i]
    transform_into(b.R_bg[:], d_g, phi)
    exp_into(phi, turn)
    product_into(b.dR[:], turn, dR)
    for i in range(3):
        dv[i], dp[i] = b.dv[i], b.dp[i]
        for j in range(3):
            dv[i] += b.v_ba[i, j] * d_a[j] + b.v_bg[i, j] * d_g[j]
            dp[i] += b.p_ba[i, j] * d_a[j] + b.p_bg[i, j] * d_g[j]

    identity(F)
    for i in range(3):
        for j in range(3):
            F[THETA_0 + i, THETA_0 + j] = dR[j, i]
        F[POSITION_0 + i, VELOCITY_0 + i] = T
    right_jacobian_into(phi, S)
    set_product(F, THETA_0, GYRO_BIAS_0, 1.0, S, b.R_bg[:])
    skew_into(dp, S)
    set_product(F, POSITION_0, THETA_0, -1.0, R_i, S)
    set_product(F, POSITION_0, ACCEL_BIAS_0, 1.0, R_i, b.p_ba[:])
    set_product(F, POSITION_0, GYRO_BIAS_0, 1.0, R_i, b.p_bg[:])
    skew_into(dv, S)
    set_product(F, VELOCITY_0, THETA_0, -1.0, R_i, S)
    set_product(F, VELOCITY_0, ACCEL_BIAS_0, 1.0, R_i, b.v_ba[:])
    set_product(F, VELOCITY_0, GYRO_BIAS_0, 1.0, R_i, b.v_bg[:])

    product_into(R_i, dR, R_j)
    transform_into(R_i, dp, p_j)
    transform_into(R_i, dv, v_j)
    for i in range(3):
        p_j[i] += s.p_WB_W[i] + T * s.v_WB_W[i]
        v_j[i] += s.v_WB_W[i]
    p_j[2] -= 0.5 * gravity * T * T
    v_j[2] -= gravity * T
    if turns(b.w_CW_W[:]):
        turn_world(b.w_CW_W[:], T, gravity, s.p_WB_W[:], R_j, p_j, v_j, F)
    for i in range(3):
        for j in range(3):
            e.R_WB[i, j] = R_j[i, j]
        e.p_WB_W[i], e.v_WB_W[i], e.b_a[i], e.b_g[i] = p_j[i], v_j[i], s.b_a[i], s.b_g[i]


@inner
def turns(w_CW_W: Array) -> bool:
    """Whether W turns with the Earth."""
    return w_CW_W[0] != 0.0 or w_CW_W[1] != 0.0 or w_CW_W[2] != 0.0


@inner
def turn_world(
    w_CW_W: Array, T: float, gravity: float, p_i: Array, R_j: Array, p_j: Array, v_j: Array, F: Array
) -> None:
    """Turn W, for T seconds, under a motion over C that began at p_i; changes R_j, p_j, v_j and F (15, 15) in place.

    The error theta is on the right of R, where E does not touch it; of p and v, E u and all else is linear.
    """
    vectors, E, R = np.empty((6, 3)), np.empty((3, 3)), R_j.copy()
    a, w_x_g, w_x_w_x_g, u, v, w_x_u = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    for i in range(3):
        a[i] = -T * w_CW_W[i]
    exp_into(a, E)
    product_into(E, R, R_j)
    a[0], a[1], a[2] = 0.0, 0.0, -gravity
    cross_into(w_CW_W, a, w_x_g)
    cross_into(w_CW_W, w_x_g, w_x_w_x_g)
    for i in range(3):
        a[i] = p_j[i] - p_i[i] + T**3 / 6.0 * w_x_g[i] + T**4 / 24.0 * w_x_w_x_g[i]
    transform_into(E, a, u)
    for i in range(3):
        a[i] = v_j[i] + T**2 / 2.0 * w_x_g[i] + T**3 / 6.0 * w_x_w_x_g[i]
    transform_into(E, a, v)
    cross_into(w_CW_W, u, w_x_u)
    for i in range(3):
        p_j[i], v_j[i] = p_i[i] + u[i], v[i] - w_x_u[i]
    for j in range(DIM):
        if POSITION_0 <= j < VELOCITY_0:  # by p_i, p_j changes as it did, and v_j not at all
            continue
        for i in range(3):
            a[i], w_x_g[i] = F[POSITION_0 + i, j], F[VELOCITY_0 + i, j]
        transform_into(E, a, u)
        transform_into(E, w_x_g, v)
        cross_into(w_CW_W, u, w_x_u)
        for i in range(3):
            F[POSITION_0 + i, j], F[VELOCITY_0 + i, j] = u[i], v[i] - w_x_u[i]


@compiled
def turn_by(R: Array, w: Array, dt: float) -> None:
    """R ← R Exp(w dt), in place."""
    phi, turn, old = np.empty(3), np.empty((3, 3)), R.copy()
    for i in range(3):
        phi[i] = w[i] * dt
    exp_into(phi, turn)
    product_into(old, turn, R)


@compiled
def over_world(imu: NDArray[Any], R_i: Array, b_g: Array, rig: NDArray[Any]) -> NDArray[Any]:
    """Return IMU_SAMPLE rows with the rates over W alone, less R_IW w_CW_W of the Earth that the gyro senses as well.

    Args:
        imu: rows of a block.
        R_i: R_WB at its start.
        b_g: (3,) gyro bias, rad/s; it stays in the rates.
        rig: RIG record of length 1.
    """
    g, R, R_mid = rig[0], R_i.copy(), np.empty((3, 3))
    R_BI, w_CW_W = g.R_BI[:], g.w_CW_W[:]
    if not turns(w_CW_W):
        return imu
    rows, vectors = imu.copy(), np.empty((4, 3))
    w_I, w_B, w_CW_B, w_CW_I = vectors[0], vectors[1], vectors[2], vectors[3]
    for k in range(len(rows)):
        row = rows[k]
        for i in range(3):
            w_I[i] = row.w_WI_I[i] - b_g[i]
        transform_into(R_BI, w_I, w_B)
        for i in range(3):
            for j in range(3):
                R_mid[i, j] = R[i, j]
        turn_by(R_mid, w_B, 0.5 * row.dt_s)
        inverse_transform_into(R_mid, w_CW_W, w_CW_B)
        inverse_transform_into(R_BI, w_CW_B, w_CW_I)
        for i in range(3):
            row.w_WI_I[i] -= w_CW_I[i]
            w_B[i] -= w_CW_B[i]
        turn_by(R, w_B, row.dt_s)
    return rows


@compiled
def process_noise(block: NDArray[Any], R_i: Array, Q: Array) -> None:
    """Fill Q (15, 15): what the block's noise adds to the error covariance at its end; R_i is R_WB at its start.

    It is G N Gᵀ of the block's N, with G = diag(ΔRᵀ, R_i, R_i). How W turns meanwhile is left out: it is 1e-4 of Q.
    """
    b = block[0]
    G, GN = np.empty((3, 3, 3)), np.empty((9, 9))
    for i in range(3):
        for j in range(3):
            G[0, i, j], G[1, i, j], G[2, i, j] = b.dR[j, i], R_i[i, j], R_i[i, j]
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(3):
                total += G[i // 3, i % 3, k] * b.N[i - i % 3 + k, j]
            GN[i, j] = total
    clear(Q)
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(3):
                total += GN[i, j - j % 3 + k] * G[j // 3, j % 3, k]
            Q[i, j] = total
    for i in range(3):
        Q[ACCEL_BIAS_0 + i, ACCEL_BIAS_0 + i] = b.bias_walk[0]
        Q[GYRO_BIAS_0 + i, GYRO_BIAS_0 + i] = b.bias_walk[1]


@compiled
def sandwich(F: Array, P: Array, Q: Array, out: Array) -> None:
    """Fill out = F P Fᵀ + Q for an F of `predict`, whose bias rows are (0, I); symmetric to the last bit.

    All are (15, 15); `out` may be P or Q.
    """
    FP = np.empty((DIM, DIM))
    for i in range(ACCEL_BIAS_0):
        for j in range(DIM):
            total = 0.0
            for k in range(DIM):
                total += F[i, k] * P[k, j]
            FP[i, j] = total
    for i in range(ACCEL_BIAS_0, DIM):
        for j in range(DIM):
            FP[i, j] = P[i, j]
    for i in range(DIM):
        for j in range(i + 1):
            total = 0.0
            if j < ACCEL_BIAS_0:
                for k in range(DIM):
                    total += FP[i, k] * F[j, k]
            else:
                total = FP[i, j]
            out[i, j] = out[j, i] = total + 0.5 * (Q[i, j] + Q[j, i])


def first_sample(imu: NDArray[Any], rig: NDArray[Any]) -> NDArray[Any]:
    """Return the row to stand before a log's first block: its first two samples, run straight on to its beginning.

    Also settles the rig's rate_cov, now that the IMU's period is known.
    """
    if not len(imu):
        return np.zeros(1, IMU_SAMPLE)
    if rig["p_BI_B"].any():
        L = skew(rig["p_BI_B"][0])
        rig["rate_cov"] = RATE_NOISE * rig["gyro_density"][0] ** 2 / imu["period_s"][0] * (L @ L.T)
    row = imu[:1].copy()
    if len(imu) > 1:
        for name in ("w_WI_I", "f_I"):
            row[name] = 1.5 * imu[name][0] - 0.5 * imu[name][1]
    return row


def split(imu: NDArray[Any], t_ns: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Split IMU_SAMPLE rows at t_ns; a sample that straddles it becomes two of the same rates."""
    k = int(np.searchsorted(imu["t_ns"], t_ns, side="right"))
    head, tail = imu[:k], imu[k:]
    if len(tail):
        began_ns = int(tail["t_ns"][0]) - round(float(tail["dt_s"][0]) * 1e9)
        if began_ns < t_ns:
            head, tail = np.concatenate([head, tail[:1]]), tail.copy()
            head["dt_s"][-1], tail["dt_s"][0] = (t_ns - began_ns) * 1e-9, (int(tail["t_ns"][0]) - t_ns) * 1e-9
            head["t_ns"][-1] = t_ns
            head["after_s"][-1] -= tail["dt_s"][0]
    return head, tail
