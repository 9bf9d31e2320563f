"""Scores against evo (an independent oracle), closed forms worked by hand, and their defining properties."""

from dataclasses import replace

import numpy as np
import pytest
from fathom.bench.metrics import (
    ScoreError,
    align,
    associate,
    ate,
    drift,
    error_state,
    horizontal_error,
    nees,
    outage_drift,
    pooled_rmse,
    rpe,
    segment_errors,
    state_errors,
)
from fathom.datasets import Trajectory
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

SECOND = 1_000_000_000
STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def trajectory(p, R=None, period_ns=SECOND // 10, **known):
    p = np.asarray(p, float)
    R = np.tile(np.eye(3), (len(p), 1, 1)) if R is None else R
    return Trajectory(np.arange(len(p), dtype=np.int64) * period_ns, R, p, **known)


def straight_line(n=101, step_m=1.0):
    return trajectory(np.arange(n)[:, None] * np.array([step_m, 0.0, 0.0]))


def wander(seed, n=400, noise_m=0.3, noise_rad=0.1):
    """A random walk, and an estimate of it that stands elsewhere, turned, and errs."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng) * Rotation.from_rotvec(np.cumsum(rng.normal(size=(n, 3)) * 0.1, axis=0))
    truth = trajectory(np.cumsum(rng.normal(size=(n, 3)) * 0.2, axis=0), R.as_matrix(), v_WB_W=rng.normal(size=(n, 3)))
    moved = Rotation.random(rng=rng).as_matrix()
    estimate = replace(
        truth,
        R_WB=moved @ (R * Rotation.from_rotvec(noise_rad * rng.normal(size=(n, 3)))).as_matrix(),
        p_WB_W=truth.p_WB_W @ moved.T + rng.normal(size=3) + noise_m * rng.normal(size=(n, 3)),
        v_WB_W=truth.v_WB_W @ moved.T,
    )
    return truth, estimate


def moved(estimate, R, p):
    return replace(estimate, R_WB=R @ estimate.R_WB, p_WB_W=estimate.p_WB_W @ R.T + p)


def yaw(psi):
    return Rotation.from_rotvec([0.0, 0.0, psi]).as_matrix()


def without_attitude(truth):
    return replace(truth, R_WB=np.full_like(truth.R_WB, np.nan))


def without_vertical(truth):
    return replace(truth, p_WB_W=truth.p_WB_W * [1.0, 1.0, np.nan])


# --- association


def test_equal_times_are_paired_and_the_rest_is_left_out():
    truth = straight_line(10)
    a, b = associate(truth, truth.select(slice(4, None, 2)))
    assert a.t_ns.tolist() == b.t_ns.tolist() == truth.t_ns[4::2].tolist()
    np.testing.assert_array_equal(a.p_WB_W, b.p_WB_W)


def test_times_one_nanosecond_apart_do_not_match_without_a_tolerance():
    truth = straight_line(3)
    late = replace(truth, t_ns=truth.t_ns + 1)
    with pytest.raises(ScoreError, match=r"3 rows from 0 to 200000000 ns.*from 1 to 200000001 ns.*tolerance_ns"):
        associate(truth, late)
    assert len(associate(truth, late, tolerance_ns=1)[0]) == 3


@pytest.mark.parametrize("seed", range(20))
def test_tolerant_association_agrees_with_a_greedy_search_where_neighbours_are_unambiguous(seed):
    rng = np.random.default_rng(seed)
    grid = np.arange(60) * 1000
    true_ns = np.sort(rng.choice(grid, 40, replace=False))
    est_ns = np.sort(rng.choice(grid, 40, replace=False)) + rng.integers(-300, 300)
    truth, estimate = associate(_at(true_ns), _at(est_ns), tolerance_ns=400)
    pairs = [(t, e) for t in true_ns for e in est_ns if abs(e - t) <= 400]
    assert list(zip(truth.t_ns.tolist(), estimate.t_ns.tolist(), strict=True)) == [(int(t), int(e)) for t, e in pairs]


@pytest.mark.parametrize("seed", range(20))
def test_no_row_is_used_twice_and_every_pair_is_mutually_nearest(seed):
    rng = np.random.default_rng(seed)
    true_ns, est_ns = (np.sort(rng.choice(2000, 80, replace=False)) for _ in range(2))
    truth, estimate = associate(_at(true_ns), _at(est_ns), tolerance_ns=30)
    assert (np.diff(truth.t_ns) > 0).all()
    assert (np.diff(estimate.t_ns) > 0).all()
    gap = np.abs(truth.t_ns - estimate.t_ns)
    assert gap.max() <= 30
    np.testing.assert_array_equal(gap, np.abs(est_ns[None] - truth.t_ns[:, None]).min(axis=1))
    np.testing.assert_array_equal(gap, np.abs(true_ns[None] - estimate.t_ns[:, None]).min(axis=1))


def test_an_estimate_half_a_period_off_matches_every_row():
    truth, estimate = associate(_at(np.arange(10) * 10), _at(np.arange(10) * 10 + 5), tolerance_ns=5)
    np.testing.assert_array_equal(estimate.t_ns - truth.t_ns, 5)
    assert len(truth) == 10


def _at(t_ns):
    return replace(trajectory(np.zeros((len(t_ns), 3))), t_ns=np.asarray(t_ns, np.int64))


def test_a_negative_tolerance_and_an_empty_estimate_are_refused():
    with pytest.raises(ScoreError, match="negative"):
        associate(straight_line(3), straight_line(3), tolerance_ns=-1)
    for tolerance_ns in (0, 5):
        with pytest.raises(ScoreError, match="no rows"):
            associate(straight_line(3), straight_line(0), tolerance_ns)


# --- alignment


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("mode", "move"), [("origin", "any"), ("se3", "any"), ("yaw", "yaw")])
def test_alignment_undoes_a_move_it_allows(mode, move, seed):
    rng = np.random.default_rng(seed)
    truth, _ = wander(seed)
    R = yaw(rng.uniform(-np.pi, np.pi)) if move == "yaw" else Rotation.random(rng=rng).as_matrix()
    estimate = replace(moved(truth, R, 100 * rng.normal(size=3)), v_WB_W=truth.v_WB_W @ R.T)
    back = align(truth, estimate, mode)
    for name in ("R_WB", "p_WB_W", "v_WB_W"):
        np.testing.assert_allclose(getattr(back, name), getattr(truth, name), atol=1e-10)


@pytest.mark.parametrize("seed", range(10))
def test_se3_alignment_turns_a_flat_track_and_never_mirrors_it(seed):
    rng = np.random.default_rng(seed)
    truth, _ = wander(seed)
    flat = replace(truth, p_WB_W=truth.p_WB_W * [1.0, 1.0, 0.0])
    R = Rotation.random(rng=rng).as_matrix()
    aligned = align(flat, moved(flat, R, rng.normal(size=3)), "se3")
    np.testing.assert_allclose(aligned.R_WB, flat.R_WB, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_yaw_and_se3_alignment_leave_no_better_small_move(seed):
    truth, estimate = wander(seed)
    rng = np.random.default_rng(seed)
    for mode, axes in (("yaw", [0, 0, 1]), ("se3", [1, 1, 1])):
        aligned = align(truth, estimate, mode)
        best = ate(truth, aligned).rmse_m
        for _ in range(20):
            turn = Rotation.from_rotvec(1e-3 * rng.normal(size=3) * axes).as_matrix()
            assert ate(truth, moved(aligned, turn, 1e-3 * rng.normal(size=3))).rmse_m > best


def test_yaw_alignment_leaves_roll_and_pitch_wrong():
    truth, _ = wander(0)
    tilted = moved(truth, Rotation.from_rotvec([0.1, 0, 0]).as_matrix(), np.zeros(3))
    aligned = align(truth, tilted, "yaw")
    np.testing.assert_allclose(np.einsum("nij,nkj->nik", aligned.R_WB, tilted.R_WB)[:, 2, 2], 1.0)


def test_more_freedom_never_raises_the_rmse():
    for seed in range(5):
        truth, estimate = wander(seed)
        none, turned, free = (ate(truth, estimate, mode).rmse_m for mode in ("none", "yaw", "se3"))
        assert none >= turned >= free


def test_alignment_none_returns_the_estimate_itself():
    truth, estimate = wander(0)
    assert align(truth, estimate, "none") is estimate


@pytest.mark.parametrize("offset_m", [0.0, 1000.0])
def test_degenerate_alignments_say_why(offset_m):
    line = straight_line()
    slope = replace(line, p_WB_W=line.p_WB_W[:, :1] * np.array([0.6, 0.3, 0.5]) + offset_m)
    still = trajectory(np.full((50, 3), 0.1) + offset_m)
    one = slope.select(slice(0, 1))
    for truth in (slope, still, one):
        with pytest.raises(ScoreError, match=r"'se3'.*no rotation"):
            align(truth, truth, "se3")
    for truth in (still, one):
        with pytest.raises(ScoreError, match=r"'yaw'.*no yaw"):
            align(truth, truth, "yaw")
    np.testing.assert_allclose(align(slope, slope, "yaw").p_WB_W, slope.p_WB_W, atol=1e-9)
    np.testing.assert_allclose(align(one, one, "origin").p_WB_W, one.p_WB_W, atol=1e-9)


def test_a_mirrored_circle_determines_no_yaw():
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    circle = trajectory(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    with pytest.raises(ScoreError, match="no yaw"):
        align(circle, replace(circle, p_WB_W=circle.p_WB_W * [1, -1, 1]), "yaw")


def test_without_attitude_only_origin_is_impossible():
    truth, estimate = wander(3)
    blind = without_attitude(truth)
    with pytest.raises(ScoreError, match=r"'origin'.*no attitude"):
        align(blind, estimate, "origin")
    for mode in ("none", "yaw", "se3"):
        assert ate(blind, estimate, mode).rmse_m == ate(truth, estimate, mode).rmse_m


def test_without_a_vertical_yaw_alignment_turns_and_shifts_horizontally():
    truth, _ = wander(4)
    estimate = moved(truth, yaw(2.0), np.array([5.0, -3.0, 7.0]))
    flat = without_vertical(truth)
    aligned = align(flat, estimate, "yaw")
    np.testing.assert_allclose(aligned.p_WB_W - truth.p_WB_W, np.tile([0.0, 0.0, 7.0], (len(truth), 1)), atol=1e-10)
    for mode in ("origin", "se3"):
        with pytest.raises(ScoreError, match="no vertical"):
            align(flat, estimate, mode)


def test_an_unknown_alignment_or_unequal_rows_are_refused():
    with pytest.raises(ScoreError, match="no mode 'sim3'"):
        align(straight_line(), straight_line(), "sim3")
    with pytest.raises(ScoreError, match="associate"):
        align(straight_line(5), straight_line(6))


# --- ATE, horizontal error


def test_a_constant_offset_is_every_statistic_of_ate_but_the_spread():
    line = straight_line()
    e = ate(line, moved(line, np.eye(3), np.array([1.0, 2.0, -2.0])))
    assert (e.rmse_m, e.mean_m, e.median_m, e.min_m, e.max_m, e.std_m) == (3, 3, 3, 3, 3, 0)
    assert (e.rotation_rmse_deg, e.heading_rmse_deg, e.alignment, e.dims, e.n) == (0, 0, "none", "3d", 101)
    flat = ate(line, moved(line, np.eye(3), np.array([3.0, 4.0, -2.0])), dims="2d")
    assert (flat.rmse_m, flat.dims) == (5, "2d")


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-9])
def test_rotation_error_is_accurate_from_zero_to_pi(angle):
    rng = np.random.default_rng(1)
    axis = rng.normal(size=(50, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    line = straight_line(50)
    R = Rotation.random(50, rng=rng)
    estimate = replace(line, R_WB=(R * Rotation.from_rotvec(angle * axis)).as_matrix())
    e = ate(replace(line, R_WB=R.as_matrix()), estimate)
    assert np.radians([e.rotation_min_deg, e.rotation_max_deg]) == pytest.approx(angle, abs=2e-15)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 2.99, 3.01, np.pi - 1e-8])
def test_the_exponential_of_the_attitude_error_turns_the_estimate_into_the_truth(scale):
    rng = np.random.default_rng(2)
    axis = rng.normal(size=(50, 3))
    phi = scale * axis / np.linalg.norm(axis, axis=1)[:, None]
    R = Rotation.random(50, rng=rng)
    line = straight_line(50)
    estimate, truth = (replace(line, R_WB=X.as_matrix()) for X in (R, R * Rotation.from_rotvec(phi)))
    np.testing.assert_allclose(error_state(truth, estimate)[:, :3], phi, atol=3e-15, rtol=1e-14)


def test_unknown_attitude_makes_rotation_scores_absent_not_zero():
    truth, estimate = wander(0)
    e = ate(without_attitude(truth), estimate)
    assert all(getattr(e, f"rotation_{name}_deg") is None for name in STATISTICS)
    assert e.heading_rmse_deg is None
    half = replace(truth, R_WB=np.where(np.arange(len(truth))[:, None, None] < 100, truth.R_WB, np.nan))
    first = slice(0, 100)
    assert ate(half, estimate).rotation_rmse_deg == ate(truth.select(first), estimate.select(first)).rotation_rmse_deg


def test_truth_without_vertical_is_scored_in_the_horizontal_only():
    truth, estimate = wander(0)
    flat = without_vertical(truth)
    with pytest.raises(ScoreError, match="dims='2d'"):
        ate(flat, estimate)
    assert ate(flat, estimate, dims="2d").rmse_m == ate(truth, estimate, dims="2d").rmse_m
    assert rpe(flat, estimate, 2.0, "m", "all", dims="2d") == rpe(truth, estimate, 2.0, "m", "all", dims="2d")
    assert state_errors(flat, estimate).depth_m is None


def test_heading_error_wraps():
    line = straight_line()
    truth = moved(line, yaw(np.pi - 0.01), np.zeros(3))
    estimate = moved(line, yaw(-np.pi + 0.02), np.zeros(3))
    assert ate(truth, estimate).heading_rmse_deg == pytest.approx(np.degrees(0.03))
    assert state_errors(truth, estimate).heading_deg == pytest.approx(np.degrees(0.03))


def test_an_estimate_that_is_not_finite_is_named_by_row_and_time():
    truth, estimate = wander(0)
    p, R = estimate.p_WB_W.copy(), estimate.R_WB.copy()
    p[7, 1], R[9] = np.inf, np.nan
    for broken in (replace(estimate, p_WB_W=p), replace(estimate, R_WB=R)):
        for mode in ("none", "yaw", "se3"):
            with pytest.raises(ScoreError, match=r"row [79] \([79]00000000 ns\): it diverged"):
                ate(truth, broken, mode)
        for score in (rpe, segment_errors, drift, state_errors):
            with pytest.raises(ScoreError, match="it diverged"):
                score(truth, broken)


def test_one_pose_has_an_ate_and_no_drift_per_distance():
    one = straight_line(1)
    off = moved(one, np.eye(3), np.array([3.0, 4.0, 0.0]))
    assert (ate(one, off).rmse_m, ate(one, off).std_m, ate(one, off).n) == (5, 0, 1)
    d = drift(one, off)
    assert (d.end_m, d.end_percent, d.max_percent, d.distance_m) == (5, None, None, 0)
    assert segment_errors(one, off) == {}
    assert outage_drift(one, off, one.t_ns, 0.0) == ()


def test_cep50_and_drms_of_a_gaussian_scatter_are_those_of_the_rayleigh_law():
    rng = np.random.default_rng(0)
    n, sigma = 40_000, 2.0
    truth = trajectory(np.zeros((n, 3)))
    e = horizontal_error(truth, replace(truth, p_WB_W=sigma * rng.normal(size=(n, 3)) * [1, 1, 50]))
    median = sigma * np.sqrt(2 * np.log(2))
    spread = 1 / (2 * np.sqrt(n) * (np.log(2) / median))  # of a sample median: 1 / (2 f(m) √n), f(m) = ln 2 / m
    assert e.cep50_m == pytest.approx(median, abs=4 * spread)
    low, high = np.array(chi2.interval(0.9999, 2 * n)) / n
    assert low < (e.drms_m / sigma) ** 2 < high


def test_pooled_rmse_is_the_rmse_of_all_errors_together():
    rng = np.random.default_rng(0)
    runs = [rng.normal(size=n) for n in (3, 50, 400)]
    each = [float(np.sqrt(np.mean(e**2))) for e in runs]
    assert pooled_rmse(each, [len(e) for e in runs]) == pytest.approx(np.sqrt(np.mean(np.concatenate(runs) ** 2)))
    for bad in ([], [1, 2], [0, 0, 0], [-1, 2, 3]):
        with pytest.raises(ScoreError):
            pooled_rmse(each, bad)


# --- RPE, segments


def evo_path(of):
    from evo.core.trajectory import PosePath3D

    poses = np.tile(np.eye(4), (len(of), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = of.R_WB, of.p_WB_W
    return PosePath3D(poses_se3=list(poses))


def assert_same_statistics(ours, pattern, metric):
    for name, value in metric.get_all_statistics().items():
        if name in STATISTICS:
            assert getattr(ours, pattern.format(name)) == pytest.approx(value, abs=1e-9, rel=0), name


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mode", ["none", "origin", "se3"])
def test_ate_equals_evo(mode, seed):
    from evo.core.metrics import APE, PoseRelation

    truth, estimate = wander(seed)
    ref, est = evo_path(truth), evo_path(estimate)
    if mode == "origin":
        est.align_origin(ref)
    if mode == "se3":
        est.align(ref)
    ours = ate(truth, estimate, mode)
    for relation, pattern in (
        (PoseRelation.translation_part, "{}_m"),
        (PoseRelation.rotation_angle_deg, "rotation_{}_deg"),
    ):
        metric = APE(relation)
        metric.process_data((ref, est))
        assert_same_statistics(ours, pattern, metric)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("pairs", ["consecutive", "all"])
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (7, "frames"), (0.5, "m"), (3.0, "m")])
def test_rpe_equals_evo(delta, unit, pairs, seed):
    truth, estimate = wander(seed)
    rest = np.r_[0:100, np.full(30, 100), 100:400]  # the vehicle halts for 30 poses, the estimate goes on
    truth = trajectory(truth.p_WB_W[rest], truth.R_WB[rest])
    estimate = trajectory(
        estimate.p_WB_W[rest] + np.random.default_rng(seed).normal(size=(430, 3)), estimate.R_WB[rest]
    )
    ours = rpe(truth, estimate, delta, unit, pairs)
    assert (ours.delta, ours.unit, ours.pairs) == (delta, unit, pairs)
    for pattern, metric in evo_rpe(truth, estimate, delta, unit, pairs):
        assert_same_statistics(ours, pattern, metric)
        assert ours.n == len(metric.error)


def test_of_two_poses_equally_near_to_delta_rpe_takes_the_first_as_evo_does():
    rng = np.random.default_rng(0)
    truth = straight_line(60, step_m=0.25)
    estimate = replace(truth, p_WB_W=truth.p_WB_W + rng.normal(size=(60, 3)))
    ours = rpe(truth, estimate, 1.375, "m", "all")  # 1.25 or 1.5 m
    for pattern, metric in evo_rpe(truth, estimate, 1.375, "m", "all"):
        assert_same_statistics(ours, pattern, metric)


def evo_rpe(truth, estimate, delta, unit, pairs):
    from evo.core.metrics import RPE, PoseRelation, Unit

    data = (evo_path(truth), evo_path(estimate))
    evo_unit = {"frames": Unit.frames, "m": Unit.meters}[unit]
    for relation, pattern in (
        (PoseRelation.translation_part, "{}_m"),
        (PoseRelation.rotation_angle_deg, "rotation_{}_deg"),
    ):
        metric = RPE(relation, delta, evo_unit, all_pairs=pairs == "all", pairs_from_reference=True)
        metric.process_data(data)
        yield pattern, metric


@pytest.mark.parametrize("pairs", ["consecutive", "all"])
def test_rpe_in_seconds_equals_frames_at_an_even_rate(pairs):
    truth, estimate = wander(0)  # 10 Hz
    seconds, frames = rpe(truth, estimate, 2.0, "s", pairs), rpe(truth, estimate, 20, "frames", pairs)
    assert replace(seconds, delta=20, unit="frames") == frames


def test_rpe_in_seconds_takes_the_first_pose_late_enough_and_none_far_too_late():
    t_s = np.array([0.0, 0.5, 1.0, 1.55, 5.0, 6.08])
    truth = replace(straight_line(6), t_ns=np.round(t_s * SECOND).astype(np.int64))
    # all: 0→1.0, 0.5→1.55 (0.05 late), 5.0→6.08; but 1.0→5.0 and 1.55→5.0 are too late
    assert rpe(truth, truth, 1.0, "s", "all").n == 3
    # consecutive: 0→1.0, then 1.0→5.0, too late, then 5.0→6.08
    assert rpe(truth, truth, 1.0, "s", "consecutive").n == 2


@pytest.mark.parametrize("unit", ["frames", "s", "m"])
@pytest.mark.parametrize("dims", ["3d", "2d"])
def test_rpe_does_not_change_when_the_estimate_is_moved_as_a_whole(unit, dims):
    truth, estimate = wander(2)
    elsewhere = moved(
        estimate, Rotation.random(rng=np.random.default_rng(9)).as_matrix(), np.array([10.0, -20.0, 30.0])
    )
    ours, theirs = (rpe(truth, x, 2.0, unit, "all", dims=dims) for x in (estimate, elsewhere))
    assert (ours.rmse_m, ours.rotation_rmse_deg) == pytest.approx((theirs.rmse_m, theirs.rotation_rmse_deg), abs=1e-10)


def test_rpe_of_a_velocity_error_is_that_error_times_the_step():
    line = straight_line()  # 10 m/s at 10 Hz
    fast = replace(line, p_WB_W=line.p_WB_W * 1.01)
    e = rpe(line, fast, 5, "s")
    assert (e.mean_m, e.std_m, e.rotation_max_deg, e.n) == (pytest.approx(0.5), pytest.approx(0), 0, 2)


def test_the_pairs_come_from_the_truth():
    line = straight_line()
    assert rpe(line, replace(line, p_WB_W=line.p_WB_W * 3), 5.0, "m", "all").n == 96  # from the estimate: none


@pytest.mark.parametrize(
    ("delta", "unit"), [(101, "frames"), (11, "s"), (1000, "m"), (0, "frames"), (-1, "m"), (1.5, "frames"), (1, "km")]
)
@pytest.mark.parametrize("pairs", ["consecutive", "all"])
def test_a_step_that_the_truth_does_not_have_is_an_error(delta, unit, pairs):
    with pytest.raises(ScoreError, match="rpe"):
        rpe(straight_line(), straight_line(), delta, unit, pairs)


def test_a_vehicle_that_stays_has_rpe_in_frames_and_seconds_but_none_in_metres():
    still = trajectory(np.zeros((50, 3)))
    assert rpe(still, still, 1, "frames").rmse_m == rpe(still, still, 1, "s").rmse_m == 0
    for pairs in ("all", "consecutive"):
        with pytest.raises(ScoreError, match=r"0\.000 m"):
            rpe(still, still, 1.0, "m", pairs)
    with pytest.raises(ScoreError, match="1 poses match"):
        rpe(straight_line(1), straight_line(1))


@pytest.mark.parametrize(
    ("every", "delta", "unit", "says"),
    [
        (17, 1.0, "m", "over 8.500 s and 85.000 m, each about 17 m from the next; use a larger delta, or a denser est"),
        (17, 1.0, "s", "each about 1.7 s from the next; use a larger delta, or a denser estimate"),
        (2, 3.0, "m", "each about 2 m from the next; use a delta of one or several such steps, or a denser estimate"),
        (
            1,
            500.0,
            "m",
            "101 poses match, over 10.000 s and 100.000 m, each about 1 m from the next; use a smaller delta",
        ),
        (1, 101.0, "frames", "over 10.000 s and 100.000 m; use a smaller delta"),
    ],
)
def test_why_there_is_no_rpe_says_how_far_apart_the_matched_poses_are(every, delta, unit, says):
    with pytest.raises(ScoreError) as caught:
        rpe(straight_line(), straight_line().select(slice(None, None, every)), delta, unit, "all")
    assert says in str(caught.value)


def test_relative_scores_without_attitude_are_errors():
    truth, estimate = wander(0)
    for score in (rpe, segment_errors):
        with pytest.raises(ScoreError, match="needs the attitude"):
            score(without_attitude(truth), estimate)


def test_a_one_percent_scale_error_is_one_percent_over_every_length():
    line = straight_line(202, step_m=0.7)
    scaled = replace(line, p_WB_W=line.p_WB_W * 1.01)
    segments = segment_errors(line, scaled, lengths_m=(10, 50, 100, 200))
    assert list(segments) == [10, 50, 100]  # 141 m in all: 200 is absent, not zero
    for length, s in segments.items():
        assert (s.translation_rmse_percent, s.translation_max_percent) == pytest.approx((1, 1))
        assert (s.n, s.rotation_rmse_deg_m) == (202 - int(np.ceil(length / 0.7)), 0)


def test_a_steady_turn_error_shows_in_degrees_per_metre():
    line = straight_line()
    turning = replace(
        line, R_WB=Rotation.from_rotvec(np.radians(0.02) * np.arange(101)[:, None] * [0, 0, 1]).as_matrix()
    )
    s = segment_errors(line, turning, lengths_m=(25,))[25]
    assert (s.rotation_min_deg_m, s.rotation_max_deg_m) == pytest.approx((0.02, 0.02))
    with pytest.raises(ScoreError, match="positive"):
        segment_errors(line, turning, lengths_m=(10, 0))


# --- drift


@pytest.mark.parametrize("psi", [0.001, 0.1, 2.0])
def test_a_yaw_error_on_a_straight_line_drifts_by_twice_the_sine_of_half_of_it(psi):
    line = straight_line()
    d = drift(line, moved(line, yaw(psi), np.zeros(3)))
    assert d.end_percent == pytest.approx(200 * np.sin(psi / 2))
    assert d.max_percent == pytest.approx(d.end_percent)
    assert (d.distance_m, d.dims) == (pytest.approx(100), "2d")


def test_a_closed_loop_has_its_largest_drift_on_the_way():
    out = np.r_[0:51, 49:-1:-1]
    line = trajectory(out[:, None] * np.array([1.0, 0, 0]))
    d = drift(line, moved(line, yaw(0.1), np.zeros(3)))
    assert (d.end_percent, d.max_percent) == pytest.approx((0, 100 * np.sin(0.05)), abs=1e-12)


def test_horizontal_drift_ignores_depth_in_error_and_distance():
    line = straight_line()
    dive = replace(line, p_WB_W=line.p_WB_W @ [[0.6, 0, -0.8], [0, 0, 0], [0, 0, 0]])
    off = moved(dive, np.eye(3), np.array([0.0, 3.0, 4.0]))
    assert (drift(dive, off).end_percent, drift(dive, off, dims="3d").end_percent) == pytest.approx((5, 5))
    assert drift(dive, off).distance_m == pytest.approx(60)


def test_each_outage_is_charged_with_its_own_growth():
    line = straight_line(1001)  # 10 m/s, 10 Hz, 100 s
    t_s = line.t_ns / SECOND
    lost = (t_s >= 20) & (t_s < 60)  # GPS at 20 s, next at 60 s; the estimate slides sideways at 0.5 m/s, then is reset
    slide = np.where(lost, 0.5 * (t_s - 20), 0.0) + 2.0  # and has a constant error besides
    estimate = replace(line, p_WB_W=line.p_WB_W + slide[:, None] * [0, 1, 0])
    gps = np.r_[np.arange(0, 21), np.arange(60, 101)] * SECOND
    (outage,) = outage_drift(line, estimate, gps)
    assert (outage.begin_ns, outage.end_ns) == (20 * SECOND, 599 * SECOND // 10)
    assert (outage.growth_m, outage.distance_m) == pytest.approx((0.5 * 39.9, 399))
    assert outage.growth_percent == pytest.approx(5)
    assert outage_drift(line, estimate, gps, min_outage_s=40) == ()


def test_silence_before_the_first_and_after_the_last_reading_are_outages():
    line = straight_line(1001)
    spans = [(o.begin_ns / SECOND, o.end_ns / SECOND) for o in outage_drift(line, line, np.array([55, 45]) * SECOND)]
    assert spans == [(0, 44.9), (55, 100)]
    (whole,) = outage_drift(line, line, np.zeros(0, np.int64))
    assert (whole.begin_ns, whole.end_ns, whole.growth_percent) == (0, 100 * SECOND, 0)
    still = trajectory(np.zeros((1001, 3)))
    assert outage_drift(still, still, np.zeros(0, np.int64))[0].growth_percent is None


# --- state errors, NEES


def test_state_errors_are_the_constants_put_in():
    n = 20
    zero = np.zeros((n, 3))
    truth = trajectory(zero, v_WB_W=zero, b_a=zero, b_g=zero)
    R = Rotation.from_euler("ZYX", [3.0, -2.0, 1.0], degrees=True).as_matrix()
    estimate = trajectory(
        np.tile([0, 0, -0.5], (n, 1)),
        np.tile(R, (n, 1, 1)),
        v_WB_W=np.tile([0.3, 0.4, 0], (n, 1)),
        b_a=zero + 0.1,
        b_g=zero - 0.01,
    )
    e = state_errors(truth, estimate)
    assert (e.heading_deg, e.pitch_deg, e.roll_deg) == pytest.approx((3, 2, 1))
    assert (e.velocity_m_s, e.depth_m, e.n) == (pytest.approx(0.5), 0.5, n)
    assert (e.accel_bias_m_s2, e.gyro_bias_rad_s) == pytest.approx((0.1 * np.sqrt(3), 0.01 * np.sqrt(3)))


def test_unknown_parts_of_the_state_are_none():
    bare = without_attitude(straight_line())
    e = state_errors(bare, bare)
    assert (e.heading_deg, e.roll_deg, e.pitch_deg, e.velocity_m_s) == (None,) * 4
    assert (e.accel_bias_m_s2, e.gyro_bias_rad_s, e.depth_m) == (None, None, 0)


def believed(seed, n=500):
    """An estimate, and truths drawn from its covariance through the state's own ⊕."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 15, 15)) * np.repeat([0.02, 1.0, 0.1, 0.01, 1e-4], 3)[:, None]
    e = (root @ rng.normal(size=(n, 15, 1)))[:, :, 0]
    b = rng.normal(size=(4, n, 3))
    estimate = trajectory(
        b[0], Rotation.random(n, rng=rng).as_matrix(), v_WB_W=b[1], b_a=b[2], b_g=b[3], P=root @ root.transpose(0, 2, 1)
    )
    states = [estimate.state(k).retract(e[k]) for k in range(n)]
    names = ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g")
    return replace(estimate, P=None, **{x: np.array([getattr(s, x) for s in states]) for x in names}), estimate, e


BLOCK_DIM = {"position": 3, "attitude": 3, "velocity": 3, "biases": 6, "all": 15}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("block", "dim"), BLOCK_DIM.items())
def test_nees_of_truths_drawn_from_the_covariance_is_chi_square(block, dim, seed):
    truth, estimate, _ = believed(seed)
    total, n = nees(truth, estimate, block).sum(), len(truth)
    low, high = chi2.interval(0.9999, n * dim)
    assert low < total < high


def test_nees_equals_the_inverse_written_out_row_by_row():
    truth, estimate, e = believed(0, n=30)
    first = {"attitude": 0, "position": 3, "velocity": 6, "biases": 9, "all": 0}
    for block, dim in BLOCK_DIM.items():
        of = slice(first[block], first[block] + dim)
        expected = [x[of] @ np.linalg.inv(P[of, of]) @ x[of] for x, P in zip(e, estimate.P, strict=True)]
        np.testing.assert_allclose(nees(truth, estimate, block), expected, rtol=1e-5)


def test_nees_does_not_depend_on_units():
    """Positions and their σ ten times larger leave the score alone."""
    truth, estimate, _ = believed(0, n=30)
    P = estimate.P.copy()
    P[:, 3:6] *= 10
    P[:, :, 3:6] *= 10
    larger = (replace(truth, p_WB_W=truth.p_WB_W * 10), replace(estimate, p_WB_W=estimate.p_WB_W * 10, P=P))
    np.testing.assert_allclose(nees(*larger, "all"), nees(truth, estimate, "all"), rtol=1e-6)


def test_rows_without_covariance_have_no_nees():
    truth, estimate, _ = believed(1, n=10)
    P = estimate.P.copy()
    P[::2] = np.nan
    score = nees(truth, replace(estimate, P=P), "all")
    assert np.isnan(score[::2]).all()
    np.testing.assert_allclose(score[1::2], nees(truth, estimate, "all")[1::2])


def test_nees_of_what_is_unknown_or_impossible_is_an_error():
    truth, estimate, _ = believed(1, n=10)
    for block, poorer in (
        ("velocity", replace(truth, v_WB_W=None)),
        ("biases", replace(truth, b_g=None)),
        ("all", without_attitude(truth)),
        ("attitude", without_attitude(truth)),
        ("position", without_vertical(truth)),
    ):
        with pytest.raises(ScoreError, match="no known error"):
            nees(poorer, estimate, block)
    with pytest.raises(ScoreError, match="no covariances"):
        nees(truth, replace(estimate, P=None))
    with pytest.raises(ScoreError, match="no block 'depth'"):
        nees(truth, estimate, "depth")
    P = estimate.P.copy()
    P[4] -= 2 * np.diag(np.diag(P[4]))
    with pytest.raises(ScoreError, match=f"not positive definite at {estimate.t_ns[4]} ns"):
        nees(truth, replace(estimate, P=P))
