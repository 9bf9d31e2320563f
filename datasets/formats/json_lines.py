"""JSON: the objects that are messages of MCAP, and files with one object a line (JSON Lines, NDJSON)."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from .recording import TopicInfo, not_found
from .topics import (
    MOST_FIELDS,
    MOST_LEVELS,
    NS,
    Channel,
    MalformedMessage,
    Message,
    ScanResult,
    ShortArray,
    TopicRecording,
)

LONGEST_LINE = 1 << 20
"""Bytes of an object: a report of a DVL has a thousand, and Python needs some 50 times as many for what is in it."""
NO_KIND = "object"
"""The name of the objects without the key that tells their kind."""


class JsonLinesRecording(TopicRecording):
    """A file of JSON objects, one a line, such as the log of a Water Linked A50's TCP port.

    Attributes:
        kind: the key that tells what an object is; its text is the name of the message, "object" where it has none.
    """

    host_clock = ("line", "ns")
    suffixes: ClassVar = (".jsonl", ".ndjson")
    stamps: ClassVar = ("line",)

    kind: str = "type"

    def messages(self, folder: Path, topics: Collection[str] | None, found: ScanResult) -> Iterator[Message]:
        """Yield the objects of a file, and the index of their lines; see `TopicRecording.messages`."""
        path = self.path(folder)
        channels: dict[str, Channel] = {}
        wrong, first, lines = 0, "", -1
        try:
            opened = path.open("rb")
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
        with opened as file:
            for lines, line in enumerate(_lines(file)):
                if not line.strip():
                    continue
                try:
                    message = _object(line)
                except MalformedMessage as error:
                    wrong, first = wrong + 1, first or f"line {lines + 1}: {error}"
                    continue
                name = message.get(self.kind)
                name = name if isinstance(name, str) else NO_KIND
                if name not in channels:
                    channels[name] = _channel(name, f"{path}: {name}", tuple(json_fields(message)))
                    found.add(channels[name], len(name) + sum(map(len, channels[name].fields())))
                if topics is None or name in topics:
                    yield channels[name], (lines,), line
        if not channels:
            raise DatasetError(f"{path}: no line is a JSON object{f'; {first}' if first else ''}")
        if wrong:
            found.notes.append(f"{path.name}: {wrong} of {lines + 1} lines are no JSON objects, the first is {first}")

    def contents(self, folder: Path) -> list[TopicInfo]:
        """Return the kinds of objects; their times are not known before a log.yaml names them."""
        return [replace(info, span_s=0.0) for info in super().contents(folder)]


def _lines(file: Any) -> Iterator[bytes]:
    """Yield the lines of a file; of one that is too long, its beginning, which is no object."""
    while line := file.readline(LONGEST_LINE):
        whole = line.endswith(b"\n") or len(line) < LONGEST_LINE
        while not whole:
            more = file.readline(LONGEST_LINE)
            whole = more.endswith(b"\n") or not more
        yield line


def _channel(name: str, where: str, fields: tuple[str, ...]) -> Channel:
    return Channel(name, "JSON", lambda: fields, lambda wanted: JsonExtractor(wanted, where))


def _object(data: bytes) -> dict[str, Any]:
    """Return a JSON object.

    Raises:
        MalformedMessage: it is none.
    """
    try:
        message = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"not JSON: {error}") from None
    if not isinstance(message, dict):
        raise MalformedMessage(f"not an object but {type(message).__name__}")
    return message


class JsonExtractor:
    """Extracts wanted numbers from JSON objects; an `Extractor`. An absent number, or null, is NaN."""

    def __init__(self, wanted: Sequence[str], where: str) -> None:
        self._wanted, self._where = tuple(wanted), where
        self._paths = [column.split(".") for column in wanted]
        self._met: set[str] = set()
        self._shape: Mapping[str, Any] | None = None
        self.codes = ["q" for _ in wanted]

    def __call__(self, data: bytes) -> list[Any]:
        """Return the numbers, in the order of the columns."""
        message = _object(data)
        if self._shape is None:
            self._shape = message
        return [self._value(message, column, path) for column, path in zip(self._wanted, self._paths, strict=True)]

    def columns(self, raw: Sequence[NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the columns by name.

        Raises:
            DatasetError: a column that no message has.
        """
        for column in self._wanted:
            if column not in self._met:
                raise not_found(self._where, "numeric field called", column, json_fields(self._shape or {}))
        return dict(zip(self._wanted, raw, strict=True))

    def _value(self, message: Any, column: str, path: Sequence[str]) -> int | float:
        value = message
        for name in path:
            if isinstance(value, dict):
                value = value.get(name)
            elif isinstance(value, list) and name.isascii() and name.isdecimal():
                if int(name) >= len(value):
                    raise ShortArray(column, len(value))
                value = value[int(name)]
            else:
                return np.nan
        number = _json_number(value)
        if number is not None:
            self._met.add(column)
            return number
        if value is not None:
            raise MalformedMessage(f"{column!r} is no number")
        return np.nan


def _json_number(value: Any) -> int | float | None:
    """Return a number, or the nanoseconds of a time; None if it is neither."""
    if isinstance(value, int | float):
        return value if isinstance(value, float) else int(value)
    if isinstance(value, dict):
        seconds, nanoseconds = value.get("sec"), value.get("nsec", value.get("nanosec"))
        if len(value) == 2 and isinstance(seconds, int) and isinstance(nanoseconds, int):
            return seconds * NS + nanoseconds
    return None


def json_fields(message: Mapping[str, Any]) -> Iterator[str]:
    """Yield the paths of an object's numbers, at most MOST_FIELDS; of an array, that of its first element."""
    return islice(_fields(message, "", 0), MOST_FIELDS)


def _fields(value: Any, prefix: str, level: int) -> Iterator[str]:
    items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for name, inner in items:
        if _json_number(inner) is not None:
            yield f"{prefix}{name}"
        elif level < MOST_LEVELS:
            yield from _fields(inner, f"{prefix}{name}.", level + 1)
