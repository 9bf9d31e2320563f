"""The rate of an IMU and its lost samples, where stamps are uneven and where a rate changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.bench.inspection.findings.finding import Check
from fathom.bench.inspection.streams.rates import check_rates
from fathom.datasets import Log
from fathom.datasets.log import ImuStream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(duration_s=30.0), seed=3)


def check(log: Log, t_ns: np.ndarray) -> Check:
    """The check of the log with its first IMU samples at these times."""
    n = len(t_ns)
    return check_rates(replace(log, imu=ImuStream(t_ns, log.imu.w_WI_I[:n], log.imu.f_I[:n])))


def imu_findings(found: Check) -> list[str]:
    return [finding.message for finding in found.findings if finding.stream == "imu"]


def test_a_change_of_rate_is_stated_and_no_sample_is_missing(log: Log) -> None:
    t_ns = log.imu.t_ns
    found = check(log, np.concatenate([t_ns[:1500], t_ns[1501::2]]))
    assert " at 50 to 100 Hz" in found.facts["imu"]
    assert "lost 0.00%" in found.facts["imu"]
    assert not imu_findings(found)


def test_an_imu_stamped_in_pairs_loses_nothing_and_is_reported_once(log: Log) -> None:
    found = check(log, log.imu.t_ns + np.where(np.arange(len(log.imu.t_ns)) % 2 == 0, 4_900_000, 0))
    assert " at 100 Hz" in found.facts["imu"]
    assert "lost 0.00%" in found.facts["imu"]
    (message,) = imu_findings(found)
    assert "when they were received" in message


def test_packets_are_bunches_and_no_silence(log: Log) -> None:
    k = np.arange(len(log.imu.t_ns))
    found = check(log, log.start_ns + (k // 10 + 1) * 100_000_000 + k % 10 * 10_000)
    assert " at 100 Hz" in found.facts["imu"]
    (message,) = imu_findings(found)
    assert "come in bunches" in message


def test_lost_samples_are_counted_at_any_share_up_to_a_fifth(log: Log) -> None:
    there = np.random.default_rng(3).random(len(log.imu.t_ns)) > 0.15
    share = float(check(log, log.imu.t_ns[there]).facts["imu"].split("lost ")[1].split("%")[0])
    assert share == pytest.approx(100 * np.mean(~there), abs=0.5)


def test_an_imu_that_becomes_slow_is_found_by_its_slow_part(log: Log) -> None:
    t_ns = log.imu.t_ns
    found = check(log, np.concatenate([t_ns[:1500], t_ns[1509::10]]))
    assert any("samples at 10 Hz" in message for message in imu_findings(found))
