"""Which reading makes a keyframe, and which keyframe each reading belongs to: decided once, for every smoother.

Decisions depend on the times and kinds of readings, on epochs and on options, never on the estimate: for one log all
smoothers get the same list of orders. With t_k the time of keyframe k, keyframe n the newest, and m = merge_ns:

    t ≥ t_n − m             the reading waits, and is given out with the next keyframe
    t < t_n − m             it is late: it goes to the newest keyframe with t_k ≤ t + m, or is lost where that has left
    |t − t_k| ≤ m           it is taken as of keyframe k, and counted as merged where t ≠ t_k
    otherwise               it belongs to the keyframe before it, and the IMU carries it there

A DVL reading makes a keyframe once period_s has passed since the last; another reading does where the DVL has been
silent for keyframe_timeout_s; and time itself does after period_s + LONGEST_SILENCE_S. A keyframe leaves when a new one
is more than window_s younger. Where DVL readings are summed, an interval of preintegration runs from one keyframe to
the next; a reading at its beginning is the last of the interval before only where velocity runs straight.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets.compiling.decorators import Records, compiled, inner
from ..datasets.epochs import DVL, READING, SENSOR
from ..datasets.state import TimeArray
from .interface import unknown_kind
from .smoothers import GraphSmoother

LONGEST_SILENCE_S = 1.0
"""For so long beyond period_s a first-order bias correction, and one factor's rounding, hold without a keyframe."""
LEAST_AGE_NS = 500_000
"""A keyframe of just the window's age stays, for it has yet to see the new one; this allows for rounding of lag_s."""
NO_READINGS = np.zeros(0, READING)

KEYFRAME, AT_KEYFRAME, CARRIED, SUMMED, SOLVE = np.arange(5)  # no literals, for which numba would compile anew
"""What an order, a row (what, keyframe, x), asks for:

    KEYFRAME        make this keyframe, at time x, and close the interval before it
    AT_KEYFRAME     make the reading in row x a factor on this keyframe, as of it
    CARRIED         the same, carried there by the IMU
    SUMMED          add the DVL reading in row x to the displacement of the interval that this keyframe begins; the
                    readings of an interval come in the order of their times
    SOLVE           solve with this keyframe, the newest; x is the oldest that stays
"""
WAITS, BEGINS, GONE = range(3)
"""Of a row: given out with the next keyframe; given out, and summed over the interval that it begins; not needed."""
NO_ROOM, UNKNOWN_KIND = -1, -2
"""Returned by `decide` instead of a number of orders; nothing has been done then."""

PLAN = np.dtype(
    [
        # the options
        ("period_ns", "i8"),
        ("timeout_ns", "i8"),
        ("silence_ns", "i8"),
        ("merge_ns", "i8"),
        ("window_ns", "i8"),
        ("hold_ns", "i8"),
        ("sums", "i8"),
        ("velocity", "i8"),
        ("straight", "i8"),
        ("used", "i8"),  # bit by kind of reading
        # where it is
        ("now_ns", "i8"),
        ("dvl_heard_ns", "i8"),
        ("oldest", "i8"),
        ("newest", "i8"),
        ("rows", "i8"),
        ("orders", "i8"),
        # what happened
        ("merged", "i8"),
        ("carried", "i8"),
        ("late", "i8"),
        ("late_used", "i8"),
        ("preintegrated", "i8"),
        ("not_summed", "i8"),
    ]
)
COUNTS = ("merged", "carried", "late", "late_used", "preintegrated", "not_summed")


class Keyframes:
    """The decisions of one pass over one log.

    Args:
        options: the smoother's.
        inflate: (kinds,) factor on sigma by kind of reading; infinite for what is not used.
        start_ns: time of keyframe 0.

    Attributes:
        rows: READING rows that orders name by their place; they stay there until the next question.
    """

    def __init__(self, options: GraphSmoother, inflate: NDArray[np.float64], start_ns: int) -> None:
        plan = np.zeros(1, PLAN)
        plan["merge_ns"] = options.merge_ns
        plan["period_ns"] = round(options.period_s * 1e9)
        plan["timeout_ns"] = round(options.keyframe_timeout_s * 1e9)
        plan["silence_ns"] = round((options.period_s + LONGEST_SILENCE_S) * 1e9)
        plan["window_ns"] = round(min(options.window_s * 1e9, 1 << 61)) + LEAST_AGE_NS
        plan["hold_ns"] = round(options.max_hold_s * 1e9)
        plan["sums"], plan["velocity"] = options.preintegrates, "velocity" in options.dvl
        plan["straight"] = options.dvl_between == "straight"
        plan["used"] = sum(1 << kind for kind in range(len(SENSOR)) if np.isfinite(inflate[kind]))
        plan["now_ns"] = plan["dvl_heard_ns"] = start_ns
        self._plan = plan
        self._times = np.full(16, start_ns)
        self._roles = np.zeros(16, np.int64)
        self._orders = np.zeros((64, 3), np.int64)
        self.rows = np.zeros(16, READING)

    def take(self, now_ns: int, readings: Records) -> NDArray[np.int64]:
        """Return what to do with the READING rows received at now_ns: the orders, (n, 3), valid until the next call.

        Raises:
            ValueError: a reading is of no known kind.
        """
        return self._decide(now_ns, readings, False)

    def finish(self) -> NDArray[np.int64]:
        """Return the last orders: a keyframe at the end, with all waiting readings."""
        return self._decide(int(self._plan["now_ns"][0]), NO_READINGS, True)

    def not_given_out(self) -> list[Records]:
        """Return the readings that no keyframe has taken yet, in the order of their times, READING rows."""
        waits = np.flatnonzero(self._roles[: int(self._plan["rows"][0])] == WAITS)
        return [self.rows[k : k + 1] for k in waits[np.argsort(self.rows["t_ns"][waits], kind="stable")].tolist()]

    @property
    def counts(self) -> Counter[str]:
        """What happened to readings, by name."""
        counts = {name: int(self._plan[name][0]) for name in COUNTS}
        return Counter({"keyframes": int(self._plan["newest"][0]) + 1, **counts})

    def _decide(self, now_ns: int, readings: Records, closing: bool) -> NDArray[np.int64]:
        while True:
            n = decide(self._plan, self._times, self.rows, self._roles, self._orders, readings, now_ns, closing)
            if n >= 0:
                return self._orders[:n]
            if n == UNKNOWN_KIND:
                raise unknown_kind(next(kind for kind in readings["kind"].tolist() if not 0 <= kind < len(SENSOR)))
            self._make_room()

    def _make_room(self) -> None:
        n, plan = len(self._times), self._plan[0]
        kept = np.arange(plan["oldest"], plan["newest"] + 1)
        times = np.zeros(2 * n, np.int64)
        times[kept & (2 * n - 1)] = self._times[kept & (n - 1)]
        self._times = times
        self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)])
        self._roles = np.concatenate([self._roles, np.zeros_like(self._roles)])
        self._orders = np.zeros((2 * len(self._orders), 3), np.int64)


@compiled
def decide(
    plan: Records, times: TimeArray, rows: Records, roles: NDArray[np.int64], orders: NDArray[np.int64],
    readings: Records, now_ns: int, closing: bool,
) -> int:  # fmt: skip
    """Fill `orders` for the readings of an epoch, or for the end of a log; return their number.

    Args:
        plan: PLAN record of length 1.
        times: of keyframe k in place k & (length − 1).
        rows, roles: readings that are not done with, and what each is.
        orders: (n, 3), filled.
        readings: READING rows received at now_ns.
        now_ns: time of the epoch.
        closing: the log ends here.
    """
    p = plan[0]
    throw_away(plan, rows, roles)
    most = p.rows + len(readings)
    keyframes = most + 2 + (now_ns - times[p.newest & (len(times) - 1)]) // p.silence_ns
    if p.newest - p.oldest + 1 + keyframes > len(times) or most > len(rows) or 2 * (most + keyframes) > len(orders):
        return NO_ROOM
    for m in range(len(readings)):
        if readings[m].kind < 0 or readings[m].kind >= len(SENSOR):
            return UNKNOWN_KIND
    p.now_ns, p.orders = now_ns, 0
    first = p.rows
    receive(plan, times, rows, roles, orders, readings)
    for row in range(first, p.rows):
        if makes_keyframe(p.now_ns, plan, times, rows[row].kind, rows[row].t_ns):
            close(plan, times, rows, roles, orders, rows[row].t_ns)
    while now_ns - times[p.newest & (len(times) - 1)] > p.silence_ns:
        close(plan, times, rows, roles, orders, times[p.newest & (len(times) - 1)] + p.silence_ns)
    if closing:
        if now_ns - times[p.newest & (len(times) - 1)] > p.merge_ns:
            close(plan, times, rows, roles, orders, now_ns)
        for row in range(p.rows):
            if roles[row] == WAITS:
                place(plan, times, rows, orders, p.newest, row)
            roles[row] = GONE
    return p.orders


@inner
def order(plan: Records, orders: NDArray[np.int64], what: Any, keyframe: Any, x: Any) -> None:
    """Append an order."""
    n = plan[0].orders
    orders[n, 0], orders[n, 1], orders[n, 2] = what, keyframe, x
    plan[0].orders = n + 1


@inner
def throw_away(plan: Records, rows: Records, roles: NDArray[np.int64]) -> None:
    """Drop the rows that are not needed any more; the others keep their order."""
    kept = 0
    for row in range(plan[0].rows):
        if roles[row] != GONE:
            if kept != row:
                rows[kept], roles[kept] = rows[row], roles[row]
            kept += 1
    plan[0].rows = kept


@inner
def receive(
    plan: Records, times: TimeArray, rows: Records, roles: NDArray[np.int64], orders: NDArray[np.int64],
    readings: Records,
) -> None:  # fmt: skip
    """Keep the readings of an epoch in the order of their times, but for those of no use; give late ones out."""
    p, first = plan[0], plan[0].rows
    for m in range(len(readings)):
        kind, measures = readings[m].kind, False
        for i in range(3):
            measures = measures or np.isfinite(readings[m].sigma[i])
        if not measures or (p.used >> kind) & 1 == 0:
            continue
        if kind == DVL:
            p.dvl_heard_ns = p.now_ns
        row = p.rows
        while row > first and rows[row - 1].t_ns > readings[m].t_ns:
            rows[row] = rows[row - 1]
            row -= 1
        rows[row] = readings[m]
        p.rows += 1
    for row in range(first, p.rows):
        roles[row] = WAITS
        if rows[row].t_ns < times[p.newest & (len(times) - 1)] - p.merge_ns:
            roles[row] = GONE
            k = p.newest
            while k >= p.oldest and times[k & (len(times) - 1)] > rows[row].t_ns + p.merge_ns:
                k -= 1
            if k < p.oldest:
                p.late += 1
            else:
                p.late_used += 1
                place(plan, times, rows, orders, k, row)


@inner
def place(plan: Records, times: TimeArray, rows: Records, orders: NDArray[np.int64], k: int, row: int) -> None:
    """Order a reading on keyframe k, as of it or carried there."""
    p, off_ns = plan[0], rows[row].t_ns - times[k & (len(times) - 1)]
    if abs(off_ns) > p.merge_ns:
        p.carried += 1
        order(plan, orders, CARRIED, k, row)
    else:
        p.merged += off_ns != 0
        order(plan, orders, AT_KEYFRAME, k, row)


@inner
def makes_keyframe(now_ns: int, plan: Records, times: TimeArray, kind: int, t_ns: int) -> bool:
    """Whether a reading that has just come makes a keyframe."""
    p = plan[0]
    since_ns = t_ns - times[p.newest & (len(times) - 1)]
    if since_ns <= p.merge_ns:
        return False
    if kind == DVL:
        return since_ns >= p.period_ns - p.merge_ns
    dvl_is_silent = now_ns - p.dvl_heard_ns >= p.timeout_ns
    return dvl_is_silent and since_ns >= max(p.period_ns, p.timeout_ns) - p.merge_ns


@inner
def close(
    plan: Records, times: TimeArray, rows: Records, roles: NDArray[np.int64], orders: NDArray[np.int64],
    t_ns: int,
) -> None:  # fmt: skip
    """Order a keyframe at t_ns, give out the readings that waited for it, and say which keyframes leave."""
    p = plan[0]
    last, new = p.newest, p.newest + 1
    times[new & (len(times) - 1)] = t_ns
    p.newest = new
    order(plan, orders, KEYFRAME, new, t_ns)
    first = p.orders
    for row in range(p.rows):
        at_ns, role = rows[row].t_ns, roles[row]
        if role == GONE or at_ns > t_ns + p.merge_ns:
            continue
        at_new = role == WAITS and abs(at_ns - t_ns) <= p.merge_ns
        roles[row] = GONE
        if not p.sums or rows[row].kind != DVL or (at_new and p.velocity):
            place(plan, times, rows, orders, new if at_new else last, row)
            continue
        if at_new:
            roles[row] = BEGINS
        if not at_new or p.straight:
            order(plan, orders, SUMMED, last, row)
    first = sort_sum(plan, rows, orders, first)
    if has_sum(plan, rows, orders, first, times[last & (len(times) - 1)], t_ns):
        p.preintegrated += p.orders - first
    else:
        place_one_by_one(plan, times, rows, orders, first, t_ns)
    while p.oldest < new and times[p.oldest & (len(times) - 1)] < t_ns - p.window_ns:
        p.oldest += 1
    order(plan, orders, SOLVE, new, p.oldest)


@inner
def sort_sum(plan: Records, rows: Records, orders: NDArray[np.int64], first: int) -> int:
    """Bring the readings to sum behind the others, in the order of their times; return where they begin."""
    for k in range(first + 1, plan[0].orders):
        what, keyframe, row = orders[k, 0], orders[k, 1], orders[k, 2]
        j = k
        while (
            j > first
            and orders[j - 1, 0] == SUMMED
            and (what != SUMMED or rows[orders[j - 1, 2]].t_ns > rows[row].t_ns)
        ):
            for i in range(3):
                orders[j, i] = orders[j - 1, i]
            j -= 1
        orders[j, 0], orders[j, 1], orders[j, 2] = what, keyframe, row
    while first < plan[0].orders and orders[first, 0] != SUMMED:
        first += 1
    return first


@inner
def has_sum(plan: Records, rows: Records, orders: NDArray[np.int64], first: int, begin_ns: Any, end_ns: int) -> bool:
    """Whether the readings to sum, from `first` on, know the displacement: no long silence, no axis unmeasured."""
    before_ns = begin_ns
    for k in range(first, plan[0].orders):
        reading = rows[orders[k, 2]]
        for i in range(3):
            if not np.isfinite(reading.sigma[i]):
                return False
        if reading.t_ns - before_ns > plan[0].hold_ns:
            return False
        before_ns = reading.t_ns
    return end_ns - before_ns <= plan[0].hold_ns


@inner
def place_one_by_one(
    plan: Records, times: TimeArray, rows: Records, orders: NDArray[np.int64], first: int, end_ns: int
) -> None:
    """Turn orders to sum, from `first` on, into orders of single readings; one at the interval's end is the next's."""
    p, n = plan[0], plan[0].orders
    p.orders = first
    for k in range(first, n):
        row = orders[k, 2]
        if rows[row].t_ns < end_ns - p.merge_ns:
            p.not_summed += 1
            place(plan, times, rows, orders, orders[k, 1], row)
