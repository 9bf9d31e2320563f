"""Tables and trajectories that claim to be large cost no more than they are: a bounded multiple of the file."""

from __future__ import annotations

import os
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fathom.datasets import DatasetError, Trajectory
from fathom.datasets.described.conversion import _read_trajectory
from fathom.datasets.formats.tables.columns import read_table
from fathom.datasets.formats.tables.table import Table
from limited import limited

MEGABYTES = 200
"""Of address space beside what the tests hold already: several times what any of these files may take."""


def header(shape: str, dtype: str = "<f8") -> bytes:
    """The head of an array's file."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    "shape", ["(1000000000000,)", "(1000000000000, 3)", "(3, 1000000000000)", "(0, 1000000000000)",
              "(1000000000000, 0)",
              "(-1, 3)", "(9223372036854775807, 9223372036854775807)"],
)  # fmt: skip
@pytest.mark.parametrize("dtype", ["<f8", "|u1"])
def test_an_array_is_as_large_as_its_file(tmp_path, shape, dtype):
    (tmp_path / "a.npy").write_bytes(header(shape, dtype) + bytes(64))
    with pytest.raises(DatasetError, match=r"a.npy: "):
        limited(lambda: read_table(tmp_path, Table(arrays={"a": "a.npy"}), ["a.0"]), MEGABYTES)


def test_only_the_columns_asked_for_are_read_from_an_array_of_many(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((3, 3_000_000), np.uint8))
    read = limited(lambda: read_table(tmp_path, Table(arrays={"a": "a.npy"}), ["a.2999999"]), MEGABYTES)
    assert read["a.2999999"].tolist() == [1, 1, 1]


@pytest.mark.parametrize("column", ["constant", "text"])
def test_a_parquet_file_that_unpacks_to_very_much_is_refused(tmp_path, column):
    rows = 9_000_000
    one = {"constant": pa.nulls(rows, pa.int64()), "text": pa.nulls(rows, pa.string())}
    pq.write_table(pa.table(one), tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 40_000
    with pytest.raises(DatasetError, match=r"a.parquet: its 9000000 rows would need \d+ MiB, over 1000 times the file"):
        limited(lambda: read_table(tmp_path, Table(file="a.parquet"), [], [column]), MEGABYTES)


@pytest.mark.parametrize("texts", [(), ("word",)])
def test_a_text_of_megabytes_in_every_row_of_a_parquet_file_is_not_multiplied(tmp_path, texts):
    words = pa.DictionaryArray.from_arrays(pa.array(np.zeros(20_000, np.int32)), pa.array(["x" * 1_000_000]))
    pq.write_table(pa.table({"word": words, "x": np.zeros(20_000)}), tmp_path / "a.parquet", store_schema=False)
    columns = [] if texts else ["word"]
    with pytest.raises(DatasetError, match=r"column 'word' holds 'xxx|read, as a number"):
        limited(lambda: read_table(tmp_path, Table(file="a.parquet"), columns, texts) and _refused(), MEGABYTES)


def test_a_constant_column_among_others_is_read(tmp_path):
    rows = 100_000
    pd.DataFrame({"x": np.zeros(rows), "y": np.zeros(rows)}).to_parquet(tmp_path / "a.parquet")
    assert len(limited(lambda: read_table(tmp_path, Table(file="a.parquet"), ["x"]), MEGABYTES)["x"]) == rows


def test_a_text_table_of_very_many_columns_takes_a_few_times_its_size(tmp_path):
    names = ",".join(f"c{i}" for i in range(100_000))
    (tmp_path / "a.csv").write_text(names + "\n" + (",".join(["1"] * 100_000) + "\n") * 30)
    read = limited(lambda: read_table(tmp_path, Table(file="a.csv"), ["c99999"]), MEGABYTES)
    assert read["c99999"].tolist() == [1.0] * 30


@pytest.mark.parametrize(
    "text", ["x" * 3_000_000, "1" * 3_000_000, "t,x\n1," + "9" * 3_000_000, "t,x\n" + "e" * 3_000_000]
)
def test_a_field_of_megabytes_is_refused_in_linear_time(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DatasetError):
        limited(lambda: read_table(tmp_path, Table(file="a.csv"), ["x"], ["t"]) and _refused(), MEGABYTES)


def _refused() -> None:
    raise DatasetError("read, as a number that is infinite")


def test_a_text_without_an_end_of_line_is_read_in_linear_time(tmp_path):
    def cost(n: int) -> float:
        (tmp_path / "a.csv").write_text("t,x\n" + '1,"' * n)
        begin = process_time()
        with pytest.raises(DatasetError):
            read_table(tmp_path, Table(file="a.csv"), ["x"])
        return process_time() - begin

    cost(1000)
    assert cost(200_000) < 40 * (cost(20_000) + 0.05)


@pytest.mark.parametrize("line", ["9" * 3_000_000, "0 " * 200_000, "1e999999999 0 0 0 0 0 0 1", "\x00" * 3_000_000])
def test_a_trajectory_of_one_endless_line_is_refused(tmp_path, line):
    (tmp_path / "a.tum").write_text(line)
    with pytest.raises(DatasetError, match=r"a.tum: line 1: ") as error:
        limited(lambda: Trajectory.from_tum(tmp_path / "a.tum"), MEGABYTES)
    assert len(str(error.value)) < 1000


def test_a_truth_of_ours_is_read_without_what_else_stands_in_its_file(tmp_path):
    truth = Trajectory(np.arange(3), np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))
    words = pa.DictionaryArray.from_arrays(pa.array(np.zeros(3, np.int32)), pa.array(["x" * 100_000_000]))
    table = pa.table({**truth.to_columns(), "word": words})
    pq.write_table(table, tmp_path / "a.parquet", store_schema=False)
    assert len(limited(lambda: _read_trajectory(tmp_path / "a.parquet", 0.0), MEGABYTES)) == 3


def test_a_pipe_is_no_table_and_no_trajectory(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    for read in (
        lambda: Trajectory.from_tum(tmp_path / "a.csv"),
        lambda: read_table(tmp_path, Table(file="a.csv"), ["x"]),
        lambda: read_table(tmp_path, Table(arrays={"x": "a.csv"}), ["x"]),
    ):
        with pytest.raises(DatasetError, match=r"a.csv: expected a file, found a pipe"):
            limited(read, MEGABYTES, seconds=5)
