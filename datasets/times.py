"""Times from files, without loss: text, integers or floats in a unit, to int64 nanoseconds."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .state import LIMIT_NS, TimeArray

NS_PER = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Nanoseconds per unit."""
NO_TIME = Decimal("nan")


def times_ns(values: NDArray[Any], unit: str) -> tuple[TimeArray, NDArray[np.bool_]]:
    """Convert times as read to nanoseconds; text and integers exactly, floats to the nearest nanosecond.

    Returns:
        (n,) int64, and a mask of the rows with a valid time; the others are 0.
    """
    factor = NS_PER[unit]
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
    for row, text in enumerate(values):
        try:
            value = Decimal(text.strip()) * factor if isinstance(text, str) else NO_TIME
        except ArithmeticError:
            value = NO_TIME
        if value.is_finite() and abs(value) < LIMIT_NS:
            ns[row], good[row] = round(value), True
    return ns, good


def seconds_to_ns(text: str) -> int:
    """Convert decimal seconds, as text, to nanoseconds without passing through float64.

    Raises:
        ValueError: not a number, or one beyond LIMIT_NS.
    """
    try:
        ns = (Decimal(text) * 1_000_000_000).to_integral_value()
        if abs(ns) < LIMIT_NS:
            return int(ns)
    except ArithmeticError:  # decimal's errors are of this kind
        pass
    raise ValueError(f"not a time in seconds: {text[:40]!r}; nanoseconds?")
