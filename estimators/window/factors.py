"""The factors of the window: readings, displacements and IMU blocks, linearised into rows and ties of its chain.

The physics is that of `measurements` and `imu`; here it is whitened, weighted by its loss, and kept.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...datasets.state import DIM, POSITION, THETA, VELOCITY, Array
from ..physics.imu import predict, process_noise
from ..physics.measurements import measure, preintegrated_dvl_residual, tight_dvl_residual
from ..physics.so3 import exp, product, right_jacobian, skew, transform_into
from ..physics.state import STATE, local, turn_covariance, turn_rows

AT_KEYFRAME, CARRIED, LOOSE, TIGHT = range(4)
"""What a factor is: a reading that was true at its keyframe, one that the IMU carries there, and displacements."""
LOSSES = ("", "huber", "cauchy", "tukey")

FACTOR = np.dtype(
    [
        ("next", "i8"),  # of the same keyframe; -1 for none
        ("form", "i8"),
        ("fresh", "i8"),  # not linearised yet
        ("kind", "i8"),  # of the reading; a displacement is the DVL's
        ("loss", "i8"),  # index in LOSSES
        ("width", "f8"),  # of the loss
        ("cov", "f8", (3, 3)),  # of the residual; a reading at its keyframe brings its own
        ("K", "f8", (3, 3)),  # of `given_rotation`
        ("n", "i8"),  # rows
        ("weight", "f8"),  # that its loss left it when it was linearised
        ("r", "f8", (3,)),  # whitened rows
        ("H", "f8", (3, DIM)),
        ("H_j", "f8", (3, DIM)),  # by the next keyframe
    ]
)
"""Lies beside its READING, its BLOCK where it is carried, and its DISPLACEMENT where it is one: same row of each."""


@njit(cache=True, error_model="numpy")
def weight_of(loss: int, d: float, width: float) -> float:
    """w(d) of `robust`."""
    if loss == 1:
        return 1.0 if d <= width else width / d
    if loss == 2:
        return 1.0 / (1.0 + (d / width) ** 2)
    if loss == 3:
        return (1.0 - (d / width) ** 2) ** 2 if d <= width else 0.0
    return 1.0


@njit(cache=True, error_model="numpy")
def whiten(n: int, C: Array, r: Array, H: Array, H_j: Array) -> bool:
    """Divide n rows by the Cholesky factor of their covariance C, which is used up; False where it has none."""
    for k in range(n):
        if not C[k, k] > 0.0:
            return False
        root = math.sqrt(C[k, k])
        r[k] /= root
        for j in range(DIM):
            H[k, j] /= root
            H_j[k, j] /= root
        for i in range(k + 1, n):
            L = C[i, k] / root
            r[i] -= L * r[k]
            for j in range(DIM):
                H[i, j] -= L * H[k, j]
                H_j[i, j] -= L * H_j[k, j]
            for j in range(k + 1, n):
                C[i, j] -= L * C[k, j] / root
    return True


@njit(cache=True, error_model="numpy")
def linearise_factor(
    factors: NDArray[Any], f: int, readings: NDArray[Any], carries: NDArray[Any], displacements: NDArray[Any],
    x_i: NDArray[Any], x_j: NDArray[Any], rig: NDArray[Any],
) -> bool:  # fmt: skip
    """Linearise factor f at STATE records x_i and, for a displacement, x_j; False where its covariance is none.

    The first time, a reading that is carried gets the noise of the block that carries it.
    """
    g = factors[f]
    r, H, H_j, C = np.zeros(3), np.zeros((3, DIM)), np.zeros((3, DIM)), np.zeros((3, 3))
    n, e = 3, x_j[0]
    at = x_i.copy()
    s = at[0]
    if g.form <= CARRIED:
        F = np.zeros((DIM, DIM))
        if g.form == CARRIED:
            predict(carries[f : f + 1], x_i, rig[0].gravity, F, at)
        n = measure(readings, f, at, rig, r, H, C)
        if g.form == CARRIED:
            if g.fresh:
                Q, HQ = np.empty((DIM, DIM)), np.zeros((3, DIM))
                process_noise(carries[f : f + 1], x_i[0].R_WB, Q)
                chain(n, H, Q, HQ)
                for i in range(n):
                    for j in range(n):
                        for k in range(DIM):
                            C[i, j] += HQ[i, k] * H[j, k]
                g.cov[:] = C
            C[:] = g.cov
            of_end = H.copy()
            chain(n, of_end, F, H)
    else:
        C[:] = g.cov
        R_i, p_i, R_j, p_j = s.R_WB.copy(), s.p_WB_W.copy(), e.R_WB.copy(), e.p_WB_W.copy()
        if g.form == LOOSE:
            r[:] = preintegrated_dvl_residual(R_i, p_i, p_j, displacements[f].dp.copy(), H, H_j)
        else:
            K = g.K.copy()
            r[:] = tight_dvl_residual(R_i, p_i, s.b_g.copy(), R_j, p_j, displacements[f : f + 1], K, H, H_j)
    if not whiten(n, C, r, H, H_j):
        return False
    g.n, g.fresh = n, 0
    g.r[:], g.H[:], g.H_j[:] = r, H, H_j
    g.weight = weight_of(g.loss, length(r, n), g.width)
    return True


@njit(cache=True, error_model="numpy")
def chain(n: int, A: Array, F: Array, out: Array) -> None:
    """out = A F for n rows."""
    for i in range(n):
        for j in range(DIM):
            out[i, j] = 0.0
        for k in range(DIM):
            if A[i, k] != 0.0:
                for j in range(DIM):
                    out[i, j] += A[i, k] * F[k, j]


@njit(cache=True, error_model="numpy")
def length(r: Array, n: int) -> float:
    """Of the first n components."""
    total = 0.0
    for k in range(n):
        total += r[k] ** 2
    return math.sqrt(total)


@njit(cache=True, error_model="numpy")
def distance(factors: NDArray[Any], f: int, d_i: Array, d_j: Array) -> float:
    """Length of a factor's whitened residual at increments (15,) from where it was last linearised."""
    g, r = factors[f], np.empty(3)
    for row in range(g.n):
        r[row] = g.r[row]
        for k in range(DIM):
            r[row] += g.H[row, k] * d_i[k] + g.H_j[row, k] * d_j[k]
    return length(r, g.n)


@njit(cache=True, error_model="numpy")
def linearise_tie(
    block: NDArray[Any], x_i: NDArray[Any], x_j: NDArray[Any], gravity: float, F: Array, Q: Array, c: Array
) -> None:
    """Fill the tie δ_j = F δ_i + c + noise(Q) that a BLOCK makes between two STATE records.

    With x the prediction from x_i, the residual stands in the axes of B at j, as GTSAM's does (it matters only where
    one of the two is kept while the other moves):

        e = Log(Rᵀ R_j)     R_jᵀ e_p = R_jᵀ (p_j − p)     R_jᵀ e_v = R_jᵀ (v_j − v)     b_j − b

    Where x_j lies e off x, a rotation error that starts at x is carried there by Exp(−e), noise by J_r(e), and the two
    positions and velocities are seen turned by it: δp_j gains −[e_p]× R_j δθ_j, and δv_j likewise.
    """
    end = np.empty(1, STATE)
    predict(block, x_i, gravity, F, end)
    process_noise(block, x_i[0].R_WB, Q)
    b = x_j[0]
    local(end, x_j, c)
    e = c[THETA].copy()
    for i in range(DIM):
        c[i] = -c[i]
    A = np.zeros((9, 3))  # what p and v gain by the rotation of j; c is minus the residual
    A[3:6], A[6:9] = product(skew(c[POSITION]), b.R_WB), product(skew(c[VELOCITY]), b.R_WB)
    turn_rows(F, exp(-e))
    turn_covariance(Q, right_jacobian(e))
    for i in range(3, 9):
        for k in range(3):
            c[i] += A[i, k] * c[k]
            for j in range(DIM):
                F[i, j] += A[i, k] * F[k, j]
                Q[i, j] += A[i, k] * Q[k, j]
    for i in range(3, 9):
        for k in range(3):
            for j in range(DIM):
                Q[j, i] += A[i, k] * Q[j, k]


@njit(cache=True, error_model="numpy")
def linearise_prior(anchor: NDArray[Any], mean: Array, x: NDArray[Any], m: Array, P: Array) -> None:
    """Fill N(m, P) of the error at x that N(mean, anchor.P) of the error at the anchor makes; STATE records."""
    local(anchor, x, m)
    J = right_jacobian(m[THETA])
    for i in range(DIM):
        m[i] = mean[i] - m[i]
    lacking = m[THETA].copy()
    transform_into(J, lacking, m[THETA])
    P[:] = anchor[0].P
    turn_covariance(P, J)
