from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from fathom.bench.drawing import COLUMN_IN, PALETTE, TEXT_PT, WIDTH_IN, looks_of
from fathom.bench.execution.task import Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.metrics.scoring import SCORES
from fathom.bench.output.estimates import load_trajectory, tracks_of
from fathom.bench.output.figures.consistency import draw_nees
from fathom.bench.output.figures.cost import draw_costs, priced
from fathom.bench.output.figures.figures import draw_figures
from fathom.bench.output.figures.step_time import draw_step_times
from fathom.bench.output.figures.track import draw_errors, draw_tracks, pages_of
from fathom.bench.output.tables.table import print_table, write_consistency, write_table
from fathom.bench.results.store import COLUMNS
from fathom.bench.results.summary import file_names, records, summarise
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
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
    bench = WorkerCache()
    found = [row for run in plan.runs() for row in bench.execute(Task.of(plan, run)).keep(folder)]
    return pd.DataFrame(found).reindex(columns=list(COLUMNS))


@pytest.fixture(scope="module")
def files(rows: pd.DataFrame, folder: Path) -> list[Path]:
    return draw_figures(rows, folder)


def test_every_figure_is_a_pdf_and_a_legible_png(files: list[Path]) -> None:
    of_log = ("nees", "step-times", "tracks", "errors")
    names = ("accuracy-cost", *(f"lawnmower-tactical-{name}" for name in of_log))
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
    figure = draw_tracks(tracks, looks_of(LABELS), "t")
    (axes,) = figure.axes
    assert axes.get_aspect() == 1.0
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["truth", "start", *LABELS]
    assert tracks[0].truth is not None
    assert np.array_equal(axes.lines[0].get_xydata(), tracks[0].truth.p_WB_W[:, :2])


def test_a_run_that_ended_before_its_first_state_has_no_track(rows: pd.DataFrame, folder: Path, tmp_path: Path) -> None:
    row = next(row for row in records(rows) if row["trajectory"] is not None) | {"truth_trajectory": None}
    whole = pd.read_parquet(folder / "trajectories" / row["trajectory"])
    for n, found in ((len(whole), 1), (0, 0)):
        whole.iloc[:n].to_parquet(tmp_path / row["trajectory"])
        assert len(tracks_of([row], tmp_path)[0]) == found


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


def test_where_heights_are_not_scored_there_is_no_panel_of_them(rows: pd.DataFrame, folder: Path) -> None:
    tracks, _ = tracks_of(records(rows.assign(dims="2d")), folder / "trajectories")
    figure = draw_errors(tracks, looks_of(LABELS), "t")
    assert [axes.get_title() for axes in figure.axes[:2]] == ["east error (m)", "north error (m)"]
    assert len(figure.axes) == 2 * 2


def test_progress_counts_the_figures(rows: pd.DataFrame, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "trajectories").symlink_to(folder / "trajectories")
    told: list[tuple[int, int]] = []
    n = len(draw_figures(rows, tmp_path, tell=lambda done, total: told.append((done, total)))) // 2
    assert told == [(k, n) for k in range(n)]


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
    assert len({(look.colour, look.dash) for look in list(looks.values())[:32]}) == 32
    first = list(looks.values())[:8]
    assert len({look.marker for look in first}) == 8  # what is left of a colour in grey print
    assert all(a.dash != b.dash for a, b in pairwise(first))


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
    assert "against ground truth" in text
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


# -- consistency -------------------------------------------------------------------------------------------------------

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
    bench = WorkerCache()
    found = [row for run in plan.runs() for row in bench.execute(Task.of(plan, run)).keep(folder)]
    return pd.DataFrame(found).reindex(columns=list(COLUMNS)), folder


def test_the_consistency_table_marks_the_overconfident(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    summary = {(row["label"], row["output"]): row for row in summarise(rows)}
    consistent, wrong = summary["eskf", "online"], summary["overconfident", "online"]
    assert (consistent["anees_times"], consistent["anees_velocity_above"]) == (6, 0)
    assert wrong["anees_velocity_above"] >= 5
    assert wrong["nis_dvl"] > 5 > 1.2 > consistent["nis_dvl"] > 0.8
    dof = sum(json.loads(text)["gps"] for text in rows[rows["label"] == "eskf"]["nis_dof"])  # late, and replayed
    low, high = chi2.interval(0.999, dof)
    assert low < consistent["nis_gps"] * dof < high
    assert summary["rts", "smoothed"]["nis_dvl"] is None
    text = printed(rows, tmp_path, 120)
    lines = text[text.index(": consistency") :].splitlines()
    of = {label: next(line for line in lines if line.startswith(label)) for label in JUDGED}
    assert f"▲{wrong['anees_velocity_above']}" in of["overconfident"]
    assert "▲" not in of["eskf"]
    assert "▼" not in of["eskf"]
    assert f"{wrong['nis_dvl']:.3g}" in of["overconfident"]
    shares = [100 * consistent[f"within_{k}sigma_position"] for k in (1, 2, 3)]
    assert of["eskf"].rstrip().endswith(f"{shares[0]:.0f} {shares[1]:.0f} {shares[2]:.1f}")
    assert of["dead-reckoning"].count("–") == 5 + 4 + 1
    assert "gps" in lines[2]


def test_the_widest_consistency_table_fits_120_columns(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    labels = rows["label"].replace({label: f"{label:-<24}" for label in JUDGED})
    text = printed(
        rows.assign(label=labels, nis_dvl=9.35, nis_gps=12.3, nis_dof='{"dvl": 900, "gps": 9}'), tmp_path, 120
    )
    assert max(map(len, text.splitlines())) <= 120
    assert "1, 2, 3 σ" in text
    assert "…" not in text


def test_few_seeds_without_nis_have_no_consistency_table(rows: pd.DataFrame, tmp_path: Path) -> None:
    assert ": consistency" not in printed(rows, tmp_path)
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
    rows, _ = judged
    axes = draw_nees(records(rows), looks_of(JUDGED), "t").axes
    blocks = ("position, 3 dof", "attitude, 3 dof", "velocity, 3 dof", "biases, 6 dof", "all, 15 dof")
    assert tuple(panel.get_title() for panel in axes[:5]) == blocks
    averages = [line for line in axes[4].lines if len(line.get_xdata()) == 6]
    assert len(averages) == 4  # eskf, overconfident, rts online and smoothed
    for band, probability in zip(axes[4].patches, (0.95, 1 - 0.001 / 6), strict=True):
        low, high = chi2.interval(probability, 75)
        assert [band.get_y(), band.get_y() + band.get_height()] == pytest.approx([low / 75, high / 75])


def test_the_band_of_one_run_is_that_of_one_chi_square(rows: pd.DataFrame) -> None:
    figure = draw_nees(records(rows), looks_of(LABELS), "t")
    low, high = chi2.interval(0.95, 3)
    band = figure.axes[0].patches[0]
    assert [band.get_y(), band.get_y() + band.get_height()] == pytest.approx([low / 3, high / 3])
    assert "one run" in figure.get_suptitle()
    (nees,) = (json.loads(row["nees_at"]) for row in records(rows) if row["label"] == "eskf")
    points = next(line for line in figure.axes[0].lines if len(line.get_xdata()) == 10)
    assert points.get_ydata() == pytest.approx(np.array(nees["position"]) / 3)


def test_late_readings_and_outliers_are_counted(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    text = printed(rows, tmp_path, 120)
    late = text[text.index("late readings and outliers") :].splitlines()
    fixes = sum(json.loads(counts)["readings_late"] for counts in rows[rows["label"] == "eskf"]["counts"])
    assert fixes > 50
    assert next(line.split() for line in late if line.startswith("eskf"))[2:] == [str(fixes), "0", "0"]
    gated = printed(rows.assign(counts='{"readings": 1000, "late": 3, "outliers_dvl": 20}'), tmp_path, 120)
    assert "outliers" in gated
    row = next(line.split() for line in gated[gated.index("late readings") :].splitlines() if line.startswith("rts"))
    assert row[1:] == ["5,000", "0", "15", "0", "100"]


def test_a_covariance_that_is_none_is_named(judged: tuple[pd.DataFrame, Path], tmp_path: Path) -> None:
    rows, _ = judged
    text = printed(rows.assign(n_not_positive=2.0), tmp_path, 120)
    assert "lawnmower-tactical / rts smoothed: 10 covariances are not positive definite" in text
    assert "not positive" not in printed(rows, tmp_path, 120)


# -- in print ---------------------------------------------------------------------------------------------------------

LONG = "a label of someone who_likes $to$ say it all, with every_option that there is, at length"
ODD = ("_hidden", "100 % of & odd # {names} $x_", LONG, "eskf°")


@pytest.fixture(scope="module")
def drawn(judged: tuple[pd.DataFrame, Path]) -> dict[str, Figure]:
    """Every kind of figure but those of ablations and lags, of estimators with odd names."""
    rows, folder = judged
    odd = rows.assign(label=rows["label"].replace(dict(zip(JUDGED, ODD, strict=True))), log=f"{LONG} log")
    every, looks = records(odd), looks_of(ODD)
    tracks, _ = tracks_of(every, folder / "trajectories")
    (page,) = pages_of(tracks)
    return {
        "tracks": draw_tracks(tracks, looks, f"{LONG} log"),
        "errors": draw_errors(page, looks, f"{LONG} log"),
        "nees": draw_nees(every, looks, f"{LONG} log"),
        "step times": draw_step_times(every, looks, f"{LONG} log"),
        "costs": draw_costs(priced(summarise(odd)), looks),
    }


def texts(figure: Figure) -> list[Text]:
    found = [text for text in figure.findobj(Text) if isinstance(text, Text)]
    return [text for text in found if text.get_visible() and text.get_text().strip()]


@pytest.mark.parametrize("name", ["tracks", "errors", "nees", "step times", "costs"])
def test_a_figure_is_as_wide_as_a_column_with_no_text_cut_off_nor_too_small(
    drawn: dict[str, Figure], name: str
) -> None:
    figure = drawn[name]
    assert figure.get_figwidth() in (COLUMN_IN, WIDTH_IN)
    figure.draw_without_rendering()
    ticks = [text for axes in figure.axes for text in (*axes.get_xticklabels(), *axes.get_yticklabels())]
    every = texts(figure)
    assert min(text.get_fontsize() for text in every) >= TEXT_PT
    legends = [legend.get_window_extent() for legend in figure.legends]
    assert legends
    panels = [axes.get_tightbbox() for axes in figure.axes if axes.axison]  # with those ticks that are drawn
    boxes = [text.get_window_extent() for text in every if text not in ticks]
    for box in (*boxes, *legends, *panels):
        assert min(box.x0, box.y0, figure.bbox.width - box.x1, figure.bbox.height - box.y1) > -1, box
    assert not any(legend.overlaps(panel) for legend in legends for panel in panels), "the legend lies on a panel"
    assert not any(a.overlaps(b) for a, b in combinations(panels, 2)), "panels lie on each other"
    assert min(axes.get_window_extent().height for axes in figure.axes) > 0.6 * figure.dpi


def test_a_label_is_drawn_as_it_stands(drawn: dict[str, Figure]) -> None:
    shown = [text.get_text() for legend in drawn["costs"].legends for text in legend.get_texts()]
    assert [" ".join(text.split()).replace(r"\$", "$") for text in shown] == [*ODD, "smoothed"]
    assert not any(text.get_usetex() for text in texts(drawn["costs"]))


def test_an_estimator_has_one_colour_in_all_figures(drawn: dict[str, Figure]) -> None:
    looks = looks_of(ODD)

    def colours(axes: Axes) -> set[str]:
        return {to_hex(line.get_color()).upper() for line in axes.lines} - {"#000000"}

    assert colours(drawn["errors"].axes[3 * 1]) == {looks[ODD[1]].colour}
    for name in ("tracks", "step times", "costs"):
        assert colours(drawn[name].axes[0]) == {look.colour for look in looks.values()}, name
    assert colours(drawn["nees"].axes[0]) == {looks[label].colour for label in ODD[1:]}  # one claims no covariance


PROTANOPIA = ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998))
DEUTERANOPIA = ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881))


@pytest.mark.parametrize("vision", [np.eye(3), PROTANOPIA, DEUTERANOPIA], ids=["all", "protan", "deutan"])
def test_the_first_six_colours_are_distinguished_by_any_eye(vision: tuple[tuple[float, ...], ...]) -> None:
    """As Machado, Oliveira & Fernandes 2009 (doi:10.1109/TVCG.2009.113) have it, in CIELAB; 2.3 is just noticeable."""
    rgb = np.array([to_rgb(colour) for colour in PALETTE[:6]])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = (linear @ np.array(vision).T).clip(0, 1)
    xyz = seen @ np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]).T
    f = np.cbrt(xyz / np.array([0.9505, 1.0, 1.089]))
    lab = np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    assert apart[np.triu_indices(6, 1)].min() > 5 * 2.3


def test_the_pdf_has_truetype_fonts_and_the_width_of_a_column(files: list[Path]) -> None:
    for file in files:
        if file.suffix == ".pdf":
            content = file.read_bytes()
            assert b"/Type3" not in content, file
            assert b"/FontFile2" in content, file
            width = float(content.split(b"/MediaBox [ 0 0 ")[1].split()[0])
            assert width / 72 == pytest.approx(COLUMN_IN) or width / 72 == pytest.approx(WIDTH_IN)


def test_more_estimators_than_fit_a_page_go_on_another(rows: pd.DataFrame, folder: Path) -> None:
    (track, _), _ = tracks_of(records(rows), folder / "trajectories")
    pages = list(pages_of([track._replace(label=str(k)) for k in range(13)]))
    assert [len(page) for page in pages] == [6, 6, 1]
    assert [track.label for page in pages for track in page] == [str(k) for k in range(13)]


@pytest.mark.parametrize(
    "lost",
    [
        {"status": "failed", "trajectory": None, "truth_trajectory": None, "nees_at": None, "step_histogram": None},
        {"status": "diverged", "trajectory": "gone.parquet"},
        {"status": "absent", "cause": "not here", "trajectory": None, "truth_trajectory": None},
    ],
    ids=["failed", "diverged", "absent"],
)
def test_where_nothing_came_to_its_end_nothing_is_drawn(
    rows: pd.DataFrame, tmp_path: Path, lost: dict[str, str | None]
) -> None:
    assert draw_figures(rows.assign(**lost), tmp_path) == []


def test_a_damaged_trajectory_is_a_sentence_and_the_others_are_drawn(
    rows: pd.DataFrame, folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder / "trajectories", tmp_path / "trajectories")
    (tmp_path / "trajectories" / "cut.parquet").write_bytes(b"PAR1 and no more")
    damaged = rows.assign(trajectory=rows["trajectory"].mask(rows["label"] == "eskf", "cut.parquet"))
    missing: list[str] = []
    files = {path.stem for path in draw_figures(damaged, tmp_path, missing=missing)}
    assert {"lawnmower-tactical-tracks", "lawnmower-tactical-errors"} <= files
    (sentence,) = missing
    assert sentence.startswith("cut.parquet: ArrowInvalid")


def test_a_figure_that_cannot_be_drawn_is_a_sentence_and_the_others_are_drawn(
    rows: pd.DataFrame, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> Figure:
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr("fathom.bench.output.figures.figures.draw_step_times", refuse)
    shutil.copytree(folder / "trajectories", tmp_path / "trajectories")
    missing: list[str] = []
    files = {path.stem for path in draw_figures(rows, tmp_path, missing=missing)}
    assert {"lawnmower-tactical-tracks", "accuracy-cost"} <= files
    assert "lawnmower-tactical-step-times" not in files
    assert missing == ["figure lawnmower-tactical-step-times cannot be drawn (ZeroDivisionError: nothing to divide by)"]


def test_the_legend_says_what_the_estimates_are_compared_with(rows: pd.DataFrame, folder: Path) -> None:
    tracks, _ = tracks_of(records(rows.assign(truth_kind="reference")), folder / "trajectories")
    figure = draw_tracks(tracks, looks_of(LABELS), "x")
    words = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert "reference" in words
    assert "truth" not in words


def test_a_long_name_has_a_file_name_of_its_own() -> None:
    names = file_names(["x" * 300, "x" * 301, "相模湾" * 90])
    assert len({name.lower() for name in names.values()}) == 3
    assert max(len(name.encode()) for name in names.values()) < 120


def test_without_a_truth_there_are_tracks_and_step_times_alone(rows: pd.DataFrame, folder: Path) -> None:
    unknown = dict.fromkeys([*SCORES, "nees_at", "truth_kind", "truth_trajectory"])
    files = draw_figures(rows.assign(**unknown), folder)
    assert {file.stem for file in files} == {"lawnmower-tactical-tracks", "lawnmower-tactical-step-times"}
