"""Numbers as configs state them: validated, and in the units of their names."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field

from .places import MOST_LATITUDE_DEG, MOST_LONGITUDE_DEG

DEGREE = math.pi / 180
"""rad."""


def _no_truth(value: Any) -> Any:
    """Refuse true and false, which would else count as 1 and 0."""
    if isinstance(value, bool):
        raise ValueError(f"expected a number, found {value} (YAML takes yes, no, on and off for true and false)")
    return value


if TYPE_CHECKING:
    Number = float
    Whole = int
else:
    Number = Annotated[float, BeforeValidator(_no_truth)]
    Whole = Annotated[int, BeforeValidator(_no_truth)]

Finite = Annotated[Number, Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[Number, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[Number, Field(ge=0, le=1)]
Latitude = Annotated[Number, Field(ge=-MOST_LATITUDE_DEG, le=MOST_LATITUDE_DEG)]
Longitude = Annotated[Number, Field(ge=-MOST_LONGITUDE_DEG, le=MOST_LONGITUDE_DEG)]
Vector = tuple[Finite, Finite, Finite]

STRICT = ConfigDict(extra="forbid")
