"""The unscented Kalman filter on the manifold, with filterpy's sigma points; docs/conventions.md (38).

Sigma points are errors about the state that stands beside them, x ⊕ e. After each transform the mean error moves that
state, and the covariance is turned into its new tangent as after any update (`state.inject`). The block of `imu` is
integrated once, with the mean's biases, and carries all points, to first order in their difference in bias. Its noise
Q is added (at the mean), as is a reading's.

A residual is h ⊖ z at every point: yaws and attitudes are wrapped there, so no average is taken across a wrap.

Sources: Julier & Uhlmann 2004, doi:10.1109/JPROC.2003.823141; Van der Merwe 2004 for the weights; Brossard, Barrau &
Bonnabel 2017, doi:10.1109/IROS.2017.8206066, for retracting sigma points.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from ...datasets.compiling.decorators import compiled
from ...datasets.quantities import NotNegative, Number
from ...datasets.rig import Rig
from ...datasets.state import DIM, Array, Belief
from ..interface import Diverged
from ..physics.imu import integrate, predict, process_noise
from ..physics.measurements import measure
from ..physics.state import inject, local, retract
from .filter_pass import FilterOptions, FilterPass, Kalman


@dataclass(frozen=True)
class UnscentedKalmanFilter(FilterOptions):
    """Unscented Kalman filter over (theta, p, v, b_a, b_g).

    Attributes:
        alpha: the 31 points lie alpha √15 standard deviations out. At 1, a heading known to 60° has points at 232°,
            past where a rotation is a rotation vector; 1e-3, also common, cancels six digits of the covariance. From a
            good start 0.1 to 1 do the same.
        beta: adjusts the covariance weight of the central point for the fourth moments; 2 for a Gaussian.
    """

    alpha: Number = Field(default=0.3, ge=1e-3, le=1)
    beta: NotNegative = 2.0
    honest_yaw_rad: ClassVar[float] = math.radians(3.0)  # NEES of attitude 3.4 at 5°, 10 at 10°, as of `eskf`

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        return FilterPass(self, prior, rig, UnscentedKalman(self.alpha, self.beta))


class UnscentedKalman(Kalman):
    """See `Kalman`; holds the points and their weights."""

    def __init__(self, alpha: float, beta: float) -> None:
        from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform  # slow to import

        self._points = MerweScaledSigmaPoints(DIM, alpha, beta, kappa=0.0, sqrt_method=_upper_root)
        self._transform = unscented_transform

    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """x ← the mean of f over the points, P ← their covariance and Q."""
        points, Q = self._sigma_points(state), np.empty((DIM, DIM))
        errors = carry_points(points, state, rig, before, imu, block, Q)
        mean, state[0]["P"] = self._transform(errors, self._points.Wm, self._points.Wc, Q)
        inject(state, mean)

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """x ← x ⊕ K (0 − mean residual), P ← P − K S Kᵀ, by all readings together."""
        points = self._sigma_points(state)
        residuals, C = measure_points(points, state, rig, readings)
        if not residuals.shape[1]:
            return True
        mean, S = self._transform(residuals, self._points.Wm, self._points.Wc, C)
        cross = points.T @ (self._points.Wc[:, None] * (residuals - mean))
        try:
            np.linalg.cholesky(S)
        except np.linalg.LinAlgError:
            return False
        K = np.linalg.solve(S, cross.T).T
        state[0]["P"] -= K @ S @ K.T
        inject(state, -K @ mean)
        return bool(np.isfinite(state[0]["P"]).all())

    def _sigma_points(self, state: NDArray[Any]) -> Array:
        """Return the points (31, 15), errors about the state.

        Raises:
            Diverged: P is not positive definite.
        """
        try:
            return self._points.sigma_points(np.zeros(DIM), state[0]["P"])
        except np.linalg.LinAlgError:
            raise Diverged("the covariance is not positive definite, so it has no sigma points") from None


def _upper_root(P: Array) -> Array:
    """Return U with Uᵀ U = P, as filterpy wants it; raises LinAlgError if P is not positive definite."""
    return np.linalg.cholesky(P).T.astype(np.float64, copy=False)


@compiled
def carry_points(
    points: Array, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any],
    block: NDArray[Any], Q: Array,
) -> Array:  # fmt: skip
    """Carry the state over a block, in place but for P, fill Q, and return the points' errors about it, (n, 15)."""
    F, point, end = np.empty((DIM, DIM)), state.copy(), state.copy()
    errors = np.empty_like(points)
    integrate(imu, before, state[0].b_a[:], state[0].b_g[:], rig, block)
    process_noise(block, state[0].R_WB[:], Q)
    predict(block, state, rig[0].gravity, F, end)
    for k in range(len(points)):
        retract(state, points[k], point)
        predict(block, point, rig[0].gravity, F, point)
        local(end, point, errors[k])
    retract(end, np.zeros(DIM), state)
    return errors


@compiled
def measure_points(
    points: Array, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]
) -> tuple[Array, Array]:
    """Return the residuals of all readings at every point, (n, m), and their covariance (m, m)."""
    r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    point, most = state.copy(), 3 * len(readings)
    residuals, C_all, m = np.empty((len(points), most)), np.zeros((most, most)), 0
    for k in range(len(points)):
        retract(state, points[k], point)
        m = 0
        for reading in range(len(readings)):
            n = measure(readings, reading, point, rig, r, H, C)
            for i in range(n):
                residuals[k, m + i] = r[i]
                for j in range(n):
                    C_all[m + i, m + j] = C[i, j]
            m += n
    return residuals[:, :m].copy(), C_all[:m, :m].copy()
