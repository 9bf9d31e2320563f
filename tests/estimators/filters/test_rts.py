"""The smoother is least squares where least squares is exact, and beats its own filter."""

from __future__ import annotations

import numpy as np
import pytest
from driver import matched, run_log
from fathom.datasets import Belief, Trajectory
from fathom.datasets.epochs import Epoch, cut
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, GpsSpec, HeadingSpec
from fathom.estimators import create
from fathom.estimators.filters import rts
from fathom.estimators.filters.rts import PAGE, STANDSTILL, smooth_one
from fathom.estimators.physics.elimination import divide_into
from fathom.estimators.physics.state import STATE, as_belief, as_record
from linear import LINEAR, TOY_RIG, least_squares, linear_toy
from logs import DELAYED, until
from paths import random_state

ON = pytest.mark.parametrize("on", ["eskf", "iekf"])


def smoothed(prior: Belief, epochs: list[Epoch], rig: object, on: str) -> Trajectory:
    run = create("rts", filter=on).begin(prior, rig)
    for epoch in epochs:
        run.step(epoch)
    return run.finish()


@ON
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_where_all_is_linear_it_is_least_squares(seed: int, on: str) -> None:
    prior, epochs = linear_toy(seed)
    exact, _ = least_squares(prior, epochs, TOY_RIG, LINEAR, 2)
    ours = smoothed(prior, epochs, TOY_RIG, on)
    assert ours.lookahead_s == np.inf
    for k, belief in enumerate(exact):
        sigma = np.sqrt(np.diag(belief.P))[LINEAR]
        grid = np.ix_(LINEAR, LINEAR)
        assert np.abs(belief.state.local(ours.state(k))[LINEAR] / sigma).max() < 1e-6
        assert np.abs((ours.P[k] - belief.P)[grid] / np.outer(sigma, sigma)).max() < 1e-6


@pytest.mark.slow
@ON
@pytest.mark.parametrize(("noise_scale", "iterations", "apart", "P_apart"), [(1.0, 4, 0.3, 0.1), (0.01, 3, 1e-4, 1e-3)])
def test_on_a_real_mission_only_nonlinearity_parts_it_from_least_squares(
    noise_scale: float, iterations: int, apart: float, P_apart: float, on: str
) -> None:
    """All of the state, turning: what parts them, in sigmas, shrinks with the square of the errors.

    With errors a hundredth of what is stated both linearise at the truth; then they must be the same.
    """
    readings = {"dvl": DvlSpec(5.0), "depth": DepthSpec(5.0), "gps": GpsSpec(1.0), "heading": HeadingSpec(5.0)}
    log = simulate(Scenario(duration_s=20.0, surface_for_s=40.0, noise_scale=noise_scale, **readings), seed=3)
    epochs = cut(log, log.imu.t_ns[19::20]).epochs
    assert len(epochs) == 100
    exact, step = least_squares(log.prior, epochs, log.rig, np.arange(15), iterations)
    assert np.abs(step).max() < 1e-3  # it has converged
    ours = smoothed(log.prior, epochs, log.rig, on)
    for k, belief in enumerate(exact):
        sigma = np.sqrt(np.diag(belief.P))
        assert np.abs(belief.state.local(ours.state(k)) / sigma).max() < apart
        assert np.abs((ours.P[k] - belief.P) / np.outer(sigma, sigma)).max() < P_apart


def test_its_last_state_is_the_filters_and_its_times_are_the_ticks() -> None:
    log = simulate(Scenario(duration_s=120.0), seed=1)
    result = run_log(log, create("rts"))
    assert sum(len(epoch.imu) > 0 for epoch in cut(log, result.online.t_ns).epochs) > PAGE  # more than one page
    assert np.array_equal(result.smoothed.t_ns, result.online.t_ns)
    last, filtered = result.smoothed.state(-1), result.online.state(-1)
    assert np.abs(filtered.local(last)).max() < 1e-12
    assert np.allclose(result.smoothed.P[-1], result.online.P[-1], rtol=1e-9, atol=1e-18)
    assert np.linalg.eigvalsh(result.online.P - result.smoothed.P).min() > -1e-6  # smoothing never loses information


def test_late_readings_leave_no_trace_in_the_smoothed_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replayed epochs replace the stored ones, across pages."""
    monkeypatch.setattr(rts, "PAGE", 7)
    logs = simulate(Scenario(duration_s=30.0), seed=5), simulate(Scenario(duration_s=30.0, **DELAYED), seed=5)
    last_ns = int(logs[1].imu.t_ns[-1] - 1e9)
    a, b = (run_log(until(log, last_ns), create("rts")).smoothed for log in logs)
    assert np.array_equal(a.t_ns, b.t_ns)
    for k in range(len(a)):
        sigma = np.sqrt(np.diag(a.P[k]))
        assert np.abs(a.state(k).local(b.state(k)) / sigma).max() < 1e-3
        assert np.abs((a.P[k] - b.P[k]) / np.outer(sigma, sigma)).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("mission", ["lawnmower", "yo-yo"])
def test_smoothed_states_are_more_accurate_than_the_filter(mission: str) -> None:
    squares = {"online": np.zeros(2), "smoothed": np.zeros(2)}
    for seed in range(20):
        log = simulate(Scenario(mission=mission, duration_s=120.0), seed)
        result = run_log(log, create("rts"))
        for output, total in squares.items():
            track = getattr(result, output)
            truth = matched(log.truth, track)
            total += [np.square(getattr(track, x) - getattr(truth, x)).sum(axis=1).mean() for x in ("p_WB_W", "v_WB_W")]
    position, velocity = np.sqrt(squares["smoothed"] / squares["online"])
    assert position < 0.95
    assert velocity < 0.7


@ON
@pytest.mark.parametrize("seed", range(3))
def test_smoothing_over_an_interval_of_zero_changes_nothing(seed: int, on: str) -> None:
    """Without motion and noise, smoothed equals filtered, with a state a radian away and to the last digit of P."""
    rng = np.random.default_rng(seed)
    x, M = random_state(rng), rng.normal(size=(2, 15, 15))
    now = as_record(Belief(0, x, M[0] @ M[0].T))
    later = as_record(Belief(0, x.retract(0.6 * rng.normal(size=15)), 0.1 * M[1] @ M[1].T))
    assert smooth_one(now, later, STANDSTILL, 9.81, on == "iekf", np.zeros(1, STATE))
    assert np.abs(as_belief(0, now).state.local(as_belief(0, later).state)).max() < 1e-8
    assert np.allclose(now["P"], later["P"], rtol=1e-6, atol=1e-6)


def test_what_has_no_variance_is_left_out_of_the_gain() -> None:
    rng = np.random.default_rng(0)
    known = np.r_[0:4, 5:15]
    scale = np.resize([1, 1e-3, 1e3, 1, 1], len(known))
    M, A = rng.normal(size=(len(known), 40)) * scale[:, None], rng.normal(size=(15, 15))
    P, X = np.zeros((15, 15)), np.empty((15, 15))
    P[np.ix_(known, known)] = M @ M.T
    assert divide_into(P, A, X)
    assert np.allclose(P[np.ix_(known, known)] @ X[known], A[known], rtol=1e-8, atol=1e-8)
    assert (X[4] == 0).all()
    assert not divide_into(P - 1e-3 * np.eye(15), A, X)
