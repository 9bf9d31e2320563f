"""A correction of many metres or degrees makes no smoother claim more than it knows.

Errors over independent seeds, at three epochs fixed beforehand that share the 0.001. Each regime is as short as it can
be and still tell: with GTSAM's IMU factor, or with a marginal prior that is normal in our own error, `window` has an
attitude NEES per degree of freedom of 5 after the fix, and of 10 and 34 at a heading known to 25° and 60°.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from driver import BLOCKS, summed_nees
from fathom.datasets import Belief, Log, NavState
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.state import POSITION, VELOCITY
from fathom.estimators import create
from fathom.estimators.physics.invariant import from_invariant
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

AFLOAT = Scenario(duration_s=46.0, surface_for_s=600.0, surface_every_s=1000.0, heading=None)
FIX = Scenario(duration_s=150.0, imu="tactical", surface_every_s=110.0, leg_m=40.0, dvl=None)


@cache
def a_fix_after_two_minutes_without_a_dvl(seed: int) -> Log:
    return simulate(FIX, 1000 + seed)


def started(seed: int, yaw_deg: float, in_body: bool) -> Log:
    """Afloat without a compass: the heading known to yaw_deg, the velocity to 5 cm/s in B or in W."""
    log, rng = simulate(AFLOAT, 7000 + seed), np.random.default_rng(seed)
    truth, noise, degree = log.truth.state(0), log.rig.imu_noise, np.radians(1.0)
    sigma = np.repeat([degree, 1.5, 0.05, noise.accel_bias_sigma, noise.gyro_bias_sigma], 3)
    sigma[2] = np.radians(yaw_deg)
    draw = sigma * rng.standard_normal(15)
    turn = Rotation.from_rotvec([0.0, 0.0, draw[2]]).as_matrix()
    R_WB = turn @ Rotation.from_rotvec([draw[0], draw[1], 0.0]).as_matrix() @ truth.R_WB
    v = truth.v_WB_W + draw[VELOCITY]
    x = NavState(R_WB, truth.p_WB_W + draw[POSITION], turn @ v if in_body else v, np.zeros(3), np.zeros(3))
    A = from_invariant(R_WB, x.v_WB_W if in_body else np.zeros(3))
    return log.with_prior(Belief(log.start_ns, x, A @ np.diag(sigma**2) @ A.T))


@cache
def heading_25(seed: int) -> Log:
    return started(seed, 25.0, in_body=True)


@cache
def heading_60(seed: int) -> Log:
    return started(seed, 60.0, in_body=True)


@cache
def heading_25_velocity_in_world(seed: int) -> Log:
    return started(seed, 25.0, in_body=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("regime", "name", "seeds", "times_s"),
    [
        (a_fix_after_two_minutes_without_a_dvl, "window", 16, (112, 124, 148)),
        (heading_25, "window", 16, (5, 20, 45)),
        (heading_60, "window", 16, (5, 20, 45)),
        (heading_25_velocity_in_world, "window", 16, (5, 20, 45)),
        (a_fix_after_two_minutes_without_a_dvl, "fls", 6, (112, 124, 148)),
        (heading_25, "fls", 6, (5, 20, 45)),
    ],
)
def test_errors_match_the_covariance_after_a_large_correction(
    regime: Callable[[int], Log], name: str, seeds: int, times_s: tuple[int, ...]
) -> None:
    factors = (
        {"depth", "gps", "heading"} if regime is a_fix_after_two_minutes_without_a_dvl else {"depth", "gps", "dvl"}
    )
    parts = {part: BLOCKS[part] for part in ("attitude", "position", "velocity")}
    total = summed_nees(create(name, factors=factors), map(regime, range(seeds)), times_s, parts)["online"]
    low, high = chi2.interval(1 - 0.001 / len(times_s), 3 * seeds)
    for part, sums in total.items():
        # while the heading is unknown a velocity lies on an arc: its NEES has the right mean, and heavier tails
        wide = np.array([2.0, 1.0, 1.0]) if part == "velocity" and regime in (heading_25, heading_60) else 1.0
        assert (low < sums).all(), (part, sums / (3 * seeds))
        assert (sums < wide * high).all(), (part, sums / (3 * seeds))
