"""Missions: smooth paths whose positions, velocities, accelerations and rates are known exactly.

A mission is drawn on a coarse grid from straight legs, arcs, dives and climbs, smoothed, and given a small wobble.
Quintic splines interpolate the drawn velocity and Euler angles, and these splines are the truth: position is their
exact antiderivative, acceleration and angular acceleration their exact derivatives. Nothing is integrated numerically.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_interp_spline

from ..errors import DatasetError
from ..state import Array
from .motion import AFLOAT_M, Motion
from .random_streams import random_stream
from .recorded_path import follow
from .sea import Sea
from .specs import MISSIONS, RECORDED, Plan

if TYPE_CHECKING:
    from ..trajectory import Trajectory
    from .scenario import Scenario

KNOT_S = 0.1
"""Spacing of the splines' knots: a fifteenth of the smoothing, so that they follow the drawn path closely."""
SMOOTHING_S = 1.5
"""Standard deviation of the Gaussian that rounds every corner of the path."""
MARGIN_S = 12.0
"""By this the splines extend beyond both ends, which keeps the ends of splines and smoothing out of the mission."""
WOBBLE_PERIODS_S = (4.3, 6.1, 9.7, 15.1)
"""Usual periods of a small vehicle's roll, pitch and control; no two have a common multiple within minutes."""
SPEED_WOBBLE = 0.03
"""Relative variation of the speed."""


def fly(scenario: Scenario, seed: int, path: Trajectory | None = None) -> Motion:
    """Return the motion of a scenario's mission; a recorded one follows `path`, or the scenario's file.

    Raises:
        DatasetError: a recorded mission without a path, or with one that no vehicle can follow; or a path for another.
    """
    if scenario.mission == RECORDED:
        return follow(scenario, path)
    if path is not None:
        raise DatasetError(f"simulate: mission {scenario.mission} takes no path; only mission {RECORDED!r} follows one")
    return draw(scenario, random_stream(scenario.mission, "mission", seed), Sea.of(scenario, seed))


def draw(scenario: Scenario, rng: np.random.Generator, sea: Sea | None = None) -> Motion:
    """Return the motion of one of MISSIONS, on a sea or a flat one; rng draws the phases of the wobble."""
    plan = MISSIONS[scenario.mission]
    t_s = np.arange(-MARGIN_S, scenario.duration_s + MARGIN_S, KNOT_S)
    rock = wobble(t_s, rng)

    speed = scenario.speed_m_s * (1 + SPEED_WOBBLE * rock[:, 3])
    vertical = -smooth(np.gradient(depth_profile(scenario, plan, t_s), KNOT_S))
    horizontal = np.sqrt(speed**2 - vertical**2)
    travelled_m = np.cumsum(horizontal) * KNOT_S
    course = smooth(course_profile(scenario, plan, travelled_m - np.interp(0.0, t_s, travelled_m)))
    bank = np.arctan(horizontal * np.gradient(course, KNOT_S) / scenario.gravity_m_s2)

    v_WB_W = np.stack([horizontal * np.cos(course), horizontal * np.sin(course), vertical], axis=1)
    angles = np.stack([-bank, -np.arcsin(vertical / speed), course], axis=1)
    angles += math.radians(scenario.wobble_deg) * rock[:, :3]
    p_0 = np.array([0.0, 0.0, AFLOAT_M])
    if sea is not None:
        p_WB_W = np.cumsum(v_WB_W, axis=0) * KNOT_S
        p_WB_W += p_0 - [np.interp(0.0, t_s, column) for column in p_WB_W.T]
        moved = make_interp_spline(t_s, sea.displacement(t_s, p_WB_W), k=5)
        p_0, v_WB_W = p_0 + moved(0.0), v_WB_W + moved.derivative()(t_s)
        angles += lean(sea.slope(t_s, p_WB_W), angles[:, 2])
    return Motion.from_velocity(t_s, v_WB_W, angles, p_0)


def lean(slope: Array, psi: Array) -> Array:
    """Return the angles (n, 3) by which a body on a slope (n, 2) leans, with its nose towards psi (n,)."""
    ahead = slope[:, 0] * np.cos(psi) + slope[:, 1] * np.sin(psi)
    left = -slope[:, 0] * np.sin(psi) + slope[:, 1] * np.cos(psi)
    return np.stack([np.arctan(left), -np.arctan(ahead), np.zeros(len(psi))], axis=1)


def depth_profile(scenario: Scenario, plan: Plan, t_s: Array) -> Array:
    """Return depths (n,) m below the floating position: straight dives and climbs, before smoothing.

    Surfacings are centred on multiples of one period, which divides the mission evenly, and on both its ends.
    """
    legs = max(1, round(scenario.duration_s / scenario.surface_every_s))
    period_s = scenario.duration_s / legs
    half_s = min(scenario.surface_for_s / 2, period_s / 4)
    rate_m_s = scenario.speed_m_s * math.sin(climb_angle(scenario, plan))
    phase_s = np.mod(t_s, period_s)
    dived_m = rate_m_s * np.maximum(0.0, phase_s - half_s)
    to_climb_m = rate_m_s * np.maximum(0.0, period_s - phase_s - half_s)
    run_m = np.minimum(dived_m, scenario.depth_m)
    if plan.sawtooth:
        span_m = scenario.depth_m - scenario.shallow_m
        run_m -= span_m - np.abs(span_m - np.mod(np.maximum(0.0, dived_m - scenario.depth_m), 2 * span_m))
    return np.minimum(run_m, to_climb_m)


def climb_angle(scenario: Scenario, plan: Plan) -> float:
    """Return the angle of every climb and dive, rad; one turn of a helix climbs by its pitch."""
    if plan.legs:
        return math.radians(scenario.climb_deg)
    return math.atan2(scenario.helix_pitch_m, 2 * math.pi * scenario.turn_radius_m)


def course_profile(scenario: Scenario, plan: Plan, travelled_m: Array) -> Array:
    """Return the course (n,) rad after each distance travelled (n,) m: straight legs and arcs."""
    turns = np.radians(plan.turns_deg)
    each_m = plan.legs * scenario.leg_m + np.abs(turns) * scenario.turn_radius_m
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
