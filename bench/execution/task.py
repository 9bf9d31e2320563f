"""A task, which goes to a worker, and what comes back: rows and trajectories."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from ...datasets.errors import shown
from ...datasets.notes import Note
from ...datasets.trajectory import COVARIANCE, Trajectory
from ...estimators.registry import package_of
from ..experiment.plan import Experiment, Run
from ..files import write_whole, writing
from ..metrics.scoring import Scoring
from ..results.identity import identity
from ..results.store import Row, provenance

PART_BYTES = 80
"""Of a name of a log or an estimator in the name of a file, which holds both and has 255 bytes at most."""


@dataclass(frozen=True)
class Task:
    """One run and all that a worker needs for it. It is a description of a few kilobytes, without arrays.

    Attributes:
        experiment: its name.
        run: which log, estimator and seed.
        scoring, max_gap_s, timeout_s: the experiment's, for this log.
        spec: all that decides the run's numbers, except readings and versions; see `Experiment.spec`.
        lags_s: those of all estimators of the experiment, whose floors are found together.
        data: where recorded logs are.
        repair: let loaders drop bad rows.
        checked: what the check before the experiment found in the log, as notes.
        readings_sha256: of a recorded log, or of a simulated one's recorded path; see `identity.identity`.
    """

    experiment: str
    run: Run
    scoring: Scoring
    max_gap_s: float
    timeout_s: float
    spec: dict[str, Any]
    lags_s: tuple[float, ...]
    data: Path | None = None
    repair: bool = False
    readings_sha256: str | None = None
    checked: tuple[Note, ...] = ()

    @staticmethod
    def of(experiment: Experiment, run: Run, data: Path | None = None, repair: bool = False) -> Task:
        """Return the task of one of the experiment's runs."""
        return Task(
            experiment.name,
            run,
            experiment.scoring(run.log),
            experiment.max_gap_s,
            experiment.timeout_s,
            experiment.spec(run, repair),
            tuple(sorted({estimator.lag_s for estimator in experiment.estimators})),
            data,
            repair,
        )

    @cached_property
    def identity(self) -> str:
        """The identity of the run, see `identity.identity`."""
        return identity(self.spec, package_of(self.run.estimator.name), self.readings_sha256)

    def answered_by(self, answer: object) -> bool:
        """Return whether what came back from a worker is a result of this task and of no other."""
        return (
            isinstance(answer, Finished)
            and len(answer.rows) > 0
            and all(isinstance(row, dict) and self._names.items() <= row.items() for row in answer.rows)
            and all(Path(name).name == name for name in answer.files)
        )

    @property
    def _names(self) -> dict[str, Any]:
        """The columns of a row that say of which run it is."""
        run = self.run
        return {
            "experiment": self.experiment,
            "log": run.log.name,
            "label": run.estimator.label,
            "seed": run.seed,
            "identity": self.identity,
        }

    def row(self, status: str, cause: str | None, output: str = "online") -> dict[str, Any]:
        """Return the columns of a row that do not depend on success."""
        return (
            self._names
            | {
                "output": output,
                "status": status,
                "cause": None if cause is None else shown(cause),
                "align": self.scoring.align,
                "dims": self.scoring.dims,
                "estimator": self.run.estimator.name,
                "spec": json.dumps(self.spec),
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            }
            | provenance()
        )


@dataclass(frozen=True)
class Stage:
    """What a worker begins to do for a task.

    Attributes:
        identity: of the run.
        doing: in words.
        longest_s: how long it may take before the worker counts as hung.
    """

    identity: str
    doing: str
    longest_s: float


@dataclass(frozen=True)
class Finished:
    """The result of a task: a row per output, and trajectories as the bytes of Parquet files, by name.

    A worker writes no files, so it may run on another machine.
    """

    rows: list[Row]
    files: dict[str, bytes] = field(default_factory=dict)

    def keep(self, folder: Path) -> list[Row]:
        """Write the trajectories into trajectories/ of this folder, each whole or not at all, and return the rows.

        A name contains the identity of its content or its run, so a file that is there already is the same.

        Raises:
            ExperimentError: the disk is full, or the folder cannot be written.
        """
        folder = folder / "trajectories"
        with writing(folder, "; the runs before are kept"):
            folder.mkdir(parents=True, exist_ok=True)
            for name, content in self.files.items():
                write_whole(folder / name, content)
        return self.rows


def file_name(task: Task, output: str, content: str) -> str:
    """Return the name of a trajectory's file.

    It ends in the identity of the run (of the content, for the truth, which runs share): so no file is
    overwritten with other content, and the rows in the store keep their files.
    """
    label = task.run.estimator.label if output != "truth" else ""
    seed = "" if task.run.seed is None else str(task.run.seed)
    parts = (task.run.log.name, label, seed, output, content[:8])
    return "--".join(_file_part(part) for part in parts if part) + ".parquet"


def parquet(trajectory: Trajectory) -> bytes:
    """Return a trajectory as the content of a Parquet file; of the covariance, the 3 × 3 blocks."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    columns: dict[str, Any] = {**trajectory.to_columns()}
    for (i, j), name in COVARIANCE.items():
        values = columns.pop(name, None)
        if values is not None and i // 3 == j // 3:
            with np.errstate(over="ignore"):  # a covariance that diverges may overflow
                columns[name] = values.astype(np.float32)
    buffer = pa.BufferOutputStream()
    write_table(pa.table(columns), buffer, use_dictionary=False, write_statistics=False)
    return buffer.getvalue().to_pybytes()


def _file_part(text: str) -> str:
    """Return the text as a file name may hold it; a changed text gains a few letters of its own."""
    safe = re.sub(r"[^\w.=+-]+", "_", text).encode()[:PART_BYTES].decode(errors="ignore")
    return safe if safe == text else f"{safe}-{sha256(text.encode(errors='backslashreplace')).hexdigest()[:4]}"
