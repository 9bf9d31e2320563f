from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fathom.bench.errors import ExperimentError
from fathom.bench.results.store import COLUMNS, Store, load_runs, provenance


def row(**changes: Any) -> dict[str, Any]:
    identity = {"experiment": "e", "log": "l", "label": "eskf", "seed": 1, "output": "online"}
    return identity | {"status": "done", "ate_rmse_m": 1.5} | changes


def test_rows_come_back_with_absent_numbers_absent(tmp_path: Path) -> None:
    with Store(tmp_path / "new" / "runs.sqlite") as store:
        store.write([row(heading_rmse_deg=float("nan"), rpe_rmse_m=None, lookahead_s=np.inf)])
        store.write([row(seed=None, label="fls")])
    table = load_runs(tmp_path / "new")
    assert list(table.columns) == list(COLUMNS)
    assert table["ate_rmse_m"].tolist() == [1.5, 1.5]
    assert table[["heading_rmse_deg", "rpe_rmse_m", "drms_m"]].isna().all(axis=None)
    assert np.isinf(table["lookahead_s"][0])
    assert table["seed"][0] == 1
    assert pd.isna(table["seed"][1])


@pytest.mark.parametrize("seed", [1, None])
def test_a_run_replaces_all_rows_of_its_predecessor_and_no_others(tmp_path: Path, seed: int | None) -> None:
    with Store(tmp_path / "runs.sqlite") as store:
        store.write([row(seed=seed), row(seed=seed, output="smoothed")])
        store.write([row(seed=7)])
        store.write([row(seed=seed, status="failed", ate_rmse_m=None)])
        table = store.read()
    assert table["status"].tolist() == ["done", "failed"]
    assert table["output"].tolist() == ["online", "online"]


def test_a_run_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    with Store(tmp_path / "runs.sqlite") as store:
        store.write([row()])
        with pytest.raises(ExperimentError, match="cannot write"):
            store.write([row(ate_rmse_m=9.0), row(output="smoothed", no_such_column=1)])
        assert store.read()["ate_rmse_m"].tolist() == [1.5]


def test_a_run_that_cannot_be_made_keeps_what_an_earlier_one_left(tmp_path: Path) -> None:
    absent = {"status": "absent", "ate_rmse_m": None}
    with Store(tmp_path / "runs.sqlite") as store:
        store.write([row(seed=None), row(seed=None, output="smoothed")])
        assert not store.write_absent(row(seed=None, **absent))
        assert store.write_absent(row(label="new", **absent))
        assert store.write_absent(row(label="new", **absent))
        assert store.read()["status"].tolist() == ["done", "done", "absent"]


def test_two_rows_of_one_name_cannot_be(tmp_path: Path) -> None:
    with Store(tmp_path / "runs.sqlite") as store, pytest.raises(sqlite3.IntegrityError):
        store.write([row(seed=None), row(seed=None)])


def test_what_was_written_is_there_when_the_writer_is_killed(tmp_path: Path) -> None:
    store = Store(tmp_path / "runs.sqlite")
    store.write([row()])
    store.connection.execute("BEGIN")
    store.connection.execute("DELETE FROM runs")  # in flight, never committed
    assert len(load_runs(tmp_path)) == 1  # another connection, as after a kill
    store.close()
    assert len(load_runs(tmp_path)) == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("DROP COLUMN drms_m", "lacks column drms_m"),
        ("ADD COLUMN anees_position", "has an unknown column anees_position"),
    ],
)
def test_a_store_of_other_columns_is_refused_with_what_to_do_and_left_alone(
    tmp_path: Path, change: str, says: str
) -> None:
    file = tmp_path / "runs.sqlite"
    with Store(file) as store:
        store.write([row()])
    with closing(sqlite3.connect(file)) as other, other:
        other.execute(f"ALTER TABLE runs {change}")
    for use in (lambda: Store(file), lambda: load_runs(tmp_path)):
        with pytest.raises(ExperimentError, match=f"another version wrote it: it {says}; .* move it away and run"):
            use()
    with closing(sqlite3.connect(file)) as other:
        assert other.execute("SELECT count(*) FROM runs").fetchone() == (1,)


def test_the_rows_of_one_log_can_be_read_alone(tmp_path: Path) -> None:
    with Store(tmp_path / "runs.sqlite") as store:
        store.write([row()])
        store.write([row(log="m")])
        assert store.read("m")["log"].tolist() == ["m"]
        assert store.read()["log"].tolist() == ["l", "m"]


def test_a_file_that_is_no_store_is_refused_and_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "runs.sqlite"
    file.write_text("my thesis\n" * 1000)
    with pytest.raises(ExperimentError, match="not a store of runs"):
        Store(file)
    assert file.read_text().startswith("my thesis")
    with pytest.raises(ExperimentError, match="no such file"):
        load_runs(tmp_path / "elsewhere")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file, not a folder")
    with pytest.raises(ExperimentError, match="cannot be written"):
        Store(tmp_path / "out" / "e" / "runs.sqlite")


def test_provenance_names_commit_versions_and_machine() -> None:
    assert set(provenance()) == {"commit_id", "versions", "machine"}
    assert set(provenance()) <= set(COLUMNS)


def test_what_is_no_store_is_reported_plainly(tmp_path: Path) -> None:
    file = tmp_path / "runs.sqlite"
    for content in (b"", b"no database, but long enough to be read as one " * 9):
        file.write_bytes(content)
        with pytest.raises(ExperimentError, match="cannot be read as a store"):
            load_runs(tmp_path)


def test_a_store_in_a_read_only_folder_can_be_read(tmp_path: Path) -> None:
    with Store(tmp_path / "50 % of? #1" / "runs.sqlite") as store:
        store.write([row()])
    tmp_path = tmp_path / "50 % of? #1"
    assert len(load_runs(tmp_path)) == 1
    tmp_path.chmod(0o555)
    try:
        if os.access(tmp_path, os.W_OK):
            pytest.skip("to this user no folder is read-only")
        assert len(load_runs(tmp_path)) == 1
    finally:
        tmp_path.chmod(0o755)
