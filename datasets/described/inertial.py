"""The IMU of a description: gyro and accelerometer, from one source or from two, perhaps thinned by means."""

from __future__ import annotations

import numpy as np

from ..errors import DatasetError
from ..log import ImuStream
from ..state import Array, TimeArray
from . import description as d
from .rows import Rows, read_rows
from .sources import Opening

FLIP_YZ = np.array([1.0, -1.0, -1.0])
"""FRD to FLU, and back."""
LONGEST = 1.5
"""Sampling periods for which a sample speaks in a mean; behind a gap it does not speak for the gap."""


def flu(values: Array, axes: str) -> Array:
    """Return (n, 3) in forward, left, up."""
    return values * FLIP_YZ if axes == "FRD" else values


def read_imu(opening: Opening, part: d.ImuDescription) -> ImuStream:
    """Read the gyro's and the accelerometer's samples."""
    rows = _with_accel(opening, part, part.accel_source) if part.accel_source else _together(opening, part)
    t_ns, gyro, accel = rows.t_ns, rows.values["gyro"], rows.values["accel"]
    if part.every > 1:
        count, (t_ns, gyro, accel) = len(t_ns), means(t_ns, gyro, accel, part.every)
        opening.notes.append(f"imu: each sample is the mean of {part.every}, {len(t_ns)} of {count} rows")
    try:
        return ImuStream(t_ns, flu(gyro, part.axes), flu(accel, part.axes))
    except DatasetError as error:
        raise DatasetError(f"{opening.folder}: {error}") from None


def means(t_ns: TimeArray, gyro: Array, accel: Array, n: int) -> tuple[TimeArray, Array, Array]:
    """Return the means of n samples each, at the time of the last; what is left over at the end is dropped.

    A sample is itself a mean over the interval that ends at its time, so its weight is that interval: the integral of
    the means is that of the samples. An interval that is a gap weighs 1.5 sampling periods.
    """
    m = len(t_ns) // n * n
    if not m:
        return t_ns[:0], gyro[:0], accel[:0]
    step_s = np.diff(t_ns) * 1e-9
    period_s = float(np.median(step_s))
    weight = np.minimum(np.concatenate([[period_s], step_s]), LONGEST * period_s)[:m].reshape(-1, n, 1)

    def mean(values: Array) -> Array:
        return (values[:m].reshape(-1, n, 3) * weight).sum(axis=1) / weight.sum(axis=1)

    return t_ns[n - 1 : m : n], mean(gyro), mean(accel)


def _together(opening: Opening, part: d.ImuDescription) -> Rows:
    rows = read_rows(opening, "imu", part, [*part.gyro.columns, *part.accel.columns])
    rows.values |= {"gyro": rows.si(part.gyro), "accel": rows.si(part.accel)}
    rows.put_in_order()
    return rows


def _with_accel(opening: Opening, part: d.ImuDescription, source: d.SourceDescription) -> Rows:
    """Return the gyro's rows with the accelerometer's samples, interpolated linearly to their times.

    A gyro sample without accelerometer samples on both sides, within two of their periods, is dropped and counted.
    """
    rows = read_rows(opening, "imu", part, list(part.gyro.columns))
    rows.values["gyro"] = rows.si(part.gyro)
    rows.put_in_order()
    other = read_rows(opening, "imu", source, list(part.accel.columns))
    other.put_in_order()
    accel = other.si(part.accel)
    if len(other.t_ns) < 2:
        raise rows.error(f"{len(other.t_ns)} accelerometer rows, at least 2 are needed")
    after = np.searchsorted(other.t_ns, rows.t_ns).clip(1, len(other.t_ns) - 1)
    step = other.t_ns[after] - other.t_ns[after - 1]
    weight = (rows.t_ns - other.t_ns[after - 1]) / step
    alone = (weight < 0) | (weight > 1) | ((step > 2 * np.median(np.diff(other.t_ns))) & (weight % 1 != 0))
    share = weight.clip(0, 1)[:, None]
    rows.values["accel"] = accel[after - 1] * (1 - share) + accel[after] * share
    rows.leave_out(alone, "of the gyro without the accelerometer's beside them")
    return rows
