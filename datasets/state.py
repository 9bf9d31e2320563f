"""The navigation state, its error coordinates, and a belief: a state with its covariance.

The error state has fifteen components, in this order everywhere: theta (R_WB exp(theta), rad, in B), p (m, in W),
v (m/s, in W), b_a (m/s²) and b_g (rad/s), both in the IMU's axes. See docs/conventions.md (7) and (8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array: TypeAlias = NDArray[np.float64]
TimeArray: TypeAlias = NDArray[np.int64]

LIMIT_NS = 1 << 62
"""ns: times beyond this are invalid, 146 years either side of 1970. Two times within it subtract without overflow."""

# Where each part of the error stands, docs/conventions.md (7).
THETA = slice(0, 3)
POSITION = slice(3, 6)
VELOCITY = slice(6, 9)
ACCEL_BIAS = slice(9, 12)
GYRO_BIAS = slice(12, 15)
DIM = 15
"""Components of the error."""


@dataclass(frozen=True, eq=False)
class NavState:
    """Pose and velocity of the body B in the world W (east-north-up), and the IMU's biases.

    Attributes:
        R_WB: (3, 3) rotation taking B components to W components.
        p_WB_W: (3,) m.
        v_WB_W: (3,) m/s.
        b_a: (3,) m/s², in the IMU's axes.
        b_g: (3,) rad/s, in the IMU's axes.
    """

    R_WB: Array
    p_WB_W: Array
    v_WB_W: Array
    b_a: Array
    b_g: Array

    dim = DIM

    def retract(self, error: Array) -> NavState:
        """Return this state ⊕ error, error (15,); docs/conventions.md (7)."""
        return NavState(
            self.R_WB @ Rotation.from_rotvec(error[THETA]).as_matrix(),
            self.p_WB_W + error[POSITION],
            self.v_WB_W + error[VELOCITY],
            self.b_a + error[ACCEL_BIAS],
            self.b_g + error[GYRO_BIAS],
        )

    def local(self, other: NavState) -> Array:
        """Return the error (15,) with self ⊕ error = other; docs/conventions.md (8). Of states in rows: (n, 15)."""
        return np.concatenate(
            [
                rotation_vector(self.R_WB.swapaxes(-1, -2) @ other.R_WB),
                other.p_WB_W - self.p_WB_W,
                other.v_WB_W - self.v_WB_W,
                other.b_a - self.b_a,
                other.b_g - self.b_g,
            ],
            axis=-1,
        )


@dataclass(frozen=True, eq=False)
class Belief:
    """A state at t_ns with the covariance P (15, 15) of its error; P is NaN if the estimator keeps none."""

    t_ns: int
    state: NavState
    P: Array


def rotation_angle(R: Array) -> Array:
    """Return the angle (...) rad of R (..., 3, 3), in [0, π], accurate near both ends; NaN where R is.

    atan2(|vee(R − Rᵀ)|, tr R − 1): twice the sine over twice the cosine.
    """
    cosine = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0
    return np.arctan2(np.linalg.norm(_twice_sine_axis(R), axis=-1), cosine)


def rotation_vector(R: Array) -> Array:
    """Return Log R (..., 3) rad, the angle along the axis: exp(Log R) = R; NaN where R is."""
    phi, w = rotation_angle(R), _twice_sine_axis(R)
    twice_sine = np.linalg.norm(w, axis=-1)
    log = np.divide(phi, twice_sine, out=np.full(np.shape(phi), 0.5), where=twice_sine > 0)[..., None] * w
    near_pi = phi > 3.0  # where the sine loses the axis
    if near_pi.any():
        log[near_pi] = Rotation.from_matrix(R[near_pi]).as_rotvec()
    return log


def _twice_sine_axis(R: Array) -> Array:
    """Return vee(R − Rᵀ) (..., 3): the axis times twice the sine of the angle."""
    pairs = ((2, 1), (0, 2), (1, 0))
    return np.stack([R[..., i, j] - R[..., j, i] for i, j in pairs], axis=-1)
