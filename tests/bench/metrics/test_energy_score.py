"""The energy score against a closed form, against draws, and for what makes it a score: nothing is gained by a lie."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.bench.metrics.energy_score import energy_score, mean_length
from scipy.special import erf
from scipy.stats import norm


def spread(rng: np.random.Generator, d: int) -> np.ndarray:
    root = rng.normal(size=(d, d)) * np.geomspace(0.1, 2, d)
    return root @ root.T


@pytest.mark.parametrize("off", [1e-3, 0.3, 1.0, 5.0, 40.0])
def test_in_a_sphere_the_mean_length_has_a_closed_form(off: float) -> None:
    sigma = 0.7  # of a noncentral chi with three degrees of freedom
    a = off / sigma
    exact = sigma * (np.sqrt(2 / np.pi) * np.exp(-0.5 * a * a) + (a + 1 / a) * erf(a / np.sqrt(2)))
    assert mean_length(np.array([[0.0, off, 0.0]]), np.full((1, 3), sigma**2)) == pytest.approx(exact, rel=1e-9)


def test_on_a_line_it_is_the_score_of_a_normal_law() -> None:
    """Gneiting & Raftery 2007, eq. (21): the continuous ranked probability score."""
    error, sigma = np.array([-3.0, 0.0, 0.2, 7.0]), np.array([1.0, 0.5, 2.0, 0.3])
    z = error / sigma
    crps = sigma * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
    assert energy_score(error[:, None], (sigma**2)[:, None, None]) == pytest.approx(crps, rel=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_what_draws_say(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 100_000
    cov, error = spread(rng, 3), rng.normal(size=3)
    x, other = (rng.multivariate_normal(np.zeros(3), cov, n) for _ in range(2))
    draws = np.linalg.norm(x - error, axis=1) - 0.5 * np.linalg.norm(x - other, axis=1)
    assert energy_score(error[None], cov[None])[0] == pytest.approx(draws.mean(), abs=4 * draws.std() / np.sqrt(n))


def test_a_certain_estimate_has_its_error_also_in_many_rows_and_along_one_axis() -> None:
    error = np.random.default_rng(0).normal(size=(5000, 3))
    assert energy_score(error, np.zeros((5000, 3, 3))) == pytest.approx(np.linalg.norm(error, axis=1), rel=1e-7)
    flat = np.diag([1.0, 0.0, 0.0])[None]
    line = energy_score(np.array([[0.4]]), np.ones((1, 1, 1)))
    assert energy_score(np.array([[0.4, 0.0, 0.0]]), flat) == pytest.approx(line, rel=1e-7)
    assert energy_score(np.zeros((1, 3)), np.zeros((1, 3, 3))).tolist() == [0.0]


def test_the_true_covariance_scores_best() -> None:
    rng = np.random.default_rng(1)
    cov = spread(rng, 3)
    error = rng.multivariate_normal(np.zeros(3), cov, 20_000)
    score = {k: energy_score(error, np.broadcast_to(k * cov, (len(error), 3, 3))).mean() for k in (0.25, 1.0, 4.0)}
    assert score[1.0] < min(score[0.25], score[4.0])
