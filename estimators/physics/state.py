"""The state in compiled code: its record, ⊕ and ⊖, and how a covariance follows its state into a new tangent.

The equations are docs/conventions.md (7) to (9).

A STATE record is a `NavState` with the covariance P of its error. Compiled code is given an array of length 1, for a
record taken out of an array does not keep it alive. What a record holds is handed on as a view, `s.P[:]`: without the
colon its type would be another, and the function compiled once more.

`NavState.retract` and `NavState.local` define ⊕ and ⊖; those here are the same, compiled.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import (
    ACCEL_BIAS,
    DIM,
    GYRO_BIAS,
    POSITION,
    THETA,
    VELOCITY,
    Array,
    Belief,
    NavState,
)
from .so3 import between_into, exp_into, log_into, product_into, right_jacobian_into

FIRST: list[Any] = [np.int64(part.start) for part in (THETA, POSITION, VELOCITY, ACCEL_BIAS, GYRO_BIAS)]
THETA_0, POSITION_0, VELOCITY_0, ACCEL_BIAS_0, GYRO_BIAS_0 = FIRST
"""Index of each part's first component in the error state, for loops: component i of the position's error is
`error[POSITION_0 + i]`. To numba a Python integer is a type of its own, and a function compiled once for each."""

STATE = np.dtype(
    [
        ("R_WB", "f8", (3, 3)),
        ("p_WB_W", "f8", (3,)),
        ("v_WB_W", "f8", (3,)),
        ("b_a", "f8", (3,)),
        ("b_g", "f8", (3,)),
        ("P", "f8", (DIM, DIM)),
    ]
)


def as_record(belief: Belief) -> NDArray[Any]:
    """Return the belief as one STATE record."""
    record, x = np.zeros(1, STATE), belief.state
    record["R_WB"], record["p_WB_W"], record["v_WB_W"] = x.R_WB, x.p_WB_W, x.v_WB_W
    record["b_a"], record["b_g"], record["P"] = x.b_a, x.b_g, belief.P
    return record


def as_belief(t_ns: int, record: NDArray[Any]) -> Belief:
    """Return one STATE record as a belief, copied."""
    s = record[0]
    state = NavState(*(s[name].copy() for name in ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g")))
    return Belief(t_ns, state, s["P"].copy())


def with_rate_noise(belief: Belief, rig: NDArray[Any]) -> Belief:
    """Return the belief with the rate noise of the IMU's lever arm in its velocity (see `imu`)."""
    R_WB, P = belief.state.R_WB, belief.P.copy()
    P[VELOCITY, VELOCITY] += R_WB @ rig["rate_cov"][0] @ R_WB.T
    return Belief(belief.t_ns, belief.state, P)


@compiled
def retract(state: NDArray[Any], error: Array, out: NDArray[Any]) -> None:
    """Fill out = state ⊕ error (15,) but for P; `out` may be the state itself."""
    s, o = state[0], out[0]
    turn, R_WB = np.empty((3, 3)), np.empty((3, 3))
    exp_into(error[THETA], turn)
    product_into(s.R_WB[:], turn, R_WB)
    for i in range(3):
        for j in range(3):
            o.R_WB[i, j] = R_WB[i, j]
        o.p_WB_W[i] = s.p_WB_W[i] + error[POSITION_0 + i]
        o.v_WB_W[i] = s.v_WB_W[i] + error[VELOCITY_0 + i]
        o.b_a[i] = s.b_a[i] + error[ACCEL_BIAS_0 + i]
        o.b_g[i] = s.b_g[i] + error[GYRO_BIAS_0 + i]


@compiled
def local(state: NDArray[Any], other: NDArray[Any], error: Array) -> None:
    """Fill the error (15,) with state ⊕ error = other."""
    s, o, turn = state[0], other[0], np.empty((3, 3))
    between_into(s.R_WB[:], o.R_WB[:], turn)
    log_into(turn, error[THETA])
    for i in range(3):
        error[POSITION_0 + i] = o.p_WB_W[i] - s.p_WB_W[i]
        error[VELOCITY_0 + i] = o.v_WB_W[i] - s.v_WB_W[i]
        error[ACCEL_BIAS_0 + i] = o.b_a[i] - s.b_a[i]
        error[GYRO_BIAS_0 + i] = o.b_g[i] - s.b_g[i]


@compiled
def inject(state: NDArray[Any], error: Array) -> None:
    """x ← x ⊕ error, and P ← the covariance of what is left of the error: theta ← J_r(error) (theta − error)."""
    J, P = np.empty((3, 3)), state[0].P[:]
    retract(state, error, state)
    right_jacobian_into(error[THETA], J)
    turn_covariance(P, J)
    symmetrise(P)


@inner
def turn_rows(F: Array, J: Array) -> None:
    """F (15, 15) ← diag(J, I) F: only the rows of theta change."""
    for j in range(DIM):
        x, y, z = F[0, j], F[1, j], F[2, j]
        for i in range(3):
            F[i, j] = J[i, 0] * x + J[i, 1] * y + J[i, 2] * z


@compiled
def turn_covariance(P: Array, J: Array) -> None:
    """P ← A P Aᵀ with A = diag(J, I): the covariance (15, 15) of an error whose theta is J times the one before."""
    turn_rows(P, J)
    for j in range(DIM):
        x, y, z = P[j, 0], P[j, 1], P[j, 2]
        for i in range(3):
            P[j, i] = J[i, 0] * x + J[i, 1] * y + J[i, 2] * z


@compiled
def symmetrise(P: Array) -> None:
    """Make P (15, 15) symmetric to the last bit."""
    for i in range(DIM):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
