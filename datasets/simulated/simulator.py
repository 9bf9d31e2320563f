"""Simulate a log: exact motion, sensors that read it through their mountings, and noise of the stated size."""

from __future__ import annotations

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

    The biases' means are zero: their errors were drawn at turn-on.
    """
    state = truth.state(0)
    error = random_stream(scenario.mission, "prior", seed).standard_normal(DIM)
    error *= prior_sigma(scenario.imu, scenario.prior) * scenario.noise_scale
    error[ACCEL_BIAS], error[GYRO_BIAS] = state.b_a, state.b_g
    told = prior_sigma(as_told(scenario.imu), as_told(scenario.prior))
    return Belief(int(truth.t_ns[0]), state.retract(-error), np.diag(told**2))


def prior_sigma(imu: ImuSpec, prior: PriorSpec) -> Array:
    """Return the standard deviations of the error state at the start, (15,)."""
    sigma = np.empty(DIM)
    sigma[THETA] = prior.attitude_deg * DEGREE
    sigma[POSITION] = prior.position_m
    sigma[VELOCITY] = prior.velocity_m_s
    sigma[ACCEL_BIAS] = imu.figures.accel_bias_sigma
    sigma[GYRO_BIAS] = imu.figures.gyro_bias_sigma
    return sigma
