"""What counts as a place on Earth, wherever one is given: in a file, a config or a rig."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

MOST_LATITUDE_DEG, MOST_LONGITUDE_DEG = 90.0, 360.0
"""The poles; charts count longitudes from −180° to 180° or from 0° to 360°, some of them westwards."""


def is_place(latitude_deg: ArrayLike, longitude_deg: ArrayLike = 0.0) -> NDArray[np.bool_]:
    """Return where a latitude and a longitude, degrees, are a place on Earth; what is not finite is none."""
    with np.errstate(invalid="ignore"):
        north, east = np.abs(latitude_deg), np.abs(longitude_deg)
        return np.asarray((north <= MOST_LATITUDE_DEG) & (east <= MOST_LONGITUDE_DEG))
