"""The measurement physics, once; then one module per estimator."""

from .compiled_cache import use_compiled_folder

use_compiled_folder()  # before anything is compiled or loaded

from .interface import FACTORS, Diverged, Estimator, Pass  # noqa: E402
from .registry import ESTIMATORS, create  # noqa: E402

__all__ = ["ESTIMATORS", "FACTORS", "Diverged", "Estimator", "Pass", "create"]
