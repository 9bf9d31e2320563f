"""Robust losses: a reading that lies far out pulls less, or not at all.

A loss ρ(d) of the whitened residual's length d replaces ½ d²; GTSAM solves by weights w(d) = ρ'(d) / d, taken where a
factor is linearised:

    huber   1 to d = k, then k/d            cauchy  1/(1 + (d/k)²)          tukey   (1 − (d/k)²)² to d = k, then 0

The widths k are those of 95 % efficiency on one normal row: Holland & Welsch 1977, doi:10.1080/03610927708827533, and
Zhang 1997, doi:10.1016/S0262-8856(96)01112-2, table 1. A residual of n rows gets the width that a normal one exceeds as
often, P(χ²_n > k_n²) = P(χ²_1 > k_1²): the same reading is as suspect, however many rows it has.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

import gtsam
import numpy as np

from ..datasets.state import Array
from .interface import FACTORS, sensors_among

Loss = Literal["huber", "cauchy", "tukey"]
WIDTHS: dict[Loss, float] = {"huber": 1.345, "cauchy": 2.3849, "tukey": 4.6851}
"""Sigmas, for one row."""
M_ESTIMATORS: dict[Loss, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
}


Losses = Annotated[dict[str, Loss], sensors_among(FACTORS)]
"""Loss by sensor; a sensor that is not named has none."""


@cache
def width(loss: Loss, n: int) -> float:
    """Return the width of a loss for n rows, in sigmas."""
    from scipy.stats import chi2  # slow to import, and only losses need it

    return float(np.sqrt(chi2.isf(chi2.sf(WIDTHS[loss] ** 2, 1), n)))


@cache
def m_estimator(loss: Loss, n: int) -> Any:
    """Return GTSAM's loss for n rows; its `weight(d)` is w(d)."""
    return M_ESTIMATORS[loss].Create(width(loss, n))


def rows(factor: Any) -> int:
    """Return how many rows of a factor measure something: those of a finite sigma."""
    return int(np.isfinite(factor.noiseModel().sigmas()).sum())


def with_loss(factor: Any, loss: Loss) -> Any:
    """Return a factor of Gaussian noise under a loss. A CustomFactor cannot be cloned: it is called, and whitens."""
    estimator, model = m_estimator(loss, rows(factor)), gtsam.noiseModel.Unit.Create(factor.dim())
    if not isinstance(factor, gtsam.CustomFactor):
        return factor.cloneWithNewNoiseModel(gtsam.noiseModel.Robust.Create(estimator, factor.noiseModel()))
    ends = np.cumsum([3 if gtsam.Symbol(key).chr() == ord("v") else 6 for key in factor.keys()])  # noqa: SIM118

    def error(_: Any, values: gtsam.Values, jacobians: Any) -> Array:
        if jacobians is None:
            return factor.whitenedError(values)
        A, b = factor.linearize(values).jacobian()
        for k, H in enumerate(np.split(A, ends[:-1], axis=1)):
            jacobians[k] = H
        return -b

    return gtsam.CustomFactor(gtsam.noiseModel.Robust.Create(estimator, model), factor.keys(), error)


def distance(factor: Any, values: gtsam.Values) -> float:
    """Return the length of a factor's whitened residual, without the loss's weight."""
    return float(np.linalg.norm(factor.noiseModel().unweightedWhiten(factor.unwhitenedError(values))))
