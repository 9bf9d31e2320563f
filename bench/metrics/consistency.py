"""Consistency over seeds: ANEES at times fixed beforehand, and NIS, with their chi-square intervals; whiteness.

Errors of one run are correlated in time, so their average over time is not chi-square, and an interval for it would
raise false alarms. Over seeds they are independent: at one time, the NEES of N seeds of a block with d degrees of
freedom sum to chi-square with N d. The interval at each of n times has probability 1 − FALSE_ALARM / n, so that all n
together (one line of a figure) raise a false alarm at most once in 1 / FALSE_ALARM, and 100 such lines once in ten.

Innovations are white, so NIS may be pooled over time as well as over seeds. See docs/conventions.md (55) and (56).

Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainccinv, gammaincinv, ndtri

from ...datasets.log import Log
from ...datasets.state import Array
from ...datasets.trajectory import Trajectory
from .association import ScoreError, associate
from .state_error import BLOCKS, DOF, Block, nees

FALSE_ALARM = 1e-3
"""Probability that a consistent estimator leaves the interval at any of the times."""


@dataclass(frozen=True, eq=False)
class Average:
    """Averages of chi-square variables over their degrees of freedom, with the interval of a consistent estimator.

    Attributes:
        t_s: (n,) from the start of the log; NaN for an average over time.
        runs: (n,) seeds in each average.
        dof: (n,) degrees of freedom of all seeds together.
        value: (n,) averages per degree of freedom; 1 is consistent.
        low, high: (n,) the interval.
    """

    t_s: Array
    runs: NDArray[np.int64]
    dof: NDArray[np.int64]
    value: Array
    low: Array
    high: Array

    def __len__(self) -> int:
        return len(self.value)

    @property
    def above(self) -> NDArray[np.bool_]:
        """Where errors are larger than the covariance says: overconfident."""
        return self.value > self.high

    @property
    def below(self) -> NDArray[np.bool_]:
        """Where errors are smaller than the covariance says: underconfident."""
        return self.value < self.low


def nees_at(log: Log, estimate: Trajectory, epochs: int) -> dict[str, list[float | None]]:
    """Return the NEES of each block at times fixed beforehand, with those times.

    The times are the middles of `epochs` equal parts of the log and do not depend on the estimate. For each, the
    nearest pose of its part with a covariance is used (of two, the earlier). A smoother that keeps few covariances has
    fewer times.

    Args:
        log: with a truth that is not a reference.
        estimate: not aligned.
        epochs: number of times.

    Returns:
        "t_s" of the poses, from the start of the log, and a list per block of BLOCKS, None where there is no such pose
        or its truth is unknown. Blocks that `nees` refuses are left out; without any covariance it is empty.
    """
    assert log.truth is not None
    try:
        truth, estimate = associate(log.truth, estimate)
    except ScoreError:
        return {}
    if estimate.P is None:
        return {}
    age_ns = estimate.t_ns - log.start_ns
    kept = np.flatnonzero(np.isfinite(estimate.P).all(axis=(1, 2)))
    half_ns = (int(log.imu.t_ns[-1]) - log.start_ns) // (2 * epochs)
    found: dict[int, int] = {}
    for k in range(epochs):
        middle_ns = (2 * k + 1) * half_ns
        inside = kept[(age_ns[kept] > middle_ns - half_ns) & (age_ns[kept] <= middle_ns + half_ns)]
        if len(inside):
            found[k] = int(inside[np.abs(age_ns[inside] - middle_ns).argmin()])
    if not found:
        return {}
    rows = np.array(list(found.values()))
    columns = {"t_s": age_ns[rows] * 1e-9}
    for block in BLOCKS:
        with suppress(ScoreError):
            columns[block] = nees(truth.select(rows), estimate.select(rows), block)
    return {name: _spread(dict(zip(found, values.tolist(), strict=True)), epochs) for name, values in columns.items()}


def _spread(values: Mapping[int, float], n: int) -> list[float | None]:
    """Return a list of n with these values at their keys, and None for a missing value or NaN."""
    return [None if np.isnan(value := values.get(k, np.nan)) else value for k in range(n)]


def interval(dof: Array | NDArray[np.int64], probability: float) -> tuple[Array, Array]:
    """Return the central interval of chi-square over its degrees of freedom, (n,) and (n,)."""
    tail = 0.5 * (1.0 - probability)
    half = np.asarray(dof, float) / 2
    return gammaincinv(half, tail) / half, gammainccinv(half, tail) / half


def anees(values: Array, dof: int, t_s: Array) -> Average:
    """Average NEES over seeds, time by time; docs/conventions.md (55).

    Args:
        values: (N, n) of N seeds at n times; NaN for a missing one.
        dof: of one value.
        t_s: (n,) the times.
    """
    known = ~np.isnan(values)
    runs = known.sum(axis=0)
    there = runs > 0
    total = np.where(known, values, 0.0).sum(axis=0)[there]
    return _average(t_s[there], runs[there], dof * runs[there], total)


def anees_of(runs: Sequence[str | None]) -> dict[Block, Average]:
    """Average the results of `nees_at` over seeds, given as JSON from the store; blocks without a run are left out."""
    every = [
        {name: np.array(values, float) for name, values in json.loads(run).items()}
        for run in runs
        if run not in (None, "", "{}")
    ]
    usual = Counter(len(run["t_s"]) for run in every).most_common(1)
    every = [run for run in every if len(run["t_s"]) == usual[0][0]]  # leaves out runs with another number of times
    found: dict[Block, Average] = {}
    for block in BLOCKS:
        of_block = [run for run in every if block in run]
        if of_block:
            values, times = (np.stack([run[name] for run in of_block]) for name in (block, "t_s"))
            first = [next((t for t in column if not np.isnan(t)), np.nan) for column in times.T]
            found[block] = anees(values, DOF[block], np.array(first))
    return {block: average for block, average in found.items() if len(average)}


def pooled_nis(runs: Sequence[Mapping[str, Any]]) -> dict[str, Average]:
    """Pool the NIS of each sensor over time and runs (rows of the store); sensors without NIS are left out."""
    return {
        sensor: _average(np.array([np.nan]), *(np.array([x]) for x in (runs_of, dof, value * dof)))
        for sensor, (value, dof, runs_of) in pooled(runs, "nis").items()
    }


def pooled_whiteness(runs: Sequence[Mapping[str, Any]]) -> dict[str, Average]:
    """Pool the `autocorrelation` of each sensor's innovations likewise, with the interval of white ones."""
    found = {}
    for sensor, (value, dof, runs_of) in pooled(runs, "whiteness").items():
        half = float(-ndtri(0.5 * FALSE_ALARM)) / np.sqrt(dof)
        found[sensor] = Average(*(np.array([x]) for x in (np.nan, runs_of, dof, value, -half, half)))
    return found


def pooled(runs: Sequence[Mapping[str, Any]], score: str) -> dict[str, tuple[float, int, int]]:
    """Return the mean of a score of innovations over runs, by degrees of freedom; with these, and how many runs."""
    each: dict[str, list[tuple[float, int]]] = {}
    for run in runs:
        for sensor, dof in json.loads(run["nis_dof"] or "{}").items():
            if (value := run.get(f"{score}_{sensor}")) is not None:
                each.setdefault(sensor, []).append((value, dof))
    found = {}
    for sensor, of_sensor in each.items():
        dof = sum(n for _, n in of_sensor)
        found[sensor] = (sum(value * n for value, n in of_sensor) / dof, dof, len(of_sensor))
    return found


def autocorrelation(white: Array) -> float | None:
    """Return the correlation of each of n vectors with the one before it, (n, d); None for fewer than two.

    Of innovations with their covariance divided out. Those of a consistent filter are white: 0, with a σ of one over
    the root of all their degrees of freedom. The mean is not subtracted, so a bias shows as well. Components that were
    not measured are 0. See docs/conventions.md (74).
    """
    square = float((white * white).sum())
    return float((white[1:] * white[:-1]).sum()) / square if len(white) > 1 and square > 0.0 else None


def _average(t_s: Array, runs: NDArray[np.int64], dof: NDArray[np.int64], total: Array) -> Average:
    low, high = interval(dof, 1.0 - FALSE_ALARM / max(len(total), 1))
    return Average(t_s, runs, dof, total / dof, low, high)
