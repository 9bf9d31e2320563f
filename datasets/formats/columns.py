"""Read columns of numbers from tables: delimited text, Parquet or NumPy arrays, without conversion of units."""

from __future__ import annotations

import codecs
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, model_validator

from ..errors import DatasetError, nearest
from ..files import regular_file

EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
"""Makes pandas read the nearest float64 of the text; 3.1 does so by default (tested), and warns about the option."""

BOOLEANS = {"true": 1, "True": 1, "TRUE": 1, "false": 0, "False": 0, "FALSE": 0}
"""As pandas reads a column of these alone; a file is read piece by piece, so here they may be mixed with numbers."""
PIECE_BYTES = 1 << 18
"""Of text at a time; larger pieces were not faster, and cost memory."""
PIECE_ROWS = 1 << 14
"""Rows at a time, about as much."""
TEXT = np.dtypes.StringDType(na_object=np.nan)

Column = int | str


class Part(BaseModel):
    """A part of a description: frozen; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Table(Part):
    """A table in a file: text, or Parquet where the name ends in .parquet; or several NumPy arrays side by side."""

    file: str | None = None
    """Path inside the folder of the recording."""
    arrays: dict[str, str] = {}
    """Instead of a file: NumPy arrays of equal length, name to path; a two-dimensional one gives `name.0`, `name.1`…"""
    delimiter: str = ","
    """Between fields; "whitespace" is any run of blanks and tabs."""
    comment: str = ""
    """Lines that begin with this are skipped, as are empty ones."""
    encoding: str = "utf-8"
    header: bool = True
    """Whether the first line names the columns; without, a column is its index, from 0."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.file is None) == (not self.arrays):
            raise ValueError("give one of `file` and `arrays`")
        return self


Columns = dict[Column, NDArray[Any]]


def read_table(folder: Path, table: Table, columns: Collection[Column], times: Collection[Column] = ()) -> Columns:
    """Return the named columns as float64 arrays; those in `times` unconverted (text, integers or floats).

    The file is read piece by piece, and only these columns are kept.

    Raises:
        DatasetError: no such file or column, or a field that is not a number; names the file, the row (from 0, headers
            and comments not counted) and the value.
    """
    if table.file is None:
        return _read_arrays(folder, table.arrays, [*columns, *times])
    path = regular_file(folder / table.file)
    wanted = dict.fromkeys([*columns, *times])
    try:
        pieces = (
            _parquet_pieces(path, wanted) if path.suffix == ".parquet" else _text_pieces(path, table, wanted, times)
        )
        return _stacked(pieces, wanted, times, path)
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from None
    except Exception as error:  # pandas and pyarrow raise many kinds for a file that is not what it seems
        raise DatasetError(f"{path}: cannot be read as a table: {str(error)[:200]}") from None


def _stacked(
    pieces: Iterable[pd.DataFrame], wanted: Collection[Column], times: Collection[Column], path: Path
) -> Columns:
    """Return the wanted columns of a table that is read in one or more pieces."""
    kept: dict[Column, list[NDArray[Any]]] = {column: [] for column in wanted}
    row = 0
    for piece in pieces:
        for column, parts in kept.items():
            series = pd.Series(piece[column])
            parts.append(_as_written(series) if column in times else _numbers(series, path, row))
        row += len(piece)
    return {column: np.concatenate(kept.pop(column)) for column in wanted}


def _check_columns(wanted: Iterable[Column], found: Sequence[Column], path: Path) -> None:
    for column in wanted:
        if found.count(column) > 1:
            raise DatasetError(f"{path}: {found.count(column)} columns are named {column!r}")
        if column not in found:
            named = ", ".join(str(c) for c in found[:40])
            raise DatasetError(f"{path}: no column {column!r}{nearest(str(column), map(str, found))}; found {named}")


def _read_arrays(folder: Path, arrays: Mapping[str, str], wanted: Collection[Column]) -> Columns:
    """Read NumPy arrays of equal length; `name.0`, `name.1` are the columns of a two-dimensional one."""
    found: dict[str, NDArray[Any]] = {}
    for name, file in arrays.items():
        path = regular_file(folder / file)
        try:
            values = np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # numpy raises many kinds for a file that is not what it seems
            raise DatasetError(f"{path}: cannot be read as an array: {str(error)[:200]}") from None
        if not isinstance(values, np.ndarray) or values.ndim not in (1, 2) or values.dtype.kind not in "iufb":
            raise DatasetError(f"{path}: expected numbers in rows and columns, found {getattr(values, 'shape', '?')}")
        found |= {name: values} if values.ndim == 1 else {f"{name}.{i}": values[:, i] for i in range(values.shape[1])}
    lengths = {name: len(values) for name, values in found.items()}
    if len(set(lengths.values())) > 1:
        raise DatasetError(f"{folder}: the arrays must be of equal length, found {lengths}")
    _check_columns(map(str, wanted), list(found), folder)
    return {column: np.array(found[str(column)]) for column in dict.fromkeys(wanted)}


def _parquet_pieces(path: Path, wanted: Iterable[Column]) -> Iterator[pd.DataFrame]:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, buffer_size=PIECE_BYTES, pre_buffer=False) as file:
        _check_columns(wanted, file.schema_arrow.names, path)
        names = [str(column) for column in wanted]
        if not file.metadata.num_rows:
            yield pd.DataFrame({name: np.zeros(0) for name in names})
        for batch in file.iter_batches(PIECE_ROWS, columns=names):
            frame = batch.to_pandas()
            for column in frame.columns:
                if pd.api.types.is_datetime64_any_dtype(frame[column]):
                    frame[column] = frame[column].astype("datetime64[ns]").astype("int64")
            yield frame


class _Lines(io.TextIOBase):
    """A text file without its empty lines and comments, for pandas to read."""

    def __init__(self, file: IO[str], comment: str) -> None:
        self.file, self.comment, self.ahead = file, comment, ""

    def _counts(self, line: str) -> bool:
        return bool(line.strip()) and not (self.comment and line.startswith(self.comment))

    def one(self) -> str:
        """Return the next line of data; "" at the end."""
        return next(filter(self._counts, self.file), "")

    def read(self, size: int | None = -1) -> str:
        """Return some whole lines of data; "" at the end."""
        text, self.ahead = self.ahead, ""
        while not text and (lines := self.file.readlines(PIECE_BYTES)):
            text = "".join(filter(self._counts, lines))
        return text


def _text_pieces(
    path: Path, table: Table, wanted: Iterable[Column], times: Collection[Column]
) -> Iterator[pd.DataFrame]:
    try:
        with path.open(encoding=table.encoding) as file:
            yield from _frames(_Lines(file, table.comment), path, table, wanted, times)
    except UnicodeDecodeError:
        raise _undecoded(path, table.encoding) from None
    except LookupError as error:
        if isinstance(error, KeyError | IndexError):
            raise
        raise DatasetError(f"{path}: unknown encoding {table.encoding!r}") from None


def _frames(
    lines: _Lines, path: Path, table: Table, wanted: Iterable[Column], times: Collection[Column]
) -> Iterator[pd.DataFrame]:
    """Yield the rows of a text table, columns by name; without a header, by index."""
    separator = r"\s+" if table.delimiter == "whitespace" else table.delimiter
    lines.ahead = lines.one()
    if not lines.ahead:
        raise DatasetError(f"{path}: no rows")
    names: list[Column] | None = None
    if table.header:
        head = pd.read_csv(io.StringIO(lines.read()), sep=separator, header=None, dtype=str, keep_default_na=False)
        names = [str(name).strip() for name in head.iloc[0]]
        _check_columns(wanted, names, path)
        lines.ahead = lines.one()
        if not lines.ahead:
            yield pd.DataFrame({name: np.zeros(0) for name in names})
            return
    reader: Any = pd.read_csv(
        lines,
        sep=separator,
        header=None,
        dtype={names.index(c) if names else c: str for c in times},
        skipinitialspace=True,
        index_col=False,
        chunksize=PIECE_ROWS,
        low_memory=False,
        **EXACT,
    )
    with reader:
        for frame in reader:
            if names is None:
                _check_columns(wanted, list(frame.columns), path)
            else:
                if len(frame.columns) == len(names) + 1 and frame.iloc[:, -1].isna().all():
                    frame = frame.iloc[:, :-1]  # every row ends in a delimiter
                if len(frame.columns) != len(names):
                    raise DatasetError(
                        f"{path}: the header names {len(names)} columns, the rows have {len(frame.columns)}"
                    )
                frame.columns = pd.Index(names)
            yield frame


def _undecoded(path: Path, encoding: str) -> DatasetError:
    """Return the error for a file that is not in this encoding, with the first wrong byte."""
    decoder = codecs.getincrementaldecoder(encoding)()
    at, final = 0, False
    with path.open("rb") as file:
        start = file.read(2)
        file.seek(0)
        while not final:
            chunk = file.read(PIECE_BYTES)
            final = not chunk
            try:
                decoder.decode(chunk, final)
            except UnicodeDecodeError as error:
                at += (
                    len(chunk) - len(error.object) + error.start
                )  # its object begins with the bytes left over from before
                break
            at += len(chunk)
    guess = "utf-16" if start in (b"\xff\xfe", b"\xfe\xff") else "latin-1"
    return DatasetError(f"{path}: byte {at} is not {encoding}; set `encoding` ({guess}?)")


def _as_written(series: pd.Series) -> NDArray[Any]:
    """Return integers and floats unchanged, and anything else as text; NaN for an empty field."""
    values = series.to_numpy()
    if values.dtype.kind != "O":
        return values
    return np.array(
        [value if absent else str(value) for value, absent in zip(values, series.isna(), strict=True)], TEXT
    )


def _numbers(series: pd.Series, path: Path, first_row: int) -> NDArray[Any]:
    """Return float64: the nearest float of a long integer, and 1 for true."""
    if pd.api.types.is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=float, na_value=np.nan)
    plain = series.map(lambda value: BOOLEANS.get(value, value))
    numbers = pd.Series(pd.to_numeric(plain, errors="coerce")).to_numpy(dtype=float, na_value=np.nan)
    bad = np.flatnonzero(np.isnan(numbers) & series.notna().to_numpy())
    if len(bad):
        value = str(series.iloc[bad[0]])[:40]
        raise DatasetError(f"{path}: row {first_row + bad[0]}: column {series.name!r} holds {value!r}, not a number")
    return numbers
