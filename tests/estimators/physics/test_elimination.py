"""Elimination, row by row, is the joint update and the division that linear algebra defines."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.estimators.physics.elimination import absorb, decorrelate, divide_into, normalised_square, project


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, 2 * n))
    return A @ A.T


@pytest.mark.parametrize("seed", range(3))
def test_rows_taken_in_one_by_one_are_the_joint_update(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, C, H, r, m = covariance(rng, 15), covariance(rng, 3), rng.normal(size=(3, 15)), rng.normal(size=3), np.ones(15)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + C)
    m_joint, P_joint = m - K @ (r + H @ m), P - K @ H @ P
    assert absorb(3, r.copy(), H.copy(), C.copy(), m, P)
    assert np.allclose(m, m_joint, rtol=1e-10)
    assert np.allclose(P, P_joint, rtol=1e-9, atol=1e-9)


def test_a_row_under_a_covariance_that_is_none_is_refused() -> None:
    r, H, C = np.ones(1), np.eye(15)[:1], np.full((1, 1), 0.5)
    assert not absorb(1, r, H, C, np.zeros(15), -np.eye(15))


def test_a_row_meets_the_belief_in_its_innovations_variance() -> None:
    rng = np.random.default_rng(1)
    P, h, PH = covariance(rng, 15), rng.normal(size=15), np.empty(15)
    h[3:9] = 0.0
    assert project(h, P, 0.25, PH) == pytest.approx(h @ P @ h + 0.25)
    assert np.allclose(PH, P @ h)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_normalised_square_is_that_of_the_inverse(n: int) -> None:
    rng = np.random.default_rng(n)
    S, r = covariance(rng, 3), rng.normal(size=3)
    expected = r[:n] @ np.linalg.solve(S[:n, :n], r[:n])
    assert normalised_square(n, r.copy(), np.zeros((3, 15)), S.copy()) == pytest.approx(expected)
    S[n - 1, n - 1] = -1.0
    assert np.isnan(normalised_square(n, r, np.zeros((3, 15)), S))


def test_rows_of_independent_errors_are_left_as_they_are() -> None:
    rng = np.random.default_rng(2)
    r, H, C = rng.normal(size=3), rng.normal(size=(3, 15)), np.diag([1.0, 2.0, 3.0])
    before = r.copy(), H.copy(), C.copy()
    decorrelate(3, r, H, C)
    assert all(np.array_equal(a, b) for a, b in zip((r, H, C), before, strict=True))


def test_dividing_is_solving() -> None:
    rng = np.random.default_rng(3)
    P, A, X = covariance(rng, 15), rng.normal(size=(15, 15)), np.empty((15, 15))
    assert divide_into(P, A, X)
    assert np.allclose(P @ X, A, rtol=1e-9, atol=1e-9)
