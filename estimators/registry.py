"""Estimators by name; other people's packages join through the entry-point group `fathom.estimators`."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pydantic import ValidationError

from ..datasets.errors import FathomError, complaints, nearest, not_loaded
from .batch import BatchSmoother
from .dead_reckoning import DeadReckoning
from .filters.eskf import ErrorStateKalmanFilter
from .filters.eskf_filterpy import FilterpyKalmanFilter
from .filters.iekf import InvariantKalmanFilter
from .filters.rts import RauchTungStriebelSmoother
from .filters.ukf import UnscentedKalmanFilter
from .graph.smoothers import BatchFixedLagSmoother, FixedLagSmoother, WholeLogSmoother
from .interface import Estimator
from .window.smoother import WindowSmoother

ESTIMATORS: dict[str, Any] = {
    "dead-reckoning": DeadReckoning,
    "eskf": ErrorStateKalmanFilter,
    "eskf-filterpy": FilterpyKalmanFilter,
    "iekf": InvariantKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "rts": RauchTungStriebelSmoother,
    "fls": FixedLagSmoother,
    "fls-batch": BatchFixedLagSmoother,
    "isam2": WholeLogSmoother,
    "batch": BatchSmoother,
    "window": WindowSmoother,
}


class EstimatorError(FathomError):
    """No estimator of that name, or an option that it does not have or cannot take."""


def known_estimators() -> list[str]:
    """Return the names of our estimators and of those that installed packages bring."""
    return sorted(ESTIMATORS.keys() | _plugins().keys())


def load_estimator(name: str) -> Any:
    """Return the class of the estimator `name`, ours or an installed package's; ours win. Other packages stay unloaded.

    Raises:
        EstimatorError: unknown name (with the nearest known one), or its package cannot be loaded.
    """
    if name in ESTIMATORS:
        return ESTIMATORS[name]
    known = known_estimators()
    if name not in known:
        raise EstimatorError(f"no estimator {name!r}{nearest(name, known)} (known: {', '.join(known)})")
    point = _plugins()[name]
    try:
        return point.load()
    except Exception as error:  # importing another package's module may raise anything
        raise EstimatorError(f"{name}: {not_loaded(point, error)}") from error


def _plugins() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="fathom.estimators")}


def package_of(name: str) -> str | None:
    """Return the package and version that an estimator comes from; None for ours."""
    point = None if name in ESTIMATORS else _plugins().get(name)
    return None if point is None or point.dist is None else f"{point.dist.name} {point.dist.version}"


def create(name: str, /, **options: Any) -> Estimator:
    """Return the estimator `name`, configured.

    Args:
        name: one of `known_estimators()`.
        options: fields of its configuration; the rest keep their defaults.

    Raises:
        EstimatorError: as `load_estimator`; or unknown option (with the nearest known one), or a value that does not
            fit.
    """
    kind = load_estimator(name)
    fields = list(getattr(kind, "__dataclass_fields__", options))
    for key in options:
        if key not in fields:
            raise EstimatorError(f"{name}: no option {key!r}{nearest(key, fields)} (it has: {', '.join(fields)})")
    try:
        return kind(**options)
    except ValidationError as error:
        raise EstimatorError(f"{name}: {'; '.join(complaints(error, kind))}") from None
