"""A log is cut into epochs by time of reception, exactly covered by the IMU, and without a look ahead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import run_log
from fathom.datasets import Log
from fathom.datasets.epochs import MOST_BRIDGED, cut
from fathom.datasets.log import ImuStream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DepthSpec, DvlSpec
from fathom.estimators import create


def with_gap(log: Log, begin_s: float, end_s: float) -> Log:
    """The log without its IMU samples in (begin_s, end_s)."""
    t_s = (log.imu.t_ns - log.start_ns) * 1e-9
    keep = (t_s < begin_s + 1e-6) | (t_s > end_s - 1e-6)
    return replace(log, imu=ImuStream(log.imu.t_ns[keep], log.imu.w_WI_I[keep], log.imu.f_I[keep]))


@pytest.fixture(scope="module")
def log() -> Log:
    """Odd rates and delays, so that little falls on an IMU sample."""
    return simulate(Scenario(duration_s=30.0, dvl=DvlSpec(rate_hz=3.7, delay_s=0.013), depth=DepthSpec(rate_hz=9.3)), 1)


def test_imu_rows_cover_every_epoch_exactly(log: Log) -> None:
    ticks = log.start_ns + np.arange(1, 30, dtype=np.int64) * 333_333_333
    before_ns = log.start_ns
    for epoch in cut(log, ticks).epochs:
        assert round(float(epoch.imu["dt_s"].sum()) * 1e9) == pytest.approx(epoch.t_ns - before_ns, abs=2)
        assert epoch.imu["t_ns"][-1] == epoch.t_ns
        assert (epoch.readings["received_ns"] == epoch.t_ns).all()
        assert (epoch.readings["t_ns"] <= epoch.t_ns).all()
        before_ns = epoch.t_ns


def test_splitting_keeps_the_integral_of_every_sample(log: Log) -> None:
    epochs = cut(log, log.imu.t_ns[-1:]).epochs
    turned = sum((epoch.imu["w_WI_I"] * epoch.imu["dt_s"][:, None]).sum(axis=0) for epoch in epochs)
    period_s = log.imu.period_ns * 1e-9
    assert np.allclose(turned, log.imu.w_WI_I.sum(axis=0) * period_s, rtol=1e-9)


def test_a_row_knows_the_rate_where_it_ends(log: Log) -> None:
    """A rate that changes evenly: exact at the end of every row, split or not, and after a gap; held over the gap."""
    t_s = (log.imu.t_ns - log.start_ns) * 1e-9
    a, b = np.array([0.1, -0.2, 0.3]), np.array([0.05, 0.02, -0.07])
    means = a + b * (t_s - 0.5e-9 * log.imu.period_ns)[:, None]
    gapped = with_gap(replace(log, imu=ImuStream(log.imu.t_ns, means, log.imu.f_I)), 10.0, 10.4)
    rows = np.concatenate([epoch.imu for epoch in cut(gapped).epochs])
    ends_s, held = (rows["t_ns"] - log.start_ns) * 1e-9, rows["held_s"] > 0
    at_end = rows["w_WI_I"] + rows["alpha_I"] * rows["after_s"][:, None]
    own = ~held & (ends_s > t_s[0])  # the first sample has none before it
    assert held.any()
    assert (rows["dt_s"][own] < 0.9e-9 * log.imu.period_ns).any()
    np.testing.assert_allclose(at_end[own], (a + b * ends_s[:, None])[own], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(at_end[held], rows["w_WI_I"][held])


def test_every_reading_comes_once_in_the_order_of_reception(log: Log) -> None:
    voyage = cut(log)
    received = np.concatenate([epoch.readings["received_ns"] for epoch in voyage.epochs])
    inside = sum(np.count_nonzero(s.received_ns <= log.imu.t_ns[-1]) for s in log.streams.values())
    assert len(received) == inside
    assert (np.diff(received) >= 0).all()
    assert voyage.counts["readings_outside"] == sum(map(len, log.streams.values())) - inside


def test_sensors_that_are_not_asked_for_make_no_epochs(log: Log) -> None:
    kinds = {int(k) for epoch in cut(log, sensors={"depth"}).epochs for k in epoch.readings["kind"]}
    assert kinds == {1}


def test_in_a_gap_the_sample_before_is_held_never_the_one_after(log: Log) -> None:
    gappy = with_gap(log, 10.0, 10.8)
    ticks = log.start_ns + np.arange(10_100_000_000, 10_800_000_000, 100_000_000, dtype=np.int64)
    voyage = cut(gappy, ticks)
    assert voyage.counts["imu_gaps_bridged"] == 1
    assert voyage.failure is None
    rows = np.concatenate([epoch.imu for epoch in voyage.epochs])
    t_s = (rows["t_ns"] - log.start_ns) * 1e-9
    last_known = log.imu.w_WI_I[np.searchsorted(log.imu.t_ns, log.start_ns + 10_000_000_000)]
    in_gap = (t_s > 10.0 + 1e-6) & (t_s < 10.79 + 1e-6)
    assert (rows["w_WI_I"][in_gap] == last_known).all()
    assert rows["held_s"][in_gap] == pytest.approx(0.79)
    assert (rows["held_s"][~in_gap] == 0).all()


@pytest.mark.parametrize("name", ["eskf", "fls"])
def test_a_gap_costs_the_same_however_often_one_looks(log: Log, name: str) -> None:
    alone = replace(with_gap(log, 10.0, 10.8), dvl=None, depth=None, gps=None, heading=None)
    sigma = []
    for period_s in (5.0, 0.1):
        online = run_log(alone, create(name), period_s=period_s).online
        row = int(np.flatnonzero(online.t_ns == log.start_ns + 15_000_000_000)[0])
        sigma.append(np.sqrt(np.diag(online.P[row])))
    assert sigma[1] == pytest.approx(sigma[0], rel=0.1)  # a long sample and ten short ones: T³/4 against T³/3


@pytest.mark.parametrize("name", ["eskf", "fls"])
def test_a_tick_just_after_the_start_changes_no_covariance(log: Log, name: str) -> None:
    beliefs = []
    for first_ns in (1_000_000_000, 1_000):
        run = create(name).begin(log.prior, log.rig)
        for epoch in cut(log, log.start_ns + np.array([first_ns, 3_000_000_000])).epochs:
            run.step(epoch)
            if epoch.t_ns >= log.start_ns + 3_000_000_000:
                break
        beliefs.append(np.diag(run.belief().P))
    assert beliefs[1] == pytest.approx(beliefs[0], rel=1e-3)


def test_a_prior_long_before_the_first_sample_is_a_gap(log: Log) -> None:
    late = replace(log, imu=ImuStream(log.imu.t_ns[500:], log.imu.w_WI_I[500:], log.imu.f_I[500:]))
    assert cut(late, max_gap_s=10.0).counts["imu_gaps_bridged"] == 1
    failure = cut(late, max_gap_s=1.0).failure
    assert failure is not None
    assert failure.startswith("imu gap at 0.000 s")


def test_a_gap_beyond_the_bound_ends_the_voyage_where_it_begins(log: Log) -> None:
    voyage = cut(with_gap(log, 10.0, 12.5), max_gap_s=2.0)
    assert voyage.failure == "imu gap at 10.000 s: 2.500 s without a sample"
    assert voyage.epochs[-1].t_ns <= log.start_ns + 10_000_000_000


def test_a_change_of_rate_holds_no_sample_and_keeps_what_the_gyro_turned(log: Log) -> None:
    """From 15 s on the means of two samples each."""
    imu, half = log.imu, len(log.imu.t_ns) // 4 * 2
    pairs = [x[half:].reshape(-1, 2, 3).mean(axis=1) for x in (imu.w_WI_I, imu.f_I)]
    stamps = np.concatenate([imu.t_ns[:half], imu.t_ns[half + 1 :: 2]])
    w, f = (np.concatenate([x[:half], y]) for x, y in zip((imu.w_WI_I, imu.f_I), pairs, strict=True))
    turned = []
    for one in (log, replace(log, imu=ImuStream(stamps, w, f))):
        voyage = cut(one, imu.t_ns[-1:])
        assert voyage.counts["imu_gaps_bridged"] == 0
        rows = np.concatenate([epoch.imu for epoch in voyage.epochs])
        assert not rows["held_s"].any()
        turned.append((rows["w_WI_I"] * rows["dt_s"][:, None]).sum(axis=0))
    assert turned[1] == pytest.approx(turned[0], rel=1e-9)


def test_gaps_are_counted_and_their_length_too(log: Log) -> None:
    counts = cut(with_gap(with_gap(log, 10.0, 10.8), 20.0, 20.3)).counts
    assert (counts["imu_gaps_bridged"], counts["imu_gaps_ms"]) == (2, 1080)


def test_many_gaps_end_the_voyage_where_they_exceed_a_share_of_the_log(log: Log) -> None:
    """0.79 s of each second is missing: 6 s, a fifth of the log, are exceeded in its eighth second."""
    gappy = log
    for k in range(30):
        gappy = with_gap(gappy, k + 0.2, k + 1.0)
    voyage = cut(gappy)
    assert voyage.failure is not None
    assert voyage.failure.startswith("imu gap at 7.200 s: gaps of 6.320 s in all, more than 20% of the log")
    assert voyage.counts["imu_gaps_ms"] <= MOST_BRIDGED * 30_000
    assert voyage.epochs[-1].t_ns <= log.start_ns + 7_200_000_000


def test_a_lost_sample_lets_a_rate_stray_less_than_a_long_gap(log: Log) -> None:
    rows = np.concatenate([epoch.imu for epoch in cut(with_gap(log, 10.0, 10.02)).epochs])
    held = rows["held_s"] > 0
    assert rows["dt_s"][held].sum() == pytest.approx(0.01)
    assert rows["held_s"][held] == pytest.approx(0.01 * 0.1**2)
