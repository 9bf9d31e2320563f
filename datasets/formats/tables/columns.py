"""Read columns of numbers from tables: delimited text, Parquet or NumPy arrays, without conversion of units."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...errors import DatasetError
from ...files import inside
from .parquet import check_size, unpacked
from .table import Column, Columns, Flaws, Table, check_columns, short
from .text_table import PIECE_BYTES, PIECE_ROWS, text_pieces

BOOLEANS = {"true": 1, "True": 1, "TRUE": 1, "false": 0, "False": 0, "FALSE": 0}
"""As pandas reads a column of these alone; a file is read piece by piece, so here they may be mixed with numbers."""
TEXT = np.dtypes.StringDType(na_object=np.nan)
"""Text, and NaN for an empty field."""

MOST_COLUMNS = 1000
"""Columns of an array that an error may list."""
LONGEST_WORD = 40
"""Characters of a field that an error shows."""
MOST_WORDS = 1000
"""Fields of text that are kept for messages, per column."""


def read_table(
    folder: Path, table: Table, columns: Collection[Column], texts: Collection[Column] = (), flaws: Flaws | None = None
) -> Columns:
    """Return the named columns as float64 arrays; those in `texts` unconverted (text, integers, floats, or times).

    The file is read piece by piece, and only these columns are kept.

    Args:
        folder: where the table's files are.
        table: its form.
        columns, texts: names, or indices where the table has no header.
        flaws: filled with what is no row of numbers, which is an error without it.

    Raises:
        DatasetError: no such file or column, or a field that is not a number; names the file, the row (from 0, headers
            and comments not counted) and the value.
    """
    if table.file is None:
        return _read_arrays(folder, table.arrays, [*columns, *texts], texts)
    path = inside(folder, table.file)
    wanted = dict.fromkeys([*columns, *texts])
    found = Flaws() if flaws is None else flaws
    try:
        if path.suffix == ".parquet":
            pieces = _parquet_pieces(path, wanted, texts)
        else:
            pieces = text_pieces(path, table, wanted, texts, found)
        stacked = _stacked(pieces, wanted, texts, table.decimal, found)
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from None
    except Exception as error:  # pandas and pyarrow raise many kinds for a file that is not what it seems
        raise DatasetError(f"{path}: cannot be read as a table: {str(error)[:200]}") from None
    if flaws is None:
        for column, words in found.words.items():
            row, word = next(iter(words.items()))
            raise DatasetError(f"{path}: row {row}: column {column!r} holds {word!r}, not a number")
    return stacked


def _stacked(
    pieces: Iterable[pd.DataFrame],
    wanted: Collection[Column],
    texts: Collection[Column],
    decimal: str,
    flaws: Flaws,
) -> Columns:
    """Return the wanted columns of a table that is read in one or more pieces."""
    kept: dict[Column, list[NDArray[Any]]] = {column: [] for column in wanted}
    row = 0
    for piece in pieces:
        for column, parts in kept.items():
            series = pd.Series(piece[column])
            if column in texts:
                parts.append(_as_written(series, decimal))
            else:
                numbers, words = _numbers(series, decimal)
                parts.append(numbers)
                for at, word in words.items():
                    known = flaws.words.setdefault(column, {})
                    if len(known) < MOST_WORDS:
                        known[row + at] = word
        row += len(piece)
    return {column: np.concatenate(kept.pop(column)) for column in wanted}


def _read_arrays(
    folder: Path, arrays: Mapping[str, str], wanted: Collection[Column], texts: Collection[Column]
) -> Columns:
    """Read NumPy arrays of equal length; `name.0`, `name.1` are the columns of a two-dimensional one."""
    opened = {name: _array(inside(folder, file)) for name, file in arrays.items()}
    lengths = {name: len(values) for name, values in opened.items()}
    if len(set(lengths.values())) > 1:
        raise DatasetError(f"{folder}: the arrays must be of equal length, found {lengths}")
    found: list[Column] = []
    for name, values in opened.items():
        found += [name] if values.ndim == 1 else [f"{name}.{i}" for i in range(min(values.shape[1], MOST_COLUMNS))]
    columns: Columns = {}
    for column in dict.fromkeys(wanted):
        name, _, index = str(column).rpartition(".")
        if str(column) in opened and opened[str(column)].ndim == 1:
            columns[column] = np.array(opened[str(column)])
        elif name in opened and opened[name].ndim == 2 and index.isdecimal() and int(index) < opened[name].shape[1]:
            columns[column] = np.array(opened[name][:, int(index)])
        else:
            check_columns([str(column)], found, folder)
        if columns[column].dtype.kind in "mM" and column not in texts:
            raise DatasetError(f"{folder}: array {column!r} holds times, not numbers")
    return columns


def _array(path: Path) -> NDArray[Any]:
    """Return the array of a file, not read yet.

    Raises:
        DatasetError: it is none, or not of numbers in rows and columns, or the file is shorter than it claims.
    """
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy raises many kinds for a file that is not what it seems
        raise DatasetError(f"{path}: cannot be read as an array: {str(error)[:200]}") from None
    if not isinstance(values, np.ndarray) or values.ndim not in (1, 2) or values.dtype.kind not in "iufbmM":
        raise DatasetError(f"{path}: expected numbers in rows and columns, found {getattr(values, 'shape', '?')}")
    if values.size == 0 and max(values.shape) > MOST_COLUMNS:
        raise DatasetError(f"{path}: claims the shape {values.shape}, but holds nothing")
    return values


def _parquet_pieces(path: Path, wanted: Iterable[Column], texts: Collection[Column]) -> Iterator[pd.DataFrame]:
    import pyarrow.parquet as pq

    names = [str(column) for column in wanted]
    schema = pq.read_schema(path)
    check_columns(wanted, schema.names, path)
    texts_in_it = [name for name in names if str(schema.field(name).type) in ("string", "large_string")]
    with pq.ParquetFile(path, buffer_size=PIECE_BYTES, pre_buffer=False, read_dictionary=texts_in_it) as file:
        check_size(path, file, names)
        if not file.metadata.num_rows:
            yield pd.DataFrame({name: np.zeros(0) for name in names})
        for batch in file.iter_batches(PIECE_ROWS, columns=names):
            yield pd.DataFrame({name: unpacked(batch[name], as_written=name in texts) for name in names})


def _as_written(series: pd.Series, decimal: str) -> NDArray[Any]:
    """Return integers, floats and times unchanged, and anything else as text; NaN for an empty field."""
    values = series.to_numpy()
    if values.dtype.kind != "O":
        return values
    texts = [value if absent else short(value) for value, absent in zip(values, series.isna(), strict=True)]
    if decimal != ".":
        texts = [text.replace(decimal, ".") if isinstance(text, str) else text for text in texts]
    return np.array(texts, TEXT)


def _numbers(series: pd.Series, decimal: str) -> tuple[NDArray[Any], dict[int, str]]:
    """Return float64, the nearest float of a long integer, and 1 for true; and the fields that are none, by row."""
    if pd.api.types.is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=float, na_value=np.nan), {}
    if len(series) and series.dtype.kind in "mM":
        return np.full(len(series), np.nan), {0: str(series.iloc[0])}
    numbers, words = np.full(len(series), np.nan), {}
    absent = series.isna().to_numpy()
    for row, value in enumerate(series.tolist()):
        if absent[row]:
            continue
        try:
            text = short(value) if decimal == "." else short(value).replace(decimal, ".")
            numbers[row] = BOOLEANS[text] if text in BOOLEANS else float(text.replace("_", "?"))
        except ValueError:
            words[row] = str(value)[:LONGEST_WORD]
    return numbers, words
