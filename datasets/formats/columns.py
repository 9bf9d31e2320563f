"""Read columns of numbers from tables: delimited text, Parquet or NumPy arrays, without conversion of units."""

from __future__ import annotations

import codecs
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Annotated, Any, Literal, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..errors import DatasetError, nearest
from ..files import regular_file
from .parquet import check_size, unpacked

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
PIECE_FIELDS = 1 << 20
"""Fields at a time, so that the pieces of a table with very many columns stay small: 8 MB of numbers."""
MOST_COLUMNS = 1000
"""Columns of an array that an error may list."""
LONGEST_WORD = 40
"""Characters of a field that an error shows."""
MOST_WORDS = 1000
"""Fields of text that are kept for messages, per column."""
SEPARATOR = "\x1f"
"""Put in the place of a delimiter of several letters; ASCII made it to separate fields, and texts do not hold it."""
MEANT = {r"\s+": "whitespace", r"\s*": "whitespace", r"\t": '"\\t" in double quotes', " +": "whitespace"}
"""What is probably meant by these delimiters, which would be taken literally."""
TEXT = np.dtypes.StringDType(na_object=np.nan)

Column = int | str


class Part(BaseModel):
    """A part of a description: frozen; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Lines(Part):
    """Only the lines of which this field is one of these are rows, as with a logger of several kinds of sentences."""

    field: Annotated[int, Field(ge=0)] = 0
    """Index of the field, from 0."""
    values: Annotated[tuple[str, ...], Field(min_length=1)]


class Table(Part):
    """A table in a file: text, or Parquet where the name ends in .parquet; or several NumPy arrays side by side."""

    file: str | None = None
    """Path inside the folder of the recording."""
    arrays: dict[str, str] = {}
    """Instead of a file: NumPy arrays of equal length, name to path; a two-dimensional one gives `name.0`, `name.1`…"""
    delimiter: str = ","
    """Between fields, taken literally; "whitespace" is any run of blanks and tabs."""
    decimal: Literal[".", ","] = "."
    """Between a number's whole part and its decimals."""
    comment: str = ""
    """Lines that begin with this are skipped, as are empty ones."""
    encoding: str = "utf-8"
    header: bool = True
    """Whether the first line names the columns; without, a column is its index, from 0."""
    lines: Lines | None = None
    """Which lines of a text are rows, if not all."""

    @model_validator(mode="after")
    def _can_be_read(self) -> Self:
        if (self.file is None) == (not self.arrays):
            raise ValueError("give one of `file` and `arrays`")
        if self.delimiter in MEANT:
            raise ValueError(f"delimiter {self.delimiter!r} is taken literally; write {MEANT[self.delimiter]}")
        if self.delimiter in ("", '"', "\n", "\r") or self.delimiter == self.decimal:
            raise ValueError(f"delimiter {self.delimiter!r} cannot separate fields (decimal: {self.decimal!r})")
        return self


@dataclass
class Flaws:
    """What a text table held beside rows of numbers.

    Attributes:
        words: by column, the fields that are not numbers, by their row (the first 1000 of a column); they read as NaN.
        other_lines: lines of other kinds, which `Table.lines` leaves out.
        too_long: lines with more fields than the first one, left out; None: they are an error.
    """

    words: dict[Column, dict[int, str]] = field(default_factory=dict)
    other_lines: int = 0
    too_long: int | None = None


Columns = dict[Column, NDArray[Any]]


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
    path = regular_file(folder / table.file)
    wanted = dict.fromkeys([*columns, *texts])
    found = Flaws() if flaws is None else flaws
    try:
        if path.suffix == ".parquet":
            pieces = _parquet_pieces(path, wanted, texts)
        else:
            pieces = _text_pieces(path, table, wanted, texts, found)
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


def _check_columns(wanted: Iterable[Column], found: Sequence[Column], path: Path) -> None:
    for column in wanted:
        if found.count(column) > 1:
            raise DatasetError(f"{path}: {found.count(column)} columns are named {column!r}")
        if column not in found:
            named = ", ".join(str(c) for c in found[:40])
            raise DatasetError(f"{path}: no column {column!r}{nearest(str(column), map(str, found))}; found {named}")


def _read_arrays(
    folder: Path, arrays: Mapping[str, str], wanted: Collection[Column], texts: Collection[Column]
) -> Columns:
    """Read NumPy arrays of equal length; `name.0`, `name.1` are the columns of a two-dimensional one."""
    opened = {name: _array(regular_file(folder / file)) for name, file in arrays.items()}
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
            _check_columns([str(column)], found, folder)
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

    with pq.ParquetFile(path, buffer_size=PIECE_BYTES, pre_buffer=False) as file:
        _check_columns(wanted, file.schema_arrow.names, path)
        names = [str(column) for column in wanted]
        check_size(path, file, names)
        if not file.metadata.num_rows:
            yield pd.DataFrame({name: np.zeros(0) for name in names})
        for batch in file.iter_batches(PIECE_ROWS, columns=names):
            yield pd.DataFrame({name: unpacked(batch[name], as_written=name in texts) for name in names})


class _Lines(io.TextIOBase):
    """A text file without its empty lines, comments and lines of other kinds, for pandas to read."""

    def __init__(self, file: IO[str], table: Table, flaws: Flaws) -> None:
        self.file, self.table, self.flaws, self.ahead = file, table, flaws, ""
        self.separator, self.rows = separator_of(table), 0
        self.kinds = () if table.lines is None else table.lines.values  # noqa: PD011  (our own field)

    def _counts(self, line: str) -> bool:
        comment = self.table.comment
        return bool(line.strip()) and not (comment and line.startswith(comment))

    def _is_row(self, line: str) -> bool:
        kind = self.table.lines
        if not self._counts(line):
            return False
        if kind is None:
            self.rows += 1
            return True
        fields = line.split(None if self.table.delimiter == "whitespace" else self.table.delimiter, kind.field + 1)
        if len(fields) > kind.field and fields[kind.field].strip().strip('"') in self.kinds:
            self.rows += 1
            return True
        self.flaws.other_lines += 1
        return False

    def _separated(self, text: str) -> str:
        return text.replace(self.table.delimiter, SEPARATOR) if self.separator == SEPARATOR else text

    def header(self) -> str:
        """Return the first line that is no comment; "" at the end."""
        return self._separated(next(filter(self._counts, self.file), ""))

    def first(self) -> str:
        """Return the next line of data; "" at the end."""
        return self._separated(next(filter(self._is_row, self.file), ""))

    def read(self, size: int | None = -1) -> str:
        """Return some whole lines of data; "" at the end."""
        text, self.ahead = self.ahead, ""
        while not text and (lines := self.file.readlines(PIECE_BYTES)):
            text = self._separated("".join(filter(self._is_row, lines)))
        return text


def separator_of(table: Table) -> str:
    """Return how pandas is told the delimiter; what it would take for a regular expression is replaced beforehand."""
    if table.delimiter == "whitespace":
        return r"\s+"
    return table.delimiter if len(table.delimiter.encode()) == 1 else SEPARATOR


def _text_pieces(
    path: Path, table: Table, wanted: Iterable[Column], texts: Collection[Column], flaws: Flaws
) -> Iterator[pd.DataFrame]:
    try:
        utf_8 = codecs.lookup(table.encoding).name == "utf-8"
        with path.open(encoding="utf-8-sig" if utf_8 else table.encoding) as file:  # without its byte-order mark
            yield from _frames(_Lines(file, table, flaws), path, table, wanted, texts)
    except UnicodeDecodeError:
        raise _undecoded(path, table.encoding) from None
    except LookupError as error:
        if isinstance(error, KeyError | IndexError):
            raise
        raise DatasetError(f"{path}: unknown encoding {table.encoding!r}") from None


def _frames(
    lines: _Lines, path: Path, table: Table, wanted: Iterable[Column], texts: Collection[Column]
) -> Iterator[pd.DataFrame]:
    """Yield the rows of a text table, columns by name; without a header, by index."""
    separator, names = lines.separator, None
    if table.header:
        head = lines.header()
        if not head:
            raise DatasetError(f"{path}: no rows")
        row = pd.read_csv(io.StringIO(head), sep=separator, header=None, dtype=str, keep_default_na=False).iloc[0]
        names = [str(name).strip() for name in row]
        _check_columns(wanted, names, path)
    lines.ahead = lines.first()
    if not lines.ahead:
        if names is None:
            raise DatasetError(f"{path}: no rows")
        yield pd.DataFrame({name: np.zeros(0) for name in names})
        return
    width = len(lines.ahead.split()) if separator == r"\s+" else lines.ahead.count(separator) + 1
    reader: Any = pd.read_csv(
        lines,
        sep=separator,
        header=None,
        dtype={names.index(str(c)) if names else c: str for c in texts},
        skipinitialspace=True,
        index_col=False,
        chunksize=max(1, min(PIECE_ROWS, PIECE_FIELDS // width)),
        decimal=table.decimal,
        on_bad_lines="error" if lines.flaws.too_long is None else "skip",
        low_memory=False,
        **EXACT,
    )
    rows = 0
    with reader:
        for frame in reader:
            if names is None:
                frame.columns = pd.Index([int(c) for c in frame.columns], dtype=object)
                _check_columns(wanted, list(frame.columns), path)
            else:
                if len(frame.columns) == len(names) + 1 and frame.iloc[:, -1].isna().all():
                    frame = frame.iloc[:, :-1]  # every row ends in a delimiter
                if len(frame.columns) != len(names):
                    raise DatasetError(
                        f"{path}: the header names {len(names)} columns, the rows have {len(frame.columns)}"
                    )
                frame.columns = pd.Index(names)
            rows += len(frame)
            yield frame
    if lines.flaws.too_long is not None:
        lines.flaws.too_long += lines.rows - rows


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


def _as_written(series: pd.Series, decimal: str) -> NDArray[Any]:
    """Return integers, floats and times unchanged, and anything else as text; NaN for an empty field."""
    values = series.to_numpy()
    if values.dtype.kind != "O":
        return values
    texts = [value if absent else str(value) for value, absent in zip(values, series.isna(), strict=True)]
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
            text = str(value) if decimal == "." else str(value).replace(decimal, ".")
            numbers[row] = BOOLEANS[text] if text in BOOLEANS else float(text.replace("_", "?"))
        except ValueError:
            words[row] = str(value)[:LONGEST_WORD]
    return numbers, words
