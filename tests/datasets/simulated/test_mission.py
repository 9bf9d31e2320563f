"""The splines are the truth; here their claims about one another are checked by differences."""

import numpy as np
import pytest
from fathom.datasets.simulated.missions import climb_angle, draw
from fathom.datasets.simulated.motion import AFLOAT_M, Motion, rotations
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.specs import MISSIONS
from scipy.spatial.transform import Rotation

every_mission = pytest.mark.parametrize("mission", MISSIONS)


def only(mission: str):
    """Claims about one mission."""
    return pytest.mark.parametrize("mission", [mission])


def motion_of(mission: str, seed: int = 0, **values) -> Motion:
    return draw(Scenario(mission=mission, **values), np.random.default_rng(seed))


@every_mission
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


@every_mission
def test_rotations_are_yaw_pitch_roll(mission):
    t_s = np.linspace(0, 600, 50)
    angles = motion_of(mission).angles(t_s)
    np.testing.assert_allclose(
        rotations(angles), Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix(), rtol=0, atol=1e-14
    )


@every_mission
def test_the_nose_points_along_the_path_where_nothing_wobbles(mission):
    motion = motion_of(mission, wobble_deg=0.0)
    R_WB, _, v_WB_W = motion.pose(np.linspace(0, 600, 2000))
    nose_W = R_WB[:, :, 0]
    np.testing.assert_allclose(nose_W, v_WB_W / np.linalg.norm(v_WB_W, axis=1, keepdims=True), atol=1e-4)
    climb = climb_angle(Scenario(), MISSIONS[mission])
    assert np.arcsin(nose_W[:, 2]).max() == pytest.approx(climb, rel=0.1)  # it did climb, nose up; the speed wobbles
    assert R_WB[:, 2, 2].min() > 0.9


@every_mission
def test_a_turn_banks_into_itself(mission):
    motion = motion_of(mission, wobble_deg=0.0)
    t_s = np.linspace(0, 600, 2000)
    R_WB, w_WB_B, _ = motion.attitude(t_s)
    turning = np.abs(w_WB_B[:, 2]) > 0.1
    assert turning.any() == any(MISSIONS[mission].turns_deg)
    assert (np.sign(R_WB[turning, 2, 1]) == -np.sign(w_WB_B[turning, 2])).all()  # to the left: the left side sinks


@every_mission
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
    speed_m_s = np.linalg.norm(motion.velocity(t_s), axis=1)
    assert 1.4 < speed_m_s.min() < speed_m_s.max() < 1.6


@every_mission
def test_surfaces_at_intervals(mission):
    t_s = np.arange(0, 3600, 0.5)
    afloat = motion_of(mission, duration_s=3600).position(t_s)[:, 2] > AFLOAT_M - 0.05
    starts = t_s[1:][np.diff(afloat.astype(int)) == 1]
    lengths = t_s[1:][np.diff(afloat.astype(int)) == -1][1:] - starts[:-1]
    assert len(starts) == 13  # 3600 / 270, evenly, less the one it starts with
    assert ((lengths > 28) & (lengths < 40)).all()


def sampled(mission: str, **values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, course and whether it is steady, every 0.1 s for half an hour without wobble."""
    motion, t_s = motion_of(mission, wobble_deg=0.0, duration_s=1800, **values), np.arange(0, 1800, 0.1)
    course = motion.angles(t_s)[:, 2]
    return motion.position(t_s), course, np.abs(np.gradient(course, 0.1)) < 1e-5


@only("lawnmower")
def test_lines_of_the_lawnmower_are_two_radii_apart(mission):
    p_WB_W, _, straight = sampled(mission)
    across_m = p_WB_W[straight] @ [-np.sin(np.pi / 6), np.cos(np.pi / 6), 0.0]
    lines = np.unique(np.round(across_m / 20))
    # smoothing cuts the corners of both ends of a turn by (σ ψ')² / 2 or 2.5 % of its radius
    spacing = [np.median(across_m[np.round(across_m / 20) == line]) for line in lines[:4]]
    np.testing.assert_allclose(np.diff(spacing), 20, atol=0.8)
    assert np.ptp(p_WB_W @ [np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0]) < 100 + 2 * 10 + 250  # it comes back
    assert len(lines) >= 15


@only("yo-yo")
def test_the_yo_yo_turns_up_and_down_on_many_courses(mission):
    p_WB_W, course, straight = sampled(mission)
    z_m = p_WB_W[:, 2]
    turns_up = (z_m[1:-1] < z_m[:-2]) & (z_m[1:-1] <= z_m[2:]) & (z_m[1:-1] < -10)
    assert turns_up.sum() > 15
    assert len(np.unique(np.round(np.degrees(course[straight])))) >= 4


@only("helix")
def test_the_helix_circles_and_gains_its_pitch_with_every_turn(mission):
    p_WB_W, course, _ = sampled(mission, helix_pitch_m=6.0, turn_radius_m=12.0)
    z_m, steady = p_WB_W[:, 2], slice(100, None)  # the turn begins with the log
    np.testing.assert_allclose(
        np.gradient(course, 0.1)[steady].mean(), 1.5 / 12 * np.cos(np.arctan(6 / 24 / np.pi)), rtol=0.01
    )
    centre = p_WB_W[steady, :2] + 12 * np.stack([-np.sin(course), np.cos(course)], axis=1)[steady]
    assert np.linalg.norm(centre - centre.mean(axis=0), axis=1).max() < 1.0  # the speed wobbles by 3 %
    diving = (z_m > -15) & (z_m < -8) & (np.gradient(z_m) < 0)
    piece = np.flatnonzero(np.diff(diving.astype(int), prepend=0) == 1)[0]
    piece = slice(piece, piece + np.flatnonzero(~diving[piece:])[0])
    slope = np.polyfit(course[piece] / (2 * np.pi), z_m[piece], 1)[0]
    assert slope == pytest.approx(-6.0, rel=0.01)
    assert ((z_m[1:-1] < z_m[:-2]) & (z_m[1:-1] <= z_m[2:]) & (z_m[1:-1] < -10)).sum() > 6


@only("box")
def test_the_box_has_four_courses_a_quarter_turn_apart_and_returns(mission):
    p_WB_W, course, straight = sampled(mission)
    courses = np.degrees(np.unwrap(np.sort(np.mod(course[straight], 2 * np.pi))))
    np.testing.assert_allclose(np.unique(np.round(courses)), [30, 120, 210, 300])
    assert np.linalg.norm(np.ptp(p_WB_W[:, :2], axis=0)) < 2**0.5 * 2 * 150
    assert course[-1] > 2 * np.pi * 4  # it went round and round, to the left


@only("transit")
def test_the_transit_is_straight_and_surfaces(mission):
    p_WB_W, course, straight = sampled(mission)
    assert straight.all()
    np.testing.assert_allclose(course, np.pi / 6, atol=1e-12)
    np.testing.assert_allclose(np.arctan2(p_WB_W[1:, 1], p_WB_W[1:, 0]), np.pi / 6, atol=1e-9)
    assert np.linalg.norm(p_WB_W[-1, :2]) > 1800 * 1.4
