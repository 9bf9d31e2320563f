"""Keyframes: which reading makes one, and where every reading goes, compared with a plain list of rules."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from fathom.datasets import Scenario, simulate
from fathom.datasets.epochs import DEPTH, DVL, GPS, HEADING, READING, cut
from fathom.datasets.simulated.specs import DvlSpec, GpsSpec, HeadingSpec
from fathom.estimators import ESTIMATORS, create
from fathom.estimators.interface import MERGE_NS
from fathom.estimators.keyframes import AT_KEYFRAME, CARRIED, KEYFRAME, LONGEST_SILENCE_S, SOLVE, SUMMED, Keyframes
from fathom.estimators.smoothers import GraphSmoother
from hypothesis import given, settings
from hypothesis import strategies as st

MS = 1_000_000
ALL = np.ones(5)


def keyframes(**options: Any) -> Keyframes:
    return Keyframes(create("window", **({"merge_ns": 5 * MS} | options)), ALL, 0)


def test_filters_and_smoothers_move_readings_by_the_same_time() -> None:
    every: dict[str, Any] = {name: create(name) for name in ESTIMATORS}
    merging = {name: config.merge_ns for name, config in every.items() if hasattr(config, "merge_ns")}
    assert {"eskf", "rts", "window", "fls", "batch"} <= merging.keys()
    assert set(merging.values()) == {MERGE_NS}


def received(*readings: tuple[int, int], sigma: float = 1.0) -> np.ndarray:
    """READING rows of (kind, time in ms)."""
    rows = np.zeros(len(readings), READING)
    rows["kind"], rows["t_ns"] = [kind for kind, _ in readings], [t_ms * MS for _, t_ms in readings]
    rows["sigma"] = sigma
    return rows


def said(one: Keyframes, orders: np.ndarray) -> list[tuple[int, int, float]]:
    """The orders with times, in ms, in place of rows."""
    times = {KEYFRAME: lambda x: x / MS, SOLVE: lambda x: x}
    return [(what, k, times.get(what, lambda x: one.rows["t_ns"][x] / MS)(x)) for what, k, x in orders.tolist()]


def at(one: Keyframes, now_ms: int, *readings: tuple[int, int], sigma: float = 1.0) -> list[tuple[int, int, float]]:
    return said(one, one.take(now_ms * MS, received(*readings, sigma=sigma)))


def test_every_dvl_reading_makes_a_keyframe_and_takes_along_what_waits() -> None:
    one = keyframes()
    assert at(one, 100, (DEPTH, 100)) == []
    assert at(one, 200, (DVL, 200)) == [(KEYFRAME, 1, 200), (CARRIED, 0, 100), (AT_KEYFRAME, 1, 200), (SOLVE, 1, 0)]
    assert one.counts["carried"] == 1


def test_with_a_period_the_first_dvl_reading_after_it_makes_one() -> None:
    one = keyframes(keyframe_period_s=1.0)
    assert [at(one, t, (DVL, t)) for t in (200, 600, 990)] == [[], [], []]
    assert (KEYFRAME, 1, 996) in at(one, 996, (DVL, 996))  # within merge_ns of it


def test_where_the_dvl_is_silent_another_reading_does_and_then_time() -> None:
    one = keyframes()
    assert at(one, 400, (DEPTH, 400)) == []
    assert (KEYFRAME, 1, 500) in at(one, 500, (DEPTH, 500))
    assert [order for order in at(one, 3700) if order[0] == KEYFRAME] == [
        (KEYFRAME, 2, 1500), (KEYFRAME, 3, 2500), (KEYFRAME, 4, 3500),
    ]  # fmt: skip


def test_a_reading_within_merge_ns_is_taken_as_of_its_keyframe_and_counted() -> None:
    one = keyframes()
    orders = at(one, 210, (GPS, 203), (DVL, 200), (HEADING, 206))
    assert orders == [(KEYFRAME, 1, 200), (AT_KEYFRAME, 1, 200), (AT_KEYFRAME, 1, 203), (SOLVE, 1, 0)]
    assert one.counts["merged"] == 1
    assert [row["t_ns"][0] for row in one.not_given_out()] == [206 * MS]


def test_a_late_reading_goes_to_the_keyframe_before_it_or_is_lost_where_that_has_left() -> None:
    one = keyframes(lag_s=0.5)
    for t in (200, 400, 600):
        at(one, t, (DVL, t))
    assert at(one, 650, (GPS, 450), (HEADING, 398)) == [(AT_KEYFRAME, 2, 398), (CARRIED, 2, 450)]
    assert at(one, 1000, (DVL, 1000))[-1] == (SOLVE, 4, 3)  # 600 stays: it is not older than the lag
    assert at(one, 1050, (GPS, 450)) == []
    assert (one.counts["late"], one.counts["late_used"]) == (1, 2)


def test_a_keyframe_of_just_the_windows_age_stays() -> None:
    one = keyframes(lag_s=1.0)
    oldest = [at(one, t, (DVL, t))[-1][2] for t in range(200, 1601, 200)]
    assert oldest == [0, 0, 0, 0, 0, 1, 2, 3]


def test_an_interval_sums_from_the_reading_at_its_beginning_to_the_last_before_its_end() -> None:
    one = keyframes(dvl=["preintegrated-loose"], keyframe_period_s=0.5, dvl_between="held")
    orders = [order for t in range(100, 1001, 100) for order in at(one, t, (DVL, t))]
    assert one.not_given_out() == []  # the reading at the beginning is not to be used by itself as well
    assert [t for what, k, t in orders if (what, k) == (SUMMED, 0)] == [100, 200, 300, 400]
    assert [t for what, k, t in orders if (what, k) == (SUMMED, 1)] == [500, 600, 700, 800, 900]
    straight = keyframes(dvl=["preintegrated-loose"], keyframe_period_s=0.5, dvl_between="straight")
    orders = [order for t in range(100, 1001, 100) for order in at(straight, t, (DVL, t))]
    assert [t for what, k, t in orders if (what, k) == (SUMMED, 1)] == [500, 600, 700, 800, 900, 1000]


def test_the_reading_at_a_keyframe_goes_by_its_velocity_where_that_is_asked_for() -> None:
    one = keyframes(dvl=["preintegrated-tight", "velocity"], keyframe_period_s=0.2)
    orders = [order for t in (100, 200, 300, 400) for order in at(one, t, (DVL, t))]
    assert [order for order in orders if order[0] in (AT_KEYFRAME, SUMMED)] == [
        (AT_KEYFRAME, 1, 200), (SUMMED, 0, 100), (AT_KEYFRAME, 2, 400), (SUMMED, 1, 300),
    ]  # fmt: skip


def test_an_interval_with_a_long_silence_or_an_unmeasured_axis_is_not_summed() -> None:
    for sigma, silence_ms in ((1.0, 1600), (np.array([1.0, np.inf, np.inf]), 300)):
        one = keyframes(dvl=["preintegrated-loose"])
        at(one, 100, (DVL, 100), sigma=sigma)
        at(one, 100 + silence_ms, (DVL, 100 + silence_ms), sigma=sigma)
        orders = said(one, one.finish()) if silence_ms < 1000 else []
        assert SUMMED not in [order[0] for order in orders]
        assert one.counts["preintegrated"] == 0
        assert one.counts["not_summed"] == 1


def test_at_the_end_all_that_waits_goes_to_the_last_keyframe() -> None:
    one = keyframes()
    at(one, 200, (DVL, 200))
    at(one, 350, (DEPTH, 300))
    assert said(one, one.finish()) == [(KEYFRAME, 2, 350), (CARRIED, 1, 300), (SOLVE, 2, 0)]
    assert one.not_given_out() == []


def test_what_is_not_used_or_measures_nothing_is_passed_over() -> None:
    one = Keyframes(create("window"), np.array([np.inf, 1.0, 1.0, 1.0, 1.0]), 0)
    assert at(one, 200, (DVL, 200)) == []
    assert at(one, 300, (DEPTH, 300), sigma=np.inf) == []
    assert one.not_given_out() == []


def test_an_unknown_kind_of_reading_is_an_error() -> None:
    for kind in (-1, 5):
        with pytest.raises(ValueError, match=f"unknown kind {kind} .*known: 0 dvl"):
            keyframes().take(200 * MS, received((kind, 200)))


SMOOTHERS, FILTERS = ("fls", "isam2", "batch", "window"), ("eskf", "eskf-filterpy", "iekf", "ukf", "rts")


@pytest.mark.parametrize("name", [*SMOOTHERS, *FILTERS, "dead-reckoning"])
def test_no_pass_takes_a_reading_of_unknown_kind_for_another(name: str) -> None:
    log = simulate(Scenario(duration_s=20.0), seed=1)
    assert log.prior is not None
    run = create(name).begin(log.prior, log.rig)
    for epoch in cut(log).epochs:
        if len(epoch.readings):
            break
        run.step(epoch)
    readings = epoch.readings.copy()
    readings["kind"][0] = 5
    with pytest.raises(ValueError, match="a reading of an unknown kind" if name in FILTERS else "unknown kind 5"):
        run.step(epoch._replace(readings=readings))


# --- any readings, in any order --------------------------------------------------------------------------------------


@dataclass
class Told:
    """What became of every reading, by its number, which stands in z."""

    kind: int
    t_ns: int
    given: list[tuple[int, int]]  # what, keyframe


READINGS = st.lists(
    st.tuples(st.sampled_from([DVL, DVL, DEPTH, GPS, HEADING]), st.integers(1, 4000), st.integers(0, 900)), max_size=60
)
OPTIONS = st.fixed_dictionaries(
    {
        "dvl": st.sampled_from([["velocity"], ["preintegrated-loose"], ["preintegrated-tight", "velocity"]]),
        "dvl_between": st.sampled_from(["held", "straight"]),
        "lag_s": st.sampled_from([0.0, 0.3, 1.0, 30.0]),
        "keyframe_period_s": st.sampled_from([None, 0.4, 1.0]),
    }
)


def epochs(readings: list[tuple[int, int, int]]) -> list[tuple[int, np.ndarray]]:
    """READING rows by the time of their reception; each carries its number in z."""
    rows = received(*((kind, t_ms) for kind, t_ms, _ in readings))
    rows["z"][:, 0] = np.arange(len(readings))
    came = np.array([(t_ms + delay_ms) * MS for _, t_ms, delay_ms in readings], np.int64)
    return [(int(now_ns), rows[came == now_ns]) for now_ns in np.unique(came)]


def follow(options: GraphSmoother, readings: list[tuple[int, int, int]]) -> tuple[list[Told], list[int], Keyframes]:
    """Return what became of each reading, and the times of the keyframes, checking the order of orders on the way."""
    one, times, oldest = Keyframes(options, ALL, 0), [0], 0
    told = [Told(kind, t_ms * MS, []) for kind, t_ms, _ in readings]
    for epoch in (*epochs(readings), None):
        solved = True
        for what, k, x in (one.take(*epoch) if epoch else one.finish()).tolist():
            if what == KEYFRAME:
                assert solved, "a keyframe is solved with before the next is made"
                assert k == len(times)
                times.append(x)
                solved = False
            elif what == SOLVE:
                assert k == len(times) - 1
                assert oldest <= x <= k
                oldest, solved = x, True
                horizon_ns = times[k] - options.window_s * 1e9
                assert x == k or times[x] >= horizon_ns - 500_001
                assert x == 0 or times[x - 1] < horizon_ns
            else:
                assert oldest <= k < len(times)
                told[int(one.rows["z"][x, 0])].given.append((what, k))
        assert solved
    return told, times, one


@settings(max_examples=200, deadline=None)
@given(READINGS, OPTIONS)
def test_no_reading_is_lost_or_used_twice_and_each_goes_to_its_own_keyframe(
    readings: list[tuple[int, int, int]], options: dict[str, Any]
) -> None:
    config = create("window", **options)
    told, times, one = follow(config, readings)
    merge_ns, counts = config.merge_ns, one.counts
    assert all(b - a > merge_ns for a, b in pairwise(times))
    longest_epoch_ns = max((b - a for (a, _), (b, _) in pairwise([(0, None), *epochs(readings)])), default=0)
    silence_ns = (config.period_s + LONGEST_SILENCE_S) * 1e9 + longest_epoch_ns
    assert max((b - a for a, b in pairwise(times)), default=0) <= silence_ns
    lost = [reading for reading in told if not reading.given]
    summed = sum(what == SUMMED for reading in told for what, _ in reading.given)
    assert summed == counts["preintegrated"]
    for reading in told:
        ways = [what for what, _ in reading.given]
        assert ways.count(AT_KEYFRAME) + ways.count(CARRIED) <= 1
        assert len(ways) <= 1 or SUMMED not in ways or config.dvl_between == "straight"
        if config.dvl == {"velocity"} or reading.kind != DVL:
            assert SUMMED not in ways
        for what, k in reading.given:
            near = abs(reading.t_ns - times[k]) <= merge_ns
            assert what == SUMMED or near == (what == AT_KEYFRAME)
            if what != AT_KEYFRAME:
                assert times[k] - merge_ns <= reading.t_ns
                assert what == CARRIED or k + 1 < len(times)
                assert k + 1 == len(times) or reading.t_ns <= times[k + 1] + merge_ns
    # what has gone nowhere came too late, or begins an interval that was never summed
    if config.dvl == {"velocity"}:
        assert len(lost) == counts["late"]
    else:
        assert len([reading for reading in lost if reading.kind != DVL]) <= counts["late"] <= len(lost)


@settings(max_examples=50, deadline=None)
@given(READINGS, OPTIONS, st.integers(1, 3600))
def test_when_all_is_shifted_in_time_nothing_changes(
    readings: list[tuple[int, int, int]], options: dict[str, Any], shift_s: int
) -> None:
    config, shift_ns = create("window", **options), shift_s * 1_000_000_000
    here, there = Keyframes(config, ALL, 0), Keyframes(replace(config), ALL, shift_ns)
    for now_ns, rows in epochs(readings):
        later = rows.copy()
        later["t_ns"] += shift_ns
        a, b = here.take(now_ns, rows).copy(), there.take(now_ns + shift_ns, later).copy()
        a[a[:, 0] == KEYFRAME, 2] += shift_ns
        assert np.array_equal(a, b)


# --- the engines -----------------------------------------------------------------------------------------------------

SENSORS = {
    "as simulated": {},
    "late": {"gps": GpsSpec(delay_s=1.0), "heading": HeadingSpec(2.5, delay_s=1.0)},
    "in disorder": {"heading": HeadingSpec(3.0, disorder_s=0.7), "dvl": DvlSpec(3.7, delay_s=0.013)},
    "without a DVL": {"dvl": None},
}


@pytest.mark.parametrize("options", [{}, {"dvl": ["preintegrated-loose"], "lag_s": 1.0}], ids=["velocity", "loose"])
@pytest.mark.parametrize("sensors", SENSORS.values(), ids=SENSORS.keys())
def test_gtsam_and_window_follow_the_same_orders(
    sensors: dict[str, Any], options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = simulate(Scenario(duration_s=20.0, imu="tactical", surface_for_s=20.0, **sensors), seed=3)
    assert log.prior is not None
    followed: list[list[list[int]]] = []
    for name in ("fls", "window"):
        orders: list[list[int]] = []
        for asked in ("take", "finish"):
            decide = getattr(Keyframes, asked)

            def told(one: Keyframes, *given: Any, decide: Any = decide, orders: list[list[int]] = orders) -> np.ndarray:
                answer = decide(one, *given)
                orders.extend(answer.tolist())
                return answer

            monkeypatch.setattr(Keyframes, asked, told)
        run = create(name, **options).begin(log.prior, log.rig)
        for epoch in cut(log).epochs:
            run.step(epoch)
        run.finish()
        monkeypatch.undo()
        followed.append(orders)
    assert followed[0] == followed[1]
    assert len(followed[0]) > 50
