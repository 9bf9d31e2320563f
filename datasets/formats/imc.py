"""IMC logs (LSF), the format of the LSTS toolchain: concatenated little-endian messages with a CRC each.

The file is read in chunks, also from within an archive, and only the wanted messages are kept. A message with a wrong
CRC is skipped, and reading goes on at the next sync word.
"""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..compiling.decorators import compiled
from ..errors import DatasetError, nearest, shown
from ..files import inside
from .recording import Messages, Recording, TopicInfo, Wanted, not_found
from .unpacking import Bounded

HEADER = np.dtype(
    [("sync", "<u2"), ("id", "<u2"), ("size", "<u2"), ("timestamp", "<f8"), ("src", "<u2"), ("src_ent", "u1"),
     ("dst", "<u2"), ("dst_ent", "u1")]
)  # fmt: skip
CHUNK_BYTES = 1 << 20
"""Read at a time: 1 MiB."""
TYPES = {"int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
         "int64_t": "<i8", "fp32_t": "<f4", "fp64_t": "<f8"}  # fmt: skip
MOST_DEFINITIONS = 8 << 20
"""Bytes of an IMC.xml: 8 MiB, thirty times that of IMC 5.4."""
BROKEN = (OSError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, ValueError)
"""The exceptions of the standard library for a damaged archive."""

_XYZ = "time:f8 x:f8 y:f8 z:f8"
_ESTIMATE = (
    "lat:f8 lon:f8 height:f4 x:f4 y:f4 z:f4 phi:f4 theta:f4 psi:f4 u:f4 v:f4 w:f4 "
    "vx:f4 vy:f4 vz:f4 p:f4 q:f4 r:f4 depth:f4 alt:f4"
)
BUILT_IN = {
    "EulerAngles": (254, "time:f8 phi:f8 theta:f8 psi:f8 psi_magnetic:f8"),
    "AngularVelocity": (256, _XYZ),
    "Acceleration": (257, _XYZ),
    "MagneticField": (258, _XYZ),
    "GroundVelocity": (259, "validity:u1 x:f8 y:f8 z:f8"),
    "WaterVelocity": (260, "validity:u1 x:f8 y:f8 z:f8"),
    "Temperature": (263, "value:f4"),
    "Pressure": (264, "value:f8"),
    "Depth": (265, "value:f4"),
    "EstimatedState": (350, _ESTIMATE),
}
"""Messages of IMC 5.4: number and fields, for logs without their definitions."""


@dataclass(frozen=True)
class Layout:
    """A message's number and its leading fields of fixed size."""

    mgid: int
    fields: np.dtype[Any]


@dataclass(frozen=True)
class LsfRead:
    """The contents of a file: per message name its rows (header's timestamp, src_ent, and the fields), and notes."""

    rows: dict[str, NDArray[Any]]
    notes: tuple[str, ...]


def built_in_layouts() -> dict[str, Layout]:
    """Return the layouts of the built-in messages."""
    layouts = {}
    for name, (mgid, fields) in BUILT_IN.items():
        dtype = np.dtype([(f.split(":")[0], "<" + f.split(":")[1]) for f in fields.split()])
        layouts[name] = Layout(mgid, dtype)
    return layouts


def parse_definitions(xml: bytes, where: str) -> dict[str, Layout]:
    """Return the layouts of the messages of an IMC.xml, up to the first field of variable size.

    Raises:
        DatasetError: it is no such list, or has a name or a number twice.
    """
    if b"<!ENTITY" in xml.replace(b"\0", b""):  # also as UTF-16
        raise DatasetError(
            f"{where}: not a list of IMC messages: it has entities, which can stand for any amount of text"
        )
    try:
        root = ET.fromstring(xml)
        layouts: dict[str, Layout] = {}
        numbers: set[int] = set()
        for message in root.iter("message"):
            fields = []
            for item in message.findall("field"):
                if item.get("type") not in TYPES:
                    break
                fields.append((str(item.get("abbrev")), TYPES[str(item.get("type"))]))
            name, layout = str(message.get("abbrev")), Layout(int(message.get("id", "-1")), np.dtype(fields))
            if name in layouts or layout.mgid in numbers:
                raise ValueError(f"the message {name} or its number {layout.mgid} stands there twice")
            layouts[name] = layout
            numbers.add(layout.mgid)
    except (ET.ParseError, ValueError) as error:
        raise DatasetError(f"{where}: not a list of IMC messages: {error}") from None
    return layouts


class ImcRecording(Recording):
    """An IMC log (LSF), bare, gzipped or inside a ZIP archive. A message's sender is its `src_ent`."""

    host_clock: ClassVar = ("timestamp", "s")
    suffixes: ClassVar = (".lsf", ".lsf.gz")

    member: str | None = None
    """Its path inside the archive."""
    definitions: str | None = None
    """IMC.xml or IMC.xml.gz, inside the same archive or folder; a short built-in list if left out."""
    source: int | None = None
    """Keep only messages with this `src`."""

    def read(self, folder: Path, wanted: Sequence[Wanted]) -> Messages:
        """Read the wanted messages; see `Recording.read`."""
        where = str(folder / self.file)
        layouts = self._layouts(folder)
        for want in wanted:
            if want.message not in layouts:
                hint = nearest(want.message, layouts)
                raise DatasetError(f"{where}: unknown IMC message {want.message!r}{hint}")
        with _opened(folder, self.file, self.member) as stream:
            held = scan(stream, {want.message: layouts[want.message] for want in wanted}, self.source, where)
        return Messages([_columns(held.rows[want.message], want, where) for want in wanted], held.notes)

    def contents(self, folder: Path) -> list[TopicInfo]:
        """Return the messages of the log, by name and entity."""
        layouts = self._layouts(folder)
        with _opened(folder, self.file, self.member) as stream:
            held = scan(stream, layouts, self.source, str(folder / self.file))
        found = []
        for name, rows in held.rows.items():
            fields = tuple(n for n in rows.dtype.names or () if n not in ("timestamp", "src_ent"))
            for entity in np.unique(rows["src_ent"]).tolist():
                stamps = rows["timestamp"][rows["src_ent"] == entity]
                found.append(TopicInfo(name, "", len(stamps), float(np.ptp(stamps)), fields, entity))
        return sorted(found, key=lambda h: (h.message, h.sender or 0))

    def _layouts(self, folder: Path) -> dict[str, Layout]:
        """Return the message layouts of the log: from its own definitions, else the built-in ones."""
        if self.definitions is None:
            return built_in_layouts()
        in_archive = self.file.endswith(".zip")
        file, member = (self.file, self.definitions) if in_archive else (self.definitions, None)
        where = f"{folder / file}: {self.definitions}"
        with _opened(folder, file, member) as stream:
            try:
                xml = stream.read(MOST_DEFINITIONS + 1)
            except DatasetError:
                raise
            except BROKEN as error:
                raise DatasetError(f"{where}: cannot be read: {error}") from None
        if len(xml) > MOST_DEFINITIONS:
            raise DatasetError(f"{where}: more than {MOST_DEFINITIONS >> 20} MiB; that is no list of IMC messages")
        return parse_definitions(xml, where)


def _columns(rows: NDArray[Any], want: Wanted, where: str) -> dict[str, NDArray[Any]]:
    """Return the wanted columns of the wanted entity, as float64."""
    if want.sender is not None:
        entities = sorted(set(rows["src_ent"].tolist()))
        rows = rows[rows["src_ent"] == want.sender]
        if not len(rows):
            raise DatasetError(f"{where}: no {want.message} from entity {want.sender}; it comes from {entities}")
    if not len(rows):
        raise DatasetError(f"{where}: no {want.message} in the log")
    for column in want.columns:
        if column not in (rows.dtype.names or ()):
            raise not_found(where, f"field of {want.message} called", column, rows.dtype.names or ())
    return {column: rows[column].astype(float) for column in want.columns}


@contextmanager
def _opened(folder: Path, file: str, member: str | None) -> Iterator[Any]:
    """Open a file, or a member of an archive, as a stream of bytes; decompressed if its name ends in .gz."""
    path = inside(folder, file)
    archive = None
    try:
        if path.suffix == ".zip":
            archive = zipfile.ZipFile(path)
            members = archive.namelist()
            if member not in members:
                hint = nearest(member or "", members)
                raise DatasetError(f"{path}: no member {member!r}{hint}; it holds {', '.join(members[:20])}")
            if archive.getinfo(str(member)).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise DatasetError(f"{path}: {member}: only stored and deflated members can be read piece by piece")
            stream: IO[bytes] = archive.open(member)
        else:
            stream = path.open("rb")
    except BROKEN as error:
        if archive is not None:
            archive.close()
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path}: cannot be opened: {error}") from None
    try:
        with stream:
            plain: Any = gzip.GzipFile(fileobj=stream) if (member or file).endswith(".gz") else stream
            yield Bounded(plain, str(path), path.stat().st_size)
    finally:
        if archive is not None:
            archive.close()


def scan(stream: IO[bytes], layouts: Mapping[str, Layout], source: int | None, where: str) -> LsfRead:
    """Read a stream of IMC messages to its end, keeping those of `layouts`."""
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in layouts}
    carry, in_gap, final = b"", False, False
    messages = gaps = skipped = short = 0
    cut_off = ""
    while not final:
        try:
            chunk = stream.read(CHUNK_BYTES)
        except DatasetError:
            raise
        except BROKEN as error:
            chunk, cut_off = b"", f" ({error})"
        final = not chunk
        data = np.frombuffer(carry + chunk, np.uint8)
        offsets, done, new_gaps, new_skipped, in_gap = _messages(data, final, in_gap, CRC_TABLE, SHIFTS)
        messages, gaps, skipped = messages + len(offsets), gaps + new_gaps, skipped + new_skipped
        carry = data[done:].tobytes()
        if len(offsets):
            short += _keep(data, offsets, layouts, source, rows)
    if messages == 0:
        raise DatasetError(f"{where}: contains no whole IMC message; is it an LSF log?")
    truncated = in_gap or bool(carry) or bool(cut_off)
    skipped += len(carry)

    notes = []
    corrupted = gaps - int(in_gap)
    if corrupted:
        notes.append(f"imc: {corrupted} stretches of corrupted messages skipped")
    if truncated:
        notes.append(f"imc: the file ends inside a message{cut_off}")
    if skipped:
        notes.append(f"imc: {skipped} bytes belong to no whole message")
    if short:
        notes.append(f"imc: {short} messages shorter than their definition dropped")
    return LsfRead({name: _stacked(kept, layouts[name]) for name, kept in rows.items()}, tuple(map(shown, notes)))


def _row_type(layout: Layout) -> np.dtype[Any]:
    fields = [(str(n), layout.fields[n]) for n in layout.fields.names or ()]
    return np.dtype([("timestamp", "<f8"), ("src_ent", "u1"), *fields])


def _stacked(kept: list[NDArray[Any]], layout: Layout) -> NDArray[Any]:
    return np.concatenate(kept) if kept else np.zeros(0, _row_type(layout))


def _keep(
    data: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    layouts: Mapping[str, Layout],
    source: int | None,
    rows: dict[str, list[NDArray[Any]]],
) -> int:
    """Append the wanted messages of a chunk to `rows`; return how many were shorter than their definition."""
    heads = data[offsets[:, None] + np.arange(HEADER.itemsize)].view(HEADER)[:, 0]
    ours = np.ones(len(heads), bool) if source is None else heads["src"] == source
    present = set(np.unique(heads["id"]).tolist())
    short = 0
    for name, layout in layouts.items():
        if layout.mgid not in present:
            continue
        chosen = ours & (heads["id"] == layout.mgid)
        whole = chosen & (heads["size"] >= layout.fields.itemsize)
        short += int(np.count_nonzero(chosen & ~whole))
        if not whole.any():
            continue
        kept = np.zeros(np.count_nonzero(whole), _row_type(layout))
        kept["timestamp"], kept["src_ent"] = heads["timestamp"][whole], heads["src_ent"][whole]
        if layout.fields.names:
            body = offsets[whole, None] + HEADER.itemsize + np.arange(layout.fields.itemsize)
            values = data[body].view(layout.fields)[:, 0]
            for field in layout.fields.names:
                kept[field] = values[field]
        rows[name].append(kept)
    return short


def crc_table() -> NDArray[np.uint16]:
    """Return the 256 steps of CRC-16 (IBM): polynomial 0x8005, reflected, starting from 0."""
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ 0xA001, table >> 1).astype(np.uint16)
    return table


CRC_TABLE = crc_table()


def shift_tables(table: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return what 2^k zero bytes after it make of a CRC, (17, 2, 256): of its low and of its high byte, to be XORed.

    A CRC is linear. So that of a message is the CRC of all up to its end, less that of all before it, which the
    message's length has shifted on: crc(b) = crc(a + b) XOR shifted(crc(a), len(b)).
    """
    step = np.zeros((2, 256), np.uint16)
    low = np.arange(256, dtype=np.uint16)
    step[0], step[1] = table[low], low  # (crc >> 8) ^ table[crc & 0xFF]
    levels = [step]
    for _ in range(16):
        last = levels[-1]
        levels.append(last[0][last & 0xFF] ^ last[1][last >> 8])
    return np.stack(levels)


SHIFTS = shift_tables(CRC_TABLE)


@compiled
def _messages(data, final, in_gap, table, shifts):  # pragma: no cover  (compiled)
    """Find the whole messages of a chunk, in a time that grows with its length, whatever the bytes claim.

    Returns their offsets, the number of bytes processed, the number of stretches of bad bytes that begin in it, the
    number of bytes skipped, and whether the chunk ends inside such a stretch.
    """
    n = len(data)
    before = np.empty(n + 1, np.uint16)  # the CRC of all bytes before each
    crc = np.uint16(0)
    for i in range(n):
        before[i] = crc
        crc = np.uint16((crc >> 8) ^ table[(crc ^ data[i]) & 0xFF])
    before[n] = crc
    offsets = np.empty(n // 22 + 1, np.int64)
    found, at, gaps, skipped = 0, 0, 0, 0
    while at + 22 <= n:
        if data[at] == 0x54 and data[at + 1] == 0xFE:
            end = at + 22 + (data[at + 4] | np.int64(data[at + 5]) << 8)
            if end > n and not final:
                break
            if end <= n:
                crc, length, k = before[at], end - 2 - at, 0
                while length:
                    if length & 1:
                        crc = np.uint16(shifts[k, 0, crc & 0xFF] ^ shifts[k, 1, crc >> 8])
                    length >>= 1
                    k += 1
                if crc ^ before[end - 2] == np.uint16(data[end - 2] | np.int64(data[end - 1]) << 8):
                    offsets[found] = at
                    found += 1
                    at = end
                    in_gap = False
                    continue
        if not in_gap:
            gaps += 1
            in_gap = True
        at += 1
        skipped += 1
    return offsets[:found], at, gaps, skipped, in_gap
