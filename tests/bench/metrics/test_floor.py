"""The floor is the dense bound, is what filters and smoothers claim at the truth, and is reached but never beaten."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
from fathom.bench.execution.drive import run_log, score_ticks
from fathom.bench.metrics import ScoreError
from fathom.bench.metrics.floor import Floor, floors, floors_along
from fathom.bench.metrics.floor_ratio import rmse_over_floor, squares
from fathom.datasets import Belief, Log, Trajectory
from fathom.datasets.epochs import SENSOR, cut
from fathom.datasets.log import ImuStream
from fathom.datasets.simulated.imu_grades import IMU_GRADES
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, GpsSpec, HeadingSpec
from fathom.datasets.state import ACCEL_BIAS, GYRO_BIAS, POSITION, THETA, VELOCITY
from fathom.estimators import FACTORS, create
from fathom.estimators.filters.eskf_filterpy import stack
from fathom.estimators.physics.imu import BLOCK, compile_rig, first_sample, integrate, predict, process_noise
from fathom.estimators.physics.state import STATE, as_record, with_rate_noise
from linear import whitened
from scipy.spatial.transform import Rotation
from scipy.stats import binom

LAGS = (0.0, 1.0, 3.0, 10.0, math.inf)
SECOND = 10**9


def twin(scenario: Scenario, seed: int) -> Log:
    return simulate(replace(scenario, noise_scale=0.0), seed)


def apart(P: np.ndarray, of: np.ndarray) -> float:
    """The largest difference of covariances, over σᵢσⱼ."""
    sigma = np.sqrt(np.einsum("...ii->...i", of))
    return float(np.abs((P - of) / (sigma[..., :, None] * sigma[..., None, :])).max())


def least_of(P: np.ndarray, over: np.ndarray) -> float:
    """The least eigenvalue of P − over, in units of P's sigmas: not negative where P is nowhere less."""
    sigma = np.sqrt(np.einsum("...ii->...i", P))
    return float(np.linalg.eigvalsh((P - over) / (sigma[..., :, None] * sigma[..., None, :])).min())


# -- the dense bound --------------------------------------------------------------------------------------------------

SPARSE = Scenario(
    duration_s=20.0,
    surface_for_s=40.0,
    dvl=DvlSpec(1.0),
    depth=DepthSpec(1.0),
    gps=GpsSpec(1.0),
    heading=HeadingSpec(1.0),
)
PUNCTUAL_S = {"dvl": 0.0, "gps": 0.0, "heading": 0.0, "depth": 0.0}
DELAYS_S = {"dvl": 1.5, "gps": 4.0, "heading": 0.5, "depth": 0.0}
LATE = replace(SPARSE, **{name: replace(getattr(SPARSE, name), delay_s=delay) for name, delay in DELAYS_S.items()})
TICKS_S = (2, 7, 13)


class Dense:
    """A voyage in which each reading comes when it is true, as one linear system over all of its states.

    Readings are told apart by when they would be received if they had these delays.
    """

    def __init__(self, log: Log, delays_s: dict[str, float]) -> None:
        heard_ns = [s.t_ns + round(delays_s[name] * SECOND) for name, s in log.streams.items()]
        epochs, truth = cut(log, np.unique(np.concatenate(heard_ns))).epochs, log.truth
        self.t_ns = np.array([log.start_ns] + [epoch.t_ns for epoch in epochs])
        rows = np.searchsorted(truth.t_ns, self.t_ns)
        assert np.array_equal(truth.t_ns[rows], self.t_ns)
        self.states = [truth.state(row) for row in rows]
        self.rig = compile_rig(log.rig, FACTORS, {})
        self.P0 = log.prior.P
        before, block, end = first_sample(epochs[0].imu, self.rig), np.zeros(1, BLOCK), np.zeros(1, STATE)
        self.F, self.Q, self.readings = [], [], []
        for k, epoch in enumerate(epochs):
            x, F, Q = as_record(Belief(0, self.states[k], np.eye(15))), np.empty((15, 15)), np.empty((15, 15))
            integrate(epoch.imu, before, np.zeros(3), np.zeros(3), self.rig, block)
            predict(block, x, log.rig.gravity, F, end)
            process_noise(block, x["R_WB"][0], Q)
            self.F.append(F)
            self.Q.append(Q)
            before = epoch.imu[-1:]
            x = as_record(Belief(0, self.states[k + 1], np.eye(15)))
            for m in range(len(epoch.readings)):
                reading = epoch.readings[m : m + 1]
                _, H, C = stack(x, self.rig, reading)
                received_ns = epoch.t_ns + round(delays_s[SENSOR[reading["kind"][0]]] * SECOND)
                if received_ns <= int(log.imu.t_ns[-1]):
                    self.readings.append((k + 1, received_ns, H, C))

    def by_information(self, t_ns: int, now_ns: float) -> np.ndarray:
        """P of the state at t_ns from all that is received by now_ns: the inverse of the whole information matrix.

        Of the states up to now_ns: those after are tied to nothing but each other.
        """
        n, k = (int(np.searchsorted(self.t_ns, at_ns, side="right")) for at_ns in (now_ns, t_ns - 1))
        zero, one = np.zeros(15), np.eye(15)
        lines = [whitened(n, {0: one}, zero, self.P0)]
        lines += [whitened(n, {i: -self.F[i], i + 1: one}, zero, self.Q[i]) for i in range(n - 1)]
        lines += [whitened(n, {i: H}, np.zeros(len(C)), C) for i, at_ns, H, C in self.readings if at_ns <= now_ns]
        A, own = np.concatenate(lines)[:, :-1], slice(15 * k, 15 * k + 15)
        size = np.linalg.norm(A, axis=0)
        upper = np.linalg.qr(A / size, mode="r")
        part = scipy.linalg.solve_triangular(upper, np.eye(15 * n)[:, own], trans="T").T / size[own, None]
        return self.of_belief(k, part @ part.T)

    def by_conditioning(self, t_ns: int, now_ns: float) -> np.ndarray:
        """The same from the joint covariance of all states, conditioned on all readings at once; inverts no Q, no P."""
        k, used = int(np.searchsorted(self.t_ns, t_ns)), [reading for reading in self.readings if reading[1] <= now_ns]
        H_all, C_all = [], scipy.linalg.block_diag(*(C for *_, C in used))
        for i, _, H, C in used:
            H_all.append(np.zeros((len(C), 15 * len(self.states))))
            H_all[-1][:, 15 * i : 15 * i + 15] = H
        P, own, H = self.joint, slice(15 * k, 15 * k + 15), np.concatenate(H_all)
        return self.of_belief(k, P[own, own] - P[own] @ H.T @ np.linalg.solve(H @ P @ H.T + C_all, H @ P[:, own]))

    @cached_property
    def joint(self) -> np.ndarray:
        """Covariance of all states before any reading."""
        tie = np.eye(15 * len(self.states))
        for i, F in enumerate(self.F):
            tie[15 * (i + 1) : 15 * (i + 2), 15 * i : 15 * (i + 1)] = -F
        root = np.linalg.inv(tie)
        return root @ scipy.linalg.block_diag(self.P0, *self.Q) @ root.T

    def of_belief(self, k: int, P: np.ndarray) -> np.ndarray:
        return with_rate_noise(Belief(0, self.states[k], P), self.rig).P


@pytest.mark.parametrize(
    ("scenario", "delays_s"), [(SPARSE, PUNCTUAL_S), pytest.param(LATE, DELAYS_S, marks=pytest.mark.slow)]
)
def test_every_floor_is_the_inverse_of_the_whole_information_matrix(
    scenario: Scenario, delays_s: dict[str, float]
) -> None:
    """With no delay, after each lag, and after the whole log; late readings count from their reception on."""
    dense = Dense(twin(SPARSE, 3), delays_s)
    ticks_ns = np.array(TICKS_S) * SECOND
    found = floors(scenario, 3, ticks_ns, LAGS)
    assert list(found) == list(LAGS)
    for lag, floor in found.items():
        assert floor.lookahead_s == lag
        assert np.array_equal(floor.t_ns, ticks_ns)
        exact = np.array([dense.by_information(t_ns, t_ns + lag * SECOND) for t_ns in floor.t_ns])
        assert apart(floor.P, exact) < 1e-7


def test_what_has_no_variance_or_no_noise_is_no_special_case() -> None:
    """Biases that do not walk (Q singular), and a height and a gyro bias that are known (P singular)."""
    noise = replace(IMU_GRADES["tactical"], gyro_walk=0.0, accel_walk=0.0)
    log = twin(replace(SPARSE, imu=noise), 4)
    P0 = log.prior.P.copy()
    P0[5], P0[:, 5], P0[12:], P0[:, 12:] = 0.0, 0.0, 0.0, 0.0
    log = log.with_prior(replace(log.prior, P=P0))
    dense = Dense(log, PUNCTUAL_S)
    ticks_ns = np.array(TICKS_S) * SECOND
    for lag, floor in floors_along(log, ticks_ns, LAGS).items():
        exact = np.array([dense.by_conditioning(t_ns, t_ns + lag * SECOND) for t_ns in ticks_ns])
        assert (floor.P[:, 12:] == 0.0).all()
        assert apart(floor.P[:, :12, :12], exact[:, :12, :12]) < 1e-7


# -- the estimators' own covariances, at the truth --------------------------------------------------------------------


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(duration_s=60.0),
        Scenario(duration_s=60.0, mission="yo-yo", imu="consumer", dvl=DvlSpec(rate_hz=7.0)),
        Scenario(duration_s=60.0, dvl=DvlSpec(delay_s=0.31), gps=GpsSpec(delay_s=0.83)),
    ],
    ids=["lawnmower", "between-samples", "delayed"],
)
def test_without_noise_iekf_claims_the_floor_and_rts_that_of_the_whole_log(scenario: Scenario) -> None:
    log = twin(scenario, 2)
    result = run_log(log, create("rts"))  # its online beliefs are iekf's
    found = floors(scenario, 2, result.online.t_ns)
    assert np.array_equal(found[0.0].t_ns, result.online.t_ns)
    assert apart(found[0.0].P, result.online.P) < 5e-3
    assert apart(found[math.inf].P, result.smoothed.P) < 5e-3


def test_without_noise_the_smoothers_on_gtsam_claim_the_floor() -> None:
    """batch that of the whole log; fls, which has seen up to one keyframe less than its lag, between two lags."""
    scenario = Scenario(duration_s=40.0)
    log = twin(scenario, 2)
    batch = run_log(log, create("batch", smoothed_covariance_s=1.0)).smoothed
    fls = run_log(log, create("fls", lag_s=3.0, smoothed_covariance_s=1.0)).smoothed
    found = floors(scenario, 2, batch.t_ns, (2.75, 3.0, math.inf))
    sigma = {ahead: np.sqrt(np.einsum("nii->ni", floor.P)) for ahead, floor in found.items()}
    of_batch, of_fls = (np.sqrt(np.einsum("nii->ni", track.P)) for track in (batch, fls))
    assert np.abs(of_batch / sigma[math.inf] - 1).max() < 0.03  # as it is to rts
    assert (of_fls / sigma[3.0]).min() > 0.99
    assert (of_fls / sigma[2.75]).max() < 1.03
    assert (of_fls / sigma[math.inf]).max() > 1.2


# -- what a bound must do ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", [Scenario(duration_s=60.0), Scenario(duration_s=60.0, gps=GpsSpec(delay_s=2.5))])
def test_a_longer_look_never_raises_the_floor_and_at_the_end_of_the_log_it_is_all(scenario: Scenario) -> None:
    ticks_ns = np.arange(1, 61) * SECOND
    lags = (0.0, 0.5, 2.0, 8.0, 30.0, 1e12, math.inf)
    found = floors(scenario, 1, ticks_ns, lags)
    for short, long in pairwise(found.values()):
        assert least_of(short.P, over=long.P) > -1e-9
        at_end = short.t_ns + short.lookahead_s * SECOND >= 60 * SECOND
        assert apart(short.P[at_end], found[math.inf].P[at_end]) < 1e-7
    assert found[8.0].P[:30].trace(axis1=1, axis2=2).sum() < 0.99 * found[0.0].P[:30].trace(axis1=1, axis2=2).sum()


@pytest.mark.parametrize("sensor", sorted(FACTORS))
def test_dropping_a_sensor_never_lowers_the_floor(sensor: str) -> None:
    scenario, ticks_ns = Scenario(duration_s=60.0, depth=DepthSpec(5.0)), np.arange(1, 61) * SECOND  # all cut alike
    every, less = (floors(scenario, 1, ticks_ns, (0.0, 3.0, math.inf), kept) for kept in (FACTORS, FACTORS - {sensor}))
    not_aboard = floors(replace(scenario, **{sensor: None}), 1, ticks_ns, (0.0, 3.0, math.inf))
    for ahead, floor in less.items():
        assert least_of(floor.P, over=every[ahead].P) > -1e-9
        assert apart(floor.P, every[ahead].P) > 0.01
        assert apart(floor.P, not_aboard[ahead].P) < 1e-12


def test_what_is_received_after_the_log_is_not_known() -> None:
    ticks_ns = np.arange(1, 31) * SECOND
    never, without = (
        floors(Scenario(duration_s=30.0, gps=gps), 1, ticks_ns, (0.0, 3.0, math.inf))
        for gps in (GpsSpec(delay_s=31.0), None)
    )
    for ahead, floor in never.items():
        assert apart(floor.P, without[ahead].P) < 1e-3  # the cuts are others


def test_constant_biases_do_not_move_the_floor_and_neither_does_noise() -> None:
    """F, Q and H depend on the path alone. What the noise of an IMU adds to its reports hardly turns them."""
    scenario, ticks_ns = Scenario(duration_s=60.0, imu="industrial"), np.arange(1, 61) * SECOND
    log, noisy = twin(scenario, 1), simulate(scenario, 1)
    rng, n = np.random.default_rng(0), len(log.truth)
    b_a, b_g = (sigma * rng.normal(size=3) for sigma in (0.02, 1e-3))
    imu = ImuStream(log.imu.t_ns, log.imu.w_WI_I + b_g, log.imu.f_I + b_a)
    truth = replace(log.truth, b_a=np.tile(b_a, (n, 1)), b_g=np.tile(b_g, (n, 1)))
    found = floors_along(log, ticks_ns)
    biased = floors_along(replace(log, imu=imu, truth=truth), ticks_ns)
    for ahead, floor in found.items():
        assert apart(biased[ahead].P, floor.P) < 1e-9
        assert apart(floors_along(noisy, ticks_ns)[ahead].P, floor.P) < 0.02


def test_the_twin_without_noise_has_the_path_and_the_times_of_the_log() -> None:
    for scenario in (LATE, Scenario(duration_s=60.0, mission="yo-yo", start_ns=SECOND)):
        noisy, exact = simulate(scenario, 5), twin(scenario, 5)
        assert np.array_equal(noisy.truth.t_ns, exact.truth.t_ns)
        for name in ("R_WB", "p_WB_W", "v_WB_W"):
            assert np.array_equal(getattr(noisy.truth, name), getattr(exact.truth, name))
        assert noisy.streams.keys() == exact.streams.keys()
        for name, stream in noisy.streams.items():
            assert np.array_equal(stream.t_ns, exact.streams[name].t_ns)
            assert np.array_equal(stream.received_ns, exact.streams[name].received_ns)
        assert np.array_equal(noisy.prior.P, exact.prior.P)
        assert np.array_equal(score_ticks(noisy, 1.0), score_ticks(exact, 1.0))


def test_the_floor_is_of_the_noise_that_there_is() -> None:
    ticks_ns = np.array(TICKS_S) * SECOND
    whole, half = (floors(replace(SPARSE, noise_scale=scale), 1, ticks_ns, (0.0,))[0.0] for scale in (1.0, 0.5))
    assert np.allclose(half.P, 0.25 * whole.P, rtol=1e-12)


def test_a_floor_that_is_not_defined_is_refused() -> None:
    log, ticks_ns = twin(SPARSE, 1), np.array(TICKS_S) * SECOND
    for lag in (-1.0, math.nan):
        with pytest.raises(ScoreError, match="look-ahead must not be negative"):
            floors_along(log, ticks_ns, (0.0, lag))
    for less in (
        replace(log, truth=None),
        replace(log, truth=replace(log.truth, v_WB_W=None)),
        replace(log, prior=None),
    ):
        with pytest.raises(ScoreError, match="needs a truth with velocities and a prior"):
            floors_along(less, ticks_ns)


def test_ticks_outside_the_log_are_passed_over_and_without_any_there_is_nothing() -> None:
    found = floors(SPARSE, 1, np.array([0, 5, 20, 21]) * SECOND, LAGS)
    assert all(floor.t_ns.tolist() == [5 * SECOND, 20 * SECOND] for floor in found.values())
    assert all(floor.P.shape == (0, 15, 15) for floor in floors(SPARSE, 1, np.zeros(0, np.int64), LAGS).values())
    bare = replace(SPARSE, dvl=None, depth=None, gps=None, heading=None)
    assert all(floor.P.shape == (0, 15, 15) for floor in floors(bare, 1, np.zeros(0, np.int64), LAGS).values())


# -- RMSE over the floor ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_iekf_and_rts_reach_the_floor_and_do_not_beat_it() -> None:
    """200 tactical minutes: the 99.9 % interval of each ratio reaches 1, that of 99 % meets [1, 1.1]."""
    scenario, blocks = Scenario(duration_s=60.0), {"position": POSITION, "velocity": VELOCITY, "attitude": THETA}
    of_seeds: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for seed in range(200):
        log = simulate(scenario, seed)
        result = run_log(log, create("rts"))  # its online beliefs are iekf's
        found = floors(scenario, seed, score_ticks(log, 1.0))
        for name, track in (("iekf", result.online), ("rts", result.smoothed)):
            for block, part in blocks.items():
                pair = squares(log.truth, track, found[track.lookahead_s], part)
                of_seeds.setdefault((name, block), []).append(pair)
            assert track.P.trace(axis1=1, axis2=2).sum() == pytest.approx(
                found[track.lookahead_s].P.trace(axis1=1, axis2=2).sum(), rel=0.02
            )  # what noise does to the linearisation moves its own claim by less than the bootstrap can see
    for key, pairs in of_seeds.items():
        error, bound = np.array(pairs).T
        meets, reaches = (rmse_over_floor(error, bound, level) for level in (0.99, 0.999))
        assert meets.high > 1.0, key
        assert meets.low < 1.1, key
        assert reaches.low < 1.0 < reaches.high, key


def test_squares_are_those_of_the_block_at_common_times() -> None:
    rng, t_ns = np.random.default_rng(0), np.arange(5) * SECOND
    R, zero = Rotation.random(5, rng=rng), np.zeros((5, 3))
    truth = Trajectory(t_ns, R.as_matrix(), zero, zero, zero, zero)
    wrong = R * Rotation.from_rotvec([0.03, 0.0, 0.04])
    estimate = Trajectory(
        t_ns,
        wrong.as_matrix(),
        zero + np.array([1.0, 2.0, 2.0]),
        zero - 0.1,
        zero + np.array([0.0, 0.0, 2.0]),
        zero,
        lookahead_s=3.0,
    )
    P = np.array([100.0, 1.0, 2.0, 3.0, 4.0])[:, None, None] * np.diag(np.arange(15.0))
    floor = Floor(np.array([-1, 1, 2, 3, 4]) * SECOND, P, 3.0)
    for block, error, bound in (
        (THETA, 0.0025, 3.0),
        (POSITION, 9.0, 12.0),
        (VELOCITY, 0.03, 21.0),
        (ACCEL_BIAS, 4.0, 30.0),
    ):
        assert squares(truth, estimate, floor, block) == pytest.approx((error, 2.5 * bound))
    with pytest.raises(ScoreError, match="looks 3 s ahead and the floor inf s"):
        squares(truth, estimate, replace(floor, lookahead_s=math.inf), POSITION)
    with pytest.raises(ScoreError, match="none of the estimate's times"):
        squares(truth, estimate, replace(floor, t_ns=floor.t_ns + 1), POSITION)
    with pytest.raises(ScoreError, match="not known"):
        squares(truth, replace(estimate, b_g=None), floor, GYRO_BIAS)


def test_the_ratio_is_of_pooled_squares_and_its_interval_is_paired() -> None:
    error, bound = np.tile([1.0, 4.0, 7.0], 2), np.tile([0.5, 1.0, 1.5], 2)
    assert rmse_over_floor(error, bound).ratio == pytest.approx(2.0)
    same = rmse_over_floor(1.21 * bound, bound)  # a seed's error and bound stay together: nothing is uncertain
    assert (same.low, same.high) == pytest.approx((1.1, 1.1))
    few = rmse_over_floor(error[:4], bound[:4])
    assert (few.low, few.high, few.seeds) == (None, None, 4)
    for bad in ((error, 0 * bound), (error * np.nan, bound), (error[:0], bound[:0]), (error, bound[:2])):
        with pytest.raises(ScoreError, match="at least one seed"):
            rmse_over_floor(*bad)


def test_the_interval_covers_the_true_ratio_about_as_often_as_stated() -> None:
    """Squared errors of six degrees of freedom, 1.44 of the bound on average; and a surer interval is a wider one."""
    rng, covered, trials, level = np.random.default_rng(1), 0, 300, 0.9
    for _ in range(trials):
        bound = rng.uniform(0.5, 2.0, size=60)
        error = 1.44 * bound * rng.chisquare(6, size=60) / 6
        found = rmse_over_floor(error, bound, level)
        covered += found.low <= 1.2 <= found.high
    low, high = binom.interval(0.999, trials, level)
    assert low <= covered <= high
    wider = rmse_over_floor(error, bound, 0.99)
    assert wider.low < found.low < found.ratio < found.high < wider.high
