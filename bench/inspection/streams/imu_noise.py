"""The IMU's noise against the stated one: by Allan deviation at rest, else from sample to sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.finding import Check, Finding
from ..findings.panels import AXIS_COLOURS
from .allan import AllanCurve, allan_deviation, bias_instability, white_density
from .channels import Channel, channels_of
from .neighbours import noise_sigma
from .static import Rest, rests

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes

SHORTEST_REST_S = 30.0
"""A curve to τ = 3 s, past the second at which the density is read."""
OFF = 3.0
"""Ratio of stated and found noise that makes a finding: nine times the variance."""
FILTERED_SAMPLES = 4
"""Neighbouring samples that the sensor's own filter may correlate: usual are two to four."""
UNIT = {"gyro": "rad/s/√Hz", "accel": "m/s²/√Hz"}


def check_imu_noise(log: Log) -> Check:
    """Compare the stated white densities with those of the longest time at rest, else with the scatter in motion."""
    gyro, accel = channels_of(log)[:2]
    found = rests(log)
    longest = max(found, key=lambda rest: rest.last - rest.first) if found else None
    rest_s = 0.0 if longest is None else (longest.last - longest.first) * log.imu.period_ns * 1e-9
    facts, findings, curves = {}, [], {}
    for channel, stated in ((gyro, log.rig.imu_noise.gyro_density), (accel, log.rig.imu_noise.accel_density)):
        if longest is not None and rest_s >= SHORTEST_REST_S:
            curve = _curve(channel, longest)
            densities, unstable = white_density(curve), bias_instability(curve)
            facts[channel.name] = (
                f"{_listed(densities)} {UNIT[channel.name]} at rest ({rest_s:.0f} s), stated {stated:.3g}; "
                f"bias instability below {_listed(unstable)} {channel.unit}"
            )
            findings += _at_rest(channel, densities, stated)
        else:
            curve = _curve(channel, Rest(0, len(channel.x) - 1))
            densities = noise_sigma(channel) * np.sqrt(channel.period_s)
            bound = _bound(curve, channel.period_s)
            facts[channel.name] = (
                f"{_listed(densities)} {UNIT[channel.name]} from sample to sample, at most {_listed(bound)} by its "
                f"Allan deviation, in motion (no {SHORTEST_REST_S:g} s at rest); stated {stated:.3g}"
            )
            findings += _under_way(channel, densities, bound, stated)
        curves[channel.name] = (curve, stated)
    where = "at rest" if rest_s >= SHORTEST_REST_S else "in motion, which it includes"
    return Check("noise of the IMU", facts, tuple(findings), _panel(curves, where))


def _curve(channel: Channel, rest: Rest) -> AllanCurve:
    return allan_deviation(channel.x[rest.first : rest.last + 1], channel.period_s)


def _listed(values: Array) -> str:
    return f"({', '.join(f'{v:.2g}' for v in values)})"


def _at_rest(channel: Channel, densities: Array, stated: float) -> list[Finding]:
    largest = float(densities.max())
    if not np.isfinite(largest) or largest == 0 or stated / OFF <= largest <= stated * OFF:
        return []
    message = (
        f"At rest the {channel.name}'s white noise is {largest:.2g} {UNIT[channel.name]} on its worst axis, "
        f"{_beside(largest, stated)}."
    )
    return [Finding("imu", message, f"streams.imu.noise.{channel.name}_density: {largest:.2g}")]


def _beside(found: float, stated: float) -> str:
    if stated == 0:
        return "where none is stated"
    how = f"{found / stated:.1f} times" if found > stated else f"1/{stated / found:.3g} of"
    return f"{how} the stated one ({stated:.2g})"


def _bound(curve: AllanCurve, period_s: float) -> Array:
    """Return (k,) an upper bound on the white density: the least σ √τ within a second, since motion only adds.

    The first few samples are left out, because a sensor's own filter correlates neighbours.
    """
    inside = (curve.tau_s > FILTERED_SAMPLES * period_s) & (curve.tau_s <= max(1.0, 2 * FILTERED_SAMPLES * period_s))
    if not inside.any():
        return np.full(curve.deviation.shape[1], np.nan)
    return (curve.deviation * np.sqrt(curve.tau_s)[:, None])[inside].min(axis=0)


def _under_way(channel: Channel, densities: Array, bound: Array, stated: float) -> list[Finding]:
    largest, most, unit = float(densities.max()), float(bound.max()), UNIT[channel.name]
    if largest > OFF * stated:
        message = (
            f"From sample to sample the {channel.name} scatters like white noise of {largest:.2g} {unit}, "
            f"{_beside(largest, stated)}: noise, or vibration that a filter must treat as noise."
        )
        return [Finding("imu", message, f"streams.imu.noise.{channel.name}_density: {largest:.2g}")]
    if 0 < max(most, largest) < stated / OFF:
        most = most or largest
        message = (
            f"Even with all motion in it, the {channel.name} varies no more than white noise of {most:.2g} {unit}, "
            f"{_beside(most, stated)}."
        )
        fix = f"streams.imu.noise.{channel.name}_density: {most:.2g}"
        return [Finding("imu", message, fix, "unless it was inflated on purpose")]
    return []


def _panel(curves: dict[str, tuple[AllanCurve, float]], where: str) -> Callable[[Axes], None]:
    def draw(axes: Axes) -> None:
        for (name, (curve, stated)), dash in zip(curves.items(), ("-", "--"), strict=True):
            for k, colour in enumerate(AXIS_COLOURS):
                axes.loglog(curve.tau_s, curve.deviation[:, k], ls=dash, lw=1, color=colour, label=f"{name} {'xyz'[k]}")
            axes.loglog(
                curve.tau_s, stated / np.sqrt(curve.tau_s), ls=dash, lw=0.8, color="black", label=f"{name}, stated"
            )
        axes.set(xlabel=f"τ (s), {where}", ylabel="Allan deviation (rad/s, m/s²)")
        axes.legend(fontsize=5, ncols=2)

    return draw
