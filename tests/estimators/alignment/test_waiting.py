"""A start waits for heading and velocity, holds no gap of the IMU, and says what it left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.datasets import Log
from fathom.datasets.errors import DatasetError
from fathom.datasets.log import AttitudeStream, DvlStream, ImuStream, ReadingStream
from fathom.datasets.notes import Note
from fathom.datasets.rig import ImuNoise, Mounting, Rig
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import GpsSpec
from fathom.datasets.state import POSITION, THETA
from fathom.estimators.alignment.initialise import Initialisation, initialise
from fathom.estimators.alignment.rest import heading_rate
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def log() -> Log:
    return replace(simulate(Scenario(duration_s=40.0), seed=3), prior=None)


def with_imu(log: Log, keep: np.ndarray, early_ns: np.ndarray | int = 0) -> Log:
    imu = log.imu
    return replace(log, imu=ImuStream((imu.t_ns - early_ns)[keep], imu.w_WI_I[keep], imu.f_I[keep]))


def after(log: Log, begin_s: float, *sensors: str) -> Log:
    """The log with nothing from these sensors up to begin_s."""

    def late(stream: ReadingStream) -> ReadingStream:
        keep = stream.t_ns > begin_s * SECOND
        return type(stream)(stream.t_ns[keep], stream.received_ns[keep], stream.z[keep], stream.sigma[keep])

    return replace(log, **{sensor: late(log.streams[sensor]) for sensor in sensors})


def told(made: Initialisation) -> list[Note]:
    return [note for note in made.notes if isinstance(note, Note) and note.kind == "start"]


def error_in_sigmas(log: Log, made: Initialisation) -> float:
    """Squared error of the whole state over chi-square's 0.9999 quantile."""
    assert log.truth is not None
    row = int(np.searchsorted(log.truth.t_ns, made.belief.t_ns))
    error = made.belief.state.local(log.truth.state(row))
    return float(error @ np.linalg.solve(made.belief.P, error) / chi2.ppf(0.9999, len(error)))


# --- gaps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("samples", "early_s"), [(1, 5), (1, 60), (20, 60), (1, 30_000_000), (150, 3)])
def test_stale_first_stamps_are_left_out_and_told(log: Log, samples: int, early_s: int) -> None:
    n = len(log.imu.t_ns)
    early_ns = np.where(np.arange(n) < samples, early_s * SECOND, 0)
    made = initialise(with_imu(log, np.ones(n, bool), early_ns))
    alone = initialise(with_imu(log, np.arange(n) >= samples))
    assert made.belief.t_ns == alone.belief.t_ns
    assert np.array_equal(made.belief.state.R_WB, alone.belief.state.R_WB)
    assert made.start == "moving, begun late"
    (note,) = told(made)
    assert note.stream == "imu"
    assert note.count == samples
    assert note.seconds == pytest.approx(early_s, abs=3)


def test_a_short_gap_in_the_window_moves_the_start_behind_it(log: Log) -> None:
    made = initialise(with_imu(log, (np.arange(len(log.imu.t_ns)) // 30) != 3))
    assert made.belief.t_ns == pytest.approx(3.2 * SECOND, abs=0.02 * SECOND)
    assert made.start == "moving, begun late"


def test_a_gap_that_is_bridged_after_the_window_leaves_the_start_alone(log: Log) -> None:
    gappy = with_imu(log, (np.arange(len(log.imu.t_ns)) // 50) != 16)
    assert initialise(gappy).belief.t_ns == initialise(log).belief.t_ns


def test_without_a_window_free_of_gaps_there_is_no_start(log: Log) -> None:
    with pytest.raises(DatasetError, match=r"a gap of more than 0\.1 s, and there are none in the first 39\.8 s"):
        initialise(with_imu(log, np.arange(len(log.imu.t_ns)) % 100 > 20))


def test_a_log_shorter_than_the_window_has_no_start(log: Log) -> None:
    with pytest.raises(DatasetError, match=r"there are none in the first 1\.5 s"):
        initialise(with_imu(log, np.arange(len(log.imu.t_ns)) < 150))


# --- sensors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sensors", [("dvl", "depth", "gps", "heading"), ("dvl",), ("heading",)], ids=lambda sensors: "-".join(sensors)
)
def test_a_start_waits_for_heading_and_velocity(log: Log, sensors: tuple[str, ...]) -> None:
    late = after(log if "gps" in sensors else replace(log, gps=None), 20.0, *sensors)
    made = initialise(late)
    assert 20 * SECOND < made.belief.t_ns < 22 * SECOND
    assert made.start == "moving, begun late"
    assert {note.stream for note in told(made)} == set(sensors) & {"dvl", "heading"}
    assert error_in_sigmas(late, made) < 1


def test_gps_gives_the_heading_before_a_sensor_that_is_slow() -> None:
    exact = simulate(Scenario(duration_s=40.0, gps=GpsSpec(horizontal_sigma_m=0.3)), seed=3)
    made = initialise(after(exact, 25.0, "heading"))
    assert made.start == "moving, heading by GPS"
    assert made.belief.t_ns < 25 * SECOND


def test_gps_gives_the_velocity_before_a_dvl_that_is_slow(log: Log) -> None:
    made = initialise(after(log, 25.0, "dvl"))
    assert made.start == "moving"
    assert made.belief.t_ns < 11 * SECOND


@pytest.mark.parametrize("where", ["argument", "log"])
def test_no_start_comes_after_max_wait(log: Log, where: str) -> None:
    late = after(replace(log, gps=None, max_wait_s=15.0 if where == "log" else None), 20.0, "dvl")
    with pytest.raises(DatasetError, match=r"first reading of dvl at 20\.\d s comes after max_wait_s \(15 s\)"):
        initialise(late, max_wait_s=15.0 if where == "argument" else None)


def test_a_dvl_without_lock_has_not_spoken(log: Log) -> None:
    assert log.dvl is not None
    sigma = np.where(log.dvl.t_ns[:, None] < 12 * SECOND, np.inf, log.dvl.sigma)
    made = initialise(replace(log, gps=None, dvl=replace(log.dvl, sigma=sigma)))
    assert 12 * SECOND <= made.belief.t_ns < 13 * SECOND


def test_the_way_before_the_first_velocity_is_not_known(log: Log) -> None:
    dead = replace(log, gps=None)
    sigma_m = [np.sqrt(initialise(one).belief.P[POSITION, POSITION][0, 0]) for one in (dead, after(dead, 9.0, "dvl"))]
    assert sigma_m[0] < 0.6
    assert sigma_m[1] > 1.0


def test_what_is_never_known_is_told(log: Log) -> None:
    made = initialise(replace(log, gps=None, heading=None, dvl=None))
    assert made.start == "moving, heading unknown, velocity unknown"
    assert {note.stream for note in told(made)} == {"heading", "dvl"}


# --- nose up ---------------------------------------------------------------------------------------------------------


def profiler(seed: int, pitch_deg: float, sigma_rad: np.ndarray) -> tuple[Log, np.ndarray]:
    """Six seconds ahead, wobbling about a fixed pitch, with a full attitude; and R_WB (n, 3, 3) at 100 Hz."""
    rng, n, h = np.random.default_rng(seed), 600, 0.01
    base = Rotation.from_euler("ZYX", [40.0, pitch_deg, 0.0], degrees=True)

    def R_WB(t: np.ndarray) -> Rotation:
        wobble = np.stack([np.sin(2 * np.pi * t / period) for period in (9, 7, 11)], axis=1)
        return base * Rotation.from_rotvec(np.radians(2) * wobble)

    t = (np.arange(n) + 1) * h
    v_B = np.array([0.5, 0.0, 0.0])
    w = (R_WB(t - h).inv() * R_WB(t)).as_rotvec() / h
    a_W = (R_WB(t).apply(v_B) - R_WB(t - h).apply(v_B)) / h
    f = R_WB(t - h / 2).inv().apply(a_W + np.array([0, 0, 9.81])) + rng.normal(size=3) * 7e-3
    stamps, every = np.rint(t * 1e9).astype(np.int64), slice(19, None, 20)
    R = R_WB(t).as_matrix()
    bias = Rotation.from_rotvec(rng.normal(size=3) * sigma_rad)  # its errors do not average out
    z = (Rotation.from_matrix(R[every]) * bias).as_matrix().reshape(-1, 9)
    k = len(z)
    heading = AttitudeStream(stamps[every], stamps[every], z, np.tile(sigma_rad, (k, 1)))
    dvl = DvlStream(stamps[every], stamps[every], v_B + rng.normal(size=(k, 3)) * 0.005, np.full((k, 3), 0.005))
    rig = Rig(ImuNoise(4.4e-5, 1e-3, 1.3e-7, 2.7e-5, 4.8e-5, 7.4e-3), Mounting())
    return Log("profiler", rig, ImuStream(stamps, w, f), dvl=dvl, heading=heading), R


@pytest.mark.parametrize("pitch_deg", [0.0, -85.0, -90.0, 90.0])
def test_a_full_attitude_counts_with_its_covariance_nose_up_too(pitch_deg: float) -> None:
    sigma_rad, squares = np.array([0.03, 0.03, 0.03]), []
    for seed in range(8):
        log, R = profiler(seed, pitch_deg, sigma_rad)
        belief = initialise(log).belief
        error = Rotation.from_matrix(
            belief.state.R_WB.T @ R[int(np.searchsorted(log.imu.t_ns, belief.t_ns))]
        ).as_rotvec()
        squares.append(error @ np.linalg.solve(belief.P[THETA, THETA], error))
        assert np.degrees(np.sqrt(np.trace(belief.P[THETA, THETA]))) < 3.0
    low, high = chi2.interval(0.999, 3 * len(squares))
    assert 0.5 * low < sum(squares) < high


def test_an_attitude_turns_about_any_axis() -> None:
    log, _ = profiler(1, -90.0, np.full(3, 1e-3))
    assert log.heading is not None
    rate, sigma = heading_rate(log, 0, 3 * SECOND)
    assert rate > 5 * sigma
    assert rate > 0.005
