"""The splines are the truth; here their claims about one another are checked by differences."""

import numpy as np
import pytest
from fathom.datasets.mission import MISSIONS, fly
from fathom.datasets.motion import AFLOAT_M, Motion, rotations
from fathom.datasets.scenario import Scenario
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.parametrize("mission", MISSIONS)


def motion_of(mission: str, seed: int = 0, **values) -> Motion:
    return fly(Scenario(mission=mission, **values), np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_match_central_differences(mission, seed):
    motion = motion_of(mission, seed)
    t_s = np.random.default_rng(seed).uniform(0, 600, 400)
    step_s = 1e-3
    before, now, after = motion.at(t_s - step_s), motion.at(t_s), motion.at(t_s + step_s)
    turned = Rotation.from_matrix(before.R_WB.transpose(0, 2, 1) @ after.R_WB).as_rotvec()
    np.testing.assert_allclose(now.v_WB_W, (after.p_WB_W - before.p_WB_W) / (2 * step_s), atol=1e-6)
    np.testing.assert_allclose(now.a_WB_W, (after.v_WB_W - before.v_WB_W) / (2 * step_s), atol=1e-6)
    np.testing.assert_allclose(now.w_WB_B, turned / (2 * step_s), atol=1e-6)
    np.testing.assert_allclose(now.alpha_WB_B, (after.w_WB_B - before.w_WB_B) / (2 * step_s), atol=1e-6)
    assert np.abs(now.alpha_WB_B).max(axis=0).min() > 1e-2  # all of it was put to use


def test_rotations_are_yaw_pitch_roll(mission):
    t_s = np.linspace(0, 600, 50)
    angles = motion_of(mission).angles(t_s)
    np.testing.assert_allclose(
        rotations(angles), Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix(), rtol=0, atol=1e-14
    )


def test_the_nose_points_along_the_path_where_nothing_wobbles(mission):
    motion = motion_of(mission, wobble_deg=0.0)
    R_WB, _, v_WB_W = motion.pose(np.linspace(0, 600, 2000))
    nose_W = R_WB[:, :, 0]
    np.testing.assert_allclose(nose_W, v_WB_W / np.linalg.norm(v_WB_W, axis=1, keepdims=True), atol=1e-4)
    assert np.degrees(np.arcsin(nose_W[:, 2])).max() > 15  # it did climb, nose up
    assert R_WB[:, 2, 2].min() > 0.9


def test_a_turn_banks_into_itself(mission):
    motion = motion_of(mission, wobble_deg=0.0)
    t_s = np.linspace(0, 600, 2000)
    R_WB, w_WB_B, _ = motion.attitude(t_s)
    turning = np.abs(w_WB_B[:, 2]) > 0.1
    assert turning.any()
    assert (np.sign(R_WB[turning, 2, 1]) == -np.sign(w_WB_B[turning, 2])).all()  # to the left: the left side sinks


@pytest.mark.parametrize("duration_s", [20.0, 23.7, 60.0, 120.0, 600.0, 7200.0])
def test_starts_and_ends_afloat_and_dives_between(mission, duration_s):
    motion = motion_of(mission, duration_s=duration_s)
    t_s = np.linspace(0, duration_s, int(duration_s * 10) + 1)
    z_m = motion.position(t_s)[:, 2]
    np.testing.assert_allclose(motion.position(0.0), [0.0, 0.0, AFLOAT_M], rtol=0, atol=1e-12)
    assert abs(z_m[-1] - AFLOAT_M) < 1e-2
    assert z_m.max() < AFLOAT_M + 1e-3
    assert z_m.min() < AFLOAT_M - min(15.0, 0.04 * duration_s)
    assert z_m.min() > AFLOAT_M - 20.01
    speed_mps = np.linalg.norm(motion.velocity(t_s), axis=1)
    assert 1.4 < speed_mps.min() < speed_mps.max() < 1.6


def test_surfaces_at_intervals(mission):
    t_s = np.arange(0, 3600, 0.5)
    afloat = motion_of(mission, duration_s=3600).position(t_s)[:, 2] > AFLOAT_M - 0.05
    starts = t_s[1:][np.diff(afloat.astype(int)) == 1]
    lengths = t_s[1:][np.diff(afloat.astype(int)) == -1][1:] - starts[:-1]
    assert len(starts) == 13  # 3600 / 270, evenly, less the one it starts with
    assert ((lengths > 28) & (lengths < 40)).all()


def test_path_has_its_shape(mission):
    motion = motion_of(mission, wobble_deg=0.0, duration_s=1800)
    p_WB_W, course = motion.position(np.arange(0, 1800, 0.1)), motion.angles(np.arange(0, 1800, 0.1))[:, 2]
    straight = np.abs(np.gradient(course, 0.1)) < 1e-5
    if mission == "lawnmower":
        across_m = p_WB_W[straight] @ [-np.sin(np.pi / 6), np.cos(np.pi / 6), 0.0]
        lines = np.unique(np.round(across_m / 20))
        # smoothing cuts the corners of both ends of a turn by (σ ψ')² / 2 or 2.5 % of its radius
        spacing = [np.median(across_m[np.round(across_m / 20) == line]) for line in lines[:4]]
        np.testing.assert_allclose(np.diff(spacing), 20, atol=0.8)
        assert np.ptp(p_WB_W @ [np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0]) < 100 + 2 * 10 + 250  # it comes back
        assert len(lines) >= 15
    else:
        z_m = p_WB_W[:, 2]
        turns_up = (z_m[1:-1] < z_m[:-2]) & (z_m[1:-1] <= z_m[2:]) & (z_m[1:-1] < -10)
        assert turns_up.sum() > 15
        assert len(np.unique(np.round(np.degrees(course[straight])))) >= 4
