"""The prior comes from the log's first seconds, and its covariance covers its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.datasets import ImuNoise, Log, Mounting, Rig
from fathom.datasets.epochs import cut
from fathom.datasets.log import AttitudeStream, DepthStream, DvlStream, GpsStream, HeadingStream, ImuStream
from fathom.datasets.mounting import MountingSpec
from fathom.datasets.simulated.faults import HeadingFaults
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import GpsSpec, HeadingSpec
from fathom.datasets.state import ACCEL_BIAS, GYRO_BIAS, POSITION, THETA, VELOCITY, NavState
from fathom.datasets.trajectory import Trajectory
from fathom.estimators.alignment.initial_state import second_order
from fathom.estimators.alignment.initialise import initialise
from fathom.estimators.alignment.rest import heading_rate, is_at_rest, is_quiet
from fathom.estimators.alignment.window import Window
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
        lever_W = R_WB(middle) @ mountings["imu"].p_BS_B
        a_W = a_W - turn**2 * lever_W * [1, 1, 0]  # of the IMU
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


@pytest.mark.parametrize("seed", range(4))
def test_an_accelerometer_bias_tilts_the_level_as_the_covariance_predicts(seed):
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
def test_a_wrong_heading_turns_the_velocity_as_the_covariance_predicts(seed):
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


def test_what_no_sensor_measures_has_a_large_sigma_and_a_note():
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
    assert any("no DVL readings" in note for note in initialise(far).notes)


# -- on simulated logs, afloat ----------------------------------------------------------------------------------------

AFLOAT = Scenario(mission="transit", duration_s=20, depth_m=0.01)


def path(seed: int, rest_s: float, m_s2: float | None = None) -> Trajectory:
    """Straight ahead on a random course, a little banked: at rest, then smoothly to 1.5 m/s; or ever faster."""
    rng = np.random.default_rng(seed)
    t = np.arange(-1.0, 21.0, 0.1)
    share = np.clip((t - rest_s) / 6.0, 0, 1)
    speed = 1.5 * (10 * share**3 - 15 * share**4 + 6 * share**5) if m_s2 is None else m_s2 * (t + 1)
    course, (roll, pitch) = rng.uniform(-3, 3), rng.uniform(-0.1, 0.1, 2)
    way = np.cumsum(speed) * 0.1
    p_WB_W = np.outer(way - np.interp(0, t, way), [np.cos(course), np.sin(course), 0])
    p_WB_W[:, 2] = -0.1
    R_WB = np.repeat(Rotation.from_euler("ZYX", [course, pitch, roll]).as_matrix()[None], len(t), axis=0)
    return Trajectory(np.rint((t + 1) * 1e9).astype(np.int64), R_WB, p_WB_W)


def afloat(seed: int, motion: Trajectory | None = None, **dials: object) -> Log:
    """A log without a prior; a compass errs by its sigma, and evenly so, beside its noise."""
    bias_deg = float(np.random.default_rng(900 + seed).normal()) * float(dials.get("noise_scale", 1.0))
    dials = {"heading": HeadingSpec(faults=HeadingFaults(bias_deg=bias_deg))} | dials
    if motion is not None:
        dials |= {"mission": "recorded"}
    return replace(simulate(replace(AFLOAT, **dials), seed, motion), prior=None)


def truth_of(log: Log, t_ns: int) -> NavState:
    row = int(np.searchsorted(log.truth.t_ns, t_ns))
    assert log.truth.t_ns[row] == t_ns
    return log.truth.state(row)


def error_of(log: Log) -> tuple[np.ndarray, np.ndarray, str]:
    """Error of the start and its covariance, and how it was got.

    Attitude is in W axes. What its error does to the velocity is taken off: where the heading is known to
    5°, the velocity lies on an arc, and NEES in W is not chi-square; docs/conventions.md (39).
    """
    made, G = initialise(log), np.eye(15)
    state, truth = made.belief.state, truth_of(log, made.belief.t_ns)
    G[THETA, THETA] = state.R_WB
    G[VELOCITY, THETA] = np.cross(state.v_WB_W, state.R_WB.T).T
    error = G @ state.local(truth)
    error[VELOCITY] = truth.v_WB_W - truth.R_WB @ state.R_WB.T @ state.v_WB_W
    return error, G @ made.belief.P @ G.T, made.start


PARTS = {
    "tilt": [0, 1],
    "yaw": [2],
    "place": [3, 4],
    "height": [5],
    "velocity": [6, 7, 8],
    "accel bias": [9, 10, 11],
    "gyro bias": [12, 13, 14],
    "all": range(15),
}
CAUTIOUS = {"yaw", "height", "velocity", "all"}
"""A compass is believed to its sigma and a degree more, the median of three depths no more than one; the yaw turns the
velocity, which at its best is known as well as that."""
STARTS = {
    "moving": (lambda seed: afloat(seed), set()),
    "moving, ever faster": (lambda seed: afloat(seed, path(seed, 0.0, 0.3)), set()),
    # at rest a vehicle may sway by 1 cm/s, and the Earth's rate may stand along any axis of the gyro: here it does not
    "static": (lambda seed: afloat(seed, path(seed, 15.0), latitude_deg=45.0), {"velocity", "gyro bias"}),
    "moving, heading by GPS": (lambda seed: afloat(seed, heading=None), set()),
    # nobody sees that this vehicle does not accelerate; and it may by 0.1 m/s²
    "moving, no DVL": (lambda seed: afloat(seed, dvl=None), {"tilt"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_the_covariance_of_a_start_is_that_of_its_errors(start):
    make, wide = STARTS[start]
    squares: dict[str, list[float]] = {part: [] for part in PARTS}
    for seed in range(50):
        error, P, found = error_of(make(seed))
        assert found == ("moving" if start in ("moving, ever faster", "moving, no DVL") else start)
        assert np.linalg.eigvalsh(P).min() > 0
        for part, rows in PARTS.items():
            squares[part].append(error[rows] @ np.linalg.solve(P[np.ix_(rows, rows)], error[rows]))
    for part, rows in PARTS.items():
        low, high = chi2.interval(0.999, 50 * len(rows))
        assert sum(squares[part]) < high, part
        if part not in CAUTIOUS | wide:
            assert sum(squares[part]) > low, part
        elif part not in wide:
            assert sum(squares[part]) > 0.25 * 50 * len(rows), part  # twice the sigma


def test_a_start_covers_its_errors():
    """The same of a few seeds, in little time."""
    squares = []
    for seed in range(100, 106):
        error, P, _ = error_of(afloat(seed))
        squares.append(error @ np.linalg.solve(P, error))
    assert 0.2 * 15 * 6 < sum(squares) < chi2.ppf(0.9999, 15 * 6)


@pytest.mark.parametrize("imu", ["consumer", "tactical"])
def test_at_rest_the_gyro_shows_its_bias(imu):
    log = afloat(3, path(3, 15.0), imu=imu)
    error, P, start = error_of(log)
    sigma = np.sqrt(np.diag(P))
    assert start == "static"
    assert (np.abs(error[GYRO_BIAS]) < 3 * sigma[GYRO_BIAS]).all()
    assert (sigma[GYRO_BIAS] < 8.5e-5).all()  # the Earth's rate, and the noise of ten seconds
    assert np.abs(initialise(log).belief.state.v_WB_W).max() < 0.03


def test_a_static_start_ends_before_the_vehicle_leaves():
    made = initialise(afloat(4, path(4, 5.0)))
    assert made.start == "static"
    assert 2.0 <= made.belief.t_ns * 1e-9 <= 6.0
    assert any("at rest" in note for note in made.notes)


def test_a_quiet_imu_is_at_rest_only_if_others_say_so():
    log = afloat(5, path(5, 15.0))
    end_ns = 8_000_000_000
    assert is_quiet(log, 0, end_ns)
    assert is_at_rest(log, 0, end_ns)
    assert is_at_rest(replace(log, heading=None), 0, end_ns)
    assert log.dvl is not None
    assert log.heading is not None
    # steady way, which no accelerometer sees
    z = log.dvl.z + np.array([0.1, 0, 0])
    assert not is_at_rest(replace(log, dvl=replace(log.dvl, z=z)), 0, end_ns)
    # a slow even turn, which the gyro's bias happens to cancel: only the compass sees it
    turned = replace(log, heading=replace(log.heading, z=log.heading.z + 0.01 * log.heading.t_ns[:, None] * 1e-9))
    rate, sigma = heading_rate(turned, 0, end_ns)
    assert abs(rate - 0.01) < 4 * sigma
    assert not is_at_rest(turned, 0, end_ns)
    # nobody to say so, or nobody who can
    assert not is_at_rest(replace(log, dvl=None, gps=None), 0, end_ns)
    poor = replace(log, dvl=replace(log.dvl, sigma=np.full(log.dvl.sigma.shape, 3.0)))
    assert not is_at_rest(poor, 0, end_ns)


@pytest.mark.parametrize("where", ["gyro", "accel"])
def test_an_imu_that_shakes_is_not_at_rest(where):
    log = afloat(6, path(6, 15.0))
    shaking = np.sin(2 * np.pi * 0.3 * log.imu.t_ns * 1e-9)[:, None] * (0.002 if where == "gyro" else 0.02)
    name = {"gyro": "w_WI_I", "accel": "f_I"}[where]
    moved = replace(log, imu=replace(log.imu, **{name: getattr(log.imu, name) + shaking}))
    assert not is_at_rest(moved, 0, 8_000_000_000)
    assert initialise(moved).start == "moving"


def test_a_vehicle_that_gathers_way_is_level_where_a_dvl_sees_it():
    log = afloat(7, path(7, 0.0, 0.3), noise_scale=0.0)
    with_dvl, without = error_of(log)[0], error_of(replace(log, dvl=None, gps=None))[0]
    assert np.degrees(np.abs(with_dvl[:2]).max()) < 0.1
    assert np.degrees(np.abs(without[:2]).max()) > 1.0  # of 1.75: 0.3 m/s² for gravity


def test_the_track_lays_itself_onto_the_fixes_with_its_lever_arm():
    dials = {"heading": None, "noise_scale": 0.0, "mission": "box", "leg_m": 6.0, "turn_radius_m": 4.0}
    log = afloat(8, gps=replace(AFLOAT.gps, mounting=MountingSpec((2.0, 1.0, 0.5))), **dials)
    error, P, start = error_of(log)
    assert start == "moving, heading by GPS"
    assert np.sqrt(P[2, 2]) < np.radians(5.0)
    assert abs(np.degrees(error[2])) < 0.5
    np.testing.assert_allclose(error[POSITION], 0, atol=0.05)
    wrong = replace(log, rig=replace(log.rig, gps=Mounting()))
    assert abs(np.degrees(error_of(wrong)[0][2])) > 1.0


def test_fixes_that_do_not_fit_the_track_are_believed_less():
    log = afloat(9, heading=None)
    assert log.gps is not None
    rough = log.gps.z + np.random.default_rng(0).normal(size=log.gps.z.shape) * [6.0, 6.0, 0.0]
    made = initialise(replace(log, gps=replace(log.gps, z=rough)))
    if made.start == "moving, heading by GPS":
        assert any("sigma stretched" in note for note in made.notes)
    else:
        assert made.start == "moving, heading unknown"


@pytest.mark.parametrize(("dials", "start"), [({"speed_m_s": 0.05}, "moving"), ({"gps": None}, "moving")])
def test_without_a_track_under_gps_the_heading_is_unknown(dials, start):
    made = initialise(afloat(10, heading=None, **dials))
    assert made.start == f"{start}, heading unknown"
    R_WB, P = made.belief.state.R_WB, made.belief.P
    assert np.sqrt((R_WB @ P[THETA, THETA] @ R_WB.T)[2, 2]) == pytest.approx(np.pi / np.sqrt(3), rel=1e-3)


def test_at_rest_without_a_heading_sensor_the_heading_is_unknown():
    assert initialise(afloat(11, path(11, 15.0), heading=None)).start == "static, heading unknown"


def test_without_a_dvl_the_fixes_tell_the_velocity():
    log = afloat(12, dvl=None, noise_scale=0.0, gps=GpsSpec(horizontal_sigma_m=0.1))
    made, (error, _, _) = initialise(log), error_of(log)
    np.testing.assert_allclose(error[VELOCITY], 0, atol=0.06)
    assert (np.sqrt(np.diag(made.belief.P)[VELOCITY])[:2] < 0.5).all()
    assert any("velocity from" in note and "fixes" in note for note in made.notes)


def test_a_dvl_reading_that_lies_far_out_is_left_out():
    log = afloat(13)
    assert log.dvl is not None
    z = log.dvl.z.copy()
    z[4] += [4.0, -2.0, 1.0]
    before, after = (initialise(each).belief for each in (log, replace(log, dvl=replace(log.dvl, z=z))))
    moved = before.state.local(after.state)
    assert (np.abs(moved) < 1.5 * np.sqrt(np.diag(before.P))).all()


def test_a_window_knows_what_biases_do_to_it():
    log, _, _ = voyage(14, noisy=True)
    b_a, b_g = np.array([0.02, -0.03, 0.01]), np.array([2e-4, -1e-4, 3e-4])
    less = replace(log, imu=replace(log.imu, f_I=log.imu.f_I - b_a, w_WI_I=log.imu.w_WI_I - b_g))
    start_ns, end_ns = T0, int(log.imu.t_ns[149])
    window, other = (Window.of(each, start_ns, end_ns) for each in (log, less))
    for k in (0, 40, 150):
        turned = Rotation.from_matrix(other.R_EB[k] @ window.R_EB[k].T).as_rotvec()
        np.testing.assert_allclose(turned, window.turn[k] @ b_g, atol=2e-6)
        pushed = other.push[k] - window.push[k]
        np.testing.assert_allclose(pushed, -window.held[k] @ b_a + window.push_bg[k] @ b_g, atol=1e-4)
        assert k == 150 or np.linalg.norm(window.push_bg[k] @ b_g) > 1e-3 * window.left_s[k]
    v_B = np.random.default_rng(1).normal(size=(len(window.t_ns), 3))
    (way, by_gyro), (other_way, _) = window.way(v_B), other.way(v_B)
    np.testing.assert_allclose(other_way - way, by_gyro @ b_g, atol=2e-6)


def test_what_is_of_second_order_in_a_velocity_is_as_many_draws_say():
    rng = np.random.default_rng(15)
    A, B, v_B = 0.05 * rng.normal(size=(3, 3)), 0.3 * rng.normal(size=(3, 3)), np.array([1.5, 0.2, -0.1])
    theta, e = rng.normal(size=(200_000, 3)) @ A.T, rng.normal(size=(200_000, 3)) @ B.T
    of = np.cross(theta, e) + 0.5 * np.cross(theta, np.cross(theta, v_B))
    found = second_order(v_B, B @ B.T, A @ A.T)
    np.testing.assert_allclose(found, of.T @ of / len(of), atol=0.02 * np.abs(found).max())


def test_fixes_give_the_velocity_in_the_world_at_any_heading():
    log = afloat(16, dvl=None, heading=None)
    made = initialise(log)
    sigma = np.sqrt(np.diag(made.belief.P)[VELOCITY])
    assert made.start == "moving, heading unknown"
    assert (sigma[:2] < 0.5).all()
    assert (np.abs(made.belief.state.local(truth_of(log, made.belief.t_ns))[VELOCITY]) < 3.5 * sigma).all()
