"""Elimination: how scalar rows are taken into a Gaussian belief, made independent, and solved for; once, for all.

A row r + h δ, of some variance, is a residual r with its derivative h (15,) by the error δ. A Gaussian belief N(m, P)
of δ takes it in by

    S = h P hᵀ + variance        K = P hᵀ / S        m ← m − K (r + h m)        P ← P − K h P

Inner loops run along rows of fixed length, so that they compile to vector instructions.
"""

from __future__ import annotations

import math

import numpy as np

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import DIM, Array

NO_VARIANCE = 1e-14
"""Of a component's own variance: a remainder below this is explained by the other components, up to rounding."""
NEGATIVE = -1e-9
"""Of a component's own variance: a remainder below this is not rounding: the matrix is not positive semi-definite."""


@inner
def add_scaled(out: Array, a: float, x: Array) -> None:
    """out += a x, for fifteen components."""
    for i in range(DIM):
        out[i] += a * x[i]


@compiled
def project(h: Array, P: Array, variance: float, PH: Array) -> float:
    """Fill PH (15,) = P hᵀ; return the variance of a row's innovation, S = h P hᵀ + variance."""
    for i in range(DIM):
        PH[i] = 0.0
    for k in range(DIM):
        if h[k] != 0.0:
            add_scaled(PH, h[k], P[k])
    S = variance
    for i in range(DIM):
        S += h[i] * PH[i]
    return S


@compiled
def absorb_row(r: float, h: Array, variance: float, m: Array, P: Array) -> bool:
    """Add the row r + h δ, of some variance, to N(m, P) of δ; False where the innovation's variance is not positive."""
    PH = np.empty(DIM)
    S, innovation = project(h, P, variance, PH), -r
    for i in range(DIM):
        innovation -= h[i] * m[i]
    if not S > 0.0:
        return False
    add_scaled(m, innovation / S, PH)
    for i in range(DIM):
        add_scaled(P[i], -PH[i] / S, PH)
    return True


@compiled
def absorb(n: int, r: Array, H: Array, C: Array, m: Array, P: Array) -> bool:
    """Add n rows r + H δ, their errors of covariance C, to N(m, P) of δ; r, H and C are used up.

    Rows of independent errors are taken in one by one: exactly the joint update, and no matrix to invert. Returns False
    where an innovation's variance is not positive.
    """
    decorrelate(n, r, H, C)
    for row in range(n):  # noqa: SIM110 - numba compiles no generator
        if not absorb_row(r[row], H[row], C[row, row], m, P):
            return False
    return True


@compiled
def decorrelate(n: int, r: Array, H: Array, C: Array) -> None:
    """Subtract from each of n rows what the rows before it say of its error, of covariance C = L D Lᵀ.

    D stands on C's diagonal afterwards and L below it, for other columns of H.
    """
    for k in range(n):
        for i in range(k + 1, n):
            if C[i, k] != 0.0:
                share = C[i, k] / C[k, k]
                r[i] -= share * r[k]
                for j in range(H.shape[1]):
                    H[i, j] -= share * H[k, j]
                for j in range(k + 1, n):
                    C[i, j] -= share * C[k, j]
                C[i, k] = share


@compiled
def normalised_square(n: int, r: Array, H: Array, S: Array) -> float:
    """Return rᵀ S⁻¹ r of n rows; NaN where S is not positive. r, S and H, which does not matter, are used up."""
    decorrelate(n, r, H, S)
    total = 0.0
    for k in range(n):
        if not S[k, k] > 0.0:
            return np.nan
        total += r[k] * r[k] / S[k, k]
    return total


@compiled
def divide_into(P: Array, A: Array, X: Array) -> bool:
    """Fill X = P⁻¹ A, all (15, 15), by elimination of P's correlations; False where P is no covariance.

    What has no variance, or none of its own, is left out of the inverse.
    """
    scale, L = np.empty(DIM), np.empty((DIM, DIM))
    for i in range(DIM):
        if not P[i, i] >= 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(P[i, i]) if P[i, i] > 0.0 else 0.0
    for i in range(DIM):
        for j in range(DIM):
            L[i, j] = P[i, j] * scale[i] * scale[j]
            X[i, j] = A[i, j] * scale[i]
    for k in range(DIM):
        pivot = L[k, k]
        if not pivot > NEGATIVE:
            return False
        inverse = 1.0 / pivot if pivot > NO_VARIANCE else 0.0
        for i in range(k + 1, DIM):
            share = L[i, k] * inverse
            add_scaled(L[i], -share, L[k])
            add_scaled(X[i], -share, X[k])
        for j in range(DIM):
            X[k, j] *= inverse
            L[k, j] *= inverse
    for k in range(DIM - 1, -1, -1):
        for i in range(k):
            add_scaled(X[i], -L[i, k], X[k])
    for i in range(DIM):
        for j in range(DIM):
            X[i, j] *= scale[i]
    return True
