"""The filters agree where theory says so, and the invariant one survives a wrong heading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import BLOCKS, FILTERS, heading_error_rad, matched, run_log, summed_nees
from fathom.datasets import Belief, Log, NavState
from fathom.datasets.epochs import DVL, GPS, IMU_SAMPLE, Epoch
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import create
from fathom.estimators.filters.eskf import inject_first_estimate
from fathom.estimators.filters.iekf import InvariantKalman
from fathom.estimators.interface import FACTORS
from fathom.estimators.physics.imu import BLOCK, integrate, predict
from fathom.estimators.physics.imu import compile_rig as compiled
from fathom.estimators.physics.invariant import (
    from_invariant,
    inject_invariant,
    local_invariant,
    local_moved,
    retract_invariant,
    to_invariant,
)
from fathom.estimators.physics.kalman import carry
from fathom.estimators.physics.measurements import measure
from fathom.estimators.physics.so3 import inverse_right_jacobian, skew
from fathom.estimators.physics.state import STATE, as_belief, as_record
from fathom.estimators.physics.state import inject as plain_inject
from fathom.estimators.registry import EstimatorError
from linear import LINEAR, TOY_RIG, linear_toy
from logs import DELAYED, until
from paths import GRAVITY, Path, random_rig, random_state, reading
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

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
    x = random_state(rng)
    A, B = to_invariant(x.R_WB, x.v_WB_W), from_invariant(x.R_WB, x.v_WB_W)
    assert np.allclose(A @ B, np.eye(15), atol=1e-12)
    for k, step in enumerate(1e-6 * np.eye(15)):
        ends = []
        for sign in (1, -1):
            record = as_record(Belief(0, x, np.eye(15)))
            retract_invariant(record, sign * step, record)
            ends.append(as_belief(0, record).state)
        assert np.allclose(x.local(ends[0]) - x.local(ends[1]), 2e-6 * B[:, k], atol=1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_a_large_correction_is_undone_by_its_inverse_and_leaves_the_invariant_covariance(seed: int) -> None:
    """A radian and tens of metres; the covariance of the invariant error, by the page's matrices, is the same after."""
    rng = np.random.default_rng(seed)
    x, M, error = random_state(rng), rng.normal(size=(15, 15)), np.empty(15)
    dx = rng.normal(size=15) * np.repeat([0.5, 30.0, 3.0, 0.1, 0.1], 3)
    old = as_record(Belief(0, x, M @ M.T))
    new = old.copy()
    inject_invariant(new, dx)
    local_moved(old, new, error)
    assert np.allclose(error, dx, rtol=1e-9, atol=1e-12)
    assert np.array_equal(new["p_WB_W"][0], x.p_WB_W + dx[3:6])  # whatever the rotation
    before, after = (to_invariant(s["R_WB"][0], s["v_WB_W"][0]) for s in (old, new))
    assert np.allclose(after @ new["P"][0] @ after.T, before @ old["P"][0] @ before.T, rtol=1e-9, atol=1e-9)


def test_an_invariant_correction_is_the_most_likely_state_and_its_curvature() -> None:
    """With the heading 40° off, by finite differences of the cost in the invariant error of the prediction."""
    rng = np.random.default_rng(3)
    x, rig = random_state(rng), random_rig(rng, 1.0)
    B, P = from_invariant(x.R_WB, x.v_WB_W), np.diag(np.repeat([0.02, 2.0, 0.05, 0.1, 0.01], 3) ** 2)
    P[2, 2] = 0.5**2
    old, records, at = as_record(Belief(0, x, B @ P @ B.T)), compiled(rig, FACTORS, {}), np.zeros(1, STATE)
    truth = old.copy()
    retract_invariant(old, np.r_[0.0, 0.0, 0.7, rng.normal(size=3), 0.05 * rng.normal(size=3), np.zeros(6)], truth)
    x_true = as_belief(0, truth).state
    rows = np.concatenate(
        [
            reading(DVL, x_true.R_WB.T @ x_true.v_WB_W, np.full(3, 0.02)),
            reading(GPS, x_true.p_WB_W + x_true.R_WB @ rig.gps.p_BS_B, np.full(3, 0.1)),
        ]
    )
    new = old.copy()
    assert InvariantKalman().correct(new, records, rows)
    xi = np.empty(15)
    local_invariant(old, new, xi)
    assert abs(xi[2]) > 0.1

    def whitened(error: np.ndarray) -> np.ndarray:
        retract_invariant(old, error, at)
        parts = [error / np.sqrt(np.diag(P))]
        for m in range(len(rows)):
            r, H, C = np.empty(3), np.empty((3, 15)), np.empty((3, 3))
            measure(rows, m, at, records, r, H, C)
            parts.append(np.linalg.solve(np.linalg.cholesky(C), r))
        return np.concatenate(parts)

    J = np.stack([(whitened(xi + d) - whitened(xi - d)) / 2e-6 for d in 1e-6 * np.eye(15)], axis=1)
    cov, K = np.linalg.inv(J.T @ J), np.empty((15, 15))
    assert np.abs(J.T @ whitened(xi) * np.sqrt(np.diag(cov))).max() < 1e-3
    end = as_belief(0, new).state
    for k, d in enumerate(1e-6 * np.eye(15)):
        ends = []
        for sign in (1, -1):
            retract_invariant(old, xi + sign * d, at)
            ends.append(end.local(as_belief(0, at).state))
        K[:, k] = (ends[0] - ends[1]) / 2e-6
    sigma = np.sqrt(np.diag(new["P"][0]))
    assert np.abs((K @ cov @ K.T - new["P"][0]) / np.outer(sigma, sigma)).max() < 1e-3


def test_the_velocitys_second_order_is_that_of_many_draws() -> None:
    """Heading known to 25°, velocity in B to 0.05 m/s: it lies on an arc, and what is handed out covers the arc."""
    rng, n = np.random.default_rng(0), 200_000
    x = random_state(rng)
    sigma = np.repeat([1e-2, 1.0, 0.05, 1e-2, 1e-3], 3)
    P = np.diag(sigma**2)
    P[2, 2] = np.radians(25.0) ** 2
    B = from_invariant(np.eye(3), x.v_WB_W)
    xi = rng.normal(size=(n, 9)) * np.sqrt(np.diag(P))[:9]
    Exp, v = Rotation.from_rotvec(xi[:, :3]), x.v_WB_W
    e_v = Exp.apply(v) + xi[:, 6:9] - v  # J_l changes nu by 2 % of 0.05 m/s here
    state = np.zeros(1, STATE)
    state["R_WB"], state["P"] = np.eye(3), B @ P @ B.T
    handed_out = InvariantKalman().error_covariance(state)[6:9, 6:9]
    drawn, plain = e_v.T @ e_v / n, state["P"][0, 6:9, 6:9]
    excess = [np.linalg.eigvals(np.linalg.solve(C, drawn)).real.max() for C in (plain, handed_out)]
    assert excess[0] > 10
    assert excess[1] < 1.2


def block_of(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half a second of any motion: (state record at its start, block, rig record)."""
    rng = np.random.default_rng(seed)
    path, rig, dt_s = Path(seed), random_rig(rng, 1.0), 0.01
    imu = path.imu(dt_s * np.arange(0, 51), dt_s, rig, np.zeros(3), np.zeros(3))
    records, block = compiled(rig, FACTORS, {}), np.zeros(1, BLOCK)
    integrate(imu[1:], imu[:1], np.zeros(3), np.zeros(3), records, block)
    return as_record(Belief(0, path.state(0.0, np.zeros(3), np.zeros(3)), np.zeros((15, 15)))), block, records


@pytest.mark.parametrize("seed", range(3))
def test_the_block_carries_a_large_error_of_rotation_and_velocity_exactly(seed: int) -> None:
    """Log-linear: 2 rad and 10 m/s are carried by Φ to the last digits, no matter the state."""
    x, block, _ = block_of(seed)
    xi = np.r_[np.random.default_rng(seed).normal(size=9), np.zeros(6)]
    xi[6:9] *= 10
    wrong, F, end = x.copy(), np.empty((15, 15)), np.zeros(1, STATE)
    retract_invariant(x, xi, wrong)
    predict(block, x, GRAVITY, F, end)
    predict(block, wrong, GRAVITY, F, wrong)
    carried, v_g = end.copy(), block["T"][0] * np.array([0, 0, -GRAVITY])
    carried["v_WB_W"] -= v_g  # Γ Exp(xi) Γ⁻¹ X: take the block's gravity off, turn, and put it on again
    retract_invariant(carried, xi, carried)
    carried["v_WB_W"] += v_g
    assert np.abs(carried["R_WB"] - wrong["R_WB"]).max() < 1e-12
    assert np.abs(carried["v_WB_W"] - wrong["v_WB_W"]).max() < 1e-10


@pytest.mark.parametrize("seed", range(3))
def test_only_the_way_travelled_enters_the_invariant_transition(seed: int) -> None:
    """Ours, seen in the invariant error, against the closed form of the page."""
    x, block, _ = block_of(seed)
    F, end, T, g = np.empty((15, 15)), np.zeros(1, STATE), block["T"][0], skew(np.array([0.0, 0.0, -GRAVITY]))
    predict(block, x, GRAVITY, F, end)
    Phi = to_invariant(end["R_WB"][0], end["v_WB_W"][0]) @ F @ from_invariant(x["R_WB"][0], x["v_WB_W"][0])
    expected = np.eye(9)
    expected[3:6, :3] = T**2 / 2 * g - skew(end["p_WB_W"][0] - x["p_WB_W"][0])
    expected[3:6, 6:9], expected[6:9, :3] = T * np.eye(3), T * g
    assert np.allclose(Phi[:9, :9], expected, atol=1e-9)


AFLOAT = Scenario(duration_s=90.0, surface_for_s=600.0, surface_every_s=1000.0, heading=None)
"""Under way at the surface with GPS and DVL, and nothing that gives a heading."""


def with_unknown_heading(log: Log, seed: int, known: str, sigma_deg: float = 60.0, draw: bool = False) -> Log:
    """The log with a prior that is σ off in heading, to either side (or drawn), and says so.

    Its velocity is known in B, as a DVL gives it, and so turned with the heading; or in W, as GPS gives it; or hardly.
    """
    rng, truth, noise = np.random.default_rng(seed), log.truth.state(0), log.rig.imu_noise
    yaw = sigma_deg * DEGREE * (rng.normal() if draw else (-1) ** seed)
    turn = Rotation.from_rotvec([*rng.normal(size=2) * DEGREE, yaw]).as_matrix()
    sigma = np.repeat([DEGREE, 1.5, 0.05, noise.accel_bias_sigma, noise.gyro_bias_sigma], 3)
    sigma[2] = sigma_deg * DEGREE
    if known == "hardly":
        sigma[6:9] = 1.5
    v_WB_W = truth.v_WB_W + 0.05 * rng.normal(size=3)
    if known != "in W":
        v_WB_W = turn @ v_WB_W
    x = NavState(turn @ truth.R_WB, truth.p_WB_W + 1.5 * rng.normal(size=3), v_WB_W, np.zeros(3), np.zeros(3))
    B = from_invariant(x.R_WB, v_WB_W if known == "in B" else np.zeros(3))
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


@pytest.mark.slow
@pytest.mark.parametrize("regime", ["unknown heading", "no DVL, then a fix"])
def test_the_invariant_filter_and_its_smoother_do_not_claim_what_they_cannot_know(regime: str) -> None:
    """Where `eskf` claims yaw from a heading 25° off, and a group that holds position claims tilt from a fix 40 m off.

    The band of 0.999 is shared among epochs, parts of the state and outputs.
    """
    if regime == "unknown heading":
        epochs_s, options = (5, 20, 60), {}
        logs = [with_unknown_heading(simulate(AFLOAT, seed), seed, "in B", 25.0, draw=True) for seed in range(10)]
    else:
        epochs_s, options = (60, 180, 235), {"factors": ["depth", "gps", "heading"]}
        dive = Scenario(duration_s=240, imu="tactical", surface_every_s=110, leg_m=40, dvl=None)
        logs = [simulate(dive, seed) for seed in range(10)]
    low, high = chi2.interval(1 - 0.001 / (2 * 3 * len(epochs_s)), 3 * len(logs))
    parts = {part: BLOCKS[part] for part in ("attitude", "position", "velocity")}
    for output, sums in summed_nees(create("rts", **options), logs, epochs_s, parts).items():  # online it is iekf
        for part, total in sums.items():
            assert (total > low).all(), (output, part, total / (3 * len(logs)))
            assert (total < high).all(), (output, part, total / (3 * len(logs)))


# -- remedies of the field --------------------------------------------------------------------------------------------


def test_an_update_iterated_to_its_end_is_the_most_likely_state() -> None:
    """The gradient of the joint cost vanishes there; one linearisation is far from it. filterpy's does the same."""
    rng = np.random.default_rng(4)
    x, M = random_state(rng), rng.normal(size=(15, 15)) * np.repeat([0.1, 2.0, 0.5, 0.1, 0.01], 3)[:, None]
    prior, rig = Belief(0, x, M @ M.T + 1e-6 * np.eye(15)), random_rig(rng, 1.0)
    true, records = x.retract(0.5 * M @ rng.normal(size=15)), compiled(rig, FACTORS, {})
    rows = np.concatenate(
        [
            reading(DVL, true.R_WB.T @ true.v_WB_W, np.full(3, 0.02)),
            reading(GPS, true.p_WB_W + true.R_WB @ rig.gps.p_BS_B, np.full(3, 0.5)),
        ]
    )
    gradients, ends = [], []
    for name, iterations in (("eskf", 1), ("eskf", 30), ("eskf-filterpy", 30)):
        run = create(name, iterations=iterations).begin(prior, rig)
        run.step(Epoch(0, np.zeros(0, IMU_SAMPLE), rows, False))
        ends.append(run.belief())
        d = x.local(ends[-1].state)
        J = np.eye(15)
        J[:3, :3] = inverse_right_jacobian(d[:3])
        gradient = J.T @ np.linalg.solve(prior.P, d)
        for m in range(len(rows)):
            r, H, C = np.empty(3), np.empty((3, 15)), np.empty((3, 3))
            n = measure(rows, m, as_record(ends[-1]), records, r, H, C)
            gradient += H[:n].T @ np.linalg.solve(C[:n, :n], r[:n])
        gradients.append(np.abs(gradient * np.sqrt(np.diag(ends[-1].P))).max())
    assert gradients[0] > 1
    assert gradients[1] < 1e-3
    assert difference(ends[1], ends[2]) == pytest.approx((0, 0), abs=1e-6)


def test_iterating_changes_nothing_where_all_is_linear() -> None:
    prior, epochs = linear_toy(0)
    once, often = create("eskf").begin(prior, TOY_RIG), create("eskf", iterations=4).begin(prior, TOY_RIG)
    for epoch in epochs:
        once.step(epoch)
        often.step(epoch)
    assert difference(once.belief(), often.belief())[0] < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_first_estimates_keep_an_unknown_turn_unknown(seed: int) -> None:
    """The whole track turned about W's origin is carried from prediction to prediction, whatever the correction."""
    x, block, _ = block_of(seed)
    z, lost = np.array([0.0, 0.0, 1.0]), block.copy()
    lost["N"], lost["bias_walk"] = 0.0, 0.0

    def turned(s: np.ndarray) -> np.ndarray:
        return np.r_[s["R_WB"][0].T @ z, np.cross(z, s["p_WB_W"][0]), np.cross(z, s["v_WB_W"][0]), np.zeros(6)]

    ends = []
    for inject in (inject_first_estimate, plain_inject):
        at = x.copy()
        at["P"] = np.outer(turned(at), turned(at))
        inject(at, 0.3 * np.random.default_rng(seed).normal(size=15))
        carry(lost, at, GRAVITY)
        ends.append(np.abs(at["P"][0] - np.outer(turned(at), turned(at))).max())
    assert ends[0] < 1e-9
    assert ends[1] > 0.1


@pytest.mark.parametrize("options", [{"iterations": 3}, {"first_estimate": True}])
def test_filterpys_filter_has_the_same_remedies(options: dict[str, object]) -> None:
    log = with_unknown_heading(simulate(replace(AFLOAT, duration_s=20.0), 1), 1, "in B", 15.0)
    ours, theirs = (run_log(log, create(name, **options)).beliefs for name in ("eskf", "eskf-filterpy"))
    plain = run_log(log, create("eskf")).beliefs
    worst = np.array([difference(a, b) for a, b in zip(ours, theirs, strict=True)])
    assert worst.max() < 1e-6
    assert difference(ours[0], plain[0])[1] > 1e-3


def test_both_remedies_at_once_are_refused() -> None:
    with pytest.raises(EstimatorError, match="leave iterations at 1"):
        create("eskf", iterations=2, first_estimate=True)


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
