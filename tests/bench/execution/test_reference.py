"""The short versions of the shipped experiments keep their numbers; when they move, the commit says why.

`make reference` writes them anew.

One tolerance holds for all: two machines, or two versions of numpy, BLAS or the C library, round otherwise. With other
kernels for all three (Haswell's in OpenBLAS, no AVX-512 in numpy, no FMA in the C library) 3,898 of 5,068 numbers of
eighteen estimators on two missions moved, by at most 2e-10 of themselves; no iSAM2 threshold tipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fathom.bench.execution.reference import (
    COLUMNS,
    LEFT_OUT,
    LOGS_LEFT_OUT,
    SHORT,
    SHORT_RECORDED,
    reference_table,
    short_rows,
    shortened,
)
from fathom.bench.experiment.plan import Experiment, Run, shipped_experiments
from fathom.datasets.simulated.scenario import Scenario
from fathom.estimators.filters import filter_pass
from fathom.estimators.physics.imu import compile_rig

REFERENCE = Path(__file__).resolve().parents[3] / "results" / "reference"
TOLERANCE = 1e-6
QUICK = {"dead-reckoning", "eskf", "iekf", "rts"}
NAMES = list(shipped_experiments())
LONG = {"ablation", "delays", "mismatch"}
"""Whose filters alone take seconds."""
OUTPUT = ["log", "label", "output"]


def quick(run: Run) -> bool:
    return run.estimator.name in QUICK and run.log.scenario is not None


def recorded(run: Run) -> bool:
    return run.log.scenario is None


def the_rest(run: Run) -> bool:
    return not quick(run) and not recorded(run)


def reference(name: str) -> pd.DataFrame:
    return pd.read_csv(REFERENCE / f"{name}.csv").set_index(OUTPUT)


def off(found: pd.DataFrame, expected: pd.DataFrame) -> list[str]:
    """Return a line for each number that is not the expected one; a column that is not there has no numbers."""
    columns = list(dict.fromkeys([*expected, *found]))
    lines = []
    for of, now in found.reindex(columns=columns).iterrows():
        then = expected.reindex(columns=columns).loc[[of]].iloc[0]
        for column in columns:
            same = math.isclose(now[column], then[column], rel_tol=TOLERANCE)
            if not (same or (pd.isna(now[column]) and pd.isna(then[column]))):
                lines.append(f"{of} {column}: {then[column]} in the reference, {now[column]} now")
    return lines


def found(name: str, chosen: Callable[[Run], bool], data: Path | None = None) -> pd.DataFrame:
    return reference_table(short_rows(name, data, chosen)).set_index(OUTPUT)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])
        for name in NAMES
        if any(map(quick, Experiment.load(name).runs()))
    ],
)
def test_the_filters_of_a_shipped_experiment_keep_their_numbers(name: str) -> None:
    table = found(name, quick)
    assert len(table) > 0
    assert not off(table, reference(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_smoothers_of_a_shipped_experiment_keep_their_numbers(name: str) -> None:
    table = found(name, the_rest)
    assert len(table) > 0
    assert not off(table, reference(name))


@pytest.mark.slow
def test_recorded_logs_keep_their_numbers(recorded_data: Path) -> None:
    here = [name for name in SHORT_RECORDED if (recorded_data / name).is_dir()]
    if not here:
        pytest.skip(f"none of {', '.join(SHORT_RECORDED)} in {recorded_data}")
    table = found("filter_vs_smoother", lambda run: run.log.name in here, recorded_data)
    assert {log for log, *_ in table.index} == set(here)
    assert not off(table, reference("filter_vs_smoother"))


@pytest.mark.parametrize("name", NAMES)
def test_every_shipped_experiment_has_a_reference_of_all_its_estimators(name: str) -> None:
    expected, short, whole = reference(name), shortened(Experiment.load(name)), Experiment.load(name)
    assert {(log, label) for log, label, _ in expected.index} == {(r.log.name, r.estimator.label) for r in short.runs()}
    left_out = LEFT_OUT.get(name, ())
    assert short.estimators == tuple(each for each in whole.estimators if each.label not in left_out)
    assert set(left_out) <= {each.label for each in whole.estimators}
    logs_left_out = set(LOGS_LEFT_OUT.get(name, ()))
    assert logs_left_out <= {log.name for log in whole.logs}
    assert {log.name for log in whole.logs} - {log.name for log in short.logs} - logs_left_out <= {
        log.name for log in whole.logs if log.scenario is None
    }
    assert set(expected) <= set(COLUMNS)
    assert (expected["done"] == expected["runs"]).all()
    assert not [column for column in expected if column.startswith(("step_", "real_time", "us_", "peak_"))]


def test_references_are_of_shipped_experiments() -> None:
    assert {path.stem for path in REFERENCE.glob("*.csv")} == set(NAMES)


def test_a_short_mission_still_dives_turns_and_is_heard_by_gps_at_both_ends() -> None:
    log = shortened(Experiment.load("filter_vs_smoother")).logs[0].open(seed=1)
    assert log.truth is not None
    assert log.gps is not None
    assert log.truth.p_WB_W[:, 2].min() == pytest.approx(-SHORT["depth_m"], abs=0.7)
    course = np.unwrap(np.arctan2(*np.diff(log.truth.p_WB_W[:, 1::-1], axis=0).T))
    assert np.ptp(course) > 2.5  # a lawnmower turns back
    age_s = (log.gps.t_ns - log.start_ns) * 1e-9
    assert (age_s < 10).any()
    assert (age_s > 30).any()


def test_outages_keep_their_share_of_a_short_mission() -> None:
    log = next(log for log in shortened(Experiment.load("ablation")).logs if log.name == "antenna up 10 min out")
    assert log.scenario is not None
    ((start_s, end_s),) = Scenario.from_dict(log.scenario).gps.faults.outages_s  # pyright: ignore
    assert (end_s - start_s) / SHORT["duration_s"] == pytest.approx(600 / 780)


@pytest.mark.parametrize(("field", "factor"), [("gravity", 1.001), ("p_BI_B", 0.9), ("gyro_density", 1.02)])
def test_a_wrong_constant_of_the_physics_is_seen(monkeypatch: pytest.MonkeyPatch, field: str, factor: float) -> None:
    def wrong(*arguments: object) -> np.ndarray:
        record = compile_rig(*arguments)  # pyright: ignore
        record[field] *= factor
        return record

    monkeypatch.setattr(filter_pass, "compile_rig", wrong)
    lines = off(found("smoke", quick), reference("smoke"))
    assert any("eskf" in line and "ate_rmse_m" in line for line in lines)
    assert not any("dead-reckoning" in line for line in lines)  # which has a rig of its own


def test_a_number_that_moved_by_a_hundred_thousandth_is_seen() -> None:
    expected = reference("smoke")
    moved = expected.assign(rpe_rmse_m=expected["rpe_rmse_m"] * (1 + 1e-5))
    assert len(off(moved, expected)) == len(expected)
    assert not off(expected, expected)
