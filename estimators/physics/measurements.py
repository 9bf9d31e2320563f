"""What each sensor says of the state: one residual and one Jacobian per sensor, for every estimator.

Every residual is h(x) ⊖ z, and H is its derivative by the error state (15) of `datasets.state`, exactly of what is
filled in.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING
from ...datasets.state import Array
from .blocks import TOP, clear, set_block, set_product
from .so3 import (
    between,
    exp,
    inverse_right_jacobian,
    inverse_right_jacobian_into,
    inverse_transform_into,
    log,
    log_into,
    product,
    product_into,
    right_jacobian,
    skew_into,
    transform_into,
    wrap,
    yaw_of,
)
from .state import GYRO_BIAS_0, POSITION_0, THETA_0, VELOCITY_0


@inner
def position_residual(R_WB: Array, p_WB_W: Array, p_BS_B: Array, p_WS_W: Array, r: Array, H: Array) -> None:
    """r(x) = p_WB_W + R_WB p_BS_B − p_WS_W                                         [docs/conventions.md (2)]

    For a sensor S at a lever arm: a GPS antenna. Fills r (3,) m and H (3, 15).
    """
    S = np.empty((3, 3))
    skew_into(p_BS_B, S)
    clear(H)
    set_product(H, TOP, THETA_0, -1.0, R_WB, S)
    transform_into(R_WB, p_BS_B, r)
    for i in range(3):
        H[i, POSITION_0 + i] = 1.0
        r[i] += p_WB_W[i] - p_WS_W[i]


@inner
def depth_residual(R_WB: Array, p_WB_W: Array, p_BP_B: Array, z_m: float, r: Array, H: Array) -> None:
    """r(x) = (p_WB_W + R_WB p_BP_B) · e_z − z_m                                    [docs/conventions.md (1)]

    Fills row 0 of r, m, and of H: the last one of `position_residual`.
    """
    clear(H)
    r[0] = p_WB_W[2] - z_m
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        H[0, THETA_0 + i] = R_WB[2, k] * p_BP_B[j] - R_WB[2, j] * p_BP_B[k]  # −(R_WB [p_BP_B]×), its last row
        r[0] += R_WB[2, i] * p_BP_B[i]
    H[0, POSITION_0 + 2] = 1.0


@inner
def attitude_residual(R_WB: Array, R_BH: Array, R_WH: Array, r: Array, H: Array) -> None:
    """r(x) = Log((R_WH R_BH⁻¹)⁻¹ R_WB)                                             [docs/conventions.md (3)]

    For a sensor that gives a full attitude R_WH (9,), by rows. Fills r (3,) rad, in B, and H (3, 15).
    """
    missed, R_HB = np.empty((3, 3)), np.empty((3, 3))  # R_HB: by the sensor's attitude and the state's
    for i in range(3):
        for j in range(3):
            R_HB[i, j] = R_WH[i] * R_WB[0, j] + R_WH[3 + i] * R_WB[1, j] + R_WH[6 + i] * R_WB[2, j]
    product_into(R_BH, R_HB, missed)
    log_into(missed, r)
    clear(H)
    inverse_right_jacobian_into(r, R_HB)
    set_block(H, TOP, THETA_0, 1.0, R_HB)


@inner
def yaw_residual(R_WB: Array, R_BH: Array, yaw_rad: float, r: Array, H: Array) -> None:
    """r(x) = yaw(R_WB R_BH) − yaw_rad, wrapped                                     [docs/conventions.md (15)]

    By the heading sensor's own rotation its derivative is (0, sin φ / cos θ, cos φ / cos θ), with φ, θ its roll and
    pitch. Within 2° of its x axis being vertical a yaw says nothing: r and H are zero there. Fills row 0 of r, rad, and
    of H.
    """
    R_WH = np.empty((3, 3))
    product_into(R_WB, R_BH, R_WH)
    # cos θ sin φ = R[2,1], cos θ cos φ = R[2,2], and cos² θ = R[0,0]² + R[1,0]²
    cos2 = R_WH[0, 0] ** 2 + R_WH[1, 0] ** 2
    clear(H)
    r[0] = 0.0
    if cos2 >= 1e-3:
        for i in range(3):
            H[0, THETA_0 + i] = (R_BH[i, 1] * R_WH[2, 1] + R_BH[i, 2] * R_WH[2, 2]) / cos2
        r[0] = wrap(yaw_of(R_WH) - yaw_rad)


@inner
def dvl_residual(R_WB: Array, v_WB_W: Array, v_WB_B: Array, r: Array, H: Array) -> None:
    """r(x) = R_WBᵀ v_WB_W − v_WB_B                                                 [docs/conventions.md (4)]

    Fills r (3,) m/s and H (3, 15).
    """
    inverse_transform_into(R_WB, v_WB_W, r)
    clear(H)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        H[k, THETA_0 + j], H[j, THETA_0 + k] = r[i], -r[i]  # [R_WBᵀ v_WB_W]×
        for m in range(3):
            H[i, VELOCITY_0 + m] = R_WB[m, i]
    for i in range(3):
        r[i] -= v_WB_B[i]


@compiled
def preintegrated_dvl_residual(R_i: Array, p_i: Array, p_j: Array, dp_ij: Array, H_i: Array, H_j: Array) -> Array:
    """r(x_i, x_j) = R_iᵀ (p_j − p_i) − Δp̃_ij                                       [docs/conventions.md (6)]

    Returns r (3,) m and fills H_i and H_j, both (3, 15).
    """
    r, p_ij_W, S = np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(3):
        p_ij_W[i] = p_j[i] - p_i[i]
    inverse_transform_into(R_i, p_ij_W, r)
    skew_into(r, S)
    clear(H_i)
    clear(H_j)
    set_block(H_i, TOP, THETA_0, 1.0, S)
    for i in range(3):
        r[i] -= dp_ij[i]
        for j in range(3):
            H_i[i, POSITION_0 + j] = -R_i[j, i]
            H_j[i, POSITION_0 + j] = R_i[j, i]
    return r


@compiled
def tight_dvl_residual(
    R_i: Array,
    p_i: Array,
    b_g: Array,
    R_j: Array,
    p_j: Array,
    displacement: NDArray[Any],
    K: Array,
    H_i: Array,
    H_j: Array,
) -> Array:
    """r(x_i, b_i, x_j) = r_p − K r_R: the displacement's residual, less what the rotation's says of it.

        r_p = R_iᵀ (p_j − p_i) − Δp̃(b_g)         r_R = Log(R_iᵀ R_j ΔR̃(b_g)ᵀ)         [docs/conventions.md (20)]

    Args:
        R_i, p_i, b_g: pose and gyro bias of keyframe i.
        R_j, p_j: pose of keyframe j.
        displacement: DISPLACEMENT record of length 1.
        K: (3, 3) m/rad, of `given_rotation`.
        H_i, H_j: (3, 15), filled.

    Returns:
        r (3,) m.
    """
    d = displacement[0]
    dp, phi, d_g, moved = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(3):
        d_g[i] = b_g[i] - d.b_g[i]
    transform_into(d.R_bg[:], d_g, phi)
    transform_into(d.p_bg[:], d_g, dp)
    for i in range(3):
        dp[i] += d.dp[i]
    dR = product(d.dR[:], exp(phi))
    r = preintegrated_dvl_residual(R_i, p_i, p_j, dp, H_i, H_j)
    R_ij = between(R_i, R_j)
    missed = np.empty((3, 3))  # R_ij ΔRᵀ
    for i in range(3):
        for j in range(3):
            missed[i, j] = R_ij[i, 0] * dR[j, 0] + R_ij[i, 1] * dR[j, 1] + R_ij[i, 2] * dR[j, 2]
    r_R = log(missed)
    K_J = product(K, inverse_right_jacobian(r_R))
    K_J_dR = product(K_J, dR)
    set_block(H_j, TOP, THETA_0, -1.0, K_J_dR)
    product_into(right_jacobian(phi), d.R_bg[:], moved)
    set_product(H_i, TOP, GYRO_BIAS_0, 1.0, K_J_dR, moved)
    for i in range(3):
        for j in range(3):
            H_i[i, GYRO_BIAS_0 + j] -= d.p_bg[i, j]
            r[i] -= K[i, j] * r_R[j]
            for k in range(3):
                H_i[i, THETA_0 + j] += K_J[i, k] * missed[j, k]
    return r


@compiled
def measure(
    readings: NDArray[Any], m: int, state: NDArray[Any], rig: NDArray[Any], r: Array, H: Array, C: Array
) -> int:
    """Residual of any reading, without the components that it does not measure.

    Args:
        readings: READING rows, of which the one at m is meant.
        state, rig: STATE and RIG records of length 1.
        r, H, C: (3,), (3, 15), (3, 3); the first n rows are filled. C is the covariance of the reading, inflated as the
            rig says; a velocity's has the rate noise of the lever arm in it.

    Returns:
        n, how many rows there are; 0 for a sensor that is switched off.

    Raises:
        ValueError: the reading is of no kind that there is.
    """
    reading, s, g = readings[m], state[0], rig[0]
    kind, R_WB, z = reading.kind, s.R_WB[:], reading.z[:]
    width = 3
    if kind == DVL:
        dvl_residual(R_WB, s.v_WB_W[:], z, r, H)
    elif kind == DEPTH:
        width = 1
        depth_residual(R_WB, s.p_WB_W[:], g.p_BP_B[:], z[0], r, H)
    elif kind == GPS:
        position_residual(R_WB, s.p_WB_W[:], g.p_BG_B[:], z, r, H)
    elif kind == HEADING:
        width = 1
        yaw_residual(R_WB, g.R_BH[:], z[0], r, H)
    elif kind == ATTITUDE:
        attitude_residual(R_WB, g.R_BH[:], z, r, H)
    else:
        raise ValueError("a reading of an unknown kind")
    n = 0  # rows that are measured; row i becomes row n
    for i in range(width):
        spread = reading.sigma[i] * g.inflate[kind]
        if math.isinf(spread):
            continue
        r[n] = r[i]
        for j in range(H.shape[1]):
            H[n, j] = H[i, j]
        row = 0
        for j in range(i + 1):
            if j == i or not math.isinf(reading.sigma[j] * g.inflate[kind]):
                C[n, row] = C[row, n] = g.rate_cov[i, j] if kind == DVL else 0.0
                row += 1
        C[n, n] += spread * spread
        n += 1
    return n
