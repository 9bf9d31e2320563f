"""The IMU block follows a body that it is bolted to, and its Jacobians and covariance are what they claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.datasets import Belief, ImuNoise, Mounting, NavState, Rig
from fathom.datasets.epochs import IMU_SAMPLE, cut
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import FACTORS
from fathom.estimators.graph.gtsam_border import preintegrate_imu
from fathom.estimators.physics.imu import (
    BLOCK,
    compile_rig,
    first_sample,
    integrate,
    predict,
    process_noise,
    sandwich,
    split,
)
from fathom.estimators.physics.kalman import propagate
from fathom.estimators.physics.state import STATE, as_belief, as_record, with_rate_noise
from paths import GRAVITY, NOISE, Path, random_rig

ZERO_P = np.zeros((15, 15))


def carry(state: NavState, imu: np.ndarray, before: np.ndarray, rig: Rig, at: NavState | None = None) -> NavState:
    """Carry a state over a block integrated with the biases of `at` (its own by default)."""
    record, block, out = as_record(Belief(0, state, ZERO_P)), np.zeros(1, BLOCK), np.zeros(1, STATE)
    at = at or state
    integrate(imu, before, at.b_a, at.b_g, compile_rig(rig, FACTORS, {}), block)
    predict(block, record, rig.gravity, np.empty((15, 15)), out)
    return as_belief(0, out).state


@pytest.mark.parametrize("seed", range(5))
def test_block_follows_a_path_at_a_lever_arm(seed: int) -> None:
    """The path's specific force is differentiated at the IMU: centripetal and tangential terms are in it."""
    rng = np.random.default_rng(seed)
    rig, path, dt = random_rig(rng, lever_m=1.0), Path(seed), 0.01
    b_a, b_g = rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.01
    t = dt * np.arange(0, 1001)
    imu = path.imu(t, dt, rig, b_a, b_g)
    state, truth = (_with_rate_of(path.state(at, b_a, b_g), path, at, imu[k], rig) for at, k in ((0.0, 0), (10.0, -1)))
    for k in range(1, 1001, 20):
        state = carry(state, imu[k : k + 20], imu[k - 1 : k], rig)
    error = truth.local(state)
    assert np.linalg.norm(error[:3]) < 1e-6
    assert np.linalg.norm(error[3:6]) < 3e-4
    assert np.linalg.norm(error[6:9]) < 2e-5


def _with_rate_of(state: NavState, path: Path, t_s: float, sample: np.ndarray, rig: Rig) -> NavState:
    """The velocity of B by way of the IMU's, with the rate at the sample's end that is run straight on to it."""
    rate_I = sample["w_WI_I"] + sample["alpha_I"] * sample["after_s"] - state.b_g
    off = rig.imu.R_BS @ rate_I - path.rate(np.array([t_s]))[0]
    return replace(state, v_WB_W=state.v_WB_W - state.R_WB @ np.cross(off, rig.imu.p_BS_B))


@pytest.mark.parametrize("seed", range(3))
def test_the_lever_arm_turns_with_the_rate_where_the_block_ends(seed: int) -> None:
    """At 20 Hz with 2 m, at the end of a sample and within one; the mean rate would be 10 to 30 mm/s off."""
    rng, dt = np.random.default_rng(seed), 0.05
    rig, path = random_rig(rng, lever_m=2.0), Path(seed)
    imu = path.imu(dt * np.arange(0, 41), dt, rig, *np.zeros((2, 3)))
    start, before = path.state(0.0, *np.zeros((2, 3))), imu[:1]
    for end_s in (1.0, 1.013, 1.037, 2.0):
        head, _ = split(imu[1:], round(end_s * 1e9))
        late = head.copy()
        late["after_s"] = 0.0
        found, lagging = (
            carry(start, rows, before, rig).v_WB_W - path.state(end_s, *np.zeros((2, 3))).v_WB_W
            for rows in (head, late)
        )
        assert np.linalg.norm(found) < 5e-3
        if end_s in (1.0, 2.0):
            assert np.linalg.norm(found) < 0.25 * np.linalg.norm(lagging)


@pytest.mark.parametrize("lever_m", [0.0, 1.0])
def test_blocks_of_any_length_tell_the_same(lever_m: float) -> None:
    rng = np.random.default_rng(2)
    rig, path, dt = random_rig(rng, lever_m), Path(2), 0.01
    imu = path.imu(dt * np.arange(0, 201), dt, rig, np.zeros(3), np.zeros(3))
    start = path.state(0.0, np.zeros(3), np.zeros(3))
    ends = []
    for length in (1, 7, 40, 200):
        state = start
        for k in range(1, 201, length):
            state = carry(state, imu[k : min(k + length, 201)], imu[k - 1 : k], rig)
        ends.append(state)
    for end in ends[1:]:
        assert np.abs(ends[0].local(end)).max() < 1e-11


def test_splitting_a_sample_changes_nothing_to_first_order() -> None:
    rig, path, dt = Rig(NOISE), Path(4), 0.1
    imu = path.imu(dt * np.arange(0, 21), dt, rig, np.zeros(3), np.zeros(3))
    start = path.state(0.0, np.zeros(3), np.zeros(3))
    whole = carry(start, imu[1:], imu[:1], rig)
    head, tail = split(imu[1:], 1_230_000_000)
    halves = carry(carry(start, head, imu[:1], rig), tail, head[-1:], rig)
    assert head["dt_s"].sum() + tail["dt_s"].sum() == pytest.approx(2.0)
    assert head["t_ns"][-1] == 1_230_000_000
    assert np.abs(whole.local(halves)).max() < 2e-3


@pytest.mark.parametrize("seed", range(5))
def test_transition_is_the_derivative_of_the_prediction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, path, dt = random_rig(rng, lever_m=0.7), Path(seed), 0.01
    b_a, b_g = rng.normal(size=3) * 0.02, rng.normal(size=3) * 0.005
    imu = path.imu(dt * np.arange(0, 51), dt, rig, b_a, b_g)
    state = path.state(0.0, b_a, b_g)
    record, block, F = as_record(Belief(0, state, ZERO_P)), np.zeros(1, BLOCK), np.empty((15, 15))
    integrate(imu[1:], imu[:1], b_a, b_g, compile_rig(rig, FACTORS, {}), block)
    predict(block, record, GRAVITY, F, np.zeros(1, STATE))
    # biases enter the integration itself here, not its first-order correction
    end = carry(state, imu[1:], imu[:1], rig)
    for column in range(15):
        step = 1e-5 * np.eye(15)[column]
        plus, minus = (carry(state.retract(s), imu[1:], imu[:1], rig) for s in (step, -step))
        numeric = (end.local(plus) - end.local(minus)) / 2e-5
        assert np.allclose(F[:, column], numeric, atol=2e-4 * max(1e-2, np.abs(numeric).max())), column


def test_first_order_bias_correction_matches_integrating_anew() -> None:
    rng = np.random.default_rng(0)
    rig, path, dt = random_rig(rng, lever_m=0.7), Path(0), 0.01
    imu = path.imu(dt * np.arange(0, 51), dt, rig, np.zeros(3), np.zeros(3))
    old = path.state(0.0, np.zeros(3), np.zeros(3))
    new = old.retract(np.concatenate([np.zeros(9), rng.normal(size=3) * 1e-2, rng.normal(size=3) * 1e-3]))
    anew, corrected = carry(new, imu[1:], imu[:1], rig), carry(new, imu[1:], imu[:1], rig, at=old)
    moved = np.abs(old.local(new)).max()
    assert np.abs(anew.local(corrected)).max() < 1e-3 * moved


@pytest.mark.parametrize("seed", range(3))
def test_gtsam_preintegrates_exactly_our_block(seed: int) -> None:
    """fls and eskf share one mean motion, to the last digits."""
    rng = np.random.default_rng(seed)
    rig, path, dt = random_rig(rng, lever_m=1.0), Path(seed), 0.01
    b_a, b_g = rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.01
    imu = path.imu(dt * np.arange(0, 31), dt, rig, b_a, b_g)
    record, block = compile_rig(rig, FACTORS, {}), np.zeros(1, BLOCK)
    integrate(imu[1:], imu[:1], b_a, b_g, record, block)
    theirs = preintegrate_imu(imu[1:], imu[:1], block, record)
    assert np.allclose(theirs.deltaRij().matrix(), block["dR"][0], atol=1e-14)
    assert np.allclose(theirs.deltaVij(), block["dv"][0], atol=1e-13)
    assert np.allclose(theirs.deltaPij(), block["dp"][0], atol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_our_covariance_of_a_block_is_gtsams(seed: int) -> None:
    """Without a lever arm: with one, gyro noise moves B by turning it; GTSAM, fed with B's samples, cannot know."""
    rng = np.random.default_rng(seed)
    rig, path, dt = random_rig(rng, lever_m=0.0), Path(seed), 0.01
    imu = path.imu(dt * np.arange(0, 31), dt, rig, np.zeros(3), np.zeros(3))
    record, block = compile_rig(rig, FACTORS, {}), np.zeros(1, BLOCK)
    integrate(imu[1:], imu[:1], np.zeros(3), np.zeros(3), record, block)
    theirs = preintegrate_imu(imu[1:], imu[:1], block, record).residualCovariance()[:9, :9]
    G = np.eye(9)
    G[:3, :3] = block["dR"][0].T  # theirs has the rotation in B_j
    ours = G @ block["N"][0] @ G.T
    sigma = np.sqrt(np.diag(ours))
    assert np.allclose(theirs / np.outer(sigma, sigma), ours / np.outer(sigma, sigma), atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("lever_m", [0.0, 1.0])
def test_covariance_of_a_chain_of_blocks_is_what_monte_carlo_finds(lever_m: float) -> None:
    """From a perfect start, 40 blocks with noise in every sample; a lever arm of 1 m must not make it grow wrongly."""
    rng = np.random.default_rng(11)
    noise = ImuNoise(2e-4, 1e-3, 1e-9, 1e-9, 1e-9, 1e-9)
    mounting = Mounting(random_rig(rng).imu.R_BS, lever_m * np.array([0.8, -0.5, 0.33]))
    rig, path, dt, runs = Rig(noise, imu=mounting, gravity=GRAVITY), Path(6), 0.01, 800
    imu = path.imu(dt * np.arange(0, 201), dt, rig, np.zeros(3), np.zeros(3))
    errors = np.empty((runs, 9))

    def drive(samples: np.ndarray) -> Belief:
        record, block = compile_rig(rig, FACTORS, {}), np.zeros(1, BLOCK)
        first_sample(samples, record)
        state = as_record(Belief(0, path.state(0.0, np.zeros(3), np.zeros(3)), ZERO_P))
        for k in range(1, 201, 5):
            propagate(state, record, samples[k - 1 : k], samples[k : k + 5], block)
        return with_rate_noise(as_belief(0, state), record)

    clean = drive(imu)
    for run in range(runs):
        noisy = imu.copy()
        noisy["w_WI_I"][1:] += rng.normal(size=(200, 3)) * noise.gyro_density / np.sqrt(dt)
        noisy["alpha_I"][1:] = np.diff(noisy["w_WI_I"], axis=0) / dt
        noisy["f_I"] += rng.normal(size=(201, 3)) * noise.accel_density / np.sqrt(dt)
        errors[run] = clean.state.local(drive(noisy).state)[:9]
    claimed = clean.P[:9, :9]
    L = np.linalg.cholesky(claimed)
    whitened = np.linalg.solve(L, errors.T)
    spread = whitened @ whitened.T / runs
    assert np.abs(spread - np.eye(9)).max() < 5 / np.sqrt(runs)


def test_a_gap_grows_the_covariance() -> None:
    rig = compile_rig(Rig(NOISE), FACTORS, {})
    imu = np.zeros(1, IMU_SAMPLE)
    imu["dt_s"], imu["period_s"], imu["f_I"] = 0.5, 0.5, [0, 0, GRAVITY]
    blocks = np.zeros(1, BLOCK), np.zeros(1, BLOCK)
    for block, held in zip(blocks, (0.0, 0.5), strict=True):
        imu["held_s"] = held
        integrate(imu, imu, np.zeros(3), np.zeros(3), rig, block)
    assert (np.diag(blocks[1]["N"][0]) > 100 * np.diag(blocks[0]["N"][0])).all()


def test_block_without_samples_moves_nothing() -> None:
    path, rig = Path(0), random_rig(np.random.default_rng(0))
    state = path.state(0.0, np.zeros(3), np.zeros(3))
    none = np.zeros(0, IMU_SAMPLE)
    assert (
        np.abs(state.local(carry(state, none, path.imu(np.zeros(1), 0.01, rig, *np.zeros((2, 3))), rig))).max() < 1e-12
    )


def test_process_noise_is_symmetric_and_sandwich_is_f_p_f_transposed() -> None:
    rng = np.random.default_rng(0)
    rig, path = random_rig(rng), Path(1)
    imu = path.imu(0.01 * np.arange(0, 21), 0.01, rig, np.zeros(3), np.zeros(3))
    block, F, Q = np.zeros(1, BLOCK), np.empty((15, 15)), np.empty((15, 15))
    state = path.state(0.0, np.zeros(3), np.zeros(3))
    integrate(imu[1:], imu[:1], np.zeros(3), np.zeros(3), compile_rig(rig, FACTORS, {}), block)
    predict(block, as_record(Belief(0, state, ZERO_P)), GRAVITY, F, np.zeros(1, STATE))
    process_noise(block, state.R_WB, Q)
    A = rng.normal(size=(15, 15))
    out = np.empty((15, 15))
    sandwich(F, A @ A.T, np.eye(15), out)
    assert np.allclose(out, F @ A @ A.T @ F.T + np.eye(15), rtol=1e-12)
    assert np.allclose(Q, Q.T, atol=1e-15 * np.abs(Q).max(), rtol=1e-12)
    assert np.linalg.eigvalsh(Q).min() > -1e-18


@pytest.mark.parametrize(
    "mission",
    ["lawnmower", "yo-yo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("helix", "box", "transit"))],
)
def test_ten_noise_free_minutes_return_to_the_truth(mission: str) -> None:
    """The simulator's IMU, at its lever arm and turned mounting, through the block: within 5 mm all the way."""
    log = simulate(Scenario(mission=mission, duration_s=600.0, noise_scale=0.0), seed=1)
    record, block = compile_rig(log.rig, FACTORS, {}), np.zeros(1, BLOCK)
    state = as_record(replace(log.prior, P=ZERO_P))
    epochs = cut(replace(log, dvl=None, depth=None, gps=None, heading=None), log.truth.t_ns[20::20]).epochs
    before, worst = first_sample(epochs[0].imu, record), 0.0
    for epoch, row in zip(epochs, range(20, len(log.truth), 20), strict=True):
        propagate(state, record, before, epoch.imu, block)
        before = epoch.imu[-1:]
        worst = max(worst, float(np.linalg.norm(state["p_WB_W"][0] - log.truth.p_WB_W[row])))
    assert worst < 5e-3
