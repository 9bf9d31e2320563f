"""Numbers as configs state them: validated, and in the units of their names."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field

from .places import MOST_LATITUDE_DEG, MOST_LONGITUDE_DEG, degrees_said

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
Latitude = Annotated[
    Number, Field(ge=-MOST_LATITUDE_DEG, le=MOST_LATITUDE_DEG), BeforeValidator(partial(degrees_said, hemispheres="NS"))
]
"""°, north positive; or a text such as 41°11'06" N."""
Longitude = Annotated[
    Number,
    Field(ge=-MOST_LONGITUDE_DEG, le=MOST_LONGITUDE_DEG),
    BeforeValidator(partial(degrees_said, hemispheres="EW")),
]
"""°, east positive; or a text such as 8 42.36 W."""
Vector = tuple[Finite, Finite, Finite]

STRICT = ConfigDict(extra="forbid")
