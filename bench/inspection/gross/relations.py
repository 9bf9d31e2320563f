"""The gyro against what tilts and what turns, linear in the signs and the order of its axes.

Specific force turns against the gyro, df = −(Q dθ) × f, and the change of a heading is up · Q dθ. Q (3, 3) is 1 in a
right log. If the accelerometer must be turned or mirrored by A, and the gyro by G, Q is det(A) Aᵀ G in the former and
Aᵀ G in the latter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....datasets.state import Array
from ..findings.fitting import Estimate, Mask
from .sketch import Sketch

TURN_S = 3.0
"""Changes of heading are taken over this: long enough for a turn to stand out of a compass's noise."""
ROWS = 50.0
"""Rows that the evidence counts as at most: neighbouring errors are alike."""


@dataclass(frozen=True, eq=False)
class Relation:
    """Sums of one kind of rows y = X q, q the nine numbers of Q by rows: X'X, X'y, y'y, and how many rows."""

    XX: Array
    Xy: Array
    yy: float
    n: int

    def correlation(self, Q: Array) -> float:
        """Return the correlation of what Q (3, 3) predicts with what is measured."""
        q = Q.ravel()
        return float(q @ self.Xy) / np.sqrt(max(float(q @ self.XX @ q), 1e-300) * max(self.yy, 1e-300))

    def slope(self, Q: Array) -> Estimate:
        """Return the factor that Q (3, 3) needs; its sigma counts at most ROWS independent rows."""
        q, c = Q.ravel(), self.correlation(Q)
        value = float(q @ self.Xy) / max(float(q @ self.XX @ q), 1e-300)
        return Estimate(value, abs(value) * np.sqrt(max(1 / max(c * c, 1e-12) - 1, 0) / min(self.n, ROWS)))


def _relation(X: Array, y: Array) -> Relation:
    """Return the sums of rows X (n, 9), y (n,), each less its mean: a gyro's bias and a slow drift are in the means."""
    X, y = X - X.mean(axis=0), y - y.mean()
    return Relation(X.T @ X, X.T @ y, float(y @ y), len(y))


def tilting(sketch: Sketch) -> Relation:
    """Return how the specific force turns, by the gyro."""
    f = (sketch.f_I[1:] + sketch.f_I[:-1]) / 2
    turn = np.diff(sketch.turned_I, axis=0)
    zero = np.zeros(len(f))
    against = np.stack([zero, -f[:, 2], f[:, 1], f[:, 2], zero, -f[:, 0], -f[:, 1], f[:, 0], zero], axis=1)
    X = against.reshape(-1, 3, 3)[:, :, :, None] * turn[:, None, None, :]  # (f × Q dθ) = [f]× Q dθ
    X -= X.mean(axis=0)
    y = np.diff(sketch.f_I, axis=0)
    y -= y.mean(axis=0)
    flat = X.reshape(-1, 9)
    return Relation(flat.T @ flat, flat.T @ y.ravel(), float(np.sum(y * y)), len(y))


def turning(sketch: Sketch, t_s: Array, psi: Array, heard: Mask) -> Relation | None:
    """Return how a yaw psi (m,) rad at t_s (m,) turns, by the gyro; None if they share too little."""
    lag = max(round(TURN_S / sketch.step_s), 1)
    steps = np.diff(sketch.turned_I, axis=0)
    up = (sketch.up_I[1:] + sketch.up_I[:-1]) / 2
    summed = np.vstack([np.zeros((1, 9)), np.cumsum((up[:, :, None] * steps[:, None, :]).reshape(-1, 9), axis=0)])
    yaw = sketch.on_grid(t_s, psi)
    rows = np.arange(0, len(yaw) - lag, lag)
    rows = rows[heard[rows] & heard[rows + lag]]
    if len(rows) < 10:
        return None
    return _relation(summed[rows + lag] - summed[rows], yaw[rows + lag] - yaw[rows])


def likelihood(relation: Relation | None, Q: Array) -> float:
    """Return the log likelihood of Q (3, 3) with its best positive scale, over that of no relation."""
    if relation is None or relation.n < 10:
        return 0.0
    c = max(relation.correlation(Q), 0.0)
    return -0.5 * min(relation.n, ROWS) * float(np.log(max(1 - c * c, 1e-6)))
