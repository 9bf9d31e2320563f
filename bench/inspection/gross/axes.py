"""Which axes of gyro and accelerometer are negated or exchanged, and by what the gyro must be scaled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np

from ....datasets.quantities import DEGREE
from ....datasets.state import Array
from ..findings.finding import Finding
from ..findings.fitting import Estimate
from ..streams.channels import seconds
from .relations import ROWS, Relation, likelihood
from .sketch import Sketch

SURELY = 20.0
"""Least gain in log likelihood that makes a finding: one in 10⁸ by chance, of 50 independent rows."""
ALIKE = 5.0
"""Hypotheses within this of the best, in log likelihood, are not told apart by what tilts and turns."""
UPRIGHT = np.cos(60 * DEGREE)
"""Least vertical part of the mean up in B: a vehicle travels more upright than this."""
KNOWN = 0.9
"""Least correlation for a scale to be read off: what is left of it moves a slope by some 10 %."""
SURE = 0.97
"""The same where nothing else says so: accelerations are then under 6 % of what changes the specific force."""
SCALE_MATTERS = 0.1
"""Relative, of a gross scale: gyros are calibrated to 1 %, and the acceleration in turns may feign some percent."""
CLEARLY = 5.0
"""Least difference in log likelihood by DVL and depth sensor to tell which axis is negated: one in 150."""
ALONE_MATTERS = 0.25
"""The same where the heading alone says so: a compass that deviates by 10° all around turns 17 % too far in places."""
UNIT_TOLERANCE = 0.3
"""Relative, of the ratio of degrees and radians."""
TILT, HEADING, TRUTH = "the accelerometer tilts", "the heading turns", "the truth turns"
ONE = np.eye(3)
"""What axes that are right are multiplied by."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One fault of the inertial sensors: what accelerometer (A) and gyro (G) must be multiplied by, in the IMU's axes.

    Attributes:
        heading, truth: −1 if the heading, or the truth's attitude, must be turned over instead, else 1.
    """

    A: Array
    G: Array
    heading: float = 1.0
    truth: float = 1.0

    @property
    def is_none(self) -> bool:
        """Whether nothing is wrong by it."""
        return bool((self.A == ONE).all() and (self.G == ONE).all() and min(self.heading, self.truth) > 0)

    def fits(self, tilt: Relation, by_heading: Relation | None, by_truth: Relation | None) -> float:
        """Return its log likelihood by what tilts and what turns."""
        of_turn = self.A.T @ self.G
        of_tilt = float(np.sign(np.linalg.det(self.A))) * of_turn
        return (
            likelihood(tilt, of_tilt)
            + likelihood(by_heading, self.heading * of_turn)
            + likelihood(by_truth, self.truth * of_turn)
        )


@cache
def hypotheses() -> tuple[Hypothesis, ...]:
    """Return every single fault, the commonest first."""
    flips = [np.diag(signs) for signs in sorted(product((1.0, -1.0), repeat=3), key=lambda s: (-sum(s), s))][1:]
    orders = [ONE[list(order)] for order in permutations(range(3))][1:]
    turned_over = [np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])]
    found = [Hypothesis(ONE, ONE), Hypothesis(ONE, ONE, heading=-1.0), Hypothesis(ONE, ONE, truth=-1.0)]
    found += [Hypothesis(one, one) for one in turned_over[:2]]
    found += [Hypothesis(one, one) for one in flips if one.sum() == 1]  # left-handed
    found += [Hypothesis(ONE, flip) for flip in flips] + [Hypothesis(flip, ONE) for flip in flips]
    swapped = [order @ flip for order in orders for flip in (ONE, *flips)]
    return (*found, *(Hypothesis(ONE, swap) for swap in swapped), *(Hypothesis(swap, ONE) for swap in swapped))


def is_upright(sketch: Sketch) -> bool:
    """Return whether B's z is about up on average."""
    up = sketch.up_B.mean(axis=0)
    return bool(up[2] > UPRIGHT * np.linalg.norm(up))


def best(
    sketch: Sketch, tilt: Relation, by_heading: Relation | None, by_truth: Relation | None
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses that explain the data about equally well; the one without a fault alone if it does."""
    R_BI, up_I = np.asarray(sketch.log.rig.imu.R_BS), sketch.up_I.mean(axis=0)
    none, relations = hypotheses()[0], (tilt, by_heading, by_truth)
    if is_upright(sketch) and none.fits(*relations) > most(*relations) - SURELY:
        return (none,)
    upright = [h for h in hypotheses() if (R_BI @ h.A @ up_I)[2] > UPRIGHT * np.linalg.norm(up_I)]
    fits = np.array([h.fits(tilt, by_heading, by_truth) for h in upright])
    if not upright:
        return (none,)
    sideways = abs((R_BI @ up_I)[2]) <= UPRIGHT * np.linalg.norm(up_I)  # a mounting explains that as well
    if (upright[0].is_none or sideways) and fits.max() < none.fits(*relations) + SURELY:
        return (none,)
    return tuple(h for h, fit in zip(upright, fits, strict=True) if fit > fits.max() - ALIKE)


def most(*relations: Relation | None) -> float:
    """Return an upper bound on the log likelihood of any hypothesis: each relation by its own best Q."""
    total = 0.0
    for relation in relations:
        if relation is not None and relation.n >= 10:
            free = np.linalg.lstsq(relation.XX, relation.Xy, rcond=1e-9)[0]
            total += likelihood(relation, np.asarray(free, np.float64).reshape(3, 3))
    return total


def told_apart(sketch: Sketch, alike: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return those of the hypotheses that the motion by DVL and depth sensor agrees with best."""
    scores = [agreement(sketch, each) for each in alike]
    return [each for each, score in zip(alike, scores, strict=True) if score > max(scores) - CLEARLY]


def agreement(sketch: Sketch, each: Hypothesis, dvl_turn: float = 0.0) -> float:
    """Return the log likelihood of what DVL and depth sensor say of the motion, by the accelerometer.

    A depth changes by the vertical part of the velocity; in a turn a vehicle is pushed sideways by v × yaw rate. The
    velocity is the DVL's, turned by `dvl_turn` rad about B's z.
    """
    motion, log = sketch.velocity, sketch.log
    if motion is None:
        return 0.0
    c, s = np.cos(dvl_turn), np.sin(dvl_turn)
    v_B, heard = motion[0] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), motion[1]
    f_B = sketch.f_I @ each.A.T @ np.asarray(log.rig.imu.R_BS).T
    rate = np.einsum("ni,ni->n", sketch.up_I @ each.A.T, sketch.w_I @ each.G.T)
    score = _explained(f_B[heard, 1], (v_B[:, 0] * rate)[heard])
    if log.depth is not None and len(log.depth) >= 30:
        z = sketch.on_grid(seconds(log, log.depth.t_ns), log.depth.z[:, 0])
        up = f_B / np.maximum(np.linalg.norm(f_B, axis=1, keepdims=True), 1e-9)
        score += _explained(np.gradient(z, sketch.t_s)[heard], np.einsum("ni,ni->n", up, v_B)[heard])
    return score


def _explained(measured: Array, predicted: Array) -> float:
    """Return the log likelihood of measured − predicted, over that of the measured alone; not below zero."""
    if len(measured) < 10 or measured.std() == 0:
        return 0.0
    left = min(float(np.var(measured - predicted) / np.var(measured)), 1.0)  # a vehicle that banks shows nothing
    return -0.5 * min(len(measured), ROWS) * float(np.log(max(left, 0.02)))


def axes_findings(sketch: Sketch, alike: Sequence[Hypothesis]) -> list[Finding]:
    """Return what is wrong with the axes, by the hypotheses that explain the data best."""
    if alike[0].is_none:
        return []
    left = told_apart(sketch, alike) if len(alike) > 1 else list(alike)
    each = left[0]
    over = _turned_over(sketch, each)
    if len(left) > 1 and not over:
        listed = "; or ".join(dict.fromkeys(_said(h) for h in left[:6]))
        return [Finding("imu", f"The axes of gyro and accelerometer do not fit each other: {listed}.")]
    if each.heading < 0:
        message = (
            "The heading turns against the gyro, which agrees with the accelerometer: a compass is read as a yaw, "
        )
        fix = "streams.heading.convention: yaw  # or compass, whichever it is not"
        return [Finding("heading", message + "or a yaw as a compass.", fix)]
    if each.truth < 0:
        message = (
            f"The attitude of the {sketch.log.truth_kind} turns against the gyro: it takes the world's axes to the "
        )
        return [Finding("truth", message + "body's, and not the body's to the world's.")]
    if over:
        message = "The specific force points down in the body (mean f along −z): z is down in these axes, not up."
        return [Finding("imu", message, over)]
    return [Finding("imu", f"{_because(each)}: {_said(each)}.", "\n".join(_fixes(each)))]


def _turned_over(sketch: Sketch, each: Hypothesis) -> str:
    """Return the fix if the IMU as a whole is upside down, else nothing."""
    if (each.A != each.G).any() or np.linalg.det(each.A) < 0 or (each.A == ONE).all():
        return ""
    return "streams.imu.axes: FRD  # or FLU, whichever it is not"


def _said(each: Hypothesis) -> str:
    """Return a hypothesis in words."""
    if min(each.heading, each.truth) < 0:
        return f"the {'heading' if each.heading < 0 else 'truth'} is turned over"
    if (each.A == each.G).all():
        axis = "xyz"[int(np.argmin(np.diag(each.A)))]
        return f"axis {axis} of both is negated, so the IMU is left-handed"
    name, M = ("gyro", each.G) if (each.A == ONE).all() else ("accelerometer", each.A)
    if (np.abs(M) == ONE).all():
        axes = [axis for axis, sign in zip("xyz", np.diag(M), strict=True) if sign < 0]
        if len(axes) == 3:
            return f"the sign of the {name} is wrong"
        return f"{' and '.join(axes)} of the {name} {'is' if len(axes) == 1 else 'are'} negated"
    order = ", ".join(("−" if row.sum() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in M)
    return f"the axes of the {name} must be read as ({order})"


def _because(each: Hypothesis) -> str:
    against = (each.A == each.G).all() or (each.G == -ONE).all()
    return "f tilts against the gyro" if against else "f tilts as the gyro does not say"


def _fixes(each: Hypothesis) -> list[str]:
    """Return the keys that undo a hypothesis: factors for signs, columns in another order."""
    lines = []
    for name, M in (("gyro", each.G), ("accel", each.A)):
        if (M == ONE).all():
            continue
        order = [int(np.argmax(np.abs(row))) for row in M]
        if order != [0, 1, 2]:
            lines.append(f"streams.imu.{name}.columns: {order}  # of the columns there")
        signs = M.sum(axis=1)
        if (signs < 0).any():
            lines.append(f"streams.imu.{name}.scale: [{', '.join(f'{sign:g}' for sign in signs)}]")
    return lines


def scale_findings(
    tilt: Relation, by_heading: Relation | None, by_truth: Relation | None, up: int, heading_right: bool
) -> list[Finding]:
    """Return what is wrong with the gyro's scale, its axes being right: two witnesses must agree on it.

    Args:
        tilt, by_heading, by_truth: what tilts and turns.
        up: which axis of the IMU is about vertical.
        heading_right: whether positions agree with a path by the heading.
    """
    every = {TILT: tilt, HEADING: by_heading, TRUTH: by_truth}
    slopes = {
        name: relation.slope(ONE)
        for name, relation in every.items()
        if relation is not None and relation.n >= 10 and relation.correlation(ONE) > KNOWN
    }
    off = {name: slope for name, slope in slopes.items() if _is_off(slope, SCALE_MATTERS)}
    if not off:
        return []
    listed = " and ".join(f"{name} {slope.text()} times as far" for name, slope in off.items())
    message = f"{listed[0].upper()}{listed[1:]} as the gyro"
    if list(off) == [HEADING] and abs(slopes[HEADING].value * DEGREE - 1) < UNIT_TOLERANCE and len(slopes) > 1:
        return [Finding("heading", message + ": degrees are read as radians.", "streams.heading.heading.unit: deg")]
    agreed = [a for a in off.values() if sum(abs(b.value / a.value - 1) < SCALE_MATTERS for b in off.values()) > 1]
    turns = [slopes[name].value for name in (HEADING, TRUTH) if name in off]
    if TILT not in off and HEADING in off and (len(agreed) > 1 or (heading_right and TRUTH not in slopes)):
        scales = [f"{turns[0]:.4g}" if axis == up else "1" for axis in range(3)]
        message += f": the scale of the gyro's {'xyz'[up]} axis, which is about vertical, is off."
        return [Finding("imu", message, f"streams.imu.gyro.scale: [{', '.join(scales)}]")]
    if list(slopes) == [TILT] and tilt.correlation(ONE) > SURE and _is_off(slopes[TILT], ALONE_MATTERS):
        agreed = [slopes[TILT]]
    elif len(agreed) < len(slopes) or len(agreed) < 2:
        if list(off) != [HEADING] or TRUTH in slopes or not _is_off(off[HEADING], ALONE_MATTERS):
            return []  # motion, or a truth of its own, may feign it
        return [Finding("imu", message + ": the scale of the gyro's vertical axis, or that of the heading, is off.")]
    scale = float(np.average([e.value for e in agreed], weights=[1 / max(e.sigma, 1e-6) for e in agreed]))
    for ratio, unit in ((DEGREE, "deg/s"), (1 / DEGREE, "rad/s")):
        if abs(scale / ratio - 1) < UNIT_TOLERANCE:
            message += f", the ratio of degrees and radians: the gyro is in {unit}."
            return [Finding("imu", message, f"streams.imu.gyro.unit: {unit}")]
    return [Finding("imu", message + ": the gyro's scale is off.", f"streams.imu.gyro.scale: {scale:.4g}")]


def _is_off(slope: Estimate, by: float) -> bool:
    return abs(slope.value - 1) > by and slope.differs(1.0, by)
