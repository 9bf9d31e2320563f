"""Innovations: a reading against the belief before it: their NIS, docs/conventions.md (37), and their density (73)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled
from ...datasets.epochs import SENSOR
from ...datasets.state import DIM, Array, Belief
from .elimination import decorrelate, project
from .measurements import measure
from .state import as_record

LOG_2PI = math.log(2.0 * math.pi)
"""Of a normal density, twice per component."""
TINY = np.finfo(np.float64).tiny
"""A variance that is not positive has no logarithm; the square beside it is NaN then."""

INNOVATION = np.dtype(
    [
        ("kind", "i8"),  # of the reading, as in READING
        ("t_ns", "i8"),  # when it was true
        ("dof", "i8"),  # components it measured
        ("nis", "f8"),  # normalised innovation squared: for a consistent belief, chi-square with dof degrees of freedom
        ("log_density", "f8"),  # of the reading as predicted, nats; its units are m, rad and m/s
        ("white", "f8", 3),  # the innovation with its covariance divided out; for a consistent belief N(0, I)
    ]
)


def gate_widths(gate: Mapping[str, float]) -> Array:
    """Return the largest NIS that passes, (kinds, 4), by kind of reading and its degrees of freedom.

    Args:
        gate: probability by sensor; a sensor that is not named always passes.
    """
    from scipy.stats import chi2  # a third of what importing the estimators would take, and only gates need it

    widths = np.full((len(SENSOR), 4), np.inf)
    for kind, sensor in enumerate(SENSOR):
        if sensor in gate:
            widths[kind, 1:] = chi2.ppf(gate[sensor], [1, 2, 3])
    return widths


def innovations(belief: Belief, readings: NDArray[Any], rig: NDArray[Any]) -> NDArray[Any]:
    """Judge a belief by readings that it has not seen, each by itself: of its residual r, with S = H P Hᵀ + C.

    Args:
        belief: at the readings' time; its velocity has the rate noise of the IMU's lever arm in it (`with_rate_noise`).
        readings: READING rows, all true at the belief's time.
        rig: RIG record of length 1 as `compile_rig` returns it, with the inflation that the estimator believes in. Its
            rate_cov must still be zero: the rate noise is in the belief, and would count twice.

    Returns:
        INNOVATION rows of the readings that measure anything. nis and log_density are NaN where the belief has no
        covariance, or one under which S is not positive.

    Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2.
    """
    table = np.zeros(len(readings), INNOVATION)
    judge(readings, as_record(belief), rig, table)
    return table[table["dof"] > 0]


@compiled
def judge(readings: NDArray[Any], state: NDArray[Any], rig: NDArray[Any], table: NDArray[Any]) -> None:
    """Fill a table of INNOVATION rows, one per reading; state and rig are records of length 1."""
    r, H, S, PH = np.empty(3), np.empty((3, DIM)), np.empty((3, 3)), np.empty(DIM)
    for m in range(len(readings)):
        t, n, largest = table[m], measure(readings, m, state, rig, r, H, S), 0.0
        t.kind, t.t_ns = readings[m].kind, readings[m].t_ns
        for i in range(n):
            S[i, i] = project(H[i], state[0].P[:], S[i, i], PH)
            for j in range(DIM):
                largest = max(largest, abs(H[i, j]))
                for k in range(i):
                    S[i, k] += H[k, j] * PH[j]
            for k in range(i):
                S[k, i] = S[i, k]
        if largest > 0.0:  # a yaw looked at from the pole measures nothing
            decorrelate(n, r, H, S)
            t.dof, t.nis, t.log_density = n, 0.0, -0.5 * n * LOG_2PI
            for i in range(n):
                t.white[i] = r[i] / math.sqrt(S[i, i]) if S[i, i] > 0.0 else np.nan
                t.nis += t.white[i] * t.white[i]
                t.log_density -= 0.5 * (t.white[i] * t.white[i] + math.log(max(S[i, i], TINY)))
