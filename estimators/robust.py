"""Robust losses: an outlier gets less weight, or none.

A loss ρ(d) of the whitened residual's length d replaces ½ d²; smoothers solve by weights w(d) = ρ'(d) / d, taken
where a factor is linearised:

    huber   1 to d = k, then k/d            cauchy  1/(1 + (d/k)²)          tukey   (1 − (d/k)²)² to d = k, then 0

The widths k are those of 95 % efficiency on one normal row: Holland & Welsch 1977, doi:10.1080/03610927708827533, and
Zhang 1997, doi:10.1016/S0262-8856(96)01112-2, table 1. A residual of n rows gets the width that a normal one exceeds as
often, P(χ²_n > k_n²) = P(χ²_1 > k_1²): the number of rows does not matter.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal

import numpy as np

from ..datasets.compiling.decorators import compiled
from .interface import FACTORS, sensors_among

Loss = Literal["huber", "cauchy", "tukey"]
WIDTHS: dict[Loss, float] = {"huber": 1.345, "cauchy": 2.3849, "tukey": 4.6851}
"""Sigmas, for one row."""
LOSSES: tuple[str, ...] = ("", "huber", "cauchy", "tukey")
"""Losses by number, for compiled code; 0 means no loss."""
Losses = Annotated[dict[str, Loss], sensors_among(FACTORS)]
"""Loss by sensor; a sensor that is not named has none."""


@cache
def width(loss: Loss, n: int) -> float:
    """Return the width of a loss for n rows, in sigmas."""
    from scipy.stats import chi2  # slow to import, and only losses need it

    return float(np.sqrt(chi2.isf(chi2.sf(WIDTHS[loss] ** 2, 1), n)))


@compiled
def weight_of(loss: int, d: float, width: float) -> float:
    """w(d), of the loss by its place in LOSSES."""
    if loss == 1:
        return 1.0 if d <= width else width / d
    if loss == 2:
        return 1.0 / (1.0 + (d / width) ** 2)
    if loss == 3:
        return (1.0 - (d / width) ** 2) ** 2 if d <= width else 0.0
    return 1.0
