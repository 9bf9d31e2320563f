"""A vehicle's motion as splines, exact in every derivative; every simulated sensor reads it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from ..state import Array

AFLOAT_M = -0.1
"""Height of B while the vehicle is afloat: low in the water, its antenna's mast above."""


class Kinematics(NamedTuple):
    """Motion of B at n times."""

    R_WB: Array  # (n, 3, 3)
    p_WB_W: Array  # (n, 3) m
    v_WB_W: Array  # (n, 3) m/s
    a_WB_W: Array  # (n, 3) m/s²
    w_WB_B: Array  # (n, 3) rad/s
    alpha_WB_B: Array  # (n, 3) rad/s², the derivative of w_WB_B


@dataclass(frozen=True, eq=False)
class Motion:
    """A path as splines of time, in seconds from the start.

    Attributes:
        position: spline of p_WB_W, m.
        velocity: its derivative, v_WB_W, m/s.
        angles: spline of (phi, theta, psi), rad, with R_WB = Rz(psi) Ry(theta) Rx(phi); in a forward-left-up body a
            raised nose has theta < 0.
        notes: how it was made, if the mission's name does not say.
    """

    position: BSpline
    velocity: BSpline
    angles: BSpline
    notes: tuple[str, ...] = ()

    @classmethod
    def from_velocity(cls, t_s: Array, v_WB_W: Array, angles: Array, p_0: Array) -> Motion:
        """Interpolate v_WB_W and the angles, (n, 3), at t_s (n,) by quintic splines; p_0 is the position at time 0."""
        velocity = make_interp_spline(t_s, v_WB_W, k=5)
        position = velocity.antiderivative()
        # a B-spline's basis sums to one: shifting every coefficient shifts the curve
        position.c += p_0 - position(0.0)
        return cls(position, velocity, make_interp_spline(t_s, angles, k=5))

    @cached_property
    def acceleration(self) -> BSpline:
        """Spline of a_WB_W, m/s²."""
        return self.velocity.derivative()

    def at(self, t_s: Array) -> Kinematics:
        """Return the motion at times t_s (n,)."""
        R_WB, w_WB_B, alpha_WB_B = self.attitude(t_s)
        return Kinematics(R_WB, self.position(t_s), self.velocity(t_s), self.acceleration(t_s), w_WB_B, alpha_WB_B)

    def pose(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Return R_WB (n, 3, 3), p_WB_W and v_WB_W (n, 3) at times t_s (n,)."""
        return rotations(self.angles(t_s)), self.position(t_s), self.velocity(t_s)

    def attitude(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Return R_WB (n, 3, 3), w_WB_B (rad/s) and its derivative (rad/s²), (n, 3), at times t_s (n,)."""
        angles = self.angles(t_s)
        return rotations(angles), *body_rates(angles, self.angles(t_s, nu=1), self.angles(t_s, nu=2))


def rotations(angles: Array) -> Array:
    """Return Rz(psi) Ry(theta) Rx(phi), (n, 3, 3), for angles (n, 3) = (phi, theta, psi), rad."""
    (s_phi, s_theta, s_psi), (c_phi, c_theta, c_psi) = np.sin(angles).T, np.cos(angles).T
    R = np.empty((len(angles), 3, 3))
    R[:, 0, 0] = c_psi * c_theta
    R[:, 0, 1] = c_psi * s_theta * s_phi - s_psi * c_phi
    R[:, 0, 2] = c_psi * s_theta * c_phi + s_psi * s_phi
    R[:, 1, 0] = s_psi * c_theta
    R[:, 1, 1] = s_psi * s_theta * s_phi + c_psi * c_phi
    R[:, 1, 2] = s_psi * s_theta * c_phi - c_psi * s_phi
    R[:, 2, 0] = -s_theta
    R[:, 2, 1] = c_theta * s_phi
    R[:, 2, 2] = c_theta * c_phi
    return R


def body_rates(angles: Array, rate: Array, acceleration: Array) -> tuple[Array, Array]:
    """Return w_WB_B and alpha_WB_B from the Euler angles (phi, theta, psi) and their derivatives, all (n, 3).

    w = e_x phi' + Rx(phi)ᵀ e_y theta' + Rx(phi)ᵀ Ry(theta)ᵀ e_z psi', and alpha is its derivative, term by term.
    """
    phi, theta, _ = angles.T
    d_phi, d_theta, d_psi = rate.T
    dd_phi, dd_theta, dd_psi = acceleration.T
    s_phi, c_phi, s_theta, c_theta = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta)
    # e_z psi' in the axes after Ry: (-sin theta, 0, cos theta) psi'; h is its z component, dh the derivative
    h = d_psi * c_theta
    dh = dd_psi * c_theta - d_psi * d_theta * s_theta
    w = np.empty_like(rate)
    w[:, 0] = d_phi - d_psi * s_theta
    w[:, 1] = d_theta * c_phi + h * s_phi
    w[:, 2] = h * c_phi - d_theta * s_phi
    alpha = np.empty_like(rate)
    alpha[:, 0] = dd_phi - dd_psi * s_theta - d_psi * d_theta * c_theta
    alpha[:, 1] = dd_theta * c_phi + dh * s_phi + d_phi * w[:, 2]
    alpha[:, 2] = dh * c_phi - dd_theta * s_phi - d_phi * w[:, 1]
    return w, alpha
