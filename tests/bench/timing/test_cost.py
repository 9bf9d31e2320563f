from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fathom.bench.cli.app import app
from fathom.bench.execution.task import Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.results.intervals import interval_over_seeds
from fathom.bench.results.store import COLUMNS
from fathom.bench.results.summary import records
from fathom.bench.timing.cost import BEGIN, END, LAGS_S, cost_markdown, cost_records, draw_accuracy_cost, write_cost
from fathom.bench.timing.cost import COLUMNS as HEADINGS
from fathom.estimators import ESTIMATORS
from typer.testing import CliRunner

README = Path(__file__).parents[3] / "README.md"


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    """A filter, a smoother at two lags and one over the whole log, on two seeds of one short dive."""
    plan = Experiment.from_dict(
        {
            "name": "c",
            "logs": [{"scenario": {"duration_s": 40}}],
            "estimators": [
                {"name": "eskf"},
                {"name": "window", "label": "window lag 3", "with": {"lag_s": 3}},
                {"name": "window", "label": "window lag 10", "with": {"lag_s": 10}},
                {"name": "rts"},
            ],
            "seeds": [1, 2],
        }
    )
    bench = WorkerCache()
    found = [row for run in plan.runs() for row in bench.execute(Task.of(plan, run)).rows]
    return pd.DataFrame(found).reindex(columns=list(COLUMNS))


def table_of(text: str) -> list[list[str]]:
    """The cells of the one Markdown table between the marks, its ruler left out."""
    inside = text[text.index(BEGIN) : text.index(END)]
    lines = [line for line in inside.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if not line.startswith("| ---")]


def test_a_cost_is_what_its_runs_took_by_what_they_did(rows: pd.DataFrame) -> None:
    costs = {row["label"]: row for row in cost_records(rows)}
    assert list(costs) == ["eskf", "window lag 3", "window lag 10", "rts"]
    assert [row["lag_s"] for row in costs.values()] == [0.0, 3.0, 10.0, math.inf]
    of_window = rows[(rows["label"] == "window lag 3") & (rows["output"] == "online")]
    each = [1e3 * row["total_s"] / json.loads(row["counts"])["keyframes"] for row in of_window.to_dict("records")]
    assert costs["window lag 3"]["ms_per_keyframe"] == pytest.approx(np.median(each))
    assert costs["eskf"]["ms_per_keyframe"] is None
    online = rows[rows["output"] == "online"]
    for label, row in costs.items():
        assert row["runs"] == 2
        for name in ("us_per_imu_sample", "us_per_imu_sample_with_outputs", "real_time_factor", "peak_mb"):
            assert row[name] == pytest.approx(online.loc[online["label"] == label, name].median())
        assert (
            row["cpu_us_per_imu_sample"]
            < 1.05 * row["us_per_imu_sample"]
            < 1.05 * row["us_per_imu_sample_with_outputs"]
        )


def test_the_table_has_a_line_for_each_estimator_and_names_the_machine(rows: pd.DataFrame) -> None:
    text = cost_markdown(rows)
    head, *lines = table_of(text)
    assert head == list(HEADINGS)
    assert [line[0] for line in lines] == ["`eskf`", "`window`", "`rts`"]
    window = lines[1]
    assert all(re.fullmatch(r"[\d.,]+", each) for each in window[1:6])
    assert window[6:8] == ["–", "–"]
    machine = json.loads(rows["machine"][0])
    assert machine["cpu"] in text
    for package in ("python", "numpy", "numba", "gtsam"):
        assert f"{package} {json.loads(rows['versions'][0])[package]}" in text


def test_the_figure_holds_every_output_with_its_seeds_interval(rows: pd.DataFrame) -> None:
    five = pd.concat(
        [rows[rows["seed"] == 1].assign(seed=s, ate_rmse_m=lambda of, s=s: of["ate_rmse_m"] * 1.1**s) for s in range(5)]
    )
    (axes,) = draw_accuracy_cost(five).axes
    drawn = [container for container in axes.containers if container.get_label() != "no"]
    assert len(drawn) == 5  # online: eskf, window, rts; smoothed: window, rts
    (segment,) = drawn[0].lines[2][0].get_segments()  # type: ignore[index]
    expected = interval_over_seeds(records(five[five["label"] == "eskf"]), "ate_rmse_m")
    assert (segment[0][1], segment[1][1]) == pytest.approx(expected)
    (alone,) = draw_accuracy_cost(rows).axes[0].containers[0].lines[2][0].get_segments()  # type: ignore[index]
    assert alone[0][1] == alone[1][1]  # of two seeds there is none


def test_what_is_written_can_be_read_again(rows: pd.DataFrame, tmp_path: Path) -> None:
    files = write_cost(rows, tmp_path)
    assert [file.name for file in files] == ["cost.md", "cost.csv", "accuracy-cost.pdf", "accuracy-cost.png"]
    assert table_of(files[0].read_text()) == table_of(cost_markdown(rows))
    assert pd.read_csv(files[1])["label"].tolist() == ["eskf", "window lag 3", "window lag 10", "rts"]


def test_the_experiment_prices_every_estimator_and_every_lag() -> None:
    priced = Experiment.load("cost").estimators
    assert {one.name for one in priced} == set(ESTIMATORS)
    assert f"with {Experiment.load('cost').scores.output_rate_hz:g} beliefs a second" in HEADINGS
    lags = {
        name: [one.options["lag_s"] for one in priced if one.name == name] for name in ("fls", "fls-batch", "window")
    }
    assert lags == {"fls": list(LAGS_S), "fls-batch": list(LAGS_S[:2]), "window": list(LAGS_S)}


def test_the_readme_shows_the_table_that_the_command_makes() -> None:
    text = README.read_text(encoding="utf-8")
    if BEGIN not in text:
        pytest.skip("README has no table of costs")
    head, *lines = table_of(text)
    assert head == list(HEADINGS)
    priced = dict.fromkeys(f"`{one.name}`" for one in Experiment.load("cost").estimators)
    assert [line[0] for line in lines] == list(priced)
    assert all(len(line) == len(HEADINGS) for line in lines)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["profile", "eskff"], "no estimator 'eskff'"),
        (["profile", "eskf", "-o", "{file}"], "cannot be made"),
        (["cost", "-o", "{file}"], "cannot be made"),
    ],
)
def test_what_cannot_be_profiled_or_written_is_refused_in_one_line(
    arguments: list[str], said: str, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.touch()
    result = CliRunner().invoke(app, ["timing", *(argument.format(file=file) for argument in arguments)])
    assert result.exit_code == 2
    assert said in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the system does not report peak memory")
def test_a_run_does_not_hide_in_the_memory_that_the_run_before_left() -> None:
    plan = Experiment.from_dict(
        {"name": "m", "logs": [{"scenario": {"duration_s": 60}}], "estimators": [{"name": "isam2"}], "seeds": [1]}
    )
    bench, task = WorkerCache(), Task.of(plan, plan.runs()[0])
    first, again = (bench.execute(task).rows[0]["peak_mb"] for _ in range(2))
    assert first > 5  # a graph of 300 keyframes with 15 × 15 blocks
    assert again > 0.5 * first
