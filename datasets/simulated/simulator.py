"""Simulate a log: exact motion, sensors that read it through their mountings, and noise of the stated size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import DatasetError
from ..log import DepthStream, DvlStream, GpsStream, HeadingStream, Log
from ..quantities import DEGREE
from ..state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array, Belief
from ..trajectory import Trajectory
from .imu import sample_imu, simulate_biases
from .missions import fly
from .notes import scenario_notes
from .random_streams import random_stream
from .readings import read, ticks
from .scenario import Scenario
from .specs import ImuSpec, PriorSpec, as_told


def simulate(scenario: Scenario, seed: int, path: Trajectory | None = None) -> Log:
    """Return the log of one scenario; the same seed gives the same log, bit for bit, on one machine type.

    Args:
        scenario: what to simulate.
        seed: of every random stream of this mission; another mission has others.
        path: what the mission "recorded" follows, in place of the scenario's file.

    Raises:
        DatasetError: the seed is negative or has more than 63 bits, or no vehicle can follow the path.
    """
    if not 0 <= seed < 1 << 63:
        raise DatasetError("simulate: seed must be from 0 to 2^63 − 1")
    motion, rig, start_ns = fly(scenario, seed, path), scenario.rig, scenario.start_ns
    edges_ns = np.concatenate([[0], ticks(scenario.imu.rate_hz, scenario.duration_s)])
    rng = random_stream(scenario.mission, "imu_bias", seed)
    biases = simulate_biases(scenario.imu.figures, edges_ns, rng, scenario.imu.faults.bias_correlation_s)
    biases *= scenario.noise_scale

    R_WB, p_WB_W, v_WB_W = motion.pose(edges_ns * 1e-9)
    truth = Trajectory(start_ns + edges_ns, R_WB, p_WB_W, v_WB_W, b_a=biases[:, :3], b_g=biases[:, 3:])
    earth = "the Earth does not turn" if scenario.latitude_deg is None else f"latitude {scenario.latitude_deg:g}°"
    grade = scenario.imu.noise if isinstance(scenario.imu.noise, str) else "custom"
    return Log(
        name=f"{scenario.mission}-{grade}-s{seed}",
        rig=rig,
        imu=sample_imu(scenario, seed, motion, edges_ns, biases),
        dvl=read(DvlStream, scenario, seed, motion),
        depth=read(DepthStream, scenario, seed, motion),
        gps=read(GpsStream, scenario, seed, motion),
        heading=read(HeadingStream, scenario, seed, motion),
        truth=truth,
        prior=draw_prior(scenario, truth, seed),
        notes=(
            f"Simulated: {scenario.mission}, {scenario.duration_s:g} s, {grade} IMU at {scenario.imu.rate_hz:g} Hz, "
            f"seed {seed}, noise scaled by {scenario.noise_scale:g}; {earth}.",
            *motion.notes,
            *scenario_notes(scenario),
        ),
        origin=None if scenario.latitude_deg is None else (scenario.latitude_deg, 0.0),
    )


def draw_prior(scenario: Scenario, truth: Trajectory, seed: int) -> Belief:
    """Return the belief at the start: its mean is the truth less one draw of the error.

    The draw xi is made in the coordinates in which the sigmas are independent. With C the axes of the attitude's (W
    where a heading has its own, else B), and u the velocity in B where it is known there:

        R_true = R Exp(theta)    theta = R_CB xi_theta    v_true = R_true u_true    u_true = u + xi_v
        e_v = R (xi_v − u × theta), to first order, as P states it

    The biases' means are zero: their errors were drawn at turn-on.
    """
    spec, state = scenario.prior, truth.state(0)
    random = random_stream(scenario.mission, "prior", seed)
    error = random.standard_normal(DIM) * prior_sigma(scenario.imu, spec) * scenario.noise_scale
    if spec.wrong_by_deg is not None:
        axis = random.standard_normal(3)
        error[THETA] = spec.wrong_by_deg * DEGREE * axis / np.linalg.norm(axis)
    told = as_told(spec)
    if told.heading_deg is not None:
        error[THETA] = state.R_WB.T @ error[THETA]
    error[ACCEL_BIAS], error[GYRO_BIAS] = state.b_a, state.b_g
    mean, to_error = state.retract(-error), np.eye(DIM)
    if told.heading_deg is not None:
        to_error[THETA, THETA] = mean.R_WB.T
    if spec.velocity_in == "B":
        u_WB_B = state.R_WB.T @ state.v_WB_W - error[VELOCITY]
        mean = replace(mean, v_WB_W=mean.R_WB @ u_WB_B)
        to_error[VELOCITY, THETA] = mean.R_WB @ np.cross(to_error[THETA, THETA].T, u_WB_B).T
        to_error[VELOCITY, VELOCITY] = mean.R_WB
    sigma = prior_sigma(as_told(scenario.imu), told)
    return Belief(int(truth.t_ns[0]), mean, to_error @ np.diag(sigma**2) @ to_error.T)


def prior_sigma(imu: ImuSpec, prior: PriorSpec) -> Array:
    """Return the standard deviations of the error at the start, (15,), in the coordinates of its draw."""
    sigma = np.empty(DIM)
    sigma[THETA] = prior.attitude_deg * DEGREE
    if prior.heading_deg is not None:
        sigma[THETA.stop - 1] = prior.heading_deg * DEGREE
    sigma[POSITION] = prior.position_m
    sigma[VELOCITY] = prior.velocity_m_s
    sigma[ACCEL_BIAS] = imu.figures.accel_bias_sigma
    sigma[GYRO_BIAS] = imu.figures.gyro_bias_sigma
    return sigma
