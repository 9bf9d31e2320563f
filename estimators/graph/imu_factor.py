"""The IMU factor of our own: a block between two keyframes; docs/conventions.md (62).

    r = (φ, p_j − p⁻, J_l(φ)⁻¹ R⁻ᵀ (v_j − v⁻), b_j − b_i)        φ = Log(R⁻ᵀ R_j), x⁻ = f(x_i) by the block

GTSAM's `CombinedImuFactor` has the position's residual in the axes of B at j as well. A keyframe that touches the
marginal prior is not linearised anew, so that after a large correction its residual stays large: in the axes of B, a
gap of 40 m turns with the attitude of j, and a depth known to 2 cm is taken for knowledge of roll and pitch. In W it
does not turn. Its covariance has the gyro noise on the IMU's lever arm in it, which GTSAM's has not.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled
from ...datasets.state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, VELOCITY, Array
from ..physics.imu import predict, process_noise
from ..physics.so3 import inverse_transform_into
from ..physics.state import STATE, VELOCITY_0
from ..physics.tie import inverse_jacobian, tie_residual
from ..stages import stage
from .gtsam_border import INTEGRATION_DENSITY, LEAST_WALK, by_gtsam, custom_factor, fill_state


@compiled
def linearise_tie(
    block: NDArray[Any], gravity: float, R_BI: Array, pose_i: Array, v_i: Array, bias_i: Array, pose_j: Array,
    v_j: Array, bias_j: Array,
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Residual (15,), and its Jacobians by pose, velocity and bias of i and of j, in GTSAM's tangents.

    With φ and ν the residual's rotation and velocity, and Q that of `mixed_jacobian_into`, r moves by J_r⁻¹ of SE_2(3)
    where x_j does, and by −J_l⁻¹ where x⁻ does.
    """
    x_i, x_j, end = np.empty(1, STATE), np.empty(1, STATE), np.empty(1, STATE)
    r, minus, F, L = np.empty(DIM), np.empty(DIM), np.empty((DIM, DIM)), np.empty((DIM, DIM))
    H_i, H_j = np.zeros((DIM, DIM)), np.empty((DIM, DIM))
    fill_state(pose_i, v_i, bias_i, R_BI, x_i)
    fill_state(pose_j, v_j, bias_j, R_BI, x_j)
    predict(block, x_i, gravity, F, end)
    tie_residual(end, x_j, r)
    for a in range(DIM):
        minus[a] = -r[a]
    inverse_jacobian(minus, x_j[0].R_WB[:], H_j)
    inverse_jacobian(r, end[0].R_WB[:], L)
    for a in range(DIM):
        for k in range(DIM):
            if L[a, k] != 0.0:
                for b in range(DIM):
                    H_i[a, b] -= L[a, k] * F[k, b]
    X_i, V_i, B_i = by_gtsam(DIM, H_i, pose_i, R_BI)
    X_j, V_j, B_j = by_gtsam(DIM, H_j, pose_j, R_BI)
    return r, X_i, V_i, B_i, X_j, V_j, B_j


@compiled
def to_axes(R_WB: Array, Q: Array) -> None:
    """Turn the velocity of a covariance Q (15, 15) from W into the axes of B."""
    row = np.empty(3)
    for _ in range(2):
        for j in range(DIM):
            inverse_transform_into(R_WB, Q[VELOCITY, j], row)
            for i in range(3):
                Q[VELOCITY_0 + i, j] = row[i]
        for i in range(DIM):
            for j in range(i):
                Q[i, j], Q[j, i] = Q[j, i], Q[i, j]


@stage("linearisation")
def imu_factor(i: int, j: int, block: NDArray[Any], R_i: Array, rig: NDArray[Any]) -> gtsam.CustomFactor:
    """Return the IMU factor of a block from keyframe i to j.

    Args:
        i, j: keyframes.
        block: BLOCK record from i to j; its motion is not empty.
        R_i: R_WB at keyframe i, where the covariance is evaluated.
        rig: RIG record.
    """
    g, Q = rig[0], np.empty((DIM, DIM))
    process_noise(block, R_i, Q)
    to_axes(R_i @ block["dR"][0], Q)
    T = float(block["T"][0])
    Q[POSITION, POSITION] += INTEGRATION_DENSITY**2 * T * np.eye(3)
    Q[ACCEL_BIAS, ACCEL_BIAS] = max(g["accel_walk"], LEAST_WALK * g["accel_density"]) ** 2 * T * np.eye(3)
    Q[GYRO_BIAS, GYRO_BIAS] = max(g["gyro_walk"], LEAST_WALK * g["gyro_density"]) ** 2 * T * np.eye(3)
    gravity, R_BI, kept = float(g["gravity"]), g["R_BI"].copy(), block.copy()

    keys = [X(i), V(i), B(i), X(j), V(j), B(j)]
    linearise = partial(linearise_tie, kept, gravity, R_BI)
    return custom_factor(gtsam.noiseModel.Gaussian.Covariance(Q), keys, linearise)
