"""The simulator against the definitions: what an IMU's companions report, how noisy they are, and what a seed fixes."""

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError, ImuNoise, Log, open_log
from fathom.datasets.described.folder import write_folder
from fathom.datasets.epochs import cut
from fathom.datasets.mounting import MountingSpec
from fathom.datasets.simulated.faults import HeadingFaults
from fathom.datasets.simulated.imu import simulate_biases
from fathom.datasets.simulated.imu_grades import IMU_GRADES
from fathom.datasets.simulated.random_streams import RANDOM_STREAMS, random_stream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.seabed import SeabedSpec
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import (
    MISSIONS,
    DepthSpec,
    DvlSpec,
    GpsSpec,
    HeadingSpec,
    ImuSpec,
    PriorSpec,
    TideSpec,
    WavesSpec,
)
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest, pearsonr, uniform
from variances import assert_variance

SENSORS = ("dvl", "depth", "gps", "heading")


def arrays(log: Log, *but: str) -> dict[str, np.ndarray]:
    """Every array of a log by name, except those of the streams named."""
    out = {"imu.t": log.imu.t_ns, "imu.w": log.imu.w_WI_I, "imu.f": log.imu.f_I}
    for name, stream in log.streams.items():
        if name not in but:
            out |= {f"{name}.{field.name}": getattr(stream, field.name) for field in dataclasses.fields(stream)}
    out |= {f"truth.{n}": getattr(log.truth, n) for n in ("t_ns", "R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g")}
    out |= {f"prior.{n}": getattr(log.prior.state, n) for n in ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g")}
    return out


def assert_same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    assert a.keys() == b.keys()
    for name, value in a.items():
        assert np.array_equal(value, b[name]), name


def truth_at(log: Log, t_ns: np.ndarray) -> np.ndarray:
    rows = np.searchsorted(log.truth.t_ns, t_ns)
    assert np.array_equal(log.truth.t_ns[rows], t_ns)
    return rows


# -- what the others report


@pytest.mark.parametrize(
    "mission",
    [pytest.param(name, marks=[] if name in ("lawnmower", "yo-yo") else pytest.mark.slow) for name in MISSIONS],
)
def test_noise_free_readings_follow_from_the_truth(mission):
    log = simulate(Scenario(mission=mission, duration_s=300, noise_scale=0.0), 5)
    truth, rig = log.truth, log.rig
    at = {name: truth_at(log, stream.t_ns) for name, stream in log.streams.items()}
    for row, z in zip(at["dvl"], log.dvl.z, strict=True):
        np.testing.assert_allclose(z, truth.R_WB[row].T @ truth.v_WB_W[row], atol=1e-12)
    for row, z in zip(at["depth"], log.depth.z, strict=True):
        np.testing.assert_allclose(z, (truth.p_WB_W[row] + truth.R_WB[row] @ rig.depth.p_BS_B)[2], atol=1e-12)
    for row, z in zip(at["gps"], log.gps.z, strict=True):
        np.testing.assert_allclose(z, truth.p_WB_W[row] + truth.R_WB[row] @ rig.gps.p_BS_B, atol=1e-9)
    for row, z in zip(at["heading"], log.heading.z, strict=True):
        yaw = Rotation.from_matrix(truth.R_WB[row] @ rig.heading.R_BS).as_euler("ZYX")[0]
        np.testing.assert_allclose(np.cos(z - yaw), 1.0, atol=1e-12)
    assert not truth.b_a.any()
    assert not truth.b_g.any()
    np.testing.assert_allclose(log.prior.state.local(truth.state(0)), 0, atol=1e-12)
    assert (np.diag(log.prior.P) > 0).all()


@pytest.mark.parametrize("mission", MISSIONS)
def test_gps_is_heard_only_at_the_surface(mission):
    log = simulate(Scenario(mission=mission, duration_s=600), 2)
    antenna_m = log.truth.p_WB_W[:, 2] + (log.truth.R_WB @ log.rig.gps.p_BS_B)[:, 2]
    each_second = np.flatnonzero((log.truth.t_ns % 1_000_000_000 == 0) & (log.truth.t_ns > 0))
    expected = log.truth.t_ns[each_second][antenna_m[each_second] > -0.05]
    assert np.array_equal(log.gps.t_ns, expected)
    assert log.gps.t_ns[0] == 1_000_000_000
    assert log.gps.t_ns[-1] == 600_000_000_000
    assert np.diff(log.gps.t_ns).max() > 150e9  # a long dive


def test_dvl_sigma_is_that_of_its_beams():
    log = simulate(Scenario(duration_s=600, dvl=DvlSpec(rate_hz=50, beam_sigma_m_s=0.01, beam_angle_deg=30)), 1)
    quiet = simulate(
        Scenario(duration_s=600, dvl=DvlSpec(rate_hz=50, beam_sigma_m_s=0.01, beam_angle_deg=30), noise_scale=0), 1
    )
    # by hand: two opposite beams give v_x with 1/(2 sin) of their difference; turned by 45° all four share in each
    np.testing.assert_allclose(log.dvl.sigma[0], 0.01 * np.array([2**0.5, 2**0.5, 1 / 3**0.5]), rtol=1e-12)
    error = log.dvl.z - quiet.dvl.z
    for axis in range(3):
        assert_variance(error[:, axis], log.dvl.sigma[0, axis])
    correlation = np.corrcoef(error.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / np.sqrt(len(error))


def test_readings_have_the_sigmas_they_state():
    scenario = Scenario(duration_s=600, gps=GpsSpec(mounting=MountingSpec((0, 0, 50))))  # GPS all the time
    noisy, quiet = simulate(scenario, 4), simulate(dataclasses.replace(scenario, noise_scale=0.0), 4)
    for name in SENSORS:
        error = noisy.streams[name].z - quiet.streams[name].z
        error = np.arctan2(np.sin(error), np.cos(error)) if name == "heading" else error
        for axis in range(error.shape[1]):
            assert_variance(error[:, axis], noisy.streams[name].sigma[0, axis])


def test_heading_bias_turns_every_heading_counter_clockwise():
    straight, biased = (
        simulate(Scenario(duration_s=60, heading=HeadingSpec(faults=HeadingFaults(bias_deg=bias))), 1).heading.z
        for bias in (0, 2)
    )
    np.testing.assert_allclose(np.exp(1j * (biased - straight)), np.exp(1j * np.radians(2)), atol=1e-12)
    assert np.abs(simulate(Scenario(course_deg=179), 1).heading.z).max() <= np.pi


def test_delay_moves_reception_and_nothing_else():
    scenario = Scenario(duration_s=60, dvl=DvlSpec(delay_s=0.35), gps=GpsSpec(delay_s=1.2))
    late, prompt = simulate(scenario, 1), simulate(Scenario(duration_s=60), 1)
    assert (late.dvl.received_ns - late.dvl.t_ns == 350_000_000).all()
    assert (late.gps.received_ns - late.gps.t_ns == 1_200_000_000).all()
    assert (prompt.dvl.received_ns == prompt.dvl.t_ns).all()
    assert np.array_equal(late.dvl.z, prompt.dvl.z)
    assert list(late.notes[1:]) == [
        "dvl comes 0.35 s late, and up to 0 s more, at random.",
        "gps comes 1.2 s late, and up to 0 s more, at random.",
    ]


def test_disorder_lets_readings_overtake_one_another_and_moves_nothing_else():
    scenario = Scenario(duration_s=60, heading=HeadingSpec(delay_s=0.5, disorder_s=2.0))
    mixed, prompt = simulate(scenario, 1), simulate(Scenario(duration_s=60), 1)
    way_s = (mixed.heading.received_ns - mixed.heading.t_ns) * 1e-9
    assert 0.5 <= way_s.min() < 0.6
    assert 2.4 < way_s.max() <= 2.5
    assert kstest(way_s, uniform(0.5, 2.0).cdf).pvalue > 1e-3
    assert (np.diff(mixed.heading.received_ns) < 0).mean() > 0.3
    assert np.array_equal(mixed.heading.z, prompt.heading.z)
    assert np.array_equal(mixed.dvl.received_ns, prompt.dvl.received_ns)


@pytest.mark.slow
def test_prior_error_has_the_covariance_it_states():
    seeds = range(200)
    errors, nees = [], []
    for seed in seeds:
        log = simulate(Scenario(duration_s=20, imu=ImuSpec(rate_hz=5), prior=PriorSpec(attitude_deg=2)), seed)
        assert not log.prior.state.b_a.any()
        assert not log.prior.state.b_g.any()
        errors.append(log.prior.state.local(log.truth.state(0)) / np.sqrt(np.diag(log.prior.P)))
        nees.append(errors[-1] @ errors[-1])
    low, high = chi2.interval(0.999, 15 * len(seeds))
    assert low < sum(nees) < high
    for component in np.array(errors).T:
        assert_variance(component, 1.0)


# -- seeds and streams


def test_same_seed_same_log_and_other_seed_other_log():
    scenario = Scenario(duration_s=60)
    one, again, other = (arrays(simulate(scenario, seed)) for seed in (7, 7, 8))
    assert_same(one, again)
    changed = {name for name in one if not np.array_equal(one[name], other[name])}
    assert {"imu.w", "imu.f", "dvl.z", "depth.z", "gps.z", "heading.z", "truth.p_WB_W", "prior.p_WB_W"} <= changed


EVERYTHING = {
    "mission": "helix",
    "duration_s": 90,
    "latitude_deg": -33.0,
    "waves": {"height_m": 0.8},
    "tide": {},
    "seabed": {"relief_m": 2},
    "imu": {
        "faults": {
            "bias_correlation_s": 100,
            "dropout_probability": 0.01,
            "outlier_probability": 0.01,
            "gyro_quantum_deg_s": 0.01,
        },
    },
    "dvl": {"beam_loss_probability": 0.1, "max_tilt_deg": 15, "delay_s": 0.2, "faults": {"repeat_probability": 0.1}},
    "gps": {"reacquisition_s": 5, "faults": {"outages_s": [[3, 6]]}},
    "heading": {"disorder_s": 1, "faults": {"soft_iron_deg": 2, "clock_offset_s": 0.05}},
}


def test_a_log_with_everything_in_it_is_fixed_by_its_seed_can_be_cut_and_survives_a_folder(tmp_path):
    scenario = Scenario.from_dict(EVERYTHING)
    log = simulate(scenario, 5)
    assert_same(arrays(log), arrays(simulate(Scenario.from_dict(json.loads(json.dumps(scenario.to_dict()))), 5)))
    assert cut(log).failure is None
    back = open_log(write_folder(log, tmp_path / "log"))
    assert_same(arrays(log), arrays(back))
    assert back.notes[: len(log.notes)] == log.notes
    assert back.origin == (-33.0, 0.0)


@pytest.mark.parametrize("sensor", SENSORS)
def test_dropping_or_changing_one_sensor_changes_no_other(sensor):
    base = Scenario(duration_s=60)
    other_spec = {
        "dvl": DvlSpec(beam_sigma_m_s=0.02, rate_hz=7),
        "depth": DepthSpec(sigma_m=0.1),
        "gps": GpsSpec(rate_hz=2),
        "heading": HeadingSpec(faults=HeadingFaults(bias_deg=5)),
    }[sensor]
    expected = arrays(simulate(base, 7), sensor)
    for value in (None, other_spec):
        log = simulate(dataclasses.replace(base, **{sensor: value}), 7)
        assert (getattr(log, sensor) is None) == (value is None)
        assert_same(arrays(log, sensor), expected)


def test_changing_the_imu_changes_neither_path_nor_aiding():
    tactical, consumer = (simulate(Scenario(duration_s=60, imu=grade), 7) for grade in ("tactical", "consumer"))
    for name in ("truth.p_WB_W", "dvl.z", "gps.z", "heading.z", "depth.z", "prior.p_WB_W", "prior.R_WB"):
        assert np.array_equal(arrays(tactical)[name], arrays(consumer)[name]), name


def test_a_longer_log_begins_with_the_same_noise():
    short, long = (
        simulate_biases(IMU_GRADES["tactical"], np.arange(n) * 10_000_000, np.random.default_rng(3)) for n in (100, 200)
    )
    assert np.array_equal(short, long[:100])


def test_random_streams_are_distinct():
    assert len(set(RANDOM_STREAMS.values())) == len(RANDOM_STREAMS)
    keys = itertools.product([*MISSIONS, "recorded"], RANDOM_STREAMS, [0, 1, 2**32, 2**63 - 1])
    draws = [random_stream(*key).random() for key in keys]
    assert len(set(draws)) == len(draws)


def test_two_missions_of_one_seed_are_two_experiments():
    """Not one error of any sensor, of the biases or of the prior is shared, nor correlated."""
    noisy, quiet = (
        [simulate(Scenario(mission=mission, duration_s=60, noise_scale=scale), 7) for mission in ("box", "transit")]
        for scale in (1.0, 0.0)
    )
    for name in ("imu.w", "imu.f", "dvl.z", "depth.z", "heading.z"):
        box, transit = (
            np.diff(arrays(log)[name] - arrays(still)[name], axis=0) for log, still in zip(noisy, quiet, strict=True)
        )
        assert abs(pearsonr(box.ravel(), transit.ravel()).statistic) < 4 / np.sqrt(box.size), name
    for one in (lambda log: log.truth.b_g[0], lambda log: log.prior.state.local(log.truth.state(0))):
        assert not np.intersect1d(*map(one, noisy)).any()


# -- the log as a whole


@pytest.mark.parametrize("start_ns", [0, 1_700_000_000_000_000_123])
def test_times_are_exact_integers(start_ns):
    log = simulate(Scenario(duration_s=60, start_ns=start_ns), 1)
    assert log.imu.t_ns.dtype == np.int64
    assert np.array_equal(log.imu.t_ns, start_ns + np.arange(1, 6001) * 10_000_000)
    assert np.array_equal(log.truth.t_ns, start_ns + np.arange(6001) * 10_000_000)
    assert np.array_equal(log.dvl.t_ns, start_ns + np.arange(1, 301) * 200_000_000)
    assert log.start_ns == log.prior.t_ns == start_ns
    assert log.duration_s == pytest.approx(60)
    expected = simulate(Scenario(duration_s=60), 1)
    assert np.array_equal(log.imu.f_I, expected.imu.f_I)


@pytest.mark.parametrize("mission", MISSIONS)
@pytest.mark.parametrize("duration_s", [20.0, 33.3, pytest.param(1200.0, marks=pytest.mark.slow)])
def test_every_duration_makes_a_log_that_can_be_cut(mission, duration_s):
    voyage = cut(simulate(Scenario(mission=mission, duration_s=duration_s), 9))
    assert voyage.failure is None
    assert not any(voyage.counts.values())


def test_the_log_says_what_it_is():
    log = simulate(Scenario(duration_s=60), 7)
    assert log.name == "lawnmower-tactical-s7"
    assert "seed 7" in log.notes[0]
    assert log.truth_kind == "truth"
    custom = ImuNoise(1e-4, 1e-3, 0.0, 0.0, 1e-4, 1e-2)
    assert simulate(Scenario(duration_s=60, imu=custom, mission="yo-yo"), 7).name == "yo-yo-custom-s7"


TOLD = {
    "imu": {"noise": "consumer"},
    "dvl": {"beam_sigma_m_s": 0.05},
    "depth": {"sigma_m": 0.3},
    "gps": {"horizontal_sigma_m": 4, "vertical_sigma_m": 9},
    "heading": {"sigma_deg": 6},
    "prior": {"attitude_deg": 3, "position_m": 4, "velocity_m_s": 0.5},
}


@pytest.mark.parametrize("part", TOLD)
def test_what_is_told_changes_what_the_log_states_and_nothing_that_it_measures(part: str) -> None:
    plain = Scenario(duration_s=60)
    odd = Scenario.from_dict({"duration_s": 60, part: {"told": TOLD[part]}})
    log, other = simulate(plain, 3), simulate(odd, 3)
    stated = {f"{part}.sigma"} if part in SENSORS else set()
    before, after = arrays(log), arrays(other)
    assert {name for name in before if not np.array_equal(before[name], after[name])} == stated
    assert (log.rig.imu_noise == other.rig.imu_noise) == (part != "imu")
    assert np.array_equal(log.prior.P, other.prior.P) == (part not in ("imu", "prior"))
    assert other.notes[-1].startswith(f"{part} is told otherwise than simulated: ")
    assert odd.truly_told == plain
    as_if = simulate(Scenario.from_dict({"duration_s": 60, part: TOLD[part]}), 3)
    if part in SENSORS:
        assert np.array_equal(getattr(other, part).sigma, getattr(as_if, part).sigma)
    assert other.rig.imu_noise == as_if.rig.imu_noise
    assert np.array_equal(other.prior.P, as_if.prior.P)


# -- scenarios


def test_scenario_survives_a_file():
    scenario = Scenario(
        mission="yo-yo", imu=IMU_GRADES["consumer"], gps=None, dvl=DvlSpec(delay_s=0.1), prior=PriorSpec(position_m=2)
    )
    assert Scenario.from_dict(json.loads(json.dumps(scenario.to_dict()))) == scenario
    assert Scenario.from_dict({}) == Scenario()


def keys(value: object) -> object:
    """The keys of nested mappings, all the way down."""
    return {key: keys(item) for key, item in value.items()} if isinstance(value, dict) else None


def test_the_page_on_the_simulator_shows_every_dial_at_its_default():
    page = Path(__file__).parents[3].joinpath("docs", "simulator.md").read_text(encoding="utf-8")
    shown = yaml.safe_load(page.split("```yaml")[1].split("```")[0])
    scenario = Scenario.from_dict(shown)
    assert keys(shown) == keys(scenario.to_dict())
    assert scenario == Scenario(seabed=SeabedSpec(), waves=WavesSpec(), tide=TideSpec())


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"mision": "yo-yo"}, ["mision", "did you mean 'mission'"]),
        ({"mission": "lawnmover"}, ["mission", "did you mean 'lawnmower'"]),
        ({"imu": "tacticel"}, ["imu", "did you mean 'tactical'"]),
        ({"imu": {"rate_hz": -100}}, ["`imu.rate_hz`", "greater than 0", "-100"]),
        ({"dvl": {"rate": 5}}, ["dvl.rate", "did you mean 'rate_hz'"]),
        ({"dvl": {"rate_hz": 0}}, ["dvl.rate_hz", "greater than 0"]),
        ({"duration_s": 5}, ["duration_s", "20"]),
        ({"duration_s": float("nan")}, ["duration_s"]),
        ({"speed_m_s": float("inf")}, ["speed_m_s", "finite"]),
        ({"imu": {"mounting": {"yaw": 3}}}, ["imu.mounting.yaw", "did you mean 'yaw_deg'"]),
        ({"imu": {"noise": {"gyro_densty": 1e-4}}}, ["imu.noise.gyro_densty", "did you mean 'gyro_density'"]),
        ({"speed_mps": 1.5}, ["`speed_mps` is called `speed_m_s` now"]),
        ({"dvl": {"faults": {"limit_mps": 3}}}, ["`dvl.faults.limit_mps` is called `limit_m_s` now"]),
        ({"imu_rate_hz": 50}, ["`imu_rate_hz` is called `imu.rate_hz` now"]),
        ({"gps_mounting": {}}, ["`gps_mounting` is called `gps.mounting` now"]),
        ({"imu": {"mounting": {"lever_arm_m": [0, 0, 0]}}}, ["lever_arm_m` is called `translation_m` now"]),
        ({"imu": {"gyro_density": 1e-4}}, ["`imu.gyro_density` is called `noise.gyro_density` now"]),
        ({"imu": {"bias_correlation_s": 5}}, ["`imu.bias_correlation_s` is called `faults.bias_correlation_s` now"]),
        ({"heading": {"bias_deg": 5}}, ["`heading.bias_deg` is called `faults.bias_deg` now"]),
        ({"imu": {"told": {"noise": "tacticel"}}}, ["imu.told.noise", "did you mean 'tactical'"]),
        ({"gyro_density": 1e-4}, ["unknown key `gyro_density`"]),
        ({"dvl": {"lever_arm_m": [0, 0, 0]}}, ["unknown key `dvl.lever_arm_m`"]),
        ({"speed_mps": 1, "depth_mounting": {}}, ["`speed_mps` is called", "`depth_mounting` is called"]),
        ({"imu": 3}, ["imu"]),
        ({"mission": "yo-yo", "depth_m": 3}, ["shallow_m", "less than"]),
        ({"mission": "helix", "helix_pitch_m": 70}, ["helix_pitch_m 70", "45°"]),
        ([1, 2], ["mapping"]),
    ],
)
def test_a_bad_scenario_is_refused_by_name(values, words):
    with pytest.raises(DatasetError) as caught:
        Scenario.from_dict(values, source="here.yaml")
    for word in ["here.yaml", *words]:
        assert word in str(caught.value)


def test_bad_arguments_are_refused():
    with pytest.raises(ValidationError, match="did you mean 'yo-yo'"):
        Scenario(mission="yoyo")
    with pytest.raises(ValidationError, match="gyro_density"):
        Scenario(imu=ImuNoise(0.0, 1.0, 1.0, 1.0, 1.0, 1.0))
    with pytest.raises(DatasetError, match="gyro_density"):
        Scenario(imu=ImuNoise(-1.0, 1.0, 1.0, 1.0, 1.0, 1.0))
    with pytest.raises(DatasetError, match="seed"):
        simulate(Scenario(duration_s=20), -1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Scenario().duration_s = 3
