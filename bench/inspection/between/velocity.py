"""The DVL against positions: is its path as long as the GPS's, or the truth's, and does it run where theirs does?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ....datasets.log import Log
from ..findings.finding import Check, Finding
from .answers import Answer, Delay
from .inertial import Inertial
from .path_fit import PathFit, Positions, fit_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DEGREE = np.pi / 180
SCALE_MATTERS = 0.01
TURN_MATTERS = 1.0 * DEGREE


def dvl_against_positions(log: Log, imu: Inertial, where: Positions) -> Answer | None:
    """Whether the DVL's path is as long as the positions' and runs where theirs does."""
    by = "gyro" if log.heading is None else "heading"
    found = fit_path(log, imu, where, by)
    if found is None:
        return None
    whose = where.whose
    moved = found.scale.known_to(0.3 * max(abs(found.scale.value), 0.1))
    facts = {"turned by": by, "scale that the DVL needs": found.scale.text_if(0.3)}
    facts["rms left in a twelfth of the log"] = f"{found.rms_m:.2g} m per axis"
    findings: list[Finding] = []
    if found.mirrored:
        says = (
            f"The DVL's path fits the {whose}'s only turned over: north and east are exchanged, or the heading "
            "turns the wrong way (a compass read as a yaw)."
        )
        part = "streams.gps" if whose == "GPS" else "truth"
        says += f" Or `{part}.frame` is wrong."
        findings.append(Finding("heading", says, "streams.heading.convention: yaw  # or compass, whichever it is not"))
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
        axes.plot(found.t_s / 60, left.real, ".", markersize=2, label="east")
        axes.plot(found.t_s / 60, left.imag, ".", markersize=2, label="north")
        axes.legend(fontsize=7)
        axes.set(xlabel="time (min)", ylabel=f"{whose} less DVL's path (m)", title=f"DVL against {whose}")

    kept = tuple(delay for delay in delays if delay.by.known_to(0.5))
    return Answer(Check(f"DVL against the positions of the {whose}", facts, tuple(findings), draw), kept)


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
            f"The DVL's path must be multiplied by {found.scale.text()} to be as long as the {whose}'s.{guess}",
            f"streams.dvl.velocity.unit: {near[0]}" if near else f"streams.dvl.velocity.scale: {scale:.4g}",
        )
    ]


def _turn_findings(log: Log, found: PathFit, whose: str) -> list[Finding]:
    if not found.turn.differs(0.0, TURN_MATTERS):
        return []
    attitude = log.truth is not None and bool(np.isfinite(log.truth.R_WB).all(axis=(1, 2)).any())
    if attitude and whose != "GPS":
        return []  # its attitude says whether heading or DVL is turned: other checks tell
    add = np.degrees(found.turn.value)
    return [
        Finding(
            "heading",
            f"Dead reckoned with DVL and heading, the path must be turned by {found.turn.times(1 / DEGREE).text('°')} "
            f"counter-clockwise to run as the {whose}'s: declination, deviation or mounting of the heading sensor, or "
            "the DVL's own yaw on the vehicle.",
            f"streams.heading.add_deg: {-add:.1f}  # convention: compass; with yaw {add:.1f}",
        )
    ]
