"""Innovations: what a reading says against what was predicted, and how unlikely that is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.stats import chi2

from ..datasets.epochs import SENSOR
from ..datasets.state import DIM, Array
from .measurements import decorrelate, measure


def gate_widths(gate: Mapping[str, float]) -> Array:
    """Return the largest normalised innovation squared that passes, (kinds, 4), by kind of reading and rows it has.

    Args:
        gate: probability by sensor; what is not named always passes.
    """
    widths = np.full((len(SENSOR), 4), np.inf)
    for kind, sensor in enumerate(SENSOR):
        if sensor in gate:
            widths[kind, 1:] = chi2.ppf(gate[sensor], [1, 2, 3])
    return widths


@njit(cache=True)
def normalised_innovations(
    state: NDArray[Any], P: Array, rig: NDArray[Any], readings: NDArray[Any]
) -> tuple[Array, NDArray[np.int64]]:
    """Normalised innovation squared of each reading, rᵀ S⁻¹ r with S = H P Hᵀ + C, all against the same state.

    Args:
        state: STATE record of length 1, predicted; its own P is not read.
        P: (15, 15) covariance of its error.
        rig: RIG record of length 1.
        readings: READING rows, all true at the state's time.

    Returns:
        nis (n,), and how many rows each has (n,); of an honest prediction chi-square with so many degrees of freedom.
        NaN where S is not positive.

    Source: Bar-Shalom, Li & Kirubarajan 2001, eq. (5.4.2-5).
    """
    nis, dof = np.zeros(len(readings)), np.zeros(len(readings), np.int64)
    r, H, C, PH = np.empty(3), np.empty((3, DIM)), np.empty((3, 3)), np.empty((3, DIM))
    for m in range(len(readings)):
        n = measure(readings, m, state, rig, r, H, C)
        for row in range(n):
            for i in range(DIM):
                PH[row, i] = 0.0
                for j in range(DIM):
                    PH[row, i] += P[i, j] * H[row, j]
        for row in range(n):
            for other in range(n):
                for i in range(DIM):
                    C[row, other] += H[row, i] * PH[other, i]
        decorrelate(n, r, H, C)
        dof[m] = n
        for row in range(n):
            nis[m] += r[row] ** 2 / C[row, row] if C[row, row] > 0.0 else np.nan
    return nis, dof
