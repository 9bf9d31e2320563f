"""Outliers: readings far from their neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ....datasets.log import Log
from ....datasets.state import TimeArray
from ..findings.finding import Check, Finding
from ..findings.panels import AXIS_COLOURS, thinned
from .channels import Channel, channels_of, seconds
from .missing import missing_rows, readings_of
from .neighbours import FAR, outliers, residuals, robust_sigma, rounding_sigma

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes

WEIGHTY = 0.1
"""Of the stated variance, summed over all readings: outliers that add less do not change an estimate."""
CLEARLY = 0.5
"""Share of the outliers that a bound on the size must catch to be proposed."""
SPARED = 0.999
"""Share of the good readings that such a bound must leave in."""


Marked = tuple[Channel, NDArray[np.bool_], TimeArray]
"""The readings of a channel, which of them are outliers, and when there was a row without a reading."""


def check_outliers(log: Log) -> Check:
    """Count the outliers of every channel."""
    facts, findings, found = {}, [], {}
    for whole in channels_of(log):
        channel = readings_of(whole)
        out = outliers(channel)
        found[channel.name] = (channel, out, whole.t_ns[~missing_rows(whole).readings])
        count = int(out.sum())
        facts[channel.name] = f"{count} of {len(out)} ({count / len(out):.2%})"
        if _added(channel, out) > WEIGHTY:
            findings.append(outlier_finding(channel, out))
    return Check("outliers", facts, tuple(findings), _panel(log, found))


def _added(channel: Channel, out: NDArray[np.bool_]) -> float:
    """Return the variance that the outliers add to the sum of the readings, over the stated variance of all."""
    if not out.any():
        return 0.0
    added = np.sum(residuals(channel)[out] ** 2, axis=0) / len(out)
    return float(np.max(added / channel.sigma**2))


def outlier_finding(channel: Channel, out: NDArray[np.bool_]) -> Finding:
    """Report the outliers of a channel, which are the rows `out` (n,)."""
    off = residuals(channel)
    spread = np.maximum(robust_sigma(off), rounding_sigma(channel))
    worst = np.abs(off[out]).max(axis=0)
    k = int(np.nanargmax(worst / np.where(np.isfinite(channel.sigma) & (spread > 0), spread, np.nan)))
    message = (
        f"{int(out.sum())} of {len(out)} {channel.name} readings ({out.mean():.2%}) stand out of their neighbours by "
        f"more than {FAR:g} times the usual spread; the farthest by {channel.text(float(worst[k]))}, where the spread "
        f"is {channel.text(float(spread[k]))}."
    )
    size = np.linalg.norm(channel.raw[:, np.isfinite(channel.sigma)], axis=1)
    above = float(f"{1.1 * np.quantile(size[~out], SPARED):.2g}")
    caught = float(np.mean(size[out] > above))
    if channel.stream != "imu" and caught >= CLEARLY:
        fix = f"streams.{channel.stream}.outliers.above: {above:g}  # drops {caught:.0%} of them"
        return Finding(channel.stream, message, fix)
    return Finding(
        channel.stream, message + " No bound on their size separates them from the rest: an estimator has to gate them."
    )


def _panel(log: Log, found: dict[str, Marked]) -> Callable[[Axes], None] | None:
    """Return a panel of the velocity if there is a DVL; else of the stream with most outliers, if any has one."""
    if "dvl" in found:
        channel, out, missing_ns = found["dvl"]
    else:
        channel, out, missing_ns = max(found.values(), key=lambda marked: marked[1].mean())
        if not out.any():
            return None

    def draw(axes: Axes) -> None:
        t_s = seconds(log, channel.t_ns)
        for k, colour in zip(range(channel.x.shape[1]), AXIS_COLOURS, strict=False):
            kept, x = thinned(channel.x[:, k]), channel.x[:, k] * channel.shown
            axes.plot(t_s[kept], x[kept], lw=0.6, color=colour, label=channel.of_axis(k))
        if out.any():
            x = channel.x[out] * channel.shown
            label = "outliers"
            for k in range(x.shape[1]):
                axes.plot(t_s[out], x[:, k], "x", ms=3, color="black", label=label)
                label = None
            low, high = np.quantile(channel.x[~out] * channel.shown, [0.001, 0.999])
            room = max(high - low, 1e-9)
            far_low, far_high = max(x.min(), low - room), min(x.max(), high + room)
            axes.set_ylim(min(low, far_low) - 0.2 * room, max(high, far_high) + 0.2 * room)
        if len(missing_ns):
            at = {"transform": axes.get_xaxis_transform(), "color": "black", "ms": 8}
            axes.plot(seconds(log, missing_ns), np.full(len(missing_ns), 0.02), "|", label="no reading", **at)
        axes.set(xlabel="time (s)", ylabel=f"{channel.name} ({channel.unit})")
        axes.legend(fontsize=6, ncols=2)

    return draw
