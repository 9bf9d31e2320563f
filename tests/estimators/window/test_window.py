"""`window` is `fls` and, without end, `batch`: the same optimum on the same graph, for a small part of the time."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter, thread_time_ns

import numpy as np
import pytest
from driver import BLOCKS, Driven, gaps_in_sigma, rmse_m, run_log, summed_nees, ticks
from fathom.datasets import Belief, Log, NavState
from fathom.datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING, READING, cut
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, GpsSpec, HeadingSpec
from fathom.datasets.state import DIM, POSITION
from fathom.estimators import FACTORS, Diverged, create
from fathom.estimators.graph import solvers
from fathom.estimators.graph.losses import m_estimator
from fathom.estimators.physics.dvl_preintegration import DISPLACEMENT, given_rotation, preintegrate_dvl
from fathom.estimators.physics.elimination import absorb_row, divide_into
from fathom.estimators.physics.imu import BLOCK, compile_rig, integrate, predict, process_noise
from fathom.estimators.physics.state import STATE, as_belief, as_record
from fathom.estimators.robust import LOSSES, weight_of, width
from fathom.estimators.window.chain import (
    NODE,
    absorb_joint_row,
    back_substitute,
    cross_tie,
    smooth_covariances,
)
from fathom.estimators.window.factors import (
    AT_KEYFRAME,
    CARRIED,
    FACTOR,
    LOOSE,
    TIGHT,
    linearise_factor,
    linearise_prior,
    linearise_tie,
)
from linear import LAG, SEEDS, apart, exact, run
from paths import Path, random_rig, random_rotation, random_state, reading
from scipy.linalg import logm
from scipy.stats import chi2

SMALL = {"depth_m": 5.0, "shallow_m": 1.0, "leg_m": 15.0, "turn_radius_m": 5.0, "surface_for_s": 20.0}
SLOW_SENSORS = {"dvl": DvlSpec(2.5), "depth": DepthSpec(5.0), "heading": HeadingSpec(2.5)}
SHORT = Scenario(duration_s=20.0, imu="tactical", **SMALL, **SLOW_SENSORS)
MINUTE = Scenario(duration_s=60.0, imu="tactical", **SMALL)
TO_OPTIMUM = {"relinearize": [0.0] * 4, "extra_updates": 30}
AS_GTSAM = {**TO_OPTIMUM, "relinearize_prior": False}
"""It keeps what touches the marginal prior, as GTSAM does."""
LATE = {"gps": GpsSpec(delay_s=1.0), "heading": HeadingSpec(2.5, delay_s=1.0)}
ODD = {
    "dvl": DvlSpec(rate_hz=3.7, delay_s=0.013),
    "depth": DepthSpec(rate_hz=9.3, delay_s=0.05),
    "heading": HeadingSpec(rate_hz=4.1, delay_s=0.4),
}
LOSS_BY_SENSOR = {"gps": "huber", "heading": "cauchy", "dvl": "huber"}


# --- GTSAM's optimum -------------------------------------------------------------------------------------------------


@pytest.fixture
def to_the_last_digit(monkeypatch: pytest.MonkeyPatch) -> None:
    """GTSAM's Levenberg–Marquardt stops where the cost changes by 1e-5 of itself; let it go on to 1e-12."""
    usual = solvers.levenberg_marquardt_params

    def params(factorization: str) -> object:
        made = usual(factorization)
        made.setRelativeErrorTol(1e-12)
        made.setAbsoluteErrorTol(1e-12)
        return made

    monkeypatch.setattr(solvers, "levenberg_marquardt_params", params)


def assert_one(ours: Driven, theirs: Driven, tolerance_m: float = 1e-3) -> None:
    """Positions to a millimetre, attitudes to 0.1 mrad, standard deviations to 1 %, and counts to the last one.

    Outliers to two: ours are counted when a keyframe has seen the one that makes it leave, theirs just before.
    """
    assert ours.status == theirs.status == "done", (ours.cause, theirs.cause)
    for name, n in theirs.counts.items():
        assert ours.counts[name] == pytest.approx(n, abs=2 if name.startswith("outliers") else 0), name
    for a, b in ((ours.online, theirs.online), (ours.smoothed, theirs.smoothed)):
        assert np.array_equal(a.t_ns, b.t_ns)
        assert np.linalg.norm(a.p_WB_W - b.p_WB_W, axis=1).max() < tolerance_m
        assert np.abs(np.einsum("nji,njk->nik", a.R_WB, b.R_WB) - np.eye(3)).max() < 1e-4
        kept = np.isfinite(b.P[:, 0, 0])
        assert kept.any()
        assert np.array_equal(kept, np.isfinite(a.P[:, 0, 0]))
        ratio = np.sqrt(np.einsum("nii->ni", a.P[kept]) / np.einsum("nii->ni", b.P[kept]))
        assert np.abs(ratio - 1).max() < 0.01


@pytest.mark.usefixtures("to_the_last_digit")
def test_at_a_lag_it_reaches_gtsams_optimum() -> None:
    log = simulate(SHORT, seed=3)
    assert_one(run_log(log, create("window", **AS_GTSAM)), run_log(log, create("fls-batch", imu_factor="fathom")))


@pytest.mark.usefixtures("to_the_last_digit")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"dvl": ["preintegrated-loose"]},
        {"dvl": ["preintegrated-tight"]},
        {"dvl": ["preintegrated-tight", "velocity"], "dvl_between": "straight"},
        pytest.param({"robust": dict.fromkeys(["gps", "depth", "dvl"], "huber")}, marks=pytest.mark.slow),
    ],
    ids=["velocity", "loose", "tight", "tight and velocity", "robust"],
)
def test_at_a_lag_it_is_online_the_optimum_of_all_readings_so_far(options: dict) -> None:
    """GTSAM's, with nothing marginalised: ours forgets keyframes, and loses nothing but what is not linear in them.

    GTSAM's batch lag is no oracle of these: it keeps what touches its marginal prior, and its damped steps end some
    millimetres from its own optimum where a fix moves what is kept.
    """
    log = simulate(SHORT, seed=3)
    ours = run_log(log, create("window", **TO_OPTIMUM, **options)).online
    whole = run_log(log, create("fls-batch", lag_s=100.0, imu_factor="fathom", **options)).online
    assert np.linalg.norm(ours.p_WB_W - whole.p_WB_W, axis=1).max() < 1e-3
    assert np.abs(np.einsum("nji,njk->nik", ours.R_WB, whole.R_WB) - np.eye(3)).max() < 1e-4
    assert np.abs(np.sqrt(np.einsum("nii->ni", ours.P) / np.einsum("nii->ni", whole.P)) - 1).max() < 0.01


@pytest.mark.parametrize("factor", ["preintegrated-loose", "preintegrated-tight"])
@pytest.mark.parametrize(
    "dvl",
    [DvlSpec(delay_s=0.15), DvlSpec(disorder_s=0.2), DvlSpec(delay_s=0.6, disorder_s=0.2)],
    ids=["late", "out of order", "both"],
)
def test_late_dvl_readings_are_summed_up_to_their_keyframe_and_no_further(dvl: DvlSpec, factor: str) -> None:
    log = simulate(replace(SHORT, duration_s=30.0, dvl=dvl), seed=3)
    options = {"dvl": [factor], "imu_factor": "fathom"}
    ours, theirs = run_log(log, create("window", dvl=[factor])).online, run_log(log, create("fls", **options)).online
    assert ours is not None
    assert theirs is not None
    np.testing.assert_allclose(ours.p_WB_W, theirs.p_WB_W, atol=0.01)


@pytest.mark.slow
@pytest.mark.usefixtures("to_the_last_digit")
@pytest.mark.parametrize(
    ("change", "options"),
    [
        ({}, {}),
        ({"mission": "yo-yo"}, {}),
        ({"mission": "yo-yo"}, {"lag_s": 10.0}),
        ({}, {"keyframe_period_s": 1.0}),
        (LATE, {}),
        (ODD, {}),
    ],
    ids=["lawnmower", "yo-yo", "yo-yo at 10 s", "sparse", "late", "odd"],
)
def test_at_a_lag_it_reaches_gtsams_optimum_for_all_sensors_and_options(change: dict, options: dict) -> None:
    log = simulate(replace(SHORT, duration_s=30.0, **change), seed=3)
    assert_one(
        run_log(log, create("window", **TO_OPTIMUM, **options)),
        run_log(log, create("fls-batch", imu_factor="fathom", **options)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
def test_with_a_doubted_heading_it_is_isam2_with_nothing_put_off(loss: str) -> None:
    """To 2 mm: iSAM2 lets a state go one step before its optimum. GTSAM's batch lag is no oracle here: at the fourth
    second of this log its damped steps end 0.5 mrad from both of them, a step later they are together again.
    """  # fmt: skip
    log = simulate(SHORT, seed=3)
    options = {"robust": {"gps": loss, "heading": loss}, "relinearize": [0.0] * 4, "extra_updates": 8}
    assert_one(
        run_log(log, create("window", **options)),
        run_log(log, create("fls", imu_factor="fathom", wildfire=0.0, **options)),
        2e-3,
    )


@pytest.mark.usefixtures("to_the_last_digit")
@pytest.mark.parametrize(
    "options", [{}, {"dvl": ["preintegrated-loose"]}, {"robust": LOSS_BY_SENSOR}], ids=["velocity", "loose", "robust"]
)
def test_over_the_whole_log_both_engines_of_batch_end_at_one_optimum(options: dict) -> None:
    log = simulate(SHORT, seed=4)
    exact = {"relinearize": [0.0] * 4, "wildfire": 0.0, "extra_updates": 5}  # GTSAM's covariances are iSAM2's
    ours = run_log(log, create("batch", engine="window", **options))
    theirs = run_log(log, create("batch", imu_factor="fathom", **exact, **options))
    assert ours.status == "done", ours.cause
    a, b = ours.smoothed, theirs.smoothed
    assert np.isinf(a.lookahead_s)
    assert np.linalg.norm(a.p_WB_W - b.p_WB_W, axis=1).max() < 1e-3
    if "robust" not in options:  # whose covariances are iSAM2's, of weights as old as its linearisation
        kept = np.isfinite(b.P[:, 0, 0])
        assert np.abs(np.sqrt(np.einsum("nii->ni", a.P[kept]) / np.einsum("nii->ni", b.P[kept])) - 1).max() < 0.01


@pytest.mark.slow
@pytest.mark.usefixtures("to_the_last_digit")
@pytest.mark.parametrize("mission", ["lawnmower", "yo-yo"])
def test_a_lag_longer_than_the_log_is_batch(mission: str) -> None:
    log = simulate(replace(MINUTE, mission=mission), seed=3)
    ours, theirs = (
        run_log(log, create("window", lag_s=100.0, smoothed_covariance_s=60.0, **TO_OPTIMUM)),
        run_log(log, create("batch", imu_factor="fathom")),
    )
    assert np.linalg.norm(ours.smoothed.p_WB_W - theirs.smoothed.p_WB_W, axis=1).max() < 1e-3
    ratio = np.einsum("nii->ni", ours.smoothed.P[:1]) / np.einsum("nii->ni", theirs.smoothed.P[:1])
    assert np.abs(np.sqrt(ratio) - 1).max() < 0.01
    engine = run_log(log, create("batch", engine="window"))
    assert np.linalg.norm(ours.smoothed.p_WB_W - engine.smoothed.p_WB_W, axis=1).max() < 1e-5


def test_as_shipped_it_equals_fls() -> None:
    """From the second tick on: at the first, iSAM2 leaves be what ours has linearised anew."""
    log = simulate(SHORT, seed=4)
    ours, theirs = run_log(log, create("window")), run_log(log, create("fls", imu_factor="fathom"))
    for a, b in ((ours.online, theirs.online), (ours.smoothed, theirs.smoothed)):
        assert np.linalg.norm(a.p_WB_W - b.p_WB_W, axis=1)[1:].max() < 3e-3
    ratio = np.einsum("nii->ni", ours.online.P) / np.einsum("nii->ni", theirs.online.P)
    assert np.abs(np.sqrt(ratio[1:]) - 1).max() < 0.01


def test_linearising_the_marginal_prior_anew_moves_it_by_millimetres() -> None:
    log = simulate(SHORT, seed=3)
    kept, anew = (run_log(log, create("window", relinearize_prior=anew, **TO_OPTIMUM)) for anew in (False, True))
    gap = np.linalg.norm(kept.online.p_WB_W - anew.online.p_WB_W, axis=1).max()
    assert 1e-6 < gap < 5e-3


# --- where all is linear ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("thorough", [False, True], ids=["as shipped", "to the last digit"])
@pytest.mark.parametrize("seed", SEEDS)
def test_online_it_is_the_filter_and_least_squares_so_far(seed: int, thorough: bool) -> None:
    online, _ = run("window", seed, thorough)
    assert apart(online, run("eskf", seed)[0]) < 1e-6
    assert apart(online, [exact(seed, k + 1)[k] for k in range(len(online))]) < 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_at_a_lag_smoothed_states_are_least_squares_on_the_readings_so_far(seed: int) -> None:
    _, smoothed = run("window", seed)
    n = len(smoothed)
    assert apart(smoothed, [exact(seed, min(k + LAG + 1, n))[k] for k in range(n)]) < 1e-6
    assert apart(smoothed[: -2 * LAG], exact(seed, n)[: -2 * LAG]) > 1e-3  # the window does matter


# --- the chain against dense least squares ---------------------------------------------------------------------------


def _covariance(rng: np.random.Generator, size: float) -> np.ndarray:
    A = rng.normal(size=(DIM, DIM))
    return size**2 * (A @ A.T / DIM + 0.1 * np.eye(DIM))


@pytest.mark.parametrize("seed", range(3))
def test_a_chain_with_rows_on_one_and_on_two_keyframes_is_dense_least_squares(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 6
    nodes, A, b = np.zeros(8, NODE), [], []

    def whitened(P: np.ndarray, r: np.ndarray, parts: dict[int, np.ndarray]) -> None:
        W, row = np.linalg.inv(np.linalg.cholesky(P)), np.zeros((len(r), DIM * n))
        for k, H in parts.items():
            row[:, DIM * k : DIM * (k + 1)] = W @ H
        A.append(row)
        b.append(-W @ r)

    node = nodes[0]
    node["m_given"], node["P_given"] = rng.normal(size=DIM), _covariance(rng, 10.0)
    whitened(node["P_given"], -node["m_given"], {0: np.eye(DIM)})
    for k in range(n):
        node = nodes[k]
        node["m"], node["P"] = node["m_given"], node["P_given"]
        for _ in range(4):
            h, r = rng.normal(size=DIM), rng.normal()
            assert absorb_row(r, h, 0.5, node["m"], node["P"])
            whitened(np.array([[0.5]]), np.array([r]), {k: h[None]})
        if k == n - 1:
            break
        node["F"], node["Q"], node["c"] = rng.normal(size=(DIM, DIM)), _covariance(rng, 0.1), rng.normal(size=DIM)
        whitened(node["Q"], -node["c"], {k: -node["F"], k + 1: np.eye(DIM)})
        P_ji, ahead = np.empty((DIM, DIM)), nodes[k + 1]
        m_j, P_j = ahead["m_given"], ahead["P_given"]
        cross_tie(node["F"], node["Q"], node["c"], node["m"], node["P"], m_j, P_j, P_ji)
        for _ in range(2):
            h_i, h_j, r = rng.normal(size=DIM), rng.normal(size=DIM), rng.normal()
            assert absorb_joint_row(r, h_i, h_j, 0.3, node["m"], node["P"], m_j, P_j, P_ji)
            whitened(np.array([[0.3]]), np.array([r]), {k: h_i[None], k + 1: h_j[None]})
        assert divide_into(P_j, P_ji, node["Gt"])
    back_substitute(nodes, 0, n - 1)

    J = np.vstack(A)
    d = np.linalg.lstsq(J, np.concatenate(b), rcond=None)[0].reshape(n, DIM)
    P = np.linalg.inv(J.T @ J)
    smooth_covariances(nodes, 0, n - 1)
    for k in range(n):
        of = slice(DIM * k, DIM * (k + 1))
        sigma = np.sqrt(np.diag(P)[of])
        assert np.abs((nodes[k]["d"] - d[k]) / sigma).max() < 1e-7
        ours = nodes[k]["P_smoothed"]
        assert np.abs((ours - P[of, of]) / np.outer(sigma, sigma)).max() < 1e-7


def test_a_tie_of_a_micrometre_beside_a_prior_of_a_kilometre_costs_no_digits() -> None:
    """Closed form of a random walk: prior 1e6, steps 1e-12, one reading of 1e-4 at its end; variances in m².

    In the information form the sum 1e-6 + 1e12 has forgotten the prior.
    """
    n, prior, step, noise = 50, 1e6, 1e-12, 1e-4
    nodes, h = np.zeros(64, NODE), np.zeros(DIM)
    h[0] = 1.0
    nodes["F"], nodes["Q"] = np.eye(DIM), step * np.eye(DIM)
    nodes[0]["P_given"] = prior * np.eye(DIM)
    for k in range(n):
        node, ahead, P_ji = nodes[k], nodes[k + 1], np.empty((DIM, DIM))
        node["m"], node["P"] = node["m_given"], node["P_given"]
        if k == n - 1:
            assert absorb_row(-1.0, h, noise, node["m"], node["P"])
            break
        cross_tie(node["F"], node["Q"], node["c"], node["m"], node["P"], ahead["m_given"], ahead["P_given"], P_ji)
        assert divide_into(ahead["P_given"], P_ji, node["Gt"])
    back_substitute(nodes, 0, n - 1)
    spread = prior + (n - 1) * step + noise
    assert nodes[0]["d"][0] == pytest.approx(prior / spread, rel=1e-9)
    assert nodes[0]["d"][1] == 0.0
    smooth_covariances(nodes, 0, n - 1)
    P = nodes[0]["P_smoothed"]
    assert P[0, 0] == pytest.approx(prior * (noise + (n - 1) * step) / spread, rel=1e-4)
    assert P[1, 1] == pytest.approx(prior, rel=1e-9)


# --- rows and ties against finite differences ------------------------------------------------------------------------


def _moved(x: NavState, d: np.ndarray) -> np.ndarray:
    return as_record(Belief(0, x.retract(d), np.eye(DIM)))


def logarithm(R: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Rotation and translation (6,) of the logarithm of an element of SE(3), by that of its matrix (4, 4)."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, u
    L = logm(X).real
    return np.r_[L[2, 1], L[0, 2], L[1, 0], L[:3, 3]]


def _derivative(f, step: float = 1e-6) -> np.ndarray:
    return np.stack([(f(step * e) - f(-step * e)) / (2 * step) for e in np.eye(DIM)], axis=1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("what", ["dvl", "depth", "gps", "heading", "attitude", "carried", "loose", "tight"])
def test_rows_are_whitened_residuals_and_their_derivatives(what: str, seed: int) -> None:
    """At random states, biases and mountings."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    record = compile_rig(rig, FACTORS, {})
    record["rate_cov"] = 1e-4 * (np.eye(3) + 0.3)
    factors, readings = np.zeros(1, FACTOR), np.zeros(1, READING)
    carries, displacements = np.zeros(1, BLOCK), np.zeros(1, DISPLACEMENT)
    imu, still = Path(seed).imu(0.01 * np.arange(0, 91), 0.01, rig, np.zeros(3), np.zeros(3)), np.zeros(3)
    kinds = {"depth": DEPTH, "gps": GPS, "heading": HEADING, "attitude": ATTITUDE}
    factors["form"], factors["fresh"] = AT_KEYFRAME, 1
    if what in ("loose", "tight"):
        t_ns, v = np.arange(3) * 250_000_000, rng.normal(size=(3, 3))
        sigma = np.full((3, 3), 0.1)
        displacements = preintegrate_dvl(imu[1:], 0, t_ns, v, sigma, still, record, seed % 2 == 0, still)
        factors["form"] = TIGHT if what == "tight" else LOOSE
        K, C = given_rotation(displacements[0]["N"])
        factors["K"], factors["cov"] = K, C if what == "tight" else displacements[0]["N"][3:, 3:]
    else:
        z = random_rotation(rng).ravel() if what == "attitude" else rng.normal(size=3)
        readings = reading(kinds.get(what, DVL), z, np.full(3, 0.1))
        if what == "carried":
            factors["form"] = CARRIED
            integrate(imu[1:31], imu[:1], still, still, record, carries)
    x_i, x_j = random_state(rng), random_state(rng)

    def rows(d_i: np.ndarray, d_j: np.ndarray) -> np.ndarray:
        """The factor is fresh only the first time: what carries it keeps its noise."""
        at = _moved(x_i, d_i), _moved(x_j, d_j)
        assert linearise_factor(factors, 0, readings, carries, displacements, *at, record, np.full((5, 4), np.inf))
        return factors["r"][0, : factors["n"][0]].copy()

    zero = np.zeros(DIM)
    rows(zero, zero)
    H, H_j, n = factors["H"][0].copy(), factors["H_j"][0].copy(), int(factors["n"][0])
    assert n == (1 if what in ("depth", "heading") else 3)
    scale = max(1.0, np.abs(H).max())
    assert np.allclose(H[:n], _derivative(lambda d: rows(d, zero)), atol=1e-5 * scale)
    assert np.allclose(H_j[:n], _derivative(lambda d: rows(zero, d)), atol=1e-5 * scale)
    assert H_j.any() == (what in ("loose", "tight"))
    assert (what == "carried") == (factors["cov"][0, 0, 0] > 0.01 and factors["form"][0] == CARRIED)


@pytest.mark.parametrize("seed", range(4))
def test_a_tie_is_the_imu_residual_solved_for_the_later_keyframe(seed: int) -> None:
    """At random states, x_j well off what x_i predicts: r + J_i δ_i + J_j δ_j = noise, by finite differences."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    record, block = compile_rig(rig, FACTORS, {}), np.zeros(1, BLOCK)
    imu = Path(seed).imu(0.01 * np.arange(0, 31), 0.01, rig, np.zeros(3), np.zeros(3))
    x_i = random_state(rng)
    integrate(imu[1:], imu[:1], x_i.b_a + 0.01, x_i.b_g - 0.001, record, block)
    end, F, Q, c = np.zeros(1, STATE), np.empty((DIM, DIM)), np.empty((DIM, DIM)), np.empty(DIM)

    def residual(d_i: np.ndarray, d_j: np.ndarray) -> np.ndarray:
        predict(block, _moved(x_i, d_i), rig.gravity, np.empty((DIM, DIM)), end)
        x, j = as_belief(0, end).state, x_j.retract(d_j)
        e = x.local(j)
        e[6:9] = logarithm(x.R_WB.T @ j.R_WB, x.R_WB.T @ e[6:9])[3:]
        return e

    predict(block, _moved(x_i, np.zeros(DIM)), rig.gravity, F, end)
    x_j = as_belief(0, end).state.retract(0.3 * rng.normal(size=DIM))
    if seed > 1:
        x_j = x_j.retract(np.r_[1.0, -1.0, 0.5, 40.0 * np.ones(3), 2.0 * np.ones(3), np.zeros(6)])
    zero = np.zeros(DIM)
    J_i, J_j = _derivative(lambda d: residual(d, zero)), _derivative(lambda d: residual(zero, d))
    linearise_tie(block, _moved(x_i, zero), _moved(x_j, zero), rig.gravity, F, Q, c)
    assert np.allclose(F, -np.linalg.solve(J_j, J_i), atol=1e-6)
    assert np.allclose(c, -np.linalg.solve(J_j, residual(zero, zero)), atol=1e-6)
    noise, B = np.empty((DIM, DIM)), np.eye(DIM)
    process_noise(block, x_i.R_WB, noise)
    B[6:9, 6:9] = as_belief(0, end).state.R_WB.T
    A = np.linalg.solve(J_j, B)
    assert np.allclose(Q, A @ noise @ A.T, rtol=1e-5, atol=1e-6 * np.abs(noise).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_prior_at_another_point_is_its_residual_solved_for_the_state(seed: int) -> None:
    """Where x is the anchor, it is the density of the error itself."""
    rng = np.random.default_rng(seed)
    a, mean, P = random_state(rng), 0.1 * rng.normal(size=DIM), _covariance(rng, 0.2)

    def residual(y: NavState) -> np.ndarray:
        turn = y.R_WB @ a.R_WB.T
        e = a.local(y)
        e[:3], e[6:9] = np.split(logarithm(turn, y.v_WB_W - turn @ a.v_WB_W), 2)
        return e

    for x in (a, a.retract(0.5 * rng.normal(size=DIM))):
        m, P_x = np.empty(DIM), np.empty((DIM, DIM))
        linearise_prior(as_record(Belief(0, a, P)), mean, _moved(x, np.zeros(DIM)), m, P_x)
        J_a, J = (_derivative(lambda d, at=at: residual(at.retract(d))) for at in (a, x))
        A = np.linalg.solve(J, J_a)
        assert np.allclose(m, A @ mean - np.linalg.solve(J, residual(x)), atol=1e-6)
        assert np.allclose(P_x, A @ P @ A.T, atol=1e-7)
    assert np.abs(A - np.eye(DIM)).max() > 0.1


@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
def test_weights_are_those_of_gtsam(loss: str) -> None:
    for n in (1, 2, 3):
        for d in np.linspace(0.0, 8.0, 33):
            expected = m_estimator(loss, n).weight(d)
            assert weight_of(LOSSES.index(loss), d, width(loss, n)) == pytest.approx(expected, abs=1e-12)


# --- what it does with readings --------------------------------------------------------------------------------------


def test_readings_that_are_late_odd_or_between_are_counted_as_fls_counts_them() -> None:
    for change, options in (
        (LATE, {"lag_s": 3.0}),
        (LATE, {"lag_s": 0.5}),
        (ODD, {}),
        ({}, {"lag_s": 0.0}),
        ({"heading": HeadingSpec(3.0, disorder_s=0.7)}, {"dvl": ["preintegrated-loose"], "dvl_between": "straight"}),
        ({"dvl": None}, {"keyframe_timeout_s": 0.5}),
    ):
        log = simulate(replace(SHORT, **change), seed=3)
        ours, theirs = run_log(log, create("window", **options)), run_log(log, create("fls", **options))
        assert ours.status == theirs.status == "done", (ours.cause, theirs.cause)
        for name in ("keyframes", "carried", "merged", "late", "late_used", "preintegrated"):
            assert ours.counts[name] == theirs.counts.get(name, 0), (change, options, name)
        assert len(ours.smoothed) == len(theirs.smoothed)


def test_a_lag_of_nothing_is_a_filter() -> None:
    log = simulate(replace(SHORT, duration_s=40.0, dvl=DvlSpec()), seed=4)
    result, eskf = run_log(log, create("window", lag_s=0.0)), run_log(log, create("eskf"))
    sigma = np.sqrt(np.einsum("nii->ni", eskf.online.P))
    assert gaps_in_sigma(eskf.online, result.online)[20:, POSITION].max() < 0.1
    assert np.abs(np.sqrt(np.einsum("nii->ni", result.online.P))[20:] / sigma[20:] - 1).max() < 0.02
    assert np.allclose(result.smoothed.p_WB_W, result.online.p_WB_W, atol=1e-9)  # every tick is a keyframe here


@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
def test_a_loss_saves_it_from_gps_that_lies(loss: str) -> None:
    log = simulate(Scenario(duration_s=60.0, imu="tactical", gps=GpsSpec(rate_hz=5.0)), seed=4)
    z, bad = log.gps.z.copy(), slice(18, None, 10)
    z[bad, :2] += 50.0
    n = int(np.count_nonzero(log.gps.received_ns[bad] <= log.imu.t_ns[-1]))
    spoilt = replace(log, gps=replace(log.gps, z=z))
    robust, plain = run_log(spoilt, create("window", robust={"gps": loss})), run_log(log, create("window"))
    assert rmse_m(log.truth, robust.smoothed) < rmse_m(log.truth, plain.smoothed) + 1.0
    assert n <= robust.counts["outliers_gps"] <= n + 30
    theirs = run_log(spoilt, create("fls", robust={"gps": loss}))
    assert robust.counts["outliers_gps"] == pytest.approx(theirs.counts["outliers_gps"], abs=2)
    assert np.linalg.norm(robust.online.p_WB_W - theirs.online.p_WB_W, axis=1).max() < 0.05


def test_a_prior_that_is_no_covariance_is_refused() -> None:
    log = simulate(SHORT, seed=3)
    for P in (-log.prior.P, np.full((DIM, DIM), np.nan)):
        with pytest.raises(Diverged, match="prior"):
            create("window").begin(replace(log.prior, P=P), log.rig)


# --- what it costs ---------------------------------------------------------------------------------------------------


def _counts(log: Log, **options: object) -> dict[str, int]:
    result = run_log(log, create("window", smoothed_covariance_s=1e6, **options))
    assert result.status == "done", result.cause
    return result.counts


def test_a_step_factors_two_blocks_at_any_lag_if_nothing_moves() -> None:
    """The one that gains a tie and, with it, the new one."""
    log = simulate(replace(MINUTE, **SLOW_SENSORS), seed=4)
    for lag_s in (3.0, 30.0):
        counts = _counts(log, lag_s=lag_s, relinearize=[1e9] * 4)
        assert counts["relinearised"] == 0
        assert counts["refactored"] == 2 * (counts["keyframes"] - 1)
    usual = _counts(log, lag_s=30.0)
    assert 0 < usual["relinearised"] < 0.1 * usual["keyframes"]  # when the first turns tell heading from bias
    assert usual["refactored"] < 2.5 * usual["keyframes"]


def test_what_it_holds_is_bounded_by_the_window() -> None:
    log = simulate(replace(MINUTE, dvl=DvlSpec(20.0)), seed=1)
    one, sizes = create("window", lag_s=1.0).begin(log.prior, log.rig), []
    for epoch in cut(log, ticks(log, 1.0)).epochs:
        one.step(epoch)
        sizes.append(sum(part.nbytes for part in vars(one).values() if isinstance(part, np.ndarray)))
    assert one.counts["keyframes"] > 1000
    assert sizes[-1] == sizes[len(sizes) // 4]


def _us_per_keyframe(log: Log, name: str, **options: object) -> float:
    one = create(name, **options).begin(log.prior, log.rig)
    epochs, spent = cut(log, ticks(log, 1.0)).epochs, 0
    for epoch in epochs:
        started = thread_time_ns()
        one.step(epoch)
        spent += thread_time_ns() - started
    return spent / one.counts["keyframes"] * 1e-3


@pytest.mark.slow
def test_a_lag_of_30_s_costs_at_most_twice_one_of_3_s() -> None:
    log = simulate(Scenario(duration_s=90.0, imu="tactical"), seed=4)
    still = {"relinearize": [1e9] * 4, "smoothed_covariance_s": 1e6}
    us = np.array([[_us_per_keyframe(log, "window", lag_s=lag_s, **still) for lag_s in (3.0, 30.0)] for _ in range(9)])
    short, long = np.median(us[1:], axis=0)
    assert long < 2 * short, (short, long)


@pytest.mark.slow
def test_batch_has_its_optimum_of_ten_minutes_in_two_seconds() -> None:
    log = simulate(Scenario(duration_s=600.0, imu="tactical"), seed=1)
    run_log(simulate(SHORT, seed=1), create("batch", engine="window"))
    one, epochs = create("batch", engine="window").begin(log.prior, log.rig), cut(log, ticks(log, 1.0)).epochs
    started = perf_counter()
    for epoch in epochs:
        one.step(epoch)
    assert one.finish() is not None
    assert perf_counter() - started < 2.0


# --- consistency -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_over_twenty_seeds_its_errors_match_its_covariance() -> None:
    """Online and smoothed, at three times fixed beforehand; the 0.001 is shared among them."""
    n, epochs_s, parts = 20, (10, 30, 50), {part: of for part, of in BLOCKS.items() if part != "biases"}
    logs = (simulate(replace(MINUTE, **SLOW_SENSORS), seed) for seed in range(n))
    total = summed_nees(create("window", smoothed_covariance_s=1e-3), logs, epochs_s, parts)
    for output in ("online", "smoothed"):
        for part, of in parts.items():
            low, high = chi2.interval(1 - 0.001 / len(epochs_s), n * (of.stop - of.start))
            assert (low < total[output][part]).all(), (output, part, total, low)
            assert (total[output][part] < high).all(), (output, part, total, high)
