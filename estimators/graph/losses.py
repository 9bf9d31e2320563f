"""Robust losses on GTSAM's factors."""

from __future__ import annotations

from functools import cache
from typing import Any

import gtsam
import numpy as np

from ...datasets.state import Array
from ..robust import Loss, width
from ..stages import stage, staged

M_ESTIMATORS: dict[Loss, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
}


@cache
def m_estimator(loss: Loss, n: int) -> Any:
    """Return GTSAM's loss for n rows; its `weight(d)` is w(d)."""
    return M_ESTIMATORS[loss].Create(width(loss, n))


def rows(factor: Any) -> int:
    """Return how many rows of a factor measure something: those of a finite sigma."""
    return int(np.isfinite(factor.noiseModel().sigmas()).sum())


@stage("linearisation")
def with_loss(factor: Any, loss: Loss) -> Any:
    """Return a factor of Gaussian noise under a loss. A CustomFactor cannot be cloned: it is called, and whitens."""
    estimator, model = m_estimator(loss, rows(factor)), gtsam.noiseModel.Unit.Create(factor.dim())
    if not isinstance(factor, gtsam.CustomFactor):
        return factor.cloneWithNewNoiseModel(gtsam.noiseModel.Robust.Create(estimator, factor.noiseModel()))
    ends = np.cumsum([3 if gtsam.Symbol(key).chr() == ord("v") else 6 for key in factor.keys()])  # noqa: SIM118

    def callback(_: Any, values: gtsam.Values, jacobians: Any) -> Array:
        if jacobians is None:
            return factor.whitenedError(values)
        A, b = factor.linearize(values).jacobian()
        for k, H in enumerate(np.split(A, ends[:-1], axis=1)):
            jacobians[k] = H
        return -b

    return gtsam.CustomFactor(
        gtsam.noiseModel.Robust.Create(estimator, model), factor.keys(), staged("linearisation", callback)
    )


def distance(factor: Any, values: gtsam.Values) -> float:
    """Return the length of a factor's whitened residual, without the loss's weight."""
    return float(np.linalg.norm(factor.noiseModel().unweightedWhiten(factor.unwhitenedError(values))))
