"""Attitudes and headings that are read in another form or unit, so that they have nothing to do with the IMU."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ....datasets.log import AttitudeStream
from ....datasets.quantities import DEGREE
from ....datasets.state import Array
from ..findings.advice import ATTITUDE
from ..findings.finding import Finding
from ..streams.channels import seconds
from .sketch import MOST_POSES, Sketch

UPRIGHT = np.cos(30 * DEGREE)
"""Least vertical part of B's mean up by the accelerometers: the IMU's own mounting is then not in doubt."""
TILTED = 45 * DEGREE
"""Median angle of two ups: no attitude of a vehicle is as far off, and none in another form much nearer."""
RIGHT = 15 * DEGREE
"""The same of an attitude that is read rightly: its errors, and accelerations over gravity."""
RANDOM = 0.6
"""Mean cosine of the steps of a heading less the gyro's: below it the steps differ by a radian, rms."""
COHERENT = 0.2
"""The same of a heading in degrees: four times what a hundred random steps show."""
FEWEST = 100
"""Steps of a heading for that."""


def attitude_findings(sketch: Sketch) -> list[Finding]:
    """Find attitudes whose up is not that of the accelerometers, where those say that the vehicle is upright."""
    up = sketch.up_B.mean(axis=0)
    if up[2] < UPRIGHT * np.linalg.norm(up):
        return []
    log, found = sketch.log, []
    if isinstance(log.heading, AttitudeStream) and len(log.heading):
        R, t_s = log.heading.z.reshape(-1, 3, 3), seconds(log, log.heading.t_ns)
        found += _tilted(sketch, "heading", t_s, R @ np.asarray(log.rig.heading.R_BS).T)
    if log.truth is not None and len(log.truth):
        found += _tilted(sketch, "truth", seconds(log, log.truth.t_ns), log.truth.R_WB)
    return found


def _tilted(sketch: Sketch, stream: str, t_s: Array, R_WB: Array) -> list[Finding]:
    """Return what is wrong with an attitude R_WB (m, 3, 3) at t_s (m,), if anything is."""
    rows = np.flatnonzero((t_s >= sketch.t_s[0]) & (t_s <= sketch.t_s[-1]) & np.isfinite(R_WB[:, 0, 0]))
    rows = rows[:: max(len(rows) // MOST_POSES, 1)]
    if not len(rows):
        return []
    R_WB, t_s = R_WB[rows], t_s[rows]
    off = _off(sketch, t_s, R_WB)
    if off < TILTED:
        return []
    who = "attitude" if stream == "heading" else f"{sketch.log.truth_kind}'s attitude"
    message = f"The {who} is tilted by {off / DEGREE:.0f}° (median) against the accelerometers: "
    q = Rotation.from_matrix(R_WB).as_quat()
    if min(_off(sketch, t_s, Rotation.from_quat(np.roll(q, k, axis=1)).as_matrix()) for k in (1, -1)) < RIGHT:
        path = "truth" if stream == "truth" else "streams.heading"
        fix = f"{path}.attitude.form: quaternion_wxyz  # or quaternion_xyzw, whichever it is not"
        return [Finding(stream, message + "w is read from the wrong end of its quaternions.", fix)]
    hint = ATTITUDE.replace("streams.heading", "truth") if stream == "truth" else ATTITUDE
    return [Finding(stream, message + "it is read in another form, unit, order of columns or axes.", hint=hint)]


def _off(sketch: Sketch, t_s: Array, R_WB: Array) -> float:
    """Return the median angle (rad) of up by R_WB (m, 3, 3) and by the accelerometers."""
    up = np.stack([np.interp(t_s, sketch.t_s, column) for column in sketch.up_B.T], axis=1)
    cosine = np.einsum("mi,mi->m", R_WB[:, 2, :], up) / np.maximum(np.linalg.norm(up, axis=1), 1e-9)
    return float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))


def random_heading(sketch: Sketch) -> list[Finding]:
    """Find a heading whose steps have nothing to do with the gyro's: degrees that are read as radians, mostly."""
    heading = sketch.heading
    if heading is None or isinstance(sketch.log.heading, AttitudeStream):
        return []
    t_s, psi, _ = heading
    steps, by_gyro = np.diff(psi), np.diff(np.interp(t_s, sketch.t_s, sketch.yaw))
    if len(steps) < FEWEST or np.mean(np.cos(steps - by_gyro)) > RANDOM:
        return []
    message = f"The heading steps by {np.std(np.angle(np.exp(1j * steps))) / DEGREE:.0f}° (rms) from reading to reading"
    message += ", which the gyro does not: "
    large = np.abs(by_gyro) > DEGREE  # others are in phase whatever they are multiplied by
    in_degrees = [np.mean(np.cos(steps[large] + s * by_gyro[large] / DEGREE)) for s in (1, -1) if large.sum() > FEWEST]
    if max(in_degrees, default=0.0) > COHERENT:
        return [Finding("heading", message + "degrees are read as radians.", "streams.heading.heading.unit: deg")]
    hint = "streams.heading.heading: unit: deg if its numbers go up to 360; else check its column"
    return [Finding("heading", message + "degrees are read as radians, or another column is.", hint=hint)]
