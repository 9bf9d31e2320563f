"""What a run noticed of its log and of the readings it got, as notes: silent sensors, late readings, gates, gaps."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.log import Log, ReadingStream
from ...datasets.notes import Note
from ...datasets.rig import Rig
from ...estimators.interface import MERGE_NS, OUTLIERS
from ...estimators.physics.imu import turns_with_earth
from ...estimators.unknown_start import yaw_sigma_rad

ON_TIME_NS = MERGE_NS
"""A reading received at most this long after it was true came in time."""


def late_readings(log: Log, sensors: Collection[str], start_ns: int, end_ns: int) -> int:
    """Return how many readings of these sensors came late between two times, by the log alone.

    So it is the same number for every estimator that uses these sensors; what became of them is the estimator's.
    """
    streams = [stream for sensor, stream in log.streams.items() if sensor in sensors]
    return sum(
        int(np.count_nonzero(_between(s, start_ns, end_ns) & (s.received_ns - s.t_ns > ON_TIME_NS))) for s in streams
    )


def _between(stream: ReadingStream, start_ns: int, end_ns: int) -> NDArray[np.bool_]:
    """Return which readings are driven through: true after the start, received by the end, and not void."""
    measures = np.isfinite(stream.sigma).any(axis=1)
    return (stream.t_ns > start_ns) & (stream.received_ns <= end_ns) & measures


def noticed(log: Log, counts: Mapping[str, int], estimator: object = None) -> tuple[Note, ...]:
    """Return a note for whatever a run noticed.

    Args:
        log: what was driven through.
        counts: of the run, see `Result.counts`.
        estimator: its configuration; `honest_yaw_rad` and `earth_rotation` are told of, where it states them.
    """
    of_estimator = (*_of_start(log, estimator), *_of_earth(log.rig, estimator))
    return (*of_estimator, *_of_streams(log), *_of_counts(log, counts))


def _stated(estimator: object, name: str) -> Any:
    """Return an attribute; None where there is none, or another package's code raises instead."""
    try:
        return getattr(estimator, name, None)
    except Exception:
        return None


def _of_start(log: Log, estimator: object) -> Iterator[Note]:
    """Yield where the heading at the start is known less well than the estimator needs to be honest."""
    most_rad = _stated(estimator, "honest_yaw_rad")
    if log.prior is not None and isinstance(most_rad, float) and (sigma_rad := yaw_sigma_rad(log.prior)) > most_rad:
        known, most = (f"{math.degrees(angle):.0f}°" for angle in (sigma_rad, most_rad))
        yield Note(f"the heading at the start has a sigma of {known}, and it is honest up to {most}", "overclaims")


def unmeasured_height(log: Log, sensors: Collection[str]) -> tuple[Note, ...]:
    """Return a note where a score in 3D takes in the height of the truth, which none of these sensors measures."""
    heard = {name: stream for name, stream in log.streams.items() if name in sensors and len(stream)}
    if log.truth is None or "depth" in heard or not np.isfinite(log.truth.p_WB_W[:, 2]).any():
        return ()
    gps = heard.get("gps")
    if gps is not None and np.isfinite(gps.sigma[:, 2]).any():
        return ()
    n = 0 if gps is None else len(gps)
    fixes = f", and {n} of {n} fixes without a height" if gps is not None else " and no fix"
    text = f"nothing measures the height (no depth{fixes}), which is scored in 3D; `dims: 2d` scores the horizontal"
    return (Note(text, "height", "" if gps is None else "gps", n, n or None),)


def _of_earth(rig: Rig, estimator: object) -> Iterator[Note]:
    """Yield whether an estimator that can model the Earth's rotation does so, where the latitude is known."""
    option = _stated(estimator, "earth_rotation")
    if rig.latitude_deg is not None and (isinstance(option, bool) or option == "auto"):
        said = "modelled" if turns_with_earth(rig, option) else "left out (earth_rotation: false)"
        yield Note(f"{said}, at latitude {rig.latitude_deg:.1f}°", "earth")


def _of_streams(log: Log) -> Iterator[Note]:
    """Yield which sensors have no reading, and which have readings outside the IMU's time."""
    first_ns, end_ns = int(log.imu.t_ns[0]) - log.imu.period_ns, int(log.imu.t_ns[-1])
    for sensor, stream in log.streams.items():
        n = len(stream)
        out = n - int(np.count_nonzero((stream.t_ns > first_ns) & (stream.received_ns <= end_ns)))
        if out == n:
            yield Note(f"{sensor}: not one reading in the whole log", "silent", sensor, 0)
        elif out:
            text = f"{sensor}: {out} of {n} readings lie outside the IMU's time and are not used"
            yield Note(text, "outside", sensor, out, n)


def _of_counts(log: Log, counts: Mapping[str, int]) -> Iterator[Note]:
    """Yield what a run counted of gaps and readings."""
    readings, dropped = counts["readings"], counts.get("late", 0)
    if n := counts["imu_gaps_bridged"]:
        ms = counts.get("imu_gaps_ms")
        seconds = None if ms is None else ms * 1e-3
        yield Note(f"imu: {n} gaps bridged, each by holding the last sample", "gap", "imu", n, seconds=seconds)
    found = {
        "late_dropped": (dropped, "came too late and were dropped"),
        "late": (counts["readings_late"], "were received more than 1 ms after they were true"),
        "merged": (counts.get("merged", 0), "were taken as of a time a little before or after their own"),
        "carried": (counts.get("carried", 0), "were tied by the IMU to the keyframe before them"),
        "void": (counts["readings_void"], "measured nothing (every sigma is infinite)"),
    }
    for kind, (n, what) in found.items():
        if n > 0:
            yield Note(f"{n} of {readings} readings {what}", kind, "", n, readings)
    for name, n in counts.items():
        sensor = name.removeprefix(OUTLIERS)
        if n > 0 and name.startswith(OUTLIERS) and sensor in log.streams:
            of = len(log.streams[sensor])
            text = f"{sensor}: {n} of {of} readings rejected by the gate, or given less weight by the loss"
            yield Note(text, "gated", sensor, n, of)
