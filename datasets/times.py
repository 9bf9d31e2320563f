"""Times from files, without loss: text, integers or floats in a unit, and dates, to int64 nanoseconds."""

from __future__ import annotations

from decimal import ROUND_HALF_EVEN, Context, Decimal, DivisionByZero, InvalidOperation, Overflow
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .state import LIMIT_NS, TimeArray

NS_PER = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Nanoseconds per unit."""
UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
CONTEXT = Context(28, ROUND_HALF_EVEN, -999_999, 999_999, 1, 0, [], [InvalidOperation, DivisionByZero, Overflow])
"""Of decimal's arithmetic, as Python starts with: that of the process is anybody's to change. Times have 19 digits."""
DAY_NS = 86_400 * 1_000_000_000
"""Nanoseconds per day."""
FAR_NS = 400 * DAY_NS
"""No log is as long as 400 days."""
NO_TIME = Decimal("nan")
DATE_UNITS = ("W", "D", "h", "m", "s", "ms", "us", "ns")
"""Units of datetime64 that are whole nanoseconds; months and years are of no fixed length."""
LONGEST_DATE = 64
"""Characters of a date: 2023-11-14T22:13:20.123456789+00:00 has 35."""


def far(t_ns: TimeArray) -> NDArray[np.bool_]:
    """Return the rows (n,) whose time is more than 400 days from the median: of a clock that was not set."""
    return np.abs(t_ns - int(np.median(t_ns))) > FAR_NS if len(t_ns) else np.zeros(0, bool)


def far_complaint(t_ns: TimeArray, row: int) -> str:
    """Return how far from the median a row's time is."""
    days = abs(int(t_ns[row]) - int(np.median(t_ns))) / DAY_NS
    return f"time {t_ns[row]} ns is {days:.0f} days from the middle of the stream"


def times_ns(values: NDArray[Any], unit: str) -> tuple[TimeArray, NDArray[np.bool_]]:
    """Convert times as read to nanoseconds; text and integers exactly, floats to the nearest nanosecond.

    A date, as text (ISO 8601) or as datetime64, becomes nanoseconds since 1970, UTC where it names no zone; a duration
    or a time of day becomes its nanoseconds. The unit is that of plain numbers.

    Returns:
        (n,) int64, and a mask of the rows with a valid time; the others are 0.
    """
    factor = NS_PER[unit]
    if values.dtype.kind in "mM":
        return _dates_ns(values)
    if values.dtype.kind in "iu":
        good = (np.abs(values.astype(float)) * factor) < LIMIT_NS
        return np.where(good, values, 0).astype(np.int64) * factor, good
    if values.dtype.kind in "fb":
        values = values.astype(float)
        good = np.isfinite(values)
        good[good] = np.abs(values[good]) * factor < LIMIT_NS
        safe = np.where(good, values, 0.0)
        whole = np.floor(safe)
        rest = np.rint((safe - whole) * factor).astype(np.int64)
        return whole.astype(np.int64) * factor + rest, good
    ns, good = np.zeros(len(values), np.int64), np.zeros(len(values), bool)
    words: list[int] = []
    for row, text in enumerate(values):
        try:
            value = _scaled(text.strip(), factor) if isinstance(text, str) else NO_TIME
        except ArithmeticError:
            words.append(row)
            continue
        if value.is_finite() and -LIMIT_NS < value < LIMIT_NS:
            ns[row], good[row] = round(value), True
    if words:
        ns[words], good[words] = _written_dates_ns([values[row].strip() for row in words])
    return ns, good


def _dates_ns(values: NDArray[Any]) -> tuple[TimeArray, NDArray[np.bool_]]:
    """Convert datetime64 or timedelta64 of any unit, as `times_ns` does."""
    unit, count = np.datetime_data(values.dtype)
    step_ns = int(np.timedelta64(count, unit) / np.timedelta64(1, "ns")) if unit in DATE_UNITS else 0
    ticks = values.astype(np.int64)
    good = ~np.isnat(values) & (np.abs(ticks.astype(float)) * step_ns < LIMIT_NS) & (step_ns > 0)
    return np.where(good, ticks, 0) * step_ns, good


def _written_dates_ns(texts: list[str]) -> tuple[TimeArray, NDArray[np.bool_]]:
    """Convert dates by ISO 8601, durations as pandas writes them, and times of day, as `times_ns` does."""
    import pandas as pd

    short = [text.replace(",", ".") if len(text) <= LONGEST_DATE else "" for text in texts]
    dates = pd.to_datetime(pd.Series(short, dtype=object), format="ISO8601", errors="coerce", utc=True)
    ns, good = _dates_ns(dates.dt.tz_localize(None).to_numpy())
    if not good.all():
        spans = pd.to_timedelta(pd.Series(short, dtype=object)[~good], errors="coerce")
        ns[~good], good[~good] = _dates_ns(spans.to_numpy())
    return ns, good


def seconds_to_ns(text: str) -> int:
    """Convert decimal seconds, as text, to nanoseconds without passing through float64.

    Raises:
        ValueError: not a number, or one beyond LIMIT_NS.
    """
    try:
        ns = CONTEXT.to_integral_value(_scaled(text, NS_PER["s"]))
        if -LIMIT_NS < ns < LIMIT_NS:
            return int(ns)
    except ArithmeticError:  # decimal's errors are of this kind
        pass
    meant = finer_unit(text, "s")
    hint = f"; this looks like {UNIT_NAMES[meant]}" if meant else ""
    raise ValueError(f"not a time in seconds: {text[:40]!r}{hint}")


def finer_unit(stamp: Any, unit: str) -> str:
    """Return the unit that a stamp beyond the clock is probably in: the coarsest in which it is a time; "" if none."""
    try:
        value = float(stamp)
    except (TypeError, ValueError):
        return ""
    if not abs(value) * NS_PER[unit] >= LIMIT_NS:
        return ""
    return next((finer for finer, factor in NS_PER.items() if abs(value) * factor < LIMIT_NS), "")


def _scaled(text: str, factor: int) -> Decimal:
    return CONTEXT.multiply(CONTEXT.create_decimal(text), Decimal(factor))
