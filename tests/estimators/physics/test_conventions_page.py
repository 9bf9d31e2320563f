"""The equations of docs/conventions.md, written out in numpy, are what the compiled code computes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fathom.datasets import ImuNoise, Mounting, Rig
from fathom.datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING, IMU_SAMPLE
from fathom.datasets.state import Array
from fathom.estimators.physics.dvl_preintegration import given_rotation, preintegrate_dvl
from fathom.estimators.physics.imu import (
    BLOCK,
    HELD_ACCEL,
    HELD_RATE,
    compile_rig,
    integrate,
    predict,
    process_noise,
)
from fathom.estimators.physics.measurements import tight_dvl_residual
from fathom.estimators.physics.state import STATE
from numpy.typing import NDArray
from paths import random_state, reading, residual
from scipy.spatial.transform import Rotation

NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, 1e-3, 1e-2)
I3 = np.eye(3)


def exp(phi: Array) -> Array:
    return Rotation.from_rotvec(phi).as_matrix()


def log(R: Array) -> Array:
    return Rotation.from_matrix(R).as_rotvec()


def skew(a: Array) -> Array:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def right_jacobian(phi: Array) -> Array:
    """(13)."""
    a = float(np.linalg.norm(phi))
    return I3 - (1 - np.cos(a)) / a**2 * skew(phi) + (a - np.sin(a)) / a**3 * skew(phi) @ skew(phi)


def samples(rng: np.random.Generator, n: int) -> NDArray[Any]:
    table = np.zeros(n, IMU_SAMPLE)
    table["dt_s"] = 0.01 * rng.uniform(0.5, 1.5, n)
    table["t_ns"] = np.rint(np.cumsum(table["dt_s"]) * 1e9)
    table["dt_s"] = np.diff(table["t_ns"], prepend=0) * 1e-9
    table["period_s"], table["held_s"][3:6] = 0.01, 0.03
    table["w_WI_I"], table["f_I"] = rng.normal(size=(n, 3)), 5 * rng.normal(size=(n, 3))
    table["alpha_I"], table["after_s"] = rng.normal(size=(n, 3)), rng.uniform(-0.1, 0.1, n)
    return table


def some_rig(rng: np.random.Generator) -> Rig:
    imu = Mounting(Rotation.random(random_state=rng.integers(99)).as_matrix(), rng.normal(size=3))
    return Rig(NOISE, imu=imu, latitude_deg=50.0)


@pytest.mark.parametrize("seed", range(3))
def test_the_imu_block_is_that_of_the_page(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, rows, before = some_rig(rng), samples(rng, 20), samples(rng, 1)
    b_a, b_g = 0.1 * rng.normal(size=(2, 3))
    record, block = compile_rig(rig, frozenset({"dvl"}), {}, True), np.zeros(1, BLOCK)
    integrate(rows, before, b_a, b_g, record, block)
    R_BI, arm = rig.imu.R_BS, rig.imu.p_BS_B

    w = [R_BI @ (row["w_WI_I"] - b_g) for row in (*before, *rows)]  # (21)
    f = [R_BI @ (row["f_I"] - b_a) for row in (*before, *rows)]
    w_i, w_j = (R_BI @ (row["w_WI_I"] + row["after_s"] * row["alpha_I"] - b_g) for row in (before[0], rows[-1]))
    dts = [*before["dt_s"], *rows["dt_s"]]
    R, v, p, T, middles = I3, np.zeros(3), np.zeros(3), 0.0, []
    for k in range(1, len(dts)):
        dt, x = dts[k], np.cross
        c = dt**3 / (6 * (dts[k - 1] + dt))  # (22)
        turn = dt * w[k] + c * x(w[k - 1], w[k])
        w_x_f = x(w[k], f[k])
        push = dt * f[k] + dt**2 / 2 * w_x_f + dt**3 / 6 * x(w[k], w_x_f)
        push = push + c * (x(w[k - 1], f[k]) + x(f[k - 1], w[k]))
        drift = dt**2 / 2 * f[k] + dt**3 / 6 * w_x_f + dt**4 / 24 * x(w[k], w_x_f)
        middles.append((T + dt / 2, R @ exp(turn / 2), v + R @ push / 2, p + dt / 2 * v + R @ drift / 4, dt))
        p, v, R, T = p + dt * v + R @ drift, v + R @ push, R @ exp(turn), T + dt  # (23)
    dv = v + np.cross(w_i, arm) - R @ np.cross(w_j, arm)  # (24)
    dp = p + np.cross(w_i, arm) * T + arm - R @ arm
    b = block[0]
    for name, value in (("dR", R), ("dv", dv), ("dp", dp)):
        np.testing.assert_allclose(b[name], value, rtol=0, atol=1e-12)

    v_end, p_end, N = v - R @ np.cross(w_j, arm), p - R @ arm, np.zeros((9, 9))
    R_bg, v_ba, p_ba, v_bg, p_bg = np.zeros((5, 3, 3))
    for (t, R_s, v_s, p_s, dt), gap in zip(middles, rows["held_s"], strict=True):
        u_, w_ = v_end - v_s, p_end - p_s - v_s * (T - t)  # (29)
        q = NOISE.gyro_density**2 * dt + HELD_RATE**2 * gap * dt  # (34)
        q_a = NOISE.accel_density**2 * dt + HELD_ACCEL**2 * gap * dt
        response = np.vstack([I3, -skew(w_), -skew(u_)])  # of (φ, Δp, Δv): N of (31) is the sum of its squares
        force = np.vstack([0 * I3, (T - t) * I3, I3])
        N += q * response @ response.T + q_a * force @ force.T
        R_bg -= R.T @ (dt * R_s @ R_BI)  # (30)
        v_ba, p_ba = v_ba - dt * R_s @ R_BI, p_ba - dt * (T - t) * R_s @ R_BI
        v_bg, p_bg = v_bg + dt * skew(u_) @ R_s @ R_BI, p_bg + dt * skew(w_) @ R_s @ R_BI
    v_bg, p_bg = v_bg + skew(arm) @ R_BI - R @ skew(arm) @ R_BI, p_bg + T * skew(arm) @ R_BI
    for name, value in (("R_bg", R_bg), ("v_ba", v_ba), ("p_ba", p_ba), ("v_bg", v_bg), ("p_bg", p_bg)):
        np.testing.assert_allclose(b[name], value, rtol=0, atol=1e-12)
    np.testing.assert_allclose(b["N"], N, rtol=0, atol=1e-12 * N.max())

    at_i, at_j, F, Q = np.zeros(1, STATE), np.zeros(1, STATE), np.empty((15, 15)), np.empty((15, 15))
    R_i, d_a, d_g = Rotation.random(random_state=seed).as_matrix(), np.full(3, 0.01), np.full(3, -0.02)
    p_i, v_i = 10 * rng.normal(size=3), rng.normal(size=3)
    for name, value in (("R_WB", R_i), ("p_WB_W", p_i), ("v_WB_W", v_i), ("b_a", b_a + d_a), ("b_g", b_g + d_g)):
        at_i[name] = value
    predict(block, at_i, rig.gravity, F, at_j)
    process_noise(block, R_i, Q)

    dR, dv, dp = R @ exp(R_bg @ d_g), dv + v_ba @ d_a + v_bg @ d_g, dp + p_ba @ d_a + p_bg @ d_g  # (26)
    W, g = rig.w_CW_W, np.array([0.0, 0.0, -rig.gravity])
    E, W_g, W_W_g = exp(-W * T), np.cross(W, g), np.cross(W, np.cross(W, g))
    g_1 = g * T + T**2 / 2 * W_g + T**3 / 6 * W_W_g  # (28)
    g_2 = T**2 / 2 * g + T**3 / 6 * W_g + T**4 / 24 * W_W_g
    u = v_i * T + g_2 + R_i @ dp  # (27)
    v_j = E @ (v_i + g_1 + R_i @ dv) - np.cross(W, E @ u)
    for name, value in (("R_WB", E @ R_i @ dR), ("p_WB_W", p_i + E @ u), ("v_WB_W", v_j)):
        np.testing.assert_allclose(at_j[name][0], value, rtol=0, atol=1e-12)

    zero = 0 * I3
    theta = np.hstack([dR.T, zero, zero, zero, right_jacobian(R_bg @ d_g) @ R_bg])  # (32)
    by_p = np.hstack([-R_i @ skew(dp), zero, T * I3, R_i @ p_ba, R_i @ p_bg])
    by_v = np.hstack([-R_i @ skew(dv), zero, I3, R_i @ v_ba, R_i @ v_bg])
    by_p = E @ by_p
    by_v = E @ by_v - skew(W) @ by_p
    by_p[:, 3:6] = I3
    np.testing.assert_allclose(F, np.vstack([theta, by_p, by_v, np.eye(15)[9:]]), rtol=0, atol=1e-12)
    G = np.zeros((9, 9))
    G[:3, :3], G[3:6, 3:6], G[6:, 6:] = R.T, R_i, R_i  # (33)
    np.testing.assert_allclose(Q[:9, :9], G @ N @ G.T, rtol=0, atol=1e-12 * N.max())
    np.testing.assert_allclose(Q.diagonal()[9:], np.repeat([NOISE.accel_walk**2 * T, NOISE.gyro_walk**2 * T], 3))


@pytest.mark.parametrize("seed", range(3))
def test_the_tight_displacement_is_that_of_the_page(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, rows, b_g = some_rig(rng), samples(rng, 20), 0.1 * rng.normal(size=3)
    record, sigma, S, v_B = (
        compile_rig(rig, frozenset({"dvl"}), {}),
        np.array([[0.02, 0.03, 0.01]]),
        np.array([0.004, 0.002, 0.001]),
        rng.normal(size=(1, 3)),
    )
    sums = preintegrate_dvl(rows, 0, np.zeros(1, np.int64), v_B, sigma, b_g, record, False, S)
    d, K = sums[0], given_rotation(sums[0]["N"])[0]

    R, dp, W_k, pieces = I3, np.zeros(3), np.zeros((3, 3)), []
    for row in rows:
        dt, w = row["dt_s"], rig.imu.R_BS @ (row["w_WI_I"] - b_g)
        R_s = R @ exp(dt / 2 * w)
        pieces.append(
            (dp + dt / 2 * R_s @ v_B[0], R_s, dt, NOISE.gyro_density**2 * dt + HELD_RATE**2 * row["held_s"] * dt)
        )
        dp, W_k, R = dp + dt * R_s @ v_B[0], W_k + dt * R_s, R @ exp(dt * w)  # (5)
    u = [dp - half for half, *_ in pieces]
    q = np.array([piece[3] for piece in pieces])
    N_pp = W_k @ np.diag(sigma[0] ** 2 + S * rows["dt_s"].sum() / 3) @ W_k.T + sum(
        q_ * (u_ @ u_ * I3 - np.outer(u_, u_)) for q_, u_ in zip(q, u, strict=True)
    )  # (18)
    N_phi_p = skew(q @ np.array(u))
    np.testing.assert_allclose(d["dp"], dp, rtol=0, atol=1e-12)
    np.testing.assert_allclose(d["N"][3:, 3:], N_pp, rtol=0, atol=1e-12 * N_pp.max())
    np.testing.assert_allclose(d["N"][:3, 3:], N_phi_p, rtol=0, atol=1e-12 * N_pp.max())
    np.testing.assert_allclose(K, -skew(q @ np.array(u) / q.sum()), rtol=0, atol=1e-10)  # (19)

    R_bg = -R.T @ sum(dt * R_s @ rig.imu.R_BS for _, R_s, dt, _ in pieces)
    p_bg = sum(dt * skew(u_) @ R_s @ rig.imu.R_BS for u_, (_, R_s, dt, _) in zip(u, pieces, strict=True))
    R_i, R_j = (Rotation.random(random_state=seed + k).as_matrix() for k in (0, 9))
    R_j, d_g = R_i @ R @ exp(0.1 * rng.normal(size=3)), 0.01 * rng.normal(size=3)
    p_i, p_j = rng.normal(size=(2, 3))
    H_i, H_j = np.empty((3, 15)), np.empty((3, 15))
    r = tight_dvl_residual(R_i, p_i, b_g + d_g, R_j, p_j, sums, K, H_i, H_j)
    dR = R @ exp(R_bg @ d_g)  # (20)
    r_R, moved = log(R_i.T @ R_j @ dR.T), R_i.T @ (p_j - p_i)
    np.testing.assert_allclose(r, moved - dp - p_bg @ d_g - K @ r_R, rtol=0, atol=1e-12)
    K_J, zero = K @ np.linalg.inv(right_jacobian(r_R)), 0 * I3
    H_theta = skew(moved) + K_J @ (R_i.T @ R_j @ dR.T).T
    H_g = K_J @ dR @ right_jacobian(R_bg @ d_g) @ R_bg - p_bg
    np.testing.assert_allclose(H_i, np.hstack([H_theta, -R_i.T, zero, zero, H_g]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(H_j, np.hstack([-K_J @ dR, R_i.T, zero, zero, zero]), rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_the_sensors_residuals_are_those_of_the_page(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mountings = {
        name: Mounting(Rotation.random(random_state=seed + k).as_matrix(), rng.normal(size=3))
        for k, name in enumerate(("depth", "gps", "heading"))
    }
    rig, x, zero = Rig(NOISE, **mountings), random_state(rng), np.zeros((3, 3))
    R, p, v, R_BH = x.R_WB, x.p_WB_W, x.v_WB_W, rig.heading.R_BS
    z, R_WH, sigma = rng.normal(size=3), R @ R_BH @ exp(0.3 * rng.normal(size=3)), np.array([0.1, 0.2, 0.3])

    depth = np.hstack([-(R @ skew(rig.depth.p_BS_B)), I3, zero, zero, zero])[2:]
    gps = np.hstack([-R @ skew(rig.gps.p_BS_B), I3, zero, zero, zero])
    r_attitude, v_B = log(R_BH @ R_WH.T @ R), R.T @ v
    attitude = np.hstack([np.linalg.inv(right_jacobian(r_attitude)), zero, zero, zero, zero])
    dvl = np.hstack([skew(v_B), zero, R.T, zero, zero])
    psi, theta, phi = Rotation.from_matrix(R @ R_BH).as_euler("ZYX")
    by_yaw = np.array([0.0, np.sin(phi) / np.cos(theta), np.cos(phi) / np.cos(theta)]) @ R_BH.T
    r_yaw = (psi - z[0] + np.pi) % (2 * np.pi) - np.pi
    for kind, reading_z, r, H in (
        (DEPTH, z[:1], (p + R @ rig.depth.p_BS_B - z[0])[2:], depth),  # (1)
        (GPS, z, p + R @ rig.gps.p_BS_B - z, gps),  # (2)
        (ATTITUDE, R_WH, r_attitude, attitude),  # (3)
        (DVL, z, v_B - z, dvl),  # (4)
        (HEADING, z[:1], [r_yaw], [[*by_yaw, *np.zeros(12)]]),  # (15)
    ):
        n = len(H)
        found_r, found_H, found_C = residual(reading(kind, reading_z, sigma[:n]), x, rig)
        np.testing.assert_allclose(found_r, r, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found_H, H, rtol=0, atol=1e-10)
        np.testing.assert_allclose(found_C, np.diag(sigma[:n] ** 2), rtol=0, atol=1e-15)  # (16)
