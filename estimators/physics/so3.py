"""Rotations: skew, exponential, logarithm and Jacobians of SO(3), compiled; docs/conventions.md (11) to (14).

Source: Solà, Deray & Atchuthan 2018, arXiv:1812.01537, appendix B. Where an angle is small, coefficients come from
their series.
"""

from __future__ import annotations

import math

import numpy as np

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import Array

SMALL = 1e-4
"""rad; below it, two terms of each series are exact to double precision."""


# Products of matrices and vectors are loops: for three components a call of BLAS costs more than the product,
# and loops compile faster than the same sums written out, and than expressions of arrays and slices.
# Functions named `..._into` write to an array of the caller's, which must not be one of the inputs.


@compiled
def skew_into(a: Array, out: Array) -> None:
    """Write [a]× into `out` (3, 3)."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, i] = 0.0
        out[k, j] = a[i]
        out[j, k] = -a[i]


def skew(a: Array) -> Array:
    """[a]× (..., 3, 3) of vectors (..., 3), with skew(a) @ b = a × b; not compiled."""
    x, y, z = np.moveaxis(np.asarray(a, float), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*np.shape(x), 3, 3)


@compiled
def cross_into(a: Array, b: Array, out: Array) -> None:
    """Write a × b into `out` (3,)."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = a[j] * b[k] - a[k] * b[j]


@compiled
def cross(a: Array, b: Array) -> Array:
    """a × b."""
    out = np.empty(3)
    cross_into(a, b, out)
    return out


@compiled
def transform_into(R: Array, a: Array, out: Array) -> None:
    """Write R a into `out` (3,)."""
    for i in range(3):
        out[i] = R[i, 0] * a[0] + R[i, 1] * a[1] + R[i, 2] * a[2]


@compiled
def transform(R: Array, a: Array) -> Array:
    """R a."""
    out = np.empty(3)
    transform_into(R, a, out)
    return out


@compiled
def inverse_transform_into(R: Array, a: Array, out: Array) -> None:
    """Write Rᵀ a into `out` (3,)."""
    for i in range(3):
        out[i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]


@compiled
def product_into(A: Array, B: Array, out: Array) -> None:
    """Write A B, all (3, 3), into `out`."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@compiled
def product(A: Array, B: Array) -> Array:
    """A B, both (3, 3)."""
    out = np.empty((3, 3))
    product_into(A, B, out)
    return out


@compiled
def between_into(R_i: Array, R_j: Array, out: Array) -> None:
    """Write R_iᵀ R_j, the rotation from one attitude to another, into `out` (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = R_i[0, i] * R_j[0, j] + R_i[1, i] * R_j[1, j] + R_i[2, i] * R_j[2, j]


@compiled
def between(R_i: Array, R_j: Array) -> Array:
    """R_iᵀ R_j, the rotation from one attitude to another."""
    out = np.empty((3, 3))
    between_into(R_i, R_j, out)
    return out


@inner
def _polynomial(phi: Array, constant: float, first: float, second: float, M: Array) -> None:
    """Write constant I + first [phi]× + second [phi]×², the form of every function below, into M."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        M[i, i] = constant - second * (phi[j] * phi[j] + phi[k] * phi[k])
        M[i, j] = second * phi[i] * phi[j] - first * phi[k]
        M[j, i] = second * phi[i] * phi[j] + first * phi[k]


@compiled
def exp_into(phi: Array, out: Array) -> None:
    """Write Exp(phi) into `out` (3, 3); eq. (134)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    first, second = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    if angle2 >= SMALL * SMALL:
        angle = math.sqrt(angle2)
        first, second = math.sin(angle) / angle, 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2
    _polynomial(phi, 1.0, first, second, out)


@compiled
def exp(phi: Array) -> Array:
    """Exp: rotation vector (3,) rad to rotation matrix (3, 3); eq. (134)."""
    out = np.empty((3, 3))
    exp_into(phi, out)
    return out


@compiled
def log_into(R: Array, out: Array) -> None:
    """Write Log(R) into `out` (3,) rad, of length at most π; inverse of `exp`, eq. (135).

    Goes through the quaternion (w, x, y, z) of largest component, so that it is exact near zero and near π alike.
    """
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    i, largest = -1, 1.0 + trace  # four times the square of the largest component; i: which of x, y, z, or -1 for w
    for m in range(3):
        square = 1.0 + 2.0 * R[m, m] - trace
        if square > largest:
            i, largest = m, square
    if i < 0:
        w = largest
        for m in range(3):
            j, k = (m + 1) % 3, (m + 2) % 3
            out[m] = R[k, j] - R[j, k]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        w = R[k, j] - R[j, k]
        out[i], out[j], out[k] = largest, R[j, i] + R[i, j], R[k, i] + R[i, k]
    norm = math.sqrt(w * w + out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if w < 0.0:
        norm = -norm
    w /= norm
    for m in range(3):
        out[m] /= norm
    sine = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    for m in range(3):
        out[m] *= scale


@compiled
def log(R: Array) -> Array:
    """Log: rotation matrix (3, 3) to rotation vector (3,) rad of length at most π; inverse of `exp`, eq. (135)."""
    out = np.empty(3)
    log_into(R, out)
    return out


@compiled
def right_jacobian_into(phi: Array, out: Array) -> None:
    """Write `right_jacobian` into `out` (3, 3)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    first = -0.5 + angle2 / 24.0 - angle2**2 / 720.0
    second = 1.0 / 6.0 - angle2 / 120.0 + angle2**2 / 5040.0
    if angle2 >= 1e-4:  # below, the closed form would lose digits by cancellation
        angle = math.sqrt(angle2)
        first, second = -(1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    _polynomial(phi, 1.0, first, second, out)


@compiled
def right_jacobian(phi: Array) -> Array:
    """J_r: Exp(phi + d) ≈ Exp(phi) Exp(J_r(phi) d) for small d; phi (3,) rad; eq. (143)."""
    out = np.empty((3, 3))
    right_jacobian_into(phi, out)
    return out


@compiled
def inverse_right_jacobian_into(phi: Array, out: Array) -> None:
    """Write `inverse_right_jacobian` into `out` (3, 3)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    second = 1.0 / 12.0 + angle2 / 720.0 + angle2**2 / 30240.0
    if angle2 >= 1e-4:
        half = 0.5 * math.sqrt(angle2)
        second = (1.0 - half / math.tan(half)) / angle2
    _polynomial(phi, 1.0, 0.5, second, out)


@compiled
def inverse_right_jacobian(phi: Array) -> Array:
    """J_r⁻¹: Log(Exp(phi) Exp(d)) ≈ phi + J_r⁻¹(phi) d for small d; |phi| < 2π; eq. (144)."""
    out = np.empty((3, 3))
    inverse_right_jacobian_into(phi, out)
    return out


@compiled
def yaw_of(R: Array) -> float:
    """Yaw ψ of R = Rz(ψ) Ry(θ) Rx(φ), rad, counter-clockwise from W's first axis."""
    return math.atan2(R[1, 0], R[0, 0])


@compiled
def wrap(angle: float) -> float:
    """The same angle in [−π, π)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
