"""The store of an experiment: one SQLite file, one transaction per finished run."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from ..errors import ExperimentError
from ..files import writing
from ..metrics.floor_ratio import FLOORS
from ..metrics.scoring import COSTS, INNOVATIONS, SCORES
from .identity import FINAL, versions
from .machine import git, machine

Row = Mapping[str, Any]

NAMES = {"experiment": "TEXT", "log": "TEXT", "label": "TEXT", "seed": "INTEGER", "output": "TEXT"}
"""Columns that name a row: seed is NULL for a recorded log; output is "online" or "smoothed"."""

OUTCOME = {
    "status": "TEXT",  # done, diverged, failed, absent
    "cause": "TEXT",
    "traceback": "TEXT",  # of the error that ended the run
    "failed_at_s": "REAL",
    "lookahead_s": "REAL",
    "truth_kind": "TEXT",
    "align": "TEXT",
    "dims": "TEXT",
    "duration_s": "REAL",
    "start": "TEXT",  # where the prior came from: "given", "static", "moving", ...
}
HONESTY = {
    "nees_at": "TEXT",  # JSON: NEES by block at times fixed beforehand, see `consistency.nees_at`
    "nis_dof": "TEXT",  # JSON: degrees of freedom of each sensor's NIS
}
TIMES = {
    "step_histogram": "TEXT",  # JSON: how many steps took how long, see `step_time.step_histogram`
}
ORIGIN = {
    "identity": "TEXT",  # see `identity`
    "estimator": "TEXT",
    "spec": "TEXT",  # JSON
    "counts": "TEXT",  # JSON
    "notes": "TEXT",  # JSON
    "trajectory": "TEXT",  # file under trajectories/
    "truth_trajectory": "TEXT",  # likewise, at the same times
    "started": "TEXT",
    "finished": "TEXT",
    "commit_id": "TEXT",
    "versions": "TEXT",  # JSON
    "machine": "TEXT",  # JSON
}
COLUMNS = NAMES | OUTCOME | dict.fromkeys([*SCORES, *FLOORS, *INNOVATIONS, *COSTS], "REAL") | HONESTY | TIMES | ORIGIN
SAME_RUN = "experiment IS :experiment AND log IS :log AND label IS :label AND seed IS :seed"


class Store:
    """The rows of one experiment.

    Raises:
        ExperimentError: the file is there and is not such a store, or has other columns.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.connection = sqlite3.connect(path, timeout=60)
        except (OSError, sqlite3.Error) as error:
            raise ExperimentError(f"{path}: cannot be written ({error}); give another --out") from None
        try:
            self._prepare()
        except _OtherColumnsError as error:
            self.connection.close()
            raise ExperimentError(f"{path}: {error}") from None
        except sqlite3.Error as error:
            self.connection.close()
            raise ExperimentError(
                f"{path}: not a store of runs ({error}); move it away, or give another --out"
            ) from None

    def _prepare(self) -> None:
        run = self.connection.execute
        run("PRAGMA journal_mode = WAL")
        run("PRAGMA synchronous = FULL")
        with self.connection:
            run(f"CREATE TABLE IF NOT EXISTS runs ({', '.join(f'{name} {kind}' for name, kind in COLUMNS.items())})")
            _check_columns(self.connection)
            run("CREATE UNIQUE INDEX IF NOT EXISTS one_row ON runs (experiment, log, label, ifnull(seed, -1), output)")

    def write(self, rows: Sequence[Row]) -> None:
        """Replace the rows of an earlier run of the same name by these, in one transaction.

        Raises:
            ExperimentError: the disk is full, or the file cannot be written.
        """
        try:
            with self.connection:
                for row in rows:
                    self.connection.execute(f"DELETE FROM runs WHERE {SAME_RUN}", {key: row[key] for key in NAMES})
                for row in rows:
                    names = ", ".join(row)
                    values = ", ".join(f":{name}" for name in row)
                    self.connection.execute(f"INSERT INTO runs ({names}) VALUES ({values})", dict(row))
        except sqlite3.OperationalError as error:
            raise ExperimentError(f"{self.path}: cannot write ({error}); the runs before are kept") from None

    def write_absent(self, row: Row) -> bool:
        """Add the row of a run that could not be made; do nothing and return False if it has earlier rows."""
        run = {key: row[key] for key in NAMES}
        found = self.connection.execute(f"SELECT 1 FROM runs WHERE {SAME_RUN} AND status IS NOT 'absent'", run)
        if found.fetchone():
            return False
        self.write([row])
        return True

    def finished(self) -> set[tuple[str, str, int | None, str | None]]:
        """Return log, label, seed and identity of every run that is done or diverged."""
        final = ", ".join(f"'{status}'" for status in FINAL)
        query = f"SELECT DISTINCT log, label, seed, identity FROM runs WHERE status IN ({final})"
        return set(self.connection.execute(query))

    def trajectories(self) -> set[str]:
        """Return the names of the trajectory files that rows refer to."""
        query = "SELECT trajectory FROM runs UNION SELECT truth_trajectory FROM runs"
        return {name for (name,) in self.connection.execute(query) if name is not None}

    def read(self, log: str | None = None) -> pd.DataFrame:
        """Return every row, or those of one log, in the order in which they were written."""
        return read_rows(self.connection, log)

    def close(self) -> None:
        """Merge the write-ahead log into the file and close it."""
        self.connection.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _OtherColumnsError(sqlite3.DatabaseError):
    """The table `runs` is not of this version; says what to do."""


def _check_columns(connection: sqlite3.Connection) -> None:
    there = {row[1] for row in connection.execute("PRAGMA table_info(runs)")}
    if not there:
        raise sqlite3.DatabaseError("no table `runs` in it")
    for what, names in (("lacks", COLUMNS.keys() - there), ("has an unknown", there - COLUMNS.keys())):
        if names:
            raise _OtherColumnsError(
                f"another version wrote it: it {what} column {min(names)}; read it with that version, or move it away "
                "and run the experiment again"
            )


def read_rows(connection: sqlite3.Connection, log: str | None = None) -> pd.DataFrame:
    """Return the rows of an open store, or those of one log."""
    _check_columns(connection)
    chosen = "" if log is None else "WHERE log IS :log"
    query = f"SELECT {', '.join(COLUMNS)} FROM runs {chosen} ORDER BY rowid"
    table = pd.DataFrame(connection.execute(query, {"log": log}).fetchall(), columns=list(COLUMNS))
    numbers = [name for name, kind in COLUMNS.items() if kind == "REAL"]
    return table.astype(dict.fromkeys(numbers, "float64") | {"seed": "Int64"})


def load_runs(folder: Path | str) -> pd.DataFrame:
    """Return the rows of the experiment in `folder`, read only.

    Raises:
        ExperimentError: no store there, or it cannot be read.
    """
    path = Path(folder) / "runs.sqlite"
    if not path.is_file():
        raise ExperimentError(f"{path}: no such file; `fathom run` makes it")
    alone = not os.access(path.parent, os.W_OK) and not path.with_name(f"{path.name}-wal").exists()
    try:  # SQLite reads a store with a write-ahead log by writing beside it, unless told that nobody changes it
        uri = f"{path.resolve().as_uri()}{'?immutable=1' if alone else ''}"
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            return read_rows(connection)
    except _OtherColumnsError as error:
        raise ExperimentError(f"{path}: {error}") from None
    except sqlite3.Error as error:
        raise ExperimentError(f"{path}: cannot be read as a store of runs ({error})") from None


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
        with suppress(OSError):  # no room for our number, say: the lock holds without
            handle.truncate(0)
            handle.write(f"{os.getpid()}\n".encode("ascii"))
        yield
