"""How a description says where a table is and what form it has; and what is found in one besides numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ...errors import DatasetError, nearest

LONGEST_TEXT = 400
"""Characters of a field, so that a Parquet file with one text of megabytes in every row needs little memory."""
MEANT = {r"\s+": "whitespace", r"\s*": "whitespace", r"\t": '"\\t" in double quotes', " +": "whitespace"}
"""What is probably meant by these delimiters, which would be taken literally."""

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
        cut_off: the end of a last line that is cut off, and left out; "" where there is none.
        too_long: lines with more fields than the first one, left out; None: they are an error.
    """

    words: dict[Column, dict[int, str]] = field(default_factory=dict)
    other_lines: int = 0
    cut_off: str = ""
    too_long: int | None = None


Columns = dict[Column, NDArray[Any]]


def check_columns(wanted: Iterable[Column], found: Sequence[Column], path: Path) -> None:
    """Refuse columns that a table does not have, or has twice.

    Raises:
        DatasetError: names the file, the column, the nearest one and those found.
    """
    for column in wanted:
        if found.count(column) > 1:
            raise DatasetError(f"{path}: {found.count(column)} columns are named {column!r}")
        if column not in found:
            named = ", ".join(str(c) for c in found[:40])
            raise DatasetError(f"{path}: no column {column!r}{nearest(str(column), map(str, found))}; found {named}")


def short(value: Any) -> str:
    """Return a field as text; of one that is longer than any time, place or word, the beginning."""
    text = str(value)
    return text if len(text) <= LONGEST_TEXT else f"{text[: LONGEST_TEXT - 1]}…"
