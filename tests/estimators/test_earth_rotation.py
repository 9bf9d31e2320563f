"""With `earth_rotation` an estimator models the Earth's rotation: it returns to truth, is consistent, and finds north.

Where the effect of one block is small beside a sigma, the Earth turns SPIN times too fast (simulator and rig take their
rate from the same place), or W at a rate of its own.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path as FilePath

import gtsam
import numpy as np
import pytest
from driver import BLOCKS, error_states, run_log, summed_nees
from fathom.datasets import Belief, Log, Mounting, NavState, Rig, open_log
from fathom.datasets import rig as rig_module
from fathom.datasets.described.folder import write_folder
from fathom.datasets.epochs import DEPTH, DVL, IMU_SAMPLE, Epoch, cut
from fathom.datasets.errors import DatasetError
from fathom.datasets.simulated.imu_grades import IMU_GRADES
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, GpsSpec, HeadingSpec, PriorSpec
from fathom.estimators import ESTIMATORS, FACTORS, create
from fathom.estimators.graph.gtsam_border import insert_state, preintegrate_imu
from fathom.estimators.physics.dvl_preintegration import preintegrate_dvl
from fathom.estimators.physics.imu import BLOCK, compile_rig, first_sample, integrate, over_world, predict
from fathom.estimators.physics.invariant import from_invariant, to_invariant
from fathom.estimators.physics.kalman import propagate
from fathom.estimators.physics.so3 import exp, skew
from fathom.estimators.physics.state import STATE, as_belief, as_record
from gtsam.symbol_shorthand import B, V, X
from paths import GRAVITY, Path, random_rig, random_rotation, reading
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

ZERO_P = np.zeros((15, 15))
NAVIGATION = IMU_GRADES["navigation"]
OPTION = {"earth_rotation": True}


# -- where it is set --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_refuses_to_guess_the_latitude(name: str) -> None:
    log = simulate(Scenario(duration_s=20.0), seed=1)
    estimator = create(name, **OPTION)
    with pytest.raises(DatasetError, match="no latitude"):
        estimator.begin(log.prior, log.rig)
    assert run_log(simulate(Scenario(duration_s=20.0, latitude_deg=10.0), 1), estimator).status == "done"


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_earth_turns_by_default_where_the_latitude_is_known(name: str) -> None:
    options = {"attitude": "gyro"} if name == "dead-reckoning" else {}
    ends = {}
    for latitude_deg in (None, 50.0):
        log = simulate(Scenario(duration_s=20.0, latitude_deg=latitude_deg), seed=1)
        for earth_rotation in ({}, {"earth_rotation": "auto"}, {"earth_rotation": latitude_deg is not None}):
            result = run_log(log, create(name, **options, **earth_rotation))
            ends.setdefault(latitude_deg, []).append(result.online.R_WB[-1])
    for by_default, auto, stated in ends.values():
        assert np.array_equal(by_default, auto)
        assert np.array_equal(by_default, stated)
    ignored = run_log(log, create(name, **options, earth_rotation=False)).online.R_WB[-1]
    assert not np.array_equal(ignored, ends[50.0][0])


def test_a_log_keeps_its_latitude_on_disk(tmp_path: FilePath) -> None:
    for latitude_deg in (None, -33.3):
        log = simulate(Scenario(duration_s=20.0, latitude_deg=latitude_deg), seed=1)
        again = open_log(write_folder(log, tmp_path / str(latitude_deg)))
        assert log.rig.latitude_deg == again.rig.latitude_deg == latitude_deg
    north, up = again.rig.w_CW_W[1:]
    assert (north, up) == pytest.approx(
        (7.292115e-5 * np.cos(np.radians(33.3)), -7.292115e-5 * np.sin(np.radians(33.3)))
    )
    with pytest.raises(DatasetError, match="latitude_deg must lie between"):
        replace(log.rig, latitude_deg=91.0)


# -- one block --------------------------------------------------------------------------------------------------------


def some_block(
    seed: int, w_CW_W: np.ndarray, far_m: float = 20.0
) -> tuple[np.ndarray, np.ndarray, NavState, np.ndarray]:
    """A second of any motion, in a W that turns: (rig, block, a state other than its own, IMU samples)."""
    rng = np.random.default_rng(seed)
    rig, path, dt_s = compile_rig(random_rig(rng, 0.7), FACTORS, {}), Path(seed), 0.01
    rig["w_CW_W"] = w_CW_W
    b_a, b_g = rng.normal(size=3) * 0.02, rng.normal(size=3) * 0.005
    mounting = Mounting(rig["R_BI"][0], rig["p_BI_B"][0])
    samples = path.imu(dt_s * np.arange(101), dt_s, Rig(NAVIGATION, mounting, gravity=GRAVITY), b_a, b_g)
    block = np.zeros(1, BLOCK)
    integrate(samples[1:], samples[:1], b_a, b_g, rig, block)
    d_a, d_g = rng.normal(size=3) * 1e-2, rng.normal(size=3) * 1e-3
    state = NavState(random_rotation(rng), far_m * rng.normal(size=3), 2 * rng.normal(size=3), b_a + d_a, b_g + d_g)
    return rig, block, state, samples


def carried(block: np.ndarray, state: NavState, F: np.ndarray | None = None) -> NavState:
    out = np.zeros(1, STATE)
    predict(block, as_record(Belief(0, state, ZERO_P)), GRAVITY, np.empty((15, 15)) if F is None else F, out)
    return as_belief(0, out).state


@pytest.mark.parametrize("seed", range(5))
def test_transition_is_the_derivative_of_the_prediction_in_a_world_that_turns(seed: int) -> None:
    _, block, state, _ = some_block(seed, np.array([0.03, -0.05, 0.04]))
    F, F_still, still = np.empty((15, 15)), np.empty((15, 15)), block.copy()
    end = carried(block, state, F)
    still["w_CW_W"] = 0.0
    carried(still, state, F_still)
    numeric = np.empty((15, 15))
    for column, step in enumerate(1e-5 * np.eye(15)):
        plus, minus = (carried(block, state.retract(s)) for s in (step, -step))
        numeric[:, column] = (end.local(plus) - end.local(minus)) / 2e-5
    assert np.abs(F - F_still).max() > 0.05
    assert np.abs(F - numeric).max() < 1e-7


@pytest.mark.parametrize("seed", range(5))
def test_the_invariant_transition_is_the_one_that_its_page_derives(seed: int) -> None:
    """By propagating each unit of the invariant error, against the closed form."""
    w = np.array([0.03, -0.05, 0.04])
    rig, block, state, samples = some_block(seed, w)
    T, S, E, record = 1.0, skew(w), exp(-w), as_record(Belief(0, state, ZERO_P))
    rig["gyro_density"] = rig["accel_density"] = rig["gyro_walk"] = rig["accel_walk"] = 0.0
    A_i = from_invariant(state.R_WB, state.v_WB_W)
    record["P"] = A_i @ A_i.T
    propagate(record, rig, samples[:1], samples[1:], block)
    end, g = as_belief(0, record).state, np.array([0.0, 0.0, -GRAVITY])
    g_1 = T * g + T**2 / 2 * S @ g + T**3 / 6 * S @ S @ g
    g_2 = T**2 / 2 * g + T**3 / 6 * S @ g + T**4 / 24 * S @ S @ g
    Phi, moved = np.eye(15), end.p_WB_W - state.p_WB_W
    Phi[:3, :3], Phi[3:6, 6:9], Phi[6:9, 6:9] = E, T * E, E - T * S @ E
    Phi[3:6, :3] = E @ skew(g_2) - skew(moved) @ E
    Phi[6:9, :3] = E @ skew(g_1) - S @ E @ skew(g_2) + skew(moved) @ S @ E
    F, at = np.empty((15, 15)), as_record(Belief(0, state, ZERO_P))
    predict(block, at, GRAVITY, F, at)
    A_j = to_invariant(end.R_WB, end.v_WB_W)
    Phi[:9, 9:] = (A_j @ F @ A_i)[:9, 9:]
    assert np.abs(A_j @ record["P"][0] @ A_j.T - Phi @ Phi.T).max() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_gtsams_factor_predicts_what_we_do_in_a_world_that_turns(seed: int) -> None:
    """At the Earth's own rate, a thousand metres from W's origin: its residual at our prediction, and its transition.

    (Fed with samples of B, it does not know how the gyro bias moves B on a lever arm, on an Earth at rest either.)
    """
    rig, block, state, samples = some_block(seed, 7.292115e-5 * np.array([0.0, 0.6, 0.8]), far_m=1000.0)
    state = replace(state, b_a=block["b_a"][0], b_g=block["b_g"][0])
    R_BI, F = rig["R_BI"][0], np.empty((15, 15))
    preintegrated = preintegrate_imu(samples[1:], samples[:1], block, rig, state.p_WB_W)
    factor = gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), preintegrated)
    end, values = carried(block, state, F), gtsam.Values()
    insert_state(values, 0, state, R_BI)
    insert_state(values, 1, end, R_BI)
    r = factor.unwhitenedError(values)
    assert np.abs(r[:3]).max() < 1e-12
    assert np.abs(r[3:6]).max() < 1e-9
    assert np.abs(r[6:9]).max() < 1e-11

    def in_theirs(R_WB: np.ndarray) -> np.ndarray:
        G = np.zeros((15, 15))
        for of, M in zip(range(0, 15, 3), (np.eye(3), R_WB.T, np.eye(3), R_BI, R_BI), strict=True):
            G[of : of + 3, of : of + 3] = M
        return G

    A = factor.linearize(values).jacobian()[0]
    by_key = {key: A[:, at : at + n] for key, at, n in zip(factor.keys(), *columns(factor, A), strict=True)}
    of_i, of_j = (np.hstack([by_key[X(k)], by_key[V(k)], by_key[B(k)]]) for k in (0, 1))
    theirs = -np.linalg.solve(of_j @ in_theirs(end.R_WB), of_i @ in_theirs(state.R_WB))
    still, F_still = block.copy(), np.empty((15, 15))
    still["w_CW_W"] = 0.0
    carried(still, state, F_still)
    assert np.abs(F - F_still)[:9, :9].max() > 3e-4
    assert np.abs(theirs - F)[:9, :9].max() < 2e-8


def columns(factor: gtsam.CombinedImuFactor, A: np.ndarray) -> tuple[list[int], list[int]]:
    """Where each key's columns begin in A, and how many there are."""
    width = [3 if gtsam.Symbol(key).chr() == ord("v") else 6 for key in factor.keys()]  # noqa: SIM118 - no dict
    assert sum(width) == A.shape[1]
    return np.cumsum([0, *width[:-1]]).tolist(), width


def test_a_displacement_is_over_the_world_when_the_gyro_senses_the_stars() -> None:
    rng, dt_s = np.random.default_rng(0), 0.01
    path, rig = Path(3), random_rig(rng)
    record, w_CW_W = compile_rig(rig, FACTORS, {}), np.array([0.02, -0.01, 0.03])
    record["w_CW_W"] = w_CW_W
    b_g = rng.normal(size=3) * 0.01
    t_s = dt_s * np.arange(1, 101)
    over_W = path.imu(t_s, dt_s, rig, np.zeros(3), b_g)
    over_C = over_W.copy()
    over_C["w_WI_I"] += np.einsum("nji,j->ni", path.R_WB(t_s - dt_s / 2) @ rig.imu.R_BS, w_CW_W)
    v_WB_B = np.einsum("nji,nj->ni", path.R_WB(t_s), path.velocity(t_s, np.zeros(3)))
    R_i, t_ns = path.R_WB(np.zeros(1))[0], over_W["t_ns"].copy()

    def displaced(samples: np.ndarray) -> np.ndarray:
        return preintegrate_dvl(samples, 0, t_ns, v_WB_B, np.zeros_like(v_WB_B), b_g, record, False, np.zeros(3))

    expected, sensed = displaced(over_W), displaced(over_C)
    found = displaced(over_world(over_C, R_i, b_g, record))
    assert np.abs(sensed["dp"] - expected["dp"]).max() > 1e-3
    assert np.abs(found["dp"] - expected["dp"]).max() < 2e-5 * np.linalg.norm(expected["dp"])
    assert np.abs(sensed["dR"] - expected["dR"]).max() > 1e-2
    assert np.abs(found["dR"] - expected["dR"]).max() < 1e-6


# -- ten minutes ------------------------------------------------------------------------------------------------------


def drive(log: Log, every: int, knows: bool) -> float:
    """Free-inertial navigation by blocks of `every` samples: the greatest distance from the truth, m."""
    record, block = compile_rig(log.rig, FACTORS, {}, knows), np.zeros(1, BLOCK)
    state = as_record(replace(log.prior, P=ZERO_P))
    blind = replace(log, dvl=None, depth=None, gps=None, heading=None)
    epochs = cut(blind, log.truth.t_ns[every::every]).epochs
    before, worst = first_sample(epochs[0].imu, record), 0.0
    for epoch, row in zip(epochs, range(every, len(log.truth), every), strict=True):
        propagate(state, record, before, epoch.imu, block)
        before = epoch.imu[-1:]
        worst = max(worst, float(np.linalg.norm(state["p_WB_W"][0] - log.truth.p_WB_W[row])))
    return worst


@pytest.mark.parametrize(
    ("latitude_deg", "mission", "every"),
    [(0.0, "lawnmower", 100), (45.0, "yo-yo", 20), (-60.0, "helix", 100), (89.0, "transit", 20)],
)
def test_ten_noise_free_minutes_on_a_turning_earth_return_to_the_truth(
    latitude_deg: float, mission: str, every: int
) -> None:
    scenario = Scenario(mission=mission, duration_s=600.0, imu="navigation", noise_scale=0.0, latitude_deg=latitude_deg)
    log = simulate(scenario, seed=1)
    assert drive(log, every, knows=True) < 2e-3
    assert drive(log, every, knows=False) > 300.0


@pytest.mark.parametrize("latitude_deg", [0.0, 52.0, -75.0])
def test_at_rest_the_earth_displaces_an_estimator_that_ignores_it_by_the_closed_form(latitude_deg: float) -> None:
    """The attitude turns away at Ω, and with it the specific force: ∬ (Exp(Ω t) − 1) (0, 0, g) dt², 26 km · cos φ.

    Who knows stays, but for the centrifugal force of the lever arm, which `imu` says is left out.
    """
    rng, T, dt_s = np.random.default_rng(4), 600.0, 0.1
    rig = Rig(
        NAVIGATION, Mounting(random_rotation(rng), rng.normal(size=3)), gravity=GRAVITY, latitude_deg=latitude_deg
    )
    samples = at_rest(rig, R_WB := random_rotation(rng), round(T / dt_s), dt_s)
    start = NavState(R_WB, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    ends = {}
    for knows in (False, True):
        record, block = compile_rig(rig, FACTORS, {}, knows), np.zeros(1, BLOCK)
        state = as_record(Belief(0, start, ZERO_P))
        for k in range(0, len(samples), 10):
            propagate(state, record, samples[k - 1 : k] if k else samples[:1], samples[k : k + 10], block)
        ends[knows] = as_belief(0, state).state
    rate, f_W = np.linalg.norm(rig.w_CW_W), np.array([0.0, 0.0, GRAVITY])
    axis, angle = rig.w_CW_W / rate, rate * T
    along = axis * (axis @ f_W)
    turned = (1 - np.cos(angle)) / rate**2 * (f_W - along) + (angle - np.sin(angle)) / rate**2 * np.cross(axis, f_W)
    drift = along * T**2 / 2 + turned - f_W * T**2 / 2
    assert drift[0] == pytest.approx(GRAVITY * rig.w_CW_W[1] * T**3 / 6, rel=1e-3)
    assert ends[False].p_WB_W == pytest.approx(drift, abs=1e-6 * np.linalg.norm(drift))
    astray = start.local(ends[True])
    assert np.abs(astray[:3]).max() < 1e-12
    assert np.linalg.norm(astray[3:6]) < rate**2 * np.linalg.norm(rig.imu.p_BS_B) * T**2 / 2


def at_rest(rig: Rig, R_WB: np.ndarray, n: int, dt_s: float) -> np.ndarray:
    """IMU_SAMPLE rows (n,) of a vehicle that does not move, without noise."""
    samples, R_IW = np.zeros(n, IMU_SAMPLE), (R_WB @ rig.imu.R_BS).T
    samples["t_ns"] = np.round(np.arange(1, n + 1) * dt_s * 1e9)
    samples["dt_s"] = samples["period_s"] = dt_s
    samples["w_WI_I"], samples["f_I"] = R_IW @ rig.w_CW_W, R_IW @ [0.0, 0.0, rig.gravity]
    return samples


def test_dead_reckoning_by_gyro_keeps_its_course() -> None:
    log = simulate(Scenario(duration_s=600.0, imu="navigation", noise_scale=0.0, latitude_deg=60.0), seed=1)
    errors = {}
    for knows in (False, True):
        track = run_log(log, create("dead-reckoning", attitude="gyro", earth_rotation=knows)).online
        errors[knows] = np.linalg.norm(error_states(log.truth, track)[-1, :3])
    assert errors[False] == pytest.approx(np.linalg.norm(log.rig.w_CW_W) * 600.0, rel=0.01)
    assert errors[True] < 1e-4


# -- all estimators are one -------------------------------------------------------------------------------------------

SPIN = 10.0
SMALL = {"depth_m": 5.0, "shallow_m": 1.0, "leg_m": 15.0, "turn_radius_m": 5.0, "surface_for_s": 20.0}
SENSORS = {"dvl": DvlSpec(2.5), "depth": DepthSpec(5.0), "heading": HeadingSpec(2.5), "gps": GpsSpec(delay_s=0.83)}


@pytest.fixture
def spun(monkeypatch: pytest.MonkeyPatch) -> Log:
    """A minute of the navigation grade on an Earth that turns, for as long as a test, SPIN times too fast."""
    monkeypatch.setattr(rig_module, "EARTH_RATE_RAD_S", SPIN * rig_module.EARTH_RATE_RAD_S)
    prior = PriorSpec(attitude_deg=0.05)  # near enough for all to be linear
    scenario = Scenario(duration_s=60.0, imu="navigation", latitude_deg=50.0, prior=prior, **SMALL, **SENSORS)
    return simulate(scenario, seed=3)


def apart(log: Log, a: str, b: str, output: str = "online", **options: object) -> float:
    """How far an estimator, with the option and others, is from another, over all states and ticks: in its sigmas."""
    results = run_log(log, create(a, **OPTION, **options)), run_log(log, create(b, **OPTION))
    one, other = (result.outputs[output] for result in results)
    assert (one.t_ns == other.t_ns).all()
    sigma = np.sqrt(other.P.diagonal(axis1=1, axis2=2))
    return float(np.nanmax(np.abs(error_states(other, one)) / sigma))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("eskf-filterpy", {}),
        ("iekf", {}),
        ("ukf", {}),
        ("rts", {}),
        ("fls", {}),
        ("fls", {"keyframe_period_s": 2.0}),  # readings and ticks between keyframes are carried
        ("fls-batch", {}),
        ("batch", {}),
        ("window", {}),
        ("window", {"keyframe_period_s": 2.0}),
    ],
    ids=str,
)
def test_all_estimators_are_one_on_a_turning_earth(spun: Log, name: str, options: dict[str, float]) -> None:
    assert apart(spun, name, "eskf", **options) < (1e-6 if name == "eskf-filterpy" else 0.1)


@pytest.mark.parametrize("options", [{}, {"keyframe_period_s": 2.0}], ids=str)
def test_smoothed_too(spun: Log, options: dict[str, float]) -> None:
    assert apart(spun, "batch", "rts", "smoothed", **options) < 0.1


@pytest.mark.parametrize("name", ["fls", "window"])
@pytest.mark.parametrize("dvl", ["velocity", "preintegrated-loose", "preintegrated-tight"])
def test_a_smoother_at_long_intervals_stays_at_the_truth(name: str, dvl: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without noise, on an Earth that turns a hundred times too fast, by DVL and depth alone."""
    monkeypatch.setattr(rig_module, "EARTH_RATE_RAD_S", 100 * rig_module.EARTH_RATE_RAD_S)
    scenario = Scenario(duration_s=60.0, imu="navigation", latitude_deg=50.0, noise_scale=0.0, **SMALL)
    log = simulate(scenario, seed=3)
    options = {"dvl": [dvl], "dvl_between": "straight", "keyframe_period_s": 1.0, "factors": ["dvl", "depth"]}
    online = run_log(log, create(name, **options, **OPTION)).online
    error, sigma = error_states(log.truth, online), np.sqrt(online.P.diagonal(axis1=1, axis2=2))
    assert np.abs(error[:, 3:6]).max() < 0.03
    assert np.abs(error / sigma).max() < 1.0


# -- consistency ------------------------------------------------------------------------------------------------------

SEEDS = 20
EPOCHS_S = np.array([10, 20, 30, 40, 50, 60])


@cache
def small_mission(seed: int) -> Log:
    return simulate(Scenario(duration_s=61.0, imu="navigation", latitude_deg=45.0, **SMALL, **SENSORS), seed)


def anees(name: str, output: str, knows: bool) -> dict[str, np.ndarray]:
    """By part of the state: NEES summed over the seeds, at each epoch, per degree of freedom."""
    known = ESTIMATORS[name].__dataclass_fields__
    every_tick = {"smoothed_covariance_s": 1e-3} if "smoothed_covariance_s" in known else {}
    estimator = create(name, earth_rotation=knows, **every_tick)
    sums = summed_nees(estimator, map(small_mission, range(SEEDS)), EPOCHS_S)[output]
    return {part: total / (SEEDS * (BLOCKS[part].stop - BLOCKS[part].start)) for part, total in sums.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "output"),
    [
        ("eskf", "online"),
        ("rts", "smoothed"),
        ("iekf", "online"),
        ("ukf", "online"),
        ("fls", "online"),
    ],
)
def test_a_navigation_grade_imu_is_consistent_only_with_earth_rotation(name: str, output: str) -> None:
    for part, found in anees(name, output, knows=True).items():
        dof = SEEDS * len(np.arange(15)[BLOCKS[part]])
        low, high = np.array(chi2.interval(1 - 0.001 / len(EPOCHS_S), dof)) / dof
        assert (low < found).all(), (part, found, low)
        assert (found < high).all(), (part, found, high)
    astray = anees(name, output, knows=False)["attitude"]
    assert astray.min() > 2
    assert astray.max() > 1000


# -- north ------------------------------------------------------------------------------------------------------------

MOORED_S, IMU_HZ = 600, 10


def moored(seed: int, latitude_deg: float) -> tuple[Rig, Belief, NavState, list[Epoch]]:
    """A vehicle at rest with a DVL and depth, and a heading that nothing measures, known to 30° at first."""
    rng, dt_s, n = np.random.default_rng(seed), 1 / IMU_HZ, MOORED_S * IMU_HZ
    rig = Rig(NAVIGATION, Mounting(random_rotation(rng)), gravity=GRAVITY, latitude_deg=latitude_deg)
    R_WB = Rotation.from_euler("ZYX", [rng.uniform(0, 360), 5, -3], degrees=True).as_matrix()
    b_a, b_g = rng.normal(size=3) * NAVIGATION.accel_bias_sigma, rng.normal(size=3) * NAVIGATION.gyro_bias_sigma
    samples = at_rest(rig, R_WB, n, dt_s)
    samples["w_WI_I"] += b_g + rng.normal(size=(n, 3)) * NAVIGATION.gyro_density / np.sqrt(dt_s)
    samples["f_I"] += b_a + rng.normal(size=(n, 3)) * NAVIGATION.accel_density / np.sqrt(dt_s)
    truth = NavState(R_WB, np.zeros(3), np.zeros(3), b_a, b_g)

    sigma_W = np.radians([0.1, 0.1, 30.0])
    sigma = np.r_[np.repeat([0.1, 0.05], 3), np.repeat([NAVIGATION.accel_bias_sigma, NAVIGATION.gyro_bias_sigma], 3)]
    wrong = exp(sigma_W * rng.normal(size=3)) @ R_WB
    P = np.diag(np.r_[np.zeros(3), sigma**2])
    P[:3, :3] = wrong.T @ np.diag(sigma_W**2) @ wrong
    p, v = (s * rng.normal(size=3) for s in (0.1, 0.05))
    epochs = []
    for t_s in range(1, MOORED_S + 1):
        t_ns = t_s * 10**9
        dvl = reading(DVL, 0.002 * rng.normal(size=3), np.full(3, 0.002), t_ns)
        depth = reading(DEPTH, 0.02 * rng.normal(size=1), np.array([0.02]), t_ns)
        imu = samples[(t_s - 1) * IMU_HZ : t_s * IMU_HZ]
        epochs.append(Epoch(t_ns, imu, np.concatenate([dvl, depth]), t_s in (1, MOORED_S)))
    return rig, Belief(0, NavState(wrong, p, v, np.zeros(3), np.zeros(3)), P), truth, epochs


@pytest.mark.parametrize(
    ("name", "latitude_deg", "seeds"),
    [
        ("eskf", 0.0, 8),
        ("iekf", -60.0, 8),
        ("ukf", 45.0, 2),
        ("rts", 70.0, 8),
        ("fls", 45.0, 1),
        pytest.param("batch", 45.0, 3, marks=pytest.mark.slow),
    ],
)
def test_at_rest_the_earths_rate_gives_north(name: str, latitude_deg: float, seeds: int) -> None:
    """Ω cos φ points north. A heading that is wrong by ψ is an eastward rate of Ω cos φ ψ, which is seen as tilting.

    What limits it is the gyro: its bias, b, and after T seconds what its noise, of density N, averages to:
    σ_ψ = √(b² + N²/T) / (Ω cos φ). That the tilt takes its time to be measured by a DVL costs a few percent.
    """
    sigmas, errors = [], []
    for seed in range(seeds):
        rig, prior, truth, epochs = moored(seed, latitude_deg)
        run = create(name, **OPTION).begin(prior, rig)
        for epoch in epochs:
            run.step(epoch)
        beliefs, smoothed = [run.belief()], run.finish()
        if name in ("rts", "batch"):  # smoothed, north is known from the beginning
            beliefs.append(Belief(0, smoothed.state(0), smoothed.P[0]))
        for belief in beliefs:
            R_WB = belief.state.R_WB
            errors.append(Rotation.from_matrix(R_WB @ truth.R_WB.T).as_rotvec()[2])
            sigmas.append(np.sqrt((R_WB @ belief.P[:3, :3] @ R_WB.T)[2, 2]))
    drift = np.hypot(NAVIGATION.gyro_bias_sigma, NAVIGATION.gyro_density / np.sqrt(MOORED_S))
    limit = drift / (7.292115e-5 * np.cos(np.radians(latitude_deg)))
    assert (np.array(sigmas) > limit).all()
    assert (np.array(sigmas) < 1.1 * limit).all()
    assert (np.abs(errors) < 4 * limit).all()
