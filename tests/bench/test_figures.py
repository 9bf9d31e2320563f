from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from fathom.bench.drawing import looks_of
from fathom.bench.experiment import Experiment
from fathom.bench.figures import (
    draw_anees,
    draw_costs,
    draw_errors,
    draw_figures,
    draw_tracks,
    load_trajectory,
    tracks_of,
)
from fathom.bench.store import COLUMNS
from fathom.bench.summary import records, summarise
from fathom.bench.table import print_table, write_consistency, write_table
from fathom.bench.working import Bench, Task
from rich.console import Console
from scipy.stats import chi2

LABELS = ("dead-reckoning", "eskf")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("figures")


@pytest.fixture(scope="module")
def rows(folder: Path) -> pd.DataFrame:
    """Two estimators on one short dive, run in this process."""
    plan = Experiment.from_dict(
        {
            "name": "f",
            "logs": [{"scenario": {"duration_s": 40}}],
            "estimators": [{"name": label} for label in LABELS],
            "seeds": [2],
        }
    )
    bench = Bench()
    found = [row for run in plan.runs() for row in bench.execute(Task.of(plan, run)).keep(folder)]
    return pd.DataFrame(found).reindex(columns=list(COLUMNS))


def test_every_figure_is_a_pdf_and_a_legible_png(rows: pd.DataFrame, folder: Path) -> None:
    files = draw_figures(rows, folder)
    names = ("lawnmower-tactical-tracks", "lawnmower-tactical-errors", "accuracy-cost")
    assert {file.name for file in files} == {f"{name}{suffix}" for name in names for suffix in (".pdf", ".png")}
    for file in files:
        if file.suffix == ".pdf":
            assert file.read_bytes().startswith(b"%PDF")
        else:
            height, width = matplotlib.image.imread(file).shape[:2]
            assert width > 1000
            assert height > 300


def test_the_tracks_have_equal_axes_and_the_truth(rows: pd.DataFrame, folder: Path) -> None:
    tracks, seed = tracks_of(records(rows), folder / "trajectories")
    assert seed == 2
    (axes,) = draw_tracks(tracks, looks_of(LABELS), "t").axes
    assert axes.get_aspect() == 1.0
    assert [line.get_label() for line in axes.lines] == ["truth", "start", *LABELS]
    assert tracks[0].truth is not None
    assert np.array_equal(axes.lines[0].get_xydata(), tracks[0].truth.p_WB_W[:, :2])


def test_a_track_that_got_lost_does_not_set_the_scale(rows: pd.DataFrame, folder: Path) -> None:
    tracks, _ = tracks_of(records(rows), folder / "trajectories")
    before = draw_tracks(tracks, looks_of(LABELS), "t").axes[0].get_xlim()
    p = tracks[0].estimate.p_WB_W.copy()
    p[-1] = 1e6
    tracks[0] = tracks[0]._replace(estimate=replace(tracks[0].estimate, p_WB_W=p))
    assert draw_tracks(tracks, looks_of(LABELS), "t").axes[0].get_xlim()[1] < before[1] + 50


def test_the_errors_are_the_errors_and_the_band_is_three_sigma(rows: pd.DataFrame, folder: Path) -> None:
    tracks, _ = tracks_of(records(rows), folder / "trajectories")
    figure = draw_errors(tracks, looks_of(LABELS), "t")
    assert len(figure.axes) == 2 * 3
    eskf = tracks[1]
    north = figure.axes[3 + 1]
    assert eskf.truth is not None
    assert eskf.estimate.P is not None
    assert np.array_equal(north.lines[0].get_ydata(), eskf.estimate.p_WB_W[:, 1] - eskf.truth.p_WB_W[:, 1])
    (band,) = north.collections
    edge = np.abs(band.get_paths()[0].vertices[:, 1]).max()
    assert edge == pytest.approx(3 * np.sqrt(eskf.estimate.P[:, 4, 4].max()), rel=1e-6)
    assert not figure.axes[0].collections  # dead reckoning claims no covariance


def test_a_saved_trajectory_keeps_states_exactly_and_covariance_blocks(rows: pd.DataFrame, folder: Path) -> None:
    name = rows.set_index("label").loc["eskf", "trajectory"]
    trajectory = load_trajectory(folder / "trajectories" / str(name))
    assert trajectory.P is not None
    assert np.isfinite(trajectory.P[:, 3:6, 3:6]).all()
    assert np.isnan(trajectory.P[:, 0, 3]).all()
    assert (np.linalg.eigvalsh(trajectory.P[:, 3:6, 3:6]) > 0).all()


def test_every_label_has_a_look_of_its_own() -> None:
    labels = [str(k) for k in range(64)]
    looks = looks_of(labels)
    assert list(looks) == labels
    assert len({(look.colour, look.marker) for look in looks.values()}) == 64


def test_accuracy_against_cost_is_logarithmic_with_a_panel_per_log(rows: pd.DataFrame) -> None:
    axes = draw_costs(summarise(rows), looks_of(LABELS)).axes
    assert len(axes) == 1
    assert (axes[0].get_xscale(), axes[0].get_yscale()) == ("log", "log")


def test_the_terminals_table_and_the_csv_say_the_same(rows: pd.DataFrame, tmp_path: Path) -> None:
    console = Console(width=80, record=True, file=(tmp_path / "terminal").open("w"))
    print_table(rows, console)
    console.file.close()
    text = console.export_text()
    write_table(rows, tmp_path / "table.csv")
    table = pd.read_csv(tmp_path / "table.csv")
    assert table["label"].tolist() == list(LABELS)
    for _, row in table.iterrows():
        assert f"{row['ate_rmse_m']:.3g}" in text
    assert "alignment: none" in text
    assert "against the truth" in text
    assert "–" in text  # dead reckoning's NEES
    assert "…" not in text


def printed(rows: pd.DataFrame, tmp_path: Path, width: int = 100) -> str:
    with (tmp_path / "terminal").open("w") as file:
        console = Console(width=width, record=True, file=file)
        print_table(rows, console)
    return console.export_text()


def test_the_table_says_which_rpe_it_is(rows: pd.DataFrame, tmp_path: Path) -> None:
    assert "RPE over 10 m, all pairs" in " ".join(printed(rows, tmp_path).split())
    write_table(rows, tmp_path / "table.csv")
    table = pd.read_csv(tmp_path / "table.csv")
    assert table[["rpe_delta", "rpe_unit", "rpe_pairs"]].to_numpy().tolist() == [[10.0, "m", "all"]] * 2
    assert table["n_scored"].tolist() == rows["n_scored"].tolist()
    assert table["n_rpe"].tolist() == rows["n_rpe"].tolist()


def test_a_label_is_printed_as_it_stands(rows: pd.DataFrame, tmp_path: Path) -> None:
    text = printed(rows.assign(label="x%[/]y", log="a[/b]"), tmp_path)
    assert "x%[/]y" in text
    assert "a[/b]" in text


def test_the_widest_label_fits_100_columns(rows: pd.DataFrame, tmp_path: Path) -> None:
    wide = {"label": "fls preintegrated lag 10", "step_median_us": 22.8, "step_p99_us": 73.5, "real_time_factor": 3566}
    text = printed(rows.assign(**wide), tmp_path)
    assert "fls preintegrated lag 10" in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_log_whose_readings_lay_outside_is_named_with_their_number(rows: pd.DataFrame, tmp_path: Path) -> None:
    assert "outside the log" not in printed(rows, tmp_path)
    counts = '{"readings": 100, "readings_outside": 90}'
    lost = "lawnmower-tactical: 90 of 100 readings lay outside the log"
    assert printed(rows.assign(counts=counts), tmp_path).count(lost) == 1


# -- honesty ----------------------------------------------------------------------------------------------------------

JUDGED = ("dead-reckoning", "eskf", "overconfident", "rts")


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[pd.DataFrame, Path]:
    """Five seeds of a short dive, with innovations; one filter takes its DVL for five times better than it is."""
    folder = tmp_path_factory.mktemp("judged")
    wrong = {"name": "eskf", "label": "overconfident", "with": {"inflate": {"dvl": 0.2}}}
    plan = Experiment.from_dict(
        {
            "name": "h",
            "logs": [{"scenario": {"duration_s": 30, "gps": {"delay_s": 0.5}}}],
            "estimators": [{"name": "dead-reckoning"}, {"name": "eskf"}, wrong, {"name": "rts"}],
            "seeds": [1, 2, 3, 4, 5],
            "scores": {"nis": True, "nees_epochs": 6},
        }
    )
    bench = Bench()
    found = [row for run in plan.runs() for row in bench.execute(Task.of(plan, run)).keep(folder)]
    return pd.DataFrame(found).reindex(columns=list(COLUMNS)), folder


def test_the_honesty_table_tells_who_is_overconfident(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    summary = {(row["label"], row["output"]): row for row in summarise(rows)}
    honest, wrong = summary["eskf", "online"], summary["overconfident", "online"]
    assert (honest["anees_times"], honest["anees_velocity_above"]) == (6, 0)
    assert wrong["anees_velocity_above"] >= 5
    assert wrong["nis_dvl"] > 5 > 1.2 > honest["nis_dvl"] > 0.8
    assert honest["nis_gps"] is None  # it comes late
    assert summary["rts", "hindsight"]["nis_dvl"] is None
    text = printed(rows, tmp_path, 120)
    lines = text[text.index("honesty") :].splitlines()
    of = {label: next(line for line in lines if line.startswith(label)) for label in JUDGED}
    assert f"▲{wrong['anees_velocity_above']}" in of["overconfident"]
    assert "▲" not in of["eskf"]
    assert "▼" not in of["eskf"]
    assert f"{wrong['nis_dvl']:.3g}" in of["overconfident"]
    shares = [100 * honest[f"within_{k}sigma_position"] for k in (1, 2, 3)]
    assert of["eskf"].rstrip().endswith(f"{shares[0]:.0f} {shares[1]:.0f} {shares[2]:.1f}")
    assert of["dead-reckoning"].count("–") == 5 + 3 + 1
    assert "gps" not in lines[2]


def test_the_widest_honesty_table_fits_120_columns(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    labels = rows["label"].replace({label: f"{label:-<24}" for label in JUDGED})
    text = printed(
        rows.assign(label=labels, nis_dvl=9.35, nis_gps=12.3, nis_dof='{"dvl": 900, "gps": 9}'), tmp_path, 120
    )
    assert max(map(len, text.splitlines())) <= 120
    assert "1, 2, 3 σ" in text
    assert "…" not in text


def test_few_seeds_without_nis_have_no_honesty_table_and_no_figure_of_it(rows: pd.DataFrame, tmp_path: Path) -> None:
    assert "honesty" not in printed(rows, tmp_path)
    assert "late readings" not in printed(rows, tmp_path)


def test_the_csv_of_consistency_has_every_average_with_its_interval(
    judged: tuple[pd.DataFrame, Path], tmp_path: Path
) -> None:
    rows, _ = judged
    write_consistency(rows, tmp_path / "consistency.csv")
    table = pd.read_csv(tmp_path / "consistency.csv")
    of_eskf = table[(table["label"] == "eskf") & (table["score"] == "nees_all")]
    assert of_eskf["dof"].tolist() == [75] * 6
    assert of_eskf["low"].to_numpy() == pytest.approx(chi2.ppf(0.0005 / 6, 75) / 75)
    assert of_eskf["t_s"].tolist() == [2, 7, 12, 17, 22, 27]
    nis = table[(table["label"] == "eskf") & (table["score"] == "nis_dvl")].iloc[0]
    assert (nis["seeds"], nis["dof"]) == (5, 5 * 450)
    assert nis["high"] == pytest.approx(chi2.ppf(1 - 0.0005, 2250) / 2250)
    verdicts = table.assign(verdict=table["verdict"]).groupby("label")["verdict"].value_counts()
    assert verdicts["overconfident", "above"] >= 12
    assert "dead-reckoning" not in set(table["label"])
    assert ((table["per_dof"] > table["high"]) == (table["verdict"] == "above")).all()


def test_the_figure_of_nees_has_a_line_per_output_and_the_band(judged: tuple[pd.DataFrame, Path]) -> None:
    rows, folder = judged
    files = {file.name for file in draw_figures(rows, folder)}
    assert {"lawnmower-tactical-anees.pdf", "lawnmower-tactical-anees.png"} <= files
    axes = draw_anees(records(rows), looks_of(JUDGED), "t").axes
    assert [panel.get_ylabel() for panel in axes] == ["position", "attitude", "velocity", "biases", "all"]
    averages = [line for line in axes[4].lines if len(line.get_xdata()) == 6]
    assert len(averages) == 4  # eskf, overconfident, rts online and with hindsight
    (band,) = axes[4].patches
    low, high = chi2.interval(1 - 0.001 / 6, 75)
    assert [band.get_y(), band.get_y() + band.get_height()] == pytest.approx([low / 75, high / 75])


def test_what_became_of_late_readings_and_outliers_is_said(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    text = printed(rows, tmp_path, 120)
    late = text[text.index("late readings and outliers") :].splitlines()
    fixes = sum(json.loads(counts)["nis_late"] for counts in rows[rows["label"] == "eskf"]["counts"])
    assert fixes > 50
    assert next(line.split() for line in late if line.startswith("eskf"))[2:] == [str(fixes), "0", "0"]
    gated = printed(rows.assign(counts='{"readings": 1000, "late": 3, "outliers_dvl": 20}'), tmp_path, 120)
    assert "outliers" in gated
    row = next(line.split() for line in gated[gated.index("late readings") :].splitlines() if line.startswith("rts"))
    assert row[1:] == ["5,000", "0", "15", "0", "100"]


def test_a_covariance_that_is_none_is_named(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    text = printed(rows.assign(n_not_positive=2.0), tmp_path, 120)
    assert "lawnmower-tactical / rts hindsight: 10 covariances are not positive definite" in text
    assert "not positive" not in printed(rows, tmp_path, 120)
