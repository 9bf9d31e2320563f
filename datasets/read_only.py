"""Make the arrays of a value read-only, so that whoever is handed it cannot change it for others by accident."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


def make_read_only(value: Any) -> None:
    """Make every array of a dataclass, and of the dataclasses in it, a read-only view of what it was.

    Whoever made the arrays can still write to those that he kept.
    """
    for field in fields(value):
        part = getattr(value, field.name)
        if isinstance(part, np.ndarray):
            if part.flags.writeable:
                object.__setattr__(value, field.name, read_only(part))
        elif is_dataclass(part) and not isinstance(part, type):
            make_read_only(part)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view
