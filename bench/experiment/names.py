"""Names alone in an experiment file: `estimators: [eskf]` for `estimators: [{name: eskf}]`, and likewise for others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator

from ...datasets.errors import nearest
from ...datasets.simulated.specs import MISSIONS
from ..metrics.floor_ratio import FLOORS
from ..metrics.scoring import COSTS, INNOVATIONS, SCORES

ASKED_FOR = dict.fromkeys(INNOVATIONS, "nis") | dict.fromkeys(FLOORS, "floor") | {"nis": "nis", "floor": "floor"}
"""Scores that are taken where they are asked for, by name, and the key that asks for them."""


def one_or_many(entry: Callable[[str], Any] = str) -> BeforeValidator:
    """Return a validator that takes a text alone for a list of it, and makes of each text in a list what it means."""

    def listed(value: Any) -> Any:
        many = [value] if isinstance(value, str | Mapping) else value
        return [entry(each) if isinstance(each, str) else each for each in many] if isinstance(many, list) else many

    return BeforeValidator(listed)


Names = Annotated[tuple[str, ...], one_or_many()]
"""One name, or a list of them."""


def estimator_entry(name: str) -> dict[str, str]:
    """Return the entry of an estimator with all its defaults."""
    return {"name": name}


def log_entry(name: str) -> dict[str, Any]:
    """Return the entry of a mission of the simulator with all its defaults, or of a recorded log."""
    return {"scenario": {"mission": name}} if name in MISSIONS else {"log": name}


def scoring_entry(value: Any) -> Any:
    """Return the keys of `scores` for a list of names and keys; whatever is no such list stays as it is.

    Raises:
        ValueError: no such score, or a key stands in two entries.
    """
    if not isinstance(value, str | list):
        return value
    found: dict[str, Any] = {}
    for each in [value] if isinstance(value, str) else value:
        keys = each if isinstance(each, Mapping) else _asked_for(each)
        twice = [key for key in keys if key in found and found[key] != keys[key]]
        if twice:
            raise ValueError(f"{twice[0]!r} is there twice")
        found |= keys
    return found


def _asked_for(name: Any) -> dict[str, bool]:
    """Return the key that asks for a score; none for a score that is always taken."""
    known = [*ASKED_FOR, *SCORES, *COSTS]
    if name not in known:
        hint = nearest(name, known) if isinstance(name, str) else ""
        raise ValueError(f"no score {name!r}{hint}; `fathom list scores` names them")
    return {ASKED_FOR[name]: True} if name in ASKED_FOR else {}
