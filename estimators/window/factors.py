"""The factors of the window: readings, displacements and IMU blocks, linearised into rows and ties of its chain.

The physics is that of `physics`; here it is whitened, weighted by its loss, and kept. Equation numbers are those of
docs/window.md.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.state import DIM, THETA, VELOCITY, Array
from ..physics.blocks import clear, identity, rows_times, set_block, set_product
from ..physics.elimination import add_scaled, decorrelate
from ..physics.imu import predict, process_noise
from ..physics.invariant import as_invariant, congruent, error_after_invariant, local_invariant, to_invariant
from ..physics.measurements import measure, preintegrated_dvl_residual, tight_dvl_residual
from ..physics.so3 import exp_into, product_into, right_jacobian_into, skew_into, transform_into
from ..physics.state import STATE, THETA_0, VELOCITY_0, turn_rows
from ..physics.tie import mixed_jacobian_into, tie_residual
from ..robust import weight_of
from .chain import copy_into

AT_KEYFRAME, CARRIED, LOOSE, TIGHT = range(4)
"""What a factor is: a reading that was true at its keyframe, one that the IMU carries there, and displacements."""

AT_PREDICTION = 1e-3
"""rad and m/s: carried to a state this near the prediction, the noise of an IMU block changes by a thousandth."""

FACTOR = np.dtype(
    [
        ("next", "i8"),  # of the same keyframe; -1 for none
        ("form", "i8"),
        ("fresh", "i8"),  # not linearised yet
        ("kind", "i8"),  # of the reading; a displacement is the DVL's
        ("loss", "i8"),  # index in LOSSES
        ("width", "f8"),  # of the loss, by its rows
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


@inner
def whiten(n: int, C: Array, r: Array, H: Array, H_j: Array) -> bool:
    """Make n rows of covariance C, which is used up, independent and of variance 1; False where C is no covariance."""
    decorrelate(n, r, H, C)
    for i in range(n):
        for k in range(i):
            add_scaled(H_j[i], -C[i, k], H_j[k])
    for k in range(n):
        if not C[k, k] > 0.0:
            return False
        root = math.sqrt(C[k, k])
        r[k] /= root
        for j in range(DIM):
            H[k, j] /= root
            H_j[k, j] /= root
    return True


@compiled
def linearise_factor(
    factors: NDArray[Any], f: int, readings: NDArray[Any], carries: NDArray[Any], displacements: NDArray[Any],
    x_i: NDArray[Any], x_j: NDArray[Any], rig: NDArray[Any], widths: Array,
) -> bool:  # fmt: skip
    """Linearise factor f at STATE records x_i and, for a displacement, x_j; False where it has no covariance.

    Args:
        factors, readings, carries, displacements: row f of each is the factor.
        x_i, x_j: where.
        rig: RIG record.
        widths: (kinds, 4) of the losses, by kind and number of rows.
    """
    g, C = factors[f], np.empty((3, 3))
    if g.form <= CARRIED:
        clear(g.H_j[:])
        if g.form == CARRIED:
            n = linearise_carried(factors, f, readings, carries, x_i, rig, C)
        else:
            n = measure(readings, f, x_i, rig, g.r[:], g.H[:], C)
    else:
        n = 3
        for i in range(3):
            for j in range(3):
                C[i, j] = g.cov[i, j]
        s, e, d = x_i[0], x_j[0], displacements[f]
        if g.form == LOOSE:
            r = preintegrated_dvl_residual(s.R_WB[:], s.p_WB_W[:], e.p_WB_W[:], d.dp[:], g.H[:], g.H_j[:])
        else:
            of_f = displacements[f : f + 1]
            r = tight_dvl_residual(
                s.R_WB[:], s.p_WB_W[:], s.b_g[:], e.R_WB[:], e.p_WB_W[:], of_f, g.K[:], g.H[:], g.H_j[:]
            )
        for i in range(3):
            g.r[i] = r[i]
    if not whiten(n, C, g.r[:], g.H[:], g.H_j[:]):
        return False
    g.n, g.fresh, g.width = n, 0, widths[g.kind, n]
    g.weight = weight_of(g.loss, length(g.r[:], n), g.width)
    return True


@inner
def linearise_carried(
    factors: NDArray[Any], f: int, readings: NDArray[Any], carries: NDArray[Any], x_i: NDArray[Any],
    rig: NDArray[Any], C: Array,
) -> int:  # fmt: skip
    """Fill r and H of a reading that the IMU carries to its keyframe, and C, its covariance; return how many rows.

    C = C_z + H Q Hᵀ, with the noise of the block as it was the first time.
    """
    g, H, F, end = factors[f], np.empty((3, DIM)), np.empty((DIM, DIM)), np.empty(1, STATE)
    predict(carries[f : f + 1], x_i, rig[0].gravity, F, end)
    n = measure(readings, f, end, rig, g.r[:], H, C)
    rows_times(n, H, F, g.H[:])
    if g.fresh:
        HQ = np.empty((3, DIM))
        process_noise(carries[f : f + 1], x_i[0].R_WB[:], F)
        rows_times(n, H, F, HQ)
        for i in range(n):
            for j in range(n):
                for k in range(DIM):
                    C[i, j] += HQ[i, k] * H[j, k]
                g.cov[i, j] = C[i, j]
    else:
        for i in range(n):
            for j in range(n):
                C[i, j] = g.cov[i, j]
    return n


@inner
def length(r: Array, n: int) -> float:
    """Of the first n components."""
    total = 0.0
    for k in range(n):
        total += r[k] ** 2
    return math.sqrt(total)


@inner
def distance(factors: NDArray[Any], f: int, d_i: Array, d_j: Array) -> float:
    """Length of a factor's whitened residual at increments (15,) from where it was last linearised."""
    g, r = factors[f], np.empty(3)
    for row in range(g.n):
        r[row] = g.r[row]
        for k in range(DIM):
            r[row] += g.H[row, k] * d_i[k] + g.H_j[row, k] * d_j[k]
    return length(r, g.n)


@compiled
def linearise_tie(
    block: NDArray[Any], x_i: NDArray[Any], x_j: NDArray[Any], gravity: float, F: Array, Q: Array, c: Array
) -> None:
    """Fill the tie δ_j = F δ_i + c + noise(Q) that a BLOCK makes between two STATE records; docs/window.md (14).

    It is `tie_residual` solved for δ_j. Where x_j lies e = x_j ⊖ x⁻ off the prediction x⁻ from x_i, with the residual's
    rotation φ and velocity ν, an error (θ, e_v) that starts at x⁻ is carried there by the adjoint of SE_2(3), and noise
    by its right Jacobian, whose lower block is that of the left at −φ, −ν.
    """
    end, matrices, r, vectors = np.empty(1, STATE), np.empty((3, 3, 3)), np.empty(DIM), np.empty((3, 3))
    turn, S, A = matrices[0], matrices[1], matrices[2]
    gap, back, lacking = vectors[0], vectors[1], vectors[2]
    predict(block, x_i, gravity, F, end)
    process_noise(block, x_i[0].R_WB[:], Q)
    tie_residual(end, x_j, r)
    s, size = x_j[0], 0.0
    for i in range(3):
        gap[i] = end[0].v_WB_W[i] - s.v_WB_W[i]
        back[i], lacking[i] = -r[THETA_0 + i], -r[VELOCITY_0 + i]
        size += back[i] ** 2 + lacking[i] ** 2
    for i in range(DIM):
        c[i] = -r[i]
    transform_into(s.R_WB[:], lacking, c[VELOCITY])
    exp_into(back, turn)
    turn_rows(F, turn)
    skew_into(gap, S)
    product_into(S, s.R_WB[:], A)
    for i in range(3):
        for k in range(3):
            for j in range(DIM):
                F[VELOCITY_0 + i, j] += A[i, k] * F[THETA_0 + k, j]
    if size > AT_PREDICTION**2:
        carry_noise(end, s.R_WB[:], r, Q)


@compiled
def carry_noise(end: NDArray[Any], R_j: Array, r: Array, Q: Array) -> None:
    """Carry the noise Q (15, 15) of a block from its prediction, a STATE record, to R_j, where its residual is r."""
    matrices, M, back = np.empty((7, 3, 3)), np.empty((DIM, DIM)), np.empty((2, 3))
    J, mixed, R_JW, turned = matrices[0], matrices[1], matrices[2], matrices[3]
    for i in range(3):
        back[0, i], back[1, i] = -r[THETA_0 + i], -r[VELOCITY_0 + i]
    right_jacobian_into(r[THETA], J)
    mixed_jacobian_into(back[0], back[1], mixed, matrices[4:7])
    for i in range(3):
        for j in range(3):
            R_JW[i, j] = end[0].R_WB[j, i]
    product_into(J, R_JW, turned)
    identity(M)
    set_block(M, THETA_0, THETA_0, 1.0, J)
    set_product(M, VELOCITY_0, THETA_0, 1.0, R_j, mixed)
    set_product(M, VELOCITY_0, VELOCITY_0, 1.0, R_j, turned)
    congruent(M, Q)


@compiled
def linearise_prior(anchor: NDArray[Any], mean: Array, x: NDArray[Any], m: Array, P: Array) -> None:
    """Fill N(m, P) of the error at x from N(mean, anchor.P) of that at the anchor; docs/window.md (12).

    What is normal is the invariant error ξ of x from the anchor (`invariant`), which the error at the anchor turns into
    by its derivative there.

    Args:
        anchor, x: STATE records.
        mean, m, P: (15,), (15,), (15, 15).
    """
    a, xi, at, K = anchor[0], np.empty(DIM), np.empty(DIM), np.empty((DIM, DIM))
    as_invariant(anchor, mean, xi)
    local_invariant(anchor, x, at)
    error_after_invariant(x, at, K)
    copy_into(a.P[:], P)
    congruent(to_invariant(a.R_WB[:], a.v_WB_W[:]), P)
    congruent(K, P)
    for i in range(DIM):
        m[i] = 0.0
        for j in range(DIM):
            m[i] += K[i, j] * (xi[j] - at[j])
