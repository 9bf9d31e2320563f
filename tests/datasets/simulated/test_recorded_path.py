"""A recorded trajectory as the path: the splines keep its poses, and refuse what is no motion."""

import dataclasses

import numpy as np
import pytest
from fathom.datasets import DatasetError, Trajectory
from fathom.datasets.simulated.missions import fly
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from pydantic import ValidationError
from scipy.spatial.transform import Rotation


def recorded(duration_s: float = 120.0, period_s: float = 0.4, mission: str = "yo-yo", jitter_s: float = 0.0):
    """What a vehicle at that mission would have recorded, at times of its own clock, and its motion."""
    motion = fly(Scenario(mission=mission, duration_s=duration_s), 4)
    t_s = np.arange(0, duration_s + 1e-9, period_s)
    t_s[1:-1] += np.random.default_rng(0).uniform(-jitter_s, jitter_s, len(t_s) - 2)
    t_ns = np.rint(t_s * 1e9).astype(np.int64)
    R_WB, p_WB_W, _ = motion.pose(t_ns * 1e-9)
    return Trajectory(1_700_000_000_000_000_000 + t_ns, R_WB, p_WB_W), motion


def scenario(**values) -> Scenario:
    return Scenario(**({"mission": "recorded", "duration_s": 100, "noise_scale": 0.0} | values))


def test_the_truth_passes_every_pose():
    path, _ = recorded(jitter_s=0.1)
    motion = fly(scenario(path_start_s=7.0), 1, path)
    t_s = (path.t_ns - path.t_ns[0]) * 1e-9 - 7.0
    R_WB, p_WB_W, _ = motion.pose(t_s)
    np.testing.assert_allclose(p_WB_W, path.p_WB_W, atol=1e-9)
    np.testing.assert_allclose(R_WB, path.R_WB, atol=1e-9)


def test_the_motion_between_smooth_poses_is_that_of_the_vehicle():
    path, flown = recorded()
    t_s = np.random.default_rng(1).uniform(5, 100, 500)
    now, then = fly(scenario(), 1, path).at(t_s), flown.at(t_s)
    for name, tolerance in (("R_WB", 1e-4), ("p_WB_W", 1e-3), ("v_WB_W", 5e-3), ("a_WB_W", 5e-2), ("w_WB_B", 1e-2)):
        np.testing.assert_allclose(getattr(now, name), getattr(then, name), atol=tolerance, err_msg=name)


def test_its_derivatives_match_central_differences():
    path, _ = recorded(jitter_s=0.1)
    motion, step_s = fly(scenario(), 1, path), 1e-3
    t_s = np.random.default_rng(2).uniform(1, 99, 400)
    before, now, after = motion.at(t_s - step_s), motion.at(t_s), motion.at(t_s + step_s)
    turned = Rotation.from_matrix(before.R_WB.transpose(0, 2, 1) @ after.R_WB).as_rotvec()
    np.testing.assert_allclose(now.v_WB_W, (after.p_WB_W - before.p_WB_W) / (2 * step_s), atol=2e-6)
    np.testing.assert_allclose(now.a_WB_W, (after.v_WB_W - before.v_WB_W) / (2 * step_s), atol=2e-6)
    np.testing.assert_allclose(now.w_WB_B, turned / (2 * step_s), atol=2e-6)
    np.testing.assert_allclose(now.alpha_WB_B, (after.w_WB_B - before.w_WB_B) / (2 * step_s), atol=2e-6)


def test_yaw_may_turn_round_and_round():
    path, _ = recorded(mission="helix", period_s=1.0)
    psi = fly(scenario(), 1, path).angles(np.linspace(0, 100, 1000))[:, 2]
    assert psi[-1] - psi[0] > 4 * np.pi
    assert np.abs(np.diff(psi)).max() < 0.1


def test_a_file_and_its_trajectory_give_the_same_log(tmp_path):
    path, _ = recorded()
    path.to_tum(tmp_path / "dive.tum")
    from_file = simulate(scenario(path=str(tmp_path / "dive.tum"), noise_scale=1.0), 3)
    from_object = simulate(scenario(noise_scale=1.0), 3, Trajectory.from_tum(tmp_path / "dive.tum"))
    assert np.array_equal(from_file.imu.f_I, from_object.imu.f_I)
    assert np.array_equal(from_file.dvl.z, from_object.dvl.z)
    assert from_file.name == "recorded-tactical-s3"
    assert "dive.tum, sha256 " in from_file.notes[1]
    assert "301 poses" in from_file.notes[1]


def test_knots_apart_smooth_the_noise_of_the_recording():
    """Least squares through noise of σ leave √(knots / poses) of it in the path."""
    path, _ = recorded(period_s=0.02)
    noisy = dataclasses.replace(path, p_WB_W=path.p_WB_W + np.random.default_rng(5).normal(0, 0.02, path.p_WB_W.shape))
    with pytest.raises(DatasetError, match=r"an acceleration of .* m/s² .* path_spacing_s"):
        fly(scenario(), 1, noisy)
    smooth = fly(scenario(path_spacing_s=1.0), 1, noisy)
    t_s = (path.t_ns - path.t_ns[0]) * 1e-9
    inner = (t_s > 2) & (t_s < 98)
    left_m = np.sqrt(np.mean((smooth.position(t_s) - path.p_WB_W)[inner] ** 2))
    assert left_m == pytest.approx(0.02 * np.sqrt(0.02 / 1.0), rel=0.35)
    assert np.linalg.norm(smooth.acceleration(t_s[inner]), axis=1).max() < 1.0
    assert "m rms" in smooth.notes[0]


def broken(path: Trajectory, what: str) -> Trajectory:
    R, p = path.R_WB.copy(), path.p_WB_W.copy()
    if what == "nan":
        p[17, 1] = np.nan
    elif what == "no rotation":
        R[17] *= 1.01
    elif what == "steep":
        R[17] = Rotation.from_euler("ZYX", [0.1, -1.5, 0.0]).as_matrix()
    elif what == "turned":
        R[17] = R[17] @ Rotation.from_euler("Z", 2.5).as_matrix()
    elif what == "jump":
        p[17:] += [30.0, 0.0, 0.0]
    return dataclasses.replace(path, R_WB=R, p_WB_W=p)


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("nan", "pose 17 .1 in all. is not finite"),
        ("no rotation", "pose 17 .1 in all.: R_WB is not a rotation"),
        ("steep", "pose 17 .1 in all. is pitched beyond 80°"),
        ("turned", "pose 17 .* is turned by more than 90°"),
        ("jump", r"an acceleration of .* m/s² 6\.\d+ s after its first pose"),
    ],
)
def test_a_path_that_is_no_motion_is_refused_with_its_pose(what, words):
    with pytest.raises(DatasetError, match=words):
        fly(scenario(), 1, broken(recorded()[0], what))


def test_a_path_that_does_not_last_is_refused():
    path, _ = recorded(duration_s=60)
    with pytest.raises(DatasetError, match=r"the path lasts 60 s; the scenario needs it from 0 to 100 s"):
        fly(scenario(), 1, path)
    with pytest.raises(DatasetError, match=r"from 50 to 70 s; change path_start_s or duration_s"):
        fly(scenario(duration_s=20, path_start_s=50), 1, path)
    fly(scenario(duration_s=20, path_start_s=40), 1, path)
    with pytest.raises(DatasetError, match="4 poses; splines need at least 6"):
        fly(scenario(), 1, path.select(slice(4)))


def test_gaps_are_refused_where_knots_would_find_no_pose():
    path, _ = recorded()
    with pytest.raises(DatasetError, match=r"no pose from 39 to 40 s \(4 such gaps\)"):
        fly(scenario(path_spacing_s=1.0), 1, path.select(np.abs(np.arange(len(path)) - 102) > 5))
    with pytest.raises(DatasetError, match=r"too few for knots every 0\.4 s"):
        fly(scenario(path_spacing_s=0.4), 1, path)


def test_paths_and_missions_go_together(tmp_path):
    path, _ = recorded()
    with pytest.raises(DatasetError, match="mission lawnmower takes no path"):
        simulate(Scenario(), 1, path)
    with pytest.raises(ValidationError, match="takes no `path`"):
        Scenario(path="dive.tum")
    with pytest.raises(DatasetError, match="needs `path`, a TUM file, or a Trajectory"):
        simulate(scenario(), 1)
    with pytest.raises(DatasetError, match=r"here\.yaml: mission 'recorded' needs `path`"):
        Scenario.from_dict({"mission": "recorded"}, "here.yaml")
    with pytest.raises(DatasetError, match=r"none\.tum: no such file"):
        simulate(scenario(path=str(tmp_path / "none.tum")), 1)
