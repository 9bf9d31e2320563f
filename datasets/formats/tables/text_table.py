"""Tables in text: lines split by a delimiter, read piece by piece."""

from __future__ import annotations

import codecs
import csv
import io
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd

from ...errors import DatasetError
from .table import Column, Flaws, Table, check_columns

EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
"""Makes pandas read the nearest float64 of the text; 3.1 does so by default (tested), and warns about the option."""

PIECE_BYTES = 1 << 18
"""Of text at a time; larger pieces were not faster, and cost memory."""
PIECE_ROWS = 1 << 14
"""Rows at a time, about as much."""
WIDE = 500
"""Of a table with more columns only the wanted ones are handed to pandas, which takes its time for every column."""
BEFORE, FEWEST_BEFORE = 100, 10
"""Lines before the last one with which it is compared, and how many it needs: a number of fewer decimals than all of a
hundred others is hardly one in full."""
LONGEST_END = 40
"""Characters of a line that is cut off, of which a note shows the end."""
LONG_WHOLE = 5
"""Characters from which on whole numbers are compared by their length; shorter ones lose a digit by counting down."""
SEPARATOR = "\x1f"
"""Put in the place of a delimiter of several letters; ASCII made it to separate fields, and texts do not hold it."""


class _Lines(io.TextIOBase):
    """A text file without its empty lines, comments and lines of other kinds, for pandas to read."""

    def __init__(self, file: IO[str], table: Table, flaws: Flaws) -> None:
        self.file, self.table, self.flaws, self.ahead = file, table, flaws, ""
        self.separator, self.rows = separator_of(table), 0
        self.before = list[str]()
        self.picked, self.width = list[int](), 0
        self.comment = table.comment
        self.kinds = () if table.lines is None else table.lines.values  # noqa: PD011  (our own field)
        self.kind_field = 0 if table.lines is None else table.lines.field

    def _counts(self, line: str) -> bool:
        return bool(line.strip()) and not (self.comment and line.startswith(self.comment))

    def _rows(self, lines: Iterable[str]) -> list[str]:
        """Return the lines that are rows, and count them and the lines of other kinds."""
        rows = list(filter(self._counts, lines))
        if self.kinds:
            rows, every = [row for row in rows if self._kind(row) in self.kinds], len(rows)
            self.flaws.other_lines += every - len(rows)
        before, self.before = self.before, (self.before + rows)[-BEFORE:]
        if rows and not rows[-1].endswith("\n") and self._cut_off(rows[-1], (before + rows[:-1])[-BEFORE:]):
            self.flaws.cut_off = rows.pop()[-LONGEST_END:]
        self.rows += len(rows)
        return rows

    def _cut_off(self, last: str, before: list[str]) -> bool:
        """Return whether a last line without an end has fewer fields than those before it, or a shorter last number."""
        if len(before) < FEWEST_BEFORE:
            return False
        fields, others = self.fields(self._separated(last)), [self.fields(self._separated(line)) for line in before]
        if len(fields) < min(map(len, others)):
            return True
        at = len(fields) - 1
        texts = [other[at] for other in others if len(other) > at]
        decimals = [_decimals(text, self.table.decimal) for text in texts]
        if any(decimals):
            return _decimals(fields[at], self.table.decimal) < min(decimals)
        return LONG_WHOLE <= min(map(len, texts)) > len(fields[at]) and all(map(_is_whole, texts))

    def _kind(self, line: str) -> str | None:
        fields = line.split(None if self.separator == r"\s+" else self.table.delimiter, self.kind_field + 1)
        return fields[self.kind_field].strip().strip('"') if len(fields) > self.kind_field else None

    def _separated(self, text: str) -> str:
        return text.replace(self.table.delimiter, SEPARATOR) if self.separator == SEPARATOR else text

    def header(self) -> str:
        """Return the first line that is no comment; "" at the end."""
        return self._separated(next(filter(self._counts, self.file), ""))

    def first(self) -> str:
        """Return the next line of data; "" at the end."""
        return self._separated(next((row for line in self.file for row in self._rows([line])), ""))

    def read(self, size: int | None = -1) -> str:
        """Return some whole lines of data; "" at the end."""
        text, self.ahead = self._narrowed([self.ahead]), ""
        while not text and (lines := self.file.readlines(PIECE_BYTES)):
            rows = self._rows(lines)
            text = self._narrowed(map(self._separated, rows)) if self.width else self._separated("".join(rows))
        return text

    def fields(self, line: str) -> list[str]:
        """Return the fields of a line."""
        if self.separator == r"\s+":
            return line.split()
        return next(csv.reader([line], delimiter=self.separator, skipinitialspace=True), [])

    def narrow(self, picked: list[int], width: int) -> None:
        """Hand on these fields only, of lines that have `width`."""
        self.picked, self.width = picked, width

    def _narrowed(self, lines: Iterable[str]) -> str:
        if not self.width:
            return "".join(lines)
        kept = []
        for line in lines:
            fields = self.fields(line)
            if len(fields) == self.width:
                kept.append(self.separator.replace(r"\s+", " ").join(fields[i] for i in self.picked) + "\n")
            elif line and self.flaws.too_long is None:
                raise ValueError(f"a line has {len(fields)} fields instead of {self.width}")
        return "".join(kept)


def _decimals(text: str, mark: str) -> int:
    return len(text.strip().partition(mark)[2])


def _is_whole(text: str) -> bool:
    return text.strip().removeprefix("-").isdecimal()


def separator_of(table: Table) -> str:
    """Return how pandas is told the delimiter; what it would take for a regular expression is replaced beforehand."""
    if table.delimiter == "whitespace":
        return r"\s+"
    return table.delimiter if len(table.delimiter.encode()) == 1 else SEPARATOR


def text_pieces(
    path: Path, table: Table, wanted: Iterable[Column], texts: Collection[Column], flaws: Flaws
) -> Iterator[pd.DataFrame]:
    """Yield the rows of a file, piece by piece; see `columns.read_table`."""
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
        names = [name.strip() for name in lines.fields(head)]
        check_columns(wanted, names, path)
    lines.ahead = lines.first()
    if not lines.ahead:
        if names is None:
            raise DatasetError(f"{path}: no rows")
        yield pd.DataFrame({name: np.zeros(0) for name in names})
        return
    columns: list[Column] = list(range(len(lines.fields(lines.ahead))))
    if names is None:
        check_columns(wanted, columns, path)
    elif len(columns) not in (len(names), len(names) + 1):
        raise DatasetError(f"{path}: the header names {len(names)} columns, the rows have {len(columns)}")
    else:
        columns = [*names, *columns[len(names) :]]
    if len(columns) > WIDE:
        lines.narrow([columns.index(column) for column in wanted], len(columns))
        columns = list(wanted)
    reader: Any = pd.read_csv(
        lines,
        sep=separator,
        header=None,
        dtype={columns.index(column): str for column in texts},
        skipinitialspace=True,
        index_col=False,
        chunksize=PIECE_ROWS,
        decimal=table.decimal,
        on_bad_lines="error" if lines.flaws.too_long is None else "skip",
        low_memory=False,
        **EXACT,
    )
    rows = 0
    with reader:
        for frame in reader:
            if len(frame.columns) != len(columns) or (
                names is not None and len(columns) > len(names) and not frame.iloc[:, -1].isna().all()
            ):  # a field more than names is nothing, where every row ends in a delimiter
                raise DatasetError(
                    f"{path}: the header names {len(names or columns)} columns, the rows have {len(frame.columns)}"
                )
            frame.columns = pd.Index(columns, dtype=object)
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
