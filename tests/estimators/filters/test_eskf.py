"""The filter is exact where theory is, and indifferent to the order of arrival."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import run_log
from fathom.datasets import Belief, Log, NavState, Rig, Trajectory
from fathom.datasets.epochs import DEPTH, DVL, GPS, Epoch, cut
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DvlSpec, GpsSpec, HeadingSpec
from fathom.estimators import Diverged, create
from fathom.estimators.physics.elimination import decorrelate
from logs import until
from paths import NOISE, reading


def drive(log: Log, name: str = "eskf", **options: object) -> Belief:
    """The belief at the log's end."""
    run = create(name, **options).begin(log.prior, log.rig)
    for epoch in cut(log, log.imu.t_ns[-1:], create(name, **options).factors).epochs:
        run.step(epoch)
    return run.belief()


def still(t_s: float, readings: np.ndarray, dt_s: float = 0.01) -> Epoch:
    """An epoch of a vehicle at rest."""
    from fathom.datasets.epochs import IMU_SAMPLE

    imu = np.zeros(round(t_s / dt_s), IMU_SAMPLE)
    imu["dt_s"], imu["period_s"], imu["f_I"] = dt_s, dt_s, [0, 0, 9.81]
    imu["t_ns"] = np.round(np.arange(1, len(imu) + 1) * dt_s * 1e9)
    readings["t_ns"] = readings["received_ns"] = imu["t_ns"][-1]
    return Epoch(int(imu["t_ns"][-1]), imu, readings, False)


def test_one_linear_update_is_the_weighted_mean() -> None:
    """Position prior and a GPS fix, no motion: the closed form of two Gaussians."""
    prior = Belief(0, NavState(np.eye(3), *np.zeros((4, 3))), np.diag([1e-12] * 3 + [4.0] * 3 + [1e-12] * 9))
    run = create("eskf").begin(prior, Rig(NOISE))
    run.step(still(0.01, reading(GPS, np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, np.inf]))))
    assert run.belief().state.p_WB_W == pytest.approx([0.8, 1.0, 0.0], abs=1e-6)
    assert np.diag(run.belief().P)[3:6] == pytest.approx([0.8, 2.0, 4.0], rel=1e-6)


def test_readings_of_one_epoch_count_the_same_in_any_order() -> None:
    log = simulate(Scenario(duration_s=20.0), seed=3)
    rows = np.concatenate(
        [
            reading(DVL, np.array([1.0, 0.1, 0.0]), np.full(3, 0.01)),
            reading(DEPTH, np.array([-0.3]), np.array([0.02])),
            reading(GPS, np.array([1.0, 1.0, 0.0]), np.full(3, 1.5)),
        ]
    )
    ends = []
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        run = create("eskf").begin(replace(log.prior, t_ns=0), log.rig)
        run.step(still(0.5, rows[order]))
        ends.append(run.belief())
    for end in ends[1:]:
        assert np.abs(ends[0].state.local(end.state)).max() < 1e-10
        assert np.allclose(ends[0].P, end.P, rtol=1e-9, atol=1e-16)


def test_decorrelating_keeps_the_information() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3))
    r, H, C = rng.normal(size=3), rng.normal(size=(3, 15)), A @ A.T + np.eye(3)
    information, vector = H.T @ np.linalg.solve(C, H), H.T @ np.linalg.solve(C, r)
    decorrelate(3, r, H, C)
    weights = 1 / np.diag(C)
    assert np.allclose(H.T @ (weights[:, None] * H), information)
    assert np.allclose(H.T @ (weights * r), vector)


@pytest.mark.parametrize("delay_s", [0.05, 0.37, 2.0])
def test_a_late_reading_is_worth_what_it_would_have_been_in_time(delay_s: float) -> None:
    """The same log, once with everything in time and once with DVL, GPS and heading late: the same end."""
    scenario = Scenario(duration_s=40.0)
    late = replace(
        scenario,
        dvl=DvlSpec(delay_s=delay_s),
        gps=GpsSpec(delay_s=delay_s / 2),
        heading=HeadingSpec(delay_s=delay_s / 3),
    )
    in_time, delayed = simulate(scenario, seed=5), simulate(late, seed=5)
    last = int(delayed.imu.t_ns[-1] - delay_s * 1e9)
    a, b = drive(until(in_time, last)), drive(until(delayed, last))
    sigma = np.sqrt(np.diag(a.P))
    assert np.abs(a.state.local(b.state) / sigma).max() < 1e-3
    assert np.allclose(np.diag(b.P), np.diag(a.P), rtol=1e-3)


def test_a_reading_beyond_reach_is_counted_and_left_out() -> None:
    log = simulate(Scenario(duration_s=30.0, gps=GpsSpec(delay_s=3.0)), seed=5)
    result = run_log(log, create("eskf", max_delay_s=2.0))
    assert result.status == "done"
    without = run_log(replace(log, gps=None), create("eskf", max_delay_s=2.0))
    assert result.counts["late"] == np.count_nonzero(log.gps.received_ns <= log.imu.t_ns[-1])
    assert np.allclose(result.online.p_WB_W, without.online.p_WB_W, atol=1e-6)


def test_switching_a_sensor_off_equals_not_having_it() -> None:
    log = simulate(Scenario(duration_s=30.0), seed=5)
    off = drive(log, factors=frozenset({"dvl", "depth", "gps"}))
    absent = drive(replace(log, heading=None))
    assert np.array_equal(off.state.p_WB_W, absent.state.p_WB_W)
    assert not np.array_equal(drive(log).state.p_WB_W, absent.state.p_WB_W)


def test_a_covariance_that_is_none_is_called_diverged() -> None:
    prior = Belief(0, NavState(np.eye(3), *np.zeros((4, 3))), -np.eye(15))
    run = create("eskf").begin(prior, Rig(NOISE))
    with pytest.raises(Diverged, match="not positive"):
        run.step(still(0.01, reading(GPS, np.zeros(3), np.full(3, 0.1))))


def test_online_trajectory_is_asked_for_at_the_truths_own_times() -> None:
    log = simulate(Scenario(duration_s=20.0), seed=1)
    online = run_log(log, create("eskf")).online
    assert isinstance(online, Trajectory)
    assert np.isin(online.t_ns, log.truth.t_ns).all()
    assert online.lookahead_s == 0.0
