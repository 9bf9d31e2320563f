"""Wheel speed is a velocity sensor of one axis: all estimators ignore the others, whose values are arbitrary."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest
from driver import Driven, run_log
from fathom.datasets.epochs import DVL, IMU_SAMPLE, READING, Epoch
from fathom.datasets.state import VELOCITY
from fathom.estimators import create
from fathom.estimators.alignment.initialise import initialise
from fathom.estimators.graph.gtsam_border import carried_factor, reading_factor
from fathom.estimators.graph.losses import rows
from fathom.estimators.physics.imu import BLOCK, compile_rig
from fathom.estimators.physics.state import as_record
from logs import full, unmeasured

FLEET: dict[str, tuple[str, dict[str, Any]]] = {
    "eskf": ("eskf", {}),
    "eskf-filterpy": ("eskf-filterpy", {}),
    "iekf": ("iekf", {}),
    "ukf": ("ukf", {}),
    "rts": ("rts", {}),
    "fls": ("fls", {"lag_s": 3.0}),
    "fls robust": ("fls", {"lag_s": 3.0, "robust": {"dvl": "huber"}}),
    "fls loose": ("fls", {"lag_s": 3.0, "dvl": ["preintegrated-loose"]}),
    "fls tight": ("fls", {"lag_s": 3.0, "dvl": ["preintegrated-tight"]}),
    "fls-batch": ("fls-batch", {"lag_s": 1.0}),
    "window": ("window", {"lag_s": 3.0}),
    "window loose": ("window", {"lag_s": 3.0, "dvl": ["preintegrated-loose"]}),
    "isam2": ("isam2", {}),
    "batch": ("batch", {}),
}
RECKONERS: dict[str, tuple[str, dict[str, Any]]] = {
    "dead-reckoning": ("dead-reckoning", {}),
    "dead-reckoning gyro": ("dead-reckoning", {"attitude": "gyro"}),
}
EVERY = FLEET | RECKONERS
PATTERNS = ("wheel", "by rows")
FILTERS = ("eskf", "eskf-filterpy", "iekf", "ukf", "rts")
OTHERWISE = ("iekf", "fls robust", "fls loose", "fls tight", "window loose")
"""These linearise or weigh otherwise, or hear of a reading by its keyframe's end: the same within a sigma."""


def cases(labels: Collection[str], twice: Collection[str] = FILTERS) -> list[tuple[str, str]]:
    """Every label with a wheel, and the quick ones by rows as well."""
    return [(label, pattern) for pattern in PATTERNS for label in labels if pattern == "wheel" or label in twice]


@cache
def said(label: str, pattern: str, sigma: float = np.inf, z: float | None = 0.0) -> Driven:
    name, options = EVERY[label]
    result = run_log(unmeasured(pattern, sigma, z), create(name, **options), period_s=2.0)
    assert result.status == "done", result.cause
    return result


@pytest.mark.parametrize(("label", "pattern"), cases(EVERY))
def test_what_stands_in_an_axis_that_is_not_measured_has_no_influence(label, pattern):
    one, other = said(label, pattern), said(label, pattern, z=1e3)
    assert one.counts == other.counts
    for output, trajectory in one.outputs.items():
        for name in ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g", "P"):
            np.testing.assert_array_equal(getattr(trajectory, name), getattr(other.outputs[output], name))


@pytest.mark.parametrize(
    ("label", "pattern"),
    cases([label for label in FLEET if "loose" not in label and label not in ("fls tight", "fls robust")]),
)
def test_no_measurement_is_the_limit_of_a_poor_one(label, pattern):
    """But of a sum of velocities, in which a poor axis drowns the others; of a loss, whose width goes by the axes; and
    of dead reckoning, which uses every value that has a sigma."""
    none, poor = said(label, pattern), said(label, pattern, 1e6, None)
    for output, trajectory in none.outputs.items():
        other = poor.outputs[output]
        np.testing.assert_allclose(trajectory.p_WB_W, other.p_WB_W, atol=2e-4)
        np.testing.assert_allclose(trajectory.v_WB_W, other.v_WB_W, atol=2e-5)
        np.testing.assert_allclose(trajectory.R_WB, other.R_WB, atol=2e-5)
        known = np.isfinite(trajectory.P[:, 0, 0])
        variances = [np.einsum("nii->ni", t.P[known]) for t in (trajectory, other)]
        np.testing.assert_allclose(variances[0], variances[1], rtol=2e-3)


@pytest.mark.parametrize(
    ("label", "pattern"),
    cases([label for label in FLEET if label != "eskf"], ["eskf-filterpy", "iekf", "ukf", "rts", "fls", "isam2"]),
)
def test_the_fleet_agrees_about_one_axis(label, pattern):
    eskf, other = said("eskf", pattern).online, said(label, pattern).online
    sigma = np.sqrt(np.einsum("nii->ni", eskf.P))
    share = 1.0 if label in OTHERWISE else 0.5
    assert (np.abs(other.p_WB_W - eskf.p_WB_W) < share * sigma[:, 3:6]).all()
    assert (np.abs(other.v_WB_W - eskf.v_WB_W) < share * sigma[:, 6:9]).all()
    if label == "eskf-filterpy":
        np.testing.assert_allclose(other.p_WB_W, eskf.p_WB_W, atol=1e-6)


@pytest.mark.parametrize("label", ["eskf", "fls", "isam2"])
def test_the_axes_that_are_left_out_are_known_less(label):
    """Sideways and vertically the wheel says nothing; along it says what the DVL did."""
    sigma = {}
    name, options = FLEET[label]
    every = run_log(full(), create(name, **options), period_s=2.0)
    for result in (every, said(label, "wheel")):
        online = result.online
        cov_B = np.einsum("nji,njk,nkl->nil", online.R_WB, online.P[:, VELOCITY, VELOCITY], online.R_WB)
        sigma[result is every] = np.sqrt(np.median(np.einsum("nii->ni", cov_B)[-4:], axis=0))
    assert sigma[False][1] > 2.0 * sigma[True][1]
    assert sigma[False][0] < 3.0 * sigma[True][0]


def test_readings_with_an_axis_unmeasured_are_not_summed():
    summed = run_log(full(), create("batch", dvl=["preintegrated-loose"]))
    assert summed.counts["preintegrated"] > 90
    assert "not_summed" not in summed.counts
    one_by_one = run_log(unmeasured("wheel"), create("batch", dvl=["preintegrated-loose"]))
    velocities = run_log(unmeasured("wheel"), create("batch", keyframe_period_s=1.0))
    assert "preintegrated" not in one_by_one.counts
    assert one_by_one.counts["not_summed"] > 90
    np.testing.assert_allclose(one_by_one.smoothed.p_WB_W[:-2], velocities.smoothed.p_WB_W[:-2], atol=0.02)
    assert np.sqrt(one_by_one.smoothed.P[0, 3, 3]) > 0.2  # the last reading is of the interval that is never closed


@pytest.mark.parametrize("label", RECKONERS)
def test_dead_reckoning_goes_where_its_nose_points(label):
    online = said(label, "wheel").online
    v_B = np.einsum("nji,nj->ni", online.R_WB, online.v_WB_W)
    np.testing.assert_allclose(v_B[:, 1:], 0, atol=1e-12)
    assert v_B[:, 0].min() > 1.0


@pytest.mark.parametrize("name", ["eskf", "eskf-filterpy", "iekf", "ukf"])
def test_a_gate_is_as_wide_as_the_axes_that_are_measured(name):
    """A reading off by 3.7 sigma on x: of one axis it is beyond 99.9 %, of three it is not."""
    log, outliers = full(), []
    for sigma_yz in (np.inf, 0.02):
        v_B = log.prior.state.R_WB.T @ log.prior.state.v_WB_W
        cov_B = log.prior.state.R_WB.T @ log.prior.P[VELOCITY, VELOCITY] @ log.prior.state.R_WB
        reading = np.zeros(1, READING)
        reading["kind"], reading["t_ns"], reading["received_ns"] = DVL, log.prior.t_ns, log.prior.t_ns
        reading["sigma"] = [[0.02, sigma_yz, sigma_yz]]
        v_B[0] += 3.7 * np.sqrt(cov_B[0, 0] + 0.02**2)
        reading["z"][0, :3] = v_B
        run = create(name, gate={"dvl": 0.999}).begin(log.prior, log.rig)
        run.step(Epoch(log.prior.t_ns, np.zeros(0, IMU_SAMPLE), reading, False))
        outliers.append(run.counts["outliers_dvl"])
    assert outliers == [1, 0]


@pytest.mark.parametrize("carried", [False, True])
def test_a_loss_is_as_wide_as_the_axes_that_are_measured(carried):
    log = unmeasured("wheel")
    reading = np.zeros(1, READING)
    reading["kind"], reading["z"][0, :3], reading["sigma"] = DVL, log.dvl.z[0], log.dvl.sigma[0]
    rig, block = compile_rig(log.rig, frozenset({"dvl"}), {}), np.zeros(1, BLOCK)
    block["dR"], block["T"] = np.eye(3), 0.01
    factor = reading_factor(0, reading, rig)
    if carried:
        factor = carried_factor(0, reading, block, as_record(log.prior), rig)
    assert isinstance(factor, gtsam.CustomFactor)
    assert rows(factor) == 1


@pytest.mark.parametrize("without", [(), ("heading",)])
def test_the_start_leaves_them_out_too(without):
    start, other = (
        initialise(replace(unmeasured("wheel", z=z), prior=None, **dict.fromkeys(without))) for z in (0.0, 1e3)
    )
    np.testing.assert_array_equal(start.belief.P, other.belief.P)
    np.testing.assert_array_equal(start.belief.state.v_WB_W, other.belief.state.v_WB_W)
    x = start.belief.state
    cov_B = x.R_WB.T @ start.belief.P[VELOCITY, VELOCITY] @ x.R_WB
    assert np.sqrt(cov_B[1, 1]) > 0.3
    assert any("y, z of B not measured" in note for note in start.notes)
