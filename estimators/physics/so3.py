"""Rotations: skew, exponential, logarithm and Jacobians of SO(3), compiled.

Source: Solà, Deray & Atchuthan 2018, arXiv:1812.01537, appendix B. Where an angle is small, coefficients come from
their series.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ...datasets.state import Array

SMALL = 1e-4
"""rad; below it, two terms of each series are exact to double precision."""


@njit(cache=True)
def skew(a: Array) -> Array:
    """[a]×, with skew(a) @ b = a × b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@njit(cache=True)
def cross(a: Array, b: Array) -> Array:
    """a × b."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def transform(R: Array, a: Array) -> Array:
    """R a, written out: for three components a call of BLAS costs more than the product."""
    return np.array(
        [
            R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
            R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
            R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
        ]
    )


@njit(cache=True)
def inverse_transform(R: Array, a: Array) -> Array:
    """Rᵀ a, written out."""
    return np.array(
        [
            R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
            R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
            R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2],
        ]
    )


@njit(cache=True)
def product_into(A: Array, B: Array, out: Array) -> None:
    """Write A B, all (3, 3), into `out`, which is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(cache=True)
def product(A: Array, B: Array) -> Array:
    """A B, both (3, 3)."""
    out = np.empty((3, 3))
    product_into(A, B, out)
    return out


@njit(cache=True)
def _polynomial(phi: Array, constant: float, first: float, second: float, M: Array) -> None:
    """Write constant I + first [phi]× + second [phi]×², the form of every function below, into M."""
    x, y, z = phi[0], phi[1], phi[2]
    M[0, 0] = constant - second * (y * y + z * z)
    M[1, 1] = constant - second * (x * x + z * z)
    M[2, 2] = constant - second * (x * x + y * y)
    M[0, 1] = second * x * y - first * z
    M[1, 0] = second * x * y + first * z
    M[0, 2] = second * x * z + first * y
    M[2, 0] = second * x * z - first * y
    M[1, 2] = second * y * z - first * x
    M[2, 1] = second * y * z + first * x


@njit(cache=True)
def exp_into(phi: Array, out: Array) -> None:
    """Write Exp(phi) into `out` (3, 3); eq. (134)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if angle2 < SMALL * SMALL:
        _polynomial(phi, 1.0, 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, out)
    else:
        angle = math.sqrt(angle2)
        _polynomial(phi, 1.0, math.sin(angle) / angle, 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2, out)


@njit(cache=True)
def exp(phi: Array) -> Array:
    """Exp: rotation vector (3,) rad to rotation matrix (3, 3); eq. (134)."""
    out = np.empty((3, 3))
    exp_into(phi, out)
    return out


@njit(cache=True)
def log(R: Array) -> Array:
    """Log: rotation matrix (3, 3) to rotation vector (3,) rad of length at most π; inverse of `exp`, eq. (135).

    Goes through the quaternion of largest component, so that it is exact near zero and near π alike.
    """
    t = np.array(
        [
            1.0 + R[0, 0] + R[1, 1] + R[2, 2],
            1.0 + R[0, 0] - R[1, 1] - R[2, 2],
            1.0 - R[0, 0] + R[1, 1] - R[2, 2],
            1.0 - R[0, 0] - R[1, 1] + R[2, 2],
        ]
    )  # four times the squared components w, x, y, z
    k = np.argmax(t)
    if k == 0:
        q = np.array([t[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    elif k == 1:
        q = np.array([R[2, 1] - R[1, 2], t[1], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]])
    elif k == 2:
        q = np.array([R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], t[2], R[1, 2] + R[2, 1]])
    else:
        q = np.array([R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], t[3]])
    q /= math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        q = -q
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, q[0]) / sine
    return scale * q[1:]


@njit(cache=True)
def right_jacobian(phi: Array) -> Array:
    """J_r: Exp(phi + d) ≈ Exp(phi) Exp(J_r(phi) d) for small d; phi (3,) rad; eq. (143)."""
    out = np.empty((3, 3))
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if angle2 < 1e-4:  # the closed form would lose digits by cancellation
        _polynomial(
            phi, 1.0, -0.5 + angle2 / 24.0 - angle2**2 / 720.0, 1.0 / 6.0 - angle2 / 120.0 + angle2**2 / 5040.0, out
        )
    else:
        angle = math.sqrt(angle2)
        _polynomial(phi, 1.0, -(1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle), out)
    return out


@njit(cache=True)
def inverse_right_jacobian(phi: Array) -> Array:
    """J_r⁻¹: Log(Exp(phi) Exp(d)) ≈ phi + J_r⁻¹(phi) d for small d; |phi| < 2π; eq. (144)."""
    out = np.empty((3, 3))
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if angle2 < 1e-4:
        _polynomial(phi, 1.0, 0.5, 1.0 / 12.0 + angle2 / 720.0 + angle2**2 / 30240.0, out)
    else:
        half = 0.5 * math.sqrt(angle2)
        _polynomial(phi, 1.0, 0.5, (1.0 - half / math.tan(half)) / angle2, out)
    return out


@njit(cache=True)
def yaw_of(R: Array) -> float:
    """Yaw ψ of R = Rz(ψ) Ry(θ) Rx(φ), rad, counter-clockwise from W's first axis."""
    return math.atan2(R[1, 0], R[0, 0])


@njit(cache=True)
def wrap(angle: float) -> float:
    """The same angle in [−π, π)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
