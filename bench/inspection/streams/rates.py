"""The times of the readings: rates, gaps, bunches and delays."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from ....datasets.log import Log
from ....datasets.state import Array, TimeArray
from ...drawing import logarithmic
from ..findings.finding import Check, Finding
from ..findings.panels import colour_of, thinned
from .channels import seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SLOWEST_IMU_HZ = 20.0
"""A vehicle's own motion reaches 2 Hz (pitch and roll in a sea, a turn of the fins), with ten samples per period."""
CLUSTERED = 0.25
"""Of the median interval: two samples stamped by a regular clock are never this close."""
MOST_CLUSTERED = 0.01
"""Share of the intervals: a few such pairs occur in any log, when a host catches up."""
MOST_OF_TIME = 0.95
"""Share of the samples whose rate is looked at: the first and the last seconds of a log may be slower."""
RATE_CHANGE = 1.2
"""Times: a rate that differs by more within a log is another setting of the device."""
MOST_JITTER = 0.2
"""Standard deviation over the interval: with more, the stamps are not of the sampling."""
MOST_LOST = {"imu": 0.001}
"""Share of samples. A lost inertial sample is motion that was not measured."""
MOST_LOST_AIDING = 0.05
"""Share of readings. A lost reading of an aiding sensor only means less information."""
MOST_OUTSIDE = 0.01
"""Share of readings outside the IMU's time: recorders rarely start and stop all streams at once."""
LONGEST_GAP_S = 5.0
"""Tilted by half a degree, as accelerometers level, inertial dead reckoning is 1 m off after 5 s."""
LONGEST_IMU_GAP_S = 0.1
"""At 10 °/s the vehicle turns by a degree meanwhile."""


def check_rates(log: Log) -> Check:
    """Count each stream's readings, gaps and clusters."""
    facts, findings = {}, []
    times = _times(log)
    for name, t_ns in times.items():
        if len(t_ns) < 3:
            facts[name] = f"{len(t_ns)} readings"
            continue
        interval_s = np.diff(t_ns) * 1e-9
        about_s = _about_s(log, name, interval_s)
        period_s = float(np.median(about_s))
        lost = _lost_samples(log) if name == "imu" else _lost(name, interval_s, period_s)
        clustered = float(np.mean(interval_s < CLUSTERED * about_s))
        ratio = interval_s / about_s
        jitter = float(np.std(ratio - np.rint(ratio)))  # a lost reading is no jitter
        at = int(np.argmax(interval_s))
        facts[name] = (
            f"{len(t_ns)} at {_rate(about_s)}, jitter {jitter:.1%}, lost {lost / (len(t_ns) + lost):.2%}, "
            f"longest gap {interval_s[at]:.3g} s at {seconds(log, t_ns[at]):.1f} s"
        )
        mean_hz = (len(t_ns) - 1 + lost) / ((int(t_ns[-1]) - int(t_ns[0])) * 1e-9)
        bunched = _clusters(name, clustered, jitter, period_s, mean_hz)
        findings += bunched or _gaps(log, name, t_ns, lost)  # bunches imply gaps between them
    imu_hz = 1e9 / float(np.quantile(log.imu.sampling_ns, MOST_OF_TIME))
    if imu_hz < SLOWEST_IMU_HZ:
        findings.append(
            Finding(
                "imu",
                f"The IMU samples at {imu_hz:.3g} Hz: motion and vibration above {imu_hz / 2:.3g} Hz are aliased, and "
                "coning between samples is not measured.",
                "streams.imu.noise.gyro_density and accel_density: large enough to cover that",
            )
        )

    def draw(axes: Axes) -> None:
        for order, (name, t_ns) in enumerate(times.items()):
            if len(t_ns) > 2:
                t_s, interval_s = seconds(log, t_ns[1:]), np.diff(t_ns) * 1e-9
                kept, look = (
                    thinned(interval_s),
                    {"ms": 1.5 + order, "zorder": 3 - order / 10, "color": colour_of(name)},
                )
                axes.plot(t_s[kept], interval_s[kept], ".", label=name, rasterized=True, **look)
        axes.set(xlabel="time (s)", ylabel="interval (s)")
        logarithmic(axes, "y")
        axes.legend(fontsize=6, markerscale=1.5, ncols=3)

    return Check("rates and gaps", facts, tuple(findings), draw if any(len(t) > 2 for t in times.values()) else None)


def _times(log: Log) -> dict[str, TimeArray]:
    return {"imu": log.imu.t_ns} | {name: stream.t_ns for name, stream in log.streams.items()}


def _about_s(log: Log, name: str, interval_s: Array) -> Array:
    """Return the usual interval at each interval, (n,) s: the IMU's own about it, another sensor's median."""
    if name == "imu":
        return np.asarray(log.imu.sampling_ns[1:] * 1e-9, np.float64)
    return np.full(len(interval_s), np.median(interval_s))


def _rate(about_s: Array) -> str:
    """Return the rate, or the lowest and the highest if it changes."""
    low, middle, high = 1 / np.quantile(about_s, [MOST_OF_TIME, 0.5, 1 - MOST_OF_TIME])
    return f"{low:.4g} to {high:.4g} Hz" if high > RATE_CHANGE * low else f"{middle:.4g} Hz"


def _longest_gap_s(name: str, period_s: float) -> float:
    """Return the length from which a gap is a silence rather than lost readings."""
    return max(LONGEST_IMU_GAP_S if name == "imu" else LONGEST_GAP_S, 3 * period_s)


def _lost(name: str, interval_s: Array, period_s: float) -> int:
    """Return the number of missing readings between silences; two within one period cancel a missing one."""
    short = interval_s[interval_s <= _longest_gap_s(name, period_s)]
    return max(int((np.rint(short / period_s) - 1).sum()), 0)


def _lost_samples(log: Log) -> int:
    """Return the number of missing IMU samples between silences."""
    gaps, sampling = log.imu.gaps_ns, log.imu.sampling_ns
    short = gaps <= _longest_gap_s("imu", log.imu.period_ns * 1e-9) * 1e9
    return int(np.rint(gaps[short] / sampling[short]).sum())


def _clusters(name: str, clustered: float, jitter: float, period_s: float, mean_hz: float) -> list[Finding]:
    if clustered > MOST_CLUSTERED:
        message = (
            f"{name} readings come in bunches: {clustered:.1%} of their intervals are under a quarter of the median "
            f"({period_s * 1e3:.3g} ms). They were stamped when they were received, not when they were taken."
        )
    elif name == "imu" and jitter > MOST_JITTER:
        message = (
            f"IMU intervals jitter by {jitter:.0%} of {period_s * 1e3:.3g} ms: they were stamped when they were "
            "received, not when they were taken."
        )
    else:
        return []
    fix = (
        f"streams.{name}.message.clock, or a time column of the device's own clock; without one, "
        f"streams.{name}.time: {{row_rate_hz: {mean_hz:.5g}, start_s: …}} if no row is missing"
    )
    return [Finding(name, message, fix)]


def _gaps(log: Log, name: str, t_ns: TimeArray, lost: int) -> list[Finding]:
    """Find lost readings and long silences; a GPS is silent under water, so its gaps are no finding."""
    if name == "gps":
        return []
    findings = []
    share = lost / (len(t_ns) + lost)
    if share > MOST_LOST.get(name, MOST_LOST_AIDING):
        dropped = [
            note.removeprefix(f"{name}: ") for note in log.notes if re.match(rf"{name}: \d+ rows .* dropped$", note)
        ]
        by_hand = f"; the description drops some ({'; '.join(dropped)})" if dropped else ""
        findings.append(
            Finding(
                name, f"{share:.1%} of the {name} readings are missing: {lost}, by their rate, between others{by_hand}."
            )
        )
    longest_s = _longest_gap_s(name, float(np.median(_about_s(log, name, np.diff(t_ns) * 1e-9))))
    ends_ns = [] if name == "imu" else [log.start_ns, int(log.imu.t_ns[-1])]
    inside = t_ns[(t_ns >= log.start_ns) & (t_ns <= log.imu.t_ns[-1])]
    edges_ns = np.sort(np.concatenate([inside, np.array(ends_ns, np.int64)]))
    gap_s = np.diff(edges_ns) * 1e-9
    if name == "imu":
        gap_s = np.where(log.imu.gaps_ns[t_ns >= log.start_ns][1:] > 0, gap_s, 0.0)
    long = np.flatnonzero(gap_s > longest_s)
    if len(long):
        at = long[np.argmax(gap_s[long])]
        count = "one silence" if len(long) == 1 else f"{len(long)} silences"
        findings.append(
            Finding(
                name,
                f"{name} has {count} of more than {longest_s:g} s; the longest is {gap_s[at]:.3g} s, "
                f"from {seconds(log, edges_ns[at]):.1f} s after the start.",
            )
        )
    outside = len(t_ns) - len(inside)
    if outside > MOST_OUTSIDE * len(t_ns):
        findings.append(
            Finding(
                name,
                f"{outside} of {len(t_ns)} {name} readings lie before or after the IMU's time and are of no use.",
                f"streams.{name}.time.clock_offset_s, if the two clocks differ",
            )
        )
    return findings


def check_delays(log: Log) -> Check:
    """Report how late each stream's readings were received, and how many out of order."""
    facts, findings = {}, []
    late = {name: np.asarray((s.received_ns - s.t_ns) * 1e-9, float) for name, s in log.streams.items() if len(s) > 1}
    for name, late_s in late.items():
        if not late_s.any():
            facts[name] = "none, or not recorded"
            continue
        stream = log.streams[name]
        overtaken = int(
            np.count_nonzero(stream.received_ns[:-1] > np.minimum.accumulate(stream.received_ns[::-1])[-2::-1])
        )
        median_s, period_s = float(np.median(late_s)), float(np.median(np.diff(stream.t_ns))) * 1e-9
        facts[name] = f"median {median_s:.3g} s, at most {late_s.max():.3g} s, {overtaken} overtaken by a later one"
        if median_s > period_s or overtaken:
            order = f", and {overtaken} of {len(late_s)} were overtaken by a later one" if overtaken else ""
            findings.append(
                Finding(
                    name,
                    f"{name} readings arrive {median_s:.3g} s after they were true (at most {late_s.max():.3g} s), "
                    f"with an interval of {period_s:.3g} s{order}: a filter that cannot replay uses them late.",
                    f"streams.{name}.time.received and .delay_s, if that is wrong",
                )
            )

    def draw(axes: Axes) -> None:
        for name, late_s in late.items():
            if late_s.any():
                t_s, kept = seconds(log, log.streams[name].t_ns), thinned(late_s)
                axes.plot(t_s[kept], late_s[kept], ".", ms=2, color=colour_of(name), label=name, rasterized=True)
        axes.set(xlabel="time (s)", ylabel="received after it was true (s)")
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=6, markerscale=3)

    return Check("delays", facts, tuple(findings), draw if any(late_s.any() for late_s in late.values()) else None)
