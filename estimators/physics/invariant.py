"""The invariant error of rotation and velocity, beside an additive one of position and biases.

    R_true = Exp(phi) R        v_true = Exp(phi) v + J_l(phi) nu        p_true = p + e_p        b_true = b + e_b

It is docs/conventions.md (39) to (41). A velocity that is known in B, at a heading that is not, is an error nu that
does not depend on phi; one that is known in W is v + s for any phi, with nu = s + v × phi. So a density that is normal
in these coordinates stays true however far the heading is off.

Source: Barrau & Bonnabel 2017, doi:10.1109/TAC.2016.2594085, for the group; Barfoot & Furgale 2014,
doi:10.1109/TRO.2014.2298059, eq. (102), for the lower block of its left Jacobian.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import DIM, THETA, VELOCITY, Array
from .blocks import clear, identity, rows_times, set_block, set_product
from .imu import sandwich
from .so3 import (
    between_into,
    cross_into,
    exp_into,
    inverse_right_jacobian_into,
    inverse_transform_into,
    log_into,
    product_into,
    right_jacobian_into,
    skew_into,
    transform_into,
)
from .state import ACCEL_BIAS_0, GYRO_BIAS_0, POSITION_0, THETA_0, VELOCITY_0, symmetrise
from .tie import inverse_jacobian, mixed_jacobian_into

PHI, NU = THETA, VELOCITY
PHI_0, NU_0 = THETA_0, VELOCITY_0
"""The invariant error stands in the order of ours."""


@compiled
def to_invariant(R_WB: Array, v_WB_W: Array) -> Array:
    """Derivative (15, 15) of (phi, e_p, nu, biases) by our error state."""
    A, S = np.empty((DIM, DIM)), np.empty((3, 3))
    identity(A)
    set_block(A, PHI_0, THETA_0, 1.0, R_WB)
    skew_into(v_WB_W, S)
    set_product(A, NU_0, THETA_0, 1.0, S, R_WB)
    return A


@compiled
def from_invariant(R_WB: Array, v_WB_W: Array) -> Array:
    """Inverse of `to_invariant`: theta = Rᵀ phi, e_v = nu − v × phi."""
    A, S = np.empty((DIM, DIM)), np.empty((3, 3))
    identity(A)
    for i in range(3):
        for j in range(3):
            A[THETA_0 + i, PHI_0 + j] = R_WB[j, i]
    skew_into(v_WB_W, S)
    set_block(A, VELOCITY_0, PHI_0, -1.0, S)
    return A


@inner
def left_jacobian_into(phi: Array, out: Array) -> None:
    """J_l(phi) = J_r(−phi) into `out` (3, 3)."""
    minus = np.empty(3)
    for i in range(3):
        minus[i] = -phi[i]
    right_jacobian_into(minus, out)


@compiled
def retract_invariant(state: NDArray[Any], xi: Array, out: NDArray[Any]) -> None:
    """Fill out = Exp(xi) state but for P, xi being the invariant error (15,); `out` may be the state itself."""
    s, o = state[0], out[0]
    matrices, v, gained = np.empty((3, 3, 3)), np.empty(3), np.empty(3)
    turn, J_l, R_WB = matrices[0], matrices[1], matrices[2]
    exp_into(xi[PHI], turn)
    left_jacobian_into(xi[PHI], J_l)
    product_into(turn, s.R_WB[:], R_WB)
    transform_into(turn, s.v_WB_W[:], v)
    transform_into(J_l, xi[NU], gained)
    for i in range(3):
        for j in range(3):
            o.R_WB[i, j] = R_WB[i, j]
        o.p_WB_W[i] = s.p_WB_W[i] + xi[POSITION_0 + i]
        o.v_WB_W[i] = v[i] + gained[i]
        o.b_a[i] = s.b_a[i] + xi[ACCEL_BIAS_0 + i]
        o.b_g[i] = s.b_g[i] + xi[GYRO_BIAS_0 + i]


@inner
def as_invariant(state: NDArray[Any], error: Array, xi: Array) -> None:
    """Fill xi (15,) = `to_invariant` · error, at the state."""
    s, gained = state[0], np.empty(3)
    for i in range(DIM):
        xi[i] = error[i]
    transform_into(s.R_WB[:], error[THETA], xi[PHI])
    cross_into(s.v_WB_W[:], xi[PHI], gained)
    for i in range(3):
        xi[NU_0 + i] += gained[i]


@compiled
def move(state: NDArray[Any], error: Array, out: NDArray[Any]) -> None:
    """Fill `out`, but for P, with the state moved by our error (15,) as an invariant one; `out` may be the state."""
    xi = np.empty(DIM)
    as_invariant(state, error, xi)
    retract_invariant(state, xi, out)


@compiled
def inject_moved(state: NDArray[Any], error: Array) -> None:
    """`move` the state by an error (15,), and carry P, of our error, to where it is then, to second order."""
    xi, K, P = np.empty(DIM), np.empty((DIM, DIM)), state[0].P[:]
    A = to_invariant(state[0].R_WB[:], state[0].v_WB_W[:])
    as_invariant(state, error, xi)
    retract_invariant(state, xi, state)
    error_after_invariant(state, xi, K)
    congruent(A, P)
    congruent(K, P)
    spread_velocity(P, state[0].R_WB[:])


@compiled
def congruent(A: Array, P: Array) -> None:
    """P ← A P Aᵀ, for an A of this module: all but rows of rotation and velocity are the identity's."""
    AP = np.empty((DIM, DIM))
    for _ in range(2):  # P ← (A P)ᵀ, twice
        for i in range(DIM):
            for j in range(DIM):
                AP[i, j] = P[i, j]
        for first in (THETA_0, VELOCITY_0):
            for i in range(first, first + 3):
                for j in range(DIM):
                    total = 0.0
                    for k in range(3):
                        total += A[i, THETA_0 + k] * P[THETA_0 + k, j] + A[i, VELOCITY_0 + k] * P[VELOCITY_0 + k, j]
                    AP[i, j] = total
        for i in range(DIM):
            for j in range(DIM):
                P[j, i] = AP[i, j]
    symmetrise(P)


@compiled
def spread_velocity(P: Array, R_WB: Array) -> None:
    """Add to P (15, 15), of our error, the second order in which an invariant error moves the velocity: (66).

    With phi = R theta, v_true − v = e + ½ phi × e + …, where e = nu − v × phi is the first order. At a heading that is
    known to 25° a velocity that is known in B lies on an arc, and leaves its chord e by 10 % of itself; one that is
    known in W does not. As phi and e are normal, by Isserlis' theorem

        E[(phi × e)ᵢ (phi × e)ⱼ] = εᵢₐᵦ εⱼ꜀ₔ (Xₐᵦ X꜀ₔ + Σₐ꜀ Eᵦₔ + Xₐₔ X꜀ᵦ),     Σ, E, X the covariances of phi, e, both.
    """
    S, X, E = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            X[i, j], E[i, j] = 0.0, P[VELOCITY_0 + i, VELOCITY_0 + j]
            S[i, j] = 0.0
            for k in range(3):
                X[i, j] += R_WB[i, k] * P[THETA_0 + k, VELOCITY_0 + j]
                for m in range(3):
                    S[i, j] += R_WB[i, k] * P[THETA_0 + k, THETA_0 + m] * R_WB[j, m]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            moment = (X[a, b] - X[b, a]) * (X[c, d] - X[d, c])
            moment += S[a, c] * E[b, d] - S[a, d] * E[b, c] - S[b, c] * E[a, d] + S[b, d] * E[a, c]
            moment += X[a, d] * X[c, b] - X[a, c] * X[d, b] - X[b, d] * X[c, a] + X[b, c] * X[d, a]
            P[VELOCITY_0 + i, VELOCITY_0 + j] += 0.25 * moment


@compiled
def local_invariant(state: NDArray[Any], other: NDArray[Any], xi: Array) -> None:
    """Fill xi (15,) with Exp(xi) state = other."""
    s, o, matrices, v = state[0], other[0], np.empty((3, 3, 3)), np.empty(3)
    turn, J, R_WB = matrices[0], matrices[1], matrices[2]
    for i in range(3):
        for j in range(3):
            R_WB[i, j] = s.R_WB[j, i]
    product_into(o.R_WB[:], R_WB, turn)
    log_into(turn, xi[PHI])
    transform_into(turn, s.v_WB_W[:], v)
    for i in range(3):
        xi[POSITION_0 + i] = o.p_WB_W[i] - s.p_WB_W[i]
        xi[ACCEL_BIAS_0 + i] = o.b_a[i] - s.b_a[i]
        xi[GYRO_BIAS_0 + i] = o.b_g[i] - s.b_g[i]
        v[i] = o.v_WB_W[i] - v[i]
    inverse_right_jacobian_into(xi[PHI], J)  # J_l⁻¹ is its transpose
    inverse_transform_into(J, v, xi[NU])


@compiled
def error_after_invariant(state: NDArray[Any], xi: Array, K: Array) -> None:
    """Fill K (15, 15): the derivative of our error state by xi, at `state` = Exp(xi) of where xi is counted from.

    With Q of Barfoot & Furgale, theta = Rᵀ J_l dphi and e_v = J_l dnu + (Q − [v]× J_l) dphi; the other components are
    their own.
    """
    s, matrices = state[0], np.empty((7, 3, 3))
    J_l, Q, S, R_BW = matrices[0], matrices[1], matrices[2], matrices[3]
    left_jacobian_into(xi[PHI], J_l)
    mixed_jacobian_into(xi[PHI], xi[NU], Q, matrices[4:7])
    for i in range(3):
        for j in range(3):
            R_BW[i, j] = s.R_WB[j, i]
    identity(K)
    set_product(K, THETA_0, PHI_0, 1.0, R_BW, J_l)
    skew_into(s.v_WB_W[:], S)
    set_product(K, VELOCITY_0, PHI_0, -1.0, S, J_l)
    for i in range(3):
        for j in range(3):
            K[VELOCITY_0 + i, PHI_0 + j] += Q[i, j]
            K[VELOCITY_0 + i, NU_0 + j] = J_l[i, j]


@compiled
def invariant_after_error(state: NDArray[Any], xi: Array, H: Array) -> None:
    """Fill H (15, 15), the inverse of `error_after_invariant`: the derivative of xi by our error at the state.

    It is J_l⁻¹(xi) of SE_2(3), in W, times `to_invariant`.
    """
    J, no_turn = np.empty((DIM, DIM)), np.empty((3, 3))
    identity(no_turn)
    inverse_jacobian(xi, no_turn, J)
    rows_times(DIM, J, to_invariant(state[0].R_WB[:], state[0].v_WB_W[:]), H)


@compiled
def local_moved(state: NDArray[Any], other: NDArray[Any], error: Array) -> None:
    """Fill our error (15,) by which `move` takes the state to `other`."""
    xi, turned = np.empty(DIM), np.empty(3)
    local_invariant(state, other, xi)
    for i in range(DIM):
        error[i] = xi[i]
    inverse_transform_into(state[0].R_WB[:], xi[PHI], error[THETA])
    cross_into(state[0].v_WB_W[:], xi[PHI], turned)
    for i in range(3):
        error[VELOCITY_0 + i] -= turned[i]


@compiled
def inject_invariant(state: NDArray[Any], error: Array) -> None:
    """`move` the state by our error (15,), and carry P, of our error, along: that of the invariant error stays."""
    before = state.copy()
    move(before, error, state)
    carry_over(before, state, False, state[0].P[:])


@compiled
def carry_over(old: NDArray[Any], new: NDArray[Any], position: bool, P: Array) -> None:
    """P ← T P Tᵀ, which takes P (15, 15) of our error at one state to another, with the invariant error kept.

    T = `from_invariant` at the new state times `to_invariant` at the old: docs/conventions.md (67). With `position`,
    position counts to the group as well, from the origin of W: (65).
    """
    o, n, T, none = old[0], new[0], np.empty((DIM, DIM)), np.empty((DIM, DIM))
    S, change, turn = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    identity(T)
    between_into(n.R_WB[:], o.R_WB[:], turn)
    set_block(T, THETA_0, THETA_0, 1.0, turn)
    for i in range(3):
        change[i] = o.v_WB_W[i] - n.v_WB_W[i]
    skew_into(change, S)
    set_product(T, VELOCITY_0, THETA_0, 1.0, S, o.R_WB[:])
    if position:
        for i in range(3):
            change[i] = o.p_WB_W[i] - n.p_WB_W[i]
        skew_into(change, S)
        set_product(T, POSITION_0, THETA_0, 1.0, S, o.R_WB[:])
    clear(none)
    sandwich(T, P, none, P)
