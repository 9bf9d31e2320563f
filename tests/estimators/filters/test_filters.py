"""The filters agree where theory says so, and the invariant one survives a wrong heading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.execution.result import Result
from fathom.bench.metrics import associate, state_errors
from fathom.bench.metrics.pose_error import heading_roll_pitch, wrapped
from fathom.datasets import Belief, ImuNoise, Log, NavState, Rig
from fathom.datasets.epochs import DEPTH, DVL, GPS, IMU_SAMPLE, Epoch
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DvlSpec, GpsSpec
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
from paths import GRAVITY, Path, random_rig, random_state, reading
from scipy.spatial.transform import Rotation

FILTERS = ["eskf", "eskf-filterpy", "iekf", "ukf", "rts"]
"""By their online beliefs; rts gives eskf's until it finishes."""
DEGREE = np.pi / 180


def difference(a: Belief, b: Belief) -> tuple[float, float]:
    """The largest difference of state, and of covariance over σᵢσⱼ."""
    sigma = np.sqrt(np.diag(a.P))
    return np.abs(a.state.local(b.state)).max(), np.abs((a.P - b.P) / np.outer(sigma, sigma)).max()


def beliefs(result: Result) -> list[Belief]:
    track = result.online
    return [Belief(int(t), track.state(k), track.P[k]) for k, t in enumerate(track.t_ns)]


# -- one filter, written twice ----------------------------------------------------------------------------------------

DELAYED = {"dvl": DvlSpec(delay_s=0.31), "gps": GpsSpec(delay_s=0.83)}


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(duration_s=120.0),
        Scenario(mission="yo-yo", duration_s=120.0, imu="consumer"),
        Scenario(duration_s=120.0, **DELAYED),
    ],
    ids=["lawnmower", "yo-yo", "delayed"],
)
def test_filterpys_filter_is_ours_over_a_whole_mission(scenario: Scenario) -> None:
    log = simulate(scenario, seed=4)
    ours, theirs = run_log(log, create("eskf")), run_log(log, create("eskf-filterpy"))
    assert theirs.counts == ours.counts
    assert len(beliefs(ours)) == 120
    worst = np.array([difference(a, b) for a, b in zip(beliefs(ours), beliefs(theirs), strict=True)])
    assert worst.max() < 1e-6


# -- a linear toy -----------------------------------------------------------------------------------------------------

TINY = 1e-12
TOY_RIG = Rig(ImuNoise(TINY, 2e-3, TINY, 1e-4, TINY, 0.02), gravity=GRAVITY)
LINEAR = np.r_[3:12]
"""Position, velocity and accelerometer bias: all that is uncertain in the toy."""


def linear_toy(seed: int, epochs: int = 40, rig: Rig = TOY_RIG) -> tuple[Belief, list[Epoch]]:
    """A vehicle that never turns and knows its attitude: then every sensor is linear in what it does not know."""
    rng, noise = np.random.default_rng(seed), rig.imu_noise
    R_WB, n, dt_s = Rotation.random(rng=rng).as_matrix(), 20, 0.01
    p, v, b_a = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3) * noise.accel_bias_sigma
    sigma = np.repeat([TINY, 1.0, 0.2, noise.accel_bias_sigma, TINY], 3)
    draw = sigma * rng.normal(size=15)
    prior = Belief(0, NavState(R_WB, p, v, b_a, np.zeros(3)).retract(np.r_[np.zeros(3), draw[3:12], np.zeros(3)]), None)
    cut, up, R_IW = [], np.array([0.0, 0.0, GRAVITY]), (R_WB @ rig.imu.R_BS).T
    for k in range(epochs):
        imu = np.zeros(n, IMU_SAMPLE)
        imu["t_ns"] = np.round((np.arange(1, n + 1) + n * k) * dt_s * 1e9)
        imu["dt_s"] = imu["period_s"] = dt_s
        a_W = 0.3 * rng.normal(size=3)
        imu["f_I"] = R_IW @ (a_W + up) + b_a + noise.accel_density / np.sqrt(dt_s) * rng.normal(size=(n, 3))
        T = n * dt_s
        p, v = p + v * T + 0.5 * a_W * T**2, v + a_W * T
        t_ns = int(imu["t_ns"][-1])
        rows = [reading(DVL, R_WB.T @ v + 0.01 * rng.normal(size=3), np.full(3, 0.01), t_ns)]
        if k % 2:
            rows.append(reading(DEPTH, p[2:] + 0.02 * rng.normal(), np.array([0.02]), t_ns))
        if k % 5 == 0:
            rows.append(reading(GPS, p + rng.normal(size=3), np.array([1.0, 1.0, np.inf]), t_ns))
        cut.append(Epoch(t_ns, imu, np.concatenate(rows), True))
    return replace(prior, P=np.diag(sigma**2)), cut


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
def test_invariant_filter_finds_a_heading_that_is_60_degrees_off(known: str) -> None:
    error_deg: dict[str, list[float]] = {"iekf": [], "eskf": []}
    for seed in range(12):
        log = with_unknown_heading(simulate(AFLOAT, seed), seed, known)
        for name, errors in error_deg.items():
            truth, online = associate(log.truth, run_log(log, create(name)).online)
            heading = wrapped(heading_roll_pitch(online.R_WB) - heading_roll_pitch(truth.R_WB))[:, 0]
            errors.append(abs(heading[truth.t_ns == log.start_ns + 60 * 10**9][0]) / DEGREE)
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
            truth, online = associate(log.truth, run_log(log, create(name)).online)
            e = state_errors(truth, online)
            squares += [((online.p_WB_W - truth.p_WB_W) ** 2).mean(), e.velocity_m_s**2]
    for name in ("iekf", "ukf"):
        assert np.sqrt(pooled[name] / pooled["eskf"]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_where_sigma_points_lie_hardly_matters_from_a_good_start(alpha: float) -> None:
    log = simulate(Scenario(duration_s=60.0), seed=2)
    a, b = (beliefs(run_log(log, create("ukf", **options)))[-1] for options in ({}, {"alpha": alpha}))
    sigma = np.sqrt(np.diag(a.P))
    assert np.abs(a.state.local(b.state) / sigma).max() < 0.05
    assert np.diag(b.P) == pytest.approx(np.diag(a.P), rel=0.02)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("psi", [-180.0, 180.0])
def test_a_heading_across_the_wrap_is_no_full_turn(name: str, psi: float) -> None:
    log = simulate(Scenario(duration_s=30.0, course_deg=psi), seed=3)
    truth, online = associate(log.truth, run_log(log, create(name)).online)
    assert state_errors(truth, online).heading_deg < 1.0


# -- late readings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILTERS)
def test_late_readings_are_lived_through_again(name: str) -> None:
    """Late, but all received by the end: the last belief is that of a log in which they came in time."""
    in_time = simulate(Scenario(duration_s=30.0), seed=5)
    delayed = simulate(Scenario(duration_s=30.0, **DELAYED), seed=5)
    last_ns = int(delayed.imu.t_ns[-1] - 1e9)
    a, b = (
        run_log(replace(log, **{key: _until(stream, last_ns) for key, stream in log.streams.items()}), create(name))
        for log in (in_time, delayed)
    )
    assert b.counts["replayed"] > 100
    assert b.counts["late"] == 0
    state, P = difference(beliefs(a)[-1], beliefs(b)[-1])
    assert (state, P) == pytest.approx((0, 0), abs=1e-3)


def _until(stream: object, t_ns: int) -> object:
    rows = stream.t_ns <= t_ns
    return type(stream)(stream.t_ns[rows], stream.received_ns[rows], stream.z[rows], stream.sigma[rows])
