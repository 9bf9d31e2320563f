"""The belief at the start of a simulated log: its mean is off by a draw of what its covariance states."""

import dataclasses
import math

import numpy as np
import pytest
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import draw_prior
from fathom.datasets.simulated.specs import PriorSpec
from fathom.datasets.state import Belief, NavState
from fathom.datasets.trajectory import Trajectory
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from variances import assert_variance

UNKNOWN_HEADING = PriorSpec(attitude_deg=1, heading_deg=40, velocity_in="B")


def of_prior(prior: PriorSpec, seed: int) -> tuple[Belief, NavState]:
    """A belief at the start, and the true state there: level enough, but turned and pitched."""
    R_WB = Rotation.from_euler("ZYX", [130, 25, -10], degrees=True).as_matrix()
    v_WB_W = R_WB @ [1.5, 0.1, -0.2]
    truth = Trajectory(
        np.array([5]), R_WB[None], np.ones((1, 3)), v_WB_W[None], np.full((1, 3), 1e-2), np.zeros((1, 3))
    )
    return draw_prior(Scenario(prior=prior), truth, seed), truth.state(0)


def test_an_unknown_heading_turns_attitude_and_velocity_by_the_stated_covariance():
    """In the coordinates of the knowledge (rotation in W, velocity in B) the draws are Gaussian at any angle."""
    seeds = range(400)
    draws = []
    for seed in seeds:
        belief, true = of_prior(UNKNOWN_HEADING, seed)
        mean = belief.state
        turned = Rotation.from_matrix(true.R_WB @ mean.R_WB.T).as_rotvec()
        ahead = true.R_WB.T @ true.v_WB_W - mean.R_WB.T @ mean.v_WB_W
        draws.append([*turned / np.radians([1, 1, 40]), *(true.p_WB_W - mean.p_WB_W) / 1.0, *ahead / 0.05])
    columns = np.array(draws).T
    for column in columns:
        assert_variance(column, 1.0)
    off = np.corrcoef(columns)[np.triu_indices(9, 1)]
    assert np.abs(off).max() < 4.5 / math.sqrt(len(seeds))  # sigma of each of 36 is 1/√400


def test_of_a_small_heading_error_the_stated_covariance_is_that_of_the_errors():
    """Its cross terms too: at small angles NEES of all is chi-square; at 40° only attitude's is, by construction."""
    prior = PriorSpec(attitude_deg=0.01, heading_deg=0.5, velocity_m_s=0.05, velocity_in="B")
    small = [(belief.state.local(true), belief.P) for belief, true in (of_prior(prior, seed) for seed in range(200))]
    sizes = [e[:9] @ np.linalg.solve(P[:9, :9], e[:9]) for e, P in small]
    low, high = chi2.interval(0.999, 9 * len(sizes))
    assert low < sum(sizes) < high
    large = [
        (belief.state.local(true), belief.P) for belief, true in (of_prior(UNKNOWN_HEADING, s) for s in range(200))
    ]
    sizes = [e[:3] @ np.linalg.solve(P[:3, :3], e[:3]) for e, P in large]
    low, high = chi2.interval(0.999, 3 * len(sizes))
    assert low < sum(sizes) < high


def test_a_start_without_a_heading_knows_its_speed_and_not_whereto():
    """Closed form: level and running along its x axis at 1.5 m/s, a yaw error moves the velocity sideways alone."""
    yaw = Rotation.from_euler("Z", 40, degrees=True).as_matrix()
    truth = Trajectory(np.array([0]), yaw[None], np.zeros((1, 3)), (yaw @ [1.5, 0, 0])[None], *np.zeros((2, 1, 3)))
    scenario = Scenario(prior=PriorSpec(attitude_deg=1, heading_deg=10, velocity_in="B"), noise_scale=0)
    P = draw_prior(scenario, truth, 1).P
    theta, along, across = np.radians([1, 1, 10]), yaw[:, 0], yaw[:, 1]
    np.testing.assert_allclose(P[:3, :3], np.diag(theta**2), atol=1e-16)
    V = P[6:9, 6:9]
    assert along @ V @ along == pytest.approx(0.05**2)
    assert across @ V @ across == pytest.approx(0.05**2 + (1.5 * theta[2]) ** 2)
    assert V[2, 2] == pytest.approx(0.05**2 + (1.5 * theta[1]) ** 2)
    assert across @ P[6:9, 2] == pytest.approx(1.5 * theta[2] ** 2)  # to the left, for a turn to the left
    assert np.linalg.eigvalsh(P)[0] > 0


@pytest.mark.parametrize("degrees", [0, 30, 180])
def test_an_attitude_can_be_wrong_by_a_stated_angle_whatever_its_sigma(degrees: float):
    axes = []
    for seed in range(20):
        prior = PriorSpec(attitude_deg=2, wrong_by_deg=degrees)
        belief, true = of_prior(prior, seed)
        drawn, _ = of_prior(dataclasses.replace(prior, wrong_by_deg=None), seed)
        turned = Rotation.from_matrix(true.R_WB @ belief.state.R_WB.T)
        assert np.degrees(turned.magnitude()) == pytest.approx(degrees, abs=1e-6)
        assert np.array_equal(belief.P, drawn.P)
        assert np.array_equal(belief.state.p_WB_W, drawn.state.p_WB_W)
        axes.append(turned.as_rotvec())
    if 0 < degrees < 180:
        assert (np.abs(np.mean(axes, axis=0)) < 4 * np.radians(degrees) / math.sqrt(3 * 20)).all()
        assert (np.ptp(axes, axis=0) > np.radians(degrees)).all()  # of axes all over the sphere
