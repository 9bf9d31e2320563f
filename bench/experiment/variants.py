"""Grids: the variants of an entry of an experiment, over values of one or more fields.

grid: {lag_s: [1, 3, 10], gate.gps: [0.99, 0.999]}        six variants, "… lag_s=1 gate.gps=0.99" first
grid: {dvl: {velocity: [velocity], loose: [preintegrated-loose]}}       two, named "… velocity" and "… loose"
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from math import prod
from typing import Annotated, Any

from pydantic import BeforeValidator

MOST_POINTS = 10_000
"""Of one grid: each is an estimator or a log of its own, with its row in every table."""
LONGEST_WORDS = 500
"""Characters that a value may add to the label of its point."""


def named_axes(grid: Any) -> Any:
    """Return every axis of a grid as values by their words; a list of values has the words "path=value".

    Raises:
        ValueError: an axis without values, or one that has the same words twice or long ones; or too many points.
    """
    if not isinstance(grid, Mapping):
        raise ValueError(f"expected a mapping of fields to lists of values, found {grid!r:.60}")
    axes = {}
    for path, values in grid.items():
        if not isinstance(values, Mapping | list | tuple) or not values:
            raise ValueError(f"{path}: expected a list of values, or values by name, found {values!r:.60}")
        named = values.items() if isinstance(values, Mapping) else [(f"{path}={_text(v)}", v) for v in values]
        axes[str(path)] = {str(words): value for words, value in named}
        if len(axes[str(path)]) < len(values):
            raise ValueError(f"{path}: a value is there twice; found {values!r:.60}")
        if max(map(len, axes[str(path)])) > LONGEST_WORDS:
            raise ValueError(f"{path}: a value of more than {LONGEST_WORDS} characters; write {{name: value}} for each")
    count = prod(map(len, axes.values()))
    if count > MOST_POINTS:
        sizes = " · ".join(str(len(values)) for values in axes.values())
        raise ValueError(f"{sizes} = {count} points are more than {MOST_POINTS}; leave some values out")
    return axes


Grid = Annotated[dict[str, dict[str, Any]], BeforeValidator(named_axes)]
"""Values by their words, by dotted path of the field."""


def points(grid: Grid) -> list[tuple[str, dict[str, Any]]]:
    """Return every point of the cartesian product, the last axis fastest: its words, and each path's value.

    An empty grid is one point without words.
    """
    axes = [[(path, words, value) for words, value in axis.items()] for path, axis in grid.items()]
    return [
        (" ".join(words for _, words, _ in point), {path: value for path, _, value in point})
        for point in product(*axes)
    ]


def changed(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of nested values with the value at each dotted path replaced, or put there.

    Raises:
        ValueError: what is above a path's end is there and holds no fields.
    """
    copy = dict(values)
    for path, value in changes.items():
        copy = _with(copy, path.split("."), value, path)
    return copy


def _with(values: Mapping[str, Any], parts: list[str], value: Any, path: str) -> dict[str, Any]:
    first, *rest = parts
    if not rest:
        return {**values, first: value}
    below = values.get(first, {})
    if not isinstance(below, Mapping):
        raise ValueError(f"grid: {path}: {first!r} is {below!r:.60} here, and has no {'.'.join(rest)!r} to change")
    return {**values, first: _with(below, rest, value, path)}


def _text(value: Any) -> str:
    """Return a value as a label shows it."""
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else str(value)
    if isinstance(value, list | tuple):
        return "+".join(map(_text, value)) or "nothing"
    if isinstance(value, Mapping):
        return "+".join(f"{key}:{_text(item)}" for key, item in value.items()) or "nothing"
    return "none" if value is None else str(value)
