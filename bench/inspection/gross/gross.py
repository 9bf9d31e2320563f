"""All tests for gross faults, in an order in which each may rely on those before it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from ....datasets.log import ImuStream, Log
from ....datasets.quantities import DEGREE
from ....datasets.state import Array, TimeArray
from ..findings.advice import clock_fix
from ..findings.finding import Check, Finding
from ..streams.channels import seconds
from ..streams.norms import NO_GRAVITY, check_norms
from .axes import axes_findings, best, is_upright, scale_findings
from .plane import heading_fits, plane_findings
from .relations import tilting, turning
from .shifts import shift_of
from .sketch import Sketch, sketch_of
from .stated import sigma_findings, time_findings
from .vertical import vertical_findings

WEAKEST = 1.0
"""m/s²: gravity in the smallest wrong unit that is still read, g."""
TURNS = 0.7
"""Least correlation of heading and gyro that tells that both turn the same way."""
CLOCK_MATTERS_S = 2.0
"""Finer delays are left to the comparison of all clocks."""
RUNNING_S = 3.0
"""Headings are compared by their changes over this."""


def quick_findings(log: Log) -> tuple[Finding, ...]:
    """Return what looks grossly wrong: gravity, units, axes, clocks, coordinates, sign of depth, stated noise.

    It takes milliseconds: less than a twentieth of a run of `eskf`.
    """
    log = _speaking(log)
    sketch = sketch_of(log)
    if sketch is None:
        return ()
    coarse = replace(log, imu=ImuStream(_times(sketch), sketch.w_I, sketch.f_I))
    single = check_norms(coarse).findings
    return (*single, *unsaid(single, gross_check(log, sketch).findings))


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
    tilt = tilting(sketch)
    heading, truth = sketch.heading, _truth_yaw(sketch)
    by_heading = None if heading is None else turning(sketch, *heading)
    by_truth = None if truth is None else turning(sketch, *truth)
    alike = best(sketch, tilt, by_heading, by_truth)
    findings = axes_findings(sketch, alike)
    if alike[0].is_none:
        findings += _small_heading(sketch) or scale_findings(tilt, by_heading, by_truth, alike[0])
        findings += [] if findings else _heading_clock(sketch)
    if findings or not is_upright(sketch):
        return findings
    turns_right = by_heading is not None and by_heading.correlation(np.eye(3)) > TURNS
    in_plane, agrees = plane_findings(sketch, turns_right)
    suspects = {finding.stream for finding in in_plane}
    vouched = {"dvl"} if agrees else set()
    every = [*in_plane, *vertical_findings(sketch, suspects, vouched)]
    keys = [(finding.stream, _key(finding)) for finding in every]
    return [finding for k, finding in enumerate(every) if keys[k] not in keys[:k]]


def _small_heading(sketch: Sketch) -> list[Finding]:
    """Find a heading in radians that is read as degrees: it stays within 2π degrees while the gyro turns."""
    heading = sketch.heading
    if heading is None or np.ptp(heading[1]) > 2.05 * np.pi * DEGREE or np.ptp(sketch.yaw) < 1.0:
        return []
    message = (
        f"The heading stays within {np.degrees(np.ptp(heading[1])):.1f}° while the gyro turns: radians are read as "
        "degrees."
    )
    return [Finding("heading", message, "streams.heading.heading.unit: rad")]


def _truth_yaw(sketch: Sketch) -> tuple[Array, Array, Array] | None:
    """Return when (m,) s, the yaw (m,) rad by the truth, and where it is known (n,); None without an attitude."""
    truth = sketch.log.truth
    if truth is None or len(truth) < 30:
        return None
    every = slice(None, None, max(len(truth) // 4000, 1))
    R, t_s = truth.R_WB[every], seconds(sketch.log, truth.t_ns[every])
    known = np.isfinite(R[:, 0, 0])
    if np.count_nonzero(known) < 30:
        return None
    t_s, yaw = t_s[known], np.unwrap(np.arctan2(R[known, 1, 0], R[known, 0, 0]))
    return t_s, yaw, sketch.heard(t_s)


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
    if not shift.matters or abs(shift.late_s) < CLOCK_MATTERS_S:
        return []
    if heading_fits(sketch, shift.late_s):
        message = f"The IMU turns {abs(shift.late_s):.1f} s {_late(-shift.late_s)} by the clock of the others."
        return [Finding("imu", message, clock_fix("imu", -shift.late_s))]
    message = f"The heading turns {abs(shift.late_s):.1f} s {_late(shift.late_s)} by the IMU's clock."
    return [Finding("heading", message, clock_fix("heading", shift.late_s))]


def _late(shift_s: float) -> str:
    return "late" if shift_s > 0 else "early"
