"""The steps of the window, compiled; `window_pass` calls them one after the other, as docs/window.md derives them.

    extend      close an interval, predict the next keyframe, and put the readings that go with it among the factors
    linearise   what is new, and anew what has moved                                    docs/window.md (1) to (4)
    solve       eliminate from the oldest keyframe that changed to the newest, and substitute back            (5) to (8)
    forget      drop the oldest keyframes; the prior of the next one is already computed                            (10)

Numba optimises a function together with all that it calls, and again with each of its callers: so the tree of calls is
flat, and a function takes the arrays that it needs, not all there are.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import Records, compiled, inner
from ...datasets.state import DIM
from ..keyframes import AT_KEYFRAME, CARRIED, KEYFRAME
from ..physics.elimination import absorb_row, divide_into
from ..physics.imu import integrate, predict
from ..physics.invariant import move
from ..physics.state import ACCEL_BIAS_0, GYRO_BIAS_0, POSITION_0, STATE
from . import factors as forms
from .chain import absorb_joint_row, back_substitute, copy_into, cross_tie
from .factors import distance, linearise_factor, linearise_prior, linearise_tie

NO_ROOM = -1
"""Returned by `extend` if keyframes, factors or samples might not fit; nothing is done then."""
SOLVED, NOT_POSITIVE, NOT_FINITE = range(3)
"""Status of a solve."""
CAUSES = {
    NOT_POSITIVE: "an innovation's or a predicted state's covariance is not positive definite",
    NOT_FINITE: "the newest position is not finite",
}
CONVERGED = 1e-6
"""As a share of a sigma: a smaller increment counts as none; a thousandth of what any table of results shows."""
MOST_ITERATIONS = 100
"""Gauss–Newton steps to an optimum; recorded logs take 4 to 12."""

WINDOW = np.dtype(
    [
        # options
        ("thresholds", "f8", (DIM,)),
        ("relinearize_prior", "i8"),
        ("reach", "i8"),  # keyframes to go back in a back substitution
        ("loss", "i8", (5,)),  # by kind of reading, place in LOSSES
        ("widths", "f8", (5, 4)),  # of the loss, by kind and rows
        # where it is
        ("oldest", "i8"),
        ("newest", "i8"),
        ("unsolved", "i8"),  # first keyframe with rows that the solution has not seen; beyond the newest: none
        ("marginalised", "i8"),
        ("mean", "f8", (DIM,)),  # of the prior on the oldest keyframe, at the anchor
        ("free", "i8"),  # first free factor
        ("n_free", "i8"),
        ("n_imu", "i8"),  # rows of IMU in store, and how many have gone before them
        ("imu_gone", "i8"),
        # what happened
        ("relinearised", "i8"),
        ("refactored", "i8"),
        ("outliers", "i8", (5,)),
    ]
)


# --- extend ----------------------------------------------------------------------------------------------------------


@compiled
def extend(
    w: Records, nodes: Records, points: Records, blocks: Records, factors: Records,
    readings: Records, carries: Records, imu: Records, rig: Records, rows: Records,
    orders: NDArray[np.int64], first: int,
) -> int:  # fmt: skip
    """Follow orders from the first on, up to one to sum or to solve; return its place, how many there are, or NO_ROOM.

    Args:
        w: WINDOW record; all records are arrays of length 1.
        nodes, points, blocks: rings of NODE, of STATE (where each keyframe is linearised) and of BLOCK (from each to
            the next), a power of two long: keyframe k in place k & (length − 1).
        factors, readings, carries: FACTOR, READING and BLOCK, row by row.
        imu: IMU_SAMPLE rows; the first is that before the oldest keyframe.
        rig: RIG record.
        rows, orders: of `Keyframes`.
        first: order to begin with.
    """
    v, n, more = w[0], first, len(orders)
    if v.newest - v.oldest + 1 + more > len(nodes) or v.n_free < more or v.n_imu + more > len(imu):
        return NO_ROOM
    while n < len(orders):
        what, k, x = orders[n, 0], orders[n, 1], orders[n, 2]
        if what == KEYFRAME:
            make_keyframe(w, nodes, points, blocks, imu, rig, x)
        elif what in (AT_KEYFRAME, CARRIED):
            form = forms.CARRIED if what == CARRIED else forms.AT_KEYFRAME
            f = add_factor(w, nodes, factors, k, rows[x].kind, form)
            readings[f] = rows[x]
            if what == CARRIED:
                move_along(w, nodes, points, imu, rig, k, rows[x].t_ns, carries[f : f + 1])
        else:
            break
        n += 1
    return n


@inner
def make_keyframe(
    w: Records, nodes: Records, points: Records, blocks: Records, imu: Records,
    rig: Records, t_ns: int,
) -> None:  # fmt: skip
    """Close the newest keyframe's interval at t_ns, and predict a keyframe there by the IMU."""
    v, mask = w[0], len(nodes) - 1
    a, b = v.newest & mask, (v.newest + 1) & mask
    new, F = nodes[b], np.empty((DIM, DIM))
    split_samples(w, imu, nodes[a].imu_from - v.imu_gone, t_ns)
    new.imu_from = end_of(w, imu, nodes[a].imu_from - v.imu_gone, t_ns) + v.imu_gone
    move_along(w, nodes, points, imu, rig, v.newest, t_ns, blocks[a : a + 1])
    x = np.empty(1, STATE)
    move(points[a : a + 1], nodes[a].d[:], x)
    predict(blocks[a : a + 1], x, rig[0].gravity, F, points[b : b + 1])
    new.t_ns, new.first, new.moved = t_ns, -1, 1
    for i in range(DIM):
        new.d[i], new.m[i] = 0.0, 0.0
    v.unsolved = min(v.unsolved, v.newest)
    v.newest += 1


@inner
def end_of(w: Records, imu: Records, first: int, t_ns: int) -> int:
    """Return the place of the first sample, from `first` on, that ends after t_ns."""
    while first < w[0].n_imu and imu[first].t_ns <= t_ns:
        first += 1
    return first


@inner
def split_samples(w: Records, imu: Records, first: int, t_ns: int) -> None:
    """Split the sample that straddles t_ns, if one does, into two of the same rates."""
    k = end_of(w, imu, first, t_ns)
    if k < w[0].n_imu:
        began_ns = imu[k].t_ns - round(imu[k].dt_s * 1e9)
        if began_ns < t_ns:
            for m in range(w[0].n_imu, k, -1):
                imu[m] = imu[m - 1]
            w[0].n_imu += 1
            imu[k + 1].dt_s = (imu[k + 1].t_ns - t_ns) * 1e-9
            end_at(imu[k], began_ns, t_ns)


@inner
def end_at(sample: Any, began_ns: int, t_ns: int) -> None:
    """Let a sample that began at began_ns end at t_ns, which lies within it."""
    sample.after_s -= (sample.t_ns - t_ns) * 1e-9
    sample.dt_s, sample.t_ns = (t_ns - began_ns) * 1e-9, t_ns


@inner
def move_along(
    w: Records, nodes: Records, points: Records, imu: Records, rig: Records, k: int,
    t_ns: int, block: Records,
) -> None:  # fmt: skip
    """Integrate the motion from keyframe k to t_ns into a BLOCK, at the biases of keyframe k as they are now."""
    v, a = w[0], k & (len(nodes) - 1)
    first, biases = nodes[a].imu_from - v.imu_gone, np.empty((2, 3))
    x, d = points[a], nodes[a].d
    for i in range(3):
        biases[0, i], biases[1, i] = x.b_a[i] + d[ACCEL_BIAS_0 + i], x.b_g[i] + d[GYRO_BIAS_0 + i]
    end = end_of(w, imu, first, t_ns)
    part = imu[first:end]
    if end < v.n_imu:
        began_ns = imu[end].t_ns - round(imu[end].dt_s * 1e9)
        if began_ns < t_ns:
            part = imu[first : end + 1].copy()
            end_at(part[end - first], began_ns, t_ns)
    integrate(part, imu[first - 1 : first], biases[0], biases[1], rig, block)


@compiled
def add_factor(w: Records, nodes: Records, factors: Records, k: int, kind: int, form: int) -> int:
    """Return a free row, as a factor on keyframe k."""
    v, node = w[0], nodes[k & (len(nodes) - 1)]
    f = v.free
    factor = factors[f]
    v.free = factor.next
    v.n_free -= 1
    factor.kind, factor.loss, factor.fresh, factor.form = kind, v.loss[kind], 1, form
    factor.next = node.first
    node.first = f
    v.unsolved = min(v.unsolved, k)
    return f


# --- linearise --------------------------------------------------------------------------------------------------------


@compiled
def linearise(
    w: Records, nodes: Records, points: Records, blocks: Records, factors: Records,
    readings: Records, carries: Records, displacements: Records, anchor: Records,
    rig: Records, exact: bool,
) -> int:  # fmt: skip
    """Linearise what is new, and anew the keyframes that have moved beyond the thresholds, or, `exact`, at all.

    Returns from where the chain is to be factored anew: beyond the newest where nothing is new or has moved, and -1
    where a factor has no covariance.
    """
    v, mask = w[0], len(nodes) - 1
    first = v.newest + 1
    low = v.oldest + 1 if v.marginalised == 1 and v.relinearize_prior == 0 else v.oldest
    if not exact:
        low = max(low, v.newest - v.reach)
    for k in range(low, v.newest + 1):
        a = k & mask
        if has_moved(w, nodes, a, exact):
            move(points[a : a + 1], nodes[a].d[:], points[a : a + 1])
            for i in range(DIM):
                nodes[a].d[i] = 0.0
            nodes[a].moved = 1
            first = min(first, k)
            v.relinearised += 1
    if first == v.oldest:
        a = first & mask
        linearise_prior(anchor, v.mean[:], points[a : a + 1], nodes[a].m_given[:], nodes[a].P_given[:])
    first = max(v.oldest, min(first - 1, v.unsolved)) if first <= v.newest else v.unsolved
    for k in range(first, v.newest + 1):
        a, b = k & mask, (k + 1) & mask
        node, x_i, x_j = nodes[a], points[a : a + 1], points[b : b + 1]
        own = node.moved == 1
        either = own or (k < v.newest and nodes[b].moved == 1)
        f = node.first
        while f >= 0:
            factor = factors[f]
            stale = factor.fresh == 1 or own or (either and factor.form > forms.CARRIED)
            if stale and not linearise_factor(factors, f, readings, carries, displacements, x_i, x_j, rig, v.widths[:]):
                return -1
            f = factor.next
        if either and k < v.newest:
            linearise_tie(blocks[a : a + 1], x_i, x_j, rig[0].gravity, node.F[:], node.Q[:], node.c[:])
    for k in range(first, v.newest + 1):
        nodes[k & mask].moved = 0
    return first


@inner
def has_moved(w: Records, nodes: Records, a: int, exact: bool) -> bool:
    """Whether the increment in place a is beyond the thresholds, or, `exact`, more than rounding."""
    node = nodes[a]
    for i in range(DIM):
        size = abs(node.d[i])
        if (exact or size > w[0].thresholds[i]) and size > CONVERGED * math.sqrt(max(node.P[i, i], 0.0)):
            return True
    return False


@compiled
def solve(
    w: Records, nodes: Records, points: Records, factors: Records, first: int, reach: int
) -> int:  # fmt: skip
    """Factor anew from keyframe `first` on, and find the increments of it and of `reach` keyframes at least.

    Returns SOLVED or a key of CAUSES.
    """
    v, mask, P_ji = w[0], len(nodes) - 1, np.empty((DIM, DIM))
    for k in range(first, v.newest + 1):
        node, ahead = nodes[k & mask], nodes[(k + 1) & mask]
        for i in range(DIM):
            node.m[i] = node.m_given[i]
        m, P, m_j, P_j = node.m[:], node.P[:], ahead.m_given[:], ahead.P_given[:]
        copy_into(node.P_given[:], P)
        f = node.first
        while f >= 0:
            g = factors[f]
            if g.form <= forms.CARRIED and g.weight > 0.0:
                for row in range(g.n):
                    if not absorb_row(g.r[row], g.H[row], 1.0 / g.weight, m, P):
                        return NOT_POSITIVE
            f = g.next
        v.refactored += 1
        if k == v.newest:
            break
        cross_tie(node.F[:], node.Q[:], node.c[:], m, P, m_j, P_j, P_ji)
        f = node.first
        while f >= 0:
            g = factors[f]
            if g.form > forms.CARRIED and g.weight > 0.0:
                for row in range(g.n):
                    if not absorb_joint_row(
                        g.r[row], g.H[row], g.H_j[row], 1.0 / g.weight, m, P, m_j, P_j, P_ji
                    ):  # fmt: skip
                        return NOT_POSITIVE
            f = g.next
        if not divide_into(P_j, P_ji, node.Gt[:]):
            return NOT_POSITIVE
    back_substitute(nodes, max(v.oldest, min(first, v.newest - reach)), v.newest)
    v.unsolved = v.newest + 1
    x, d = points[v.newest & mask], nodes[v.newest & mask].d
    for i in range(3):
        if not math.isfinite(x.p_WB_W[i] + d[POSITION_0 + i]):
            return NOT_FINITE
    return SOLVED


@compiled
def forget(
    w: Records, nodes: Records, points: Records, factors: Records, anchor: Records,
    oldest: int,
) -> None:  # fmt: skip
    """Marginalise out the keyframes before `oldest`; their information becomes its prior, at the anchor."""
    v, mask = w[0], len(nodes) - 1
    count_outliers(w, nodes, factors, oldest)
    for k in range(v.oldest, oldest):
        f = nodes[k & mask].first
        while f >= 0:
            following = factors[f].next
            factors[f].next = v.free
            v.free = f
            v.n_free += 1
            f = following
    v.oldest, v.marginalised = oldest, 1
    node = nodes[oldest & mask]
    anchor[0] = points[oldest & mask]
    copy_into(node.P_given[:], anchor[0].P[:])
    for i in range(DIM):
        v.mean[i] = node.m_given[i]


@compiled
def count_outliers(w: Records, nodes: Records, factors: Records, until: int) -> None:
    """Count the factors on the keyframes before `until` that end beyond the width of their loss."""
    v, mask = w[0], len(nodes) - 1
    for k in range(v.oldest, until):
        f = nodes[k & mask].first
        while f >= 0:
            g = factors[f]
            if g.loss > 0:
                v.outliers[g.kind] += distance(factors, f, nodes[k & mask].d[:], nodes[(k + 1) & mask].d[:]) > g.width
            f = g.next
