"""All tests for gross faults, in an order in which each may rely on those before it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from ....datasets.log import AttitudeStream, ImuStream, Log
from ....datasets.quantities import DEGREE
from ....datasets.state import TimeArray
from ..findings.advice import ATTITUDE, clock_fix, late_or_early
from ..findings.finding import Check, Finding
from ..streams.norms import NO_GRAVITY, check_norms
from .attitudes import attitude_findings, random_heading
from .axes import CLEARLY, SURELY, agreement, axes_findings, best, hypotheses, is_upright, scale_findings
from .datum import height_findings, surface_findings
from .plane import heading_fits, heard_under_water, plane_findings
from .readings import reading_findings, without
from .relations import tilting, turning
from .shifts import shift_of
from .sketch import Sketch, sketch_of
from .stated import sigma_findings, time_findings
from .vertical import vertical_findings

WEAKEST = 1.0
"""m/s²: gravity in the smallest wrong unit that is still read, g."""
TURNS = 0.7
"""Least correlation of heading and gyro that tells that both turn the same way."""
RUNNING_S = 3.0
"""Headings are compared by their changes over this."""


def quick_findings(log: Log) -> tuple[Finding, ...]:
    """Return what looks grossly wrong: readings, gravity, units, axes, clocks, coordinates, sign of depth, noise.

    It takes milliseconds: less than a twentieth of a run of `eskf`.
    """
    log = _speaking(log)
    readings = reading_findings(log)
    broken = {finding.stream for finding in readings}
    log = without(log, broken)
    sketch = sketch_of(log)
    if sketch is None or "imu" in broken:
        return tuple(readings)
    coarse = replace(log, imu=ImuStream(_times(sketch), sketch.w_I, sketch.f_I))
    single = check_norms(coarse).findings
    gross = unsaid(single, gross_check(log, sketch).findings)
    faulty = {finding.stream for finding in gross}
    return (*readings, *single, *gross, *height_findings(replace(sketch, log=without(log, faulty))))


def gross_check(log: Log, sketch: Sketch | None = None) -> Check:
    """Find the streams that contradict the others grossly; one whose fault hides others is reported alone."""
    log = _speaking(log)
    sketch = sketch or sketch_of(log)
    found = time_findings(log)
    if not found and sketch is not None:
        found = _findings(sketch)
    streams = {finding.stream for finding in found}
    found += [finding for finding in sigma_findings(log) if finding.stream not in streams]  # else of another unit
    return Check("gross faults", {}, tuple(found))


def unsaid(said: Iterable[Finding], findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings that change another key of log.yaml than those which are said already."""
    keys = {(finding.stream, _key(finding)) for finding in said}
    return tuple(finding for finding in findings if not _key(finding) or (finding.stream, _key(finding)) not in keys)


def _key(finding: Finding) -> str:
    return finding.fix.split(":")[0]


def _speaking(log: Log) -> Log:
    """Return the log with a stream without rows counted as absent."""
    silent: dict[str, Any] = {name: None for name, stream in log.streams.items() if not len(stream)}
    return replace(log, **silent) if silent else log


def _times(sketch: Sketch) -> TimeArray:
    return np.asarray(np.rint(sketch.t_s * 1e9), np.int64) + sketch.log.start_ns


def _findings(sketch: Sketch) -> list[Finding]:
    if np.median(np.linalg.norm(sketch.f_I, axis=1)) < NO_GRAVITY * WEAKEST:
        return []  # there is no up
    unread = [*attitude_findings(sketch), *random_heading(sketch)]
    if unread:
        return unread
    tilt = tilting(sketch)
    heading, truth = sketch.heading, sketch.truth_yaw
    by_heading = None if heading is None else turning(sketch, *heading)
    by_truth = None if truth is None else turning(sketch, *truth)
    alike = best(sketch, tilt, by_heading, by_truth)
    findings = axes_findings(sketch, alike)
    if alike[0].is_none:
        up = int(np.argmax(np.abs(sketch.up_I.mean(axis=0))))
        vouched = by_truth is None and heading is not None and plane_findings(sketch, True)[1]
        findings += _small_heading(sketch) or scale_findings(tilt, by_heading, by_truth, up, vouched)
        findings += [] if findings else _heading_clock(sketch)
    if findings or not is_upright(sketch):
        return findings
    turns_right = by_heading is not None and by_heading.correlation(np.eye(3)) > TURNS
    in_plane, agrees = plane_findings(sketch, turns_right)
    suspects = {finding.stream for finding in in_plane}
    vouched = {"dvl"} if agrees else set()
    zero = [] if "gps" in suspects else surface_findings(sketch)
    vertical = vertical_findings(sketch, suspects, vouched, zero_off=bool(zero))
    if not in_plane and all(finding.stream == "dvl" for finding in vertical):
        vertical = _imu_yaw(sketch, agrees) or vertical  # it turns the climb over too
    vertical += [] if any(finding.stream == "depth" for finding in vertical) else zero
    every = [*in_plane, *vertical]
    if not {"gps", "depth"} & {finding.stream for finding in every}:
        every += heard_under_water(sketch)
    keys = [(finding.stream, _key(finding)) for finding in every]
    return [finding for k, finding in enumerate(every) if keys[k] not in keys[:k]]


def _imu_yaw(sketch: Sketch, path_agrees: bool) -> list[Finding]:
    """Find an IMU that is mounted a quarter or half a turn off about the vertical, by the motion of the DVL."""
    none = hypotheses()[0]
    now = agreement(sketch, none)
    if sketch.velocity is None or now > CLEARLY:
        return []
    found = {quarter: agreement(sketch, none, dvl_turn=quarter * np.pi / 2) for quarter in (1, 2, 3)}
    best = max(found, key=lambda quarter: found[quarter])
    if found[best] < now + SURELY:
        return []
    turn = (-90 * best + 180) % 360 - 180
    message = f"DVL and depth sensor agree with the accelerometers if the IMU is turned by {turn}° about the vertical"
    if not path_agrees:
        return [Finding("imu", message + ", or the DVL the other way.")]
    message += ", while DVL and heading agree with the positions: the IMU's yaw on the vehicle."
    return [Finding("imu", message, f"streams.imu.mounting.yaw_deg: {turn}  # added to the one there")]


def _small_heading(sketch: Sketch) -> list[Finding]:
    """Find a heading in radians that is read as degrees: it stays within 2π degrees while the gyro turns."""
    heading = sketch.heading
    if heading is None or np.ptp(heading[1]) > 2.05 * np.pi * DEGREE or np.ptp(sketch.yaw) < 1.0:
        return []
    message = f"The heading stays within {np.degrees(np.ptp(heading[1])):.1f}° while the gyro turns: "
    if isinstance(sketch.log.heading, AttitudeStream):
        message += "its attitude is read in another form, or in another unit or order of columns, than it is in."
        return [Finding("heading", message, hint=ATTITUDE)]
    message += "radians are read as degrees."
    return [Finding("heading", message, "streams.heading.heading.unit: rad")]


def _heading_clock(sketch: Sketch) -> list[Finding]:
    """Find a heading whose turns come earlier or later than the gyro's."""
    heading = sketch.heading
    if heading is None:
        return []
    t_s, psi, heard = heading
    lag = max(round(RUNNING_S / sketch.step_s), 1)
    both = heard[lag:] & heard[:-lag]
    turns = [np.where(both, x[lag:] - x[:-lag], 0.0) for x in (sketch.on_grid(t_s, psi), sketch.yaw)]
    shift = shift_of(turns[0], turns[1], sketch.step_s)
    if not shift.matters:
        return []
    if heading_fits(sketch, shift.late_s):
        message = f"The IMU turns {abs(shift.late_s):.1f} s {late_or_early(-shift.late_s)} by the clock of the others."
        return [Finding("imu", message, clock_fix("imu", -shift.late_s))]
    message = f"The heading turns {abs(shift.late_s):.1f} s {late_or_early(shift.late_s)} by the IMU's clock."
    return [Finding("heading", message, clock_fix("heading", shift.late_s))]
