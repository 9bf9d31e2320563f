"""The right-invariant extended Kalman filter with biases ("imperfect": biases stand beside the group).

The equations are docs/conventions.md (39) to (43).

Pose and velocity X = (R_WB, v_WB_W, p_WB_W) are one element of SE_2(3), and the error is on its left, in W:

    X_true = Exp(xi) X        xi = (phi, rho, nu), rotation, position, velocity; biases are added

To first order phi = R theta, rho = p_error + p × phi and nu = v_error + v × phi. This has two consequences. The IMU
block carries xi by a matrix that does not depend on the state, exactly (Exp(xi_j) = Γ Exp(Φ xi_i) Γ⁻¹ with the block's
gravity in Γ), and a DVL's velocity measures R_BW nu, independently of phi: a wrong heading affects neither. Only the
biases' columns of the transition and the other sensors' rows still depend on the state.

Where W turns (`earth_rotation`, see `imu`), phi turns with it, phi_j = E phi, and so do rho and nu; but v is over W,
not over the stars, and p is counted in W. With u' = p_j − p_i and positions from the origin,

    rho_j = rho + T E nu + (E [g₂]× + [p_i]× (E − I)) phi
    nu_j = (E − T Ω× E) nu + (E [g₁]× − Ω× E [g₂]× + [u']× Ω× E) phi

The two terms that depend on the state are the Earth's rotation in T times it: a wrong heading enters by 1e-4 of it.

Positions are counted from the prior's, for rho turns about the point that they are counted from: an unknown heading
is then an unknown turn about where the vehicle began.

Sources: Barrau & Bonnabel 2017, doi:10.1109/TAC.2016.2594085; Hartley, Ghaffari, Eustice & Grizzle 2020,
doi:10.1177/0278364919894385, section 5 (theirs is also X̂ = Exp(xi) X; ours has the sign of our other errors). As
there, P is not turned after an update: with the left Jacobian of SE_2(3) it would be in the new tangent, but with a
heading 60° off and the velocity known in W, a filter that does so is still 32° off after a minute, and this one 2°.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.epochs import DVL, GPS
from ...datasets.rig import Rig
from ...datasets.state import DIM, POSITION, THETA, VELOCITY, Array, Belief
from ..physics.blocks import identity, set_block, set_product
from ..physics.elimination import absorb, add_scaled
from ..physics.imu import integrate, predict, process_noise, sandwich, turns
from ..physics.measurements import measure
from ..physics.so3 import cross_into, exp, product, right_jacobian, skew_into, transform, transform_into
from ..physics.state import ACCEL_BIAS_0, GYRO_BIAS_0, POSITION_0, THETA_0, VELOCITY_0, symmetrise
from ..stages import stage
from ..unknown_start import refuse_unknown_velocity
from .filter_pass import FilterOptions, FilterPass, Kalman

PHI, RHO, NU = THETA, POSITION, VELOCITY
PHI_0, RHO_0, NU_0 = THETA_0, POSITION_0, VELOCITY_0
"""The invariant error stands in the order of ours."""


@dataclass(frozen=True)
class InvariantKalmanFilter(FilterOptions):
    """Right-invariant extended Kalman filter over SE_2(3) and biases."""

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        refuse_unknown_velocity(prior)
        kalman, x = InvariantKalman(prior.state.p_WB_W.copy()), prior.state
        A = to_invariant(x.R_WB, np.zeros(3), x.v_WB_W)
        P = A @ prior.P @ A.T
        return FilterPass(self, Belief(prior.t_ns, x, P), rig, kalman)


class InvariantKalman(Kalman):
    """See `Kalman`; every P is of the invariant error, and positions are counted from the origin (3,)."""

    stopped_by, freed_by = GPS, DVL

    def __init__(self, origin: Array) -> None:
        self._origin = origin

    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """See `Kalman.predict`."""
        propagate_invariant(state, rig, before, imu, block, self._origin)

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct_invariant(state, rig, readings, self._origin)

    @stage("marginal")
    def error_covariance(self, state: NDArray[Any]) -> Array:
        """See `Kalman.error_covariance`. (The rate noise that a belief adds to v is the same in nu.)"""
        s = state[0]
        A = from_invariant(s["R_WB"], s["p_WB_W"] - self._origin, s["v_WB_W"])
        P = A @ s["P"] @ A.T
        return 0.5 * (P + P.T)


@compiled
def to_invariant(R_WB: Array, p_OB_W: Array, v_WB_W: Array) -> Array:
    """Derivative (15, 15) of (xi, biases) by our error state; p_OB_W is B's position from the origin of the group."""
    A, S = np.empty((DIM, DIM)), np.empty((3, 3))
    identity(A)
    set_block(A, PHI_0, THETA_0, 1.0, R_WB)
    skew_into(p_OB_W, S)
    set_product(A, RHO_0, THETA_0, 1.0, S, R_WB)
    skew_into(v_WB_W, S)
    set_product(A, NU_0, THETA_0, 1.0, S, R_WB)
    return A


@compiled
def from_invariant(R_WB: Array, p_OB_W: Array, v_WB_W: Array) -> Array:
    """Inverse of `to_invariant`: theta = Rᵀ phi, p_error = rho − p × phi, v_error = nu − v × phi."""
    A, S = np.empty((DIM, DIM)), np.empty((3, 3))
    identity(A)
    for i in range(3):
        for j in range(3):
            A[THETA_0 + i, PHI_0 + j] = R_WB[j, i]
    skew_into(p_OB_W, S)
    set_block(A, POSITION_0, PHI_0, -1.0, S)
    skew_into(v_WB_W, S)
    set_block(A, VELOCITY_0, PHI_0, -1.0, S)
    return A


@compiled
def propagate_invariant(
    state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any], origin: Array
) -> None:
    """x ← f(x, imu), P ← Φ P Φᵀ + A Q Aᵀ, with A = `to_invariant` at the end."""
    s, F, Q, none = state[0], np.empty((DIM, DIM)), np.empty((DIM, DIM)), np.zeros((DIM, DIM))
    back = from_invariant(s.R_WB[:], s.p_WB_W - origin, s.v_WB_W[:])
    integrate(imu, before, s.b_a[:], s.b_g[:], rig, block)
    process_noise(block, s.R_WB[:], Q)
    predict(block, state, rig[0].gravity, F, state)
    A = to_invariant(s.R_WB[:], s.p_WB_W - origin, s.v_WB_W[:])
    if turns(block[0].w_CW_W[:]):
        Phi, AF = np.zeros((DIM, DIM)), np.zeros((DIM, DIM))
        add_product(A, F, AF)
        add_product(AF, back, Phi)
    else:
        Phi = invariant_transition(block, rig[0].gravity, F, A)
    sandwich(A, Q, none, Q)
    sandwich(Phi, s.P[:], Q, s.P[:])


@inner
def add_product(A: Array, B: Array, out: Array) -> None:
    """out += A B, all (15, 15)."""
    for i in range(DIM):
        for k in range(DIM):
            add_scaled(out[i], A[i, k], B[k])


@compiled
def invariant_transition(block: NDArray[Any], gravity: float, F: Array, A: Array) -> Array:
    """Φ (15, 15) of a block: constant for the group, [g]× and T; only the biases' columns come from F and the state.

    In a W that does not turn.

    Args:
        block: BLOCK record of length 1.
        gravity: m/s², positive.
        F: transition of our error state, from `predict`.
        A: `to_invariant` at the block's end.
    """
    T, Phi = block[0].T, np.empty((DIM, DIM))
    identity(Phi)
    for i in range(3):
        Phi[RHO_0 + i, NU_0 + i] = T
    for i, j, sign in ((0, 1, 1.0), (1, 0, -1.0)):  # [g_W]×
        Phi[NU_0 + i, PHI_0 + j] = sign * gravity * T
        Phi[RHO_0 + i, PHI_0 + j] = sign * 0.5 * gravity * T**2
    for i in range(ACCEL_BIAS_0):
        for j in range(ACCEL_BIAS_0, DIM):
            Phi[i, j] = F[i, j] if i >= POSITION_0 else 0.0
            for k in range(3):
                Phi[i, j] += A[i, THETA_0 + k] * F[THETA_0 + k, j]
    return Phi


@compiled
def correct_invariant(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any], origin: Array) -> bool:
    """Correct by all readings, linearised together at the predicted state; False where that is impossible.

    H by the invariant error is H · `from_invariant`: for a DVL (0, 0, R_BW).
    """
    s, dx, r, H, C = state[0], np.zeros(DIM), np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    by_phi, p_OB_W, v_WB_W = np.empty((3, 3)), s.p_WB_W - origin, s.v_WB_W[:]
    for m in range(len(readings)):
        n = measure(readings, m, state, rig, r, H, C)
        for row in range(n):
            transform_into(s.R_WB[:], H[row, THETA], by_phi[0])
            cross_into(p_OB_W, H[row, POSITION], by_phi[1])
            cross_into(v_WB_W, H[row, VELOCITY], by_phi[2])
            for i in range(3):
                H[row, PHI_0 + i] = by_phi[0, i] + by_phi[1, i] + by_phi[2, i]
        if not absorb(n, r, H, C, dx, s.P[:]):
            return False
    inject_invariant(state, dx, origin)
    symmetrise(s.P[:])
    return np.isfinite(dx.sum())


@compiled
def inject_invariant(state: NDArray[Any], dx: Array, origin: Array) -> None:
    """X ← Exp(xi) X: R ← Exp(phi) R, v ← Exp(phi) v + J_l(phi) nu, p likewise about the origin."""
    s = state[0]
    turn, J_l = exp(dx[PHI]), right_jacobian(-dx[PHI])
    R_WB, p, v = product(turn, s.R_WB[:]), transform(turn, s.p_WB_W - origin), transform(turn, s.v_WB_W[:])
    moved, gained = transform(J_l, dx[RHO]), transform(J_l, dx[NU])
    for i in range(3):
        for j in range(3):
            s.R_WB[i, j] = R_WB[i, j]
        s.p_WB_W[i] = origin[i] + p[i] + moved[i]
        s.v_WB_W[i] = v[i] + gained[i]
        s.b_a[i] += dx[ACCEL_BIAS_0 + i]
        s.b_g[i] += dx[GYRO_BIAS_0 + i]
