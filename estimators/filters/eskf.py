"""The error-state Kalman filter: predict by the IMU block, correct by every reading of an epoch at once.

Source: Solà 2017, arXiv:1711.02298, sections 5–6, with the error on the right of R_WB and the block of `imu` as the
transition.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ...datasets.rig import Rig
from ...datasets.state import THETA, Array, Belief
from ..physics.imu import integrate, predict, process_noise, sandwich
from ..physics.measurements import decorrelate, measure
from ..physics.so3 import exp, product, right_jacobian
from .filter_pass import FilterOptions, FilterPass, Kalman


@dataclass(frozen=True)
class ErrorStateKalmanFilter(FilterOptions):
    """Error-state extended Kalman filter over (theta, p, v, b_a, b_g).

    A late reading is put where it belongs, see `FilterPass`.
    """

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        return FilterPass(self, prior, rig, ErrorStateKalman())


@njit(cache=True)
def propagate(
    state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
) -> None:
    """x ← f(x, imu), P ← F P Fᵀ + Q."""
    s = state[0]
    F, Q, R_i = np.empty((15, 15)), np.empty((15, 15)), s.R_WB.copy()
    integrate(imu, before, s.b_a, s.b_g, rig, block)
    predict(block, state, rig[0].gravity, F, state)
    process_noise(block, R_i, Q)
    s.P[:] = sandwich(F, s.P) + Q


@njit(cache=True)
def correct(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
    """Correct by all readings, linearised together at the predicted state; False where that is impossible.

    Rows of independent errors are taken one by one: exactly the joint update, and no matrix to invert. A reading whose
    own rows are correlated is first turned into one whose rows are not.
    """
    P, dx = state[0].P, np.zeros(15)
    r, H, C = np.empty(3), np.empty((3, 15)), np.empty((3, 3))
    for m in range(len(readings)):
        n = measure(readings, m, state, rig, r, H, C)
        if not absorb(n, r, H, C, P, dx):
            return False
    inject(state, dx)
    total = 0.0
    for i in range(15):
        total += dx[i]
    return np.isfinite(total)


@njit(cache=True)
def absorb(n: int, r: Array, H: Array, C: Array, P: Array, dx: Array) -> bool:
    """Add to the correction dx (15,), and take from P, what n rows of one reading say; r, H and C are used up.

    False where an innovation's variance is not positive.
    """
    PH = np.empty(15)
    decorrelate(n, r, H, C)
    for row in range(n):
        innovation, S = -r[row], C[row, row]
        for i in range(15):
            PH[i] = 0.0
            for j in range(15):
                PH[i] += P[i, j] * H[row, j]
        for i in range(15):
            S += H[row, i] * PH[i]
            innovation -= H[row, i] * dx[i]
        if not S > 0.0:
            return False
        for i in range(15):
            gain = PH[i] / S
            dx[i] += gain * innovation
            for j in range(15):
                P[i, j] -= gain * PH[j]
    return True


@njit(cache=True)
def inject(state: NDArray[Any], dx: Array) -> None:
    """x ← x ⊕ dx, and P for the error that is left: theta ← J_r(dtheta) (theta − dtheta)."""
    s = state[0]
    dtheta = dx[0:3]
    s.R_WB[:] = product(s.R_WB, exp(dtheta))
    for i in range(3):
        s.p_WB_W[i] += dx[3 + i]
        s.v_WB_W[i] += dx[6 + i]
        s.b_a[i] += dx[9 + i]
        s.b_g[i] += dx[12 + i]
    J = right_jacobian(dtheta)
    P_J = J @ np.ascontiguousarray(s.P[THETA, :])
    s.P[THETA, :] = P_J
    s.P[:, THETA] = np.ascontiguousarray(s.P[:, THETA]) @ J.T
    for i in range(15):
        for j in range(i):
            s.P[i, j] = s.P[j, i] = 0.5 * (s.P[i, j] + s.P[j, i])


class ErrorStateKalman(Kalman):
    """See `Kalman`: the functions of this module."""

    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """See `Kalman.predict`."""
        propagate(state, rig, before, imu, block)

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct(state, rig, readings)
