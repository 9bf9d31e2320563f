"""What runs noticed is told by log and kind, the worst first, on lines that fit the terminal."""

from __future__ import annotations

import io
import json
from typing import Any

import pandas as pd
import pytest
from fathom.bench.output import notices
from fathom.bench.output.tables.table import print_remarks
from fathom.bench.results.store import COLUMNS
from fathom.datasets.notes import KINDS, Note, as_data
from rich.console import Console

DROPPED = Note("dvl: 49 rows invalid dropped", "dropped", "dvl", 49, 500)
ALSO = Note("dvl: 51 rows over 2 m/s dropped", "dropped", "dvl", 51, 500)
SILENT = Note("gps: not one reading in the whole log", "silent", "gps", 0)
DAMAGE = Note("a.bag: cut off 12 bytes before a record's end", "damage")


def row(log: str, label: str, *notes: str, seed: int | None = None, **other: Any) -> dict[str, Any]:
    empty = dict.fromkeys(COLUMNS)
    told = json.dumps([as_data(note) for note in notes])
    return empty | {"log": log, "label": label, "seed": seed, "status": "done", "notes": told} | other


def gated(n: int) -> Note:
    return Note(f"gps: {n} of 60 readings rejected", "gated", "gps", n, 60)


def late(n: int) -> Note:
    return Note(f"{n} of 60 readings were late", "late", "", n, 60)


def lines(*rows: dict[str, Any]) -> list[str]:
    return [line for line, _ in notices.lines(rows)]


def test_the_worst_comes_first_and_what_is_about_the_log_is_not_told() -> None:
    every = [Note(f"{kind} told", kind, "dvl", 1, 10) for kind in reversed(KINDS)]
    told = lines(row("dive", "eskf", "how it was made", *every))
    assert [line.split(": ")[1] for line in told] == list(notices.WORDS.values())
    assert not any("how it was made" in line for line in told)


def test_rows_dropped_for_several_reasons_are_one_number() -> None:
    told = lines(row("dive", "eskf", DROPPED, ALSO), row("dive", "fls", DROPPED, ALSO))
    assert told == ["dive: left out on reading: dvl 100 of 500 (20.0 %)"]


def test_the_estimator_is_named_where_another_counts_otherwise() -> None:
    assert lines(row("dive", "eskf", gated(12)), row("dive", "fls")) == [
        "dive: gated, or given less weight: gps 12 of 60 (20.0 %) by eskf"
    ]
    assert lines(row("dive", "eskf", gated(12)), row("dive", "fls", gated(3))) == [
        "dive: gated, or given less weight: gps up to 12 of 60 (20.0 %) by eskf"
    ]
    assert lines(row("dive", "eskf", gated(12)), row("dive", "fls", gated(12))) == [
        "dive: gated, or given less weight: gps 12 of 60 (20.0 %)"
    ]


def test_every_estimator_that_overclaims_is_named() -> None:
    note = Note("the heading is unknown", "overclaims")
    told = lines(row("dive", "eskf", note), row("dive", "ukf", note), row("dive", "window"))
    assert told == ["dive: claims more than it knows (eskf, ukf): the heading is unknown"]


def test_the_worst_seed_is_told() -> None:
    told = lines(*(row("box", "eskf", gated(n), seed=n) for n in (1, 30, 2)))
    assert told == ["box: gated, or given less weight: gps up to 30 of 60 (50.0 %)"]


def test_logs_that_say_the_same_share_a_line() -> None:
    assert lines(*(row(log, "eskf", SILENT) for log in "abc")) == [
        "a, b, c: silent: gps: not one reading in the whole log"
    ]


def test_a_repair_is_told_by_what_was_done() -> None:
    told = lines(
        row("dive", "eskf", Note("truth: 47,253 rotations made exact, off by up to 1e-05", "repaired", "truth"))
    )
    assert told == ["dive: changed on reading: truth: 47,253 rotations made exact, off by up to 1e-05"]


def test_what_is_routine_has_one_line_for_all_logs() -> None:
    told = lines(row("a", "eskf", late(3)), row("b", "eskf", late(30)))
    assert told == ["b: late: 30 of 60 readings (50.0 %) (the most of 2 logs)"]


def test_a_run_without_notes_and_one_of_little_are_told() -> None:
    assert lines(row("a", "eskf", notes=None, status="failed")) == []
    told = lines(row("a", "eskf", Note("x", "dropped", "imu", 1, 100_000)))
    assert told == ["a: left out on reading: imu 1 of 100,000 (under 0.1 %)"]


@pytest.mark.parametrize("width", [80, 120])
def test_the_lines_fit_a_terminal(width: int) -> None:
    names = [f"a log with a long name, number {k}" for k in range(9)]
    frame = pd.DataFrame([row(name, "fls lag_s=3 gate.gps=0.99", DROPPED, DAMAGE, gated(12), SILENT) for name in names])
    console = Console(file=io.StringIO(), width=width)
    print_remarks(frame, console)
    assert isinstance(console.file, io.StringIO)
    printed = console.file.getvalue()
    assert max(map(len, printed.splitlines())) <= 80
    assert printed.count("cut off 12 bytes") == 1


def test_a_cause_is_shown_to_its_end_where_it_says_what_to_do() -> None:
    cause = f"ValueError: eskf: {'the heading at the start is not known; ' * 5}begin later by `from_s`, or use a filter"
    console = Console(file=io.StringIO(), width=120)
    print_remarks(pd.DataFrame([row("dive", "eskf", status="failed", cause=cause)]), console)
    assert isinstance(console.file, io.StringIO)
    printed = console.file.getvalue().splitlines()
    assert " ".join(line.strip() for line in printed) == f"dive / eskf: failed: {cause}"
    assert max(map(len, printed)) <= 80
    assert all(line.startswith("  ") for line in printed[1:])


def test_the_table_of_the_report_has_every_kind_and_sensor() -> None:
    sheet = notices.sheet([row("dive", "eskf", DROPPED, ALSO, SILENT, gated(12)), row("dive", "fls", DROPPED, ALSO)])
    assert sheet is not None
    assert [[cell.text for cell in line.cells[:4]] for line in sheet.lines] == [
        ["silent", "gps", "0", "eskf"],
        ["left out on reading", "dvl", "100 of 500 (20.0 %)", "all"],
        ["gated, or given less weight", "gps", "12 of 60 (20.0 %)", "eskf"],
    ]
    assert sheet.lines[1].cells[4].text == f"{DROPPED}; {ALSO}"
    assert notices.sheet([row("dive", "eskf", "how it was made")]) is None


def test_a_printed_table_has_a_sentence_for_each_kind() -> None:
    said = notices.sentences([row("dive", "eskf", DAMAGE, DROPPED)])
    assert said == [
        "damage: a.bag: cut off 12 bytes before a record's end",
        "left out on reading: dvl 49 of 500 (9.8 %)",
    ]


def test_a_sentence_of_one_estimator_names_it() -> None:
    height = Note("nothing measures the height", "height", "gps", 9, 9)
    assert lines(row("dive", "eskf", height), row("dive", "fls")) == [
        "dive: height (eskf): nothing measures the height"
    ]
