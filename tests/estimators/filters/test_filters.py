"""The filters agree where theory says so, and the invariant one survives a wrong heading."""

from __future__ import annotations

import numpy as np
import pytest
from driver import FILTERS, heading_error_rad, matched, run_log
from fathom.datasets import Belief, Log, NavState
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import create
from fathom.estimators.filters.iekf import (
    from_invariant,
    inject_invariant,
    invariant_transition,
    propagate_invariant,
    to_invariant,
)
from fathom.estimators.interface import FACTORS
from fathom.estimators.physics.imu import BLOCK, integrate, predict
from fathom.estimators.physics.imu import compile_rig as compiled
from fathom.estimators.physics.state import STATE, as_belief, as_record
from linear import LINEAR, TOY_RIG, linear_toy
from logs import DELAYED, until
from paths import GRAVITY, Path, random_rig, random_state
from scipy.spatial.transform import Rotation

DEGREE = np.pi / 180


def difference(a: Belief, b: Belief) -> tuple[float, float]:
    """The largest difference of state, and of covariance over σᵢσⱼ."""
    sigma = np.sqrt(np.diag(a.P))
    return np.abs(a.state.local(b.state)).max(), np.abs((a.P - b.P) / np.outer(sigma, sigma)).max()


# -- one filter, written twice ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(duration_s=120.0),
        Scenario(mission="yo-yo", duration_s=120.0, imu="consumer"),
        pytest.param(Scenario(duration_s=120.0, **DELAYED), marks=pytest.mark.slow),
    ],
    ids=["lawnmower", "yo-yo", "delayed"],
)
def test_filterpys_filter_is_ours_over_a_whole_mission(scenario: Scenario) -> None:
    log = simulate(scenario, seed=4)
    ours, theirs = run_log(log, create("eskf")), run_log(log, create("eskf-filterpy"))
    assert theirs.counts == ours.counts
    assert len(ours.beliefs) == 120
    worst = np.array([difference(a, b) for a, b in zip(ours.beliefs, theirs.beliefs, strict=True)])
    assert worst.max() < 1e-6


# -- a linear toy -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in FILTERS if name != "eskf"])
@pytest.mark.parametrize("seed", range(3))
def test_where_all_is_linear_all_filters_are_one(name: str, seed: int) -> None:
    prior, epochs = linear_toy(seed)
    reference, run = create("eskf").begin(prior, TOY_RIG), create(name).begin(prior, TOY_RIG)
    for epoch in epochs:
        reference.step(epoch)
        run.step(epoch)
        a, b = reference.belief(), run.belief()
        sigma = np.sqrt(np.diag(a.P))
        assert np.abs(a.state.local(b.state) / sigma)[LINEAR].max() < 1e-6
        assert np.abs((a.P - b.P) / np.outer(sigma, sigma))[np.ix_(LINEAR, LINEAR)].max() < 1e-6


# -- the invariant filter ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_invariant_coordinates_are_the_derivative_of_the_groups_exponential(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, origin = random_state(rng), rng.normal(size=3)
    A = to_invariant(x.R_WB, x.p_WB_W - origin, x.v_WB_W)
    B = from_invariant(x.R_WB, x.p_WB_W - origin, x.v_WB_W)
    assert np.allclose(A @ B, np.eye(15), atol=1e-12)
    for k, step in enumerate(1e-6 * np.eye(15)):
        ends = []
        for sign in (1, -1):
            record = as_record(Belief(0, x, np.eye(15)))
            inject_invariant(record, sign * step, origin)
            ends.append(as_belief(0, record).state)
        assert np.allclose(x.local(ends[0]) - x.local(ends[1]), 2e-6 * B[:, k], atol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_the_block_carries_a_large_invariant_error_exactly(seed: int) -> None:
    """Log-linear: an error of 2 rad and 20 m is carried over the block by Φ to the last digits, no matter the state."""
    rng = np.random.default_rng(seed)
    path, rig, dt_s = Path(seed), random_rig(rng, 1.0), 0.01
    imu = path.imu(dt_s * np.arange(0, 51), dt_s, rig, np.zeros(3), np.zeros(3))
    records, block, origin = compiled(rig, FACTORS, {}), np.zeros(1, BLOCK), rng.normal(size=3)
    x = as_record(Belief(0, path.state(0.0, np.zeros(3), np.zeros(3)), np.zeros((15, 15))))
    xi = np.r_[rng.normal(size=3), 10 * rng.normal(size=6), np.zeros(6)]
    wrong = x.copy()
    inject_invariant(wrong, xi, origin)
    F, end = np.empty((15, 15)), np.zeros(1, STATE)
    integrate(imu[1:], imu[:1], np.zeros(3), np.zeros(3), records, block)
    predict(block, x, GRAVITY, F, end)
    A = to_invariant(end["R_WB"][0], end["p_WB_W"][0] - origin, end["v_WB_W"][0])
    Phi = invariant_transition(block, GRAVITY, F, A)
    before = from_invariant(x["R_WB"][0], x["p_WB_W"][0] - origin, x["v_WB_W"][0])
    assert np.allclose(Phi, A @ F @ before, atol=1e-9)  # so F itself is state-independent once seen in xi

    predict(block, wrong, GRAVITY, F, wrong)
    T, g_W = block["T"][0], np.array([0, 0, -GRAVITY])
    carried = end.copy()  # Γ Exp(Φ xi) Γ⁻¹ X: take the block's gravity off, turn, and put it on again
    carried["v_WB_W"] -= T * g_W
    carried["p_WB_W"] -= 0.5 * T**2 * g_W
    xi[3:6] += T * xi[6:9]
    inject_invariant(carried, xi, origin)
    carried["v_WB_W"] += T * g_W
    carried["p_WB_W"] += 0.5 * T**2 * g_W
    a, b = as_belief(0, carried).state, as_belief(0, wrong).state
    assert np.abs(a.local(b)).max() < 1e-10


def test_invariant_covariance_is_ours_in_other_coordinates_after_a_block() -> None:
    rng = np.random.default_rng(7)
    path, rig = Path(7), random_rig(rng, 1.0)
    imu = path.imu(0.01 * np.arange(0, 51), 0.01, rig, np.zeros(3), np.zeros(3))
    M = rng.normal(size=(15, 15)) * np.repeat([0.1, 1.0, 0.1, 1e-2, 1e-3], 3)[:, None]
    x, origin = path.state(0.0, np.zeros(3), np.zeros(3)), rng.normal(size=3)
    prior = Belief(0, x, M @ M.T)
    from fathom.estimators.physics.kalman import propagate

    records, block = compiled(rig, FACTORS, {}), np.zeros(1, BLOCK)
    ours, theirs = as_record(prior), as_record(prior)
    propagate(ours, records, imu[:1], imu[1:], block)
    A = to_invariant(x.R_WB, x.p_WB_W - origin, x.v_WB_W)
    theirs["P"] = A @ prior.P @ A.T
    propagate_invariant(theirs, records, imu[:1], imu[1:], block, origin)
    B = from_invariant(*(theirs[name][0] - shift for name, shift in (("R_WB", 0), ("p_WB_W", origin), ("v_WB_W", 0))))
    assert np.allclose(B @ theirs["P"][0] @ B.T, ours["P"][0], rtol=1e-9, atol=1e-14)


AFLOAT = Scenario(duration_s=90.0, surface_for_s=600.0, surface_every_s=1000.0, heading=None)
"""Under way at the surface with GPS and DVL, and nothing that gives a heading."""


def with_unknown_heading(log: Log, seed: int, known: str) -> Log:
    """The log with a prior that is 60° off in heading and says so (σ 60°).

    Its velocity is known in B, as a DVL gives it, and so turned with the heading; or in W, as GPS gives it; or hardly.
    """
    rng, truth, noise = np.random.default_rng(seed), log.truth.state(0), log.rig.imu_noise
    turn = Rotation.from_rotvec([*rng.normal(size=2) * DEGREE, 60 * DEGREE * (-1) ** seed]).as_matrix()
    sigma = np.repeat([DEGREE, 1.5, 0.05, noise.accel_bias_sigma, noise.gyro_bias_sigma], 3)
    sigma[2] = 60 * DEGREE
    if known == "hardly":
        sigma[6:9] = 1.5
    v_WB_W = truth.v_WB_W + 0.05 * rng.normal(size=3)
    if known != "in W":
        v_WB_W = turn @ v_WB_W
    x = NavState(turn @ truth.R_WB, truth.p_WB_W + 1.5 * rng.normal(size=3), v_WB_W, np.zeros(3), np.zeros(3))
    B = from_invariant(x.R_WB, np.zeros(3), v_WB_W if known == "in B" else np.zeros(3))
    return log.with_prior(Belief(log.start_ns, x, B @ np.diag(sigma**2) @ B.T))


@pytest.mark.slow
@pytest.mark.parametrize("known", ["in B", "in W", "hardly"])
def test_invariant_filter_finds_a_heading_that_is_60_degrees_off(known: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where none of them refuses such a start, as they do."""
    monkeypatch.setattr("fathom.estimators.unknown_start.MOST_YAW_RAD", 90 * DEGREE)
    monkeypatch.setattr("fathom.estimators.unknown_start.MOST_VELOCITY_M_S", 2.0)
    error_deg: dict[str, list[float]] = {"iekf": [], "eskf": []}
    for seed in range(12):
        log = with_unknown_heading(simulate(AFLOAT, seed), seed, known)
        for name, errors in error_deg.items():
            online = run_log(log, create(name)).online
            heading = heading_error_rad(log.truth, online)
            errors.append(abs(heading[online.t_ns == log.start_ns + 60 * 10**9][0]) / DEGREE)
    assert max(error_deg["iekf"]) < 10
    assert max(error_deg["iekf"]) < 0.5 * min(error_deg["eskf"])


# -- from a good start ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_filters_that_are_well_set_up_are_equally_good() -> None:
    """From a good start nonlinearity hardly matters: pooled errors within 5 % of eskf's."""
    pooled: dict[str, np.ndarray] = {name: np.zeros(2) for name in ("eskf", "iekf", "ukf")}
    for seed in range(10):
        log = simulate(Scenario(mission="yo-yo", duration_s=120.0), seed)
        for name, squares in pooled.items():
            online = run_log(log, create(name)).online
            truth = matched(log.truth, online)
            squares += [np.square(getattr(online, x) - getattr(truth, x)).mean() for x in ("p_WB_W", "v_WB_W")]
    for name in ("iekf", "ukf"):
        assert np.sqrt(pooled[name] / pooled["eskf"]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_where_sigma_points_lie_hardly_matters_from_a_good_start(alpha: float) -> None:
    log = simulate(Scenario(duration_s=60.0), seed=2)
    a, b = (run_log(log, create("ukf", **options)).beliefs[-1] for options in ({}, {"alpha": alpha}))
    sigma = np.sqrt(np.diag(a.P))
    assert np.abs(a.state.local(b.state) / sigma).max() < 0.05
    assert np.diag(b.P) == pytest.approx(np.diag(a.P), rel=0.02)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("psi", [-180.0, 180.0])
def test_a_heading_across_the_wrap_is_no_full_turn(name: str, psi: float) -> None:
    log = simulate(Scenario(duration_s=30.0, course_deg=psi), seed=3)
    heading = heading_error_rad(log.truth, run_log(log, create(name)).online)
    assert np.sqrt(np.mean(heading**2)) < DEGREE


# -- late readings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILTERS)
def test_late_readings_are_replayed(name: str) -> None:
    """Late, but all received by the end: the last belief is that of a log in which they came in time."""
    in_time = simulate(Scenario(duration_s=30.0), seed=5)
    delayed = simulate(Scenario(duration_s=30.0, **DELAYED), seed=5)
    last_ns = int(delayed.imu.t_ns[-1] - 1e9)
    a, b = (run_log(until(log, last_ns), create(name)) for log in (in_time, delayed))
    assert b.counts["replayed"] > 100
    assert b.counts["late"] == 0
    state, P = difference(a.beliefs[-1], b.beliefs[-1])
    assert (state, P) == pytest.approx((0, 0), abs=1e-3)
