"""Gross single readings: marks of rows without one, outliers, dead axes and stuck sensors.

Cheap signs tell which channels to look at: a leap, a repeat, an axis that never changes. Those are then searched as
`fathom inspect` does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.finding import Finding
from ..findings.fitting import Mask
from ..streams.channels import Channel, channels_of, imu_period_ns
from ..streams.frozen import SAME_ANGLE, frozen_findings
from ..streams.missing import missing_rows, readings_of
from ..streams.neighbours import outliers, residuals, robust_sigma, stretches
from ..streams.outliers import outlier_finding
from ..streams.values import dead_axes, missing_findings

LEAP = 20.0
"""Over the stated sigma and the usual change from reading to reading: a filter without a gate is then thrown off."""
BURST = 15.0
"""Largest inertial reading over the 99th percentile; shocks and waves reach a few times that."""
FULL_SCALE = {"gyro": 35.0, "accel": 160.0}
"""rad/s and m/s²: 2000 °/s and 16 g, the range of the coarsest inertial sensors."""
SOME = 1000
"""Samples of which the percentile is taken."""
FEWEST = 20
"""Readings, fewer than which are not looked at."""
BESIDE = 16
"""Rows side by side; no result depends on it."""
MOVED = {"heading": 0.5, "depth": 2.0, "gps": 100.0, "dvl": 10.0}
"""rad and m that another sensor must have seen before a sensor that never changes is called dead."""


def reading_findings(log: Log) -> list[Finding]:
    """Find channels with gross readings. Their streams say nothing against others before they are mended."""
    found: list[Finding] = []
    for channel in channels_of(log):
        if len(channel.x) < FEWEST or not np.isfinite(channel.sigma).any():
            continue
        dead = _dead(log, channel)
        found += dead or _single(channel) + (frozen_findings(log, channel) if _repeats(channel) else [])
    return found


def without(log: Log, streams: set[str]) -> Log:
    """Return the log without some of its aiding streams."""
    absent: dict[str, Any] = dict.fromkeys(streams - {"imu"})
    return replace(log, **absent) if absent else log


def _dead(log: Log, channel: Channel) -> list[Finding]:
    """Find axes that never change, where the sensor has others that do, or another sensor shows motion."""
    measured = np.flatnonzero(np.isfinite(channel.sigma))
    constant = np.ptp(channel.x[:: max(len(channel.x) // SOME, 1)], axis=0)[measured] == 0
    if constant.any():
        constant = (channel.x == channel.x[0]).all(axis=0)[measured]
    live = np.count_nonzero(~constant)
    no_gravity = channel.name == "accel" and not channel.x[0].any() and not live
    if not constant.any() or (channel.stream == "gps" and live) or no_gravity:
        return []  # of an accelerometer the comparison with gravity tells
    if channel.stream != "imu" and live < 2 and (live or not _moves(log, channel)):
        return []  # an odometer's other axes are zero by construction
    return dead_axes(channel, channel.raw[:, measured], [channel.of_axis(int(k)) for k in measured])[0]


def _moves(log: Log, channel: Channel) -> bool:
    """Whether another sensor shows that this one's quantity changes."""
    name, dvl, seen = channel.stream, log.dvl, []
    if name == "heading":
        up = np.median(log.imu.f_I, axis=0)
        seen = [np.cumsum(log.imu.w_WI_I @ up / max(float(np.linalg.norm(up)), 1e-9)) * imu_period_ns(log.imu) * 1e-9]
    elif dvl is not None and name in ("depth", "gps") and len(dvl):
        rate = dvl.z[:, 2] if name == "depth" else np.linalg.norm(dvl.z[:, :2], axis=1)
        seen = [np.cumsum(rate[1:] * np.diff(dvl.t_ns) * 1e-9)]
    axes = slice(2, 3) if name == "depth" else slice(0, 2)
    if log.truth is not None and name != "heading":
        seen += list(log.truth.p_WB_W[:, axes].T)
    elif log.gps is not None and name == "dvl" and len(log.gps):
        seen += [east[np.isfinite(east)] for east in log.gps.z[:, axes].T]
    return any(np.ptp(values) > MOVED[name] for values in seen if len(values))


def _repeats(channel: Channel) -> bool:
    """Whether readings a second apart are ever alike, as they are in any stuck piece."""
    period_ns = max(int(channel.t_ns[-1] - channel.t_ns[0]) // (len(channel.x) - 1), 1)
    first = channel.x[:: max(10**9 // period_ns, 1), int(np.argmax(np.isfinite(channel.sigma)))]
    return bool((np.abs(np.diff(first)) < SAME_ANGLE).any())


def _single(channel: Channel) -> list[Finding]:
    """Find marks, zeros and outliers in a channel that leaps."""
    if not _leaps(channel):
        return []
    missing = missing_rows(channel)
    if missing.marked.any() or (missing.zero.any() and _amid_motion(channel, missing.zero)):
        return missing_findings(channel)
    good = readings_of(channel)
    out = outliers(good)
    if out.any():
        off = residuals(good)
        scale = np.maximum(np.nan_to_num(robust_sigma(off)), good.sigma)
        out &= (np.abs(np.nan_to_num(off)) > LEAP * scale).any(axis=1)
    return [outlier_finding(good, out)] if out.any() else []


def _leaps(channel: Channel) -> bool:
    if channel.stream == "imu":
        some = channel.x[:: max(len(channel.x) // SOME, 1)]
        middle, (least, most) = np.median(some, axis=0), _range(channel.x)
        far = np.maximum(most - middle, middle - least)
        usual = np.quantile(np.abs(some - middle), 0.99, axis=0)
        return bool((far > np.minimum(BURST * usual, FULL_SCALE[channel.name])).any())
    near = np.diff(channel.t_ns) < 5e9 * channel.period_s
    change = np.abs(np.diff(channel.x[:, np.isfinite(channel.sigma)], axis=0))[near]
    if len(change) < FEWEST:
        return False
    usual = np.median(change[:: max(len(change) // SOME, 1)], axis=0)
    return bool((change.max(axis=0) > LEAP * np.maximum(usual, channel.sigma[np.isfinite(channel.sigma)])).any())


def _range(x: Array) -> tuple[Array, Array]:
    """Return least and largest values (3,) of x (n, 3), many rows at a time: numpy is slow with rows of three."""
    whole = len(x) // BESIDE * BESIDE
    wide, rest = x[:whole].reshape(-1, BESIDE * 3), x[whole:]
    least = np.vstack([wide.min(axis=0).reshape(-1, 3), rest]).min(axis=0)
    return least, np.vstack([wide.max(axis=0).reshape(-1, 3), rest]).max(axis=0)


def _amid_motion(channel: Channel, zero: NDArray[np.bool_]) -> bool:
    """Whether most stretches of zeros lie between readings of the usual size; at rest a sensor may read zero."""
    size = np.linalg.norm(channel.raw[:, np.isfinite(channel.sigma)], axis=1)
    usual: Mask = size > 0.5 * np.median(size[~zero])
    beside = [(a == 0 or usual[a - 1]) and (b + 1 == len(size) or usual[b + 1]) for a, b in stretches(zero)]
    return bool(np.mean(beside) > 0.5)
