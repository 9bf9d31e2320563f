"""Dead reckoning follows what its sensors say, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import matched, run_log
from fathom.datasets import Log
from fathom.datasets.log import AttitudeStream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, HeadingSpec
from fathom.estimators import create

FAST = Scenario(
    duration_s=60.0,
    noise_scale=0.0,
    dvl=DvlSpec(rate_hz=50),
    depth=DepthSpec(rate_hz=50),
    heading=HeadingSpec(rate_hz=50),
)


def with_full_attitude(log: Log) -> Log:
    rows = np.searchsorted(log.truth.t_ns, log.heading.t_ns)
    R_WH = log.truth.R_WB[rows] @ log.rig.heading.R_BS
    sigma = np.full((len(rows), 3), 0.01)
    return replace(log, heading=AttitudeStream(log.heading.t_ns, log.heading.received_ns, R_WH.reshape(-1, 9), sigma))


@pytest.mark.parametrize("attitude", ["gyro", "heading"])
def test_without_noise_it_comes_home(attitude: str) -> None:
    """From the gyro, or from a sensor of the full attitude; what is left is the holding of readings for 20 ms."""
    log = with_full_attitude(simulate(FAST, seed=1))
    online = run_log(log, create("dead-reckoning", attitude=attitude)).online
    assert np.linalg.norm(online.p_WB_W - matched(log.truth, online).p_WB_W, axis=1).max() < 0.1


def test_a_heading_alone_leaves_roll_and_pitch_level() -> None:
    log = simulate(FAST, seed=1)
    online = run_log(log, create("dead-reckoning")).online
    assert np.allclose(online.R_WB[:, 2, 2], 1.0, atol=1e-12)
    rows = np.searchsorted(log.truth.t_ns, online.t_ns)
    yaw = [np.arctan2(R[:, 1, 0], R[:, 0, 0]) for R in (online.R_WB, log.truth.R_WB[rows])]
    # a level vehicle and a pitching one give the heading sensor, which is mounted askew, slightly different yaws
    assert np.abs(np.angle(np.exp(1j * (yaw[0] - yaw[1])))).max() < np.radians(2.0)


def test_it_keeps_no_covariance_and_has_no_smoothed_states() -> None:
    result = run_log(simulate(replace(FAST, duration_s=20.0), seed=1), create("dead-reckoning"))
    assert result.online.P is None
    assert result.smoothed is None


def test_without_a_dvl_it_stands_still() -> None:
    log = simulate(replace(FAST, duration_s=20.0, depth=None), seed=1)
    log = replace(log, prior=replace(log.prior, state=replace(log.prior.state, v_WB_W=np.zeros(3))))
    online = run_log(log, create("dead-reckoning", factors=["heading"])).online
    assert np.allclose(online.p_WB_W, log.prior.state.p_WB_W)


def test_older_readings_than_the_newest_are_counted_not_used() -> None:
    log = simulate(replace(FAST, duration_s=20.0), seed=1)
    received = log.dvl.received_ns.copy()
    received[10] += 500_000_000
    late = replace(log, dvl=replace(log.dvl, received_ns=received))
    result = run_log(late, create("dead-reckoning"))
    assert result.counts["late"] == 1
