"""A free-running clock inside a sensor: unwrapped, and mapped to the host's clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..state import Array


def common_instants(
    host_s: Sequence[Array], device_s: Sequence[Array], wraps_at_s: float
) -> tuple[list[NDArray[np.int64]], Array]:
    """Join messages that carry the same device clock, where their times agree to the microsecond.

    Args:
        host_s, device_s: (n_k,) stamps of each kind of message.

    Returns:
        for each kind the (m,) rows that are kept, and (m,) their device time on the host's clock, s.
    """
    unwrapped = [unwrap(host, device, wraps_at_s) for host, device in zip(host_s, device_s, strict=True)]
    picks: list[NDArray[Any]] = [np.arange(len(unwrapped[0]))]
    if len(unwrapped) > 1:
        keys = [np.where(np.isfinite(u), np.rint(u * 1e6), -1.0).astype(np.int64) for u in unwrapped]
        rows = [np.unique(k, return_index=True)[1] for k in keys]
        common = keys[0][rows[0]]
        for k, row in zip(keys[1:], rows[1:], strict=True):
            common = np.intersect1d(common, k[row])
        picks = [row[np.isin(k[row], common)] for k, row in zip(keys, rows, strict=True)]
    return picks, onto_host(host_s[0][picks[0]], unwrapped[0][picks[0]])


def unwrap(host_s: Array, device_s: Array, wraps_at_s: float) -> Array:
    """Return the device clock without its jumps, counted by the host's clock; the two may differ by half a period."""
    if not len(host_s):
        return device_s
    with np.errstate(invalid="ignore", over="ignore"):
        laps = np.rint(((host_s - host_s[0]) - (device_s - device_s[0])) / wraps_at_s)
        unwrapped = device_s + laps * wraps_at_s
    return np.where(np.abs(unwrapped) < 1e12, unwrapped, np.nan)


def onto_host(host_s: Array, device_s: Array, window_s: float = 10.0) -> Array:
    """Return the device's times on the host's clock: offset and drift from the smallest delays of each window.

    The device clock is exact but has its own rate (1.1e-3 fast has been seen). A reception is late by an amount that is
    sometimes nearly zero. So a line is fitted to the smallest host − device of each window.
    """
    good = np.isfinite(device_s) & np.isfinite(host_s) & (np.abs(host_s) < 1e12)
    if not good.any():
        return np.full_like(device_s, np.nan)
    start = device_s[good][0]
    since, late = device_s[good] - start, host_s[good] - device_s[good]
    window = np.floor(since / window_s).astype(np.int64)
    order = np.lexsort((late, window))
    first = order[np.unique(window[order], return_index=True)[1]]
    if len(first) < 3:
        return device_s + late.min()
    line = np.polynomial.Polynomial.fit(since[first], late[first], 1)
    return device_s + line(device_s - start)
