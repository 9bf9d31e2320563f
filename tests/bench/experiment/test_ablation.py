from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.colors
import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from fathom.bench.cli.app import app
from fathom.bench.drawing import PALETTE, looks_of, save
from fathom.bench.errors import ExperimentError
from fathom.bench.execution.task import Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.experiment.variants import changed, named_axes, points
from fathom.bench.metrics.comparison import Comparison
from fathom.bench.output.figures.ablation import draw_ablation
from fathom.datasets import Log
from typer.testing import CliRunner

SHORT = {"duration_s": 20}
SENSORS = ("dvl", "depth", "gps", "heading")


def experiment(logs: list[Any] | None = None, estimators: list[Any] | None = None, **more: Any) -> Experiment:
    content = {"name": "t", "logs": logs or [{"scenario": SHORT}], "estimators": estimators or [{"name": "eskf"}]}
    return Experiment.from_dict(content | more, "t.yaml")


def expanded(**entry: Any) -> dict[str, Any]:
    """Return the options of every estimator that an entry of `eskf` stands for, by label."""
    return {each.label: each.options for each in experiment(estimators=[{"name": "eskf"} | entry]).estimators}


# -- what entries stand for -------------------------------------------------------------------------------------------


def test_drop_leaves_out_one_sensor_at_a_time_beside_the_full_set() -> None:
    plan = experiment(estimators=[{"name": "eskf", "drop": list(SENSORS)}])
    used = {each.label: each.create().factors for each in plan.estimators}
    assert used == {"eskf": frozenset(SENSORS)} | {f"eskf no {name}": frozenset(SENSORS) - {name} for name in SENSORS}


def test_drop_begins_from_the_sensors_that_the_entry_uses() -> None:
    less = expanded(drop=["gps"], **{"with": {"factors": ["gps", "dvl"], "max_delay_s": 2.0}})
    assert less["eskf no gps"] == {"factors": ["dvl"], "max_delay_s": 2.0}


def test_only_keeps_each_set_of_sensors() -> None:
    found = expanded(only=[["dvl", "depth"], ["gps"], []])
    assert {label: options.get("factors") for label, options in found.items()} == {
        "eskf": None,
        "eskf only dvl + depth": ["depth", "dvl"],
        "eskf only gps": ["gps"],
        "eskf only the IMU": [],
    }


def test_a_grid_is_the_product_of_its_axes_the_last_one_fastest() -> None:
    entry = {"grid": {"max_delay_s": [0, 2.5], "inflate.dvl": [1, 3]}, "with": {"inflate": {"gps": 2}}}
    assert expanded(**entry) == {
        f"eskf max_delay_s={delay:g} inflate.dvl={dvl}": {"max_delay_s": delay, "inflate": {"gps": 2, "dvl": dvl}}
        for delay in (0, 2.5)
        for dvl in (1, 3)
    }


def test_values_may_have_names_of_their_own() -> None:
    grid = {"dvl": {"velocity": ["velocity"], "loose": ["preintegrated-loose"]}, "lag_s": [1]}
    plan = experiment(estimators=[{"name": "fls", "label": "f", "grid": grid}])
    assert [each.label for each in plan.estimators] == ["f velocity lag_s=1", "f loose lag_s=1"]
    assert plan.estimators[1].options == {"dvl": ["preintegrated-loose"], "lag_s": 1}


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.1, "x=0.1"),
        (1234567.5, "x=1234567.5"),
        (1e-9, "x=1e-09"),
        (None, "x=none"),
        (True, "x=True"),
        (["a", "b"], "x=a+b"),
        ([], "x=nothing"),
        ({"dvl": 2.0}, "x=dvl:2"),
    ],
)
def test_a_value_is_readable_in_a_label(value: Any, words: str) -> None:
    assert points(named_axes({"x": [value]})) == [(words, {"x": value})]


def test_more_runs_than_anybody_waits_for_are_refused() -> None:
    grid = {"speed_m_s": [1 + i / 100 for i in range(11)]}
    refused(
        ["11 logs · 100000 seeds · 1 estimators = 1100000 runs"],
        seeds=100_000,
        logs=[{"scenario": SHORT, "grid": grid}],
    )


def test_every_point_of_a_grid_has_its_own_drops() -> None:
    plan = experiment(
        estimators=[{"name": "fls", "grid": {"lag_s": [1, 3]}, "drop": ["gps"], "baseline": "fls lag_s=1"}]
    )
    assert [(each.label, each.baseline) for each in plan.estimators] == [
        ("fls lag_s=1", "fls lag_s=1"),
        ("fls lag_s=1 no gps", "fls lag_s=1"),
        ("fls lag_s=3", "fls lag_s=1"),
        ("fls lag_s=3 no gps", "fls lag_s=3"),
    ]
    assert plan.estimators[3].options == {"lag_s": 3, "factors": ["depth", "dvl", "heading"]}


def test_a_log_has_a_grid_over_its_scenario() -> None:
    grid = {"gps.faults.outages_s": {"calm": [], "out": [[3, 9]]}, "speed_m_s": [1, 2]}
    plan = experiment(logs=[{"name": "l", "scenario": SHORT | {"gps": {"rate_hz": 2}}, "grid": grid}])
    assert [log.name for log in plan.logs] == [f"l {words} speed_m_s={v}" for words in ("calm", "out") for v in (1, 2)]
    assert plan.logs[3].scenario == SHORT | {"gps": {"rate_hz": 2, "faults": {"outages_s": [[3, 9]]}}, "speed_m_s": 2}
    assert plan.spec(plan.runs()[-1])["log"]["gps"]["faults"]["outages_s"] == [[3.0, 9.0]]


def test_changing_a_nested_value_leaves_the_original_alone() -> None:
    before = {"a": {"b": 1, "c": 2}}
    assert changed(before, {"a.b": 5, "d.e": 6}) == {"a": {"b": 5, "c": 2}, "d": {"e": 6}}
    assert before == {"a": {"b": 1, "c": 2}}


def test_variants_survive_being_written_out_again() -> None:
    plan = experiment(estimators=[{"name": "eskf", "drop": ["gps"], "grid": {"max_delay_s": [0, 1]}}])
    again = Experiment(name="t", logs=plan.logs, estimators=plan.estimators)
    assert again.estimators == plan.estimators
    assert again.comparisons() == plan.comparisons()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"drop": ["dlv"]}, ["estimators[0].drop", "no sensor 'dlv'", "did you mean 'dvl'"]),
        ({"drop": "dvl"}, ["estimators[0].drop", "'dvl'"]),
        ({"only": [["gpss"]]}, ["estimators[0].only[0]", "did you mean 'gps'"]),
        ({"drop": ["gps"], "with": {"factors": ["dvl"]}}, ["eskf does not use 'gps'", "it uses: dvl"]),
        ({"grid": {"infalte.dvl": [1]}}, ["estimators[0]", "no option 'infalte'", "did you mean 'inflate'"]),
        ({"grid": {"inflate.dlv": [1]}}, ["estimators[0]", "no sensor 'dlv'", "did you mean 'dvl'"]),
        ({"grid": {"max_delay_s": [1, -1]}}, ["max_delay_s", "greater than or equal to 0", "-1"]),
        ({"grid": {"max_delay_s.x": [1]}, "with": {"max_delay_s": 2}}, ["max_delay_s.x", "is 2 here"]),
        ({"grid": {"max_delay_s": [1, 1.0]}}, ["estimators[0].grid", "max_delay_s: a value is there twice"]),
        ({"grid": {"max_delay_s": 3}}, ["estimators[0].grid", "max_delay_s: expected a list", "found 3"]),
        ({"grid": {"max_delay_s": []}}, ["max_delay_s: expected a list"]),
        ({"grid": ["max_delay_s"]}, ["estimators[0].grid", "expected a mapping"]),
        ({"grid": {f"k{i}": list(range(10)) for i in range(12)}}, ["= 1000000000000 points are more than 10000"]),
        ({"grid": {"robust": ["x" * 501]}}, ["robust: a value of more than 500 characters", "{name: value}"]),
        ({"baseline": "esfk"}, ["baseline", "no estimator has the label 'esfk'", "did you mean 'eskf'"]),
        ({"dorp": ["dvl"]}, ["estimators[0].dorp", "did you mean 'drop'"]),
    ],
)
def test_what_is_wrong_with_an_estimators_variants_is_named(changes: dict[str, Any], says: list[str]) -> None:
    refused(says, estimators=[{"name": "eskf"} | changes])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"grid": {"gps.faultz.outages_s": [[]]}}, ["logs[0]", "gps.faultz", "did you mean 'faults'"]),
        ({"grid": {"gps.rate_hz": ["often"]}}, ["logs[0]", "gps.rate_hz", "'often'"]),
        ({"grid": {"gps.rate_hz": [1]}, "scenario": SHORT | {"gps": None}}, ["gps.rate_hz", "'gps' is None here"]),
        ({"baseline": "lwanmower-tactical"}, ["no log has the name", "did you mean 'lawnmower-tactical'"]),
        ({"estimators": ["esfk"]}, ["lawnmower-tactical: estimators", "did you mean 'eskf'"]),
        ({"estimators": []}, ["logs[0].estimators", "at least 1"]),
        ({"log": "x", "scenario": None, "grid": {"speed_m_s": [1]}}, ["logs[0]", "`grid` is for simulated logs"]),
        ({"log": "x", "scenario": None, "baseline": "x"}, ["logs[0]", "`baseline` is for simulated logs"]),
    ],
)
def test_what_is_wrong_with_a_logs_variants_is_named(changes: dict[str, Any], says: list[str]) -> None:
    refused(says, logs=[{"scenario": SHORT} | changes])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"baseline": "eksf"}, ["no estimator has the label 'eksf'", "did you mean 'eskf'"]),
        ({"compare": ["ate_rmse"]}, ["compare", "no score to compare by 'ate_rmse'", "did you mean 'ate_rmse_m'"]),
        ({"compare": []}, ["compare"]),
        ({"compare": ["cep50_m", "cep50_m"]}, ["compare", "the score 'cep50_m' is there twice"]),
    ],
)
def test_what_is_wrong_with_a_comparison_is_named(changes: dict[str, Any], says: list[str]) -> None:
    refused(says, **changes)


def refused(says: list[str], **content: Any) -> None:
    with pytest.raises(ExperimentError) as caught:
        experiment(**content)
    assert str(caught.value).startswith("t.yaml: ")
    for words in says:
        assert words in str(caught.value)


# -- what is compared with what ---------------------------------------------------------------------------------------


def test_drops_are_compared_with_their_own_full_set_and_the_rest_with_the_baseline() -> None:
    plan = experiment(
        estimators=[
            {"name": "dead-reckoning"},
            {"name": "eskf", "drop": ["gps"]},
            {"name": "iekf", "baseline": "eskf"},
        ],
        baseline="dead-reckoning",
    )
    assert [(each.label, each.baseline_label) for each in plan.comparisons()] == [
        ("eskf", "dead-reckoning"),
        ("eskf no gps", "eskf"),
        ("iekf", "eskf"),
    ]


def test_without_a_baseline_nothing_is_compared() -> None:
    assert experiment(estimators=[{"name": "eskf"}, {"name": "fls", "grid": {"lag_s": [1, 3]}}]).comparisons() == []


def test_a_log_is_compared_with_its_baseline_estimator_by_estimator() -> None:
    plan = experiment(
        logs=[{"name": "l", "scenario": SHORT, "grid": {"speed_m_s": [1, 2]}, "baseline": "l speed_m_s=1"}],
        estimators=[{"name": "eskf"}, {"name": "iekf"}],
    )
    assert plan.comparisons() == [
        Comparison("l speed_m_s=2", label, "l speed_m_s=1", label) for label in ("eskf", "iekf")
    ]


def test_a_log_may_name_its_estimators_and_only_those_are_compared() -> None:
    plan = experiment(
        logs=[{"name": "all", "scenario": SHORT}, {"name": "some", "scenario": SHORT, "estimators": ["eskf no *"]}],
        estimators=[{"name": "eskf", "drop": ["gps", "dvl"]}],
    )
    assert [run.estimator.label for run in plan.runs() if run.log.name == "some"] == ["eskf no gps", "eskf no dvl"]
    assert {each.log for each in plan.comparisons()} == {"all"}


def test_the_shipped_ablation_is_the_whole_section() -> None:
    plan = Experiment.load("ablation")
    pairs = plan.comparisons()
    for label in ("eskf", "fls"):
        assert {Comparison("survey", f"{label} no {name}", "survey", label) for name in SENSORS} <= set(pairs)
    outages = {(each.log, each.label) for each in pairs if each.baseline_log == "antenna up no outage"}
    assert {log for log, _ in outages} == {"antenna up 2 min out", "antenna up 10 min out"}
    assert {label for _, label in outages} == {"eskf", "fls 1 s velocity"}
    by_label = {each.label: each.create() for each in plan.estimators}
    rivals = [by_label[f"fls 1 s {name}"] for name in ("velocity", "loose", "tight")]
    assert {rival.period_s for rival in rivals} == {1.0}
    assert [set(rival.dvl) for rival in rivals] == [{"velocity"}, {"preintegrated-loose"}, {"preintegrated-tight"}]
    assert len(plan.seeds) >= 10


def test_outages_of_the_shipped_ablation_are_as_long_as_they_say() -> None:
    for log, out_s in zip(Experiment.load("ablation").logs[1:], (0, 120, 600), strict=True):
        gps = log.open(seed=1).gps
        assert gps is not None
        gaps_s = np.diff(np.concatenate([[0], gps.t_ns, [780 * 10**9]])) * 1e-9
        assert gaps_s.max() == pytest.approx(max(out_s, 1), abs=2.1)
        assert (gaps_s > 5).sum() == (out_s > 0)


# -- from the file to the figure --------------------------------------------------------------------------------------


PLAN = {
    "name": "small",
    "logs": [
        {
            "name": "l",
            "scenario": {"duration_s": 20, "depth_m": 0.05, "imu": "consumer"},
            "grid": {"gps.faults.outages_s": {"heard": [], "out": [[5, 18]]}},
            "baseline": "l heard",
        }
    ],
    "estimators": [{"name": "eskf", "drop": ["dvl", "gps"]}],
    "seeds": 5,
    "compare": ["ate_rmse_m", "velocity_rmse_m_s"],
    "scores": {"segment_lengths_m": [10]},
}


def test_points_of_a_scenario_share_all_random_numbers_but_their_own() -> None:
    heard, out = (log.open(seed=3) for log in Experiment.from_dict(PLAN).logs)
    assert_same(heard, out, ("imu", "dvl", "depth", "heading"))
    assert heard.gps is not None
    assert out.gps is not None
    kept = np.isin(heard.gps.t_ns, out.gps.t_ns)
    assert 0 < kept.sum() < len(kept)
    assert np.array_equal(heard.gps.z[kept], out.gps.z)


def assert_same(one: Log, other: Log, streams: tuple[str, ...]) -> None:
    for name in streams:
        a, b = getattr(one, name), getattr(other, name)
        for field in a.__dataclass_fields__:
            assert np.array_equal(getattr(a, field), getattr(b, field)), (name, field)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a small ablation, run in this process by the command `fathom run`."""
    out = tmp_path_factory.mktemp("out")
    (out / "small.yaml").write_text(str(PLAN).replace("'", '"'))  # JSON is YAML
    with pytest.MonkeyPatch.context() as patch:
        bench = WorkerCache()
        patch.setattr(
            "fathom.bench.execution.sweep.run_all", lambda tasks, jobs: (bench.execute(task) for task in tasks)
        )
        patch.setattr("fathom.bench.output.figures.figures.tracks_of", lambda rows, folder: ([], None))
        result = CliRunner().invoke(app, ["run", str(out / "small.yaml"), "--out", str(out)])
    assert result.exit_code == 0, result.output
    (out / "small" / "printed.txt").write_text(result.output)
    return out / "small"


@pytest.fixture(scope="module")
def differences(folder: Path) -> list[dict[str, Any]]:
    table = pd.read_csv(folder / "paired.csv")
    rows = table.astype(object).where(table.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


@pytest.mark.slow
def test_one_command_runs_compares_and_draws(folder: Path, differences: list[dict[str, Any]]) -> None:
    assert len(differences) == 2 * (2 + 2 + 3)  # drops on both logs, and three estimators across the logs
    by = {(row["log"], row["label"], row["baseline_log"], row["score"]): row for row in differences}
    assert len(by) == len(differences)
    lost = by["l heard", "eskf no dvl", "l heard", "velocity_rmse_m_s"]
    assert lost["low"] > 0
    assert lost["ratio_low"] > 2
    assert (lost["pairs"], lost["rank_biserial"], lost["p_wilcoxon"]) == (5, 1.0, 2.0**-4)
    assert by["l out", "eskf no gps", "l heard", "ate_rmse_m"]["difference"] == 0  # what is dropped cannot be missed
    printed = (folder / "printed.txt").read_text()
    for words in ("l heard: against eskf", "l heard: against eskf no dvl", "l out: against eskf", "eskf no gps"):
        assert words in printed
    figures = {path.name for path in (folder / "figures").glob("*ablation*")}
    assert figures == {f"l_{log}-ablation.{suffix}" for log in ("heard", "out") for suffix in ("pdf", "png")}


@pytest.mark.slow
def test_bars_are_the_ratios_and_whiskers_their_intervals(differences: list[dict[str, Any]]) -> None:
    of_log = [row for row in differences if row["baseline_log"] == "l heard"]
    looks = looks_of(["eskf", "eskf no dvl", "eskf no gps"])
    figure = draw_ablation(of_log, looks, "l heard")
    assert len(figure.axes) == 3 * 2  # three baselines, two scores
    ate = figure.axes[0]
    expected = [row for row in of_log if (row["baseline_label"], row["score"]) == ("eskf", "ate_rmse_m")]
    assert [text.get_text() for text in ate.get_yticklabels()] == ["eskf no dvl", "eskf no gps", "l out"]
    ratios = sorted(row["ratio"] for row in expected)
    assert sorted(bar.get_x() + bar.get_width() for bar in ate.patches) == pytest.approx(ratios)
    ends = sorted(x for whiskers in ate.collections for segment in whiskers.get_segments() for x in segment[:, 0])
    assert ends == pytest.approx(sorted(row[end] for row in expected for end in ("ratio_low", "ratio_high")))
    colours = {matplotlib.colors.to_hex(bar.get_edgecolor()).upper() for axes in figure.axes for bar in axes.patches}
    assert colours == set(PALETTE[:3])


@pytest.mark.slow
def test_what_the_test_does_not_tell_from_chance_is_in_brackets(differences: list[dict[str, Any]]) -> None:
    def changes(p: float) -> list[str]:
        figure = draw_ablation([row | {"p_holm": p} for row in differences[:2]], looks_of(["eskf"]), "l")
        return [text.get_text() for axes in figure.axes for text in axes.texts]

    assert len(changes(0.01)) == 2
    assert changes(0.2) == [f"({change})" for change in changes(0.01)]


@pytest.mark.slow
def test_the_figure_is_vectors_and_a_legible_png(differences: list[dict[str, Any]], tmp_path: Path) -> None:
    smoothed_rows = [row | {"output": "smoothed", "lookahead_s": 3.0} for row in differences[:4]]
    figure = draw_ablation(differences[:4] + smoothed_rows, looks_of(["eskf"]), "l")
    pdf, png = save(figure, tmp_path / "a")
    assert pdf.read_bytes().startswith(b"%PDF")
    assert b"/Subtype /Image" not in pdf.read_bytes()
    assert matplotlib.image.imread(png).shape[1] > 1000
    faces = {matplotlib.colors.to_hex(bar.get_facecolor()) for bar in figure.axes[0].patches}
    assert len(faces) == 2
    assert "#ffffff" in faces


@pytest.mark.slow
def test_only_what_was_asked_for_is_shown(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = WorkerCache()
    monkeypatch.setattr(
        "fathom.bench.execution.sweep.run_all", lambda tasks, jobs: (bench.execute(task) for task in tasks)
    )
    monkeypatch.setattr("fathom.bench.output.figures.figures.draw_figures", lambda *_: [])
    only = ["run", str(folder.parent / "small.yaml"), "--out", str(folder.parent), "--only", "l heard/eskf no gps"]
    result = CliRunner().invoke(app, only)
    assert result.exit_code == 0, result.output
    assert "l heard: against eskf " in result.output
    assert "l out: against" not in result.output
    assert len(pd.read_csv(folder / "paired.csv")) == 14  # and the file still has all


@pytest.mark.slow
def test_a_task_knows_its_variant(folder: Path) -> None:
    plan = Experiment.from_dict(PLAN)
    row = Task.of(plan, plan.runs()[1]).row("done", None)
    assert (row["label"], row["estimator"]) == ("eskf no dvl", "eskf")
    assert '"factors": ["depth", "gps", "heading"]' in row["spec"]


def test_a_run_compared_with_itself_is_no_test() -> None:
    scenario = SHORT | {"gps": None}
    plan = experiment(
        logs=[{"name": "l", "scenario": scenario}],
        estimators=[{"name": "eskf", "drop": ["gps", "dvl"]}, {"name": "eskf", "label": "again", "baseline": "eskf"}],
        compare=["ate_rmse_m", "heading_rmse_deg"],
    )
    assert len(plan.comparisons()) == 3
    assert plan.least_tests() == 2  # without the DVL, in two scores: the log has no GPS anyway
    two_logs = [{"name": "l", "scenario": SHORT}, {"name": "m", "scenario": scenario, "baseline": "l"}]
    assert experiment(logs=two_logs, compare=["ate_rmse_m"]).least_tests() == 1
