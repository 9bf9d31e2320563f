"""What a window does, compiled: the steps of `graph_pass`, keyframe for keyframe, on arrays of records.

An interpreter's overhead per keyframe would cost more than the solving. So all that a pass holds lies in a `Store`, and
`drive` and `believe` are one call each. What is done with a reading, and when, is told in `GraphSmoother`.

Numba optimises a function together with all that it calls, and again with each of its callers: so the tree of calls is
flat, and what is long is called from one place.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...datasets.epochs import DEPTH, DVL, HEADING
from ...datasets.state import DIM, Array, TimeArray
from ..physics.dvl_preintegration import given_rotation, preintegrate_dvl
from ..physics.elimination import absorb_row, divide_into, normalised_square
from ..physics.imu import BLOCK, integrate, over_world, predict
from ..physics.kalman import carry, correct, propagate
from ..physics.measurements import measure
from ..physics.state import inject, retract
from .chain import (
    absorb_joint_row,
    back_substitute,
    covariance_with_hindsight,
    cross_tie,
    step_back,
)
from .factors import (
    AT_KEYFRAME,
    CARRIED,
    LOOSE,
    TIGHT,
    distance,
    linearise_factor,
    linearise_prior,
    linearise_tie,
    weight_of,
)

DONE, NOT_POSITIVE, NOT_FINITE, NOT_CONVERGED = range(4)
"""What a call returns."""
CAUSES = {
    NOT_POSITIVE: "an innovation's or a predicted state's covariance is not positive",
    NOT_FINITE: "the newest position is not finite",
    NOT_CONVERGED: "Gauss–Newton has not settled on an optimum of the whole log",
}
CONVERGED = 1e-6
"""Of a sigma: what moves by less has not moved."""
MOST_ITERATIONS = 100
"""Of Gauss–Newton over the whole log; a run that has not converged by then is recorded as diverged."""

WINDOW = np.dtype(
    [
        # what it was told
        ("window_ns", "f8"),
        ("merge_ns", "i8"),
        ("period_ns", "f8"),
        ("timeout_ns", "f8"),
        ("silence_ns", "i8"),
        ("hold_ns", "f8"),
        ("covariance_ns", "i8"),
        ("preintegrates", "i8"),
        ("velocity", "i8"),
        ("tight", "i8"),
        ("straight", "i8"),
        ("thresholds", "f8", (DIM,)),
        ("extra_updates", "i8"),
        ("whole", "i8"),  # linearise anew what touches the marginal prior, too
        ("reach", "i8"),  # keyframes to go back in a back-substitution
        ("to_optimum", "i8"),  # at the end
        ("loss", "i8", (5,)),  # by kind of reading
        ("width", "f8", (5, 4)),  # of the loss, by kind and rows
        # where it is
        ("now_ns", "i8"),
        ("dvl_heard_ns", "i8"),
        ("covariance_due_ns", "i8"),
        ("head", "i8"),  # oldest keyframe
        ("newest", "i8"),
        ("unsolved", "i8"),  # first keyframe with rows that the solution has not seen; beyond the newest: none
        ("marginalised", "i8"),
        ("free", "i8"),  # first free factor
        ("n_free", "i8"),
        ("n_pending", "i8"),
        ("n_imu", "i8"),  # rows of IMU in store, and how many have gone before them
        ("imu_gone", "i8"),
        ("n_ticks", "i8"),
        ("ticks_done", "i8"),
        ("n_out", "i8"),
        # what happened
        ("keyframes", "i8"),
        ("carried", "i8"),
        ("merged", "i8"),
        ("late", "i8"),
        ("late_used", "i8"),
        ("preintegrated", "i8"),
        ("not_summed", "i8"),
        ("relinearised", "i8"),
        ("refactored", "i8"),
        ("outliers", "i8", (5,)),
    ]
)
NODES, FACTORS, SAMPLES, PENDING, TICKS, OUT = 1, 2, 4, 8, 16, 32
"""What a Store can be short of."""


Records: TypeAlias = Any
"""An array, mostly of records; NumPy's types know nothing of their fields."""


class Store(NamedTuple):
    """All that a pass holds.

    Attributes:
        w: WINDOW record.
        nodes, points, blocks: rings of NODE, of STATE (where each keyframe is linearised; P is not used) and of BLOCK
            (from each to the next), a power of two long: keyframe k in slot k & (length − 1).
        anchor: STATE record, where the prior of the oldest keyframe was said; mean: (15,) its mean, with anchor's P.
        factors, readings, carries, displacements: FACTOR, READING, BLOCK and DISPLACEMENT, row by row.
        imu: IMU_SAMPLE rows; the first is that before the oldest keyframe.
        pending: READING rows after the newest keyframe.
        ticks: times at which states with hindsight are wanted.
        out, out_ns: STATE records that have left, and their times; P is NaN where there is none.
        rig: RIG record.
    """

    w: Records
    nodes: Records
    points: Records
    blocks: Records
    anchor: Records
    mean: Records
    factors: Records
    readings: Records
    carries: Records
    displacements: Records
    imu: Records
    pending: Records
    ticks: Records
    out: Records
    out_ns: Records
    rig: Records


@njit(cache=True, error_model="numpy")
def slot(s: Store, k: int) -> int:
    """Where keyframe k lies in the rings."""
    return k & (len(s.nodes) - 1)


@njit(cache=True, error_model="numpy")
def estimate(s: Store, k: int) -> NDArray[Any]:
    """Return keyframe k as it is believed now, a STATE record; its P is of no meaning."""
    a = slot(s, k)
    x = s.points[a : a + 1].copy()
    retract(x, s.nodes[a].d, x)
    return x


# --- the entries -----------------------------------------------------------------------------------------------------

STEP, SOLVE, CLOSE = range(3)
"""What `drive` is asked for: to take in an epoch; to solve with late readings; to let every state leave."""


@njit(cache=True, error_model="numpy")
def drive(s: Store, asked: int, imu: NDArray[Any], readings: NDArray[Any], t_ns: int, tick: bool) -> int:
    """Take in an epoch, or what else is asked for, which may have no samples and no readings.

    Returns DONE, a key of CAUSES, or minus what the store is short of, nothing being done then.
    """
    w = s.w[0]
    short = lacks(s, len(imu), len(readings), t_ns)
    if short:
        return -short
    for k in range(len(imu)):
        s.imu[w.n_imu] = imu[k]
        w.n_imu += 1
    s.nodes[slot(s, w.newest)].imu_to = w.imu_gone + w.n_imu
    w.now_ns = t_ns
    if tick:
        s.ticks[w.n_ticks] = t_ns
        w.n_ticks += 1
    calls = receive(s, readings)
    closed, solved, m = False, asked == STEP, 0
    while True:
        newest_ns = s.nodes[slot(s, w.newest)].t_ns
        at_ns, stays = newest_ns, w.head
        while m < len(calls) and at_ns == newest_ns:
            at_ns = calls[m].t_ns if calls_for_keyframe(s, calls[m]) else newest_ns
            m += 1
        if at_ns == newest_ns and w.now_ns - newest_ns > w.silence_ns:
            at_ns = newest_ns + w.silence_ns
        if at_ns == newest_ns and asked == CLOSE and not closed:
            closed = True
            at_ns = w.now_ns if w.now_ns - newest_ns > w.merge_ns else newest_ns
        if at_ns > newest_ns:
            stays = make_keyframe(s, at_ns)
            leave(s, stays, False)
        elif not solved:  # with what no keyframe has taken along
            solved = True
            if asked == CLOSE:
                for p in range(w.n_pending):
                    add_reading(s, w.newest, accept(s, s.pending[p : p + 1]))
                w.n_pending = 0
        else:
            break
        status = update(s, solved and asked == CLOSE and w.to_optimum)
        if status != DONE:
            return status
        while w.head < stays:
            forget(s)
    if asked == CLOSE:
        for k in range(w.newest - 1, w.head - 1, -1):  # P becomes that with hindsight
            a, b = slot(s, k), slot(s, k + 1)
            P = s.nodes[b].P.copy()
            step_back(s.nodes[a : a + 1], s.nodes[b : b + 1], P)
            s.nodes[a].P[:] = P
        leave(s, w.newest + 1, True)
        for k in range(w.head, w.newest + 1):
            count_outliers(s, k)
    return DONE


@njit(cache=True, error_model="numpy")
def lacks(s: Store, n_imu: int, n_readings: int, t_ns: int) -> int:
    """What might run out in an epoch of so much; nothing needs more than this allows for."""
    w, short = s.w[0], 0
    waiting = n_readings + w.n_pending
    keyframes = waiting + 2 + (t_ns - s.nodes[slot(s, w.newest)].t_ns) // w.silence_ns
    if w.newest - w.head + 1 + keyframes > len(s.nodes):
        short += NODES
    if 2 * waiting + 2 > w.n_free:
        short += FACTORS
    if w.n_imu + n_imu + keyframes > len(s.imu):
        short += SAMPLES
    if waiting > len(s.pending):
        short += PENDING
    if w.n_ticks + 1 > len(s.ticks):
        short += TICKS
    if w.n_out + w.n_ticks - w.ticks_done + 1 > len(s.out):
        short += OUT
    return short


@njit(cache=True, error_model="numpy")
def believe(s: Store, out: NDArray[Any]) -> int:
    """Fill `out`, a STATE record, with the belief now: the newest keyframe's, carried on as a filter would."""
    w = s.w[0]
    a = slot(s, w.newest)
    node = s.nodes[a]
    out[0] = s.points[a]
    out[0].P[:] = node.P
    inject(out, node.m)
    if w.now_ns == node.t_ns and w.n_pending == 0:
        return DONE
    order = in_order(s.pending[: w.n_pending])
    block, done = np.empty(1, BLOCK), node.imu_from - w.imu_gone
    before, rest = s.imu[done - 1 : done], s.imu[done : w.n_imu]
    for m in range(w.n_pending + 1):
        t_ns = w.now_ns if m == w.n_pending else max(s.pending[order[m]].t_ns, node.t_ns)
        part, n, straddles = head_of(rest, t_ns)
        if len(part):
            propagate(out, s.rig, before, part, block)
            before = part[len(part) - 1 :]
        rest = rest[n:]
        if straddles:
            rest = rest.copy()
            rest[0].dt_s = (rest[0].t_ns - t_ns) * 1e-9
        if m < w.n_pending:
            reading = s.pending[order[m] : order[m] + 1].copy()
            weigh(s, reading, out)
            if not correct(out, s.rig, reading):
                return NOT_POSITIVE
    return DONE


# --- readings and keyframes ------------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy")
def in_order(readings: Records) -> TimeArray:
    """Return the rows in the order of their truth; those of one moment stay as they are."""
    order = np.arange(len(readings))
    for i in range(1, len(order)):
        k, j = order[i], i
        while j > 0 and readings[order[j - 1]].t_ns > readings[k].t_ns:
            order[j] = order[j - 1]
            j -= 1
        order[j] = k
    return order


@njit(cache=True, error_model="numpy")
def receive(s: Store, readings: Records) -> Records:
    """Put every reading of an epoch where it belongs; return those that may call for keyframes."""
    w, order = s.w[0], in_order(readings)
    calls: Records = np.empty(len(order), readings.dtype)
    n = 0
    for m in order:
        reading = readings[m]
        kind, measured = reading.kind, 0
        for i in range(3):
            measured += np.isfinite(reading.sigma[i])
        if measured == 0 or np.isinf(s.rig[0].inflate[kind]):
            continue
        if kind == DVL:
            w.dvl_heard_ns = w.now_ns
        if reading.t_ns >= s.nodes[slot(s, w.newest)].t_ns - w.merge_ns:
            s.pending[w.n_pending] = reading
            w.n_pending += 1
            calls[n] = reading
            n += 1
        else:
            receive_late(s, readings[m : m + 1])
    return calls[:n]


@njit(cache=True, error_model="numpy")
def calls_for_keyframe(s: Store, reading: Any) -> bool:
    """Whether a READING makes a keyframe; see `GraphSmoother`."""
    w = s.w[0]
    since_ns = reading.t_ns - s.nodes[slot(s, w.newest)].t_ns
    if since_ns <= w.merge_ns:
        return False
    if reading.kind == DVL:
        return since_ns >= w.period_ns - w.merge_ns
    silent_ns = w.now_ns - w.dvl_heard_ns
    return silent_ns >= w.timeout_ns and since_ns >= max(w.period_ns - w.merge_ns, w.timeout_ns - w.merge_ns)


@njit(cache=True, error_model="numpy")
def receive_late(s: Store, reading: NDArray[Any]) -> None:
    """Tie a reading older than the newest keyframe to the one before it, if that is still in the window."""
    w = s.w[0]
    k = w.newest
    while k >= w.head and s.nodes[slot(s, k)].t_ns > reading[0].t_ns + w.merge_ns:
        k -= 1
    if k < w.head:
        w.late += 1
        return
    w.late_used += 1
    add_reading(s, k, accept(s, reading))


@njit(cache=True, error_model="numpy")
def make_keyframe(s: Store, t_ns: int) -> int:
    """Close the newest keyframe's interval at t_ns, start the next one there, and hand the pending readings out.

    Returns the oldest keyframe that is to stay.
    """
    w = s.w[0]
    i, j = w.newest, w.newest + 1
    a, b = slot(s, i), slot(s, j)
    last, new = s.nodes[a], s.nodes[b]
    last.imu_to, last.next_ns = split_imu(s, t_ns), t_ns
    new.t_ns, new.next_ns, new.imu_from, new.imu_to = t_ns, 0, last.imu_to, w.imu_gone + w.n_imu
    new.first, new.dvl, new.moved = -1, -1, 1
    new.d[:] = 0.0
    new.m[:] = 0.0

    x, F = estimate(s, i), np.empty((DIM, DIM))
    lo = last.imu_from - w.imu_gone
    imu, before = s.imu[lo : last.imu_to - w.imu_gone], s.imu[lo - 1 : lo]
    integrate(imu, before, x[0].b_a.copy(), x[0].b_g.copy(), s.rig, s.blocks[a : a + 1])
    predict(s.blocks[a : a + 1], x, s.rig[0].gravity, F, s.points[b : b + 1])
    w.newest, w.keyframes, w.unsolved = j, w.keyframes + 1, min(w.unsolved, i)
    waiting, w.n_pending = w.n_pending, 0
    for p in range(waiting):
        at_ns = s.pending[p].t_ns
        if at_ns > t_ns + w.merge_ns:
            s.pending[w.n_pending] = s.pending[p]
            w.n_pending += 1
            continue
        f, at_new = accept(s, s.pending[p : p + 1]), abs(at_ns - t_ns) <= w.merge_ns
        if w.preintegrates and s.readings[f].kind == DVL and not (at_new and w.velocity):
            keep_for_interval(s, f, at_new)
        else:
            add_reading(s, j if at_new else i, f)
    if w.preintegrates and last.dvl >= 0:
        b_g = x[0].b_g.copy()
        add_displacement(s, over_world(imu, x[0].R_WB, b_g, s.rig), b_g)

    # a state of just the window's age stays, for it has yet to see the new one; half a millisecond for rounding
    stays, horizon_ns = w.head, t_ns - (w.window_ns + 5e5)
    while stays < j and s.nodes[slot(s, stays)].t_ns < horizon_ns:
        stays += 1
    return stays


@njit(cache=True, error_model="numpy")
def split_imu(s: Store, t_ns: int) -> int:
    """Split the samples of the newest keyframe at t_ns; return where those after it begin."""
    w = s.w[0]
    lo = s.nodes[slot(s, w.newest)].imu_from - w.imu_gone
    head, n, straddles = head_of(s.imu[lo : w.n_imu], t_ns)
    if straddles:
        for k in range(w.n_imu, lo + n, -1):
            s.imu[k] = s.imu[k - 1]
        w.n_imu += 1
        s.imu[lo + n] = head[n]
        s.imu[lo + n + 1].dt_s = (s.imu[lo + n + 1].t_ns - t_ns) * 1e-9
        n += 1
    return lo + n + w.imu_gone


@njit(cache=True, error_model="numpy")
def head_of(imu: NDArray[Any], t_ns: int) -> tuple[NDArray[Any], int, bool]:
    """Return samples up to t_ns, how many are whole, and whether one more straddles t_ns: the last, then cut short."""
    n = 0
    while n < len(imu) and imu[n].t_ns <= t_ns:
        n += 1
    if n < len(imu):
        began_ns = imu[n].t_ns - int(np.rint(imu[n].dt_s * 1e9))
        if began_ns < t_ns:
            head = imu[: n + 1].copy()
            head[n].dt_s, head[n].t_ns = (t_ns - began_ns) * 1e-9, t_ns
            return head, n, True
    return imu[:n], n, False


# --- factors ---------------------------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy")
def accept(s: Store, reading: NDArray[Any]) -> int:
    """Return a free factor's row, with the reading in it."""
    w = s.w[0]
    f = w.free
    w.free = s.factors[f].next
    w.n_free -= 1
    s.readings[f] = reading[0]
    return f


@njit(cache=True, error_model="numpy")
def give_back(s: Store, first: int) -> None:
    """Free a chain of factors."""
    w = s.w[0]
    while first >= 0:
        following = s.factors[first].next
        s.factors[first].next = w.free
        w.free = first
        w.n_free += 1
        first = following


@njit(cache=True, error_model="numpy")
def add_reading(s: Store, k: int, f: int) -> None:
    """Make row f, whose reading is there, a factor on keyframe k, carried by the IMU where it was true later."""
    w = s.w[0]
    node, factor, reading = s.nodes[slot(s, k)], s.factors[f], s.readings[f]
    kind, n = reading.kind, 0
    for i in range(1 if kind in (DEPTH, HEADING) else 3):
        n += np.isfinite(reading.sigma[i])
    factor.kind, factor.loss, factor.width, factor.fresh = kind, w.loss[kind], w.width[kind, n], 1
    if abs(reading.t_ns - node.t_ns) <= w.merge_ns:
        w.merged += reading.t_ns != node.t_ns
        factor.form = AT_KEYFRAME
    else:
        w.carried += 1
        factor.form = CARRIED
    factor.next = node.first
    node.first = f
    w.unsolved = min(w.unsolved, k)


@njit(cache=True, error_model="numpy")
def keep_for_interval(s: Store, f: int, at_new: bool) -> None:
    """Keep the DVL reading in row f for the interval that it begins or lies in; straight lines end on it as well."""
    w = s.w[0]
    last, new = s.nodes[slot(s, w.newest - 1)], s.nodes[slot(s, w.newest)]
    if at_new:
        s.factors[f].next = new.dvl
        new.dvl = f
        if w.straight:
            other = accept(s, s.readings[f : f + 1])
            s.factors[other].next = last.dvl
            last.dvl = other
    else:
        s.factors[f].next = last.dvl
        last.dvl = f


@njit(cache=True, error_model="numpy")
def add_displacement(s: Store, imu: NDArray[Any], b_g: Array) -> None:
    """Add the preintegrated-DVL factor of the newest interval, or its readings one by one where the DVL was silent.

    Args:
        s: the store.
        imu: samples of the interval.
        b_g: (3,) gyro bias, as it is known now.
    """
    w = s.w[0]
    i = w.newest - 1
    last, new_ns = s.nodes[slot(s, i)], s.nodes[slot(s, w.newest)].t_ns
    n, f = 0, last.dvl
    while f >= 0:
        n, f = n + 1, s.factors[f].next
    rows, f = np.empty(n, np.int64), last.dvl
    readings: Records = np.empty(n, s.readings.dtype)
    for m in range(n - 1, -1, -1):
        rows[m], readings[m], f = f, s.readings[f], s.factors[f].next
    last.dvl = -1
    order = in_order(readings)
    t_ns, v_WB_B, sigma = np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 3))
    longest_ns, before_ns, complete = 0, last.t_ns, True
    for m in range(n):
        reading = readings[order[m]]
        t_ns[m] = reading.t_ns
        for c in range(3):
            v_WB_B[m, c], sigma[m, c] = reading.z[c], reading.sigma[c] * s.rig[0].inflate[DVL]
            complete = complete and np.isfinite(sigma[m, c])
        longest_ns, before_ns = max(longest_ns, t_ns[m] - before_ns), t_ns[m]
    summed = complete and max(longest_ns, new_ns - before_ns) <= w.hold_ns
    for m in range(n):
        f = rows[m]
        s.factors[f].next = -1
        if not summed and readings[m].t_ns < new_ns - w.merge_ns:
            w.not_summed += 1
            add_reading(s, i, f)
        elif not summed or m > 0:
            give_back(s, f)
    if not summed:
        return
    w.preintegrated += n
    f = rows[0]
    factor = s.factors[f]
    s.displacements[f] = preintegrate_dvl(imu, last.t_ns, t_ns, v_WB_B, sigma, b_g, s.rig, w.straight != 0)[0]
    factor.kind, factor.loss, factor.width, factor.fresh = DVL, w.loss[DVL], w.width[DVL, 3], 1
    factor.form = TIGHT if w.tight else LOOSE
    N = s.displacements[f].N.copy()
    if w.tight:
        K, C = given_rotation(N)
        factor.K[:], factor.cov[:] = K, C
    else:
        factor.cov[:] = N[3:, 3:]
    factor.next = last.first
    last.first = f


# --- solving ---------------------------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy")
def update(s: Store, to_optimum: bool) -> int:
    """Solve with what is new: one Gauss–Newton step, and as many more as are asked for while anything moves."""
    w = s.w[0]
    if to_optimum:
        w.unsolved = w.head
    settled = False
    for _ in range(MOST_ITERATIONS if to_optimum else w.extra_updates + 1):
        first = linearise(s, to_optimum)
        if first < w.head:
            return NOT_POSITIVE
        if first > w.newest:
            settled = True
            break
        if not solve(s, first, w.newest if to_optimum else w.reach):
            return NOT_POSITIVE
        w.unsolved = w.newest + 1
    a = slot(s, w.newest)
    for k in range(3):
        if not np.isfinite(s.points[a].p_WB_W[k] + s.nodes[a].d[3 + k]):
            return NOT_FINITE
    return DONE if settled or not to_optimum else NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def solve(s: Store, first: int, reach: int) -> bool:
    """Factor anew from keyframe `first` on, and find the increments of it and of `reach` keyframes at least."""
    w = s.w[0]
    for k in range(first, w.newest + 1):
        a = slot(s, k)
        node = s.nodes[a]
        node.m[:], node.P[:] = node.m_given, node.P_given
        f = node.first
        while f >= 0:
            factor = s.factors[f]
            if factor.form <= CARRIED and factor.weight > 0.0:
                for row in range(factor.n):
                    if not absorb_row(factor.r[row], factor.H[row], 1.0 / factor.weight, node.m, node.P):
                        return False
            f = factor.next
        if k < w.newest and not tie(s, k):
            return False
        w.refactored += 1
    back_substitute(s.nodes, max(w.head, min(first, w.newest - reach)), w.newest)
    return True


@njit(cache=True, error_model="numpy")
def tie(s: Store, k: int) -> bool:
    """Eliminate keyframe k: what it says of the next one, with the factors of both, and what that says of it."""
    node, ahead, P_ji = s.nodes[slot(s, k)], s.nodes[slot(s, k + 1)], np.empty((DIM, DIM))
    m_j, P_j = ahead.m_given, ahead.P_given
    cross_tie(node.F, node.Q, node.c, node.m, node.P, m_j, P_j, P_ji)
    f = node.first
    while f >= 0:
        g = s.factors[f]
        if g.form > CARRIED and g.weight > 0.0:
            for row in range(g.n):
                spread = 1.0 / g.weight
                if not absorb_joint_row(g.r[row], g.H[row], g.H_j[row], spread, node.m, node.P, m_j, P_j, P_ji):
                    return False
        f = g.next
    return divide_into(P_j, P_ji, node.Gt)


@njit(cache=True, error_model="numpy")
def linearise(s: Store, exact: bool) -> int:
    """Linearise what is new, and anew the keyframes that have moved beyond the thresholds, or, `exact`, at all.

    Returns from where the chain is to be factored anew: beyond the newest where nothing is new or has moved, and -1
    where a factor has no covariance.
    """
    w = s.w[0]
    low = w.head + 1 if w.marginalised and not w.whole else w.head
    if not exact:
        low = max(low, w.newest - w.reach)
    first = w.newest + 1
    for k in range(low, w.newest + 1):
        a = slot(s, k)
        node, moved = s.nodes[a], False
        for c in range(DIM):
            size = abs(node.d[c])
            if (exact or size > w.thresholds[c]) and size > CONVERGED * np.sqrt(max(node.P[c, c], 0.0)):
                moved = True
        if moved:
            retract(s.points[a : a + 1], node.d, s.points[a : a + 1])
            node.d[:] = 0.0
            node.moved = 1
            first = min(first, k)
            w.relinearised += 1
    if first == w.head:
        a = slot(s, first)
        linearise_prior(s.anchor, s.mean, s.points[a : a + 1], s.nodes[a].m_given, s.nodes[a].P_given)
    first = max(w.head, min(first - 1, w.unsolved)) if first <= w.newest else w.unsolved
    for k in range(first, w.newest + 1):
        a, b = slot(s, k), slot(s, k + 1)
        node = s.nodes[a]
        own = node.moved == 1
        either = own or (k < w.newest and s.nodes[b].moved == 1)
        x_i, x_j = s.points[a : a + 1], s.points[b : b + 1]
        f = node.first
        while f >= 0:
            factor = s.factors[f]
            if factor.fresh and factor.form == CARRIED:
                x, lo = estimate(s, k), node.imu_from - w.imu_gone
                part, _, _ = head_of(s.imu[lo : node.imu_to - w.imu_gone], s.readings[f].t_ns)
                b_a, b_g = x[0].b_a.copy(), x[0].b_g.copy()
                integrate(part, s.imu[lo - 1 : lo], b_a, b_g, s.rig, s.carries[f : f + 1])
            if (factor.fresh or own or (either and factor.form > CARRIED)) and not linearise_factor(
                s.factors, f, s.readings, s.carries, s.displacements, x_i, x_j, s.rig
            ):
                return -1
            f = factor.next
        if either and k < w.newest:
            linearise_tie(s.blocks[a : a + 1], x_i, x_j, s.rig[0].gravity, node.F, node.Q, node.c)
    for k in range(first, w.newest + 1):
        s.nodes[slot(s, k)].moved = 0
    return first


@njit(cache=True, error_model="numpy")
def forget(s: Store) -> None:
    """Marginalise the oldest keyframe out: what it said of the next one is there already."""
    w = s.w[0]
    count_outliers(s, w.head)
    give_back(s, s.nodes[slot(s, w.head)].first)
    give_back(s, s.nodes[slot(s, w.head)].dvl)
    w.head += 1
    w.marginalised = 1
    a = slot(s, w.head)
    s.anchor[0] = s.points[a]
    s.anchor[0].P[:], s.mean[:] = s.nodes[a].P_given, s.nodes[a].m_given


# --- what is said ----------------------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy")
def weigh(s: Store, reading: NDArray[Any], state: NDArray[Any]) -> None:
    """Give a reading the noise that its loss leaves it with at a predicted state (a STATE record)."""
    w, one = s.w[0], reading[0]
    loss = w.loss[one.kind]
    if loss == 0:
        return
    r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    n = measure(reading, 0, state, s.rig, r, H, C)
    if n:
        d = np.sqrt(normalised_square(n, r, H, C))
        weight = weight_of(loss, d, w.width[one.kind, n])
        for i in range(3):
            one.sigma[i] = one.sigma[i] / np.sqrt(weight) if weight > 0.0 else np.inf


@njit(cache=True, error_model="numpy")
def leave(s: Store, until: int, swept: bool) -> None:
    """Write down the ticks from the oldest keyframe on, up to `until`, as they are seen now.

    A tick is carried by the IMU from the keyframe before, with the IMU's noise since then added, although the keyframe
    after it limits that too. `swept`: P of each node is with hindsight already; else the newest is just being made.
    """
    w = s.w[0]
    for k in range(w.head, until):
        a = slot(s, k)
        node = s.nodes[a]
        until_ns = w.now_ns + 1 if node.next_ns == 0 else node.next_ns
        while w.ticks_done < w.n_ticks and s.ticks[w.ticks_done] < until_ns:
            t_ns = s.ticks[w.ticks_done]
            w.ticks_done += 1
            x = s.out[w.n_out : w.n_out + 1]
            x[0] = s.points[a]
            s.out_ns[w.n_out] = t_ns
            w.n_out += 1
            if t_ns >= w.covariance_due_ns:
                w.covariance_due_ns = t_ns + w.covariance_ns
                if swept:
                    x[0].P[:] = node.P
                else:
                    x[0].P[:] = covariance_with_hindsight(s.nodes, k, w.newest - 1)
            else:
                x[0].P[:] = np.nan
            inject(x, node.d)
            if t_ns != node.t_ns:
                carry_on(s, k, x, t_ns)


@njit(cache=True, error_model="numpy")
def carry_on(s: Store, k: int, x: NDArray[Any], t_ns: int) -> None:
    """Carry a belief at keyframe k, a STATE record, on to t_ns."""
    w, node = s.w[0], s.nodes[slot(s, k)]
    block = np.empty(1, BLOCK)
    lo = node.imu_from - w.imu_gone
    part, _, _ = head_of(s.imu[lo : node.imu_to - w.imu_gone], t_ns)
    integrate(part, s.imu[lo - 1 : lo], x[0].b_a.copy(), x[0].b_g.copy(), s.rig, block)
    carry(block, x, s.rig[0].gravity)


@njit(cache=True, error_model="numpy")
def count_outliers(s: Store, k: int) -> None:
    """Count the factors on a keyframe that end beyond the width of their loss."""
    w, node, ahead = s.w[0], s.nodes[slot(s, k)], s.nodes[slot(s, k + 1)]
    f = node.first
    while f >= 0:
        g = s.factors[f]
        if g.loss > 0:
            w.outliers[g.kind] += distance(s.factors, f, node.d, ahead.d) > g.width
        f = g.next
