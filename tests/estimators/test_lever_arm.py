"""A lever arm of 2 m and an IMU at 20 Hz: v_B is that of the moment, in every estimator."""

from __future__ import annotations

import numpy as np
import pytest
from driver import run_log
from fathom.datasets import Log, Scenario, simulate
from fathom.datasets.mounting import MountingSpec
from fathom.datasets.simulated.specs import DvlSpec, ImuSpec
from fathom.estimators import create

ARM_M = (2.0, 0.5, -0.4)


@pytest.fixture(scope="module")
def log() -> Log:
    """Without noise; a DVL whose readings fall between samples, and on them."""
    imu = ImuSpec("tactical", rate_hz=20.0, mounting=MountingSpec(ARM_M, roll_deg=180.0, pitch_deg=2.0, yaw_deg=87.0))
    steep = {"mission": "yo-yo", "depth_m": 15.0, "shallow_m": 3.0, "climb_deg": 35.0, "wobble_deg": 8.0}
    return simulate(Scenario(duration_s=40.0, imu=imu, dvl=DvlSpec(rate_hz=8.0), noise_scale=0.0, **steep), seed=1)


@pytest.mark.parametrize(
    ("name", "options"), [("eskf", {}), ("window", {"lag_s": 1.0}), ("fls", {"lag_s": 1.0}), ("rts", {})]
)
def test_velocity_does_not_lag_by_half_a_sample(log: Log, name: str, options: dict[str, float]) -> None:
    """The mean rate of the last sample would be alpha dt/2 behind: 9 mm/s here, and as much in every DVL reading."""
    rate, period_s = log.imu.w_WI_I @ log.rig.imu.R_BS.T, log.imu.period_ns * 1e-9
    lag = np.cross(0.5 * np.diff(rate, axis=0), log.rig.imu.p_BS_B)
    assert np.sqrt((lag**2).sum(axis=1).mean()) > 5e-3
    assert period_s == pytest.approx(0.05)
    result = run_log(log, create(name, **options), period_s=0.5)
    for track in result.outputs.values():
        _, i, j = np.intersect1d(log.truth.t_ns, track.t_ns, return_indices=True)
        off = track.v_WB_W[j] - log.truth.v_WB_W[i]
        assert np.sqrt((off**2).sum(axis=1).mean()) < 0.25 * np.sqrt((lag**2).sum(axis=1).mean())
