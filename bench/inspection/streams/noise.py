"""The noise of the aiding sensors, estimated from their values, against the stated sigma."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ....datasets.log import Log
from ....datasets.state import Array
from ...drawing import logarithmic
from ..findings.finding import Check, Finding
from ..findings.panels import colour_of
from .channels import Channel, channels_of, seconds
from .missing import readings_of
from .neighbours import noise_sigma, residuals, rounding_sigma, spread_by_block, stretches

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OFF = 3.0
"""Ratio of stated and found sigma that makes a finding: a factor of nine in the weight of a reading."""

UNSURE = 1.65
"""Relative error of a robust sigma of n residuals, times √n: 1.17, times √2 because neighbours share readings."""
MOVING = 2.0
"""Ratio of the scatter of every second reading to that of all; above it the scatter contains motion, which grows up to
16 times."""
NOISIER, NOISY_SHARE, FEWEST_BLOCKS = 2.0, 0.05, 10
"""Ratio to the usual sigma, least share of the log, and least number of blocks. A robust sigma of a hundred residuals
is known to 12 %, so twice the usual is eight of its own sigmas away."""


def check_noise(log: Log) -> Check:
    """Compare every aiding sensor's scatter against its neighbours with its stated sigma."""
    facts, findings, ratios = {}, [], []
    for channel in map(readings_of, channels_of(log)[2:]):
        sigma, stated = noise_sigma(channel), channel.sigma
        if not np.isfinite(sigma).any():
            facts[channel.name] = "too few readings in a row"
            continue
        measured = np.isfinite(stated)
        rounding = rounding_sigma(channel)
        floor = np.maximum(sigma, rounding)
        moving = _every_second(channel) > MOVING * sigma
        alive = measured & (np.ptp(channel.x, axis=0) > 0)
        facts[channel.name] = "; ".join(
            f"{channel.of_axis(k)} {floor[k] * channel.shown:.2g}, stated {channel.text(float(stated[k]))}"
            + (" (motion is in it)" if moving[k] else "")
            for k in np.flatnonzero(measured).tolist()
        )
        ratio = np.divide(floor, stated, out=np.full(len(stated), np.nan), where=alive)
        ratios += [(channel, k, float(ratio[k])) for k in np.flatnonzero(alive).tolist() if ratio[k] > 0]
        findings += _off(
            channel, floor, np.where((moving | (rounding > sigma)) & (ratio > 1), np.nan, ratio)
        ) + _changing(log, channel, measured, rounding)

    def draw(axes: Axes) -> None:
        names = [channel.of_axis(k) for channel, k, _ in ratios]
        for row, (channel, _, ratio) in enumerate(ratios):
            axes.plot(ratio, row, "o", ms=5, color=colour_of(channel.stream))
        axes.axvspan(1 / OFF, OFF, color="0.9", zorder=0)
        axes.axvline(1, color="black", lw=0.8)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(min(low, 0.2), max(high, 5))
        logarithmic(axes, "x")
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.set_xlabel("scatter from reading to reading / stated sigma")

    return Check("noise of the aiding sensors", facts, tuple(findings), draw if ratios else None)


def _every_second(channel: Channel) -> Array:
    """Return the scatter (k,) of every second reading: the same for white noise, much larger for motion."""
    return noise_sigma(channel.rows(np.arange(len(channel.x)) % 2 == 0))


def _changing(log: Log, channel: Channel, measured: NDArray[np.bool_], rounding: Array) -> list[Finding]:
    """Find a sensor that is much noisier than usual for part of the log."""
    edges, spread = spread_by_block(residuals(channel))
    spread = np.maximum(spread, rounding)[:, measured]
    usual = np.median(spread[np.isfinite(spread).all(axis=1)], axis=0)
    if np.isfinite(spread).all(axis=1).sum() < FEWEST_BLOCKS or not (usual > 0).all():
        return []
    times = np.nan_to_num(np.sqrt(np.mean((spread / usual) ** 2, axis=1)))
    noisy = times > NOISIER
    if noisy.mean() < NOISY_SHARE:
        return []
    first, last = max(stretches(noisy), key=lambda stretch: stretch[1] - stretch[0])
    rows = int(edges[first]), int(edges[last + 1]) - 1
    begin_s, end_s = seconds(log, channel.t_ns[list(rows)])
    message = (
        f"{channel.name} is {np.median(times[noisy]):.1f} times as noisy as usual in {noisy.mean():.0%} of the log, "
        f"longest from {begin_s:.0f} to {end_s:.0f} s: no single sigma is right for all of it."
    )
    path = f"streams.{channel.stream}"
    hint = f"{path}.sigma (columns, row by row), or {path}.outliers.above"
    return [Finding(channel.stream, message, hint=hint)]


def _off(channel: Channel, found: Array, ratio: Array) -> list[Finding]:
    """Return the finding about the axis whose ratio is farthest from 1."""
    with np.errstate(divide="ignore"):
        off = np.where(np.isfinite(ratio) & (ratio > 0), np.abs(np.log(ratio)), 0.0)
    k = int(np.argmax(off))
    count = int(np.isfinite(residuals(channel)).all(axis=1).sum())
    if off[k] <= np.log(OFF) + 2 * UNSURE / np.sqrt(count):
        return []
    large = ratio[k] > 1
    how = f"{ratio[k]:.1f} times" if large else f"1/{1 / ratio[k]:.3g} of"
    message = (
        f"{channel.of_axis(k)} scatters from reading to reading by {channel.text(float(found[k]))}, {how} the stated "
        f"sigma ({channel.text(float(channel.sigma[k]))})."
    )
    values = [f"{found[j] * channel.shown:.2g}" if np.isfinite(channel.sigma[j]) else ".inf" for j in range(len(found))]
    fix = f"{channel.sigma_key}: " + (values[0] if len(values) == 1 else f"[{', '.join(values)}]")
    if not large:
        message += " The stated one is right only if most of the error is slow, which this check cannot see."
    return [Finding(channel.stream, message, fix, "" if large else "only if its errors are white")]
