"""The rig: mounting of every sensor on the body, noise of the IMU, gravity and the Earth's rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .errors import DatasetError
from .places import on_earth
from .state import Array

EARTH_RATE_RAD_S = 7.292115e-5
"""rad/s, from WGS 84: 15.04 °/h."""


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
        orthonormal = R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-9) and np.linalg.det(R) > 0
        if not orthonormal:
            raise DatasetError(f"mounting: R_BS must be a 3 × 3 rotation, found {self.R_BS!r}")
        if p.shape != (3,) or not np.isfinite(p).all():
            raise DatasetError(f"mounting: p_BS_B must be three finite metres, found {self.p_BS_B!r}")


@dataclass(frozen=True)
class ImuNoise:
    """IMU noise, equal on the three axes; from the data sheet or an Allan-variance fit."""

    gyro_density: float  # rad/s/√Hz, white
    accel_density: float  # m/s²/√Hz, white
    gyro_walk: float  # rad/s²/√Hz, random walk of the bias
    accel_walk: float  # m/s³/√Hz, random walk of the bias
    gyro_bias_sigma: float  # rad/s, at turn-on
    accel_bias_sigma: float  # m/s², at turn-on


@dataclass(frozen=True, eq=False)
class Rig:
    """Extrinsics and noise of one vehicle. B coincides with the DVL, so the DVL has no mounting of its own.

    Attributes:
        imu: mounting of the inertial sensor I.
        imu_noise: its densities and bias figures.
        depth, gps, heading: mountings of the pressure sensor P, the GPS antenna G, the heading sensor H.
        gravity: m/s², positive; g_W = (0, 0, −gravity).
        latitude_deg: of W's origin; None if unknown (or, in a simulation, if the Earth does not turn).
    """

    imu_noise: ImuNoise
    imu: Mounting = field(default_factory=Mounting)
    depth: Mounting = field(default_factory=Mounting)
    gps: Mounting = field(default_factory=Mounting)
    heading: Mounting = field(default_factory=Mounting)
    gravity: float = 9.81
    latitude_deg: float | None = None

    def __post_init__(self) -> None:
        if not 9.7 < self.gravity < 9.9:
            raise DatasetError(f"rig: gravity must be in m/s² and positive, found {self.gravity}")
        if self.latitude_deg is not None and not on_earth(self.latitude_deg):
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
                "in a scenario, or leave `earth_rotation` out"
            )
        latitude = math.radians(self.latitude_deg)
        return EARTH_RATE_RAD_S * np.array([0.0, math.cos(latitude), math.sin(latitude)])
