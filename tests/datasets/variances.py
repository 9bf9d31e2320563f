"""Whether samples scatter as they are said to."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2


def assert_variance(samples: np.ndarray, sigma: float | np.ndarray) -> None:
    """Zero-mean samples have this sigma, at 99.9 %."""
    low, high = chi2.interval(0.999, samples.size)
    assert low < np.sum((samples / sigma) ** 2) < high
