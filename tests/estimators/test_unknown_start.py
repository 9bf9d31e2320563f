"""Estimators refuse a start that they cannot take, and no other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from driver import run_log
from fathom.datasets import Belief, Log
from fathom.datasets.log import DvlStream, ImuStream
from fathom.datasets.rig import Rig
from fathom.datasets.simulated.imu_grades import IMU_GRADES
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.state import THETA, VELOCITY, NavState
from fathom.estimators import create
from fathom.estimators.unknown_start import StartError

GRAVITY = 9.81
LOST_RAD = np.pi / np.sqrt(3)


@pytest.fixture(scope="module")
def log() -> Log:
    """The first four seconds of a dive."""
    whole = simulate(Scenario(duration_s=20.0), seed=1)
    return replace(whole, imu=ImuStream(*(part[:400] for part in (whole.imu.t_ns, whole.imu.w_WI_I, whole.imu.f_I))))


def lost(log: Log) -> Log:
    """The log with a prior whose yaw is unknown, and with it the direction of the velocity."""
    assert log.prior is not None
    up_B, P = log.prior.state.R_WB[2], log.prior.P.copy()
    P[THETA, THETA] += LOST_RAD**2 * np.outer(up_B, up_B)
    v = log.prior.state.v_WB_W
    across = np.array([-v[1], v[0], 0.0])
    P[VELOCITY, VELOCITY] += LOST_RAD**2 * np.outer(across, across)
    P[THETA, VELOCITY] += LOST_RAD**2 * np.outer(up_B, across)
    P[VELOCITY, THETA] += LOST_RAD**2 * np.outer(across, up_B)
    return log.with_prior(replace(log.prior, P=P))


def still_unknown(log: Log) -> Log:
    """The log with a prior whose velocity is unknown."""
    assert log.prior is not None
    P = log.prior.P.copy()
    P[VELOCITY, VELOCITY] += 1.5**2 * np.eye(3)
    return log.with_prior(replace(log.prior, P=P))


WITH_DVL = ["eskf", "eskf-filterpy", "ukf", "fls", "fls-batch"]


@pytest.mark.parametrize(("name", "options"), [(name, {}) for name in WITH_DVL] + [("rts", {"filter": "eskf"})])
def test_a_velocity_in_the_body_is_refused_while_the_heading_is_unknown(
    log: Log, name: str, options: dict[str, Any]
) -> None:
    with pytest.raises(StartError, match=r"heading is unknown.*`prior`.*`from_s`"):
        run_log(replace(lost(log), heading=None), create(name, **options))


@pytest.mark.parametrize(
    ("name", "options"),
    [("iekf", {}), ("rts", {}), ("isam2", {}), ("window", {}), ("batch", {"engine": "window"}), ("dead-reckoning", {})],
)
def test_estimators_that_hold_for_any_yaw_take_an_unknown_heading(log: Log, name: str, options: dict[str, Any]) -> None:
    assert run_log(replace(lost(log), heading=None), create(name, **options)).online is not None


def test_sums_of_the_dvl_need_a_heading_on_every_solver(log: Log) -> None:
    for name, options in (("isam2", {}), ("batch", {}), ("batch", {"engine": "window"}), ("window", {})):
        with pytest.raises(StartError, match="heading"):
            run_log(lost(log), create(name, dvl=["preintegrated-loose"], **options))


@pytest.mark.parametrize("name", ["window", "fls"])
def test_a_window_does_not_sum_the_dvl_along_a_heading_that_is_lost_on_the_way(name: str) -> None:
    """At rest, where nothing tells a gyro bias about the vertical from a turn, known to 0.05 rad/s: 45° in 16 s."""
    imu_ns, dvl_ns = 10_000_000 * np.arange(1, 2501), 200_000_000 * np.arange(1, 126)
    f_I, still = np.tile([0.0, 0.0, GRAVITY], (len(imu_ns), 1)), np.zeros((len(dvl_ns), 3))
    sigma = np.repeat([1e-3, 1e-3, 0.1, 1e-2, 0.05], 3)
    prior = Belief(0, NavState(np.eye(3), *np.zeros((4, 3))), np.diag(sigma**2))
    imu, dvl = ImuStream(imu_ns, 0 * f_I, f_I), DvlStream(dvl_ns, dvl_ns, still, np.full_like(still, 0.01))
    log = Log("at rest", Rig(IMU_GRADES["consumer"], gravity=GRAVITY), imu, dvl, prior=prior)
    options: dict[str, Any] = {"factors": ["dvl"], "keyframe_period_s": 1.0}
    refused = run_log(log, create(name, dvl=["preintegrated-loose"], **options))
    assert refused.status == "diverged"
    assert refused.failed_at_s == pytest.approx(16.7, abs=2.0)
    assert "heading is lost, its sigma is over 45°" in str(refused.cause)
    assert "`dvl: [velocity]`" in str(refused.cause)
    assert run_log(log, create(name, **options)).status == "done"


@pytest.mark.parametrize("name", ["eskf", "ukf"])
def test_a_filter_takes_gps_while_the_heading_is_unknown(log: Log, name: str) -> None:
    assert run_log(replace(lost(log), heading=None, dvl=None), create(name)).online is not None
    assert run_log(replace(lost(log), heading=None), create(name, factors=["gps", "depth"])).online is not None


def test_a_heading_before_the_dvl_makes_the_start_a_known_one(log: Log) -> None:
    assert log.heading is not None
    assert log.dvl is not None
    after = log.dvl.t_ns > log.heading.received_ns[0]
    dvl = type(log.dvl)(log.dvl.t_ns[after], log.dvl.received_ns[after], log.dvl.z[after], log.dvl.sigma[after])
    assert run_log(replace(lost(log), dvl=dvl), create("eskf")).online is not None


@pytest.mark.parametrize(("name", "takes"), [("eskf", True), ("iekf", False), ("fls", False), ("window", False)])
def test_an_unknown_velocity_is_refused_by_those_that_linearise_at_it(log: Log, name: str, takes: bool) -> None:
    blind = replace(still_unknown(log), dvl=None)
    if takes:
        assert run_log(blind, create(name)).online is not None
        return
    with pytest.raises(StartError, match="velocity at the start is unknown"):
        run_log(blind, create(name))
