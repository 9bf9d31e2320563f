"""The DVL against positions: scale and direction of its path, compared with GPS or truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ....datasets.log import Log
from ....datasets.quantities import DEGREE
from ..findings.finding import Check, Finding
from .inertial import Inertial
from .pair_check import Delay, PairCheck
from .path_fit import PathFit, Positions, fit_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCALE_MATTERS = 0.01
"""Relative: what a low-cost DVL is specified to (Water Linked A50: 1.01 % long-term)."""
TURN_MATTERS = 1.0 * DEGREE
"""rad: 1.7 % of the distance travelled, across the track; a magnetic compass is good to 1 to 2°."""


def dvl_against_positions(log: Log, imu: Inertial, where: Positions) -> PairCheck | None:
    """Compare length and direction of the DVL's path with those of the positions."""
    by = "gyro" if log.heading is None else "heading"
    found = fit_path(log, imu, where, by)
    if found is None:
        return None
    whose = where.whose
    moved = found.scale.known_to(0.3 * max(abs(found.scale.value), 0.1))
    facts = {"turned by": by, "scale that the DVL needs": found.scale.text_if(0.3)}
    facts["rms residual of the path"] = f"{found.rms_m:.2g} m per axis, within a twelfth of the log"
    findings: list[Finding] = []
    if found.mirrored:
        message = (
            f"The DVL's path fits the {whose}'s only if mirrored: north and east are exchanged, or the heading "
            "turns the wrong way (a compass read as a yaw)."
        )
        part = "streams.gps" if whose == "GPS" else "truth"
        message += f" Or `{part}.frame` is wrong."
        findings.append(
            Finding("heading", message, "streams.heading.convention: yaw  # or compass, whichever it is not")
        )
    elif moved:
        facts[f"turn of the DVL's path onto the {whose}'s"] = (
            found.turn.times(1 / DEGREE).text("°") if by == "heading" else "free: no heading sensor"
        )
        facts["DVL later than the yaw by"] = found.dvl_delay.text_if(0.5, "s")
        facts[f"{whose} later than the yaw by"] = found.delay.text_if(0.5, "s")
        if found.bias is not None:
            facts["gyro bias about the vertical"] = found.bias.text("rad/s")
        findings += _scale_findings(found, whose)
        findings += _turn_findings(log, found, whose) if by == "heading" else []
    delays = []
    if moved and not found.mirrored:
        yaw = "heading" if by == "heading" else "imu"
        delays.append(Delay("dvl", yaw, found.dvl_delay))
        delays.append(Delay("gps" if whose == "GPS" else "truth position", yaw, found.delay))

    def draw(axes: Axes) -> None:
        left = found.p - found.x
        axes.plot(found.t_s, left.real, ".", markersize=2, label="east")
        axes.plot(found.t_s, left.imag, ".", markersize=2, label="north")
        axes.legend(fontsize=7)
        axes.set(xlabel="time (s)", ylabel=f"{whose} less DVL's path (m)", title=f"DVL against {whose}")

    kept = tuple(delay for delay in delays if delay.by.known_to(0.5))
    return PairCheck(Check(f"DVL against the positions of the {whose}", facts, tuple(findings), draw), kept)


def _scale_findings(found: PathFit, whose: str) -> list[Finding]:
    if not found.scale.differs(1.0, SCALE_MATTERS):
        return []
    scale = found.scale.value
    units = {"cm/s": 0.01, "mm/s": 0.001, "m/s": 100.0, "kn": 1852 / 3600, "km/h": 1 / 3.6}
    near = [unit for unit, ratio in units.items() if abs(scale / ratio - 1) < 0.1 and abs(scale - 1) > 0.3]
    guess = f" That is the ratio of {near[0]} to what is stated." if near else ""
    return [
        Finding(
            "dvl",
            f"The DVL's path must be scaled by {found.scale.text()} to be as long as the {whose}'s.{guess}",
            f"streams.dvl.velocity.unit: {near[0]}" if near else f"streams.dvl.velocity.scale: {scale:.4g}",
        )
    ]


def _turn_findings(log: Log, found: PathFit, whose: str) -> list[Finding]:
    if not found.turn.differs(0.0, TURN_MATTERS):
        return []
    attitude = log.truth is not None and bool(np.isfinite(log.truth.R_WB).all(axis=(1, 2)).any())
    if attitude and whose != "GPS":
        return []  # checks against its attitude tell whether the heading or the DVL is turned
    add = np.degrees(found.turn.value)
    return [
        Finding(
            "heading",
            f"The path by DVL and heading must be turned by {found.turn.times(1 / DEGREE).text('°')} "
            f"counter-clockwise to match the {whose}'s: declination, deviation or mounting of the heading sensor, or "
            "the DVL's own yaw on the vehicle.",
            f"streams.heading.add_deg: {-add:.1f}  # convention: compass; with yaw {add:.1f}",
        )
    ]
