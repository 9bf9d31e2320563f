"""Over the whole log, factor graphs and a filter run backwards give one estimate."""

from __future__ import annotations

import math

import numpy as np
import pytest
from driver import run_log
from fathom.datasets import Trajectory
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import GpsSpec
from fathom.estimators import create


def gap_m(a: Trajectory, b: Trajectory) -> float:
    return float(np.linalg.norm(a.p_WB_W - b.p_WB_W, axis=1).max())


@pytest.mark.parametrize("mission", ["lawnmower", pytest.param("yo-yo", marks=pytest.mark.slow)])
def test_batch_and_rts_agree_in_state_and_in_covariance(mission: str) -> None:
    """A graph of factors solved by Levenberg–Marquardt, and a filter swept back: nothing shared but the physics."""
    small = {"depth_m": 5.0, "shallow_m": 1.0, "leg_m": 15.0, "turn_radius_m": 5.0, "surface_for_s": 20.0}
    log = simulate(Scenario(mission=mission, duration_s=60.0, imu="tactical", **small), seed=3)
    batch, rts = (run_log(log, create(name)).smoothed for name in ("batch", "rts"))
    assert math.isinf(batch.lookahead_s)
    assert gap_m(batch, rts) < 3e-3
    kept = np.isfinite(batch.P[:, 0, 0])
    ratio = np.sqrt(np.einsum("nii->ni", batch.P[kept]) / np.einsum("nii->ni", rts.P[kept]))
    assert kept.any()
    assert np.abs(ratio - 1).max() < 0.03  # GTSAM does not know that gyro noise moves B about a displaced IMU


@pytest.mark.slow
def test_isam2_ends_near_the_optimum_and_batch_does_not_depend_on_its_thresholds() -> None:
    log = simulate(Scenario(duration_s=60.0, imu="tactical"), seed=5)
    isam2, batch = (run_log(log, create(name)).smoothed for name in ("isam2", "batch"))
    coarse = run_log(log, create("batch", relinearize=[0.05, 100.0, 0.5, 10.0])).smoothed
    assert gap_m(isam2, batch) < 0.02
    assert gap_m(coarse, batch) < 1e-4


@pytest.mark.slow
def test_isam2_with_nothing_put_off_is_at_the_optimum_at_every_tick() -> None:
    """Thresholds of 0 and two more steps after each update: Levenberg–Marquardt's positions to 1e-3 mm."""
    log = simulate(Scenario(duration_s=60.0, imu="tactical"), seed=5)
    exact = {"lag_s": 100.0, "relinearize": [0, 0, 0, 0], "wildfire": 0, "extra_updates": 2}
    fls, batch = (run_log(log, create(n, keyframe_period_s=1.0, **o)) for n, o in (("fls", exact), ("batch", {})))
    assert fls.counts["keyframes"] == batch.counts["keyframes"]
    assert np.array_equal(fls.smoothed.t_ns, batch.smoothed.t_ns)
    assert gap_m(fls.smoothed, batch.smoothed) < 1e-6


def test_each_option_of_exactness_brings_isam2_nearer_to_the_optimum() -> None:
    log = simulate(Scenario(duration_s=20.0, imu="tactical"), seed=5)
    batch = run_log(log, create("batch", keyframe_period_s=1.0)).smoothed
    fine = {"relinearize": [1e-5, 1e-4, 1e-5, 1e-7]}
    each = ({}, fine, fine | {"wildfire": 0, "extra_updates": 2})
    gaps = [gap_m(run_log(log, create("isam2", keyframe_period_s=1.0, **o)).smoothed, batch) for o in each]
    assert gaps[0] > 2 * gaps[1] > 200 * gaps[2]
    stale = run_log(log, create("isam2", keyframe_period_s=1.0, wildfire=1.0)).smoothed
    assert gap_m(stale, batch) > 100 * gaps[0]


@pytest.mark.slow
def test_the_whole_log_is_more_accurate_than_a_lag_which_beats_no_lag() -> None:
    """Velocity, pooled over seeds."""
    squared = {"eskf": 0.0, "fls": 0.0, "batch": 0.0}
    for seed in range(4):
        log = simulate(Scenario(duration_s=60.0, imu="tactical"), seed=seed)
        rows = None
        for name in squared:
            result = run_log(log, create(name))
            estimate = result.smoothed or result.online
            rows = np.searchsorted(log.truth.t_ns, estimate.t_ns)
            squared[name] += np.square(estimate.v_WB_W - log.truth.v_WB_W[rows]).sum()
    assert squared["batch"] < 0.95 * squared["fls"]
    assert squared["fls"] < 0.8 * squared["eskf"]


def test_no_reading_is_too_late_for_the_whole_log() -> None:
    log = simulate(Scenario(duration_s=60.0, gps=GpsSpec(delay_s=20.0)), seed=1)
    result = run_log(log, create("isam2"))
    assert result.counts.get("late", 0) == 0
    assert result.counts["late_used"] > 10
