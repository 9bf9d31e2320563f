"""Allan deviation, and the white density and bias instability read from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....datasets.state import Array

PER_DECADE = 10
"""Averaging times per decade: enough to see a slope over a third of one."""
FEWEST_CLUSTERS = 9
"""Independent clusters at the longest τ: its Allan deviation is then known to about a quarter."""
SLOPE_TOLERANCE = 0.15
"""Of the slope in the log-log plot: half way from white noise (−1/2) to where flicker noise has a visible part."""
FLICKER = float(np.sqrt(2 * np.log(2) / np.pi))
"""Allan deviation of flicker noise over its coefficient B, the bias instability (IEEE Std 952, C.1.3): 0.664."""


@dataclass(frozen=True, eq=False)
class AllanCurve:
    """Allan deviation of each axis.

    Attributes:
        tau_s: (m,) averaging times.
        deviation: (m, k) in the unit of the rates.
        clusters: (m,) how many independent averages of that length there are.
    """

    tau_s: Array
    deviation: Array
    clusters: Array


def averaging_factors(n: int) -> NDArray[np.int64]:
    """Return numbers of samples to average over, ten per decade, up to nine clusters of n samples."""
    longest = n // FEWEST_CLUSTERS
    if longest < 1:
        return np.zeros(0, np.int64)
    decades = np.log10(longest)
    return np.unique(np.rint(10 ** np.linspace(0, decades, max(int(decades * PER_DECADE) + 1, 1))).astype(np.int64))


def allan_deviation(rates: Array, period_s: float, factors: NDArray[np.int64] | None = None) -> AllanCurve:
    """Return the overlapping Allan deviation of samples (n, k) that are means over period_s.

    σ²(mT) = Σ_j (θ_{j+2m} − 2 θ_{j+m} + θ_j)² / (2 (mT)² (n − 2m + 1)), with θ the samples' running integral.

    Source: IEEE Std 952-1997, annex C; Riley, NIST SP 1065, section 5.2.4.
    """
    n = len(rates)
    m = averaging_factors(n) if factors is None else factors
    centred = rates - rates.mean(axis=0)  # a constant rate has no Allan deviation, but costs digits
    theta = np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(centred, axis=0)]) * period_s
    deviation = np.empty((len(m), rates.shape[1]))
    for row, k in enumerate(m):
        second = theta[2 * k :] - 2 * theta[k:-k] + theta[: -2 * k]
        deviation[row] = np.sqrt(np.mean(second**2, axis=0) / 2) / (k * period_s)
    return AllanCurve(np.asarray(m * period_s, float), deviation, np.asarray(n / m, float))


def white_density(curve: AllanCurve) -> Array:
    """Return (k,) N: at τ = 1 s, the line of slope −1/2 through the part of the curve that has that slope.

    The part begins at the least σ √τ of well known points and extends while the slope is within 0.15 of −1/2. If no
    point has that slope, the least σ √τ is returned, an upper bound.
    """
    root_tau = curve.deviation * np.sqrt(curve.tau_s)[:, None]
    known = curve.clusters >= 5 * FEWEST_CLUSTERS
    if not known.any():
        known = np.ones(len(curve.tau_s), bool)
    densities = np.empty(root_tau.shape[1])
    for k, axis in enumerate(root_tau.T):
        least = int(np.argmin(np.where(known, axis, np.inf)))
        densities[k] = axis[least]
        if len(axis) < 3 or axis[least] == 0:
            continue
        slope = np.gradient(np.log(np.maximum(curve.deviation[:, k], 1e-300)), np.log(curve.tau_s))
        white = known & (np.abs(slope + 0.5) < SLOPE_TOLERANCE)
        first = last = least
        while first > 0 and white[first - 1]:
            first -= 1
        while last + 1 < len(axis) and white[last + 1]:
            last += 1
        weight = curve.clusters[first : last + 1]  # the variance of a log deviation is inversely proportional
        densities[k] = np.exp(np.average(np.log(axis[first : last + 1]), weights=weight))
    return densities


def bias_instability(curve: AllanCurve) -> Array:
    """Return (k,) B: the least deviation over 0.664, an upper bound where the curve still falls at its end."""
    return curve.deviation.min(axis=0) / FLICKER
