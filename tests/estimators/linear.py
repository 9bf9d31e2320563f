"""A vehicle for which everything is linear, and least squares on all it reads: the oracle of filters and smoothers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.linalg
from fathom.datasets import Belief, ImuNoise, Mounting, NavState, Rig
from fathom.datasets.epochs import DEPTH, DVL, GPS, IMU_SAMPLE, Epoch
from fathom.estimators import ESTIMATORS, create
from fathom.estimators.filters.eskf_filterpy import stack
from fathom.estimators.graph.gtsam_border import LEAST_WALK
from fathom.estimators.interface import FACTORS
from fathom.estimators.physics.imu import BLOCK, compile_rig, first_sample, integrate, predict, process_noise
from fathom.estimators.physics.state import as_belief, as_record, with_rate_noise
from paths import GRAVITY, random_rotation, reading
from scipy.spatial.transform import Rotation

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


def least_squares(
    prior: Belief, epochs: list[Epoch], rig: object, rows: np.ndarray, iterations: int
) -> tuple[list[Belief], np.ndarray]:
    """MAP states at the prior and after each epoch, by Gauss–Newton on the whole log as one dense problem.

    Of the error state only `rows` are free. Each iteration linearises at the states themselves; motions are integrated
    at each state's own biases. Returns the beliefs of the epochs and the last step over sigma.
    """
    record = compile_rig(rig, FACTORS, {})
    first = first_sample(epochs[0].imu, record)
    states = [prior.state]
    before, block, F, Q = first, np.zeros(1, BLOCK), np.empty((15, 15)), np.empty((15, 15))
    for epoch in epochs:  # start from the prior, carried on
        x = as_record(Belief(0, states[-1], np.eye(15)))
        integrate(epoch.imu, before, x["b_a"][0], x["b_g"][0], record, block)
        predict(block, x, rig.gravity, F, x)
        states.append(as_belief(0, x).state)
        before = epoch.imu[-1:]
    n, m = len(states), len(rows)
    for _ in range(iterations):
        before, grid = first, np.ix_(rows, rows)
        lines = [whitened(n, {0: np.eye(m)}, prior.state.local(states[0])[rows], prior.P[grid])]
        for k, epoch in enumerate(epochs):
            x = as_record(Belief(0, states[k], np.eye(15)))
            R_i = x["R_WB"][0].copy()
            integrate(epoch.imu, before, x["b_a"][0], x["b_g"][0], record, block)
            predict(block, x, rig.gravity, F, x)
            process_noise(block, R_i, Q)
            r = as_belief(0, x).state.local(states[k + 1])
            lines.append(whitened(n, {k: -F[grid], k + 1: np.eye(m)}, r[rows], Q[grid]))
            z, H, C = stack(as_record(Belief(0, states[k + 1], np.eye(15))), record, epoch.readings)
            if len(z):
                lines.append(whitened(n, {k + 1: H[:, rows]}, z, C))
            before = epoch.imu[-1:]
        A = np.concatenate(lines)
        size = np.r_[np.linalg.norm(A[:, :-1], axis=0), 1.0]
        upper, size = np.linalg.qr(A / size, mode="r"), size[:-1]
        root = scipy.linalg.solve_triangular(upper[: n * m, : n * m], np.eye(n * m)) / size[:, None]
        step = root @ upper[: n * m, -1]
        full = np.zeros((n, 15))
        full[:, rows] = step.reshape(n, m)
        states = [x.retract(error) for x, error in zip(states, full, strict=True)]
    beliefs = []
    for k, epoch in enumerate(epochs, 1):
        P, part = np.zeros((15, 15)), root[k * m : (k + 1) * m]
        P[grid] = part @ part.T
        beliefs.append(with_rate_noise(Belief(epoch.t_ns, states[k], P), record))
    return beliefs, step / np.sqrt((root**2).sum(axis=1))


def whitened(n: int, parts: dict[int, np.ndarray], r: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Rows [A | −r] over n states, the parts standing at theirs, whitened by C."""
    scale, m = 1 / np.sqrt(np.diag(C)), next(iter(parts.values())).shape[1]
    line = np.zeros((len(r), n * m + 1))
    for k, A in parts.items():
        line[:, k * m : (k + 1) * m] = A
    line[:, -1] = -r
    return np.linalg.solve(np.linalg.cholesky(C * np.outer(scale, scale)), scale[:, None] * line)


# -- what smoothers say of it ------------------------------------------------------------------------------------------

SMOOTHERS_RIG = Rig(
    ImuNoise(TINY, 1.0, LEAST_WALK * TINY, LEAST_WALK, TINY, 1.0),
    Mounting(random_rotation(np.random.default_rng(7))),
    gravity=GRAVITY,
)
"""With this noise nothing is left of what GTSAM's IMU factor has and our block has not; see test_linear_smoothers."""
LAG = 5
"""The window, in epochs; each makes one keyframe."""
SEEDS = [0, pytest.param(1, marks=pytest.mark.slow)]


def options(name: str, thorough: bool) -> dict[str, object]:
    """As shipped, but for the lag and covariances at every tick; or relinearising everything that moves."""
    wanted: dict[str, object] = {"lag_s": 0.2 * LAG, "smoothed_covariance_s": 1e-3}
    if thorough:
        wanted |= {"relinearize": [1e-9] * 4, "wildfire": 0.0}
    return {key: value for key, value in wanted.items() if key in ESTIMATORS[name].__dataclass_fields__}


@cache
def toy(seed: int) -> tuple[Belief, list[Epoch]]:
    return linear_toy(seed, epochs=25, rig=SMOOTHERS_RIG)


@cache
def exact(seed: int, seen: int) -> list[Belief]:
    """Least squares on the first `seen` epochs, as one dense problem: the beliefs at each of them."""
    prior, epochs = toy(seed)
    return least_squares(prior, epochs[:seen], SMOOTHERS_RIG, LINEAR, 1)[0]


@cache
def run(name: str, seed: int, thorough: bool = False) -> tuple[list[Belief], list[Belief]]:
    """The beliefs at the end of each epoch, and the smoothed ones if there are any."""
    prior, epochs = toy(seed)
    one, online = create(name, **options(name, thorough)).begin(prior, SMOOTHERS_RIG), []
    for epoch in epochs:
        one.step(epoch)
        online.append(one.belief())
    track = one.finish()
    return online, [] if track is None else [
        Belief(int(t), track.state(k), track.P[k]) for k, t in enumerate(track.t_ns)
    ]


def apart(ours: list[Belief], theirs: list[Belief]) -> float:
    """The largest difference of state over σᵢ, and of covariance over σᵢσⱼ, of what is uncertain."""
    assert [a.t_ns for a in ours] == [b.t_ns for b in theirs]
    worst = 0.0
    for a, b in zip(ours, theirs, strict=True):
        sigma = np.sqrt(np.diag(b.P)[LINEAR])
        state = np.abs(b.state.local(a.state)[LINEAR] / sigma)
        P = np.abs((a.P - b.P)[np.ix_(LINEAR, LINEAR)] / np.outer(sigma, sigma))
        worst = np.maximum(worst, max(state.max(), P.max()))
    return float(worst)
