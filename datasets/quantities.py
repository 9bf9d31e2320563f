"""Numbers as configs state them: validated, and in the units of their names."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import ConfigDict, Field

DEGREE = math.pi / 180
"""rad."""

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[Finite, Finite, Finite]

STRICT = ConfigDict(extra="forbid")
