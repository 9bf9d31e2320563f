"""The prior comes from the log's first seconds, and its covariance covers its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.datasets import ImuNoise, Log, Mounting, Rig
from fathom.datasets.epochs import cut
from fathom.datasets.initialise import initialise
from fathom.datasets.log import AttitudeStream, DepthStream, DvlStream, GpsStream, HeadingStream, ImuStream
from fathom.datasets.state import ACCEL_BIAS, GYRO_BIAS, POSITION, THETA, VELOCITY, NavState
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

NOISE = ImuNoise(1e-3, 1e-2, 1e-6, 1e-5, 2e-3, 0.05)
T0 = 1_600_000_000_000_000_000


def voyage(seed: int, *, noisy: bool, rate_hz: int = 50) -> tuple[Log, NavState, int]:
    """Five seconds of level turning flight by its own equations; the log, and the true state after two seconds."""
    rng = np.random.default_rng(seed)
    n, dt = 5 * rate_hz, 1 / rate_hz
    t = np.arange(1, n + 1) * dt
    roll, pitch, speed = rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(0.0, 1.5)
    psi0, turn = rng.uniform(-3, 3), rng.uniform(-0.2, 0.2)

    def R_WB(time: float) -> np.ndarray:
        return Rotation.from_euler("ZYX", [psi0 + turn * time, pitch, roll]).as_matrix()

    def v_W(time: float) -> np.ndarray:
        return speed * np.array([np.cos(psi0 + turn * time), np.sin(psi0 + turn * time), 0.0])

    mountings = {
        name: Mounting(Rotation.random(random_state=seed + k).as_matrix(), rng.normal(size=3))
        for k, name in enumerate(("imu", "depth", "gps", "heading"))
    }
    rig = Rig(NOISE, mountings["imu"], mountings["depth"], mountings["gps"], mountings["heading"], 9.81)
    R_BI = mountings["imu"].R_BS
    b_a, b_g = (rng.normal(size=3) * s * noisy for s in (NOISE.accel_bias_sigma, NOISE.gyro_bias_sigma))
    w, f = np.empty((n, 3)), np.empty((n, 3))
    for k, time in enumerate(t):
        middle = time - dt / 2
        a_W = turn * np.cross([0, 0, 1], v_W(middle))
        f[k] = (
            R_BI.T @ R_WB(middle).T @ np.add(a_W, [0, 0, 9.81]) + b_a + rng.normal(size=3) * noisy * 1e-2 / np.sqrt(dt)
        )
        w[k] = R_BI.T @ R_WB(middle).T @ [0, 0, turn] + b_g + rng.normal(size=3) * noisy * 1e-3 / np.sqrt(dt)

    def stamps(times: np.ndarray) -> np.ndarray:
        return T0 + np.rint(times * 1e9).astype(np.int64)

    def stream(kind, times, values, sigma):
        z = np.array([values(time) for time in times]).reshape(len(times), -1)
        sigmas = np.full((len(times), kind.residual_width), sigma)
        if noisy and kind is not AttitudeStream:
            z = z + rng.normal(size=z.shape) * sigma
        return kind(stamps(times), stamps(times), z, sigmas)

    def p_W(time: float) -> np.ndarray:
        steps = np.linspace(0, time, 201)
        p = np.trapezoid([v_W(s) for s in steps], steps, axis=0)
        return np.add(p, [0, 0, -4.0])

    def sensor_yaw(time: float) -> float:
        x = R_WB(time) @ mountings["heading"].R_BS[:, 0]
        return float(np.arctan2(x[1], x[0]))

    slow = np.arange(0.25, 5, 0.5)
    log = Log(
        "x",
        rig,
        ImuStream(stamps(t), w, f),
        dvl=stream(DvlStream, slow, lambda s: R_WB(s).T @ v_W(s), 0.02),
        depth=stream(DepthStream, slow, lambda s: (p_W(s) + R_WB(s) @ mountings["depth"].p_BS_B)[2], 0.01),
        gps=stream(GpsStream, slow, lambda s: p_W(s) + R_WB(s) @ mountings["gps"].p_BS_B, 1.0),
        heading=stream(HeadingStream, slow, sensor_yaw, 0.03),
    )
    return log, NavState(R_WB(2.0), p_W(2.0), v_W(2.0), b_a, b_g), T0 + 2_000_000_000


@pytest.mark.parametrize("seed", range(8))
def test_without_noise_the_prior_is_the_state_at_the_end_of_the_window(seed):
    log, state, t_ns = voyage(seed, noisy=False)
    belief = initialise(log).belief
    assert belief.t_ns == t_ns
    error = belief.state.local(state)
    np.testing.assert_allclose(error[THETA], 0, atol=3e-3)
    np.testing.assert_allclose(error[VELOCITY], 0, atol=2e-2)
    np.testing.assert_allclose(error[POSITION], 0, atol=0.05)


@pytest.mark.parametrize("drop", [(), ("gps",)])
def test_its_errors_are_covered_by_its_covariance(drop):
    nees = []
    for seed in range(60):
        log, state, _ = voyage(seed, noisy=True)
        log = replace(log, **dict.fromkeys(drop))
        belief = initialise(log).belief
        error = belief.state.local(state)
        assert np.linalg.eigvalsh(belief.P).min() > 0
        nees.append(error @ np.linalg.solve(belief.P, error))
    # an upper bound only: it allows for accelerations that this voyage does not have
    assert sum(nees) < chi2.ppf(0.999, 15 * 60)
    assert sum(nees) > 0.2 * 15 * 60


@pytest.mark.parametrize("seed", range(4))
def test_an_accelerometer_bias_tilts_the_level_as_the_covariance_says(seed):
    log, state, _ = voyage(seed, noisy=False)
    b_a = np.random.default_rng(seed).normal(size=3) * 0.05
    biased = initialise(replace(log, imu=replace(log.imu, f_I=log.imu.f_I + b_a))).belief
    before = initialise(log).belief.state.local(state)
    moved = biased.state.local(state) - before
    for part in (THETA, VELOCITY):
        expected = biased.P[part, ACCEL_BIAS] @ np.linalg.solve(biased.P[ACCEL_BIAS, ACCEL_BIAS], b_a)
        assert np.linalg.norm(moved[THETA]) > 1e-3
        np.testing.assert_allclose(moved[part], expected, atol=0.1 * np.linalg.norm(moved[part]) + 2e-4)


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_heading_turns_the_velocity_as_the_covariance_says(seed):
    log, state, _ = voyage(seed, noisy=False)
    assert log.heading is not None
    wrong = initialise(replace(log, heading=replace(log.heading, z=log.heading.z + 0.03))).belief
    moved = wrong.state.local(state) - initialise(log).belief.state.local(state)
    expected = wrong.P[VELOCITY, THETA] @ np.linalg.solve(wrong.P[THETA, THETA], moved[THETA])
    assert np.linalg.norm(moved[THETA]) > 0.02
    np.testing.assert_allclose(moved[VELOCITY], expected, atol=0.1 * np.linalg.norm(moved[VELOCITY]) + 1e-4)


def test_its_readings_are_not_in_the_epochs_that_follow():
    log, _, _ = voyage(1, noisy=True)
    belief = initialise(log).belief
    epochs = cut(log.with_prior(belief)).epochs
    assert min(int(e.readings["t_ns"].min()) for e in epochs if len(e.readings)) > belief.t_ns
    assert epochs[0].imu["t_ns"][0] > belief.t_ns


def test_what_no_sensor_tells_is_wide_and_said():
    log, _, _ = voyage(2, noisy=True)
    bare = initialise(Log("x", log.rig, log.imu))
    sigma = np.sqrt(np.diag(bare.belief.P))
    R_WB = bare.belief.state.R_WB
    yaw_sigma = np.sqrt((R_WB @ bare.belief.P[THETA, THETA] @ R_WB.T)[2, 2])
    assert yaw_sigma == pytest.approx(np.pi / np.sqrt(3), rel=1e-3)
    assert (sigma[VELOCITY] > 1).all()
    assert sigma[POSITION][2] > 1
    np.testing.assert_allclose(sigma[GYRO_BIAS], NOISE.gyro_bias_sigma, rtol=1e-6)
    for word in ("heading unknown", "velocity unknown", "height unknown"):
        assert any(word in note for note in bare.notes)


def test_a_full_attitude_gives_the_heading_too():
    log, state, _ = voyage(3, noisy=False)
    assert log.heading is not None
    R_BH = log.rig.heading.R_BS
    times = (log.heading.t_ns - T0) * 1e-9
    turn = Rotation.from_rotvec(np.outer(times - 2.0, [0, 0, 1]) * _rate(log)).as_matrix()
    z = (turn @ state.R_WB @ R_BH).reshape(-1, 9)
    attitude = AttitudeStream(log.heading.t_ns, log.heading.received_ns, z, np.full((len(z), 3), 0.01))
    error = initialise(replace(log, heading=attitude)).belief.state.local(state)
    np.testing.assert_allclose(error[THETA], 0, atol=3e-3)


def _rate(log: Log) -> float:
    w_B = log.rig.imu.R_BS @ log.imu.w_WI_I[0]
    f_B = log.rig.imu.R_BS @ log.imu.f_I[0]
    return float(np.sign(w_B @ f_B) * np.linalg.norm(w_B))


def test_the_window_waits_for_a_slow_heading_sensor():
    log, _, _ = voyage(4, noisy=False)
    assert log.heading is not None
    late = HeadingStream(*(getattr(log.heading, k)[6:] for k in ("t_ns", "received_ns", "z", "sigma")))
    made = initialise(replace(log, heading=late))
    assert made.belief.t_ns >= late.received_ns[0]
    assert any("heading from 1 readings" in note for note in made.notes)


def test_only_what_was_received_in_the_window_is_used():
    log, _, _ = voyage(5, noisy=False)
    assert log.dvl is not None
    far = replace(log, dvl=replace(log.dvl, received_ns=log.dvl.t_ns + 60_000_000_000))
    assert any("no DVL heard" in note for note in initialise(far).notes)
