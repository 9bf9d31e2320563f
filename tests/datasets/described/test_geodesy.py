from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets.described.geodesy import ecef_from_geodetic, enu_axes, enu_from_geodetic, geodetic_from_ecef
from fathom.datasets.places import radians


def test_the_ellipsoid_passes_through_its_known_points():
    lat, lon = np.radians([0.0, 90.0, 0.0]), np.radians([0.0, 0.0, 90.0])
    expected = [[6378137, 0, 0], [0, 0, 6356752.314245], [0, 6378137, 0]]
    np.testing.assert_allclose(ecef_from_geodetic(lat, lon, np.zeros(3)), expected, atol=1e-6)


def test_geodetic_coordinates_return_from_ecef():
    rng = np.random.default_rng(1)
    lat, lon = rng.uniform(-1.55, 1.55, 200), rng.uniform(-np.pi, np.pi, 200)
    height_m = rng.uniform(-11_000, 9_000, 200)
    lat2, lon2, height2_m = geodetic_from_ecef(ecef_from_geodetic(lat, lon, height_m))
    np.testing.assert_allclose(lat2, lat, atol=1e-14)
    np.testing.assert_allclose(lon2, lon, atol=1e-14)
    np.testing.assert_allclose(height2_m, height_m, atol=2e-8)


@pytest.mark.parametrize("latitude_deg", [-67.0, 0.0, 41.2])
def test_near_the_origin_a_place_moves_by_the_radii_of_curvature(latitude_deg):
    a, e2 = 6378137.0, 0.00669437999014
    lat, lon, step = np.radians(latitude_deg), np.radians(-8.7), 1e-6
    w = np.sqrt(1 - e2 * np.sin(lat) ** 2)
    meridian_m, across_m = a * (1 - e2) / w**3, a / w * np.cos(lat)
    p = enu_from_geodetic(np.array([lat + step, lat]), np.array([lon, lon + step]), np.zeros(2), (lat, lon, 0.0))
    np.testing.assert_allclose(p, [[0, meridian_m * step, 0], [across_m * step, 0, 0]], atol=2e-5)


def test_axes_are_a_right_handed_triad_with_up_along_the_normal():
    rng = np.random.default_rng(2)
    lat, lon = rng.uniform(-1.5, 1.5, 50), rng.uniform(-3, 3, 50)
    axes = enu_axes(lat, lon)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    up = ecef_from_geodetic(lat, lon, np.ones(50)) - ecef_from_geodetic(lat, lon, np.zeros(50))
    np.testing.assert_allclose(axes[:, 2], up, atol=1e-8)


def test_ddmm_keeps_its_sign():
    np.testing.assert_allclose(radians(np.array([4212.225, -306.2832]), "ddmm"), np.radians([42.20375, -3.10472]))
