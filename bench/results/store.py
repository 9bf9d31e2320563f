"""The store of an experiment: one SQLite file, one transaction per finished run."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..errors import ExperimentError
from ..files import writing
from .identity import versions
from .machine import git, machine
from .rows import COLUMNS, NAMES, OtherColumnsError, Row, check_columns, read_rows, run_keys, whole_spec

LOCKED_S = 60.0
"""s to wait for a program that writes to the store at this moment: transactions are short."""
SAME_RUN = "experiment IS :experiment AND log IS :log AND label IS :label AND seed IS :seed"


class Store:
    """The rows of one experiment.

    Raises:
        ExperimentError: the file is there and is not such a store, has other columns, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.connection = sqlite3.connect(path, timeout=LOCKED_S)
        except (OSError, sqlite3.Error) as error:
            raise ExperimentError(f"{path}: cannot be written ({error}); give another --out") from None
        try:
            self._prepare()
        except sqlite3.Error as error:
            self.connection.close()
            raise ExperimentError(f"{path}: {_why(error)}") from None

    def _prepare(self) -> None:
        run = self.connection.execute
        run("PRAGMA journal_mode = WAL")
        run("PRAGMA synchronous = FULL")
        with self.connection:
            run(f"CREATE TABLE IF NOT EXISTS runs ({', '.join(f'{name} {kind}' for name, kind in COLUMNS.items())})")
            check_columns(self.connection)
            run("CREATE UNIQUE INDEX IF NOT EXISTS one_row ON runs (experiment, log, label, ifnull(seed, -1), output)")
            run("CREATE TABLE IF NOT EXISTS files (name TEXT PRIMARY KEY)")

    @contextmanager
    def _told(self, advice: str = "; the runs before are kept") -> Iterator[None]:
        """Raise ExperimentError where the file cannot be used any more."""
        try:
            with self.connection:
                yield
        except sqlite3.IntegrityError:
            raise
        except sqlite3.Error as error:
            raise ExperimentError(f"{self.path}: cannot write ({error}){advice}") from None

    def write(self, rows: Sequence[Row]) -> None:
        """Replace the rows of an earlier run of the same name by these, in one transaction.

        Raises:
            ExperimentError: the disk is full, or the file cannot be written.
        """
        with self._told():
            for row in rows:
                self.connection.execute(f"DELETE FROM runs WHERE {SAME_RUN}", {key: row[key] for key in NAMES})
            for row in rows:
                values = {name: _storable(value) for name, value in row.items()}
                marks = ", ".join(f":{name}" for name in values)
                self.connection.execute(f"INSERT INTO runs ({', '.join(values)}) VALUES ({marks})", values)

    def write_absent(self, row: Row) -> bool:
        """Add the row of a run that could not be made; do nothing and return False if it has earlier rows."""
        run = {key: row[key] for key in NAMES}
        found = self.connection.execute(f"SELECT 1 FROM runs WHERE {SAME_RUN} AND status IS NOT 'absent'", run)
        if found.fetchone():
            return False
        self.write([row])
        return True

    def announce(self, files: Iterable[str]) -> None:
        """Note the names of trajectory files before they are written: only such files are ever removed.

        Raises:
            ExperimentError: as `write`.
        """
        with self._told():
            self.connection.executemany("INSERT OR IGNORE INTO files VALUES (?)", [(name,) for name in files])

    def files(self) -> tuple[set[str], set[str]]:
        """Return the names of all files that were announced, and of those that no row refers to."""
        with self._told():
            known = {name for (name,) in self.connection.execute("SELECT name FROM files")}
            query = "SELECT trajectory FROM runs UNION SELECT truth_trajectory FROM runs"
            return known, known - {name for (name,) in self.connection.execute(query)}

    def forget(self, files: Iterable[str]) -> None:
        """Forget the names of files that were removed."""
        with self._told():
            self.connection.executemany("DELETE FROM files WHERE name = ?", [(name,) for name in files])

    def read(self, log: str | None = None) -> pd.DataFrame:
        """Return every row, or those of one log, in the order in which they were written; see `read_rows`.

        Raises:
            ExperimentError: the file cannot be read.
        """
        try:
            return read_rows(self.connection, log)
        except sqlite3.Error as error:
            raise ExperimentError(f"{self.path}: cannot be read ({error})") from None

    def close(self) -> None:
        """Merge the write-ahead log into the file and close it."""
        self.connection.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _storable(value: Any) -> Any:
    """Return a value as SQLite takes it: a number of Python's, a text without lone surrogates."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    return value.item() if isinstance(value, np.generic) else value


def _why(error: sqlite3.Error) -> str:
    """Return why a file cannot be opened as a store to write to, and what to do."""
    if isinstance(error, OtherColumnsError):
        return str(error)
    if not isinstance(error, sqlite3.OperationalError):
        return f"not a store of runs ({error}); move it away, or give another --out"
    if "locked" in str(error):
        return f"another program has it open to write ({error}); wait for it, or give another --out"
    return f"cannot be written ({error}); mend that, or give another --out"


def load_runs(folder: Path | str, shared_specs: bool = False) -> pd.DataFrame:
    """Return the rows of the experiment in `folder`, read only.

    Args:
        folder: holds runs.sqlite.
        shared_specs: leave the seeds out of the specs, which takes a third of the memory; see `read_rows`.

    Raises:
        ExperimentError: no store there, or it cannot be read.
    """
    path = Path(folder) / "runs.sqlite"
    if not path.is_file():
        raise ExperimentError(f"{path}: no such file; `fathom run` makes it")
    alone = not os.access(path.parent, os.W_OK) and not path.with_name(f"{path.name}-wal").exists()
    try:  # SQLite reads a store with a write-ahead log by writing beside it, unless told that nobody changes it
        uri = f"{path.resolve().as_uri()}{'?immutable=1' if alone else ''}"
        with closing(sqlite3.connect(uri, timeout=LOCKED_S, uri=True)) as connection:
            rows = read_rows(connection)
    except OtherColumnsError as error:
        raise ExperimentError(f"{path}: {error}") from None
    except sqlite3.Error as error:
        raise ExperimentError(f"{path}: cannot be read as a store of runs ({error})") from None
    return rows if shared_specs else with_whole_specs(rows)


def with_whole_specs(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of a store with the seed in each spec."""
    specs = (whole_spec(spec, seed) for spec, (_, _, seed) in zip(rows["spec"], run_keys(rows), strict=True))
    return rows.assign(spec=pd.Series(specs, rows.index, object))


@cache
def provenance() -> dict[str, str]:
    """Return commit, versions and machine of this process, as a row holds them."""
    return {"commit_id": _commit(), "versions": json.dumps(versions()), "machine": json.dumps(machine())}


def _commit() -> str:
    """Return the commit of the checkout this file belongs to ("-dirty" where edited), else the package's version."""
    here = Path(__file__)
    known = git(here.parent, "ls-files", "--error-unmatch", here.name) is not None
    commit = git(here.parent, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*") if known else None
    return commit or f"fathom-bench {versions()['fathom-bench']}"


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Hold the lock of an experiment's folder; the system lets go of it when this process ends, however it ends.

    Raises:
        ExperimentError: another process holds it; or the folder cannot be written.
    """
    import fcntl

    path = folder / "lock"
    with writing(path, "; give another --out"):
        handle = path.open("a+b", buffering=0)
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            handle.seek(0)
            holder = handle.read(20).decode("ascii", "replace").strip() or "unknown"
            raise ExperimentError(
                f"{folder}: another `fathom run` (process {holder}) is writing here; wait for it, or give another --out"
            ) from None
        except OSError as error:
            raise ExperimentError(f"{path}: cannot be locked ({error.strerror}); give another --out") from None
        handle.seek(0)
        if not handle.read(20).strip().strip(b"0123456789"):  # else it is somebody else's file, and stays as it is
            with suppress(OSError):  # no room for our number, say: the lock holds without
                handle.truncate(0)
                handle.write(f"{os.getpid()}\n".encode("ascii"))
        yield
