"""Cut a log into epochs, in the order of reception, as a vehicle would receive it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .imu_time import GAP_FACTOR
from .log import AttitudeStream, Log
from .state import Array, TimeArray

DVL, DEPTH, GPS, HEADING, ATTITUDE = range(5)
"""Kinds of readings, as READING and compiled code number them."""
KIND = {"dvl": DVL, "depth": DEPTH, "gps": GPS, "heading": HEADING, "attitude": ATTITUDE}
SENSOR = ("dvl", "depth", "gps", "heading", "heading")
"""Sensor name by kind; a full attitude comes from the heading sensor."""

IMU_SAMPLE = np.dtype(
    [
        ("t_ns", "i8"),  # end of the interval
        ("dt_s", "f8"),  # its length
        ("held_s", "f8"),  # in a gap, in which the sample before is held: its length (less if short: `_held_s`); else 0
        ("period_s", "f8"),  # sampling period of the IMU, also where a sample was split
        ("w_WI_I", "f8", (3,)),
        ("f_I", "f8", (3,)),
        ("alpha_I", "f8", (3,)),  # rad/s²: how w_WI_I changes, by this sample and the one before it; 0 without one
        ("after_s", "f8"),  # how long after the middle of the sample the row ends; 0 in a gap
    ]
)
READING = np.dtype([("kind", "i8"), ("t_ns", "i8"), ("received_ns", "i8"), ("z", "f8", (9,)), ("sigma", "f8", (3,))])

MOST_BRIDGED = 0.2
"""Share of a log: with less than four fifths of its motion measured, an estimate is not of an IMU any more."""
STRAYS_S = 0.1
"""A rate strays as far as `physics.imu` says in a tenth of a second or more (1 rad/s², 5 m/s³); in less, less far."""
IMU_GAP = "imu gap at"
"""How the cause of a voyage begins that ends at a gap of the IMU; its estimates hold up to there."""


class Epoch(NamedTuple):
    """What a vehicle receives between two times.

    Attributes:
        t_ns: the later time.
        imu: IMU_SAMPLE rows that cover exactly the time since the epoch before: a sample that straddles an epoch's end
            is split there. So an epoch waits for the sample that covers its end, at most one interval of the IMU.
        readings: READING rows received at t_ns, each true at that time or earlier.
        tick: the harness will ask for a belief now.
    """

    t_ns: int
    imu: NDArray[Any]
    readings: NDArray[Any]
    tick: bool


@dataclass(frozen=True)
class Voyage:
    """A log cut into epochs.

    Attributes:
        epochs: in the order of reception.
        start_ns: start of the first IMU block.
        counts: IMU gaps bridged and how long they are in all (ms), readings outside the IMU's time, and readings that
            measure nothing (every sigma infinite).
        failure: why the voyage ends early, with the time; or None.
    """

    epochs: list[Epoch]
    start_ns: int
    counts: dict[str, int]
    failure: str | None


def reading_table(log: Log, sensors: Collection[str] | None = None) -> NDArray[Any]:
    """Stack the log's readings into one READING array, in the order of reception (then of truth, then of kind)."""
    tables = []
    for sensor, stream in log.streams.items():
        if sensors is not None and sensor not in sensors:
            continue
        table = np.zeros(len(stream), READING)
        table["kind"] = ATTITUDE if isinstance(stream, AttitudeStream) else KIND[sensor]
        table["t_ns"], table["received_ns"] = stream.t_ns, stream.received_ns
        table["z"][:, : stream.width] = stream.z
        table["sigma"] = np.inf
        table["sigma"][:, : stream.residual_width] = stream.sigma
        tables.append(table)
    if not tables:
        return np.zeros(0, READING)
    table = np.concatenate(tables)
    return table[np.lexsort((table["kind"], table["t_ns"], table["received_ns"]))]


def cut(
    log: Log, ticks_ns: TimeArray | None = None, sensors: Collection[str] | None = None, max_gap_s: float = 1.0
) -> Voyage:
    """Cut the log at every reception and at every tick.

    Args:
        log: what to cut; starts at its prior's time, or at its first IMU sample.
        ticks_ns: (k,) increasing; times at which a belief will be asked for. Those outside the IMU's time are ignored.
        sensors: aiding sensors to keep; all when None.
        max_gap_s: longest gap of the IMU that is bridged: the last sample is held, and the covariance grows. A longer
            one ends the voyage, with `failure` set; and so does the gap at which all of them together exceed both
            max_gap_s and MOST_BRIDGED of the log.
    """
    start_ns = log.start_ns
    interval, gap = _intervals(log, start_ns)
    failure, end_ns = _last_gap(log, start_ns, interval, gap, max_gap_s)
    bridged = gap[(log.imu.t_ns > start_ns) & (log.imu.t_ns <= end_ns)]

    readings = reading_table(log, sensors)
    inside = (readings["t_ns"] > start_ns) & (readings["received_ns"] <= end_ns)
    void = inside & ~np.isfinite(readings["sigma"]).any(axis=1)
    counts = {"imu_gaps_bridged": int(np.count_nonzero(bridged)), "imu_gaps_ms": round(int(bridged.sum()) * 1e-6)}
    counts |= {"readings_outside": int((~inside).sum()), "readings_void": int(void.sum())}
    readings = readings[inside & ~void]
    ticks = np.zeros(0, np.int64) if ticks_ns is None else ticks_ns[(ticks_ns > start_ns) & (ticks_ns <= end_ns)]

    times = np.union1d(readings["received_ns"], ticks)
    samples = _imu_table(log, times, start_ns, end_ns, interval, gap)
    imu_stop = np.searchsorted(samples["t_ns"], times, side="right").tolist()
    reading_stop = np.searchsorted(readings["received_ns"], times, side="right").tolist()
    is_tick = np.isin(times, ticks).tolist()

    epochs, i, r = [], 0, 0
    for t_ns, i_stop, r_stop, tick in zip(times.tolist(), imu_stop, reading_stop, is_tick, strict=True):
        epochs.append(Epoch(t_ns, samples[i:i_stop], readings[r:r_stop], tick))
        i, r = i_stop, r_stop
    return Voyage(epochs, start_ns, counts, failure)


def _intervals(log: Log, start_ns: int) -> tuple[TimeArray, TimeArray]:
    """Return the time since the sample before (or since the start), and the gap in it, for each sample, (n,) ns."""
    period_ns, gap = int(log.imu.t_ns[0]) - log.imu.start_ns, log.imu.gaps_ns
    interval = np.diff(log.imu.t_ns, prepend=min(start_ns, log.imu.start_ns))
    gap[0] = interval[0] - period_ns if interval[0] > GAP_FACTOR * period_ns else 0
    return interval, gap


def _last_gap(log: Log, start_ns: int, interval: TimeArray, gap: TimeArray, max_gap_s: float) -> tuple[str | None, int]:
    """Return why the voyage ends at a gap, or None, and the end of its IMU data."""
    t_ns, last_ns = log.imu.t_ns, int(log.imu.t_ns[-1])
    most_ns = max(MOST_BRIDGED * (last_ns - start_ns), max_gap_s * 1e9)
    in_all = np.cumsum(np.where(t_ns > start_ns, gap, 0))
    long = interval > max_gap_s * 1e9
    ends = np.flatnonzero((t_ns > start_ns) & (long | (in_all > most_ns)))
    if not len(ends):
        return None, last_ns
    row = ends[0]
    end_ns = int(t_ns[row] - interval[row])
    why = f"{interval[row] * 1e-9:.3f} s without a sample"
    if not long[row]:
        why = f"gaps of {in_all[row] * 1e-9:.3f} s in all, more than {MOST_BRIDGED:.0%} of the log"
    return f"{IMU_GAP} {(end_ns - start_ns) * 1e-9:.3f} s: {why}", end_ns


def _held_s(gap: TimeArray) -> Array:
    """Return for how long each gap (n,) ns counts, s: its length, less where it is short; variance is by its square."""
    gap_s = gap * 1e-9
    return np.asarray(gap_s * np.minimum(gap_s / STRAYS_S, 1.0) ** 2, np.float64)


def _imu_table(
    log: Log, times: TimeArray, start_ns: int, end_ns: int, interval: TimeArray, gap: TimeArray
) -> NDArray[Any]:
    """Return the samples after start_ns as IMU_SAMPLE rows, split at `times`.

    In a gap the sample before is held, up to one period before the next one, so that no row uses a later sample.
    """
    imu, is_gap = log.imu, gap > 0
    middle = imu.t_ns - (interval - gap) // 2
    alpha_I = np.zeros_like(imu.w_WI_I)
    alpha_I[1:] = np.diff(imu.w_WI_I, axis=0) / (np.diff(middle) * 1e-9)[:, None]
    held_until = imu.t_ns - interval + gap
    edges = np.union1d(times, held_until[is_gap])
    edges = edges[(edges > start_ns) & (edges <= end_ns)]
    own = imu.t_ns[(imu.t_ns > start_ns) & (imu.t_ns <= end_ns)]
    if not len(own):
        return np.zeros(0, IMU_SAMPLE)
    between = edges[own[np.minimum(np.searchsorted(own, edges), len(own) - 1)] != edges]
    t_ns = np.insert(own, np.searchsorted(own, between), between) if len(between) else own

    source = np.searchsorted(imu.t_ns, t_ns)
    held = is_gap[source] & (t_ns <= held_until[source])
    table = np.zeros(len(t_ns), IMU_SAMPLE)
    table["t_ns"], table["period_s"] = t_ns, imu.period_ns * 1e-9
    table["dt_s"] = np.diff(t_ns, prepend=start_ns) * 1e-9
    table["held_s"] = np.where(held, _held_s(gap)[source], 0.0)
    table["alpha_I"][~held] = alpha_I[source[~held]]
    table["after_s"][~held] = (t_ns - middle[source])[~held] * 1e-9
    source = np.where(held, np.maximum(source - 1, 0), source)
    table["w_WI_I"], table["f_I"] = imu.w_WI_I[source], imu.f_I[source]
    return table
