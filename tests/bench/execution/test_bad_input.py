"""Whatever a log lacks or garbles, every estimator ends with a result that says so.

Everything here is asked of all of ESTIMATORS, so a new one is asked as well. Dead reckoning has no covariance, listens
to neither GPS nor accelerometer, and holds what it heard last: where that makes a difference, the test says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.execution.result import Result
from fathom.bench.metrics.scoring import SCORES, scores
from fathom.datasets import Belief, Log, Trajectory
from fathom.datasets.errors import DatasetError
from fathom.datasets.log import ImuStream, ReadingStream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec, HeadingSpec, ImuSpec
from fathom.estimators import ESTIMATORS, create

pytestmark = pytest.mark.slow  # whole runs and searches: seconds each

SECOND = 10**9
FUSING = [name for name in ESTIMATORS if name != "dead-reckoning"]
SENSORS = ["dvl", "depth", "gps", "heading"]

every = pytest.mark.parametrize("name", ESTIMATORS)
every_fusing = pytest.mark.parametrize("name", FUSING)


def scenario(duration_s: float) -> Scenario:
    """Slow sensors, so that many runs are short; DVL and heading speak at the same moments, and so does depth."""
    sensors = {"dvl": DvlSpec(2.0), "depth": DepthSpec(4.0), "heading": HeadingSpec(2.0)}
    return Scenario(duration_s=duration_s, imu=ImuSpec(rate_hz=50.0), **sensors)


def fresh() -> Log:
    """A log whose arrays nobody else has: some tests write into them."""
    return simulate(scenario(20.0), seed=6)


@pytest.fixture(scope="module")
def log() -> Log:
    return fresh()


@pytest.fixture(scope="module")
def usual(log: Log) -> Callable[[str], Result]:
    """What each estimator makes of the log when nothing is wrong with it."""
    results = {name: run_log(log, create(name)) for name in ESTIMATORS}
    return results.__getitem__


def rows_of(stream: ReadingStream, rows: Any) -> ReadingStream:
    return type(stream)(stream.t_ns[rows], stream.received_ns[rows], stream.z[rows], stream.sigma[rows])


def without_imu(log: Log, from_s: float, to_s: float) -> Log:
    t_s, imu = (log.imu.t_ns - log.start_ns) * 1e-9, log.imu
    keep = (t_s < from_s) | (t_s > to_s)
    return replace(log, imu=ImuStream(imu.t_ns[keep], imu.w_WI_I[keep], imu.f_I[keep]))


def assert_sound(result: Result, ticks: int = 20) -> Trajectory:
    """The run finished, with a finite belief at every tick, and a covariance unless the estimator keeps none."""
    assert result.status == "done", result.cause
    online = result.online
    assert online is not None
    assert len(online) == ticks
    for trajectory in result.outputs.values():
        assert len(trajectory) == ticks
        assert np.isfinite(trajectory.p_WB_W).all()
        assert np.isfinite(trajectory.R_WB).all()
    if online.P is not None:
        assert np.linalg.eigvalsh(online.P).min() > 0
    return online


def apart_in_sigma(a: Trajectory, b: Trajectory) -> float:
    """The largest difference of position, over sigma; in metres where there is no sigma."""
    sigma = np.ones_like(a.p_WB_W) if a.P is None else np.sqrt(np.einsum("nii->ni", a.P)[:, 3:6])
    return float((np.abs(a.p_WB_W - b.p_WB_W) / sigma).max())


# -- what is not there ------------------------------------------------------------------------------------------------


@every
@pytest.mark.parametrize("absent", [["dvl"], ["depth"], ["gps"], ["heading"], SENSORS], ids="+".join)
def test_without_a_sensor_it_runs_on_and_is_less_certain(
    log: Log, usual: Callable[[str], Result], name: str, absent: list[str]
) -> None:
    online = assert_sound(run_log(replace(log, **dict.fromkeys(absent)), create(name)))
    full = usual(name).online
    if full.P is not None:
        assert np.trace(online.P[-1]) > np.trace(full.P[-1])


@every
def test_a_sensor_that_never_spoke_is_a_sensor_that_is_not_there(log: Log, name: str) -> None:
    silent = replace(log, **{sensor: rows_of(stream, slice(0)) for sensor, stream in log.streams.items()})
    absent = replace(log, **dict.fromkeys(SENSORS))
    a, b = (assert_sound(run_log(one, create(name))) for one in (silent, absent))
    assert np.array_equal(a.p_WB_W, b.p_WB_W)


@every
def test_without_truth_scores_are_absent_not_zero(log: Log, usual: Callable[[str], Result], name: str) -> None:
    blind = replace(log, truth=None)
    online = assert_sound(run_log(blind, create(name)))
    assert np.array_equal(online.p_WB_W, usual(name).online.p_WB_W)
    assert scores(blind, online) == dict.fromkeys(SCORES)


@every
def test_a_log_that_ends_before_its_prior_has_no_belief_and_no_complaint(log: Log, name: str) -> None:
    result = run_log(log.with_prior(replace(log.prior, t_ns=int(log.imu.t_ns[-1]))), create(name))
    assert (result.status, result.online, len(result.step_ns)) == ("done", None, 0)


# -- gaps -------------------------------------------------------------------------------------------------------------


@every
def test_a_short_imu_gap_is_bridged_counted_and_costs_certainty(log: Log, name: str) -> None:
    """0.4 s into the gap, velocities are known ten times less well than without it; before it, exactly as well."""
    gap, none = (run_log(one, create(name), score_period_s=0.2) for one in (without_imu(log, 10.01, 10.69), log))
    assert (gap.counts["imu_gaps_bridged"], none.counts["imu_gaps_bridged"]) == (1, 0)
    online, full = assert_sound(gap, ticks=100), assert_sound(none, ticks=100)
    if full.P is not None:
        inside = int(np.searchsorted(online.t_ns, log.start_ns + int(10.4 * SECOND)))
        assert np.trace(online.P[inside, 6:9, 6:9]) > 100 * np.trace(full.P[inside, 6:9, 6:9])
        assert np.array_equal(online.P[: inside - 1], full.P[: inside - 1])


@every
def test_too_long_an_imu_gap_ends_the_run_where_it_begins_and_keeps_the_beliefs_before(log: Log, name: str) -> None:
    result = run_log(without_imu(log, 10.01, 13.0), create(name))
    assert result.status == "failed"
    assert result.cause.startswith("imu gap at 10.000 s: 3.0")
    assert result.failed_at_s == pytest.approx(10.0)
    assert [len(trajectory) for trajectory in result.outputs.values()] == [10] * len(result.outputs)


# -- time out of joint ------------------------------------------------------------------------------------------------


HEADING_EVERY_S = 2.0


def reach_s(estimator: Any) -> float:
    """How late a heading may come and still be used; a smoother's window begins a lag before its newest keyframe."""
    if not hasattr(estimator, "inflate"):
        return HEADING_EVERY_S  # dead reckoning takes it as of now, until there is a newer one
    return getattr(estimator, "max_delay_s", getattr(estimator, "lag_s", math.inf))


@pytest.fixture(scope="module")
def long_log() -> Log:
    sensors = {"dvl": DvlSpec(1.0), "depth": DepthSpec(1.0), "heading": HeadingSpec(1 / HEADING_EVERY_S)}
    return simulate(replace(scenario(120.0), **sensors), seed=6)


@every
def test_a_late_reading_counts_if_it_is_within_reach_and_else_is_counted(long_log: Log, name: str) -> None:
    """One heading comes 0.3 s late, one 4.5 s, one 100 s. Those out of reach leave no trace but in the count."""
    delay_s, heading = {3: 0.3, 5: 4.5, 7: 100.0}, long_log.heading
    received_ns, estimator = heading.received_ns.copy(), create(name)
    for row, by_s in delay_s.items():
        received_ns[row] += int(by_s * SECOND)
    lost = [row for row, by_s in delay_s.items() if by_s > reach_s(estimator)]
    late = replace(long_log, heading=replace(heading, received_ns=received_ns))
    never = replace(late, heading=rows_of(late.heading, np.setdiff1d(np.arange(len(heading)), lost)))
    result, expected = run_log(late, estimator), run_log(never, estimator)
    online, without = assert_sound(result, ticks=120), assert_sound(expected, ticks=120)
    assert result.counts.get("late", 0) == len(lost)
    assert apart_in_sigma(online, without) < 1e-6
    deaf = replace(late, heading=rows_of(late.heading, np.setdiff1d(np.arange(len(heading)), list(delay_s))))
    assert apart_in_sigma(online, run_log(deaf, estimator).online) > 1e-3  # those within reach do leave one


@every
def test_readings_that_come_in_any_order_end_where_they_end_in_order(
    log: Log, usual: Callable[[str], Result], name: str
) -> None:
    """Each is up to 0.9 s late; by the end all have come."""
    rng, streams = np.random.default_rng(1), {}
    for sensor, stream in log.streams.items():
        wait_ns = rng.integers(0, 900_000_000, len(stream))
        received_ns = np.minimum(stream.t_ns + wait_ns, log.imu.t_ns[-1])
        streams[sensor] = replace(stream, received_ns=received_ns)
    assert (np.diff(streams["dvl"].received_ns) < 0).any()
    result = run_log(replace(log, **streams), create(name))
    online = assert_sound(result)
    if name != "dead-reckoning":
        assert result.counts.get("late", 0) == 0
        assert apart_in_sigma(usual(name).online.select(slice(-1, None)), online.select(slice(-1, None))) < 0.1


@every
def test_readings_a_moment_apart_end_where_those_of_one_moment_end(
    log: Log, usual: Callable[[str], Result], name: str
) -> None:
    """In the log DVL, depth and heading share their stamps; with 0.1 µs between them only linearisation differs."""
    streams = {}
    for k, sensor in enumerate(SENSORS):
        stream = log.streams[sensor]
        streams[sensor] = replace(stream, t_ns=stream.t_ns - 100 * k, received_ns=stream.received_ns - 100 * k)
    online = assert_sound(run_log(replace(log, **streams), create(name)))
    assert apart_in_sigma(*(track.select(slice(-1, None)) for track in (usual(name).online, online))) < 0.02


# -- numbers that are none --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_reading_that_is_no_number_is_refused_by_stream_row_and_value(log: Log, sensor: str, value: float) -> None:
    z = log.streams[sensor].z.copy()
    z[7, -1] = value
    with pytest.raises(DatasetError, match=rf"^{sensor}: row 7 \(1 in all\): value is .*{value}"):
        replace(log.streams[sensor], z=z)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("column", "field"), [("gyro", "w_WI_I"), ("accel", "f_I")])
def test_a_sample_that_is_no_number_is_refused_by_row_and_value(
    log: Log, column: str, field: str, value: float
) -> None:
    samples = getattr(log.imu, field).copy()
    samples[7, 1] = value
    with pytest.raises(DatasetError, match=rf"^imu: row 7 \(1 in all\): {column} is .*{value}"):
        replace(log.imu, **{field: samples})


@pytest.mark.parametrize("sensor", SENSORS)
def test_readings_out_of_order_are_refused_by_stream_and_row(log: Log, sensor: str) -> None:
    stream = log.streams[sensor]
    t_ns = stream.t_ns.copy()
    t_ns[[7, 8]] = t_ns[[8, 7]]
    with pytest.raises(DatasetError, match=rf"^{sensor}: row 8 \(1 in all\): time {t_ns[8]} comes before"):
        replace(stream, t_ns=t_ns, received_ns=t_ns)


def spoilt(stream: str, at_s: float, value: float) -> Log:
    """The log with one value overwritten behind the loader's back, in the first row after at_s."""
    log = fresh()
    columns = {"gyro": log.imu.w_WI_I, "accel": log.imu.f_I} | {key: s.z for key, s in log.streams.items()}
    t_ns = log.streams[stream].t_ns if stream in SENSORS else log.imu.t_ns
    columns[stream].setflags(write=True)
    columns[stream][np.searchsorted(t_ns, log.start_ns + int(at_s * SECOND))] = value
    columns[stream].setflags(write=False)
    return log


@every_fusing
@pytest.mark.parametrize("stream", ["gyro", "accel", "dvl", "depth", "heading"])
def test_a_number_that_is_none_and_slipped_through_is_divergence_at_its_time(name: str, stream: str) -> None:
    result = run_log(spoilt(stream, 10.2, np.nan), create(name))
    assert result.status == "diverged"
    assert result.cause
    assert 10.2 <= result.failed_at_s <= 11.0
    assert len(result.online) == 10
    assert np.isfinite(result.online.p_WB_W).all()


@every
@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_an_absurd_velocity_is_divergence_with_cause_and_time(name: str, value: float) -> None:
    log = spoilt("dvl", 10.2, value)
    result = run_log(log, create(name))
    assert result.status == "diverged"
    assert result.cause
    assert "\n" not in result.cause
    assert 10.2 <= result.failed_at_s <= 11.0
    assert len(result.online) == 10
    assert scores(log, result.online)["ate_rmse_m"] < 10.0  # what was said until then stays and counts


@every
def test_one_run_that_is_lost_leaves_the_next_one_as_it_was(
    log: Log, usual: Callable[[str], Result], name: str
) -> None:
    assert run_log(spoilt("dvl", 10.2, np.nan), create(name)).status == "diverged"
    online = assert_sound(run_log(log, create(name)))
    assert np.array_equal(online.p_WB_W, usual(name).online.p_WB_W)


@every
def test_a_reading_that_measures_two_axes_is_used_for_two(log: Log, usual: Callable[[str], Result], name: str) -> None:
    sigma = log.dvl.sigma.copy()
    sigma[:, 1] = np.inf
    result = run_log(replace(log, dvl=replace(log.dvl, sigma=sigma)), create(name))
    online, full = assert_sound(result), usual(name).online
    without = run_log(replace(log, dvl=None), create(name)).online
    assert result.counts["readings_void"] == 0
    assert apart_in_sigma(online, without) > 1e-3
    if full.P is not None:
        assert np.trace(full.P[-1]) < np.trace(online.P[-1]) < np.trace(without.P[-1])


# -- priors -----------------------------------------------------------------------------------------------------------

HARM: dict[str, Callable[[Belief], Belief]] = {
    "nan state": lambda x: replace(x, state=replace(x.state, v_WB_W=np.full(3, np.nan))),
    "nan covariance": lambda x: replace(x, P=np.full((15, 15), np.nan)),
    "negative covariance": lambda x: replace(x, P=-x.P),
}


@every
@pytest.mark.parametrize("harm", HARM)
def test_a_prior_that_is_none_is_divergence_at_the_start(log: Log, name: str, harm: str) -> None:
    result = run_log(log.with_prior(HARM[harm](log.prior)), create(name))
    if name == "dead-reckoning" and harm != "nan state":
        assert_sound(result)
        return
    assert result.status == "diverged"
    assert result.cause
    assert result.failed_at_s <= 1.0
    assert result.online is None


@every
@pytest.mark.parametrize("known", [slice(3, 6), slice(9, 15), slice(14, 15)], ids=["place", "biases", "one bias"])
def test_what_a_prior_knows_for_certain_is_kept_or_refused_at_the_start(log: Log, name: str, known: slice) -> None:
    """Without variance there is no information matrix and no Cholesky factor: who needs one says so at once."""
    P = log.prior.P.copy()
    P[known], P[:, known] = 0.0, 0.0
    result = run_log(log.with_prior(replace(log.prior, P=P)), create(name))
    if result.status == "done":
        assert len(result.online) == 20
        if result.online.P is not None:
            assert np.linalg.eigvalsh(result.online.P).min() > -1e-12
    else:
        assert result.status == "diverged"
        assert result.cause
        assert result.failed_at_s <= 1.0
