"""The times of one stream: counters that wrap, and rows out of order."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..state import TimeArray

SLACK_NS = 10 * 1_000_000_000
"""A sensor may start and end 10 s before or after the IMU."""
RUN_ROWS, RUN_SHARE = 10, 0.05
"""So many rows that go back in one piece, or that share stamps, are no accident, but a wrong column or clock."""
COUNTERS_S = (64.0, 60.0, 65.536, 2**32 * 1e-9, 2**31 * 1e-6, 2**32 * 1e-6, 3600.0, 86400.0, 604800.0, 2**32 * 1e-3)
"""Periods at which known counters begin again: seconds, 16, 31 and 32 bits of ms, us or ns, hours, days, GPS weeks."""
NEAR = 0.05
"""A step back that is within this share of a counter's period is taken for its wrap."""


def unwrapped(t_ns: TimeArray, period_ns: int) -> TimeArray:
    """Return the times of a counter with its wraps added: a step of more than half a period is one."""
    if len(t_ns) < 2:
        return t_ns
    step = np.diff(t_ns)
    laps = np.cumsum((2 * step < -period_ns).astype(np.int64) - (2 * step > period_ns))
    return t_ns + np.concatenate([[0], laps]) * period_ns


def laps(span_ns: tuple[int, int], period_ns: int, imu_ns: tuple[int, int]) -> tuple[int, bool]:
    """Return by how many periods a stream of a counter begins nearest to the IMU's start, and if others fit as well.

    Args:
        span_ns, imu_ns: from first to last, of the stream and the IMU.
        period_ns: of the counter.
    """
    nearest = (2 * (imu_ns[0] - span_ns[0]) + period_ns) // (2 * period_ns)
    first = -((span_ns[0] - imu_ns[0] + SLACK_NS) // period_ns)
    last = (imu_ns[1] + SLACK_NS - span_ns[1]) // period_ns
    return nearest, last - first + 1 > (first <= nearest <= last)


def stray(t_ns: TimeArray) -> NDArray[np.bool_]:
    """Return the fewest rows without which times increase; of two such choices, the one that keeps the earlier rows."""
    late = np.zeros(len(t_ns), bool)
    late[1:] = t_ns[1:] <= np.maximum.accumulate(t_ns)[:-1]
    if not late.any():
        return late
    last: list[int] = []  # of the increasing runs of length 1, 2, …: the least last time
    rank = []  # of each row: the longest run that ends there, less one
    for t in t_ns.tolist():
        rank.append(bisect_left(last, t))
        last[rank[-1] : rank[-1] + 1] = [t]
    if len(last) == np.count_nonzero(~late):
        return late
    found = np.ones(len(t_ns), bool)
    wanted, below = len(last) - 1, last[-1] + 1
    for row in range(len(t_ns) - 1, -1, -1):
        if rank[row] == wanted and t_ns[row] < below:
            found[row] = False
            wanted, below = wanted - 1, t_ns[row]
    return found


@dataclass(frozen=True)
class Disorder:
    """What is out of order in a stream.

    Attributes:
        twins: (n,) rows that repeat the time and the values of a row that is kept: no loss.
        lost: (n,) the other rows out of order.
        why: what the column of times seems to be, if the lost rows are too regular for accidents; else "".
    """

    twins: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    why: str


def disorder(t_ns: TimeArray, number: TimeArray, columns: list[NDArray[Any]]) -> Disorder | None:
    """Return what is out of order; None if times increase.

    Args:
        t_ns: (n,) times.
        number: (n,) their rows in the source.
        columns: (n,) each, the values of the rows as read.
    """
    out = stray(t_ns)
    if not out.any():
        return None
    kept, rows = np.flatnonzero(~out), np.flatnonzero(out)
    match = kept[np.searchsorted(t_ns[kept], t_ns[rows]).clip(max=len(kept) - 1)]
    shared, twins = np.zeros(len(t_ns), bool), np.zeros(len(t_ns), bool)
    shared[rows] = t_ns[match] == t_ns[rows]
    twins[rows] = shared[rows] & np.all([values[match] == values[rows] for values in columns], axis=0)
    lost = out & ~twins
    return Disorder(twins, lost, _why(t_ns, number, lost))


def complaint(t_ns: TimeArray, row: int) -> str:
    """Return how a row is out of order."""
    if row == 0 or t_ns[row] > t_ns[row - 1]:
        return f"time {t_ns[row]} ns is ahead of rows below"
    how = "repeats" if t_ns[row] == t_ns[row - 1] else "comes before"
    return f"time {t_ns[row]} ns {how} the row above"


def _why(t_ns: TimeArray, number: TimeArray, lost: NDArray[np.bool_]) -> str:
    """Return what the column of times seems to be; "" where rows are out of order by accident."""
    many = max(RUN_ROWS, RUN_SHARE * len(t_ns))
    step_ns = np.diff(t_ns)
    same = int(np.count_nonzero(lost[1:] & (step_ns == 0)))
    if same >= many:
        return (
            f"{same} have other values under the stamp of the row above; the stamps are too coarse (whole seconds?): "
            "name a finer column, or give `row_rate_hz`"
        )
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False))
    pieces = edges[1::2] - edges[::2]
    if not len(pieces) or pieces.max() < many:
        return ""
    row = int(step_ns.argmin()) + 1
    back_s = -float(step_ns[row - 1]) * 1e-9
    period_s = next((period for period in COUNTERS_S if (1 - NEAR) * period <= back_s <= period), None)
    what = "was the clock set?" if period_s is None else f"a counter that wraps? `wraps_at_s: {period_s:.10g}`"
    return (
        f"time goes back by {back_s:.6g} s at row {number[row]}; {what} (--repair drops single rows, not a piece of "
        f"{pieces.max()}; `from_s` and `until_s` cut a log)"
    )
