"""The invariant extended Kalman filter with biases; docs/conventions.md (39) to (43).

The error of rotation and velocity is that of the group, on its left, in W; position and biases are added. In the group,
position's error would be about an origin that turns with phi: a fix that moves it by 40 m would turn by the attitude's
error, and a depth that is known to 2 cm be taken for knowledge of the tilt.

By (40) the invariant error is a linear function of ours at the state, so that predicting P is the step of `eskf`,
number by number. What differs is how a correction moves the state, by Exp(xi), and how P follows, by the derivative
(63) at the end of the move. A wrong heading turns the velocity with it, and a DVL, which measures R_BW nu, learns
nothing of it.

The transition of the invariant error does not depend on the state in rotation and velocity, exactly. That of position
does in one term, [p_j − p_i]× phi: the way travelled meanwhile turns with the heading. So does, as in any such filter,
what the biases do. Where W turns (`earth_rotation`), one term of nu depends on the way as well, by 1e-4 of it.

While the attitude is poorly known, rows are linearised again at the corrected state: P turned to it would otherwise
tell the next DVL reading of yaw. NEES of attitude per degree of freedom over 16 to 24 starts, the velocity known in B
at a heading with sigma 25° and 60°, and in W at 25°: 1.2, 2.2, 1.2. If instead P of the invariant error stays as it is
after one linearisation (Hartley et al., section 5), 1.6, 3.0, 1.6; if it is turned after one, 1.7, 19, 140.

What is handed out is of our error, whose velocity lies on an arc: its second order (66) is added there, and only there.

Sources: Barrau & Bonnabel 2017, doi:10.1109/TAC.2016.2594085; Hartley, Ghaffari, Eustice & Grizzle 2020,
doi:10.1177/0278364919894385, both with position in the group; Bell & Cathey 1993, doi:10.1109/9.250476, for iterating.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ...datasets.compiling.decorators import compiled
from ...datasets.epochs import DVL, GPS
from ...datasets.rig import Rig
from ...datasets.state import DIM, Array, Belief
from ..physics.blocks import rows_times
from ..physics.elimination import absorb
from ..physics.invariant import (
    as_invariant,
    congruent,
    error_after_invariant,
    retract_invariant,
    spread_velocity,
    to_invariant,
)
from ..physics.measurements import measure
from ..physics.state import THETA_0
from ..unknown_start import refuse_unknown_velocity
from .eskf import ErrorStateKalman
from .filter_pass import FilterOptions, FilterPass

POORLY_KNOWN_RAD = np.radians(2.0)
"""Below this sigma of the attitude one linearisation does: 0.02 m/s of a correction turn by half of it, 0.3 mm/s."""
ROUNDS = 5
"""Linearisations at most."""
SETTLED_RAD = 1e-6
"""A round that turns the state by less ends them."""


@dataclass(frozen=True)
class InvariantKalmanFilter(FilterOptions):
    """Invariant extended Kalman filter: rotation and velocity as a group, position and biases beside it."""

    honest_yaw_rad: ClassVar[float] = math.radians(30.0)  # NEES of attitude 1.2 at 25°, 1.4 at 40°, 2.2 at 60°

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        refuse_unknown_velocity(prior)
        return FilterPass(self, prior, rig, InvariantKalman())


class InvariantKalman(ErrorStateKalman):
    """See `Kalman`; it predicts as `eskf` does."""

    stopped_by, freed_by = GPS, DVL

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct_invariant(state, rig, readings)

    def error_covariance(self, state: NDArray[Any]) -> Array:
        """See `Kalman.error_covariance`."""
        P: Array = state["P"][0].copy()
        spread_velocity(P, state["R_WB"][0])
        return P


@compiled
def correct_invariant(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
    """Correct by all readings, linearised together; False where that is impossible.

    With e our error at the prediction, xi = A e the invariant one, and K of (63) at the corrected state, the rows of
    either are H K A and H K.
    """
    predicted, P, dx, xi = state.copy(), np.empty((DIM, DIM)), np.zeros(DIM), np.zeros(DIM)
    A, K, P_theta = to_invariant(state[0].R_WB[:], state[0].v_WB_W[:]), np.empty((DIM, DIM)), 0.0
    r, H, C, HK = np.empty(3), np.empty((3, DIM)), np.empty((3, 3)), np.empty((3, DIM))
    for i in range(THETA_0, THETA_0 + 3):
        P_theta += state[0].P[i, i]
    rounds = ROUNDS if P_theta > POORLY_KNOWN_RAD**2 else 1
    for _ in range(rounds):
        found, P[:] = np.zeros(DIM), predicted[0].P[:]
        error_after_invariant(state, xi, K)
        for m in range(len(readings)):
            n = measure(readings, m, state, rig, r, H, C)
            rows_times(n, H, K, HK)
            rows_times(n, HK, A, H)
            for row in range(n):
                for i in range(DIM):
                    r[row] -= H[row, i] * dx[i]
            if not absorb(n, r, H, C, found, P):
                return False
        turned = 0.0
        for i in range(THETA_0, THETA_0 + 3):
            turned += (found[i] - dx[i]) ** 2
        dx[:] = found
        as_invariant(predicted, dx, xi)
        retract_invariant(predicted, xi, state)
        if turned < SETTLED_RAD**2:
            break
    error_after_invariant(state, xi, K)
    congruent(A, P)
    congruent(K, P)
    state[0].P[:] = P
    return bool(np.isfinite(dx.sum()))
