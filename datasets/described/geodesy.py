"""WGS84: geodetic coordinates, earth-centred ones (ECEF), and the local tangent plane W (east-north-up)."""

from __future__ import annotations

import numpy as np

from ..state import Array

# WGS 84, defining parameters (NGA.STND.0036, table 3.1).
SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563  # (the standard states the inverse)
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)  # of the ellipse, from its definition


def ecef_from_geodetic(latitude: Array, longitude: Array, height_m: Array) -> Array:
    """Return (n, 3) m, earth-centred earth-fixed; latitude and longitude (n,) rad, height (n,) above the ellipsoid."""
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    across = (normal + height_m) * np.cos(latitude)
    up = (normal * (1 - ECCENTRICITY_SQUARED) + height_m) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), up], axis=-1)


def geodetic_from_ecef(p_ecef: Array) -> tuple[Array, Array, Array]:
    """Inverse of `ecef_from_geodetic`, by fixed-point iteration; to 1e-9 m within 100 km of the ellipsoid."""
    x, y, z = p_ecef[..., 0], p_ecef[..., 1], p_ecef[..., 2]
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - ECCENTRICITY_SQUARED))
    normal = np.full_like(latitude, SEMI_MAJOR_M)
    for _ in range(8):
        normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + ECCENTRICITY_SQUARED * normal * np.sin(latitude), across)
    height_m = across * np.cos(latitude) + z * np.sin(latitude) - SEMI_MAJOR_M**2 / normal
    return latitude, np.arctan2(y, x), height_m


def enu_axes(latitude: Array, longitude: Array) -> Array:
    """Return (n, 3, 3): rows are east, north and up at each position, in ECEF axes."""
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(s)
    rows = [[-sl, cl, zero], [-s * cl, -s * sl, c], [c * cl, c * sl, s]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def enu_from_geodetic(latitude: Array, longitude: Array, height_m: Array, origin: tuple[float, float, float]) -> Array:
    """Return (n, 3) m in the plane tangent at `origin` (latitude rad, longitude rad, height m)."""
    lat0, lon0, h0 = (np.array([x]) for x in origin)
    offset = ecef_from_geodetic(latitude, longitude, height_m) - ecef_from_geodetic(lat0, lon0, h0)
    return offset @ enu_axes(lat0, lon0)[0].T
