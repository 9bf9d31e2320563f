"""Headings, numbers and reasons are written once; what lays them out adds none of its own."""

from __future__ import annotations

import io
import json
import math
import re
from pathlib import Path

import pytest
from fathom.bench.output import cells, sheets
from fathom.bench.output.report import runs
from fathom.bench.output.tables.table import print_sheet
from rich.console import Console

OUTPUT = Path(cells.__file__).parent


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (0.0, "0"),
        (0.00012345, "0.0001"),
        (0.012345, "0.0123"),
        (1.2345, "1.23"),
        (123.45, "123"),
        (12345.6, "12,346"),
        (2.04e6, "2.0e+06"),
        (-3.456e-7, "-3.5e-07"),
        (math.inf, "inf"),
    ],
)
def test_a_number_has_three_significant_digits(value: float, written: str) -> None:
    assert cells.text(value) == written


def test_a_time_has_its_unit_beside_it_and_nees_is_per_degree_of_freedom() -> None:
    step, nees = cells.column("step_median_us"), cells.column("nees_position")
    assert [step.text(value) for value in (5.21, 999.4, 14_059.0)] == ["5.21 µs", "999 µs", "14.1 ms"]
    assert (step.heading, step.raw) == ("step\nmedian", "step median µs")
    assert nees.text(3.0) == "1.00"
    assert (nees.heading, nees.raw) == ("NEES\n/dof", "NEES")


def test_a_score_without_a_column_is_called_by_its_own_name() -> None:
    other = cells.column("segment_deg_m")
    assert (other.name, other.raw, other.axis, other.text(0.5)) == (*["segment_deg_m"] * 3, "0.500")


@pytest.mark.parametrize(
    ("output", "lookahead_s", "written"),
    [
        ("online", 0.0, "online"),
        ("smoothed", 3.0, "smoothed, lag 3 s"),
        ("smoothed", 0.0, "smoothed, lag 0 s"),
        ("smoothed", math.inf, "smoothed, whole log"),
        ("online", None, "no output"),
    ],
)
def test_an_output_is_named_by_name_and_lag(output: str, lookahead_s: float | None, written: str) -> None:
    assert cells.output_and_lag(output, lookahead_s) == written


RUN = {"status": "done", "ate_rmse_m": None, "heading_rmse_deg": None, "anees_position": None, "nis_dvl": None}
RUN |= {"over_floor_position": None, "x": None}
RUN |= {
    "missing": json.dumps(
        {
            "no attitude in the reference": ["heading_rmse_deg", "rotation_rmse_deg"],
            "no covariance": ["nees_position"],
            "no floor": ["floor_position_m"],
        }
    )
}


@pytest.mark.parametrize(
    ("score", "row", "why"),
    [
        ("ate_rmse_m", {"status": "failed"}, "no run finished"),
        ("ate_rmse_m", {"done": 0}, "no run finished"),
        ("ate_rmse_m", {"done": 2, "missing": {"ate_rmse_m": "no ground truth"}}, "no ground truth"),
        ("heading_rmse_deg", {}, "no attitude in the reference"),
        ("anees_position", {}, "no covariance"),
        ("over_floor_position", {}, "no floor"),
        ("nis_dvl", {}, "no innovations (smoothed, or late readings that a smoother ties)"),
        ("x", {}, "not defined for this run"),
        ("x", {"missing": None}, "not defined for this run"),
    ],
)
def test_a_dash_has_its_reason(score: str, row: dict[str, object], why: str) -> None:
    found = cells.cell(score, RUN | row)
    assert (found.text, found.value, found.why) == ("–", None, why)


# -- laid out ---------------------------------------------------------------------------------------------------------

HEADINGS = ("estimator", *(f"{word}\n{unit}" for word in ("error", "drift") for unit in ("m", "%", "°")))


def sheet() -> sheets.Sheet:
    numbers = [f"{1234.5 * 10**k:,.1f}" for k in range(len(HEADINGS) - 1)]
    row = [cells.Cell(number, interval="[1.23, 4.56]") for number in numbers]
    absent = [cells.Cell("–", why="no ground truth")] * len(numbers)
    lines = [
        sheets.Line("filter", row, "online", "0 s", 0.0),
        sheets.Line("an estimator with a name that goes on", row, "smoothed, lag 3 s", "3 s", 3.0),
        sheets.Line("an estimator with a name that goes on", absent, "online", "0 s", 0.0),
    ]
    return sheets.Sheet("title", ["a note"], HEADINGS, lines)


@pytest.mark.parametrize("width", [50, 80, 120, 200])
def test_no_number_is_cut_however_narrow_the_terminal_is(width: int) -> None:
    console = Console(file=io.StringIO(), width=width)
    print_sheet(sheet(), console)
    assert isinstance(console.file, io.StringIO)
    printed = console.file.getvalue()
    assert max(map(len, printed.splitlines())) <= width
    for cell in sheet().lines[0].cells:
        assert printed.count(f"{cell.text} {cell.interval}") == 2
    assert "…" not in printed
    assert (
        " ".join(printed.split()).count("– error, drift (an estimator with a name that goes on): no ground truth") == 1
    )
    assert (printed.count("title (continued)") > 0) == (printed.count("title") > 1) == (width < 200)


def test_a_name_is_not_folded_where_80_columns_have_room_for_it() -> None:
    console = Console(width=80, record=True)
    name = "fls preintegrated lag 10"
    print_sheet(sheets.Sheet("t", [], HEADINGS, [sheets.Line(name, [cells.Cell("12,345.67")] * 6)]), console)
    assert console.export_text().count(name) == 2


def test_a_name_is_not_folded_inside_a_word() -> None:
    console = Console(width=50, record=True)
    lines = [sheets.Line("survey/dead-reckoning", [cells.Cell("1234.5")] * 6)]
    print_sheet(sheets.Sheet("", [], HEADINGS, lines), console)
    text = console.export_text()
    assert text.count("survey/dead-reckoning") == text.count("────\n") > 1


def test_a_reference_is_not_said_to_be_more_than_it_is() -> None:
    assert cells.against("truth") == "ground truth"
    assert cells.against("reference") == "a reference, which is not ground truth"


def test_outputs_of_unequal_lag_are_apart_and_the_least_lag_comes_first() -> None:
    found = sheet().by_output()
    assert list(found) == ["online", "smoothed, lag 3 s"]
    assert [line.name for line in found["online"]] == ["filter", "an estimator with a name that goes on"]


def test_the_pages_script_formats_no_number() -> None:
    for script in (OUTPUT / "report").glob("*.js"):
        text = script.read_text(encoding="utf-8")
        found = re.findall(r"toFixed|toPrecision|toLocaleString|NumberFormat|%\{[xy]|hindsight|\(m\)|, m\b", text)
        assert not found, script.name


def test_the_report_says_how_many_logs_are_scored_against_what() -> None:
    row = {"label": "eskf", "seed": None, "status": "done", "align": "none", "output": "online"}
    rows = [
        row | {"log": log, "truth_kind": kind} for log, kind in zip("abc", ["truth", "reference", "truth"], strict=True)
    ]
    assert dict(runs.facts(rows[:1]))["against"] == "ground truth"
    assert dict(runs.facts(rows))["against"] == "ground truth: 2 logs; a reference, which is not ground truth: 1 log"
