"""The error-state Kalman filter once more, on filterpy's `ExtendedKalmanFilter`: the readable reference of `eskf`.

filterpy estimates the error of a state that is kept outside of it. The error is zero before every update; afterwards
it is added to the state and reset to zero.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass
from scipy.linalg import LinAlgWarning

from ...datasets.rig import Rig
from ...datasets.state import DIM, THETA, Array, Belief
from ..physics.imu import integrate, predict, process_noise
from ..physics.measurements import measure
from ..physics.so3 import right_jacobian
from ..physics.state import inject, retract
from .eskf import ErrorStateOptions, inject_first_estimate
from .filter_pass import FilterPass, Kalman


@dataclass(frozen=True)
class FilterpyKalmanFilter(ErrorStateOptions):
    """Error-state extended Kalman filter over (theta, p, v, b_a, b_g), by filterpy; agrees with `eskf`."""

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        return FilterPass(self, prior, rig, FilterpyKalman(self.iterations, self.first_estimate))


class FilterpyKalman(Kalman):
    """See `Kalman`."""

    def __init__(self, iterations: int, first_estimate: bool) -> None:
        from filterpy.kalman import ExtendedKalmanFilter  # slow to import, and no other command needs it

        self._filter, self._iterations = ExtendedKalmanFilter, iterations
        self._inject = inject_first_estimate if first_estimate else inject

    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """See `Kalman.predict`."""
        ekf, R_i = self._about(state), state[0]["R_WB"].copy()
        integrate(imu, before, state[0]["b_a"], state[0]["b_g"], rig, block)
        predict(block, state, rig[0]["gravity"], ekf.F, state)
        process_noise(block, R_i, ekf.Q)
        ekf.predict()
        state[0]["P"] = ekf.P

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        ekf, rows = self._about(state), stack(state, rig, readings)
        for k in range(self._iterations):
            if k > 0:
                ekf, rows = self._about(state), stack_again(state, ekf.x, rig, readings)
            if len(rows[0]) and not _update(ekf, *rows):
                return False
        state[0]["P"] = ekf.P
        self._inject(state, ekf.x)
        return bool(np.isfinite(ekf.x).all())

    def _about(self, state: NDArray[Any]) -> Any:
        """Return filterpy's filter of the state's error, which is zero."""
        ekf = self._filter(dim_x=DIM, dim_z=1)
        ekf.x, ekf.P = np.zeros(DIM), state[0]["P"].copy()
        return ekf


def _update(ekf: Any, r: Array, H: Array, C: Array) -> bool:
    """Correct filterpy's filter by rows; False where their innovation has no usable covariance."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)  # S is checked below
            ekf.update(np.zeros(len(r)), HJacobian=lambda error: H, Hx=lambda error: r, R=C)  # r is h ⊖ z
        np.linalg.cholesky(ekf.S)
    except (np.linalg.LinAlgError, ValueError):  # scipy raises it if something is not finite
        return False
    return True


def stack(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> tuple[Array, Array, Array]:
    """Return r (m,), H (m, 15) and C (m, m) of all readings together, linearised at the state."""
    rows: list[tuple[Array, Array, Array]] = []
    for k in range(len(readings)):
        r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
        n = measure(readings, k, state, rig, r, H, C)
        rows.append((r[:n], H[:n], C[:n, :n]))
    m = sum(len(r) for r, _, _ in rows)
    r_all, H_all, C_all, begin = np.empty(m), np.empty((m, DIM)), np.zeros((m, m)), 0
    for r, H, C in rows:
        part = slice(begin, begin + len(r))
        r_all[part], H_all[part], C_all[part, part] = r, H, C
        begin = part.stop
    return r_all, H_all, C_all


def stack_again(
    state: NDArray[Any], dx: Array, rig: NDArray[Any], readings: NDArray[Any]
) -> tuple[Array, Array, Array]:
    """Return the rows of `stack`, linearised at the state moved by dx (15,), of the error at the state itself."""
    at = state.copy()
    retract(state, dx, at)
    r, H, C = stack(at, rig, readings)
    H[:, THETA] = H[:, THETA] @ right_jacobian(dx[THETA])
    return r - H @ dx, H, C
