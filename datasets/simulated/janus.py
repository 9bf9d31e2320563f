"""A four-beam Janus DVL: bottom lock of each beam, and the velocity from the locked ones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..quantities import DEGREE
from ..rig import Mounting
from ..state import Array
from .motion import Motion
from .random_streams import random_stream
from .scenario import Scenario
from .specs import DvlSpec, as_told


def janus_beams(beam_angle_rad: float) -> Array:
    """Return the unit vectors (4, 3), in B, of beams at azimuths 45°, 135°, … and beam_angle_rad from straight down."""
    azimuth = np.pi / 4 + np.pi / 2 * np.arange(4)
    s, c = math.sin(beam_angle_rad), math.cos(beam_angle_rad)
    return np.stack([s * np.cos(azimuth), s * np.sin(azimuth), np.full(4, -c)], axis=1)


def read_dvl(
    scenario: Scenario, spec: DvlSpec, dvl: Mounting, motion: Motion, t_s: Array, seed: int
) -> tuple[Array, Array, Array]:
    """Return v_WD_D (n, 3), NaN without bottom lock, its error (n, 3), and its sigma (n, 3).

    The velocity is the least-squares solution of its beams, and its sigma their figure of merit: the square roots of
    the diagonal of σ² (AᵀA)⁻¹, with the σ that is told. Four beams give independent errors. Three give sigmas √2
    larger, and errors that are correlated by ±1/2 in pairs. A reading has no correlations, so its sigmas are right axis
    by axis only.
    """
    R_WB, p_WB_W, v_WB_W = motion.pose(t_s)
    v_WD_B = np.einsum("nji,nj->ni", R_WB, v_WB_W)
    if dvl.p_BS_B.any():
        v_WD_B += np.cross(motion.attitude(t_s)[1], dvl.p_BS_B)
    v_WD_D = spec.faults.scale * v_WD_B @ dvl.R_BS

    A = janus_beams(spec.beam_angle_deg * DEGREE)
    beam_error = spec.beam_sigma_m_s * random_stream(scenario.mission, "dvl", seed).standard_normal((len(t_s), 4))
    told_m_s = as_told(spec).beam_sigma_m_s
    error, sigma = beam_error @ np.linalg.pinv(A).T, np.tile(figure_of_merit(A, told_m_s), (len(t_s), 1))
    if scenario.seabed is None and spec.max_tilt_deg is None and not spec.beam_loss_probability:
        return v_WD_D, error, sigma

    locked = bottom_lock(scenario, spec, R_WB @ dvl.R_BS, p_WB_W + R_WB @ dvl.p_BS_B, seed)
    for lost in range(4):
        rows, others = ~locked[:, lost] & (locked.sum(axis=1) == 3), np.arange(4) != lost
        error[rows] = beam_error[rows][:, others] @ np.linalg.inv(A[others]).T
        sigma[rows] = figure_of_merit(A[others], told_m_s)
    enough = locked.sum(axis=1) >= (3 if spec.three_beams else 4)
    return np.where(enough[:, None], v_WD_D, np.nan), error, sigma


def figure_of_merit(A: Array, beam_sigma_m_s: float) -> Array:
    """Return the standard deviation of each component of the velocity that beams A (m, 3) give, (3,) m/s."""
    return beam_sigma_m_s * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))


def bottom_lock(scenario: Scenario, spec: DvlSpec, R_WD: Array, p_WD_W: Array, seed: int) -> NDArray[np.bool_]:
    """Return which beams (n, 4) hear the bottom: upright enough, in range, and not lost by chance."""
    locked = np.ones((len(R_WD), 4), bool)
    if spec.max_tilt_deg is not None:
        locked &= (R_WD[:, 2, 2] >= math.cos(spec.max_tilt_deg * DEGREE))[:, None]
    if scenario.seabed is not None:
        beams_W = janus_beams(spec.beam_angle_deg * DEGREE) @ R_WD.transpose(0, 2, 1)
        range_m = scenario.seabed.ranges(p_WD_W, beams_W)
        locked &= (range_m >= spec.min_range_m) & (range_m <= spec.max_range_m)
    if spec.beam_loss_probability:
        locked &= (
            random_stream(scenario.mission, "dvl_beams", seed).random((len(R_WD), 4)) >= spec.beam_loss_probability
        )
    return locked
