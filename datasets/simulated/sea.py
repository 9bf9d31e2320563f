"""The sea's surface: waves and tide, which move a vehicle and bias its depth sensor.

Waves are linear (Airy) and long-crested, in deep water, with a Bretschneider spectrum. A water particle at height z
moves on a circle whose radius falls as e^kz. The vehicle moves likewise, and leans with the surfaces of equal pressure.
Its pressure sensor moves with those surfaces and hardly sees the waves: the height it reads is z − rise_m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..quantities import DEGREE
from ..state import Array
from .random_streams import random_stream
from .specs import TideSpec

if TYPE_CHECKING:
    from .scenario import Scenario

COMPONENTS = 16
"""Waves of equal energy: enough for a sea that does not repeat within a mission, few enough to be cheap."""
SLOWEST_MEAN = 1.4492
"""Largest value of 2 sin²x / x, at tan x = 2x. The mean of a wave over a window τ has (sin x / x)² of its variance,
with x = ω τ / 2, and the mean of white readings every Δt has Δt / τ. At most the wave's is larger by this over ω Δt."""


@dataclass(frozen=True, eq=False)
class Sea:
    """Waves and tide.

    Attributes:
        amplitude_m, frequency_rad_s, phase_rad: (m,) of each wave.
        direction: (2,) unit vector in which they run.
        gravity: m/s²; deep water: the wave number is frequency² / gravity.
        tide: the tide, or None.
    """

    amplitude_m: Array
    frequency_rad_s: Array
    phase_rad: Array
    direction: Array
    gravity: float
    tide: TideSpec | None

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> Sea | None:
        """Return the sea of a scenario, or None where it is flat."""
        waves, gravity = scenario.waves, scenario.gravity_m_s2
        if waves is None:
            nothing = np.zeros(0)
            flat = scenario.tide is None
            return None if flat else cls(nothing, nothing, nothing, np.array([1.0, 0.0]), gravity, scenario.tide)
        # components of equal energy, each at the middle of its share of the spectrum's integral
        # m0 exp(−5/4 (ω_p / ω)⁴), m0 = height_m² / 16
        share = (np.arange(COMPONENTS) + 0.5) / COMPONENTS
        frequency = 2 * math.pi / waves.period_s * (-0.8 * np.log(share)) ** -0.25
        amplitude = np.full(COMPONENTS, waves.height_m / 4 * math.sqrt(2 / COMPONENTS))
        phase = random_stream(scenario.mission, "waves", seed).uniform(0, 2 * math.pi, COMPONENTS)
        towards = waves.towards_deg * DEGREE
        direction = np.array([math.cos(towards), math.sin(towards)])
        return cls(amplitude, frequency, phase, direction, gravity, scenario.tide)

    def rise_m(self, t_s: Array, p_W: Array) -> Array:
        """Return the rise of the surface of equal pressure through each point p_W (n, 3), (n,) m.

        ζ = tide + Σ a e^kz cos(k · x − ω t + φ); at z = 0 it is the sea's own surface.
        """
        height, phase, _ = self._waves(t_s, p_W)
        return self.tide_m(t_s) + np.sum(height * np.cos(phase), axis=1)

    def displacement(self, t_s: Array, p_W: Array) -> Array:
        """Return the displacement of the water, (n, 3) m, from its position p_W (n, 3) in a flat sea."""
        height, phase, _ = self._waves(t_s, p_W)
        along = -np.sum(height * np.sin(phase), axis=1)
        return np.column_stack([along[:, None] * self.direction, self.rise_m(t_s, p_W)])

    def slope(self, t_s: Array, p_W: Array) -> Array:
        """Return the slope of the surfaces of equal pressure, (n, 2): the derivative of rise_m by x and y."""
        height, phase, wavenumber = self._waves(t_s, p_W)
        return -np.sum(wavenumber * height * np.sin(phase), axis=1)[:, None] * self.direction

    def tide_m(self, t_s: Array) -> Array:
        """Return the rise of the tide since the start, (n,) m."""
        if self.tide is None:
            return np.zeros(len(t_s))
        phase = self.tide.phase_deg * DEGREE
        turned = 2 * math.pi / (3600 * self.tide.period_h) * t_s
        return self.tide.amplitude_m * (np.sin(turned + phase) - math.sin(phase))

    def swell_sigma_m(self, z_m: Array, period_s: float) -> Array:
        """Return the standard deviation to be told for what waves do to a pressure sensor at heights z_m, (n,) m.

        White noise of this sigma, in readings every period_s, has a mean over any window that errs by no less than the
        mean of rise_m: docs/conventions.md (75). For a single reading it is no less than the rms of rise_m. Readings
        must come three times in a wave's period or more often, or waves look slower than they are.
        """
        repeated = np.maximum(1.0, SLOWEST_MEAN / (self.frequency_rad_s * period_s))
        variance = 0.5 * self.amplitude_m**2 * repeated
        return np.sqrt(np.exp(np.outer(np.minimum(z_m, 0.0), 2 * self._wavenumber)) @ variance)

    @property
    def _wavenumber(self) -> Array:
        """(m,) rad/m, in deep water."""
        return self.frequency_rad_s**2 / self.gravity

    def _waves(self, t_s: Array, p_W: Array) -> tuple[Array, Array, Array]:
        """Return a e^kz and k · x − ω t + φ, (n, m), and k (m,)."""
        k = self._wavenumber
        depth = np.minimum(p_W[:, 2] - self.tide_m(t_s), 0.0)
        phase = np.outer(p_W[:, :2] @ self.direction, k) - np.outer(t_s, self.frequency_rad_s) + self.phase_rad
        return self.amplitude_m * np.exp(np.outer(depth, k)), phase, k
