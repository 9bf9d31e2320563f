"""The right-invariant extended Kalman filter with biases ("imperfect": biases stand beside the group).

Pose and velocity X = (R_WB, v_WB_W, p_WB_W) are one element of SE_2(3), and the error is on its left, in W:

    X_true = Exp(xi) X        xi = (phi, rho, nu), rotation, position, velocity; biases are added, as ever

To first order phi = R theta, rho = p_error + p × phi and nu = v_error + v × phi. Two things come of it. The IMU block
carries xi by a matrix that knows nothing of the state, exactly (Exp(xi_j) = Γ Exp(Φ xi_i) Γ⁻¹ with the block's gravity
in Γ), and a DVL's velocity measures R_BW nu, whatever phi is: a wrong heading makes neither of them wrong. Only the
biases' columns of the transition and the other sensors' rows still depend on the state.

Where W turns (`earth_rotation`, see `imu`), phi turns with it, phi_j = E phi, and so do rho and nu; but v is over W,
not over the stars, and p is counted in W. With u' = p_j − p_i and positions from the origin,

    rho_j = rho + T E nu + (E [g₂]× + [p_i]× (E − I)) phi
    nu_j = (E − T Ω× E) nu + (E [g₁]× − Ω× E [g₂]× + [u']× Ω× E) phi

The two terms in the state are a turn of the Earth in T of it: a wrong heading enters through them 1e-4 as much.

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
from numba import njit
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ...datasets.rig import Rig
from ...datasets.state import DIM, POSITION, THETA, VELOCITY, Array, Belief
from ..physics.imu import integrate, predict, process_noise, sandwich
from ..physics.measurements import measure
from ..physics.so3 import cross, exp, product, right_jacobian, skew, transform
from .eskf import absorb
from .filter_pass import FilterOptions, FilterPass, Kalman

PHI, RHO, NU = THETA, POSITION, VELOCITY
"""The invariant error stands in the order of ours."""


@dataclass(frozen=True)
class InvariantKalmanFilter(FilterOptions):
    """Right-invariant extended Kalman filter over SE_2(3) and biases."""

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        kalman, x = InvariantKalman(prior.state.p_WB_W.copy()), prior.state
        P = sandwich(to_invariant(x.R_WB, np.zeros(3), x.v_WB_W), prior.P)
        return FilterPass(self, Belief(prior.t_ns, x, P), rig, kalman)


class InvariantKalman(Kalman):
    """See `Kalman`; every P is of the invariant error, and positions are counted from the origin (3,)."""

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

    def error_covariance(self, state: NDArray[Any]) -> Array:
        """See `Kalman.error_covariance`. (The rate noise that a belief adds to v is the same in nu.)"""
        s = state[0]
        return sandwich(from_invariant(s["R_WB"], s["p_WB_W"] - self._origin, s["v_WB_W"]), s["P"])


@njit(cache=True)
def to_invariant(R_WB: Array, p_OB_W: Array, v_WB_W: Array) -> Array:
    """Derivative (15, 15) of (xi, biases) by our error state; p_OB_W is B's position from the origin of the group."""
    A = np.eye(DIM)
    A[PHI, THETA] = R_WB
    A[RHO, THETA] = product(skew(p_OB_W), R_WB)
    A[NU, THETA] = product(skew(v_WB_W), R_WB)
    return A


@njit(cache=True)
def from_invariant(R_WB: Array, p_OB_W: Array, v_WB_W: Array) -> Array:
    """Inverse of `to_invariant`: theta = Rᵀ phi, p_error = rho − p × phi, v_error = nu − v × phi."""
    A = np.eye(DIM)
    A[THETA, PHI] = R_WB.T
    A[POSITION, PHI] = -skew(p_OB_W)
    A[VELOCITY, PHI] = -skew(v_WB_W)
    return A


@njit(cache=True)
def propagate_invariant(
    state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any], origin: Array
) -> None:
    """x ← f(x, imu), P ← Φ P Φᵀ + A Q Aᵀ, with A = `to_invariant` at the end."""
    s = state[0]
    F, Q, R_i = np.empty((DIM, DIM)), np.empty((DIM, DIM)), s.R_WB.copy()
    back = from_invariant(R_i, s.p_WB_W - origin, s.v_WB_W)
    integrate(imu, before, s.b_a, s.b_g, rig, block)
    predict(block, state, rig[0].gravity, F, state)
    process_noise(block, R_i, Q)
    A = to_invariant(s.R_WB, s.p_WB_W - origin, s.v_WB_W)
    Phi = A @ F @ back if block[0].w_CW_W.any() else invariant_transition(block, rig[0].gravity, F, A)
    s.P[:] = sandwich(Phi, s.P) + sandwich(A, Q)


@njit(cache=True)
def invariant_transition(block: NDArray[Any], gravity: float, F: Array, A: Array) -> Array:
    """Φ (15, 15) of a block: constant for the group, [g]× and T; only the biases' columns come from F and the state.

    In a W that does not turn.

    Args:
        block: BLOCK record of length 1.
        gravity: m/s², positive.
        F: transition of our error state, from `predict`.
        A: `to_invariant` at the block's end.
    """
    T, Phi = block[0].T, np.eye(DIM)
    for i in range(3):
        Phi[3 + i, 6 + i] = T
    Phi[6, 1], Phi[7, 0] = gravity * T, -gravity * T  # T [g_W]×
    Phi[3, 1], Phi[4, 0] = 0.5 * gravity * T**2, -0.5 * gravity * T**2
    for i in range(9):
        for j in range(9, DIM):
            Phi[i, j] = F[i, j] if i >= 3 else 0.0
            for k in range(3):
                Phi[i, j] += A[i, k] * F[k, j]
    return Phi


@njit(cache=True)
def correct_invariant(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any], origin: Array) -> bool:
    """Correct by all readings, linearised together at the predicted state; False where that is impossible.

    H by the invariant error is H · `from_invariant`: for a DVL (0, 0, R_BW).
    """
    s, dx = state[0], np.zeros(DIM)
    r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    p_OB_W, v_WB_W = s.p_WB_W - origin, s.v_WB_W
    for m in range(len(readings)):
        n = measure(readings, m, state, rig, r, H, C)
        for i in range(n):
            H[i, PHI] = transform(s.R_WB, H[i, THETA]) + cross(p_OB_W, H[i, POSITION]) + cross(v_WB_W, H[i, VELOCITY])
        if not absorb(n, r, H, C, s.P, dx):
            return False
    inject_invariant(state, dx, origin)
    for i in range(DIM):
        for j in range(i):
            s.P[i, j] = s.P[j, i] = 0.5 * (s.P[i, j] + s.P[j, i])
    return np.isfinite(dx.sum())


@njit(cache=True)
def inject_invariant(state: NDArray[Any], dx: Array, origin: Array) -> None:
    """X ← Exp(xi) X: R ← Exp(phi) R, v ← Exp(phi) v + J_l(phi) nu, p likewise about the origin."""
    s = state[0]
    turn, J_l = exp(dx[PHI]), right_jacobian(-dx[PHI])
    s.R_WB[:] = product(turn, s.R_WB)
    s.p_WB_W[:] = origin + transform(turn, s.p_WB_W - origin) + transform(J_l, dx[RHO])
    s.v_WB_W[:] = transform(turn, s.v_WB_W) + transform(J_l, dx[NU])
    for i in range(3):
        s.b_a[i] += dx[9 + i]
        s.b_g[i] += dx[12 + i]
