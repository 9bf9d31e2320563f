"""Over 50 seeds every estimator errs as much as its covariance says, at ten epochs fixed beforehand, online and after.

The mission is 60 s long, so that the whole of iSAM2 and Levenberg–Marquardt over 50 logs stays affordable, and small,
so that this holds everything: afloat with GPS, down, legs and turns (or dives and climbs) without it, up, and afloat
again. (With the usual 100 m legs and 20 m depth, lawnmower and yo-yo are one and the same straight dive for a minute.)
DVL and heading at 2.5 Hz halve the cost again, and put a depth reading between every two keyframes. Noise is what is
stated, priors are drawn.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from driver import BLOCKS, summed_nees
from fathom.datasets import Log
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, HeadingSpec
from fathom.estimators import ESTIMATORS, create
from scipy.stats import chi2

SEEDS = 50
EPOCHS_S = np.arange(3, 60, 6)
SMALL = {"depth_m": 5.0, "shallow_m": 1.0, "leg_m": 15.0, "turn_radius_m": 5.0, "surface_for_s": 20.0}
SENSORS = {"dvl": DvlSpec(2.5), "depth": DepthSpec(5.0), "heading": HeadingSpec(2.5)}
AT_EVERY_TICK = {"smoothed_covariance_s": 1e-3}


@cache
def mission(name: str, seed: int) -> Log:
    return simulate(Scenario(mission=name, duration_s=60.0, imu="tactical", **SMALL, **SENSORS), seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "path"),
    [(name, "lawnmower") for name in ("eskf", "iekf", "ukf", "rts", "fls", "batch")]
    + [(name, "yo-yo") for name in ("eskf", "iekf", "ukf", "rts")],
)
def test_anees_over_50_seeds_lies_in_its_interval(name: str, path: str) -> None:
    """Per output and part of the state, the 0.001 is shared among the epochs: errors are correlated over time."""
    known = ESTIMATORS[name].__dataclass_fields__
    estimator = create(name, **{key: value for key, value in AT_EVERY_TICK.items() if key in known})
    found = summed_nees(estimator, (mission(path, seed) for seed in range(SEEDS)), EPOCHS_S)
    assert list(found) == (["online", "smoothed"] if name in ("rts", "fls", "batch") else ["online"])
    for output, sums in found.items():
        for block, nees in sums.items():
            assert nees.shape == EPOCHS_S.shape
            dof = SEEDS * (BLOCKS[block].stop - BLOCKS[block].start)
            low, high = chi2.interval(1 - 0.001 / len(EPOCHS_S), dof)
            assert (low < nees).all(), (output, block, nees / dof, low / dof)
            assert (nees < high).all(), (output, block, nees / dof, high / dof)
