"""Missions: smooth paths whose positions, velocities, accelerations and rates are known exactly.

A mission is drawn on a coarse grid, from straight legs, arcs, dives and climbs, smoothed and rocked a little; quintic
splines are laid through the drawn velocity and Euler angles. From there on the splines are the truth: position is
their exact antiderivative, acceleration and angular acceleration their exact derivatives, and nothing is integrated
numerically.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from .state import Array

if TYPE_CHECKING:
    from .scenario import Scenario

KNOT_S = 0.1
SMOOTHING_S = 1.5
"""Standard deviation of the Gaussian that rounds every corner of the path."""
MARGIN_S = 12.0
"""How far the splines reach beyond both ends, so that their ends and the smoothing's stay out of the mission."""
AFLOAT_M = -0.1
"""Height of B while the vehicle is afloat: low in the water, its antenna's mast above."""
WOBBLE_PERIODS_S = (4.3, 6.1, 9.7, 15.1)
SPEED_WOBBLE = 0.03
"""Relative variation of the speed."""


@dataclass(frozen=True)
class Plan:
    """What tells one mission from another.

    Attributes:
        turns_deg: course changes after each leg, over and over; counter-clockwise positive.
        sawtooth: whether the vehicle keeps climbing and diving between two depths, or runs level at the deeper.
    """

    turns_deg: tuple[float, ...]
    sawtooth: bool


MISSIONS = {
    "lawnmower": Plan(turns_deg=(180.0, -180.0), sawtooth=False),
    "yo-yo": Plan(turns_deg=(70.0, -100.0, 60.0, -30.0), sawtooth=True),
}


class Kinematics(NamedTuple):
    """Motion of B at n times."""

    R_WB: Array  # (n, 3, 3)
    p_WB_W: Array  # (n, 3) m
    v_WB_W: Array  # (n, 3) m/s
    a_WB_W: Array  # (n, 3) m/s²
    w_WB_B: Array  # (n, 3) rad/s
    alpha_WB_B: Array  # (n, 3) rad/s², the derivative of w_WB_B


class Motion:
    """A path as splines of time, in seconds from the start.

    Attributes:
        velocity: spline of v_WB_W, m/s.
        position: its antiderivative from the start at (0, 0, AFLOAT_M), m.
        angles: spline of (phi, theta, psi), rad, with R_WB = Rz(psi) Ry(theta) Rx(phi); in a forward-left-up body a
            raised nose has theta < 0.
    """

    def __init__(self, t_s: Array, v_WB_W: Array, angles: Array) -> None:
        self.velocity: BSpline = make_interp_spline(t_s, v_WB_W, k=5)
        self.angles: BSpline = make_interp_spline(t_s, angles, k=5)
        self.position: BSpline = self.velocity.antiderivative()
        # a B-spline's basis sums to one: shifting every coefficient shifts the curve
        self.position.c += np.array([0.0, 0.0, AFLOAT_M]) - self.position(0.0)
        self.acceleration: BSpline = self.velocity.derivative()

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


def fly(scenario: Scenario, rng: np.random.Generator) -> Motion:
    """Return the motion of a scenario's mission; rng draws the phases of the wobble."""
    plan = MISSIONS[scenario.mission]
    t_s = np.arange(-MARGIN_S, scenario.duration_s + MARGIN_S, KNOT_S)
    rock = wobble(t_s, rng)

    speed = scenario.speed_mps * (1 + SPEED_WOBBLE * rock[:, 3])
    vertical = -smooth(np.gradient(depth_profile(scenario, plan, t_s), KNOT_S))
    horizontal = np.sqrt(speed**2 - vertical**2)
    travelled_m = np.cumsum(horizontal) * KNOT_S
    course = smooth(course_profile(scenario, plan, travelled_m - np.interp(0.0, t_s, travelled_m)))
    bank = np.arctan(horizontal * np.gradient(course, KNOT_S) / scenario.gravity_mps2)

    v_WB_W = np.stack([horizontal * np.cos(course), horizontal * np.sin(course), vertical], axis=1)
    along = np.stack([-bank, -np.arcsin(vertical / speed), course], axis=1)
    return Motion(t_s, v_WB_W, along + math.radians(scenario.wobble_deg) * rock[:, :3])


def depth_profile(scenario: Scenario, plan: Plan, t_s: Array) -> Array:
    """Return depths (n,) m below where the vehicle floats: straight dives and climbs, before smoothing.

    Surfacings are centred on multiples of one period, which divides the mission evenly, and on both its ends.
    """
    legs = max(1, round(scenario.duration_s / scenario.surface_every_s))
    period_s = scenario.duration_s / legs
    half_s = min(scenario.surface_for_s / 2, period_s / 4)
    rate_mps = scenario.speed_mps * math.sin(math.radians(scenario.climb_deg))
    phase_s = np.mod(t_s, period_s)
    dived_m = rate_mps * np.maximum(0.0, phase_s - half_s)
    to_climb_m = rate_mps * np.maximum(0.0, period_s - phase_s - half_s)
    run_m = np.minimum(dived_m, scenario.depth_m)
    if plan.sawtooth:
        span_m = scenario.depth_m - scenario.shallow_m
        run_m -= span_m - np.abs(span_m - np.mod(np.maximum(0.0, dived_m - scenario.depth_m), 2 * span_m))
    return np.minimum(run_m, to_climb_m)


def course_profile(scenario: Scenario, plan: Plan, travelled_m: Array) -> Array:
    """Return the course (n,) rad after each distance travelled (n,) m: straight legs joined by arcs."""
    turns = np.radians(plan.turns_deg)
    each_m = scenario.leg_m + np.abs(turns) * scenario.turn_radius_m
    repeats = math.ceil(max(travelled_m[-1], 0.0) / each_m.sum()) + 1
    turns, arcs_m = np.tile(turns, repeats), np.tile(np.abs(turns) * scenario.turn_radius_m, repeats)
    ends_m = np.cumsum(np.tile(each_m, repeats))
    at_m = np.stack([ends_m - arcs_m, ends_m], axis=1).ravel()
    after = np.cumsum(turns)
    course = np.stack([after - turns, after], axis=1).ravel()
    return math.radians(scenario.course_deg) + np.interp(travelled_m, at_m, course)


def wobble(t_s: Array, rng: np.random.Generator) -> Array:
    """Return four slow unit wobbles (n, 4), each a sum of sinusoids: for roll, pitch, yaw and speed."""
    phases = rng.uniform(0, 2 * np.pi, (len(WOBBLE_PERIODS_S), 4))
    sines = [np.sin(2 * np.pi / T * t_s[:, None] + phase) for T, phase in zip(WOBBLE_PERIODS_S, phases, strict=True)]
    return np.sum(sines, axis=0) / math.sqrt(len(WOBBLE_PERIODS_S))


def smooth(values: Array) -> Array:
    """Return values (n,) on the knots, convolved with a Gaussian of SMOOTHING_S; the ends are held."""
    half = round(4 * SMOOTHING_S / KNOT_S)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * KNOT_S / SMOOTHING_S) ** 2)
    return np.asarray(np.convolve(np.pad(values, half, mode="edge"), kernel / kernel.sum(), mode="valid"), float)
