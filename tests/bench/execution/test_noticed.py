"""What a run notices of its log is a note with counts; "late" is one number for every estimator."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from fathom.bench import run_log
from fathom.bench.execution.noticed import late_readings, noticed, unmeasured_height
from fathom.datasets import Scenario, simulate
from fathom.datasets.log import Log
from fathom.datasets.notes import Note, as_data
from fathom.datasets.state import THETA
from fathom.estimators import create

COUNTS = {"readings": 0, "readings_late": 0, "readings_void": 0, "imu_gaps_bridged": 0}


def kinds(notes: tuple[str, ...]) -> dict[tuple[str, str], Note]:
    return {(note.kind, note.stream): note for note in notes if isinstance(note, Note)}


def dive(**gps: object) -> Log:
    return simulate(Scenario.from_dict({"duration_s": 20.0, "gps": {"rate_hz": 2.0, **gps}}), seed=1)


def test_a_sensor_without_one_reading_is_told() -> None:
    log = dive()
    assert log.gps is not None
    gone = np.zeros(len(log.gps), bool)
    mute = replace(
        log.gps, t_ns=log.gps.t_ns[gone], received_ns=log.gps.received_ns[gone], z=log.gps.z[gone],
        sigma=log.gps.sigma[gone],
    )  # fmt: skip
    assert list(kinds(noticed(replace(log, gps=mute), COUNTS))) == [("silent", "gps")]
    assert not noticed(log, COUNTS)


def test_readings_outside_the_imu_are_told_with_their_share() -> None:
    log = dive()
    half = len(log.imu.t_ns) // 2
    imu = replace(log.imu, t_ns=log.imu.t_ns[:half], w_WI_I=log.imu.w_WI_I[:half], f_I=log.imu.f_I[:half])
    note = kinds(noticed(replace(log, imu=imu), COUNTS))["outside", "dvl"]
    assert note.of == len(log.streams["dvl"])
    assert note.share is not None
    assert 0.4 < note.share < 0.6


def test_an_estimator_is_told_of_where_the_heading_at_the_start_is_known_less_well_than_it_needs() -> None:
    log = dive()
    assert log.prior is not None
    up_B, P = log.prior.state.R_WB[2], log.prior.P.copy()
    P[THETA, THETA] += np.radians(25.0) ** 2 * np.outer(up_B, up_B)
    lost = log.with_prior(replace(log.prior, P=P))
    plain, honest = SimpleNamespace(honest_yaw_rad=np.radians(20.0)), SimpleNamespace(honest_yaw_rad=np.radians(30.0))
    assert [kinds(noticed(lost, COUNTS, one)).keys() for one in (plain, honest, object())] == [
        {("overclaims", "")},
        *2 * [set()],
    ]
    assert not noticed(log, COUNTS, plain)
    assert "25°" in noticed(lost, COUNTS, plain)[0]
    options = {"rts on eskf": {"filter": "eskf"}}
    told = {
        name: bool(noticed(lost, COUNTS, create(name.split()[0], **options.get(name, {}))))
        for name in ("eskf", "eskf-filterpy", "ukf", "rts on eskf", "iekf", "rts")
    }
    assert told == {"eskf": True, "eskf-filterpy": True, "ukf": True, "rts on eskf": True, "iekf": False, "rts": False}


def test_what_a_run_counts_is_told_worst_first() -> None:
    counts = {"readings": 200, "readings_late": 12, "readings_void": 1, "imu_gaps_bridged": 2, "late": 5, "carried": 7}
    notes = noticed(dive(), counts | {"outliers_gps": 3, "outliers_heading": 0, "merged": 0})
    assert {note.kind: note.count for note in notes} == {
        "gap": 2, "late_dropped": 5, "late": 12, "carried": 7, "void": 1, "gated": 3,
    }  # fmt: skip
    assert as_data(notes[1])["share"] == 5 / 200


def test_late_readings_are_the_same_number_for_a_filter_and_a_smoother() -> None:
    log = dive(delay_s=0.3, disorder_s=1.0)
    expected = late_readings(log, {"gps"}, log.start_ns, int(log.imu.t_ns[-1]))
    asked = (("eskf", {}), ("eskf", {"max_delay_s": 0.0}), ("dead-reckoning", {}), ("window", {"lag_s": 1.0}))
    results = [run_log(log, create(name, **options)) for name, options in asked]
    assert expected > 10
    assert [result.counts["readings_late"] for result in results] == [expected] * 4
    assert [result.counts.get("late", 0) for result in results[:2]] == [0, expected]


def test_a_height_that_nothing_measures_is_told_with_counts() -> None:
    log = dive()
    assert log.gps is not None
    assert unmeasured_height(log, log.streams) == ()
    assert unmeasured_height(log, {"dvl", "gps"}) == ()  # the fixes have one
    level = replace(log.gps, sigma=log.gps.sigma * [1.0, 1.0, np.inf])
    (note,) = unmeasured_height(replace(log, gps=level, depth=None), {"depth", "gps", "dvl"})
    n = len(log.gps)
    assert (note.kind, note.stream, note.count, note.of) == ("height", "gps", n, n)
    assert f"no depth, and {n} of {n} fixes without a height" in note
    assert "no fix" in unmeasured_height(log, {"dvl"})[0]
    assert unmeasured_height(replace(log, truth=None), {"dvl"}) == ()


def test_a_run_says_whether_the_earth_turns_if_the_latitude_is_known() -> None:
    still, turning = (simulate(Scenario(duration_s=20.0, latitude_deg=x), seed=1) for x in (None, -33.04))

    def said(log: Log, **options: object) -> list[str]:
        notes = run_log(log, create("eskf", **options)).notes
        return [str(note) for note in notes if getattr(note, "kind", "") == "earth"]

    assert said(still) == []
    assert said(turning) == ["modelled, at latitude -33.0°"]
    assert said(turning, earth_rotation=False) == ["left out (earth_rotation: false), at latitude -33.0°"]
