"""ROS messages: definitions as text, and readers built from them that extract single numbers from the bytes.

A definition is the text of a .msg file, alone or joined with those that it needs by lines of "===", as recordings
contain them. The bytes are those of ROS 1, or plain CDR for ROS 2. Consecutive fields of fixed size are read by one
`struct`; other fields are skipped, and the message must end where its definition does.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, one_line
from .recording import extra, not_found
from .topics import MOST_FIELDS, MOST_LEVELS, NS, Channel, MalformedMessage, ShortArray

CODES = {"bool": "B", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
         "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d"}  # fmt: skip
TIMES = {"time", "duration", "builtin_interfaces/Time", "builtin_interfaces/Duration"}
"""Seconds and nanoseconds, read as one number of nanoseconds."""
STRINGS = {"string", "wstring"}
LONGEST_PATH = 1000
"""Characters of a field's path."""
MOST_DEFINITION = 1 << 20
"""Characters of the definition of a type with all that it contains: 1 MiB; large ones have some 30 kB."""
MOST_IDL = 100_000
"""Characters of a definition in IDL, whose parser takes 0.1 ms for each; nav_msgs/Odometry has 20,000."""

_LINE = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<most><=)?(?P<count>\d{0,9})\])?\s+(?P<name>[A-Za-z]\w*)"
)
_IDL_ASIDE = re.compile(r'"(?:[^"\\]|\\.)*"|//[^\n]*|/\*(?:.*?\*/|.*)|@[\w:]+\s*\(', re.DOTALL)
"""Parts of IDL that may hold an opening parenthesis: text, comments, annotations."""


class Field(NamedTuple):
    """A field: its name, its type, and how many: None for one, -1 for any number, else a fixed number."""

    name: str
    base: str
    length: int | None


Definition = tuple[Field, ...]
Types = Mapping[str, Definition]
Serialisation = Literal["ros1", "cdr"]


class Definitions(dict[str, Definition]):
    """Definitions by their short names, from several sources; the first source with a name is used."""

    def __init__(self, *sources: Types) -> None:
        super().__init__()
        self._sources = sources

    def __missing__(self, kind: str) -> Definition:
        for source in self._sources:
            try:
                self[kind] = source[kind]
            except KeyError:
                continue
            return self[kind]
        raise KeyError(kind)


def short_name(kind: str) -> str:
    """Return "package/Name": `sensor_msgs/msg/Imu` without its `msg`."""
    first, _, last = kind.partition("/")
    return f"{first}/{last.rpartition('/')[2]}" if last else kind


def parse_definitions(text: str, kind: str, where: str) -> dict[str, Definition]:
    """Return the definitions in a text by their short names; `kind` is the name of the first one.

    Raises:
        DatasetError: a line is not part of a definition, or a type has two fields of one name.
    """
    if len(text) > MOST_DEFINITION:
        raise DatasetError(f"{where}: {kind}: a definition of more than {MOST_DEFINITION} characters")
    types: dict[str, Definition] = {}
    name, fields = short_name(kind), []
    for line in [*text.splitlines(), "==="]:
        line = line.strip()
        if line.startswith("==="):
            if len({field.name for field in fields}) < len(fields):
                raise DatasetError(f"{where}: {name}: two fields of one name")
            types.setdefault(name, tuple(fields))
            fields = []
        elif line.startswith("MSG:"):
            name, fields = short_name(line.removeprefix("MSG:").strip()), []
        elif line and not line.startswith("#"):
            field = _field(line, name, where)
            fields += [] if field is None else [field]
    return types


def _field(line: str, kind: str, where: str) -> Field | None:
    """Return the field that a line defines; None for a constant."""
    match = _LINE.match(line)
    if match is None:
        raise DatasetError(f"{where}: {kind}: not a line of a message definition: {line[:80]!r}")
    if line[match.end() :].lstrip().startswith("="):
        return None
    base = match["base"]
    if base == "Header":
        base = "std_msgs/Header"
    elif base not in CODES and base not in STRINGS and base not in TIMES:
        base = short_name(base) if "/" in base else f"{kind.partition('/')[0]}/{base}"
    fixed = match["count"] and not match["most"]
    count = None if match["array"] is None else int(match["count"]) if fixed else -1
    return Field(match["name"], base, count)


def definitions_of(text: str, encoding: str, kind: str, where: str) -> dict[str, Definition]:
    """Return the definitions that a recording contains for one type, as `ros1msg`, `ros2msg` or `ros2idl`.

    Raises:
        DatasetError: cannot be understood.
    """
    if encoding in ("ros1msg", "ros2msg"):
        return parse_definitions(text, kind, where)
    if encoding not in ("ros2idl", "omgidl"):
        raise DatasetError(f"{where}: {kind} is defined in {encoding!r}, which is not supported")
    if len(text) > MOST_IDL:
        raise DatasetError(f"{where}: {kind}: a definition of more than {MOST_IDL} characters of IDL")
    if "(" in _IDL_ASIDE.sub(" ", text):
        what = "an expression in parentheses, which takes the parser for ever"
        raise DatasetError(f"{where}: the definition of {kind} has {what}; name its .msg file in `definitions`")
    with extra("ros"):
        from rosbags.typesys import Stores, get_types_from_idl, get_typestore
    try:
        store = get_typestore(Stores.EMPTY)
        for part in text.split("=" * 80 + "\n"):
            if part.strip():
                store.register(get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL:") else part))
        joined, _ = store.generate_msgdef(short_name(kind).replace("/", "/msg/"), ros_version=2)
    except Exception as error:  # a parser's many ways to fail
        what = one_line(error)[:200]
        raise DatasetError(f"{where}: the definition of {kind} cannot be understood: {what}") from None
    return parse_definitions(joined, kind, where)


def numeric_fields(types: Types, kind: str, where: str) -> tuple[str, ...]:
    """Return the paths of a type's numbers; of an array, that of its first element.

    Raises:
        DatasetError: a type is not defined.
    """
    found: list[str] = []
    bounds = _Bounds(types, where)

    def walk(kind: str, prefix: str, above: tuple[str, ...]) -> None:
        for name, base, count in bounds.definition(kind, prefix, above):
            path = f"{prefix}{name}" if count is None else f"{prefix}{name}.0"
            if base in CODES or base in TIMES:
                found.append(path)
            elif base not in STRINGS:
                walk(base, f"{path}.", (*above, kind))

    walk(short_name(kind), "", ())
    return tuple(found)


class _Bounds:
    """Looks types up for one walk through a type, and ends a walk that would take too long."""

    def __init__(self, types: Types, where: str) -> None:
        self.types, self.where, self.seen = types, where, 0

    def definition(self, kind: str, prefix: str, above: tuple[str, ...]) -> Definition:
        """Return the definition of a type, met at the path `prefix` inside the types `above`.

        Raises:
            DatasetError: it is not defined or contains itself, or all of it is too large.
        """
        if kind in above:
            raise DatasetError(f"{self.where}: the type {kind} contains itself")
        try:
            definition = self.types[kind]
        except KeyError:
            raise DatasetError(
                f"{self.where}: no definition of the type {kind}; name its .msg file in `definitions`"
            ) from None
        self.seen += 1 + len(definition)
        if self.seen > MOST_FIELDS or len(above) > MOST_LEVELS or len(prefix) > LONGEST_PATH:
            limits = f"{MOST_FIELDS} fields, {MOST_LEVELS} types in one another, or {LONGEST_PATH} characters of a path"
            raise DatasetError(
                f"{self.where}: the type {(*above, kind)[0]} has more than {limits}; that is no recording's"
            )
        return definition


class _Leaf(NamedTuple):
    """A number, or a time's two: their codes, and size and alignment in bytes."""

    codes: str
    size: int
    align: int


def _leaf(base: str, serialisation: Serialisation) -> _Leaf:
    if base in TIMES:
        unsigned = serialisation == "ros1" and base in ("time", "builtin_interfaces/Time")
        return _Leaf("II" if unsigned else "ii" if serialisation == "ros1" else "iI", 8, 4)
    code = "b" if base == "byte" and serialisation == "ros1" else CODES[base]
    size = struct.calcsize("<" + code)
    return _Leaf(code, size, size)


Step = Callable[[bytes, int, list[Any]], int]
"""Reads on from an offset: appends the wanted numbers, and returns the offset after."""


class RosExtractor:
    """Takes wanted numbers out of messages of one ROS type; an `Extractor`."""

    def __init__(
        self, types: Types, kind: str, wanted: Sequence[str], serialisation: Serialisation, where: str
    ) -> None:
        """Compile the reader.

        Raises:
            DatasetError: a type without definition, or a column that is no number of it (with the nearest).
        """
        self._kind, self._cdr = kind, serialisation == "cdr"
        try:
            plans = {order: _Plan(types, wanted, serialisation, order, where) for order in "<>"}
            self._steps = {order: plan.message(short_name(kind)) for order, plan in plans.items()}
        except (struct.error, OverflowError, MemoryError) as error:
            raise DatasetError(f"{where}: {kind}: cannot be read by its definition: {error}") from None
        self._leaves = plans["<"].leaves
        absent = [column for column in wanted if column not in self._leaves]
        if absent:
            known = numeric_fields(types, kind, where)
            raise not_found(where, f"numeric field of {kind} called", absent[0], known)
        self.codes = [code for leaf in self._leaves.values() for code in leaf.codes]

    def __call__(self, data: bytes) -> list[Any]:
        """Return the numbers, in the order of the message."""
        out: list[Any] = []
        if not self._cdr:
            end = self._steps["<"](data, 0, out)
            spare = len(data) - end
        else:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise MalformedMessage(f"not plain CDR: it begins with {data[:4].hex()}")
            spare = len(data) - self._steps["<" if data[1] else ">"](data, 4, out)
            if 0 < spare < 4:
                spare = 0
        if spare:
            raise MalformedMessage(f"it is {len(data)} bytes long, by its definition {len(data) - spare}")
        return out

    def columns(self, raw: Sequence[NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the columns: times in int64 ns, floats as float64, integers as they are."""
        columns, at = {}, 0
        for name, leaf in self._leaves.items():
            values = raw[at]
            if len(leaf.codes) == 2:
                values = values.astype(np.int64) * NS + raw[at + 1]
            columns[name] = values.astype(float) if leaf.codes == "f" else values
            at += len(leaf.codes)
        return columns


class _Plan:
    """Turns a type's definition into the steps that read it, in one byte order."""

    def __init__(self, types: Types, wanted: Sequence[str], serialisation: Serialisation, order: str, where: str):
        self.wanted, self.order, self.where = frozenset(wanted), order, where
        self.serialisation: Serialisation = serialisation
        self.cdr = serialisation == "cdr"
        self.length = struct.Struct(order + "I")
        self.leaves: dict[str, _Leaf] = {}
        self.bounds = _Bounds(types, where)

    def message(self, kind: str) -> Step:
        """Return the step over a message of this type."""
        steps: list[Step] = []
        run = self._fields(kind, "", (), steps, [])
        return _in_turn([*steps, *self._run(run)])

    def _fields(
        self, kind: str, prefix: str, above: tuple[str, ...], steps: list[Step], run: list[tuple[str, int, int]]
    ) -> list[tuple[str, int, int]]:
        """Append the steps over a type's fields; return the run of fixed fields (codes, size, alignment) left open."""
        definition = self.bounds.definition(kind, prefix, above)
        if not definition and self.cdr:
            run.append(("x", 1, 1))  # an empty message is a byte in CDR
        for name, base, count in definition:
            path = prefix + name
            plain = base in CODES or base in TIMES
            if plain and count is None:
                run.append(self._wanted(path, _leaf(base, self.serialisation)))
            elif plain and count is not None and count >= 0:
                run += self._elements(path, _leaf(base, self.serialisation), count)
            elif count is None and base not in STRINGS:
                run = self._fields(base, f"{path}.", (*above, kind), steps, run)
            else:
                steps += self._run(run)
                run = []
                if base in STRINGS:
                    steps.append(self._strings(base, path, count))
                elif plain:
                    steps.append(self._sequence(path, _leaf(base, self.serialisation)))
                else:
                    steps.append(self._repeated(base, path, -1 if count is None else count, (*above, kind)))
        return run

    def _wanted(self, path: str, leaf: _Leaf) -> tuple[str, int, int]:
        if path not in self.wanted:
            return f"{leaf.size}x", leaf.size, leaf.align
        self.leaves[path] = leaf
        return leaf.codes, leaf.size, leaf.align

    def _indices(self, path: str) -> list[int]:
        """Return the wanted indices of an array."""
        rests = (w.removeprefix(f"{path}.").partition(".")[0] for w in self.wanted if w.startswith(f"{path}."))
        return sorted({int(rest) for rest in rests if rest.isascii() and rest.isdecimal()})

    def _elements(self, path: str, leaf: _Leaf, count: int) -> list[tuple[str, int, int]]:
        """Return the run of an array of fixed length."""
        run, at = [], 0
        for index in [i for i in self._indices(path) if i < count]:
            if index > at:
                run.append((f"{(index - at) * leaf.size}x", (index - at) * leaf.size, leaf.align))
            run.append(self._wanted(f"{path}.{index}", leaf))
            at = index + 1
        return run if at == count else [*run, (f"{(count - at) * leaf.size}x", (count - at) * leaf.size, leaf.align)]

    def _run(self, run: Sequence[tuple[str, int, int]]) -> list[Step]:
        """Return the step over fields of fixed size; one `struct` for each offset modulo 8 that they start at."""
        if not run:
            return []
        run, cdr, structs = list(run), self.cdr, {}

        def compiled(at: int) -> struct.Struct:
            formats, start = [self.order], at
            for codes, size, align in run:
                pad = -at % align if cdr else 0
                formats.append(f"{pad}x{codes}")
                at += pad + size
            made = struct.Struct("".join(formats))
            assert made.size == at - start
            return made

        def step(data: bytes, at: int, out: list[Any]) -> int:
            phase = (at - 4) & 7 if cdr else 0
            fields = structs.get(phase)
            if fields is None:
                fields = structs[phase] = compiled(phase)
            out += fields.unpack_from(data, at)
            return at + fields.size

        return [step]

    def _counted(self, data: bytes, at: int) -> tuple[int, int]:
        """Return a length and the offset after it."""
        if self.cdr:
            at += -at & 3
        return self.length.unpack_from(data, at)[0], at + 4

    def _strings(self, base: str, path: str, count: int | None) -> Step:
        if base == "wstring":
            raise DatasetError(f"{self.where}: {path}: wide strings are not supported")
        counted, cdr = self._counted, self.cdr

        def step(data: bytes, at: int, out: list[Any]) -> int:
            strings = 1
            if count is not None:
                strings = count
                if count < 0:
                    strings, at = counted(data, at)
            for _ in range(strings):
                length, at = counted(data, at)
                at += length
                if at > len(data) or (cdr and length and data[at - 1]):
                    raise MalformedMessage(f"the string {path!r} has no end")
            return at

        return step

    def _sequence(self, path: str, leaf: _Leaf) -> Step:
        """Return the step over an array of numbers whose length is in the message."""
        picks = []
        for index in self._indices(path):
            self.leaves[f"{path}.{index}"] = leaf
            picks.append((index, struct.Struct(self.order + leaf.codes)))
        counted, cdr, least = self._counted, self.cdr, 1 + max((index for index, _ in picks), default=-1)

        def step(data: bytes, at: int, out: list[Any]) -> int:
            count, at = counted(data, at)
            if cdr and count:
                at += -(at - 4) % leaf.align
            if at + count * leaf.size > len(data):
                raise MalformedMessage(f"the array {path!r} has no end")
            if count < least:
                raise ShortArray(path, count)
            for index, number in picks:
                out += number.unpack_from(data, at + index * leaf.size)
            return at + count * leaf.size

        return step

    def _repeated(self, kind: str, path: str, count: int, above: tuple[str, ...]) -> Step:
        """Return the step over an array of messages."""

        def element(prefix: str) -> Step:
            steps: list[Step] = []
            run = self._fields(kind, prefix, above, steps, [])
            return _in_turn([*steps, *self._run(run)])

        skip = element("\0")  # a path that no column has
        picks = {index: element(f"{path}.{index}.") for index in self._indices(path) if count < 0 or index < count}
        counted, least = self._counted, 1 + max(picks, default=-1)

        def step(data: bytes, at: int, out: list[Any]) -> int:
            elements = count
            if count < 0:
                elements, at = counted(data, at)
            if elements > len(data):
                raise MalformedMessage(f"the array {path!r} has no end")
            if elements < least:
                raise ShortArray(path, elements)
            for index in range(elements):
                start, at = at, picks.get(index, skip)(data, at, out)
                if at == start and index >= least:  # elements without a byte, of which there may be any number
                    break
            return at

        return step


def _in_turn(steps: Sequence[Step]) -> Step:
    if len(steps) == 1:
        return steps[0]

    def step(data: bytes, at: int, out: list[Any]) -> int:
        for one in steps:
            at = one(data, at, out)
        return at

    return step


def ros_channel(topic: str, kind: str, types: Callable[[], Types], serialisation: Serialisation, where: str) -> Channel:
    """Return a channel of ROS messages; `types` is called only when they are read."""

    def fields() -> tuple[str, ...]:
        return numeric_fields(types(), kind, where)

    def extractor(wanted: Sequence[str]) -> RosExtractor:
        return RosExtractor(types(), kind, wanted, serialisation, where)

    return Channel(topic, kind, fields, extractor)
