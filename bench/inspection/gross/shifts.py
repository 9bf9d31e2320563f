"""By how much one signal on the grid lags another: the peak of their correlation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ....datasets.state import Array

LONGEST_S = 120.0
"""A longer lag is not searched: leap seconds are 18, and clocks set by hand are off by a minute or two."""
PEAK = 0.8
"""Least correlation at the lag: 64 % of the motion is then common to both."""
NEAR = 20
"""Steps around the coarse peak in which the exact one is sought."""
MATTERS_S = 2.0
"""Finer delays are left to the comparison of all clocks."""
BETTER = 0.3
"""What the lag must leave at most of the variance that differs without it."""


class Shift(NamedTuple):
    """The first signal is `late_s` later than the second, where their correlation is `peak`; it is `now` without."""

    late_s: float
    peak: float
    now: float

    @property
    def matters(self) -> bool:
        """Whether the lag is gross, explains most of the difference, and the two are alike with it."""
        return (
            abs(self.late_s) > MATTERS_S
            and self.peak > PEAK
            and 1 - self.peak**2 < BETTER * (1 - max(self.now, 0.0) ** 2)
        )


def shift_of(a: Array, b: Array, step_s: float) -> Shift:
    """Return by how much a (n,) lags b (n,), both at steps of step_s, at most LONGEST_S or a quarter of the log."""
    n = len(a)
    size = 1 << (2 * n - 1).bit_length()
    most = int(min(LONGEST_S / step_s, n / 4))
    a, b = a - a.mean(), b - b.mean()
    lags = np.arange(-most, most + 1)

    def summed(x: Array, y: Array) -> Array:
        """Return Σ x(t + lag) y(t), by lag."""
        spectrum = np.fft.rfft(x, size) * np.fft.rfft(y, size).conj()
        return np.fft.irfft(spectrum, size)[lags % size]

    one = np.ones(n)
    power = summed(a * a, one) * summed(one, b * b)  # of the rows that overlap
    c = summed(a, b) / np.sqrt(np.maximum(power, 1e-12 * power.max() + 1e-300))
    k = int(np.argmax(c))
    if k == most:
        return Shift(0.0, float(c[k]), float(c[k]))
    near = np.arange(max(k - NEAR, 0), min(k + NEAR + 1, len(c)))
    exact = np.array([_correlation(a, b, int(lags[i])) for i in near])  # each with the means of what overlaps
    best = int(np.argmax(exact))
    late = float(lags[near[best]])
    if 0 < best < len(exact) - 1:
        below, here, above = exact[best - 1 : best + 2]
        late += 0.5 * (above - below) / max(2 * here - above - below, 1e-12)
    return Shift(late * step_s, float(exact[best]), float(c[most]))


def _correlation(a: Array, b: Array, lag: int) -> float:
    """Return the correlation of a(t + lag) with b(t) where both are."""
    a, b = (a[lag:], b[: len(b) - lag]) if lag >= 0 else (a[:lag], b[-lag:])
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-300))
