"""What a state lacks of the prediction by an IMU block, and its derivatives; docs/conventions.md (62).

Rotation and velocity are one element of SE_2(3), less its position, and their residual is its logarithm.

Source: Barfoot & Furgale 2014, doi:10.1109/TRO.2014.2298059, eq. (102), for the lower block of the left Jacobian.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import THETA, VELOCITY, Array
from .blocks import identity, set_block, set_product
from .so3 import inverse_right_jacobian_into, inverse_transform_into, product_into, skew_into
from .state import THETA_0, VELOCITY_0, local


@compiled
def tie_residual(predicted: NDArray[Any], state: NDArray[Any], r: Array) -> None:
    """Fill r (15,), what a state lacks of the prediction by a block: docs/conventions.md (62).

        r = (φ, p − p⁻, J_l(φ)⁻¹ R⁻ᵀ (v − v⁻), b − b⁻),        φ = Log(R⁻ᵀ R)

    Rotation and velocity are the logarithm of SE_2(3), so that nothing is learnt of the attitude where both turn
    together. Position is left in W: in the axes of B, a gap of 40 m would turn with the attitude, and a depth that is
    known to 2 cm would be taken for knowledge of roll and pitch.
    """
    J, gap, turned = np.empty((3, 3)), np.empty(3), np.empty(3)
    local(predicted, state, r)
    for i in range(3):
        gap[i] = r[VELOCITY_0 + i]
    inverse_transform_into(predicted[0].R_WB[:], gap, turned)
    inverse_right_jacobian_into(r[THETA], J)  # J_l⁻¹ is its transpose
    inverse_transform_into(J, turned, r[VELOCITY])


@compiled
def inverse_jacobian(r: Array, R_WB: Array, out: Array) -> None:
    """Fill `out` (15, 15) with J_l⁻¹(r) of SE_2(3), by our error state at R_WB; position and biases stay as they are.

    J_r⁻¹ is that of −r.
    """
    matrices = np.empty((6, 3, 3))
    J, Q, QJ = matrices[0], matrices[1], matrices[2]
    minus = np.empty(3)
    for i in range(3):
        minus[i] = -r[i]
    inverse_right_jacobian_into(minus, J)
    mixed_jacobian_into(r[THETA], r[VELOCITY], Q, matrices[3:6])
    product_into(Q, J, QJ)
    identity(out)
    set_block(out, THETA_0, THETA_0, 1.0, J)
    set_product(out, VELOCITY_0, THETA_0, -1.0, J, QJ)
    for i in range(3):
        for j in range(3):
            out[VELOCITY_0 + i, VELOCITY_0 + j] = J[i, 0] * R_WB[j, 0] + J[i, 1] * R_WB[j, 1] + J[i, 2] * R_WB[j, 2]


@inner
def mixed_jacobian_into(phi: Array, nu: Array, Q: Array, scratch: Array) -> None:
    """Fill Q (3, 3), the lower block of SE(3)'s left Jacobian; Barfoot & Furgale 2014, eq. (102).

    Q = N/2 + c₁ (ΦN + NΦ + ΦNΦ) + c₂ (ΦΦN + NΦΦ − 3 ΦNΦ) + c₃ (ΦNΦΦ + ΦΦNΦ), with Φ = [phi]× and N = [nu]×.
    """
    a2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    c1 = 1.0 / 6.0 - a2 / 120.0 + a2**2 / 5040.0
    c2 = 1.0 / 24.0 - a2 / 720.0 + a2**2 / 40320.0
    c3 = 1.0 / 120.0 - a2 / 2520.0
    if a2 >= 1e-2:  # below, the closed forms would lose digits by cancellation
        a = math.sqrt(a2)
        sine, cosine = math.sin(a), math.cos(a)
        c1 = (a - sine) / (a * a2)
        c2 = (a2 + 2.0 * cosine - 2.0) / (2.0 * a2**2)
        c3 = (2.0 * a - 3.0 * sine + a * cosine) / (2.0 * a2**2 * a)
    Phi, N, PN = scratch[0], scratch[1], scratch[2]
    skew_into(phi, Phi)
    skew_into(nu, N)
    along = phi[0] * nu[0] + phi[1] * nu[1] + phi[2] * nu[2]
    product_into(Phi, N, PN)
    for i in range(3):
        for j in range(3):
            twice = PPN = NPP = 0.0  # ΦΦ, ΦΦN, NΦΦ = −(ΦΦN)ᵀ; ΦNΦ = −(phi·nu) Φ
            for k in range(3):
                twice += Phi[i, k] * Phi[k, j]
                PPN += Phi[i, k] * PN[k, j]
                NPP -= Phi[j, k] * PN[k, i]
            Q[i, j] = 0.5 * N[i, j] + c1 * (PN[i, j] + PN[j, i] - along * Phi[i, j])
            Q[i, j] += c2 * (PPN + NPP + 3.0 * along * Phi[i, j]) - 2.0 * c3 * along * twice
