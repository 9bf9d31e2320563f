"""Estimators by name; other people's packages join through the entry-point group `fathom.estimators`."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from pydantic import ValidationError

from ..datasets.errors import nearest
from .dead_reckoning import DeadReckoning
from .eskf import ErrorStateKalmanFilter
from .eskf_filterpy import FilterpyKalmanFilter
from .iekf import InvariantKalmanFilter
from .interface import Estimator
from .rts import RauchTungStriebelSmoother
from .smoothers import BatchSmoother, FixedLagSmoother, WholeLogSmoother
from .ukf import UnscentedKalmanFilter

ESTIMATORS: dict[str, Any] = {
    "dead-reckoning": DeadReckoning,
    "eskf": ErrorStateKalmanFilter,
    "eskf-filterpy": FilterpyKalmanFilter,
    "iekf": InvariantKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "rts": RauchTungStriebelSmoother,
    "fls": FixedLagSmoother,
    "isam2": WholeLogSmoother,
    "batch": BatchSmoother,
}


class EstimatorError(ValueError):
    """No estimator of that name, or an option that it does not have or cannot take."""


def known_estimators() -> dict[str, Any]:
    """Return our estimators and those that installed packages bring, by name; ours win."""
    return {point.name: point.load() for point in entry_points(group="fathom.estimators")} | ESTIMATORS


def create(name: str, **options: Any) -> Estimator:
    """Return the estimator `name`, configured.

    Args:
        name: a key of `known_estimators()`.
        options: fields of its configuration; the rest keep their defaults.

    Raises:
        EstimatorError: unknown name or option (with the nearest known one), or a value that does not fit.
    """
    known = ESTIMATORS if name in ESTIMATORS else known_estimators()
    if name not in known:
        raise EstimatorError(f"no estimator {name!r}{nearest(name, known)} (known: {', '.join(sorted(known))})")
    kind = known[name]
    fields = list(getattr(kind, "__dataclass_fields__", options))
    for key in options:
        if key not in fields:
            raise EstimatorError(f"{name}: no option {key!r}{nearest(key, fields)} (it has: {', '.join(fields)})")
    try:
        return kind(**options)
    except ValidationError as error:
        what = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}, found {e['input']!r}" for e in error.errors())
        raise EstimatorError(f"{name}: {what}") from None
