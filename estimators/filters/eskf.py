"""The error-state Kalman filter: predict by the IMU block, correct by every reading of an epoch at once.

Its two steps are those of `physics.kalman`. Two remedies of the field against what a large correction does to it are
options, so that they can be compared: the iterated update and first-estimate Jacobians; docs/conventions.md (64), (65).

Sources: Bell & Cathey 1993, doi:10.1109/9.250476, for iterations: the update as Gauss–Newton. Huang, Mourikis &
Roumeliotis 2010, doi:10.1177/0278364909353640, and Li & Mourikis 2013, doi:10.1177/0278364913481251, for first
estimates.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from ...datasets.compiling.decorators import compiled
from ...datasets.quantities import Whole
from ...datasets.rig import Rig
from ...datasets.state import DIM, THETA, Array, Belief
from ..physics.elimination import absorb
from ..physics.invariant import carry_over
from ..physics.kalman import correct, find_correction, propagate
from ..physics.measurements import measure
from ..physics.so3 import right_jacobian_into
from ..physics.state import THETA_0, inject, retract
from .filter_pass import FilterOptions, FilterPass, Kalman


@dataclass(frozen=True)
class ErrorStateOptions(FilterOptions):
    """Options of the error-state filters.

    Attributes:
        iterations: how often a correction is linearised: at the prediction, then at what the last one found.
        first_estimate: transitions run from prediction to prediction, whatever a correction changed between them, so
            that yaw and position gain no information from its being linearised twice.
    """

    iterations: Whole = Field(default=1, ge=1)
    first_estimate: bool = False
    honest_yaw_rad: ClassVar[float] = math.radians(3.0)
    """With the velocity known in B and no heading sensor, NEES of attitude is 1.2 at 2°, 1.5 at 3°, 3.7 at 5°, 10 at
    10°, and 300 at 25°. Iterated it is 4.6 at 5° and 15 at 10°; with first estimates 1.3, 1.9, and 90 at 25°."""

    @model_validator(mode="after")
    def _is_one_remedy(self) -> ErrorStateOptions:
        if self.first_estimate and self.iterations > 1:
            raise ValueError("first_estimate linearises at the prediction alone: leave iterations at 1")
        return self


@dataclass(frozen=True)
class ErrorStateKalmanFilter(ErrorStateOptions):
    """Error-state extended Kalman filter over (theta, p, v, b_a, b_g).

    It rewinds and replays for late readings, see `FilterPass`.
    """

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        if self.iterations > 1:
            return FilterPass(self, prior, rig, IteratedKalman(self.iterations))
        return FilterPass(self, prior, rig, FirstEstimateKalman() if self.first_estimate else ErrorStateKalman())


class ErrorStateKalman(Kalman):
    """See `Kalman`."""

    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """See `Kalman.predict`."""
        propagate(state, rig, before, imu, block)

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct(state, rig, readings)


class IteratedKalman(ErrorStateKalman):
    """See `Kalman`; a correction is linearised so many times."""

    def __init__(self, iterations: int) -> None:
        self._iterations = iterations

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct_iterated(state, rig, readings, self._iterations)


class FirstEstimateKalman(ErrorStateKalman):
    """See `Kalman`; rotation, position and velocity of the transition are those of the predictions."""

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct_first_estimate(state, rig, readings)


@compiled
def correct_iterated(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any], iterations: int) -> bool:
    """Correct by all readings, linearised together and again at what that gives; False where that is impossible."""
    at, dx, P, J = state.copy(), np.zeros(DIM), state[0].P.copy(), np.empty((3, 3))
    r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    for _ in range(iterations):
        found, P[:] = np.zeros(DIM), state[0].P[:]
        right_jacobian_into(dx[THETA], J)
        for m in range(len(readings)):
            n = measure(readings, m, at, rig, r, H, C)
            about_prediction(n, dx, J, r, H)
            if not absorb(n, r, H, C, found, P):
                return False
        dx[:] = found
        retract(state, dx, at)
    state[0].P[:] = P
    inject(state, dx)
    return bool(np.isfinite(dx.sum()))


@compiled
def about_prediction(n: int, dx: Array, J: Array, r: Array, H: Array) -> None:
    """Make n rows of the error at x ⊕ dx rows of that at x: H ← H diag(J, I), r ← r − H dx, with J = J_r(theta)."""
    for row in range(n):
        a, b, c = H[row, THETA_0], H[row, THETA_0 + 1], H[row, THETA_0 + 2]
        for i in range(3):
            H[row, THETA_0 + i] = a * J[0, i] + b * J[1, i] + c * J[2, i]
        for i in range(DIM):
            r[row] -= H[row, i] * dx[i]


@compiled
def correct_first_estimate(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
    """Correct by all readings, linearised together at the predicted state; False where that is impossible."""
    dx = np.zeros(DIM)
    if not find_correction(state, rig, readings, dx):
        return False
    inject_first_estimate(state, dx)
    return True


@compiled
def inject_first_estimate(state: NDArray[Any], dx: Array) -> None:
    """x ← x ⊕ dx, and P to where a transition by the predictions continues it.

    The transition of rotation, position and velocity from this prediction to the next is the one from the corrected
    state to the next prediction, times T of `carry_over` with the position in the group. So applying T here is all that
    first-estimate Jacobians ask for; the biases' columns are of the corrected state.
    """
    before = state.copy()
    retract(state, dx, state)
    carry_over(before, state, True, state[0].P[:])
