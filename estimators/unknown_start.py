"""Starts that an estimator cannot take: it linearises at the start, and an unknown heading or velocity is too far off.

Median NEES of attitude per degree of freedom, of a few simulated starts each:

- Heading unknown, with a DVL, the yaw off by its sigma, a compass after 15 s: at 45° 92 for `eskf`, and `rts` on it,
  129 for `ukf`, thousands for sums of the DVL; at 104° also 75 for `fls`, but 8 for `iekf`, whose error is exact for
  any yaw while the velocity in B is known, and 0.5 for `isam2` and `batch`, which relinearise everything. `window`,
  which carries its prior in such an error too, has 1.3 with GPS and no compass.
- Heading unknown, with GPS and no DVL: 2 for `eskf`, `ukf`, `window`, `isam2` and `batch`, hundreds for the others.
- Velocity unknown, of no axis: 1 for `eskf` and `ukf`, 5 for `isam2`, 15 to 65 for `fls`, `window` and an `iekf` whose
  group held the position; of `iekf` as it is, and `rts` on it, not measured.
"""

from __future__ import annotations

import math

import numpy as np

from ..datasets.state import THETA, VELOCITY, Belief
from .interface import Diverged

MOST_YAW_RAD = np.radians(45.0)
"""Beyond it a yaw is as good as unknown; compasses have up to 15°, headings by GPS 5°."""
MOST_VELOCITY_M_S = 1.0
"""Beyond it a vehicle that goes at 1.5 m/s may as well be at rest."""
INSTEAD = "state a `prior` in log.yaml, begin later by `from_s`, or use"


class StartError(ValueError):
    """An estimator cannot take the start that it is given; the message says what is unknown and what to do."""


def yaw_sigma_rad(belief: Belief) -> float:
    """Return the sigma of the yaw, rad."""
    up_B = belief.state.R_WB[2]
    return math.sqrt(max(float(up_B @ belief.P[THETA, THETA] @ up_B), 0.0))


def knows_heading(belief: Belief) -> bool:
    """Return whether the sigma of the yaw is not above MOST_YAW_RAD."""
    return not yaw_sigma_rad(belief) > MOST_YAW_RAD


def refuse_unknown_heading(belief: Belief) -> None:
    """Refuse to go on with an unknown heading.

    Raises:
        StartError: the heading is unknown.
    """
    if not knows_heading(belief):
        raise StartError(
            "the heading is unknown since the start, and this estimator cannot find it so: "
            f"{INSTEAD} window, isam2 or batch"
        )


def refuse_lost_heading(belief: Belief) -> None:
    """Refuse to sum the DVL from a keyframe on whose heading has been lost since the start.

    A sum ties two positions by the rotation of the first, and where that is at the marginal prior it is not linearised
    anew. Off by a radian, it throws the next position by tens of metres, which turn with the heading and are taken for
    knowledge of it: seconds later the estimate is gone. Relinearised, or by velocities one by one, it is not.

    Raises:
        Diverged: the heading is lost.
    """
    if not knows_heading(belief):
        raise Diverged(
            f"the heading is lost, its sigma is over {np.degrees(MOST_YAW_RAD):.0f}°, and a window cannot sum the DVL "
            "along it: aid the heading, or use `dvl: [velocity]`"
        )


def refuse_unknown_velocity(prior: Belief) -> None:
    """Refuse a start at which no axis of the velocity is known.

    Raises:
        StartError: all three have a sigma over MOST_VELOCITY_M_S.
    """
    P = prior.P[VELOCITY, VELOCITY]
    if np.isfinite(P).all() and np.linalg.eigvalsh(P)[0] > MOST_VELOCITY_M_S**2:
        raise StartError(
            f"the velocity at the start is unknown, and this estimator cannot find it so: {INSTEAD} isam2 or batch"
        )
