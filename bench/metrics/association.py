"""Association: which row of the estimate is compared with which row of the truth."""

from __future__ import annotations

import numpy as np

from ...datasets.errors import FathomError
from ...datasets.state import TimeArray
from ...datasets.trajectory import Trajectory


class ScoreError(FathomError):
    """A score is not defined for these trajectories; the message says why and what to do. Tables leave it out."""


def associate(truth: Trajectory, estimate: Trajectory, tolerance_ns: int = 0) -> tuple[Trajectory, Trajectory]:
    """Return the matching rows of both, equally many, each with its own times.

    Args:
        truth, estimate: any lengths.
        tolerance_ns: 0 pairs equal times only. Otherwise each row is paired with its nearest in time, provided it
            is in turn the nearest to that one, and no further than this; so no row is used twice. Of two equally
            near estimates, the later one is taken.

    Raises:
        ScoreError: nothing matches, or the tolerance is negative.
    """
    if tolerance_ns < 0:
        raise ScoreError(f"association: tolerance_ns must not be negative, found {tolerance_ns}")
    if np.array_equal(truth.t_ns, estimate.t_ns) and len(truth):
        return truth, estimate
    if tolerance_ns == 0:
        _, rows_true, rows_est = np.intersect1d(truth.t_ns, estimate.t_ns, assume_unique=True, return_indices=True)
    else:
        rows_true, rows_est = _mutual_nearest(truth.t_ns, estimate.t_ns, tolerance_ns)
    if len(rows_true) == 0:
        raise ScoreError(
            f"association: no truth within {tolerance_ns} ns of any estimate: truth has {_span(truth)}, estimate has "
            f"{_span(estimate)}; sample both at the same times, correct the clock offset, or allow a larger "
            "tolerance_ns"
        )
    return truth.select(rows_true), estimate.select(rows_est)


def _mutual_nearest(true_ns: TimeArray, est_ns: TimeArray, tolerance_ns: int) -> tuple[TimeArray, TimeArray]:
    """Return the rows (k,), (k,) that are nearest to each other and within the tolerance."""
    if not (len(true_ns) and len(est_ns)):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    to_est = _nearest(true_ns, est_ns, prefer_later=True)
    to_true = _nearest(est_ns, true_ns, prefer_later=False)
    rows = np.arange(len(true_ns))
    keep = (to_true[to_est] == rows) & (np.abs(est_ns[to_est] - true_ns) <= tolerance_ns)
    return rows[keep], to_est[keep]


def _nearest(of_ns: TimeArray, among_ns: TimeArray, *, prefer_later: bool) -> TimeArray:
    """Return, for each of `of_ns`, the row of `among_ns` that is nearest in time."""
    after = np.searchsorted(among_ns, of_ns).clip(0, len(among_ns) - 1)
    before = (after - 1).clip(0)
    wait, age = np.abs(among_ns[after] - of_ns), np.abs(of_ns - among_ns[before])
    return np.where(wait <= age if prefer_later else wait < age, after, before)


def _span(trajectory: Trajectory) -> str:
    """Say how many rows a trajectory has, and from when to when."""
    if not len(trajectory):
        return "no rows"
    return f"{len(trajectory)} rows from {trajectory.t_ns[0]} to {trajectory.t_ns[-1]} ns"
