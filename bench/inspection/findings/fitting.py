"""Least squares with an uncertainty taken from the data, valid under unknown correlation of the residuals.

A log is cut into `BLOCKS` blocks. The spread of the estimates with one block left out gives the covariance (the
delete-one-block jackknife), under arbitrary correlation inside a block. Because the blocks are few, intervals use
Student's t.
Source: Cameron & Miller 2015, A practitioner's guide to cluster-robust inference, section VI (CR3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from ....datasets.state import Array

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal noise over its median absolute deviation: 1 / Φ⁻¹(3/4)."""
BLOCKS = 12
"""Enough for 11 degrees of freedom, few enough that errors of one block hardly reach into the next."""
FALSE_ALARM = 1e-3
"""How often one estimate may seem to differ by chance."""
FEWEST_BLOCKS = 4
"""With data in fewer blocks the t quantile is over 31, and no estimate would say anything."""
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Plane = NDArray[np.complexfloating[Any, Any]]
"""Vectors in the horizontal plane: east + i north, or forward + i left."""
Values = TypeVar("Values", Array, Plane)


SMALLEST_SIGMA = 1e-6
"""Six decimals are shown at most, so a smaller sigma would be shown as zero."""


@dataclass(frozen=True)
class Estimate:
    """A number, its standard deviation, and how many degrees of freedom that has."""

    value: float
    sigma: float
    dof: int = BLOCKS - 1

    @property
    def reach(self) -> float:
        """Half width of the interval that holds the truth with probability 1 − `FALSE_ALARM`."""
        return float(student.isf(FALSE_ALARM / 2, max(self.dof, 1)) * self.sigma)

    def differs(self, nominal: float, at_least: float) -> bool:
        """Whether it differs from `nominal` by more than chance, and by more than `at_least`."""
        return abs(self.value - nominal) > max(self.reach, at_least)

    def known_to(self, size: float) -> bool:
        """Whether three sigmas are within `size`."""
        return bool(np.isfinite(self.sigma) and 3 * self.sigma < size)

    def times(self, factor: float) -> Estimate:
        """Return the estimate in another unit."""
        return Estimate(self.value * factor, self.sigma * abs(factor), self.dof)

    def text(self, unit: str = "") -> str:
        """Return "value ± sigma unit", with two digits of sigma; below 1e-6 in powers of ten."""
        if not np.isfinite(self.sigma):
            return "not observable"
        if 0 < self.sigma < SMALLEST_SIGMA:
            return f"{self.value:.1e} ± {self.sigma:.1e}{' ' * bool(unit)}{unit}"
        digits = 3 if self.sigma <= 0 else int(np.clip(1 - np.floor(np.log10(self.sigma)), 0, 6))
        value = round(self.value, digits) + 0.0  # -0.0 becomes 0.0
        return f"{value:.{digits}f} ± {self.sigma:.{digits}f}{' ' * bool(unit)}{unit}"

    def text_if(self, size: float, unit: str = "") -> str:
        """Return `text`, or "not observable here" if it is not known to `size`."""
        if self.known_to(size):
            return self.text(unit)
        return f"not observable here (sigma {self.sigma:.2g}{' ' * bool(unit)}{unit})"


@dataclass(frozen=True, eq=False)
class Fit:
    """Coefficients by name, their covariance, and the residuals.

    Attributes:
        names: of the k coefficients.
        value, cov: (k,) and (k, k).
        dof: blocks that held data, less one.
        residual: (n,), of every row.
        kept: (n,) rows that were not outliers.
    """

    names: tuple[str, ...]
    value: Array
    cov: Array
    dof: int
    residual: Array
    kept: Mask

    def __getitem__(self, name: str) -> Estimate:
        k = self.names.index(name)
        return Estimate(float(self.value[k]), float(np.sqrt(self.cov[k, k])), self.dof)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of the rows kept."""
        return float(np.sqrt(np.mean(self.residual[self.kept] ** 2)))


def least_squares(columns: dict[str, Array], y: Array, block: Index) -> Fit | None:
    """Fit y (n,) by the columns (n,), three times; after each fit rows beyond six robust sigmas are left out.

    Args:
        columns: by the name of their coefficient.
        y: (n,).
        block: (n,) the block that a row belongs to, from 0.

    Returns:
        None if fewer than `FEWEST_BLOCKS` blocks hold data, if a value is not finite, or if there are no columns.
    """
    if not columns:
        return None
    X = np.stack(list(columns.values()), axis=1)
    if not (np.isfinite(X).all() and np.isfinite(y).all()):
        return None
    kept = np.ones(len(y), bool)
    count = np.zeros(0)
    beta, cov, residual = np.zeros(X.shape[1]), np.zeros((X.shape[1],) * 2), y
    for _ in range(3):
        count = np.bincount(block[kept])
        if np.count_nonzero(count) < FEWEST_BLOCKS or kept.sum() <= 2 * X.shape[1]:
            return None
        beta, cov = _jackknife(X[kept], y[kept], block[kept])
        residual = y - X @ beta
        kept = np.abs(residual) <= 6 * MAD_TO_SIGMA * np.median(np.abs(residual)) + 1e-12
    return Fit(tuple(columns), beta, cov, int(np.count_nonzero(count)) - 1, residual, kept)


def _jackknife(X: Array, y: Array, block: Index) -> tuple[Array, Array]:
    """Return coefficients and covariance; each variance is at least that of white noise of the residual's size."""
    size = np.sqrt((X**2).sum(axis=0))
    empty = size == 0
    size[empty] = 1.0
    X = X / size
    order = np.argsort(block, kind="stable")
    edges = np.flatnonzero(np.diff(block[order])) + 1
    parts = np.split(order, edges)
    normal = np.array([X[rows].T @ X[rows] for rows in parts])
    right = np.array([X[rows].T @ y[rows] for rows in parts])
    ridge = 1e-10 * np.eye(X.shape[1])
    whole = normal.sum(axis=0) + ridge
    beta = np.linalg.solve(whole, right.sum(axis=0))
    without = np.linalg.solve(whole - normal, (right.sum(axis=0) - right)[..., None])[..., 0]
    spread = without - beta
    cov = (len(parts) - 1) / len(parts) * spread.T @ spread
    white = np.sum((y - X @ beta) ** 2) / (len(y) - len(beta)) * np.linalg.inv(whole)
    least, found = np.diag(white), np.diag(cov)
    grow = np.sqrt(np.maximum(least / np.maximum(found, 1e-12 * least + 1e-300), 1.0))
    cov = cov * np.outer(grow, grow) / np.outer(size, size)
    np.fill_diagonal(cov, np.where(empty, np.inf, np.maximum(found, least) / size**2))
    return beta / size, cov


def mean_of(y: Array, block: Index) -> Estimate | None:
    """Return the mean of y (n,), with its sigma from the blocks."""
    fit = least_squares({"mean": np.ones(len(y))}, y, block)
    return None if fit is None else fit["mean"]


def blocks_of(count: int) -> Index:
    """Return the block of each of `count` rows: blocks of equally many rows."""
    return np.arange(count) * BLOCKS // max(count, 1)


def windows_of(t_s: Array, length_s: float, gap_s: float) -> Index:
    """Return the window (n,) of each row: windows of about `length_s`, numbered in order, none across a gap."""
    if not len(t_s):
        return np.zeros(0, np.intp)
    piece = np.cumsum(np.diff(t_s, prepend=t_s[0]) > gap_s)
    begins = t_s[np.searchsorted(piece, np.arange(piece[-1] + 1))]
    since = np.floor((t_s - begins[piece]) / length_s).astype(np.intp)
    return np.cumsum((np.diff(piece, prepend=piece[0]) > 0) | (np.diff(since, prepend=since[0]) != 0))


def blocks_of_windows(window: Index) -> Index:
    """Return the block of each row: blocks made of whole windows, of about equally many rows."""
    first = np.searchsorted(window, np.arange(window[-1] + 1 if len(window) else 0))
    return blocks_of(len(window))[first][window]


def without_trend(values: Values, t_s: Array, window: Index, degree: int) -> Values:
    """Return values (n, …) less the best polynomial of time in each window; a window with too few rows gives zeros."""
    out = np.zeros_like(values)
    edges = np.flatnonzero(np.diff(window)) + 1
    for rows in np.split(np.arange(len(t_s)), edges):
        if len(rows) <= degree + 2:
            continue
        x = t_s[rows] - t_s[rows].mean()
        Q = np.linalg.qr(np.vander(x / max(np.abs(x).max(), 1e-9), degree + 1))[0]
        flat = values[rows].reshape(len(rows), -1)
        out[rows] = (flat - Q @ (Q.T @ flat)).reshape(values[rows].shape)
    return out


def stacked(z: Plane) -> Array:
    """Return the real parts (n,) and under them the imaginary ones: (2 n,)."""
    return np.asarray(np.concatenate([z.real, z.imag]), dtype=np.float64)
