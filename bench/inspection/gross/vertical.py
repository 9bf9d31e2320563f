"""Height: the depth sensor, the DVL's climb, and the truth; signs, units and clocks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ....datasets.described.description import Height
from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.advice import DEPTH_OFFSET, clock_fix, late_or_early
from ..findings.finding import Finding
from ..findings.fitting import Mask
from ..streams.channels import seconds
from .datum import in_the_air_m, noise_m
from .shifts import Shift, shift_of
from .sketch import Sketch

STEP_S = 10.0
"""Changes of height over this are compared: a climb stands out of a depth sensor's noise."""
CLIMBS_M = 0.3
"""Least standard deviation of these changes: swell and trim move a vehicle at the surface by less."""
ALIKE = 0.9
"""Least correlation for a slope to be read off."""
IN_THE_AIR_M = 1.5
"""A depth sensor whose median is higher above the sea surface is on no vehicle that has one."""
SCALE_MATTERS = 0.15
"""Relative: density and speed of sound explain a few percent."""
PRESSURES = {"bar": 10.0, "kPa": 0.1, "mbar": 0.01, "Pa": 1e-4, "psi": 0.69}
"""Metres of water under one unit, within 3 %."""


class Slope(NamedTuple):
    """How a height changes by another's change: the factor, the correlation, and the lag of the rates."""

    value: float
    correlation: float
    shift: Shift


def _heights(sketch: Sketch) -> dict[str, tuple[Array, Mask]]:
    """Return the heights that there are on the grid (n,), m, and where each is heard (n,): dvl, depth, truth."""
    log, found = sketch.log, {}
    if log.depth is not None and len(log.depth) >= 30:
        t_s, z = seconds(log, log.depth.t_ns), log.depth.z[:, 0]
        fresh = np.diff(z, prepend=np.nan) != 0  # a stuck piece is then a gap
        fresh = fresh if np.count_nonzero(fresh) >= 30 else np.full(len(z), True)
        found["depth"] = sketch.on_grid(t_s[fresh], z[fresh]), sketch.heard(t_s[fresh])
    motion = sketch.velocity
    if motion is not None and log.dvl is not None and np.isfinite(log.dvl.sigma).any(axis=0).all():
        climb = sketch.level_velocity(motion[0])[1]
        moved = np.cumsum((climb[1:] + climb[:-1]) / 2 * np.diff(sketch.t_s))
        found["dvl"] = np.concatenate([[0.0], moved]), motion[1]
    if log.truth is not None and len(log.truth) >= 30:
        t_s = seconds(log, log.truth.t_ns)
        found["truth"] = sketch.on_grid(t_s, log.truth.p_WB_W[:, 2]), sketch.heard(t_s)
    return found


def _slope(sketch: Sketch, one: tuple[Array, Mask], other: tuple[Array, Mask]) -> Slope | None:
    """Return how `one` changes by `other`; None if they share too little, or hardly climb."""
    lag = max(round(STEP_S / sketch.step_s), 1)
    heard = one[1] & other[1]
    rows = np.flatnonzero(heard[lag:] & heard[:-lag])
    if len(rows) < 20:
        return None
    y, x = (z[rows + lag] - z[rows] for z in (one[0], other[0]))
    y, x = y - y.mean(), x - x.mean()
    if min(x.std(), y.std()) == 0 or x.std() < CLIMBS_M:
        return None
    value, c = float(x @ y / (x @ x)), float(x @ y / np.sqrt((x @ x) * (y @ y)))
    shift = Shift(0.0, c, c)
    if abs(c) < 0.98:
        rates = [np.where(h[:-lag] & h[lag:], z[lag:] - z[:-lag], 0.0) for z, h in (one, other)]
        shift = shift_of(rates[0], rates[1], sketch.step_s)
        over = shift_of(-rates[0], rates[1], sketch.step_s)
        shift = over if over.peak > shift.peak + 0.1 else shift
    return Slope(value, c, shift)


def vertical_findings(sketch: Sketch, suspects: set[str], vouched: set[str], zero_off: bool = False) -> list[Finding]:
    """Compare every height with every other, and say which one is turned over, scaled or late.

    Args:
        suspects: streams that are known to be wrong, and are left out.
        vouched: streams that are known to be right.
        zero_off: whether the zero of the depth sensor is known to be off: it is then no wonder that it is in the air.
    """
    heights, log = {name: z for name, z in _heights(sketch).items() if name not in suspects}, sketch.log
    pairs = {
        (a, b): slope
        for a, b in (("depth", "dvl"), ("depth", "truth"), ("truth", "dvl"))
        if a in heights and b in heights and (slope := _slope(sketch, heights[a], heights[b])) is not None
    }
    wrong = {pair for pair, slope in pairs.items() if _is_wrong(slope)}
    right = {pair for pair, slope in pairs.items() if abs(slope.correlation) > ALIKE} - wrong
    above = "depth" in heights and _in_the_air(log) and not zero_off
    turned = any(
        pairs[pair].value < 0 and abs(pairs[pair].correlation) > ALIKE for pair in wrong
    )  # of which a path in the plane knows nothing
    vouched = {name for pair in right for name in pair} | (set() if turned else vouched)
    culprits = {name for pair in wrong for name in pair} - vouched
    if right == {("depth", "dvl")} and not zero_off and in_the_air_m(log):
        return [_too_high(log)]
    if above and "depth" not in vouched:
        culprits = {"depth"}
    elif "depth" in culprits and len(culprits) > 1 and log.depth is not None:
        sunk = float(np.median(log.depth.z)) < -IN_THE_AIR_M
        culprits -= {"depth"} if sunk and turned else set()
    if len(culprits) != 1:
        return [_unsure(log, pairs, wrong)] if wrong else []
    (name,) = culprits
    of = [(pairs[p], p) for p in sorted(wrong) if name in p]
    if not of:
        return [_turned(log, "depth", f"reads {np.median(log.depth.z):.3g} m above the surface")] if log.depth else []
    slope, pair = of[0]
    other = pair[1] if pair[0] == name else pair[0]
    return [_finding(log, name, other, slope if pair[0] == name else _inverse(slope))]


def climb_scale(sketch: Sketch) -> float | None:
    """Return by what the DVL's climb must be scaled to be the depth sensor's; None where that does not show."""
    heights = _heights(sketch)
    if not {"depth", "dvl"} <= heights.keys():
        return None
    slope = _slope(sketch, heights["depth"], heights["dvl"])
    return slope.value if slope is not None and abs(slope.correlation) > ALIKE else None


def _in_the_air(log: Log) -> bool:
    assert log.depth is not None
    return float(np.median(log.depth.z)) > IN_THE_AIR_M + noise_m(log.depth)


def _inverse(slope: Slope) -> Slope:
    value = slope.correlation**2 / slope.value if slope.value else 0.0
    return Slope(value, slope.correlation, slope.shift._replace(late_s=-slope.shift.late_s))


def _is_wrong(slope: Slope) -> bool:
    scaled = abs(slope.correlation) > ALIKE and abs(slope.value - 1) > SCALE_MATTERS
    return scaled or slope.shift.matters


def _words(log: Log, name: str) -> str:
    return {"depth": "depth sensor", "dvl": "DVL", "truth": log.truth_kind}[name]


def _unsure(log: Log, pairs: dict[tuple[str, str], Slope], wrong: set[tuple[str, str]]) -> Finding:
    a, b = sorted(wrong)[0]
    late, slope = pairs[a, b].shift, pairs[a, b].value
    how = f"{late.late_s:+.1f} s later than" if late.matters else f"{slope:.3g} times as far as"
    return Finding(a, f"The height by the {_words(log, a)} changes {how} that by the {_words(log, b)}.")


def _turned(log: Log, name: str, how: str) -> Finding:
    fixes = {
        "depth": "streams.depth.positive: up  # or down, whichever it is not",
        "dvl": "streams.dvl.axes: FRD  # or FLU, whichever it is not",
        "truth": "",
    }
    return Finding(name, f"The {_words(log, name)} {how}: up and down are exchanged.", fixes[name])


def _too_high(log: Log) -> Finding:
    """Return what is wrong with a depth sensor that climbs rightly, in the air."""
    z_m = in_the_air_m(log)
    message = (
        f"The depth sensor climbs as the others do, and reads up to {z_m:.2f} m above the surface: its zero is off"
    )
    return Finding("depth", message + ", by at least so much.", DEPTH_OFFSET.format(z_m, -z_m))


def _finding(log: Log, name: str, other: str, slope: Slope) -> Finding:
    """Return what is wrong with a height that another one contradicts."""
    shift, who = slope.shift, f"The height by the {_words(log, name)}"
    if shift.matters:
        late = f"{abs(shift.late_s):.1f} s {late_or_early(shift.late_s)}"
        message = f"{who} changes {late} by that of the {_words(log, other)}."
        return Finding(name, message, clock_fix(name, shift.late_s))
    if abs(slope.value + 1) < 2 * SCALE_MATTERS:
        return _turned(log, name, f"climbs where the {_words(log, other)} sinks (slope {slope.value:.2f})")
    message = f"{who} changes {slope.value:.3g} times as far as by the {_words(log, other)}."
    if name != "depth":
        return Finding(name, message)
    size = abs(slope.value)
    said = [unit for unit, m in PRESSURES.items() if abs(size * m - 1) < 0.1]
    units = [u for u, m in Height.units.items() if m != 1 and (abs(size * m - 1) < 0.1 or abs(size / m - 1) < 0.1)]
    if said or units:
        message += f" That is the ratio of {(said or units)[0]} and m."
    return Finding(name, message, f"streams.depth.depth.scale: {1 / slope.value:.4g}")
