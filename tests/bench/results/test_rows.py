"""A row that cannot be read is one failed run, wherever rows are used; the others are as they were."""

from __future__ import annotations

import io
import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fathom.bench.output.remarks import failures
from fathom.bench.output.report.page import render
from fathom.bench.output.tables.latex import latex
from fathom.bench.output.tables.table import print_table
from fathom.bench.results.select import choose
from fathom.bench.results.store import Store, load_runs
from fathom.bench.results.summary import records, summarise
from rich.console import Console

NEES = {"t_s": [1.0, 2.0], "position": [3.0, None]}
ROW: dict[str, Any] = {
    **{"experiment": "e", "log": "l", "label": "eskf", "output": "online", "status": "done", "estimator": "eskf"},
    **{"ate_rmse_m": 1.5, "n_scored": 10.0, "lookahead_s": 0.0, "truth_kind": "truth", "align": "none", "dims": "3d"},
    **{"identity": "a1b2c3d4", "step_max_us": 9.0, "nis_depth": 1.0, "commit_id": "c", "real_time_factor": 100.0},
    **{"nees_at": json.dumps(NEES), "nis_dof": '{"depth": 8}', "step_histogram": '{"100": 3}', "counts": '{"late": 1}'},
    **{"notes": '[{"kind": "about", "text": "n"}]', "versions": '{"python": "3"}', "machine": '{"cpu": "x"}'},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A store with two runs, of seeds 1 and 2."""
    with Store(tmp_path / "runs.sqlite") as store:
        for seed in (1, 2):
            spec = {"log": "l", "seed": seed, "scores": {"rpe_delta": 1.0, "rpe_unit": "m", "rpe_pairs": "all"}}
            store.write([ROW | {"seed": seed, "spec": json.dumps(spec)}])
    return tmp_path


def damage(folder: Path, column: str, value: Any) -> None:
    with closing(sqlite3.connect(folder / "runs.sqlite")) as store, store:
        store.execute(f"UPDATE runs SET {column} = ? WHERE seed = 1", (value,))


DAMAGES: list[tuple[str, Any]] = [
    ("counts", '{"late": '),
    ("counts", "[1, 2]"),
    ("counts", '{"late": "many"}'),
    ("nees_at", '{"position": [1.0]}'),
    ("nees_at", '{"t_s": [1.0], "position": [1.0, 2.0]}'),
    ("nees_at", '{"t_s": 3}'),
    ("nis_dof", '{"depth": null}'),
    ("step_histogram", '{"999999": 1}'),
    ("step_histogram", '{"x": 1}'),
    ("spec", "[]"),
    ("spec", '{"scores": "all"}'),
    ("notes", '"a text"'),
    ("notes", '["a text"]'),
    ("notes", '[{"kind": "unheard of", "text": "t"}]'),
    ("missing", '{"why": "ate"}'),
    ("versions", "numpy 2"),
    ("machine", "[" * 100_000),
    ("ate_rmse_m", "text"),
    ("ate_rmse_m", b"\x00\xff"),
    ("cause", b"\x00\xff"),
    ("status", "finished"),
    ("status", None),
    ("label", None),
    ("log", b"\xff"),
    ("output", None),
]


@pytest.mark.parametrize(("column", "value"), DAMAGES)
def test_a_damaged_row_is_one_failed_run(folder: Path, column: str, value: Any) -> None:
    damage(folder, column, value)
    rows = load_runs(folder)
    assert sorted(rows["status"]) == ["done", "failed"]
    assert rows["ate_rmse_m"].tolist()[1] == 1.5
    (cause,) = rows.loc[rows["status"] == "failed", "cause"]
    assert f"its row in the store cannot be read: {column}" in cause
    assert len(choose(folder)) == 2
    assert sum(record["done"] for record in summarise(rows)) == 1


@pytest.mark.slow
def test_many_damaged_rows_leave_tables_and_report_of_the_others(folder: Path) -> None:
    with Store(folder / "runs.sqlite") as store:
        for seed in range(3, 3 + len(DAMAGES)):
            store.write([ROW | {"seed": seed, "spec": "{}"}])
    with closing(sqlite3.connect(folder / "runs.sqlite")) as store, store:
        for seed, (column, value) in enumerate(DAMAGES, 3):
            store.execute(f"UPDATE runs SET {column} = ? WHERE seed = ?", (value, seed))
    rows, written = load_runs(folder), io.StringIO()
    print_table(rows, Console(file=written, width=300))
    failed = rows[rows["status"] == "failed"]
    assert len(failed) == len(DAMAGES)
    causes = failed.groupby(["log", "label", "cause"], dropna=False).ngroups  # seeds of one cause share a line
    assert written.getvalue().count("cannot be read") == causes
    assert "eskf" in latex(rows)
    assert "cannot be read" in render(rows, folder, ())


def test_a_text_of_other_letters_is_shown_with_what_can_be_read(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "runs.sqlite")) as store, store:
        store.execute("UPDATE runs SET cause = CAST(x'41ff42' AS TEXT) WHERE seed = 1")
    assert load_runs(folder)["cause"][0] == "A\ufffdB"


def test_a_failed_run_without_a_cause_is_told(folder: Path) -> None:
    damage(folder, "status", "failed")
    assert failures(records(load_runs(folder))) == ["l / eskf seed 1: failed: no cause is recorded"]


def test_a_score_beyond_all_bounds_stands_in_the_table_and_has_no_interval(folder: Path) -> None:
    damage(folder, "ate_rmse_m", 1e200)
    damage(folder, "floor_position_m", 1.0)
    (record,) = summarise(load_runs(folder))
    assert record["ate_rmse_m"] == float("inf")
    assert record["over_floor_position"] is None


def test_the_specs_of_seeds_share_one_text_and_are_whole_where_asked_for(folder: Path) -> None:
    shared = load_runs(folder, shared_specs=True)["spec"]
    assert shared[0] is shared[1]
    assert [json.loads(spec)["seed"] for spec in load_runs(folder)["spec"]] == [1, 2]
    assert [run.spec["seed"] for run in choose(folder)] == [1, 2]


def test_a_seed_inside_a_spec_is_not_taken_for_the_runs(folder: Path) -> None:
    spec = {"log": {"seed": 1, "path": "x"}, "seed": 1, "scores": {}}
    damage(folder, "spec", json.dumps(spec))
    assert json.loads(load_runs(folder)["spec"][0]) == spec


def test_a_store_that_another_program_holds_is_told_from_one_that_is_no_store(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fathom.bench.results.store.LOCKED_S", 0.01)
    with closing(sqlite3.connect(folder / "runs.sqlite")) as other, Store(folder / "runs.sqlite") as store:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(ValueError, match=r"database is locked.*the runs before are kept"):
            store.write([ROW | {"seed": 3}])
        assert len(load_runs(folder)) == 2
        assert len(store.read()) == 2


def test_two_readers_and_a_writer_at_once_see_whole_runs(folder: Path) -> None:
    with Store(folder / "runs.sqlite") as store:
        store.connection.execute("BEGIN IMMEDIATE")
        store.connection.execute("DELETE FROM runs WHERE seed = 1")
        assert [len(load_runs(folder)) for _ in range(2)] == [2, 2]
        store.connection.rollback()
