"""Rotations keep their defining identities, near zero and near π too."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.estimators.physics.so3 import (
    exp,
    inverse_right_jacobian,
    log,
    right_jacobian,
    skew,
    skew_into,
    wrap,
    yaw_of,
)
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

ANGLES = [0.0, 1e-12, 1e-8, 0.9e-4, 1.1e-4, 0.9e-2, 1.1e-2, 0.1, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-10]


def _vectors(angle: float) -> np.ndarray:
    axes = np.random.default_rng(3).normal(size=(20, 3))
    axes[:3] = np.eye(3)
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    for phi in _vectors(angle):
        assert np.allclose(exp(phi), expm(skew(phi)), atol=1e-14, rtol=0)


def test_skew_is_the_cross_product_and_the_compiled_one_is_the_same() -> None:
    a, b, out = *np.random.default_rng(0).normal(size=(2, 50, 3)), np.empty((3, 3))
    assert np.allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15, rtol=1e-14)
    for one in a:
        skew_into(one, out)
        assert np.array_equal(out, skew(one))


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle: float) -> None:
    for phi in _vectors(angle):
        assert np.allclose(log(exp(phi)), phi, atol=1e-9 if angle > 3 else 1e-14, rtol=1e-13)


def test_log_at_pi_gives_one_of_the_two_vectors() -> None:
    for phi in _vectors(np.pi):
        assert np.allclose(exp(log(exp(phi))), exp(phi), atol=1e-12)


@pytest.mark.parametrize("angle", [a for a in ANGLES if a < 3.1])
def test_right_jacobian_is_the_derivative_of_exp(angle: float) -> None:
    step = 1e-6
    for phi in _vectors(angle):
        numeric = np.stack(
            [
                (log(exp(phi).T @ exp(phi + step * e)) - log(exp(phi).T @ exp(phi - step * e))) / (2 * step)
                for e in np.eye(3)
            ],
            axis=1,
        )
        assert np.allclose(right_jacobian(phi), numeric, atol=1e-9)
        assert np.allclose(inverse_right_jacobian(phi) @ right_jacobian(phi), np.eye(3), atol=1e-11)


def test_series_and_closed_forms_meet() -> None:
    axis = np.array([0.3, -0.5, np.sqrt(1 - 0.34)])
    for function, edge in ((exp, 1e-4), (right_jacobian, 1e-2), (inverse_right_jacobian, 1e-2)):
        below, above = function(axis * edge * (1 - 1e-9)), function(axis * edge * (1 + 1e-9))
        assert np.abs(above - below).max() < 3e-9 * edge + 1e-12


def test_yaw_is_that_of_the_zyx_angles() -> None:
    for yaw, pitch, roll in np.random.default_rng(0).uniform(-1.4, 1.4, (20, 3)):
        R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        assert yaw_of(R) == pytest.approx(yaw, abs=1e-14)


def test_wrap_keeps_the_angle_and_stays_within_pi() -> None:
    for angle in np.random.default_rng(0).uniform(-50, 50, 50):
        assert -np.pi <= wrap(angle) < np.pi
        assert np.exp(1j * wrap(angle)) == pytest.approx(np.exp(1j * angle), abs=1e-12)
