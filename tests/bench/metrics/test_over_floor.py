"""Joined to the harness, the floor stands under every output of a simulated log, and the lag curve is drawn on it."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.execution.task import Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.metrics import ScoreError
from fathom.bench.metrics.floor import floors
from fathom.bench.metrics.floor_ratio import FLOORS, OVER
from fathom.bench.output.figures.figures import draw_figures
from fathom.bench.output.tables.table import print_table
from fathom.bench.results.store import COLUMNS
from fathom.bench.results.summary import summarise
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import create
from rich.console import Console

pytestmark = pytest.mark.slow  # whole runs and searches: seconds each

SCENARIO = {"duration_s": 20}
PLAN = {
    "name": "f",
    "logs": [{"scenario": SCENARIO}],
    "estimators": [
        {"name": "eskf"},
        {"name": "eskf", "label": "no gps", "with": {"factors": ["dvl", "depth", "heading"]}},
        {"name": "fls", "label": "fls 1", "with": {"lag_s": 1.0}},
        {"name": "fls", "label": "fls 2", "with": {"lag_s": 2.0}},
        {"name": "fls", "label": "fls 4", "with": {"lag_s": 4.0}},
        {"name": "rts"},
    ],
    "seeds": [2, 3],
    "scores": {"floor": True, "segment_lengths_m": [10]},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("floor")


@pytest.fixture(scope="module")
def rows(folder: Path) -> pd.DataFrame:
    plan, bench = Experiment.from_dict(PLAN), WorkerCache()
    found = [row for run in plan.runs() for row in bench.execute(Task.of(plan, run)).keep(folder)]
    return pd.DataFrame(found).reindex(columns=list(COLUMNS))


def test_each_output_stands_on_the_floor_of_its_own_look_ahead_and_sensors(rows: pd.DataFrame) -> None:
    assert (rows["status"] == "done").all(), rows["cause"].tolist()
    for row in rows.to_dict("records"):
        factors = ["dvl", "depth", "heading"] if row["label"] == "no gps" else ["dvl", "depth", "heading", "gps"]
        ahead, ticks = row["lookahead_s"], np.arange(1, 21) * 1_000_000_000
        floor = floors(Scenario(**SCENARIO), int(row["seed"]), ticks, [ahead], factors)[ahead]
        variance = floor.P.diagonal(axis1=1, axis2=2)
        assert row["floor_position_m"] == pytest.approx(np.sqrt(variance[:, 3:6].sum(axis=1).mean()), rel=1e-9)
        degrees = np.degrees(np.sqrt(variance[:, :3].sum(axis=1).mean()))
        assert row["floor_attitude_deg"] == pytest.approx(degrees, rel=1e-9)
        assert row["floor_velocity_m_s"] == pytest.approx(np.sqrt(variance[:, 6:9].sum(axis=1).mean()), rel=1e-9)


def test_over_the_floor_squares_are_pooled_over_seeds(rows: pd.DataFrame) -> None:
    first = summarise(rows)[0]
    eskf = rows[(rows["label"] == "eskf")]
    for block, (score, floor) in OVER.items():
        pooled = np.sqrt((eskf[score] ** 2).sum() / (eskf[floor] ** 2).sum())
        assert first[f"over_floor_{block}"] == pytest.approx(pooled, rel=1e-9)
        assert first[f"over_floor_{block}_low"] is None  # two seeds have no interval worth the name


def test_without_being_asked_for_there_is_no_floor(folder: Path) -> None:
    plan = Experiment.from_dict(PLAN | {"scores": {}, "seeds": [2]})
    found = WorkerCache().execute(Task.of(plan, plan.runs()[0])).rows
    assert found[0]["floor_position_m"] is None
    assert summarise(pd.DataFrame(found).reindex(columns=list(COLUMNS)))[0]["over_floor_position"] is None


def test_without_noise_there_is_no_floor_to_stand_on_and_no_harm_done(folder: Path) -> None:
    plan = Experiment.from_dict(PLAN | {"logs": [{"scenario": SCENARIO | {"noise_scale": 0}}], "seeds": [2]})
    found = WorkerCache().execute(Task.of(plan, plan.runs()[0])).rows
    assert found[0]["floor_position_m"] == 0.0
    assert summarise(pd.DataFrame(found).reindex(columns=list(COLUMNS)))[0]["over_floor_position"] is None


def test_a_floor_that_cannot_be_found_leaves_the_run_its_scores(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, bench = Experiment.from_dict(PLAN | {"seeds": [2]}), WorkerCache()

    def refuse(*_: object) -> None:
        raise ScoreError("floor: no such look-ahead")

    monkeypatch.setattr(bench, "floor", refuse)
    row, *_ = bench.execute(Task.of(plan, plan.runs()[0])).rows
    assert row["status"] == "done"
    assert row["ate_rmse_m"] > 0
    assert json.loads(row["missing"])["floor: no such look-ahead"] == list(FLOORS)


@pytest.mark.parametrize("lag_s", [1.0, 2.0])
def test_smoothed_covariance_at_a_lag_equals_the_floor_of_that_lag(lag_s: float) -> None:
    """Not of a keyframe less: what comes at the very edge of the window has been seen."""
    scenario = Scenario(duration_s=30.0)
    smoothed = run_log(simulate(scenario, 1), create("fls", lag_s=lag_s, smoothed_covariance_s=1e-3)).smoothed
    bound = floors(scenario, 1, smoothed.t_ns, [lag_s])[lag_s]
    late = slice(5, None)
    ratio = smoothed.P[late].diagonal(axis1=1, axis2=2)[:, 3:9] / bound.P[late].diagonal(axis1=1, axis2=2)[:, 3:9]
    assert np.sqrt(ratio).mean(axis=0) == pytest.approx(np.ones(6), abs=4e-3)


@pytest.mark.slow
def test_the_lag_curve_and_the_floors_table_are_shown(rows: pd.DataFrame, folder: Path) -> None:
    files = {path.name for path in draw_figures(rows, folder)}
    assert {"lawnmower-tactical-lag.pdf", "lawnmower-tactical-lag.png"} <= files
    image = matplotlib.image.imread(folder / "figures" / "lawnmower-tactical-lag.png")
    assert image.std() > 0.05
    with (folder / "terminal").open("w", encoding="utf-8") as file:
        console = Console(width=120, record=True, file=file)
        print_table(rows, console)
    text = console.export_text()
    assert "over the floor" in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.slow
def test_two_lags_are_no_curve(rows: pd.DataFrame, folder: Path) -> None:
    files = {path.name for path in draw_figures(rows[~rows["label"].isin(["fls 4"])], folder)}
    assert "lawnmower-tactical-lag.png" not in files
