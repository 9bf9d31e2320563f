"""The rig: mounting of every sensor on the body, noise of the IMU, gravity and the Earth's rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .errors import DatasetError
from .places import is_place
from .rotations import UNHEARD, complaint, off_rotation
from .state import Array

EARTH_RATE_RAD_S = 7.292115e-5
"""rad/s, from WGS 84: 15.04 °/h."""
LEAST_GRAVITY, MOST_GRAVITY = 9.7, 9.9
"""m/s²: at sea level it is from 9.780 at the equator to 9.832 at the poles; the deepest sea adds 0.03."""


@dataclass(frozen=True, eq=False)
class Mounting:
    """Fixed pose of a sensor S on the body: R_BS (3, 3) takes S components to B, p_BS_B (3,) m is its lever arm.

    Raises:
        DatasetError: R_BS is not a rotation, or p_BS_B is not finite.
    """

    R_BS: Array = field(default_factory=lambda: np.eye(3))
    p_BS_B: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        R, p = np.asarray(self.R_BS, float), np.asarray(self.p_BS_B, float)
        if R.shape != (3, 3):
            raise DatasetError(f"mounting: R_BS must be a 3 × 3 rotation, found the shape {R.shape}")
        if off_rotation(R) > UNHEARD:
            raise DatasetError(f"mounting: R_BS must be a 3 × 3 rotation; it is {complaint(R, UNHEARD)}")
        if p.shape != (3,) or not np.isfinite(p).all():
            raise DatasetError(f"mounting: p_BS_B must be three finite metres, found {self.p_BS_B!r}")


@dataclass(frozen=True)
class ImuNoise:
    """IMU noise, equal on the three axes; from the data sheet or an Allan-variance fit.

    Raises:
        DatasetError: a figure is negative or not finite.
    """

    gyro_density: float  # rad/s/√Hz, white
    accel_density: float  # m/s²/√Hz, white
    gyro_walk: float  # rad/s²/√Hz, random walk of the bias
    accel_walk: float  # m/s³/√Hz, random walk of the bias
    gyro_bias_sigma: float  # rad/s, at turn-on
    accel_bias_sigma: float  # m/s², at turn-on

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise DatasetError(f"imu noise: {name} must be finite and not negative, found {value}")


@dataclass(frozen=True, eq=False)
class Rig:
    """Extrinsics and noise of one vehicle. B coincides with the DVL, so the DVL has no mounting of its own.

    Attributes:
        imu: mounting of the inertial sensor I.
        imu_noise: its densities and bias figures.
        depth, gps, heading: mountings of the pressure sensor P, the GPS antenna G, the heading sensor H.
        gravity: m/s², positive; g_W = (0, 0, −gravity).
        latitude_deg: of W's origin; None if unknown (or, in a simulation, if the Earth does not turn). By
            default, estimators let the Earth turn where it is known.
    """

    imu_noise: ImuNoise
    imu: Mounting = field(default_factory=Mounting)
    depth: Mounting = field(default_factory=Mounting)
    gps: Mounting = field(default_factory=Mounting)
    heading: Mounting = field(default_factory=Mounting)
    gravity: float = 9.81
    latitude_deg: float | None = None

    def __post_init__(self) -> None:
        if not LEAST_GRAVITY < self.gravity < MOST_GRAVITY:
            raise DatasetError(f"rig: gravity must be in m/s² and positive, found {self.gravity}")
        if self.latitude_deg is not None and not is_place(self.latitude_deg):
            raise DatasetError(f"rig: latitude_deg must lie between −90 and 90, found {self.latitude_deg}")

    @property
    def w_CW_W(self) -> Array:  # noqa: N802 - a rate, in our notation
        """Rate at which the Earth turns W over the celestial frame C, that of the stars, (3,) rad/s.

        Raises:
            DatasetError: the latitude is not known.
        """
        if self.latitude_deg is None:
            raise DatasetError(
                "rig: no latitude, so the Earth's rate in W is unknown; give `origin` in log.yaml, or `latitude_deg` "
                "in a scenario, or set `earth_rotation: auto`"
            )
        latitude = math.radians(self.latitude_deg)
        return EARTH_RATE_RAD_S * np.array([0.0, math.cos(latitude), math.sin(latitude)])
