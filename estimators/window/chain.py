"""Gauss–Newton's normal equations on a chain of keyframes, each tied to its neighbours; docs/conventions.md (45).

docs/window.md derives them. They are block-tridiagonal, 15 × 15, and are eliminated in the covariance form, in which
nothing cancels:

    δ_j = F δ_i + c + noise of covariance Q                                   a tie from keyframe i to the next, j
    N(m, P)              of δ_i, given all that is older and i's own rows
    N(m_given, P_given)  of δ_j, given the same and the rows of both
    G = cov(δ_i, δ_j) P_given⁻¹                       d_i = m + G (d_j − m_given)          the back substitution

A row is r + H δ (+ H_j δ_j), of some variance. Inner loops run along rows of fixed length, so that they compile to
vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import DIM, Array
from ..physics.blocks import clear
from ..physics.elimination import add_scaled
from ..physics.state import symmetrise

NODE = np.dtype(
    [
        # the fields that a back-substitution reads are adjacent
        ("Gt", "f8", (DIM, DIM)),  # Gᵀ
        ("m", "f8", (DIM,)),  # mean given its own rows and everything older
        ("m_given", "f8", (DIM,)),  # mean given everything older
        ("d", "f8", (DIM,)),  # the increment: mean given everything
        ("t_ns", "i8"),
        ("imu_from", "i8"),  # first of the samples since
        ("first", "i8"),  # of its factors; -1 for none
        ("moved", "i8"),  # linearised anew in this update
        ("P", "f8", (DIM, DIM)),  # as m
        ("P_given", "f8", (DIM, DIM)),  # as m_given
        ("P_smoothed", "f8", (DIM, DIM)),  # as d, where `smooth_covariances` has been
        ("F", "f8", (DIM, DIM)),  # the tie to the next keyframe
        ("Q", "f8", (DIM, DIM)),
        ("c", "f8", (DIM,)),
    ]
)
"""Nodes lie in a ring whose length is a power of two: keyframe k in slot k & (length − 1)."""


@compiled
def absorb_joint_row(
    r: float, h_i: Array, h_j: Array, variance: float,
    m_i: Array, P_i: Array, m_j: Array, P_j: Array, P_ji: Array,
) -> bool:  # fmt: skip
    """Add the row r + h_i δ_i + h_j δ_j to the joint density of both, P_ji = cov(δ_j, δ_i).

    See docs/window.md (5), for a row (3).
    """
    PH = np.zeros((2, DIM))
    PH_i, PH_j = PH[0], PH[1]
    for k in range(DIM):
        add_scaled(PH_i, h_i[k], P_i[k])
        add_scaled(PH_i, h_j[k], P_ji[k])
        add_scaled(PH_j, h_j[k], P_j[k])
        for i in range(DIM):
            PH_j[k] += P_ji[k, i] * h_i[i]
    S, innovation = variance, -r
    for i in range(DIM):
        S += h_i[i] * PH_i[i] + h_j[i] * PH_j[i]
        innovation -= h_i[i] * m_i[i] + h_j[i] * m_j[i]
    if not S > 0.0:
        return False
    add_scaled(m_i, innovation / S, PH_i)
    add_scaled(m_j, innovation / S, PH_j)
    for i in range(DIM):
        add_scaled(P_i[i], -PH_i[i] / S, PH_i)
        add_scaled(P_j[i], -PH_j[i] / S, PH_j)
        add_scaled(P_ji[i], -PH_j[i] / S, PH_i)
    return True


@compiled
def cross_tie(F: Array, Q: Array, c: Array, m: Array, P: Array, m_j: Array, P_j: Array, P_ji: Array) -> None:
    """Carry N(m, P) of δ_i over the tie: fill m_j = F m + c, P_ji = F P, P_j = F P Fᵀ + Q; docs/window.md (6)."""
    P_ij = np.empty((DIM, DIM))
    clear(P_ji)
    for a in range(DIM):
        m_j[a] = c[a]
        for k in range(DIM):
            if F[a, k] != 0.0:
                m_j[a] += F[a, k] * m[k]
                add_scaled(P_ji[a], F[a, k], P[k])
        for k in range(DIM):
            P_ij[k, a] = P_ji[a, k]
    for a in range(DIM):
        for b in range(DIM):
            P_j[a, b] = Q[a, b]
        for k in range(DIM):
            if F[a, k] != 0.0:
                add_scaled(P_j[a], F[a, k], P_ij[k])
    symmetrise(P_j)


@compiled
def back_substitute(nodes: NDArray[Any], low: int, newest: int) -> None:
    """Fill the increments d of keyframes low to newest; docs/window.md (8)."""
    mask, x = len(nodes) - 1, np.empty(DIM)
    last = nodes[newest & mask]
    for i in range(DIM):
        last.d[i] = last.m[i]
    for k in range(newest - 1, low - 1, -1):
        n, ahead = nodes[k & mask], nodes[(k + 1) & mask]
        Gt, m, d, d_j, m_j = n.Gt, n.m, n.d, ahead.d, ahead.m_given
        for j in range(DIM):
            x[j] = d_j[j] - m_j[j]
        for i in range(0, DIM, 5):  # five sums at a time stay in registers
            d_0, d_1, d_2, d_3, d_4 = m[i], m[i + 1], m[i + 2], m[i + 3], m[i + 4]
            for j in range(DIM):
                d_0 += Gt[j, i] * x[j]
                d_1 += Gt[j, i + 1] * x[j]
                d_2 += Gt[j, i + 2] * x[j]
                d_3 += Gt[j, i + 3] * x[j]
                d_4 += Gt[j, i + 4] * x[j]
            d[i], d[i + 1], d[i + 2], d[i + 3], d[i + 4] = d_0, d_1, d_2, d_3, d_4


@compiled
def smooth_covariances(nodes: NDArray[Any], low: int, newest: int) -> None:
    """Fill P_smoothed, the covariance of δ given everything, of keyframes newest down to low; docs/window.md (9)."""
    mask, gained = len(nodes) - 1, np.empty((DIM, DIM))
    copy_into(nodes[newest & mask].P[:], nodes[newest & mask].P_smoothed[:])
    for k in range(newest - 1, low - 1, -1):
        node, ahead = nodes[k & mask], nodes[(k + 1) & mask]
        Gt, P, P_ahead, P_given = node.Gt[:], node.P_smoothed[:], ahead.P_smoothed[:], ahead.P_given[:]
        clear(gained)
        for a in range(DIM):
            for b in range(DIM):
                add_scaled(gained[a], P_ahead[a, b] - P_given[a, b], Gt[b])
        copy_into(node.P[:], P)
        for i in range(DIM):
            for a in range(DIM):
                add_scaled(P[i], Gt[a, i], gained[a])
        symmetrise(P)


@inner
def copy_into(A: Array, out: Array) -> None:
    """out ← A, both (15, 15)."""
    for i in range(DIM):
        for j in range(DIM):
            out[i, j] = A[i, j]
