"""The measurement physics, once; then one module per estimator."""

from .interface import FACTORS, Diverged, Estimator, Pass
from .registry import ESTIMATORS, create

__all__ = ["ESTIMATORS", "FACTORS", "Diverged", "Estimator", "Pass", "create"]
