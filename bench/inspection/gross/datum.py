"""Where heights have their zero: a depth sensor's by fixes, which are heard at the surface; those of others by it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ....datasets.log import DepthStream, Log
from ....datasets.state import Array, TimeArray
from ..findings.advice import DEPTH_OFFSET
from ..findings.finding import Check, Finding
from ..findings.fitting import Index, Mask
from ..streams.channels import seconds, stated_sigma
from .sketch import SILENT_S, Sketch, sketch_of

ZERO_M = 1.5
"""Waves, an antenna awash, and lever arms that a log leaves out add up to less, where a vehicle floats."""
HIGHEST_M = 1.0
"""By so much a depth sensor may be higher than at the fixes, or change there: a wave, or a nose that is lifted."""
NOISES = 3.0
"""Stated sigmas of a reading besides."""
MAST_M = 1.0
"""Of an antenna this far above the depth sensor, or farther, the waterline is half a metre above the sensor."""
DIVED_M = 2.0
"""What is this far below the fixes is under water, where there are none."""
MOST, FEWEST = 300, 5
"""Readings used, and of how many at least; more do not change a median, and with fewer it says little."""
ATMOSPHERE_M = (9.6, 10.7)
"""Metres of salt or fresh water that weigh as much as the atmosphere, from 970 to 1045 hPa."""
ALTITUDE_M = 10.0
"""The slow errors of a receiver's height: twice those in the plane, which reach 5 m."""
CONSTANT = 0.25
"""Of an offset, its spread at most: more is a scale, a tide or a drift."""

NO_GPS = "unless these are fixes of a buoy, or of an acoustic system"
"""Both are heard while the vehicle is under water."""


class Heights(NamedTuple):
    """Heights of the depth sensor (m,), of the point asked for above it (m,), and the rows where both are known."""

    z: Array
    above: Array
    rows: Index


def in_the_air_m(log: Log) -> float:
    """Return how high a depth sensor gets, m, if that is above the sea surface by more than waves explain; else 0."""
    if log.depth is None or len(log.depth) < FEWEST:
        return 0.0
    highest = float(np.partition(log.depth.z[:, 0], -FEWEST)[-FEWEST])
    return highest if highest > ZERO_M + noise_m(log.depth) else 0.0


def surface_findings(sketch: Sketch) -> list[Finding]:
    """Find a depth sensor whose zero is off: by fixes, which are heard at the surface only, or since it is in the air.

    At the fixes its reading must be constant, and the highest of all: a buoy's or an acoustic system's fixes, or those
    of another clock, are heard at any depth.
    """
    log, at = sketch.log, _at_fixes(sketch)
    if log.depth is None or at is None:
        return []
    noise = noise_m(log.depth)
    line = at.z + np.clip(at.above, 0.0, MAST_M) / 2
    least, zero, most = _quantiles(line)
    highest = float(log.depth.z.max()) - float(np.median(at.z))
    if abs(zero) < ZERO_M + noise or most - least > HIGHEST_M + 2 * noise or highest > HIGHEST_M + 2 * noise:
        return []
    where = f"{abs(zero):.2f} m {'above' if zero > 0 else 'below'} the sea surface"
    message = (
        f"The depth sensor puts the waterline {where} where the GPS has fixes, which are heard afloat (median of "
        f"{len(line)}, {least - zero:+.2f} to {most - zero:+.2f} m about it): its zero is off."
    )
    atmosphere = -ATMOSPHERE_M[1] < zero < -ATMOSPHERE_M[0]
    message += " That is the pressure of the atmosphere." if atmosphere else ""
    sure = zero > 0 or atmosphere or _dives(sketch, float(np.median(at.z)))
    return [Finding("depth", message, DEPTH_OFFSET.format(zero, -zero), "" if sure else NO_GPS)]


def height_findings(sketch: Sketch) -> list[Finding]:
    """Find heights of GPS and truth that are off those of the depth sensor by a constant."""
    off_m = _by_truth(sketch)
    return gps_height_findings(sketch) + ([] if off_m is None else [zero_finding(sketch.log, off_m)])


def gps_height_findings(sketch: Sketch) -> list[Finding]:
    """Find heights of fixes that are far from the antenna's by the depth sensor."""
    log, at = sketch.log, _at_fixes(sketch)
    if log.gps is None or at is None:
        return []
    known = np.isfinite(log.gps.sigma[at.rows, 2])
    if np.count_nonzero(known) < FEWEST:
        return []
    sigma, off = log.gps.sigma[at.rows, 2][known], (log.gps.z[at.rows, 2] - at.z - at.above)[known]
    up_m = float(np.median(off))
    if abs(up_m) < max(ALTITUDE_M, NOISES * float(np.median(sigma))):
        return []
    message = (
        f"GPS heights are {up_m:+.1f} m (median) against those of the depth sensor: they are above the ellipsoid, "
    )
    message += "or a lake's are above the sea, and not above the water."
    return [Finding("gps", message, f"streams.gps: raise {-up_m:.2f}")]


def gps_height_check(log: Log) -> Check:
    """Return the same as a check of its own."""
    sketch = sketch_of(log)
    return Check("heights of GPS and depth sensor", {}, () if sketch is None else tuple(gps_height_findings(sketch)))


def zero_finding(log: Log, off_m: float) -> Finding:
    """Return what is wrong where the depth sensor's height is off_m above the truth's throughout.

    Args:
        log: with a depth sensor and a truth.
        off_m: m.
    """
    assert log.depth is not None
    assert log.truth is not None
    z, height, whose = log.depth.z[:, 0], log.truth.p_WB_W[:, 2], log.truth_kind
    noise = noise_m(log.depth)
    message = f"The {whose}'s height is {-off_m:+.2f} m (median) against the depth sensor's throughout"
    raised, moved = f"truth: raise {off_m:.3f}", DEPTH_OFFSET.format(off_m, -off_m)
    if in_the_air_m(log):
        return Finding("depth", f"{message}, which rises above the sea surface: its zero is off.", moved)
    if -ATMOSPHERE_M[1] < off_m < -ATMOSPHERE_M[0]:
        return Finding("depth", f"{message}: the pressure of the atmosphere is in its depths.", moved)
    if abs(float(z.max())) < ZERO_M + noise:
        return Finding(
            "truth", f"{message}, which is at the surface at its highest: the {whose}'s zero is off.", raised
        )
    if float(np.median(height)) > ZERO_M:
        return Finding("truth", f"{message}, and above the sea surface: the {whose}'s zero is off.", raised)
    if log.truth_kind == "reference":
        return Finding("truth", f"{message}: its zero is off, as that of a filter's height often is.", raised)
    hint = f"move the one that is wrong: streams.depth.depth.offset by {off_m:.3f} m of depth, or the truth's height"
    return Finding("truth", f"{message}: the zero of either may be off, and nothing tells which.", hint=hint)


def _at_fixes(sketch: Sketch) -> Heights | None:
    """Return heights at the fixes, above: of the antenna; None with too few."""
    gps = sketch.log.gps
    if gps is None:
        return None
    rows = np.flatnonzero(np.isfinite(gps.sigma[:, :2]).all(axis=1))
    arm = np.asarray(sketch.log.rig.gps.p_BS_B) - np.asarray(sketch.log.rig.depth.p_BS_B)
    return _heights(sketch, gps.t_ns, rows, arm)


def _by_truth(sketch: Sketch) -> float | None:
    """Return how far the depth sensor is above the truth's heights, m, where that is constant and large; else None."""
    log = sketch.log
    if log.truth is None or log.depth is None:
        return None
    at = _heights(sketch, log.truth.t_ns, np.arange(len(log.truth)), -np.asarray(log.rig.depth.p_BS_B))
    if at is None:
        return None
    off = at.z + at.above - log.truth.p_WB_W[at.rows, 2]
    least, middle, most = _quantiles(off[np.isfinite(off)])
    limit = ZERO_M + noise_m(log.depth)
    return middle if abs(middle) > limit and most - least < CONSTANT * abs(middle) else None


def noise_m(depth: DepthStream) -> float:
    """Return what noise explains of a difference of heights, m."""
    return NOISES * float(stated_sigma(depth)[0])


def _quantiles(x: Array) -> tuple[float, float, float]:
    """Return the tenth, the middle and the ninetieth percentile of x (m,); NaN of none."""
    if not len(x):
        return np.nan, np.nan, np.nan
    x = np.sort(x)
    return float(x[len(x) // 10]), float(x[len(x) // 2]), float(x[len(x) * 9 // 10])


def _heights(sketch: Sketch, t_ns: TimeArray, rows: Index, arm_B: Array) -> Heights | None:
    """Return heights at some rows of t_ns, between readings of depth; above: of a point at arm_B from the sensor."""
    depth = sketch.log.depth
    if depth is None or len(depth) < FEWEST or len(rows) < FEWEST:
        return None
    rows = rows[:: max(len(rows) // MOST, 1)]
    after = np.searchsorted(depth.t_ns, t_ns[rows]).clip(1, len(depth.t_ns) - 1)
    before_ns, after_ns, now_ns = depth.t_ns[after - 1], depth.t_ns[after], t_ns[rows]
    inside: Mask = (before_ns <= now_ns) & (now_ns <= after_ns) & (after_ns - before_ns < SILENT_S * 1e9)
    rows, after, now_ns = rows[inside], after[inside], now_ns[inside]
    if len(rows) < FEWEST:
        return None
    share = (now_ns - depth.t_ns[after - 1]) / (depth.t_ns[after] - depth.t_ns[after - 1])
    z = (1 - share) * depth.z[after - 1, 0] + share * depth.z[after, 0]
    cell = np.searchsorted(sketch.t_s, seconds(sketch.log, now_ns)).clip(0, len(sketch.t_s) - 1)
    return Heights(z, sketch.up_B[cell] @ arm_B, rows)


def _dives(sketch: Sketch, z_m: float) -> bool:
    """Whether the vehicle is ever well below z_m, and has no fix for a while then."""
    log = sketch.log
    assert log.depth is not None
    assert log.gps is not None
    z = sketch.on_grid(seconds(log, log.depth.t_ns), log.depth.z[:, 0])
    return bool((~sketch.heard(seconds(log, log.gps.t_ns)) & (z < z_m - DIVED_M)).any())
