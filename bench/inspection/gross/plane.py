"""Positions against the path by DVL and yaw: hemispheres, exchanged coordinates, units, turns and clocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ....datasets.described.description import Speeds
from ....datasets.described.geodesy import (
    FLATTENING,
    SEMI_MAJOR_M,
    ecef_from_geodetic,
    enu_axes,
    geodetic_from_ecef,
)
from ....datasets.log import Log
from ....datasets.quantities import DEGREE
from ....datasets.state import Array
from ..findings.advice import clock_fix, late_or_early
from ..findings.finding import Finding
from ..findings.fitting import Mask, Plane
from ..streams.channels import seconds
from .axes import CLEARLY, agreement, hypotheses
from .shifts import LONGEST_S
from .sketch import Sketch
from .vertical import climb_scale

MOST_FIXES = 300
"""Positions used: more do not change a gross fault."""
FEWEST = 20
"""Positions: with fewer a path of three turns is hardly sampled."""
OUTLIER = 5.0
"""Of the median residual: what is farther off is left out; of normal noise in a plane one in 10⁷."""
EXTENT_M = 10.0
"""Least root mean square of the positions about their mean, m: a smaller path shows nothing past a fix's noise."""
TRUTH_SIGMA_M = 0.1
"""Of a truth, which states none: what a dive is usually reconstructed to."""
DRIFT = 0.1
"""Of this extent: dead reckoning by a compass that deviates by some degrees strays so far."""
NOISES = 3.0
"""Stated sigmas of a fix that a residual may have besides."""
BETTER = 0.4
"""What an explanation must leave at most of the residual."""
SCALE_MATTERS = 0.15
"""Relative, of the length of the path: a DVL is good to 1 %, a wheel to some percent."""
TURN_MATTERS = 15 * DEGREE
"""Declination and deviation are seldom more where a log states none; less is left to the finer comparison."""
SQUARE = 20 * DEGREE
"""A turn this near to a right angle is taken for one."""
NEARLY_DEG = 5.0
"""A DVL's yaw this near to a right angle is one: a path shows its direction to a degree or two."""
STEADY = 0.9
"""Least length of the mean of e^{i difference} of two yaws, for their mean difference to be an offset."""
SILENT_SHARE = 0.1
"""Of the time between the first and the last fix: with the DVL silent for longer, the path is not known."""
FAR_M = 100e3
"""From W's origin: the tangent plane is 0.8 km off the sphere there, and no voyage between two fixes is so long."""
SEARCHED = 40
"""Positions with which a clock's lag is searched for on a grid; the lag is then refined with all."""
CLOCK_NOISES, CLOCK_DRIFT = 2.0, 0.01
"""Of the stated sigma (√2 of it is the rms of the two axes), and of the extent: with less left no clock is sought."""
ALONE = 0.6
"""What a lag must leave at most of a residual that drift might explain as well."""
DEEP_M = 2.0
"""No GPS signal reaches an antenna this far under water, however it is mounted on a vehicle."""
MANY, SOME = 0.1, 0.02
"""Shares of the fixes so deep that make a finding, and that are none."""
LEAP_S = 18
"""Seconds between GPS time and UTC since 2017."""
FAR_OFF = 0.35
"""Of the extent: a residual this large is no drift, even where nothing explains it."""


@dataclass(frozen=True, eq=False)
class Fixes:
    """Positions of B: stream ("gps" or "truth"), t_s (m,), east + i north p (m,) m, and the stated sigma, m."""

    stream: str
    t_s: Array
    p: Plane
    sigma_m: float

    def some(self, most: int) -> Fixes:
        """Return about as many of the positions."""
        every = slice(None, None, max(len(self.p) // most, 1))
        return Fixes(self.stream, self.t_s[every], self.p[every], self.sigma_m)

    @property
    def extent_m(self) -> float:
        """Root mean square about the mean."""
        return float(np.sqrt(np.mean(np.abs(self.p - self.p.mean()) ** 2)))

    @property
    def allowed_m(self) -> float:
        """The residual of a right log at most."""
        return max(NOISES * self.sigma_m, DRIFT * self.extent_m)


@dataclass(frozen=True, eq=False)
class Match:
    """p ≈ z x + c: z, and the root mean square of what is left, m."""

    z: complex
    rms_m: float


@dataclass(frozen=True, eq=False)
class Course:
    """Level velocity v (n,) m/s and yaw (n,) rad on the grid; `compass` tells whether the yaw is a heading sensor's."""

    t_s: Array
    v: Plane
    yaw: Array
    compass: bool

    def path(self, dvl_late_s: float = 0.0, yaw_late_s: float = 0.0) -> list[Plane]:
        """Return the path x (n,), and by a gyro how a bias bends it (n,), for stamps that are late."""
        v = np.interp(self.t_s + dvl_late_s, self.t_s, self.v) if dvl_late_s else self.v
        yaw = np.interp(self.t_s + yaw_late_s, self.t_s, self.yaw) if yaw_late_s else self.yaw
        each = v * np.exp(1j * yaw)
        columns = [each] if self.compass else [each, each * (self.t_s - self.t_s.mean())]
        step_s = np.diff(self.t_s)
        return [np.concatenate([[0], np.cumsum((c[1:] + c[:-1]) / 2 * step_s)]) for c in columns]

    def match(self, path: list[Plane], fixes: Fixes, late_s: float = 0.0, p: Plane | None = None) -> Match:
        """Fit a path to positions (or p instead), for stamps of the positions that are late."""
        t_s = fixes.t_s - late_s
        columns = [np.interp(t_s, self.t_s, x) for x in path]
        X, y = np.stack(columns, axis=1), fixes.p if p is None else p
        z, left = _solved(X, y)
        kept = left <= OUTLIER * np.median(left) + 1e-9
        if not kept.all():
            z, left = _solved(X[kept], y[kept])
        return Match(complex(z[0]), float(np.sqrt(np.mean(left**2))))

    def scan(self, path: list[Plane], fixes: Fixes, lags_s: Array) -> Array:
        """Return the rms that is left (k,) for each lag (k,) of the positions, without a fit of a gyro's bias."""
        x = np.interp((fixes.t_s - lags_s[:, None]).ravel(), self.t_s, path[0]).reshape(len(lags_s), -1)
        x = x - x.mean(axis=1, keepdims=True)
        y = fixes.p - fixes.p.mean()
        common = np.abs(x.conj() @ y) ** 2 / np.maximum(np.sum(np.abs(x) ** 2, axis=1), 1e-9)
        return np.sqrt(np.maximum(np.sum(np.abs(y) ** 2) - common, 0.0) / len(y))


def _solved(X: Plane, y: Plane) -> tuple[Plane, Array]:
    """Return the least squares of y (m,) by the columns of X (m, k) and a constant, and what each row leaves (m,)."""
    X, y = X - X.mean(axis=0), y - y.mean()
    normal = X.conj().T @ X
    normal += (1e-9 * np.trace(normal).real + 1e-12) * np.eye(len(normal))
    z: Plane = np.linalg.solve(normal, X.conj().T @ y)
    return z, np.abs(y - X @ z)


def course_of(sketch: Sketch) -> tuple[Course, Mask] | None:
    """Return the course, and where the DVL is heard (n,); None without a DVL."""
    motion, heading = sketch.velocity, sketch.heading
    if motion is None:
        return None
    v, _ = sketch.level_velocity(motion[0])
    if heading is None:
        return Course(sketch.t_s, v, sketch.yaw, False), motion[1]
    t_s, psi, _ = heading
    axis = np.asarray(sketch.log.rig.heading.R_BS)[:, 0]
    return Course(sketch.t_s, v, sketch.on_grid(t_s, psi) - np.arctan2(axis[1], axis[0]), True), motion[1]


def fixes_of(sketch: Sketch) -> list[Fixes]:
    """Return the positions of GPS and truth that are worth fitting."""
    log, found = sketch.log, []
    if log.gps is not None and len(log.gps):
        inside = (log.gps.t_ns >= log.start_ns) & (log.gps.t_ns <= log.imu.t_ns[-1])
        good = np.flatnonzero(np.isfinite(log.gps.sigma[:, :2]).all(axis=1) & inside)
        good = good[:: max(len(good) // MOST_FIXES, 1)]
        p, sigma = log.gps.z[good], log.gps.sigma[good, :2]
        if len(good):
            found.append(
                Fixes("gps", seconds(log, log.gps.t_ns[good]), p[:, 0] + 1j * p[:, 1], float(np.median(sigma)))
            )
    if log.truth is not None and len(log.truth):
        inside = np.flatnonzero((log.truth.t_ns >= log.start_ns) & (log.truth.t_ns <= log.imu.t_ns[-1]))
        every = inside[:: max(len(inside) // MOST_FIXES, 1)]
        p = log.truth.p_WB_W[every]
        found.append(Fixes("truth", seconds(log, log.truth.t_ns[every]), p[:, 0] + 1j * p[:, 1], TRUTH_SIGMA_M))
    return [each for each in found if len(each.p) >= FEWEST]


def plane_findings(sketch: Sketch, turns_right: bool) -> tuple[list[Finding], bool]:
    """Compare the positions with the path; return what is wrong, and whether some positions agree with the path.

    Args:
        turns_right: whether heading and gyro turn alike, so that a mirrored path is not the heading's fault.
    """
    every, found = fixes_of(sketch), course_of(sketch)
    far = [fixes for fixes in every if abs(np.median(fixes.p.real) + 1j * np.median(fixes.p.imag)) > FAR_M]
    findings = [_far_away(sketch.log, fixes) for fixes in far]
    if found is None:
        return findings, False
    course, heard = found
    path = course.path()
    usable = [fixes for fixes in every if fixes not in far and _usable(course, heard, fixes)]
    now = [course.match(path, fixes) for fixes in usable]
    agrees = any(m.rms_m < f.allowed_m and abs(m.z - 1) < TURN_MATTERS for m, f in zip(now, usable, strict=True))
    near: list[Finding] = []
    for match, fixes in zip(now, usable, strict=True):
        near += _of_fixes(sketch, course, path, fixes, match, turns_right, agrees)
    return near or findings, agrees  # W's origin is at the near ones: where those are wrong, the far ones may be right


def heading_fits(sketch: Sketch, late_s: float) -> bool:
    """Return whether some positions fit a path by the heading sensor far better as it is than with late stamps."""
    found = course_of(sketch)
    if found is None or not found[0].compass:
        return False
    course, heard = found
    paths = course.path(), course.path(yaw_late_s=late_s)
    usable = [fixes for fixes in fixes_of(sketch) if _usable(course, heard, fixes)]
    rms_m = [(*(course.match(path, fixes).rms_m for path in paths), fixes.allowed_m) for fixes in usable]
    return any(now < BETTER * then and now < allowed for now, then, allowed in rms_m) and not any(
        then < BETTER * now for now, then, _ in rms_m
    )


def _usable(course: Course, heard: Mask, fixes: Fixes) -> bool:
    """Whether positions reach far enough, and the DVL is heard between them."""
    between = (course.t_s >= fixes.t_s[0]) & (course.t_s <= fixes.t_s[-1])
    heard_of = bool(between.any()) and float(np.mean(~heard[between])) <= SILENT_SHARE
    return heard_of and fixes.extent_m > max(EXTENT_M, 5 * fixes.sigma_m)


def _far_away(log: Log, fixes: Fixes) -> Finding:
    """Return what positions far from W's origin are: those of a sign or an order that brings them near it."""
    p = complex(np.median(fixes.p.real), np.median(fixes.p.imag))
    who = "GPS" if fixes.stream == "gps" else f"The {log.truth_kind}"
    message = f"{who} lies {abs(p) / 1e3:.0f} km from W's origin"
    meant = None if log.origin is None else _meant(p, np.radians(log.origin))
    if meant is None:
        return Finding(fixes.stream, message + ": latitude, longitude or a hemisphere is another's.")
    swapped, signs = meant
    path = _path_of(fixes)
    if swapped:
        message += ", and near it with latitude and longitude exchanged: the two columns are swapped."
        return Finding(fixes.stream, message, f"{path}.geodetic: exchange latitude and longitude")
    names = [name for name, sign in zip(("latitude", "longitude"), signs, strict=True) if sign < 0]
    message += f", and near it with the sign of {' and '.join(names)} turned: a hemisphere (S or W) is missing there, "
    message += "or in the origin."
    return Finding(fixes.stream, message, f"{path}: mirror {' and '.join(names)}")


def _meant(p: complex, origin: Array) -> tuple[bool, tuple[int, int]] | None:
    """Return whether to exchange latitude and longitude, and their signs then, for p (east + i north) to be near.

    Args:
        p: a position in the plane tangent at the origin, m, of a place on the ellipsoid.
        origin: (2,) latitude and longitude, rad.
    """
    at, axes = ecef_from_geodetic(origin[:1], origin[1:], np.zeros(1))[0], enu_axes(origin[:1], origin[1:])[0]
    round_ = np.array([1.0, 1.0, 1 / (1 - FLATTENING)])  # makes a sphere of the ellipsoid
    start, up = (at + p.real * axes[0] + p.imag * axes[1]) * round_, axes[2] * round_
    roots = np.roots([up @ up, 2 * start @ up, start @ start - SEMI_MAJOR_M**2])
    if np.iscomplex(roots).any():
        return None
    latitude, longitude, _ = geodetic_from_ecef((start + roots[:, None] * up) / round_)
    for swapped, signs in product((False, True), ((1, 1), (-1, 1), (1, -1), (-1, -1))):
        read = np.stack([longitude, latitude] if swapped else [latitude, longitude])
        off = read * np.array(signs)[:, None] - origin[:, None]
        off[1] = np.angle(np.exp(1j * off[1])) * np.cos(origin[0])
        if (swapped or min(signs) < 0) and (np.linalg.norm(off, axis=0) * SEMI_MAJOR_M < FAR_M).any():
            return swapped, signs
    return None


def _of_fixes(
    sketch: Sketch, course: Course, path: list[Plane], fixes: Fixes, now: Match, turns_right: bool, agrees: bool
) -> list[Finding]:
    """Return what is wrong between the path and one source of positions; `agrees`: another source fits the path."""
    log, fits = sketch.log, now.rms_m <= fixes.allowed_m
    if not (fits and _is_plain(now, course.compass)):
        other = _other_coordinates(sketch, course, path, fixes, now, turns_right)
        if other is not None:
            return [other]
    late = _clock(sketch, course, path, fixes, now)
    if late is not None:
        return [late]
    if now.rms_m > max(FAR_OFF * fixes.extent_m, 2 * NOISES * fixes.sigma_m) and course.compass:
        return [_in_earth_axes(sketch, course, fixes, now) or _far_off(log, fixes, now)]
    if not fits or _is_plain(now, course.compass):
        return []
    if not agrees:
        return _size_and_turn(sketch, course, fixes, now)
    message = f"The {_whose(log, fixes)}'s positions are turned by {np.degrees(np.angle(now.z)):.0f}° and scaled by "
    message += f"{abs(now.z):.2f} from the path by DVL and heading, with which other positions agree"
    if abs(abs(now.z) - 1) < SCALE_MATTERS and abs(abs(np.angle(now.z)) - np.pi) < SQUARE:
        fix = f"{_path_of(fixes)}: mirror latitude and longitude"
        return [Finding(fixes.stream, message + ": both hemispheres (S and W) are missing.", fix)]
    return [Finding(fixes.stream, message + ".")]


def _is_plain(match: Match, compass: bool) -> bool:
    """Whether the path need not be scaled, nor turned if it is by a compass."""
    straight = not compass or abs(np.angle(match.z)) < TURN_MATTERS
    return bool(straight and abs(abs(match.z) - 1) < SCALE_MATTERS)


def _other_coordinates(
    sketch: Sketch, course: Course, path: list[Plane], fixes: Fixes, now: Match, turns_right: bool
) -> Finding | None:
    """Return exchanged or mirrored coordinates, if the path then fits far better, or as well without a turn."""
    log, mirrored = sketch.log, course.match(path, fixes, p=fixes.p.conj())
    exchanged = _unexchanged(log, fixes)
    straight = None if exchanged is None else course.match(path, fixes, p=exchanged)
    if straight is not None and _explains(straight, now, fixes) and straight.rms_m < mirrored.rms_m:
        return _exchanged(log, fixes, now, straight)
    if _explains(mirrored, now, fixes):
        return _mirrored(log, fixes, now, mirrored, course.compass and turns_right)
    others = [each for each in (mirrored, straight) if each is not None and each.rms_m < now.rms_m / BETTER]
    if straight is not None and straight.rms_m < now.rms_m / BETTER and _is_plain(straight, course.compass):
        return _ambiguous(log, fixes, now)
    turn = float(np.angle(now.z))
    only_turned = abs(turn) > TURN_MATTERS and abs(abs(now.z) - 1) < SCALE_MATTERS and _off_the_truth(sketch) is None
    if others and now.rms_m < fixes.allowed_m and course.compass and only_turned:
        return _ambiguous(log, fixes, now)
    return None


def _ambiguous(log: Log, fixes: Fixes, now: Match) -> Finding:
    message = (
        f"The path by DVL and heading must be turned by {np.degrees(np.angle(now.z)):.0f}° and scaled by "
        f"{abs(now.z):.2f} to match the {_whose(log, fixes)}'s, or mirrored, which fits no worse: they are too "
        "straight to tell a hemisphere or exchanged coordinates from a turned heading or DVL."
    )
    return Finding(fixes.stream, message)


def heard_under_water(sketch: Sketch) -> list[Finding]:
    """Find fixes stamped while the depth sensor was under water, which another clock would put at the surface."""
    log = sketch.log
    heard = [fixes for fixes in fixes_of(sketch) if fixes.stream == "gps"]
    if not heard or log.depth is None or len(log.depth) < 30:
        return []
    (fixes,) = heard
    t_s, z = seconds(log, log.depth.t_ns), log.depth.z[:, 0]
    lags = np.arange(-LONGEST_S, LONGEST_S + 1, 1.0)
    deep = (np.interp(fixes.t_s - lags[:, None], t_s, z) < -DEEP_M).mean(axis=1)
    now, none = float(deep[len(lags) // 2]), np.flatnonzero(deep < SOME)
    if now < MANY or not len(none) or np.ptp(none) + 1 > len(none):
        return []
    late_s = float(lags[none].mean())
    message = (
        f"{now:.0%} of the fixes are stamped while the depth sensor is more than {DEEP_M:g} m under water, and none if "
        f"the stamps of the GPS are taken to be {abs(late_s):.0f} s {late_or_early(late_s)}."
    )
    return [Finding("gps", message, clock_fix("gps", late_s))]


def _explains(other: Match, now: Match, fixes: Fixes) -> bool:
    limit_m = min(BETTER * now.rms_m, 2 * fixes.allowed_m) if now.rms_m > fixes.allowed_m else ALONE * now.rms_m
    return other.rms_m < limit_m and abs(abs(other.z) - 1) < SCALE_MATTERS


def _whose(log: Log, fixes: Fixes) -> str:
    return "GPS" if fixes.stream == "gps" else log.truth_kind


def _path_of(fixes: Fixes) -> str:
    return "streams.gps" if fixes.stream == "gps" else "truth"


def _unexchanged(log: Log, fixes: Fixes) -> Plane | None:
    """Return the positions if latitude and longitude were exchanged, as the tangent plane then has them."""
    if log.origin is None:
        return None
    latitude, longitude = np.radians(log.origin)  # as read: the true longitude and latitude
    if abs(longitude) > np.pi / 2:
        return None
    return fixes.p.imag * np.cos(longitude) + 1j * fixes.p.real / max(np.cos(latitude), 1e-3)


def _exchanged(log: Log, fixes: Fixes, now: Match, then: Match) -> Finding:
    message = (
        f"The {_whose(log, fixes)}'s positions are {now.rms_m:.3g} m (rms) off the path by DVL and yaw, and "
        f"{then.rms_m:.2g} m with latitude and longitude exchanged: the two columns are swapped."
    )
    return Finding(fixes.stream, message, f"{_path_of(fixes)}.geodetic: exchange latitude and longitude")


def _mirrored(log: Log, fixes: Fixes, now: Match, then: Match, decided: bool) -> Finding:
    """Return a mirrored path: p* ≈ z x tells by z which way it is mirrored."""
    whose, path = _whose(log, fixes), _path_of(fixes)
    message = (
        f"The {whose}'s positions are {now.rms_m:.3g} m (rms) off the path by DVL and yaw, and {then.rms_m:.2g} m "
        "if mirrored: "
    )
    if not decided:
        message += "a sign of latitude or longitude (hemisphere S or W) is missing, or the yaw turns the wrong way."
        return Finding(fixes.stream, message)
    angle = float(np.angle(then.z))  # p = conj(z x): z = 1 mirrors north, −1 east, ±i exchanges the two
    if abs(angle) < SQUARE:
        message += "the positions are mirrored north to south: the sign of the latitude (hemisphere S) is missing."
        return Finding(fixes.stream, message, f"{path}: mirror latitude")
    if abs(abs(angle) - np.pi) < SQUARE:
        message += "the positions are mirrored east to west: the sign of the longitude (hemisphere W) is missing."
        return Finding(fixes.stream, message, f"{path}: mirror longitude")
    if abs(abs(angle) - np.pi / 2) < SQUARE:
        message += "east and north are exchanged."
        return Finding(fixes.stream, message, f"{path}.frame: NED  # or ENU, whichever it is not")
    message += "a sign of latitude or longitude (hemisphere S or W) is missing, and the yaw is turned as well."
    return Finding(fixes.stream, message)


def _in_earth_axes(sketch: Sketch, course: Course, fixes: Fixes, now: Match) -> Finding | None:
    """Find a DVL's velocity that is along east and north, or north and east, already."""
    assert sketch.velocity is not None
    v = sketch.velocity[0][:, 0] + 1j * sketch.velocity[0][:, 1]
    path = replace(course, v=v, yaw=np.zeros(len(v))).path()
    fits = [course.match(path, fixes, p=p) for p in (fixes.p, fixes.p.conj())]
    best = min(fits, key=lambda match: match.rms_m)
    if best.rms_m > min(BETTER * now.rms_m, fixes.allowed_m):
        return None
    message = (
        f"The path by DVL and heading is {now.rms_m:.3g} m (rms) off the {_whose(sketch.log, fixes)}'s positions, and "
        f"{best.rms_m:.2g} m if the DVL's velocity is not turned by the heading: it is along the Earth's axes, and not "
        "the body's."
    )
    return Finding("dvl", message)


def _far_off(log: Log, fixes: Fixes, now: Match) -> Finding:
    message = (
        f"The {_whose(log, fixes)}'s positions are {now.rms_m:.3g} m (rms) off the path by DVL and heading, however "
        f"that is turned and scaled; they reach {fixes.extent_m:.3g} m, and {fixes.sigma_m:.2g} m is stated. No single "
        "fault explains it."
    )
    return Finding(fixes.stream, message)


def _clock(sketch: Sketch, course: Course, path: list[Plane], fixes: Fixes, now: Match) -> Finding | None:
    """Return the clock that is off: that of the positions, or of the DVL; None if none explains it."""
    if now.rms_m < max(CLOCK_NOISES * fixes.sigma_m, CLOCK_DRIFT * fixes.extent_m):
        return None
    log, some = sketch.log, fixes.some(SEARCHED)
    lags = np.arange(-LONGEST_S, LONGEST_S + 1, 2.0)
    left = course.scan(path, some, lags)
    if course.compass and left.min() > ALONE * left[len(lags) // 2] and now.rms_m <= fixes.allowed_m:
        return None
    found = [(fixes.stream, *_searched(lambda late: course.match(path, fixes, late), lags, left))]
    if now.rms_m > fixes.allowed_m and course.compass:
        lags = np.arange(-LONGEST_S / 4, LONGEST_S / 4 + 1, 4.0)
        left = np.array([course.match(course.path(late), some).rms_m for late in lags])
        found.append(("dvl", *_searched(lambda late: course.match(course.path(late), fixes), lags, left)))
    stream, late_s, then = min(found, key=lambda each: each[2].rms_m * (1 if each[0] != "dvl" else 1 / ALONE))
    limit_m = ALONE * now.rms_m if now.rms_m < fixes.allowed_m else BETTER * now.rms_m
    if abs(late_s) < 2 * sketch.step_s or then.rms_m > min(max(limit_m, 1.5 * fixes.sigma_m), fixes.allowed_m):
        return None
    if abs(abs(then.z) - 1) > SCALE_MATTERS or (course.compass and abs(np.angle(then.z)) > 2 * TURN_MATTERS):
        return None
    who = "DVL" if stream == "dvl" else _whose(log, fixes)
    message = (
        f"The stamps of the {who} are {abs(late_s):.1f} s {late_or_early(late_s)}: with that the "
        f"positions of the {_whose(log, fixes)} are {then.rms_m:.2g} m (rms) off the path by DVL and yaw, and "
        f"{now.rms_m:.3g} m now."
    )
    if stream == "gps" and abs(abs(late_s) - LEAP_S) < 1:
        late_s = float(np.copysign(LEAP_S, late_s))
        message += f" GPS time and UTC differ by {LEAP_S} leap seconds."
    return Finding(stream, message, clock_fix(stream, late_s))


def _searched(match: Callable[[float], Match], lags: Array, left_m: Array) -> tuple[float, Match]:
    """Return the lag that leaves least, from what is left on a grid of lags, and by halving."""
    best_s, reach_s = float(lags[int(np.argmin(left_m))]), float(lags[1] - lags[0])
    while reach_s > 0.1:
        reach_s /= 2
        best_s = float(min((best_s, best_s - reach_s, best_s + reach_s), key=lambda lag: match(lag).rms_m))
    return best_s, match(best_s)


def _size_and_turn(sketch: Sketch, course: Course, fixes: Fixes, now: Match) -> list[Finding]:
    """Return a path of another length, or one that is turned."""
    log, whose, size = sketch.log, _whose(sketch.log, fixes), abs(now.z)
    if abs(size - 1) > SCALE_MATTERS:
        climb = climb_scale(sketch)
        if climb is not None and abs(climb - 1) < SCALE_MATTERS and not course.compass:
            return []  # its speed is right by its climbs, but a path that the gyro alone turns may bend
        near = [unit for unit, ratio in Speeds.units.items() if ratio != 1 and abs(size / ratio - 1) < 0.1]
        near += ["m/s"] if abs(size / 100 - 1) < 0.1 or abs(size / 1000 - 1) < 0.1 else []
        guess = f" That is the ratio of {near[0]} to what is stated." if near else ""
        message = f"The DVL's path must be scaled by {size:.4g} to be as long as the {whose}'s.{guess}"
        fix = f"streams.dvl.velocity.unit: {near[0]}" if near else f"streams.dvl.velocity.scale: {size:.4g}"
        if not near and climb is not None and abs(climb / size - 1) > 2 * SCALE_MATTERS:
            message += f" By the depth sensor its climb needs {climb:.3g}: other axes, or speeds along beams."
            fix = ""
        return [Finding("dvl", message, fix)]
    turn = float(np.angle(now.z))
    if not course.compass or abs(turn) < TURN_MATTERS:
        return []
    message = f"The path by DVL and heading must be turned by {np.degrees(turn):.0f}° counter-clockwise to match the "
    message += f"{whose}'s"
    culprit = turned(sketch, turn)
    if culprit == "dvl":
        assert log.dvl is not None
        all_axes = bool(np.isfinite(log.dvl.sigma).any(axis=0).all())
        right = 90 * round(np.degrees(turn) / 90)
        add = right if abs(np.degrees(turn) - right) < NEARLY_DEG else round(np.degrees(turn))
        fix = f"streams.dvl.mounting.yaw_deg: {add}  # added to the one there" if all_axes else ""
        message += ", and so must the DVL to match the accelerometers: its yaw on the vehicle."
        return [Finding("dvl", message, fix)]
    if culprit == "heading":
        add = np.degrees(turn)
        message += ", while DVL and accelerometers agree: declination, deviation or mounting of the heading sensor"
        message += ", or both signs of the positions." if abs(abs(turn) - np.pi) < SQUARE else "."
        fix = f"streams.heading.add_deg: {-add:.1f}  # convention: compass; with yaw {add:.1f}"
        return [Finding("heading", message, fix)]
    return [Finding("heading", message + ": the heading, or the DVL's yaw on the vehicle.")]


def turned(sketch: Sketch, turn: float) -> str:
    """Return whether "dvl" or "heading" is turned, by the accelerometers in turns and dives; "" if they cannot tell."""
    if sketch.velocity is None:
        return ""
    offset = _off_the_truth(sketch)
    if offset is not None:
        both = abs(np.angle(np.exp(1j * (offset + turn)))), abs(offset)
        return ("heading", "dvl")[int(np.argmin(both))] if min(both) < TURN_MATTERS / 2 else ""
    as_is, then = (agreement(sketch, hypotheses()[0], dvl_turn) for dvl_turn in (0.0, turn))
    return "dvl" if then > as_is + CLEARLY else "heading" if as_is > then + CLEARLY else ""


def _off_the_truth(sketch: Sketch) -> float | None:
    """Return the heading's yaw less the truth's (rad, on average); None where either is unknown, or they differ."""
    truth, found = sketch.truth_yaw, course_of(sketch)
    if truth is None or found is None:
        return None
    t_s, yaw, heard = truth
    if np.count_nonzero(heard) < FEWEST:
        return None
    mean = np.mean(np.exp(1j * (found[0].yaw - sketch.on_grid(t_s, yaw))[heard]))
    return float(np.angle(mean)) if abs(mean) > STEADY else None
