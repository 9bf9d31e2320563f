"""Pieces of a stream in which a sensor repeats one value for seconds, where its other readings vary."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.finding import Finding
from .channels import Channel, seconds
from .neighbours import FAR, stretches
from .quantisation import quantisation_of

LONG_S, LONG_ROWS = 5.0, 5
"""Least duration and number of repeats of a piece: shorter ones are published repeats, or chance."""
USUAL_REPEATS = 0.05
"""Share of repeats among the other readings above which a sensor is too coarse to tell."""
FINE, ALL_DIGITS = 0.02, 1e-4
"""Step over the usual change at which three axes, or one, do not repeat by rounding."""
NEAR_REST = 0.1
"""Of the median speed: a sensor may repeat a smaller one while the vehicle rests."""
SAME_ANGLE = 1e-12
"""rad: attitudes are summed from rotations, which rounding moves by less."""


@lru_cache(maxsize=16)
def frozen_rows(channel: Channel) -> NDArray[np.bool_]:
    """Return which rows (n,) repeat one value for seconds, the first of each piece left out.

    A piece counts if its value has all digits, or if the reading that ends it jumps. A fix may be held at rest, and an
    odometer's rate at cruise, so that such a piece must end in a jump.
    """
    frozen = np.zeros(len(channel.x), bool)
    x = channel.raw[:, np.isfinite(channel.sigma)]
    if len(x) < 4 * LONG_ROWS or not x.shape[1]:
        return frozen
    change = np.abs(np.diff(x, axis=0))
    same = np.all(change <= (SAME_ANGLE if channel.stream == "heading" else 0.0), axis=1)
    if np.count_nonzero(same) < LONG_ROWS:
        return frozen
    pieces = [
        (a, b + 1)
        for a, b in stretches(same)
        if b + 1 - a >= LONG_ROWS and (channel.t_ns[b + 1] - channel.t_ns[a]) * 1e-9 >= LONG_S
    ]
    for first, last in pieces:
        frozen[first + 1 : last + 1] = True
    others = ~frozen[1:]
    if not pieces or np.mean(others) < 0.2 or np.mean(same[others]) > USUAL_REPEATS:
        return np.zeros(len(x), bool)
    usual = np.median(change[others], axis=0)
    steps = np.array([quantisation_of(axis).quantum for axis in x[~frozen].T])
    held = channel.stream == "gps" or (channel.stream == "dvl" and x.shape[1] == 1)
    fine = bool(not held and (steps <= (FINE if x.shape[1] > 2 else ALL_DIGITS) * usual).all())
    stated = channel.sigma[np.isfinite(channel.sigma)]
    for first, last in pieces:
        soon = last + 1 < len(x) and (channel.t_ns[last + 1] - channel.t_ns[last]) * 1e-9 < 2 * channel.period_s
        jumps = soon and (change[last] > FAR * np.maximum(np.maximum(usual, steps), stated)).any()
        clipped = x.shape[1] == 1 and x[last, 0] in (x.min(), x.max())  # which leaves it gradually
        frozen[first + 1 : last + 1] = not _may_rest(channel, x, last) and (jumps or (fine and not clipped))
    return frozen


def _may_rest(channel: Channel, x: Array, row: int) -> bool:
    """Whether a row of x (n, k) is what a sensor reads at rest, or at the surface: zero, or nearly so."""
    if channel.stream == "dvl":
        size = np.linalg.norm(x, axis=1)
        return bool(size[row] <= NEAR_REST * np.median(size))
    return channel.stream != "imu" and bool((x[row] == 0).all())


def frozen_findings(log: Log, channel: Channel) -> list[Finding]:
    """Report the pieces of a channel in which the sensor, or its driver, is stuck."""
    frozen = frozen_rows(channel)
    if not frozen.any():
        return []
    pieces = stretches(frozen)
    first, last = max(pieces, key=lambda piece: channel.t_ns[piece[1]] - channel.t_ns[piece[0]])
    begin_s, end_s = seconds(log, channel.t_ns[[first - 1, last]])
    value = ", ".join(f"{v:.4g}" for v in channel.raw[last] * channel.shown + 0.0)
    often = "" if len(pieces) == 1 else f", the longest of {len(pieces)} such pieces"
    message = (
        f"{channel.name} is stuck from {begin_s:.1f} to {end_s:.1f} s: all {last - first + 2} readings are ({value}) "
        f"{channel.unit}{often}, while its others vary. These are no readings, but are used as such."
    )
    return [Finding(channel.stream, message, hint=_help(channel))]


def _help(channel: Channel) -> str:
    if channel.stream == "imu":
        return "start or stop the log outside that time: nothing replaces an IMU"
    return f"leave those rows out in the file, or by streams.{channel.stream}.valid"
