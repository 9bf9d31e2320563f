"""ROS 2 bags in SQLite (.db3): plain tables, read row by row.

A recorder that lost its power leaves journals beside the database, and the newest messages in them (`-wal`), or what a
half-written page was before (`-journal`). SQLite reads them only where it may write, so a copy is read then.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import DatasetError
from .ros_messages import Definitions, Types, definitions_of, ros_channel, short_name
from .topics import Channel, Message, ScanResult

TABLES = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("topic_id", "timestamp", "data"),
    "message_definitions": ("topic_type", "encoding", "encoded_message_definition"),
}
"""The tables that are read, and their columns; the last is there since Iron."""
JOURNAL = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
"""A rollback journal that is not finished begins so (SQLite, "Database File Format")."""
SPARE_STEPS, STEPS_PER_BYTE, STEPS_AT_A_TIME = 10_000_000, 20, 100_000
"""Of SQLite's machine, for one statement: a row takes some 20, and at least 10 bytes of the file."""


def sqlite_messages(
    plain: Path, path: Path, types: Types, topics: Collection[str] | None, found: ScanResult
) -> Iterator[Message]:
    """Yield the messages of a SQLite database; `path` is its name in errors, `plain` the uncompressed file.

    Raises:
        DatasetError: it cannot be read, or from some row on.
    """
    row = before = 0
    try:
        with (
            _with_journals(plain.resolve(), path, found) as (address, size),
            closing(_opened(address, size)) as database,
        ):
            channels = _channels(database, path, types, found)
            chosen = [i for i, channel in channels.items() if topics is None or channel.topic in topics]
            data = "x''" if topics is None else f"CASE WHEN topic_id IN ({','.join(map(str, chosen))}) THEN data END"
            rows = database.execute(f"SELECT rowid, topic_id, timestamp, {data} FROM messages ORDER BY rowid")
            wanted, strays = set(chosen), 0
            for row, topic, t_ns, data in rows:
                if row <= before:
                    raise ValueError("rows are out of order")
                before = row
                if topic in wanted:
                    if not isinstance(t_ns, int) or t_ns < 0 or not isinstance(data, bytes):
                        raise ValueError("rows are not what they should be")
                    size -= len(data)
                    if size < 0:
                        raise ValueError("rows share their bytes")
                    yield channels[topic], (t_ns,), data
                strays += topic not in channels
            if strays:
                found.notes.append(f"{path.name}: {strays} messages of no topic that it names are left out")
    except (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError) as error:
        if isinstance(error, DatasetError):
            raise
        how = f"nothing is read after row {before}" if before else "cannot be read"
        raise DatasetError(f"{path}: {how}: {error}") from None


@contextmanager
def _with_journals(plain: Path, path: Path, found: ScanResult) -> Iterator[tuple[str, int]]:
    """Yield the address and the size of the database: itself if no journal lies beside it, else a copy with it."""
    beside = [plain.with_name(plain.name + suffix) for suffix in ("-wal", "-journal")]
    for journal in beside:
        if journal.is_symlink():
            raise DatasetError(f"{journal}: a link; put the file itself beside {plain.name}, or remove the link")
    beside = [journal for journal in beside if _has_content(journal)]
    if not beside:
        yield f"{plain.as_uri()}?mode=ro&immutable=1", plain.stat().st_size
        return
    with TemporaryDirectory(prefix="fathom-") as folder:
        try:
            for file in (plain, *beside):
                shutil.copyfile(file, Path(folder) / file.name)
        except OSError as error:
            raise DatasetError(
                f"{path}: cannot be copied to {folder}, which its {beside[0].name} needs: {error.strerror}; set TMPDIR "
                f"to a folder with room, or merge them: sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'"
            ) from None
        names = " and ".join(journal.name for journal in beside)
        found.notes.append(f"{path.name}: the recorder did not finish; what is in {names} is read with it")
        copy = Path(folder) / plain.name
        yield f"{copy.resolve().as_uri()}?mode=rw", sum(file.stat().st_size for file in (plain, *beside))


def _has_content(journal: Path) -> bool:
    if not journal.is_file():
        return False
    with journal.open("rb") as stream:
        head = stream.read(len(JOURNAL))
    return head == JOURNAL if journal.name.endswith("-journal") else bool(head)


def _opened(address: str, size: int) -> sqlite3.Connection:
    """Open a database whose schema is not trusted; no value may be longer than the file, and no statement endless."""
    database = sqlite3.connect(address, uri=True)
    database.execute("PRAGMA trusted_schema = OFF")
    database.text_factory = lambda text: text.decode(errors="replace")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, 1 << 20))
    left = [SPARE_STEPS + STEPS_PER_BYTE * size]

    def over() -> bool:
        left[0] -= STEPS_AT_A_TIME
        return left[0] < 0

    database.set_progress_handler(over, STEPS_AT_A_TIME)
    return database


def _channels(database: sqlite3.Connection, path: Path, types: Types, found: ScanResult) -> dict[int, Channel]:
    """Return the channels by their number."""
    tables = set(database.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"))
    there = [name for name in TABLES if (name,) in tables]
    if not {"topics", "messages"} <= set(there):
        raise DatasetError(f"{path}: not a ROS 2 bag: no tables `topics` and `messages` in it")
    for name in there:
        _refuse_computed(database, name, path)
    carried: dict[str, tuple[str, str]] = {}
    if "message_definitions" in there:
        rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        for kind, encoding, text in rows:
            if text:
                found.keep(len(str(text)), path)
                carried[short_name(str(kind))] = str(encoding), str(text)
    channels: dict[int, Channel] = {}
    for number, topic, kind, written in database.execute("SELECT id, name, type, serialization_format FROM topics"):
        if written != "cdr":
            raise DatasetError(f"{path}: {topic}: serialised as {written!r:.60}; only CDR is supported")
        channel = _channel(str(topic), str(kind), carried.get(short_name(str(kind))), types, path)
        channels[int(number)] = channel
        found.add(channel, 0)
    return channels


def _refuse_computed(database: sqlite3.Connection, table: str, path: Path) -> None:
    """Refuse a table whose values are not in the file: generated or by default, of any size; or numbered otherwise."""
    columns = {
        name: (default, hidden)
        for _, name, _, _, default, _, hidden in database.execute(f"PRAGMA table_xinfo({table})")
    }
    for name in TABLES[table]:
        if columns.get(name) != (None, 0):
            how = "missing" if name not in columns else "computed"
            raise DatasetError(f"{path}: not a ROS 2 bag: the column {name!r} of the table {table!r} is {how}")
    if "rowid" in map(str.lower, columns):
        raise DatasetError(f"{path}: not a ROS 2 bag: the table {table!r} has a column called 'rowid'")


def _channel(topic: str, kind: str, carried: tuple[str, str] | None, types: Types, path: Path) -> Channel:
    where = f"{path}: {topic}"

    @cache
    def known() -> Types:
        if carried is None or carried[0] not in ("ros2msg", "ros2idl"):
            return types
        return Definitions(definitions_of(carried[1], carried[0], kind, where), types)

    return ros_channel(topic, short_name(kind), known, "cdr", where)
