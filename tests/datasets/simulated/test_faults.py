"""Every fault does what its dial says, to its own sensor, and to nothing else; the rig does not know."""

import dataclasses
import json

import numpy as np
import pytest
from fathom.datasets import DatasetError, Log
from fathom.datasets.epochs import cut
from fathom.datasets.mounting import MountingSpec
from fathom.datasets.simulated.faults import DepthFaults, DvlFaults, GpsFaults, HeadingFaults, ImuFaults
from fathom.datasets.simulated.missions import fly
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, GpsSpec, HeadingSpec, ImuSpec
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from variances import assert_variance

SENSORS = ("dvl", "depth", "gps", "heading")
SPEC = {"dvl": DvlSpec, "depth": DepthSpec, "gps": GpsSpec, "heading": HeadingSpec}
FAULTS = {"dvl": DvlFaults, "depth": DepthFaults, "gps": GpsFaults, "heading": HeadingFaults}
OUTLIER = {"dvl": "outlier_m_s", "depth": "outlier_m", "gps": "outlier_m", "heading": "outlier_deg"}
ALWAYS_AFLOAT = MountingSpec((-0.25, 0.1, 50.0))


def with_faults(sensor: str | None, noise_scale: float = 1.0, duration_s: float = 120, **faults) -> Log:
    """A log whose sensors all read at 10 Hz, with faults of one of them."""
    values = {s: SPEC[s](rate_hz=10, faults=FAULTS[s](**(faults if s == sensor else {}))) for s in SENSORS}
    if sensor == "imu":
        values["imu"] = ImuSpec(faults=ImuFaults(**faults))
    values["gps"] = dataclasses.replace(values["gps"], mounting=ALWAYS_AFLOAT)
    return simulate(Scenario(duration_s=duration_s, noise_scale=noise_scale, **values), 11)


def imu_and(log: Log, sensor: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of one sensor, the IMU's as (f, w)."""
    if sensor == "imu":
        return log.imu.t_ns, np.hstack([log.imu.f_I, log.imu.w_WI_I])
    return log.streams[sensor].t_ns, log.streams[sensor].z


def assert_only(log: Log, clean: Log, sensor: str) -> None:
    """Nothing but this sensor's stream differs between the logs, and the rig does not say so."""
    for other in ("imu", *SENSORS):
        if other != sensor:
            for a, b in zip(imu_and(log, other), imu_and(clean, other), strict=True):
                assert np.array_equal(a, b), other
    assert np.array_equal(log.truth.p_WB_W, clean.truth.p_WB_W)
    assert np.array_equal(log.prior.state.p_WB_W, clean.prior.state.p_WB_W)
    for mounting in ("imu", "depth", "gps", "heading"):
        assert np.array_equal(getattr(log.rig, mounting).R_BS, getattr(clean.rig, mounting).R_BS)
        assert np.array_equal(getattr(log.rig, mounting).p_BS_B, getattr(clean.rig, mounting).p_BS_B)
    assert log.rig.imu_noise == clean.rig.imu_noise


def wrapped(z: np.ndarray, sensor: str) -> np.ndarray:
    return np.arctan2(np.sin(z), np.cos(z)) if sensor == "heading" else z


CLEAN = {}


def clean(noise_scale: float = 1.0) -> Log:
    if noise_scale not in CLEAN:
        CLEAN[noise_scale] = with_faults(None, noise_scale)
    return CLEAN[noise_scale]


# -- faults of any sensor


@pytest.mark.parametrize("sensor", ["imu", *SENSORS])
def test_dropouts_take_the_stated_share_and_leave_the_rest(sensor):
    log = with_faults(sensor, dropout_probability=0.2)
    (t_ns, z), (all_ns, all_z) = imu_and(log, sensor), imu_and(clean(), sensor)
    low, high = binom.interval(0.999, len(all_ns), 0.8)
    assert low <= len(t_ns) <= high
    left = np.isin(all_ns, t_ns)
    assert np.array_equal(z, all_z[left])
    assert_only(log, clean(), sensor)
    fewer = imu_and(with_faults(sensor, dropout_probability=0.05), sensor)[0]
    assert set(t_ns) < set(fewer)  # a higher probability takes those of the lower, and more


@pytest.mark.parametrize("sensor", ["imu", *SENSORS])
def test_an_outage_is_silent_from_its_begin_to_its_end(sensor):
    log = with_faults(sensor, outages_s=((10, 20.5), (50, 50.1)))
    (t_ns, z), (all_ns, all_z) = imu_and(log, sensor), imu_and(clean(), sensor)
    silent = ((all_ns >= 10_000_000_000) & (all_ns <= 20_500_000_000)) | (
        (all_ns >= 50_000_000_000) & (all_ns <= 50_100_000_000)
    )
    assert np.array_equal(t_ns, all_ns[~silent])
    assert np.array_equal(z, all_z[~silent])
    assert silent.sum() > 100
    assert_only(log, clean(), sensor)


@pytest.mark.parametrize("sensor", SENSORS)
def test_outliers_have_the_stated_share_and_size(sensor):
    log = with_faults(sensor, outlier_probability=0.1, **{OUTLIER[sensor]: 7.0})
    size = np.radians(7.0) if sensor == "heading" else 7.0
    error = wrapped(log.streams[sensor].z - clean().streams[sensor].z, sensor)
    hit = error.any(axis=1)
    low, high = binom.interval(0.999, len(hit), 0.1)
    assert low <= hit.sum() <= high
    assert_variance(error[hit], size)
    assert np.array_equal(log.streams[sensor].sigma, clean().streams[sensor].sigma)  # nobody says so
    assert_only(log, clean(), sensor)


def test_imu_outliers_have_the_stated_share_and_sizes():
    log = with_faults("imu", outlier_probability=0.05, gyro_outlier_deg_s=10, accel_outlier_m_s2=3)
    error = imu_and(log, "imu")[1] - imu_and(clean(), "imu")[1]
    hit = np.abs(error).max(axis=1) > 1e-9
    low, high = binom.interval(0.999, len(hit), 0.05)
    assert low <= hit.sum() <= high
    assert_variance(error[hit], np.repeat([3, np.radians(10)], 3))
    assert_only(log, clean(), "imu")


@pytest.mark.parametrize("sensor", ["imu", *SENSORS])
def test_repeated_readings_repeat_the_last_value(sensor):
    log = with_faults(sensor, repeat_probability=0.4)
    (t_ns, z), (all_ns, all_z) = imu_and(log, sensor), imu_and(clean(), sensor)
    assert np.array_equal(t_ns, all_ns)
    assert np.array_equal(z[0], all_z[0])
    again = (z[1:] == z[:-1]).all(axis=1)
    assert np.array_equal(z[1:][~again], all_z[1:][~again])
    low, high = binom.interval(0.999, len(again), 0.4)
    assert low <= again.sum() <= high
    assert (again[1:] & again[:-1]).any()  # twice in a row
    assert_only(log, clean(), sensor)


def test_a_reading_repeats_the_last_one_that_arrived():
    log = with_faults("depth", repeat_probability=0.5, dropout_probability=0.5)
    fresh = np.flatnonzero(np.diff(log.depth.z[:, 0], prepend=np.nan) != 0)
    own = np.isin(clean().depth.t_ns, log.depth.t_ns[fresh])
    assert np.array_equal(log.depth.z[fresh], clean().depth.z[own])


@pytest.mark.parametrize("offset_s", [0.35, -0.2])
@pytest.mark.parametrize("sensor", ["imu", *SENSORS])
def test_a_clock_offset_stamps_readings_later_than_they_were_true(sensor, offset_s):
    log = with_faults(sensor, noise_scale=0.0, clock_offset_s=offset_s)
    (t_ns, z), (all_ns, all_z) = imu_and(log, sensor), imu_and(clean(0.0), sensor)
    assert np.array_equal(t_ns, all_ns)
    if sensor == "imu":
        shift = round(offset_s * 100)
    else:  # at 10 Hz, 0.35 s is between two readings
        motion, mounting = fly(Scenario(duration_s=120), 11), getattr(log.rig, sensor, None)
        R_WB, p_WB_W, v_WB_W = motion.pose(t_ns * 1e-9 - offset_s)
        p = p_WB_W if mounting is None else p_WB_W + R_WB @ mounting.p_BS_B
        expected = {
            "dvl": np.einsum("nji,nj->ni", R_WB, v_WB_W),
            "depth": p[:, 2:],
            "gps": p,
            "heading": Rotation.from_matrix(R_WB @ log.rig.heading.R_BS).as_euler("ZYX")[:, :1],
        }[sensor]
        np.testing.assert_allclose(wrapped(z - expected, sensor), 0, atol=1e-9)
        late_ns = log.streams[sensor].received_ns - t_ns
        assert (late_ns == round(max(0.0, -offset_s) * 1e9)).all()
        return
    ours, theirs = (slice(shift, None), slice(None, -shift)) if shift > 0 else (slice(None, shift), slice(-shift, None))
    np.testing.assert_allclose(z[ours], all_z[theirs], atol=1e-9)
    assert_only(log, clean(0.0), sensor)


def test_reception_is_by_the_right_clock():
    """True at s, received at s + 0.5 s; the stamp says s + 0.2 s, so the way looks 0.3 s long."""
    spec = DvlSpec(delay_s=0.5, faults=DvlFaults(clock_offset_s=0.2))
    log = simulate(Scenario(duration_s=30, dvl=spec), 1)
    assert (log.dvl.received_ns - log.dvl.t_ns == 300_000_000).all()


@pytest.mark.parametrize("sensor", ["imu", *SENSORS])
def test_faults_befall_readings_independently_of_one_another(sensor):
    """Each has a stream of its own: were two to share one, the same readings would be hit."""
    p, (all_ns, all_z) = 0.3, imu_and(clean(), sensor)
    (left_ns, _), (_, spoilt), (_, stale) = (
        imu_and(with_faults(sensor, **{f"{fault}_probability": p}), sensor)
        for fault in ("dropout", "outlier", "repeat")
    )
    hit = {
        "dropout": ~np.isin(all_ns, left_ns),
        "outlier": (spoilt != all_z).any(axis=1),
        "repeat": (np.diff(stale, axis=0, prepend=0) == 0).all(axis=1),
    }
    for one, other in (("dropout", "outlier"), ("dropout", "repeat"), ("outlier", "repeat")):
        low, high = binom.interval(0.9999, len(hit[one]), p**2)
        assert low <= (hit[one] & hit[other]).sum() <= high, (one, other)


# -- where sensors really are


def point_of(log: Log, p_BS_B: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    R_WB, p_WB_W, _ = fly(Scenario(duration_s=120), 11).pose(t_s)
    return p_WB_W + R_WB @ p_BS_B


ARM = (0.3, -0.2, 0.15)


@pytest.mark.parametrize("sensor", ["depth", "gps"])
def test_a_wrong_lever_arm_moves_the_sensor_and_not_the_rig(sensor):
    log = with_faults(sensor, noise_scale=0.0, lever_arm_error_m=ARM)
    p = point_of(log, getattr(log.rig, sensor).p_BS_B + ARM, log.streams[sensor].t_ns * 1e-9)
    np.testing.assert_allclose(log.streams[sensor].z, p[:, 2:] if sensor == "depth" else p, atol=1e-9)
    assert_only(log, clean(0.0), sensor)


def test_a_dvl_off_its_place_reads_the_velocity_of_its_own_point():
    log, h = with_faults("dvl", noise_scale=0.0, lever_arm_error_m=ARM, misalignment_deg=(1, -2, 3)), 1e-3
    t_s, p = log.dvl.t_ns * 1e-9, np.array(ARM)
    v_WD_W = (point_of(log, p, t_s + h) - point_of(log, p, t_s - h)) / (2 * h)
    R_WB = fly(Scenario(duration_s=120), 11).pose(t_s)[0]
    R_BD = Rotation.from_euler("ZYX", [3, -2, 1], degrees=True).as_matrix()
    np.testing.assert_allclose(log.dvl.z, np.einsum("nji,nj->ni", R_WB @ R_BD, v_WD_W), atol=1e-6)
    assert np.abs(log.dvl.z - clean(0.0).dvl.z).max() > 0.01
    assert_only(log, clean(0.0), "dvl")


def test_an_imu_off_its_place_feels_its_own_point_and_axes():
    """The simulator of another rig, stated right, is the oracle."""
    base = Scenario(duration_s=30, noise_scale=0.0)
    faulty = simulate(
        dataclasses.replace(
            base, imu=ImuSpec(faults=ImuFaults(lever_arm_error_m=ARM, misalignment_deg=(0.5, 1.0, -2.0)))
        ),
        3,
    )
    R_BI = base.rig.imu.R_BS @ Rotation.from_euler("ZYX", [-2.0, 1.0, 0.5], degrees=True).as_matrix()
    yaw_deg, pitch_deg, roll_deg = Rotation.from_matrix(R_BI).as_euler("ZYX", degrees=True)
    really = MountingSpec(tuple(base.rig.imu.p_BS_B + ARM), roll_deg, pitch_deg, yaw_deg)
    oracle = simulate(dataclasses.replace(base, imu=ImuSpec(mounting=really)), 3)
    np.testing.assert_allclose(faulty.imu.f_I, oracle.imu.f_I, atol=1e-9)
    np.testing.assert_allclose(faulty.imu.w_WI_I, oracle.imu.w_WI_I, atol=1e-9)
    assert np.array_equal(faulty.rig.imu.R_BS, base.rig.imu.R_BS)


def test_a_turned_heading_sensor_reads_the_yaw_of_its_own_axis():
    log = with_faults("heading", noise_scale=0.0, misalignment_deg=(4, 5, 6))
    R_WB = fly(Scenario(duration_s=120), 11).pose(log.heading.t_ns * 1e-9)[0]
    R_BH = log.rig.heading.R_BS @ Rotation.from_euler("ZYX", [6, 5, 4], degrees=True).as_matrix()
    yaw = Rotation.from_matrix(R_WB @ R_BH).as_euler("ZYX")[:, :1]
    np.testing.assert_allclose(wrapped(log.heading.z - yaw, "heading"), 0, atol=1e-9)
    assert_only(log, clean(0.0), "heading")


# -- what becomes of the values


@pytest.mark.parametrize("sensor", ["dvl", "depth"])
def test_scale_multiplies_the_signal_and_not_the_noise(sensor):
    log = with_faults(sensor, scale=1.02)
    added = log.streams[sensor].z - clean().streams[sensor].z
    np.testing.assert_allclose(added, 0.02 * clean(0.0).streams[sensor].z, atol=1e-12)
    assert_only(log, clean(), sensor)


def test_imu_scale_is_one_per_axis():
    log = with_faults("imu", gyro_scale=(1.01, 1, 0.98), accel_scale=(1, 1.001, 1))
    signal = imu_and(clean(0.0), "imu")[1]
    added = imu_and(log, "imu")[1] - imu_and(clean(), "imu")[1]
    np.testing.assert_allclose(added, signal * [0, 0.001, 0, 0.01, 0, -0.02], atol=1e-12)
    assert_only(log, clean(), "imu")


@pytest.mark.parametrize(("sensor", "dial", "limit"), [("dvl", "limit_m_s", 1.4), ("depth", "limit_m", 8.0)])
def test_a_saturated_sensor_stays_at_its_limit(sensor, dial, limit):
    log = with_faults(sensor, **{dial: limit})
    assert np.array_equal(log.streams[sensor].z, np.clip(clean().streams[sensor].z, -limit, limit))
    assert np.abs(clean().streams[sensor].z).max() > limit
    assert_only(log, clean(), sensor)


def test_the_imu_saturates_axis_by_axis():
    log = with_faults("imu", gyro_limit_deg_s=4.0, accel_limit_m_s2=9.8)
    limit = np.repeat([9.8, np.radians(4.0)], 3)
    samples = imu_and(clean(), "imu")[1]
    assert np.array_equal(imu_and(log, "imu")[1], np.clip(samples, -limit, limit))
    assert (np.abs(samples) > limit).any(axis=0)[[2, 3, 4, 5]].all()
    alone = with_faults("imu", gyro_limit_deg_s=4.0)
    assert np.array_equal(alone.imu.f_I, clean().imu.f_I)


@pytest.mark.parametrize(
    ("sensor", "dials", "step"),
    [
        ("dvl", {"quantum_m_s": 0.01}, 0.01),
        ("depth", {"quantum_m": 0.05}, 0.05),
        ("gps", {"quantum_m": 0.5}, 0.5),
        ("heading", {"quantum_deg": 1.0}, np.radians(1.0)),
        ("imu", {"gyro_quantum_deg_s": 0.02, "accel_quantum_m_s2": 0.01}, np.repeat([0.01, np.radians(0.02)], 3)),
    ],
)
def test_quantised_readings_are_the_nearest_multiples(sensor, dials, step):
    log = with_faults(sensor, **dials)
    z = imu_and(log, sensor)[1]
    np.testing.assert_allclose(z / step, np.rint(z / step), atol=1e-6)
    error = wrapped(z - imu_and(clean(), sensor)[1], sensor) / step
    assert np.abs(error).max() <= 0.5 + 1e-6
    assert np.mean(error**2) == pytest.approx(1 / 12, rel=0.1)  # uniform
    assert_only(log, clean(), sensor)


def test_outliers_are_clipped_and_rounded_like_any_reading():
    log = with_faults("dvl", outlier_probability=0.5, outlier_m_s=10, limit_m_s=3.0, quantum_m_s=0.25)
    assert np.abs(log.dvl.z).max() == 3.0
    np.testing.assert_array_equal(log.dvl.z, np.rint(log.dvl.z * 4) / 4)


# -- the whole


EVERYTHING = {
    "imu": {"faults": {"dropout_probability": 0.02, "gyro_limit_deg_s": 5, "clock_offset_s": 0.01}},
    "dvl": {"delay_s": 0.1, "faults": {"outlier_probability": 0.05, "scale": 1.01, "outages_s": [[20, 30]]}},
    "depth": {"faults": {"repeat_probability": 0.1, "quantum_m": 0.002}},
    "gps": {"faults": {"outages_s": [[0, 5], [100, 120]], "lever_arm_error_m": [0.1, 0, 0]}},
    "heading": {"disorder_s": 0.5, "faults": {"misalignment_deg": [0, 0, 2], "clock_offset_s": -0.1}},
}


def test_a_log_with_every_kind_of_fault_can_be_cut_and_is_reported():
    log = simulate(Scenario.from_dict({"duration_s": 120, **EVERYTHING}), 2)
    assert cut(log).failure is None
    assert list(log.notes[3:]) == [
        "imu faults: dropout_probability 0.02, clock_offset_s 0.01, gyro_limit_deg_s 5.",
        "dvl faults: outages_s [[20, 30]], outlier_probability 0.05, scale 1.01, outlier_m_s 1.",
        "depth faults: repeat_probability 0.1, quantum_m 0.002.",
        "gps faults: outages_s [[0, 5], [100, 120]], lever_arm_error_m [0.1, 0, 0].",
        "heading faults: clock_offset_s -0.1, misalignment_deg [0, 0, 2].",
    ]
    again = simulate(Scenario.from_dict({"duration_s": 120, **EVERYTHING}), 2)
    for sensor in ("imu", *SENSORS):
        for a, b in zip(imu_and(log, sensor), imu_and(again, sensor), strict=True):
            assert np.array_equal(a, b)


def test_faulty_scenarios_survive_a_file():
    scenario = Scenario.from_dict(EVERYTHING)
    assert Scenario.from_dict(json.loads(json.dumps(scenario.to_dict()))) == scenario


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"dvl": {"faults": {"dropout_probabilty": 0.1}}}, ["dvl.faults.dropout_probabilty", "'dropout_probability'"]),
        ({"dvl": {"fault": {}}}, ["dvl.fault", "did you mean 'faults'"]),
        ({"depth": {"faults": {"outlier_m_s": 1}}}, ["depth.faults.outlier_m_s", "did you mean 'outlier_m'"]),
        ({"gps": {"faults": {"dropout_probability": 1.5}}}, ["gps.faults.dropout_probability", "less than", "1.5"]),
        ({"gps": {"faults": {"outages_s": [[20, 10]]}}}, ["gps.faults.outages_s[0]", "[20.0, 10.0]"]),
        ({"gps": {"faults": {"outages_s": [[-1, 10]]}}}, ["gps.faults.outages_s[0]"]),
        ({"heading": {"faults": {"clock_offset_s": 60}}}, ["heading.faults.clock_offset_s", "60"]),
        ({"imu": {"faults": {"gyro_scale": 1.01}}}, ["imu.faults.gyro_scale"]),
        ({"dvl": {"faults": {"scale": 0}}}, ["dvl.faults.scale", "greater than 0"]),
    ],
)
def test_a_bad_fault_is_refused_by_name(values, words):
    with pytest.raises(DatasetError) as caught:
        Scenario.from_dict(values, source="here.yaml")
    for word in ["here.yaml", *words]:
        assert word in str(caught.value)


def test_a_recorded_path_must_last_for_wrong_clocks_too():
    path = simulate(Scenario(duration_s=60, imu=ImuSpec(rate_hz=5)), 1).truth
    spec = DvlSpec(faults=DvlFaults(clock_offset_s=0.5))
    scenario = Scenario(mission="recorded", duration_s=60, dvl=spec)
    with pytest.raises(DatasetError, match=r"the scenario needs it from -0\.5 to 60 s"):
        simulate(scenario, 1, path)
    simulate(dataclasses.replace(scenario, path_start_s=0.5, duration_s=59.5), 1, path)


def test_an_imu_that_never_speaks_is_no_log():
    with pytest.raises(DatasetError, match="imu: 0 samples"):
        with_faults("imu", dropout_probability=1.0)
