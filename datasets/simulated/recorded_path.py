"""A recorded trajectory as the path of a mission: quintic splines through its poses are the new truth."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline

from ..errors import DatasetError
from ..state import Array
from ..trajectory import Trajectory
from .motion import Motion

if TYPE_CHECKING:
    from .scenario import Scenario

DEGREE_OF_SPLINES = 5
"""Quintic, as in `missions`: accelerations and angular accelerations are then smooth."""
STEEPEST_DEG = 80.0
"""Beyond this pitch the Euler angles change too fast for the splines."""
TURN_LIMIT_DEG = 90.0
"""Between neighbouring poses; beyond it the direction of the turn is ambiguous."""
ACCELERATION_LIMIT_M_S2 = 50.0
"""5 g: no underwater vehicle reaches it, and a jump of 10 cm between poses at 20 Hz does."""
RATE_LIMIT_RAD_S = 10.0
"""570 °/s: faster than any underwater vehicle turns."""
CHECK_S = 0.01
"""Spacing of the times at which these limits are checked, the period of a 100 Hz IMU."""


def follow(scenario: Scenario, path: Trajectory | None = None) -> Motion:
    """Return the motion along `path`, or along the scenario's file; the log begins path_start_s after its first pose.

    Without path_spacing_s the splines interpolate every pose. With it they are the least-squares fit among the splines
    with knots that far apart. Noisy poses need a fit: at 100 Hz one centimetre of noise is an acceleration of 100 m/s².

    Raises:
        DatasetError: no path, a file that cannot be read, or poses that no smooth path passes; names the row.
    """
    source, digest = "path", ""
    if path is None:
        if scenario.path is None:
            raise DatasetError("simulate: mission 'recorded' needs `path`, a TUM file, or a Trajectory")
        source = scenario.path
        path = Trajectory.from_tum(source)
        digest = f", sha256 {hashlib.sha256(Path(source).read_bytes()).hexdigest()[:16]}"
    t_s = (path.t_ns - path.t_ns[0]) * 1e-9 - scenario.path_start_s
    _check_cover(source, t_s, scenario)
    poses = np.hstack([path.p_WB_W, _euler_angles(source, path)])
    splines = _lay(source, t_s, poses, scenario.path_spacing_s)
    off_m = np.linalg.norm(splines(t_s)[:, :3] - path.p_WB_W, axis=1)
    motion = Motion(
        position=_columns(splines, slice(0, 3)),
        velocity=_columns(splines, slice(0, 3)).derivative(),
        angles=_columns(splines, slice(3, 6)),
        notes=(
            f"Path: {source}{digest}, {len(path)} poses, from {scenario.path_start_s:g} s after the first; the splines "
            f"pass them at {math.sqrt(np.mean(off_m**2)):.3g} m rms, {off_m.max():.3g} m at most.",
        ),
    )
    _check_motion(source, motion, scenario)
    return motion


def _check_cover(source: str, t_s: Array, scenario: Scenario) -> None:
    if len(t_s) <= DEGREE_OF_SPLINES:
        raise DatasetError(f"{source}: {len(t_s)} poses; splines need at least {DEGREE_OF_SPLINES + 1}")
    begin_s, end_s = scenario.reach_s
    if t_s[0] > begin_s or t_s[-1] < end_s:
        start_s = scenario.path_start_s
        raise DatasetError(
            f"{source}: the path lasts {t_s[-1] - t_s[0]:g} s; the scenario needs it from {start_s + begin_s:g} to "
            f"{start_s + end_s:g} s; change path_start_s or duration_s"
        )


def _euler_angles(source: str, path: Trajectory) -> Array:
    """Return (phi, theta, psi), (n, 3) rad, each without jumps."""
    R = path.R_WB
    bad = np.flatnonzero(~(np.isfinite(path.p_WB_W).all(axis=1) & np.isfinite(R).all(axis=(1, 2))))
    if len(bad):
        raise DatasetError(f"{source}: pose {bad[0]} ({len(bad)} in all) is not finite")
    bad = np.flatnonzero(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 1e-6)
    if len(bad):
        raise DatasetError(f"{source}: pose {bad[0]} ({len(bad)} in all): R_WB is not a rotation")
    bad = np.flatnonzero(np.abs(R[:, 2, 0]) > math.sin(math.radians(STEEPEST_DEG)))
    if len(bad):
        raise DatasetError(
            f"{source}: pose {bad[0]} ({len(bad)} in all) is pitched beyond {STEEPEST_DEG:g}°; cut the path before it"
        )
    cosine = (np.einsum("nij,nij->n", R[:-1], R[1:]) - 1) / 2
    bad = np.flatnonzero(cosine < math.cos(math.radians(TURN_LIMIT_DEG)))
    if len(bad):
        raise DatasetError(
            f"{source}: pose {bad[0] + 1} ({len(bad)} in all) is turned by more than {TURN_LIMIT_DEG:g}° from the one "
            "before it: too far apart to be one motion"
        )
    angles = [np.arctan2(R[:, 2, 1], R[:, 2, 2]), -np.arcsin(R[:, 2, 0]), np.arctan2(R[:, 1, 0], R[:, 0, 0])]
    return np.unwrap(np.stack(angles, axis=1), axis=0)


def _lay(source: str, t_s: Array, poses: Array, spacing_s: float | None) -> BSpline:
    if spacing_s is None:
        return make_interp_spline(t_s, poses, k=DEGREE_OF_SPLINES)
    count = max(1, round((t_s[-1] - t_s[0]) / spacing_s))
    breaks = np.linspace(t_s[0], t_s[-1], count + 1)
    empty = np.flatnonzero(np.histogram(t_s, breaks)[0] == 0)
    if len(empty):
        raise DatasetError(
            f"{source}: no pose from {breaks[empty[0]] - t_s[0]:g} to {breaks[empty[0] + 1] - t_s[0]:g} s "
            f"({len(empty)} such gaps); path_spacing_s must be longer than the longest gap"
        )
    knots = np.concatenate([np.repeat(t_s[0], DEGREE_OF_SPLINES), breaks, np.repeat(t_s[-1], DEGREE_OF_SPLINES)])
    try:
        return make_lsq_spline(t_s, poses, knots, k=DEGREE_OF_SPLINES)
    except (ValueError, np.linalg.LinAlgError):
        raise DatasetError(
            f"{source}: {len(t_s)} poses are too few for knots every {spacing_s:g} s; make path_spacing_s longer"
        ) from None


def _columns(spline: BSpline, columns: slice) -> BSpline:
    return BSpline(spline.t, spline.c[:, columns], spline.k)


def _check_motion(source: str, motion: Motion, scenario: Scenario) -> None:
    """Refuse accelerations and rates beyond any vehicle's: they are noise of the poses, or a jump between them."""
    t_s = np.arange(*scenario.reach_s, CHECK_S)
    for what, values, limit, unit in (
        ("an acceleration", motion.acceleration(t_s), ACCELERATION_LIMIT_M_S2, "m/s²"),
        ("a turning rate", motion.attitude(t_s)[1], RATE_LIMIT_RAD_S, "rad/s"),
    ):
        size = np.linalg.norm(values, axis=1)
        worst = int(np.argmax(size))
        if size[worst] > limit:
            raise DatasetError(
                f"{source}: a path through its poses has {what} of {size[worst]:.3g} {unit} "
                f"{t_s[worst] + scenario.path_start_s:.2f} s after its first pose (at most {limit:g}): its poses jump, "
                "or are too noisy to run through; set path_spacing_s, 1 s for example"
            )
