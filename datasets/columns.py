"""Read columns of numbers out of tables: delimited text or Parquet, values as they stand in the file."""

from __future__ import annotations

import io
from collections.abc import Collection, Iterable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .description import Column, Table
from .errors import DatasetError, nearest
from .state import LIMIT_NS, TimeArray

NS_PER = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
NO_TIME = Decimal("nan")

EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
"""Asks pandas for the nearest float64 of what is written; 3.1 reads so anyway (tried), and warns of the question."""

Columns = dict[Column, NDArray[Any]]


def read_table(folder: Path, table: Table, columns: Collection[Column], times: Collection[Column] = ()) -> Columns:
    """Return the named columns as float64 arrays; those in `times` as they are written (text, integers or floats).

    Raises:
        DatasetError: no such file or column, or a field that is not a number; names the file, the row (from 0, headers
            and comments not counted) and the value.
    """
    if table.file is None:
        return _read_arrays(folder, table.arrays, [*columns, *times])
    path = folder / table.file
    if not path.is_file():
        names = [p.name for p in path.parent.iterdir() if p.is_file()] if path.parent.is_dir() else []
        raise DatasetError(f"{path}: no such file{nearest(path.name, names)}")
    try:
        frame = _read_parquet(path) if path.suffix == ".parquet" else _read_text(path, table, times)
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from None
    except Exception as error:  # pandas and pyarrow raise many kinds for a file that is not what it seems
        raise DatasetError(f"{path}: cannot be read as a table: {str(error)[:200]}") from None

    found = list(frame.columns)
    wanted = dict.fromkeys([*columns, *times])
    for column in wanted:
        if found.count(column) > 1:
            raise DatasetError(f"{path}: {found.count(column)} columns are called {column!r}")
        if column not in found:
            named = ", ".join(str(c) for c in found[:40])
            raise DatasetError(f"{path}: no column {column!r}{nearest(str(column), map(str, found))}; found {named}")
    return {c: frame[c].to_numpy() if c in times else _numbers(pd.Series(frame[c]), path) for c in wanted}


def _read_arrays(folder: Path, arrays: Mapping[str, str], wanted: Collection[Column]) -> Columns:
    """Read NumPy arrays of one length; `name.0`, `name.1` are the columns of a two-dimensional one."""
    found: dict[str, NDArray[Any]] = {}
    for name, file in arrays.items():
        path = folder / file
        if not path.is_file():
            names = [p.name for p in path.parent.iterdir() if p.is_file()] if path.parent.is_dir() else []
            raise DatasetError(f"{path}: no such file{nearest(path.name, names)}")
        try:
            values = np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # numpy raises many kinds for a file that is not what it seems
            raise DatasetError(f"{path}: cannot be read as an array: {str(error)[:200]}") from None
        if not isinstance(values, np.ndarray) or values.ndim not in (1, 2) or values.dtype.kind not in "iufb":
            raise DatasetError(f"{path}: expected numbers in rows and columns, found {getattr(values, 'shape', '?')}")
        found |= {name: values} if values.ndim == 1 else {f"{name}.{i}": values[:, i] for i in range(values.shape[1])}
    lengths = {name: len(values) for name, values in found.items()}
    if len(set(lengths.values())) > 1:
        raise DatasetError(f"{folder}: arrays that stand side by side must be of one length, found {lengths}")
    for column in wanted:
        if str(column) not in found:
            raise DatasetError(f"{folder}: no column {column!r}{nearest(str(column), found)}; found {', '.join(found)}")
    return {column: np.array(found[str(column)]) for column in dict.fromkeys(wanted)}


def _read_parquet(path: Path) -> pd.DataFrame:
    frame = pd.read_parquet(path)
    for column in frame.columns:
        if pd.api.types.is_datetime64_any_dtype(frame[column]):
            frame[column] = frame[column].astype("datetime64[ns]").astype("int64")
    return frame


def _read_text(path: Path, table: Table, times: Collection[Column]) -> pd.DataFrame:
    try:
        lines = path.read_text(encoding=table.encoding).splitlines()
    except UnicodeDecodeError as error:
        guess = "utf-16" if error.object[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1"
        raise DatasetError(f"{path}: byte {error.start} is not {table.encoding}; set `encoding` ({guess}?)") from None
    except LookupError:
        raise DatasetError(f"{path}: unknown encoding {table.encoding!r}") from None
    lines = [line for line in lines if line.strip() and not (table.comment and line.startswith(table.comment))]
    if not lines:
        raise DatasetError(f"{path}: no rows")
    separator = r"\s+" if table.delimiter == "whitespace" else table.delimiter
    names: list[Column] = []
    if table.header:
        head = pd.read_csv(io.StringIO(lines[0]), sep=separator, header=None, dtype=str, keep_default_na=False)
        names = [str(name).strip() for name in head.iloc[0]]
        lines = lines[1:]
        if not lines:
            return pd.DataFrame({name: np.zeros(0) for name in names})
    frame = pd.read_csv(
        io.StringIO("\n".join(lines)),
        sep=separator,
        header=None,
        dtype={names.index(c) if table.header else c: str for c in times if not table.header or c in names},
        skipinitialspace=True,
        index_col=False,
        **EXACT,
    )
    if table.header:
        if len(frame.columns) == len(names) + 1 and frame.iloc[:, -1].isna().all():
            frame = frame.iloc[:, :-1]  # every row ends in a delimiter
        if len(frame.columns) != len(names):
            raise DatasetError(f"{path}: the header names {len(names)} columns, the rows have {len(frame.columns)}")
        frame.columns = pd.Index(names)
    return frame


def _numbers(series: pd.Series, path: Path) -> NDArray[Any]:
    """Return float64; an integer too long for it keeps its nearest float."""
    if pd.api.types.is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=float, na_value=np.nan)
    numbers = pd.Series(pd.to_numeric(series, errors="coerce")).to_numpy(dtype=float, na_value=np.nan)
    bad = np.flatnonzero(np.isnan(numbers) & series.notna().to_numpy())
    if len(bad):
        value = str(series.iloc[bad[0]])[:40]
        raise DatasetError(f"{path}: row {bad[0]}: column {series.name!r} holds {value!r}, not a number")
    return numbers


def times_ns(values: NDArray[Any], unit: str) -> tuple[TimeArray, NDArray[np.bool_]]:
    """Convert times as read to nanoseconds; text and integers exactly, floats to the nearest nanosecond.

    Returns:
        (n,) int64, and a mask of the rows that hold a time; the others are 0.
    """
    factor = NS_PER[unit]
    if values.dtype.kind in "iu":
        good = (np.abs(values.astype(float)) * factor) < LIMIT_NS
        return np.where(good, values, 0).astype(np.int64) * factor, good
    if values.dtype.kind in "fb":
        values = values.astype(float)
        good = np.isfinite(values)
        good[good] = np.abs(values[good]) * factor < LIMIT_NS
        safe = np.where(good, values, 0.0)
        whole = np.floor(safe)
        rest = np.rint((safe - whole) * factor).astype(np.int64)
        return whole.astype(np.int64) * factor + rest, good
    return _text_ns(values.tolist(), factor)


def _text_ns(texts: Iterable[Any], factor: int) -> tuple[TimeArray, NDArray[np.bool_]]:
    ns, good = [], []
    for text in texts:
        try:
            value = Decimal(text.strip()) * factor if isinstance(text, str) else NO_TIME
        except ArithmeticError:
            value = NO_TIME
        good.append(value.is_finite() and abs(value) < LIMIT_NS)
        ns.append(round(value) if good[-1] else 0)
    return np.array(ns, dtype=np.int64), np.array(good, dtype=bool)
