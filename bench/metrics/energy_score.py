"""The energy score of a Gaussian estimate: one number in metres for error and covariance together; lower is better."""

from __future__ import annotations

from functools import cache

import numpy as np

from ...datasets.state import Array

NODES = 32
"""Of the quadrature: 64 change the score by less than 1e-8 of it, also if one axis is known a million times better."""
ROWS = 4096
"""Estimates at a time: 1 MB for each array of nodes."""


def energy_score(error: Array, cov: Array) -> Array:
    """Return E|X − y| − ½ E|X − X'| of truths y under estimates X, X' ~ N(mean, cov); docs/conventions.md (71).

    It is proper: an estimator has its best mean score by stating the law of its error. With cov = 0 it is |error|.

    Args:
        error: (n, d), truth less estimate, in one unit.
        cov: (n, d, d), positive semi-definite.

    Returns:
        (n,), in the unit of the error.

    Source: Gneiting & Raftery 2007, doi:10.1198/016214506000001437, eq. (22) with β = 1.
    """
    variances, axes = np.linalg.eigh(cov)
    variances, off = variances.clip(0.0), np.einsum("nij,ni->nj", axes, error)
    found = np.empty(len(error))
    for first in range(0, len(error), ROWS):
        rows = slice(first, first + ROWS)
        between = mean_length(np.zeros_like(off[rows]), 2.0 * variances[rows])
        found[rows] = mean_length(off[rows], variances[rows]) - 0.5 * between
    return found


def mean_length(mean: Array, variances: Array) -> Array:
    """Return E|x| of x ~ N(mean, diag(variances)), both (n, d), as (n,); docs/conventions.md (72).

    E|x| = π^−½ ∫ (1 − E exp(−u² |x|²)) / u² du over u > 0, by Gauss's rule in (1 + w)/(1 − w) = u √E|x|².
    """
    w, weight = _gauss()
    size = np.sqrt((variances + mean * mean).sum(axis=1))
    scale = np.where(size > 0.0, size, 1.0)
    u2 = (((1 + w) / (1 - w)) / scale[:, None]) ** 2
    exponent, product = np.zeros_like(u2), np.ones_like(u2)
    for variance, square in zip(variances.T, (mean * mean).T, strict=True):
        wide = 1.0 + 2.0 * variance[:, None] * u2
        exponent += square[:, None] * u2 / wide
        product *= wide
    return size / np.sqrt(np.pi) * (-np.expm1(-exponent - 0.5 * np.log(product)) @ (2.0 / (1 + w) ** 2 * weight))


@cache
def _gauss() -> tuple[Array, Array]:
    """Return the nodes and the weights, (NODES,) each, on −1 to 1."""
    return np.polynomial.legendre.leggauss(NODES)
