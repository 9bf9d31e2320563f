"""Check that somebody else's estimator has the interface, before it is run; ours are checked by types and tests."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import signature
from typing import Any

from pydantic import TypeAdapter, ValidationError

from .interface import Factors, Inflation

PAGE = "docs/your-own-estimator.md has the interface"

ATTRIBUTES: dict[str, TypeAdapter[Any]] = {"factors": TypeAdapter(Factors), "inflate": TypeAdapter(Inflation)}


def check_estimator(estimator: Any) -> frozenset[str]:
    """Return the sensors that a configuration may use, after a look at its `begin`, `factors` and, if any, `inflate`.

    Raises:
        TypeError: in a sentence, what is missing or does not fit.
    """
    kind = type(estimator).__name__
    _check_method(estimator, kind, "begin", "prior", "rig")
    if not hasattr(estimator, "factors"):
        raise TypeError(f"{kind} has no `factors`, the sensors that it is given; {PAGE}")
    for name, adapter in ATTRIBUTES.items():
        try:
            adapter.validate_python(getattr(estimator, name, {}))
        except ValidationError as error:
            raise TypeError(f"{kind}.{name}: {error.errors()[0]['msg']}; {PAGE}") from None
    return frozenset(estimator.factors)


def check_pass(run: Any, estimator: Any) -> None:
    """Look at the methods and the counts of a pass, as `begin` of an estimator returned it.

    Raises:
        TypeError: in a sentence, what is missing or does not fit.
    """
    kind = f"{type(run).__name__} (from {type(estimator).__name__}.begin)"
    _check_method(run, kind, "step", "epoch")
    _check_method(run, kind, "belief")
    _check_method(run, kind, "finish")
    checked_counts(run, kind)


def checked_counts(run: Any, kind: str) -> dict[str, int]:
    """Return the counts of a pass.

    Raises:
        TypeError: there are none, or they are not numbers by name.
    """
    counts = getattr(run, "counts", None)
    fits = isinstance(counts, Mapping) and all(
        isinstance(name, str) and hasattr(n, "__index__") for name, n in counts.items()
    )
    if not fits:
        found = "it has none" if counts is None else f"found {counts!r:.60}"
        raise TypeError(
            f"{kind}: `counts` must be a dict of whole numbers by name, which may be empty; {found}; {PAGE}"
        )
    return {name: int(n) for name, n in dict(counts or {}).items()}


def _check_method(thing: Any, kind: str, name: str, *arguments: str) -> None:
    call, method = f"{name}({', '.join(arguments)})", getattr(thing, name, None)
    if not callable(method):
        raise TypeError(f"{kind} has no method {call}; {PAGE}")
    try:
        signature(method).bind(*arguments)
    except ValueError:  # of compiled code, which does not say
        return
    except TypeError:
        raise TypeError(f"{kind}.{name}{signature(method)} cannot be called as {call}; {PAGE}") from None
