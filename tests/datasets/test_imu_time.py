"""Gaps of an IMU are lost samples: neither jitter nor bursts nor rounded stamps nor another rate."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets.imu_time import first_sampling_ns, gaps_ns, sampling_ns

MS = 1_000_000
N = 12_000
EVEN = np.arange(1, N + 1) * 10 * MS
"""100 Hz for two minutes."""
RNG = np.random.default_rng(4)


def packets(size: int) -> np.ndarray:
    """A packet arrives when its last sample is taken; its samples are stamped 10 µs apart."""
    k = np.arange(N)
    return (k // size + 1) * size * 10 * MS + k % size * 10_000


def stalls() -> np.ndarray:
    """Every 3 s the host is late by up to eight samples, and stamps them 0.3 ms apart."""
    t_ns = EVEN.copy()
    for at in range(100, N - 10, 300):
        late = int(RNG.integers(2, 8))
        t_ns[at : at + late] = np.maximum(t_ns[at : at + late], t_ns[at + late] - np.arange(late, 0, -1) * 300_000)
    return t_ns


def rounded(rate_hz: float) -> np.ndarray:
    return np.rint(np.arange(1, int(60 * rate_hz) + 1) / rate_hz * 1e3).astype(np.int64) * MS


def jittered(share: float) -> np.ndarray:
    return np.sort(EVEN + np.rint(RNG.normal(size=N) * share * 10 * MS).astype(np.int64))


WHOLE = {
    "even": EVEN,
    "100, then 50 Hz": np.concatenate([EVEN[:6000], EVEN[6001::2]]),
    "50, then 100 Hz": np.concatenate([EVEN[:6000:2], EVEN[6000:]]),
    "100, then 10 Hz": np.concatenate([EVEN[:6000], EVEN[6009::10]]),
    "pairs, 5 and 15 ms": EVEN + np.where(np.arange(N) % 2 == 0, 4_900_000, 0),
    "pairs, 1 and 19 ms": EVEN + np.where(np.arange(N) % 2 == 0, 9 * MS, 0),
    **{f"packets of {size}": packets(size) for size in (3, 4, 8, 10, 16, 20)},
    "a host that stalls": stalls(),
    **{f"{rate} Hz in milliseconds": rounded(rate) for rate in (300, 400, 600, 800, 990, 1000)},
    **{f"jitter of {share:.0%}": jittered(share) for share in (0.05, 0.1, 0.15)},
    "two samples": EVEN[:2],
    "one sample a second": EVEN[99::100],
}


@pytest.mark.parametrize("stamps", WHOLE)
def test_stamps_without_a_lost_sample_have_no_gap(stamps: str) -> None:
    assert not gaps_ns(WHOLE[stamps]).any()


def without(t_ns: np.ndarray, first: int, lost: int) -> np.ndarray:
    return np.delete(t_ns, slice(first, first + lost))


@pytest.mark.parametrize(
    ("t_ns", "at", "gap_ms"),
    [
        (without(EVEN, 1000, 1), 1000, 10),
        (without(EVEN, 1000, 68), 1000, 680),
        (without(packets(10), 5000, 10), 5000, 100),
        (without(WHOLE["100, then 50 Hz"], 8000, 1), 8000, 20),
        (np.concatenate([EVEN[:1] - 5000 * MS, EVEN[1:]]), 1, 5000),
        (np.concatenate([EVEN[:20] - 60_000 * MS, EVEN[20:]]), 20, 60_000),
        (np.concatenate([[0], EVEN + 1_700_000_000_000 * MS]), 1, 1_700_000_000_000),
        (np.concatenate([EVEN[:3000], EVEN[3099] + np.arange(-99, 1) * 10_000, EVEN[3100:]]), 3000, 989),
    ],
    ids=["one sample", "68 samples", "a packet", "one at 50 Hz", "stale first", "stale 20", "first 0", "long stall"],
)
def test_a_gap_stands_where_samples_are_missing_and_is_as_long_as_they_are(
    t_ns: np.ndarray, at: int, gap_ms: float
) -> None:
    gaps = gaps_ns(t_ns)
    assert np.flatnonzero(gaps).tolist() == [at]
    assert gaps[at] * 1e-6 == pytest.approx(gap_ms, abs=0.02 * gap_ms)


@pytest.mark.parametrize("share", [0.01, 0.1, 0.2])
def test_samples_lost_at_random_are_all_found(share: float) -> None:
    there = np.random.default_rng(5).random(N) > share
    there[[0, -1]] = True
    assert gaps_ns(EVEN[there]).sum() == pytest.approx(np.count_nonzero(~there) * 10 * MS, rel=0.01)


def test_holes_between_bursts_are_gaps() -> None:
    """Eight samples at 100 Hz, then half a second of none: no packet waits for so long."""
    assert gaps_ns(EVEN[np.arange(N) % 58 < 8]).sum() == pytest.approx(206 * 500 * MS)


def test_sampling_follows_the_rate() -> None:
    sampling = sampling_ns(WHOLE["100, then 50 Hz"])
    assert (sampling[0], sampling[-1]) == (10 * MS, 20 * MS)
    assert np.median(sampling_ns(WHOLE["pairs, 5 and 15 ms"])) == 10 * MS
    assert np.median(sampling_ns(rounded(800))) == pytest.approx(1.25 * MS, rel=0.01)


@pytest.mark.parametrize("stamps", WHOLE)
def test_the_first_interval_needs_no_more_than_the_first_stretches(stamps: str) -> None:
    assert first_sampling_ns(WHOLE[stamps]) == sampling_ns(WHOLE[stamps])[0]
