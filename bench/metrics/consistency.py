"""Is the error as large as the covariance says? Over seeds, at times fixed beforehand, against the chi-square interval.

The errors of a consistent estimator are correlated in time, so an average over time is not chi-square, and an interval
that takes it for that raises false alarms. Averages over seeds are, time by time: N seeds of a block with d degrees of
freedom sum to chi-square with N d. The interval at each of n times has probability 1 − FALSE_ALARM / n, so that all n
together, one line of a figure, raise a false alarm at most once in 1/FALSE_ALARM; a table of 100 such once in ten.

Innovations are white, so their NIS may be pooled over time and seeds alike.

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
from scipy.special import gammainccinv, gammaincinv

from ...datasets.log import Log
from ...datasets.state import Array
from ...datasets.trajectory import Trajectory
from .association import ScoreError, associate
from .state_error import BLOCKS, DOF, Block, nees

FALSE_ALARM = 1e-3


@dataclass(frozen=True, eq=False)
class Average:
    """Averages of something that is chi-square over its degrees of freedom, and where an honest one lies.

    Attributes:
        t_s: (n,) from the start of the log; NaN for what is pooled over time.
        runs: (n,) how many seeds are in each.
        dof: (n,) degrees of freedom, of all of them together.
        value: (n,) the averages, by degree of freedom: 1 is honest.
        low, high: (n,) their interval.
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
        """Which errors are larger than the covariance says: overconfidence."""
        return self.value > self.high

    @property
    def below(self) -> NDArray[np.bool_]:
        """Which errors are smaller than the covariance says: modesty."""
        return self.value < self.low


def nees_at(log: Log, estimate: Trajectory, epochs: int) -> dict[str, list[float | None]]:
    """Return the NEES of each block at times fixed beforehand, with those times.

    The times are the middles of `epochs` equal parts of the log, whatever the estimate. Each takes the pose of its part
    that is nearest (of two, the earlier) and has a covariance; so a smoother that keeps few covariances with hindsight
    has fewer times.

    Args:
        log: its truth must be one, and known.
        estimate: unaligned.
        epochs: how many times.

    Returns:
        "t_s" of the poses, from the start of the log, and a list per block of BLOCKS, None where there is no such pose
        or its truth is unknown; without the blocks that `nees` refuses, and empty where there is no covariance at all.
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
    """Return n places with these values in theirs; None for what is not there or NaN."""
    return [None if np.isnan(value := values.get(k, np.nan)) else value for k in range(n)]


def interval(dof: Array | NDArray[np.int64], probability: float) -> tuple[Array, Array]:
    """Return the central interval of chi-square over its degrees of freedom, (n,) and (n,)."""
    tail = 0.5 * (1.0 - probability)
    half = np.asarray(dof, float) / 2
    return gammaincinv(half, tail) / half, gammainccinv(half, tail) / half


def anees(values: Array, dof: int, t_s: Array) -> Average:
    """Average NEES over seeds, time by time.

    Args:
        values: (N, n) of N seeds at n times; NaN where a seed has none.
        dof: of one value.
        t_s: (n,) the times.
    """
    known = ~np.isnan(values)
    runs = known.sum(axis=0)
    there = runs > 0
    total = np.where(known, values, 0.0).sum(axis=0)[there]
    return _average(t_s[there], runs[there], dof * runs[there], total)


def anees_of(runs: Sequence[str | None]) -> dict[Block, Average]:
    """Average over seeds what `nees_at` returned, as the store has it (JSON); blocks that no run has are left out."""
    every: list[dict[str, list[float | None]]] = [of_run for run in runs if run and (of_run := json.loads(run))]
    usual = Counter(len(run["t_s"]) for run in every).most_common(1)
    every = [run for run in every if len(run["t_s"]) == usual[0][0]]  # a run that was asked for other times is left out
    found: dict[Block, Average] = {}
    for block in BLOCKS:
        of_block = [run for run in every if block in run]
        if of_block:
            values, times = (np.array([run[name] for run in of_block], float) for name in (block, "t_s"))
            first = [next((t for t in column if not np.isnan(t)), np.nan) for column in times.T]
            found[block] = anees(values, DOF[block], np.array(first))
    return {block: average for block, average in found.items() if len(average)}


def pooled_nis(runs: Sequence[Mapping[str, Any]]) -> dict[str, Average]:
    """Pool the NIS of each sensor over time and over runs, rows of the store; sensors that none has are left out."""
    total: dict[str, list[tuple[float, int]]] = {}
    for run in runs:
        for sensor, dof in json.loads(run["nis_dof"] or "{}").items():
            total.setdefault(sensor, []).append((run[f"nis_{sensor}"] * dof, dof))
    found = {}
    for sensor, each in total.items():
        sums, dofs = (np.array(column) for column in zip(*each, strict=True))
        found[sensor] = _average(np.array([np.nan]), np.array([len(each)]), dofs.sum()[None], sums.sum()[None])
    return found


def _average(t_s: Array, runs: NDArray[np.int64], dof: NDArray[np.int64], total: Array) -> Average:
    low, high = interval(dof, 1.0 - FALSE_ALARM / max(len(total), 1))
    return Average(t_s, runs, dof, total / dof, low, high)
