"""Estimators by name; other people's packages join through the entry-point group `fathom.estimators`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import is_pydantic_dataclass
from pydantic.errors import PydanticUserError

from ..datasets.errors import LOAD_S, FathomError, complaints, given_up_after, load, nearest, not_loaded, one_line
from .batch import BatchSmoother
from .contract import PAGE, check_estimator
from .dead_reckoning import DeadReckoning
from .filters.eskf import ErrorStateKalmanFilter
from .filters.eskf_filterpy import FilterpyKalmanFilter
from .filters.iekf import InvariantKalmanFilter
from .filters.rts import RauchTungStriebelSmoother
from .filters.ukf import UnscentedKalmanFilter
from .graph.smoothers import BatchFixedLagSmoother, FixedLagSmoother, WholeLogSmoother
from .interface import Estimator
from .other_code import process_kept
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


GROUP = "fathom.estimators"
"""The group of entry points that other packages' estimators join by."""


class EstimatorError(FathomError):
    """No estimator of that name, or not one alone; an option that it does not have or cannot take; not an estimator."""


def known_estimators() -> list[str]:
    """Return the names of our estimators and of those that installed packages bring."""
    return sorted(ESTIMATORS.keys() | _plugins().keys())


def is_ours(estimator: object) -> bool:
    """Return whether an estimator is one of this package, and not somebody else's, or a subclass by somebody else."""
    return type(estimator) in ESTIMATORS.values()


def load_estimator(name: str) -> Any:
    """Return the class of the estimator `name`, ours or an installed package's. Other packages stay unloaded.

    Raises:
        EstimatorError: unknown name (with the nearest known one), a name that several packages use, or a package that
            cannot be loaded.
    """
    known = known_estimators()
    if name not in known:
        raise EstimatorError(f"no estimator {name!r}{nearest(name, known)} (known: {', '.join(known)})")
    makers = ["fathom"] * (name in ESTIMATORS) + sorted(map(_package, _points(tuple(sys.path)).select(name=name)))
    if len(makers) > 1:
        raise EstimatorError(
            f"{name}: several packages bring an estimator of this name ({', '.join(makers)}); rename or uninstall one"
        )
    if name in ESTIMATORS:
        return ESTIMATORS[name]
    point = _plugins()[name]
    try:
        with process_kept():
            return load(point)
    except (Exception, SystemExit) as error:  # importing another package's module may raise anything, or exit
        raise EstimatorError(f"{name}: {not_loaded(point, error)}") from error


def _plugins() -> dict[str, EntryPoint]:
    return {point.name: point for point in _points(tuple(sys.path))}


@cache
def _points(path: tuple[str, ...]) -> EntryPoints:
    """Return the entry points of what is installed on a search path: reading them costs as much as a short run."""
    return entry_points(group=GROUP)


def _package(point: EntryPoint) -> str:
    return point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"


def package_of(name: str) -> str | None:
    """Return the package and version that an estimator comes from; None for ours."""
    point = None if name in ESTIMATORS else _plugins().get(name)
    return None if point is None or point.dist is None else _package(point)


def create(name: str, /, **options: Any) -> Estimator:
    """Return the estimator `name`, configured.

    Args:
        name: one of `known_estimators()`.
        options: fields of its configuration; the rest keep their defaults.

    Raises:
        EstimatorError: as `load_estimator`; or unknown option (with the nearest known one), a value that does not fit,
            or, of another package, not what an estimator must be.
    """
    kind = load_estimator(name)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        raise EstimatorError(f"{name}: {kind!r:.60} is not a dataclass, whose fields are the options; {PAGE}")
    fields = list(kind.__dataclass_fields__)
    for key in options:
        if key not in fields:
            raise EstimatorError(f"{name}: no option {key!r}{nearest(key, fields)} (it has: {', '.join(fields)})")
    try:
        return ESTIMATORS[name](**options) if name in ESTIMATORS else _of_other_package(kind, options)
    except ValidationError as error:
        raise EstimatorError(f"{name}: {'; '.join(complaints(error, kind))}") from None
    except (Exception, SystemExit) as error:  # another package's class may raise anything, or exit
        raise EstimatorError(f"{name}: {one_line(error)}") from error


def _of_other_package(kind: type, options: Mapping[str, Any]) -> Estimator:
    """Return a configured estimator of a package that is not ours, if it has the interface.

    Raises:
        Exception: anything.
    """
    with process_kept(), given_up_after(LOAD_S):
        estimator = kind(**_converted(kind, options))
        check_estimator(estimator)
        return estimator


def _converted(kind: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options as the types of a plain dataclass want them; pydantic's dataclass converts by itself."""
    if is_pydantic_dataclass(kind):
        return dict(options)
    return {key: _fitting(kind, key, value) for key, value in options.items()}


def _fitting(kind: type, key: str, value: Any) -> Any:
    """Return a value of an option as its type wants it; unchanged where pydantic does not know the type."""
    try:
        adapter: TypeAdapter[Any] = TypeAdapter(get_type_hints(kind, include_extras=True)[key])
    except (PydanticUserError, NameError, TypeError, KeyError):
        return value
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        raise TypeError(f"option {key!r}: {error.errors()[0]['msg']}, found {value!r:.60}") from None
