"""The seabed under a mission: its depth, and its range along a beam."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from ..quantities import STRICT, NotNegative, Positive
from ..state import Array
from .specs import DEEPEST_M

STEEPEST = 0.2
"""Slope; up to it, `ranges` converges for every beam that points within 75° of straight down."""
ITERATIONS = 60
"""Of `ranges`, whose error falls at least by 0.75 in each (STEEPEST times tan 75°): 1e-7 of the first guess's."""
"""Of `ranges`, whose error falls at least by 0.75 in each (STEEPEST times tan 75°): 2e-8 of the first."""


@dataclass(frozen=True, config=STRICT)
class SeabedSpec:
    """Hills and hollows, relief_m high and relief_length_m from one to the next, about a depth below the surface."""

    depth_m: Annotated[Positive, Field(le=DEEPEST_M)] = 40.0
    relief_m: NotNegative = 0.0
    relief_length_m: Positive = 100.0

    @model_validator(mode="after")
    def _gentle(self) -> SeabedSpec:
        slope = 2 * math.pi * self.relief_m / self.relief_length_m
        if slope > STEEPEST:
            raise ValueError(
                f"relief_m {self.relief_m:g} over relief_length_m makes a slope of {slope:.2g} > {STEEPEST}"
            )
        return self

    def height_m(self, x_m: Array, y_m: Array) -> Array:
        """Return z of the seabed in W below each point."""
        k = 2 * math.pi / self.relief_length_m
        return self.relief_m * np.sin(k * x_m) * np.sin(k * y_m) - self.depth_m

    def ranges(self, p_W: Array, beams_W: Array) -> Array:
        """Return how far the seabed is from p_W (n, 3) along unit vectors beams_W (n, m, 3), (n, m) m; inf: never.

        The fixed point of r = (p_z − z(p + r d)) / (−d_z), which contracts while slope · tan(angle from down) < 1.
        """
        down = -beams_W[..., 2]
        reaches = down > math.cos(math.radians(75.0))
        down = np.where(reaches, down, 1.0)
        r = (p_W[:, 2:] + self.depth_m) / down
        for _ in range(ITERATIONS if self.relief_m else 0):
            x, y = (p_W[:, None, i] + r * beams_W[..., i] for i in (0, 1))
            r, before = (p_W[:, 2:] - self.height_m(x, y)) / down, r
            if np.abs(r - before)[reaches].max(initial=0.0) < 1e-6:
                break
        return np.where(reaches, r, np.inf)
