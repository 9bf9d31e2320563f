"""Times at rest, and the gyro's bias and |f| in them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....datasets.log import Log
from ....datasets.quantities import DEGREE
from ....datasets.rig import EARTH_RATE_RAD_S
from ....datasets.state import Array, TimeArray
from ..findings.finding import Check, Finding
from ..findings.panels import AXIS_COLOURS, thinned
from .channels import channels_of, seconds
from .neighbours import noise_sigma, stretches

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WINDOW_S = 1.0
"""The rest test is made per window of this length."""
PART_S = 0.1
"""Means over this are compared within a window, so that noise and vibration average out."""
QUIET_RAD_S = 0.005
"""0.3 °/s, as the standard deviation of such means: a vehicle moored to a quay turns more."""
QUIET_M_S2 = 0.05
"""The same for the specific force: 0.3° of tilt."""
QUIET_M_S = 0.1
"""By the DVL: slower than any vehicle under way."""
TURNED_RAD = DEGREE
"""From the first quarter of a time at rest to its last."""
SHORTEST_S = 5.0
"""Over less, a gyro's white noise hides the turn-on bias that is read there."""
SIGMAS = 4.0
"""Of the stated turn-on bias: normal biases exceed it once in 16,000."""


class Rest(NamedTuple):
    """One time at rest: samples `first` to `last`, inclusive."""

    first: int
    last: int


def rests(log: Log) -> list[Rest]:
    """Return the times of five seconds and more at rest, in order.

    A second is at rest if gyro and accelerometer, averaged over tenths of a second, hardly vary (allowing for their
    stated noise) and the DVL reads hardly any velocity. Seconds of one time at rest must agree in rate and in f.
    """
    t_ns, noise = log.imu.t_ns, log.rig.imu_noise
    part = max(round(PART_S * 1e9 / log.imu.period_ns), 1)
    parts = max(round(WINDOW_S * 1e9 / (part * log.imu.period_ns)), 2)
    size = part * parts
    windows = len(t_ns) // size
    if windows < 2:
        return []
    n = windows * size
    part_s = part * log.imu.period_ns * 1e-9
    quiet = _whole(t_ns[:n].reshape(windows, size), log.imu.period_ns)
    means = []
    for x, limit, density in (
        (log.imu.w_WI_I, QUIET_RAD_S, noise.gyro_density),
        (log.imu.f_I, QUIET_M_S2, noise.accel_density),
    ):
        averaged = x[:n].reshape(windows, parts, part, 3).mean(axis=2)
        allowed = limit + 3 * density / np.sqrt(part_s)
        quiet &= (averaged.std(axis=1) < allowed).all(axis=1)
        means.append((averaged.mean(axis=1), allowed))
    starts_ns, ends_ns = t_ns[0:n:size], t_ns[size - 1 : n : size]
    quiet &= _still_by_dvl(log, starts_ns, ends_ns)
    found, turns = [], []
    for first, last in stretches(quiet):
        for a, b in _steady(first, last, means):
            long = (ends_ns[b] - starts_ns[a]) * 1e-9 >= SHORTEST_S - 2 * part_s
            if long and _stays(log, int(starts_ns[a]), int(ends_ns[b])):
                found.append(Rest(a * size, (b + 1) * size - 1))
                turns.append(means[0][0][a : b + 1].mean(axis=0))
    if not found:
        return []
    least = turns[int(np.argmin(np.linalg.norm(turns, axis=1)))]  # a steady turn passes as rest, but its rate is larger
    return [rest for rest, turn in zip(found, turns, strict=True) if np.abs(turn - least).max() <= means[0][1]]


def _whole(t_ns: TimeArray, period_ns: int) -> NDArray[np.bool_]:
    """Return which windows (rows) have no gap."""
    return t_ns[:, -1] - t_ns[:, 0] < 1.5 * period_ns * t_ns.shape[1]


def _still_by_dvl(log: Log, starts_ns: TimeArray, ends_ns: TimeArray) -> NDArray[np.bool_]:
    """Return the windows in which no reading of the DVL shows motion."""
    still = np.ones(len(starts_ns), bool)
    if log.dvl is not None and len(log.dvl):
        speed = np.linalg.norm(log.dvl.z, axis=1)
        sigma = np.where(np.isfinite(log.dvl.sigma), log.dvl.sigma, 0.0)
        moving = log.dvl.t_ns[speed > QUIET_M_S + 3 * np.linalg.norm(sigma, axis=1)]
        still &= np.searchsorted(moving, ends_ns, side="right") == np.searchsorted(moving, starts_ns)
    return still


def _stays(log: Log, start_ns: int, end_ns: int) -> bool:
    """Whether DVL and heading, averaged over the whole time, show no motion either."""
    if log.dvl is not None:
        inside = (log.dvl.t_ns >= start_ns) & (log.dvl.t_ns <= end_ns)
        v, sigma = log.dvl.z[inside], log.dvl.sigma[inside]
        if len(v):
            sigma = np.where(np.isfinite(sigma), sigma, 0.0).max(axis=0) / np.sqrt(len(v))
            if np.linalg.norm(np.median(v, axis=0)) > QUIET_M_S + 3 * np.linalg.norm(sigma):
                return False
    for channel in channels_of(log)[2:]:
        inside = (channel.t_ns >= start_ns) & (channel.t_ns <= end_ns)
        if channel.stream == "heading" and inside.sum() > 1:
            scatter = float(np.nan_to_num(noise_sigma(channel)).max())
            first, *_, last = np.array_split(channel.x[inside], min(4, int(inside.sum())))
            if np.abs(last.mean(axis=0) - first.mean(axis=0)).max() > TURNED_RAD + 4 * scatter / np.sqrt(len(first)):
                return False
    return True


def _steady(first: int, last: int, means: list[tuple[Array, float]]) -> list[tuple[int, int]]:
    """Cut a run of quiet windows where its means differ from those at its beginning: a steady turn is not rest."""
    cuts, begin = [], first
    for k in range(first + 1, last + 2):
        if k > last or any(np.abs(m[k] - m[begin:k].mean(axis=0)).max() > allowed for m, allowed in means):
            cuts.append((begin, k - 1))
            begin = k
    return cuts


def check_static(log: Log) -> Check:
    """Report the gyro's bias and |f| at rest."""
    found = rests(log)

    def draw(axes: Axes) -> None:
        t_s = seconds(log, log.imu.t_ns)
        for k, colour in enumerate(AXIS_COLOURS):
            w_deg = log.imu.w_WI_I[:, k] / DEGREE
            kept = thinned(w_deg)
            axes.plot(t_s[kept], w_deg[kept], lw=0.4, color=colour, label=f"gyro {'xyz'[k]}", rasterized=True)
        for k, rest in enumerate(found):
            label = "at rest" if k == 0 else None
            axes.axvspan(t_s[rest.first], t_s[rest.last], color="0.8", zorder=0, label=label)
        low, high = np.quantile(log.imu.w_WI_I / DEGREE, [0.001, 0.999])
        axes.set_ylim(low - 0.3 * (high - low) - 1e-3, high + 0.3 * (high - low) + 1e-3)
        axes.set(xlabel="time (s)", ylabel="gyro (°/s)")
        axes.legend(fontsize=6, ncols=2)

    if not found:
        return Check("at rest", {"stretches at rest": "none of five seconds or more"}, (), draw)
    rows = np.concatenate([np.arange(rest.first, rest.last + 1) for rest in found])
    w, f = log.imu.w_WI_I[rows], log.imu.f_I[rows]
    bias, size = w.mean(axis=0), float(np.linalg.norm(f.mean(axis=0)))
    total_s = len(rows) * log.imu.period_ns * 1e-9
    longest = max(found, key=lambda rest: rest.last - rest.first)
    facts = {
        "stretches at rest": f"{len(found)}, {total_s:.0f} s in all, the longest "
        f"{(longest.last - longest.first) * log.imu.period_ns * 1e-9:.0f} s from "
        f"{seconds(log, log.imu.t_ns[longest.first]):.0f} s",
        "gyro bias there": "({:.3g}, {:.3g}, {:.3g}) °/s".format(*bias / DEGREE),
        "|f| there": f"{size:.4f} m/s², gravity {log.rig.gravity:.4f}",
    }
    return Check("at rest", facts, tuple(_bias(log, bias, total_s)), draw)


def _bias(log: Log, bias: Array, total_s: float) -> list[Finding]:
    """Find a gyro that reads more at rest than its stated turn-on bias, the Earth's rate and its noise explain."""
    noise = log.rig.imu_noise
    largest = float(np.abs(bias).max())
    chance = noise.gyro_density / np.sqrt(total_s)
    if largest <= SIGMAS * np.hypot(noise.gyro_bias_sigma, chance) + EARTH_RATE_RAD_S:
        return []
    message = (
        "At rest the gyro reads ({:.4g}, {:.4g}, {:.4g}) rad/s".format(*bias)
        + f": {largest / max(noise.gyro_bias_sigma, 1e-12):.0f} times the stated turn-on bias "
        f"({noise.gyro_bias_sigma:.2g})."
    )
    hint = "or subtract it by streams.imu.gyro.offset, in the file's axes and unit, with the other sign"
    return [Finding("imu", message, f"streams.imu.noise.gyro_bias_sigma: {largest:.2g}", hint)]
