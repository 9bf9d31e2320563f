"""The invariant error of rotation and velocity: its derivatives, what it leaves alone, and its second order."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets import Belief, NavState
from fathom.datasets.state import DIM, THETA, VELOCITY, Array
from fathom.estimators.physics.invariant import (
    congruent,
    error_after_invariant,
    from_invariant,
    inject_moved,
    invariant_after_error,
    local_invariant,
    move,
    retract_invariant,
    spread_velocity,
    to_invariant,
)
from fathom.estimators.physics.so3 import skew
from fathom.estimators.physics.state import STATE, as_belief, as_record
from paths import random_state
from scipy.linalg import expm
from scipy.spatial.transform import Rotation


def record(x: NavState, P: Array | None = None) -> np.ndarray:
    return as_record(Belief(0, x, np.zeros((DIM, DIM)) if P is None else P))


def moved(x: NavState, error: Array) -> NavState:
    out = np.zeros(1, STATE)
    move(record(x), error, out)
    return as_belief(0, out).state


def some_covariance(rng: np.random.Generator, size: float) -> Array:
    A = size * rng.normal(size=(DIM, DIM))
    return A @ A.T / DIM


@pytest.mark.parametrize("size", [1e-3, 0.05, 1.0])
def test_it_is_the_exponential_of_se_2_3_and_back(size: float) -> None:
    rng = np.random.default_rng(1)
    x, xi, out, back = random_state(rng), size * rng.normal(size=DIM), np.zeros(1, STATE), np.empty(DIM)
    retract_invariant(record(x), xi, out)
    L = np.zeros((4, 4))
    L[:3, :3], L[:3, 3] = skew(xi[THETA]), xi[VELOCITY]
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = x.R_WB, x.v_WB_W
    expected, y = expm(L) @ X, as_belief(0, out).state
    assert np.allclose(y.R_WB, expected[:3, :3], atol=1e-12)
    assert np.allclose(y.v_WB_W, expected[:3, 3], atol=1e-11)
    local_invariant(record(x), out, back)
    assert np.allclose(back, xi, atol=1e-9)


@pytest.mark.parametrize("size", [1e-3, 0.05, 1.0])
def test_its_derivatives_are_finite_differences(size: float) -> None:
    rng = np.random.default_rng(2)
    x, xi, K, out = random_state(rng), size * rng.normal(size=DIM), np.empty((DIM, DIM)), np.zeros(1, STATE)

    def after(d: Array) -> NavState:
        retract_invariant(record(x), d, out)
        return as_belief(0, out).state

    y = after(xi)
    error_after_invariant(record(y), xi, K)
    numeric = np.stack([(y.local(after(xi + e)) - y.local(after(xi - e))) / 2e-6 for e in 1e-6 * np.eye(DIM)], axis=1)
    assert np.allclose(K, numeric, atol=1e-7 * max(1.0, np.abs(K).max()))
    H = np.empty((DIM, DIM))
    invariant_after_error(record(y), xi, H)
    assert np.allclose(H @ K, np.eye(DIM), atol=1e-12)
    A, B = to_invariant(x.R_WB, x.v_WB_W), from_invariant(x.R_WB, x.v_WB_W)
    assert np.allclose(A @ B, np.eye(DIM), atol=1e-13)
    P, Q = some_covariance(rng, 0.1), np.empty((DIM, DIM))
    for M in (A, B, K):
        Q[:] = P
        congruent(M, Q)
        assert np.allclose(Q, M @ P @ M.T, atol=1e-12 * np.abs(M).max() ** 2)


def test_a_move_is_retract_to_first_order_and_turns_a_velocity_known_in_the_body() -> None:
    rng = np.random.default_rng(3)
    x, e = random_state(rng), 1e-4 * rng.normal(size=DIM)
    assert np.abs(x.retract(e).local(moved(x, e))).max() < 1e-7
    theta = np.array([0.7, -1.5, 0.4])
    e[:], e[THETA], e[VELOCITY] = 0.0, theta, -np.cross(x.v_WB_W, x.R_WB @ theta)
    assert np.allclose(moved(x, e).R_WB.T @ moved(x, e).v_WB_W, x.R_WB.T @ x.v_WB_W, atol=1e-12)


def test_injecting_an_error_carries_its_covariance_along() -> None:
    """Samples of the error about a mean, moved, are spread about the moved mean by its P."""
    rng = np.random.default_rng(4)
    x, mean, P = random_state(rng), 0.3 * rng.normal(size=DIM), some_covariance(rng, 1e-3)
    belief = record(x, P)
    inject_moved(belief, mean)
    y, d = as_belief(0, belief).state, rng.multivariate_normal(np.zeros(DIM), P, 4000)
    errors = np.array([y.local(moved(x, mean + e)) for e in d])
    sigma = np.sqrt(np.diag(belief[0]["P"]))
    assert np.abs((np.cov(errors.T) - belief[0]["P"]) / np.outer(sigma, sigma)).max() < 0.1


def test_the_second_order_of_the_velocity_is_that_of_an_arc() -> None:
    """A velocity known in B to 5 cm/s, the heading to 25°: its error along itself, by closed form and by sampling.

    E[(v (cos ψ − 1))²] is ¾ σ⁴ v² to fourth order; across itself nothing is added, but by roll and pitch.
    """
    s, v = np.radians(25.0), np.array([1.5, 0.0, 0.0])
    R_WB = Rotation.from_euler("ZYX", [0.4, 0.2, -0.3]).as_matrix()
    sigma = np.zeros(DIM)
    sigma[2], sigma[VELOCITY] = s, 0.05
    B = from_invariant(R_WB, v)
    P = B @ np.diag(sigma**2) @ B.T
    first = P[VELOCITY, VELOCITY].copy()
    spread_velocity(P, R_WB)
    gained = P[VELOCITY, VELOCITY] - first
    assert gained[0, 0] == pytest.approx(0.75 * s**4 * v[0] ** 2, rel=0.02)
    rng, n = np.random.default_rng(5), 200_000
    phi, nu = np.outer(s * rng.normal(size=n), [0.0, 0.0, 1.0]), 0.05 * rng.normal(size=(n, 3))
    second = 0.5 * np.cross(phi, nu - np.cross(v, phi))
    assert np.allclose(gained, second.T @ second / n, atol=0.02 * gained[0, 0])
