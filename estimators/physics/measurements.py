"""What each sensor says of the state: one residual and one Jacobian per sensor, for every estimator.

Every residual is h(x) ⊖ z, and H is its derivative by the error state (15) of `datasets.state`, exactly of what is
returned. Numbers in brackets are the equations of DESIGN, section 3.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit
from numpy.typing import NDArray

from ...datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING
from ...datasets.state import GYRO_BIAS, POSITION, THETA, VELOCITY, Array
from .so3 import (
    exp,
    inverse_right_jacobian,
    inverse_transform,
    log,
    product,
    right_jacobian,
    skew,
    transform,
    wrap,
    yaw_of,
)


@njit(cache=True)
def depth_residual(R_WB: Array, p_WB_W: Array, p_BP_B: Array, z_m: float, H: Array) -> float:
    """r(x) = (p_WB_W + R_WB p_BP_B) · e_z − z_m                                    [eq. 1]

    Returns r (m) and fills H (1, 15).
    """
    H[:] = 0.0
    H[0, 0] = -R_WB[2, 1] * p_BP_B[2] + R_WB[2, 2] * p_BP_B[1]  # −(R_WB [p_BP_B]×), its last row
    H[0, 1] = R_WB[2, 0] * p_BP_B[2] - R_WB[2, 2] * p_BP_B[0]
    H[0, 2] = -R_WB[2, 0] * p_BP_B[1] + R_WB[2, 1] * p_BP_B[0]
    H[0, 5] = 1.0
    return p_WB_W[2] + R_WB[2, 0] * p_BP_B[0] + R_WB[2, 1] * p_BP_B[1] + R_WB[2, 2] * p_BP_B[2] - z_m


@njit(cache=True)
def gps_residual(R_WB: Array, p_WB_W: Array, p_BG_B: Array, p_WG_W: Array, H: Array) -> Array:
    """r(x) = p_WB_W + R_WB p_BG_B − p_WG_W                                         [eq. 2]

    Returns r (3,) m and fills H (3, 15).
    """
    H[:] = 0.0
    H[:, THETA] = -product(R_WB, skew(p_BG_B))
    H[0, 3] = H[1, 4] = H[2, 5] = 1.0
    return p_WB_W + transform(R_WB, p_BG_B) - p_WG_W


@njit(cache=True)
def attitude_residual(R_WB: Array, R_BH: Array, R_WH: Array, H: Array) -> Array:
    """r(x) = Log((R_WH R_BH⁻¹)⁻¹ R_WB)                                             [eq. 3]

    For a sensor that gives a full attitude R_WH. Returns r (3,) rad, in B, and fills H (3, 15).
    """
    r = log(product(product(R_BH, R_WH.T), R_WB))
    H[:] = 0.0
    H[:, THETA] = inverse_right_jacobian(r)
    return r


@njit(cache=True)
def yaw_residual(R_WB: Array, R_BH: Array, yaw_rad: float, H: Array) -> float:
    """r(x) = yaw(R_WB R_BH) − yaw_rad, wrapped                                     [the heading-only form of eq. 3]

    By the heading sensor's own rotation its derivative is (0, sin φ / cos θ, cos φ / cos θ), with φ, θ its roll and
    pitch. Within 2° of its x axis being vertical a yaw says nothing: r and H are zero there. Returns r (rad) and fills
    H (1, 15).
    """
    R_WH = product(R_WB, R_BH)
    # cos θ sin φ = R[2,1], cos θ cos φ = R[2,2], and cos² θ = R[0,0]² + R[1,0]²
    cos2 = R_WH[0, 0] ** 2 + R_WH[1, 0] ** 2
    H[:] = 0.0
    if cos2 < 1e-3:
        return 0.0
    for i in range(3):
        H[0, i] = (R_BH[i, 1] * R_WH[2, 1] + R_BH[i, 2] * R_WH[2, 2]) / cos2
    return wrap(yaw_of(R_WH) - yaw_rad)


@njit(cache=True)
def dvl_residual(R_WB: Array, v_WB_W: Array, v_WB_B: Array, H: Array) -> Array:
    """r(x) = R_WBᵀ v_WB_W − v_WB_B                                                 [eq. 4]

    Returns r (3,) m/s and fills H (3, 15).
    """
    predicted = inverse_transform(R_WB, v_WB_W)
    H[:] = 0.0
    H[:, THETA] = skew(predicted)
    H[:, VELOCITY] = R_WB.T
    return predicted - v_WB_B


@njit(cache=True)
def preintegrated_dvl_residual(R_i: Array, p_i: Array, p_j: Array, dp_ij: Array, H_i: Array, H_j: Array) -> Array:
    """r(x_i, x_j) = R_iᵀ (p_j − p_i) − Δp̃_ij                                       [eq. 6]

    Returns r (3,) m and fills H_i and H_j, both (3, 15).
    """
    moved = inverse_transform(R_i, p_j - p_i)
    H_i[:], H_j[:] = 0.0, 0.0
    H_i[:, THETA] = skew(moved)
    H_i[:, POSITION] = -R_i.T
    H_j[:, POSITION] = R_i.T
    return moved - dp_ij


@njit(cache=True)
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

        r_p = R_iᵀ (p_j − p_i) − Δp̃(b_g)         r_R = Log(R_iᵀ R_j ΔR̃(b_g)ᵀ)         [eq. 6, given the rotation]

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
    d_g = b_g - d.b_g
    phi = transform(d.R_bg, d_g)
    dR = product(d.dR, exp(phi))
    r_p = preintegrated_dvl_residual(R_i, p_i, p_j, d.dp + transform(d.p_bg, d_g), H_i, H_j)
    missed = product(product(R_i.T, R_j), dR.T)
    r_R = log(missed)
    K_J = product(K, inverse_right_jacobian(r_R))
    H_j[:, THETA] = -product(K_J, dR)
    H_i[:, THETA] += product(K_J, missed.T)
    H_i[:, GYRO_BIAS] = product(product(K_J, dR), product(right_jacobian(phi), d.R_bg)) - d.p_bg
    return r_p - transform(K, r_R)


@njit(cache=True)
def measure(
    readings: NDArray[Any], m: int, state: NDArray[Any], rig: NDArray[Any], r: Array, H: Array, C: Array
) -> int:
    """Residual of any reading, without the components that it does not measure.

    Args:
        readings: READING rows, of which the one at m is meant.
        state, rig: STATE and RIG records of length 1. (A record taken out of an array does not keep it alive, so
            compiled code hands on arrays.)
        r, H, C: (3,), (3, 15), (3, 3); the first n rows are filled. C is the covariance of the reading, inflated as the
            rig says; a velocity's has the rate noise of the lever arm in it.

    Returns:
        n, how many rows there are; 0 for a sensor that is switched off.
    """
    reading, s, g = readings[m], state[0], rig[0]
    kind, R_WB, p_WB_W = reading.kind, s.R_WB, s.p_WB_W
    width = 3
    if kind == DVL:
        r[:] = dvl_residual(R_WB, s.v_WB_W, reading.z[0:3], H)
    elif kind == DEPTH:
        width = 1
        r[0] = depth_residual(R_WB, p_WB_W, g.p_BP_B, reading.z[0], H)
    elif kind == GPS:
        r[:] = gps_residual(R_WB, p_WB_W, g.p_BG_B, reading.z[0:3], H)
    elif kind == HEADING:
        width = 1
        r[0] = yaw_residual(R_WB, g.R_BH, reading.z[0], H)
    elif kind == ATTITUDE:
        r[:] = attitude_residual(R_WB, g.R_BH, reading.z.reshape(3, 3), H)
    else:
        width = 0
    C[:] = 0.0
    if kind == DVL:
        C[:] = g.rate_cov
    n = 0
    for i in range(width):
        spread = reading.sigma[i] * g.inflate[kind]
        if not math.isinf(spread):
            r[n], H[n] = r[i], H[i]
            C[n, :] = C[i, :]
            C[:, n] = C[:, i].copy()
            C[n, n] += spread**2
            n += 1
    return n


@njit(cache=True)
def decorrelate(n: int, r: Array, H: Array, C: Array) -> None:
    """Subtract from each of the first n rows what the rows before it say of its error: C becomes diagonal (L D Lᵀ)."""
    for k in range(n):
        for i in range(k + 1, n):
            if C[i, k] != 0.0:
                share = C[i, k] / C[k, k]
                r[i] -= share * r[k]
                for j in range(15):
                    H[i, j] -= share * H[k, j]
                for j in range(k + 1, n):
                    C[i, j] -= share * C[k, j]
                C[i, k] = 0.0
