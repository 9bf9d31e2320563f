"""The specs of a run: a log and an estimator with every default filled in, and a seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from ...datasets.described.opening import CATALOG
from ...datasets.errors import DatasetError
from ...datasets.files import regular_file
from ...datasets.log import Log
from ...datasets.simulated.scenario import Scenario
from ...estimators.interface import Estimator
from ...estimators.registry import create
from ..metrics.alignment import Alignment
from ..metrics.pose_error import Dims


@dataclass(frozen=True)
class LogSpec:
    """One log: simulated from a `scenario` once per seed, or recorded (`log`).

    Attributes:
        name: what tables call it.
        scenario: keys of a `Scenario`.
        log: a name that `fathom list logs` prints, or a folder with a log.yaml.
        align, dims: override the experiment's scores for this log.
        estimators: labels, or patterns of labels, of those that run on it; None: all.
        baseline: the name of the log with which each estimator's scores on this one are compared, seed by seed.

    Raises:
        ValueError: neither or both of `scenario` and `log`; a scenario that cannot be (a DatasetError).
    """

    name: str
    scenario: dict[str, Any] | None = None
    log: str | None = None
    align: Alignment | None = None
    dims: Dims | None = None
    estimators: tuple[str, ...] | None = None
    baseline: str | None = None

    def __post_init__(self) -> None:
        if (self.scenario is None) == (self.log is None):
            raise ValueError("a log needs either `scenario` or `log`, and not both")
        if self.scenario is not None:
            Scenario.from_dict(self.scenario)

    def runs_on_it(self, label: str) -> bool:
        """Return whether the estimator of this label does."""
        return self.estimators is None or any(fnmatchcase(label, pattern) for pattern in self.estimators)

    @cached_property
    def source(self) -> Any:
        """What a run's spec says of the log: where it is, or the scenario with every default."""
        return self.log or plain(Scenario.from_dict(self.scenario or {}))

    @property
    def duration_s(self) -> float | None:
        """How long a simulated log is; None for a recorded one, which must be opened to know."""
        return None if self.scenario is None else Scenario.from_dict(self.scenario).duration_s

    @property
    def description_sha256(self) -> str | None:
        """Of the log.yaml or catalog entry that says how a recorded log is read; None for a simulated one."""
        if self.log is None:
            return None
        path = Path(self.log)
        catalogued = (CATALOG / f"{name}.yaml" for name in (self.log, path.resolve().name))
        places = (path / "log.yaml", path, *catalogued)
        found = next((place for place in places if place.suffix == ".yaml" and place.is_file()), None)
        return sha256(found.read_bytes()).hexdigest() if found else None

    @property
    def path_sha256(self) -> str | None:
        """Of the recorded path that a simulated log follows; None if it follows none, or the file cannot be read."""
        path = Scenario.from_dict(self.scenario or {}).path if self.scenario is not None else None
        try:
            return None if path is None else sha256(regular_file(Path(path)).read_bytes()).hexdigest()
        except (OSError, DatasetError):  # the run will say so
            return None

    def open(self, seed: int | None, data: Path | None = None, repair: bool = False) -> Log:
        """Simulate the log from this seed, or read it.

        Raises:
            DatasetError: it cannot be read; RecordingNotFound where it is not on this machine.
        """
        if self.scenario is not None:
            from ...datasets.simulated.simulator import simulate

            assert seed is not None
            return simulate(Scenario.from_dict(self.scenario), seed)
        from ...datasets.described.opening import open_log

        assert self.log is not None
        return open_log(self.log, data=data, repair=repair)


@dataclass(frozen=True)
class EstimatorSpec:
    """One estimator.

    Attributes:
        name: as in `fathom list estimators`.
        label: what tables call it.
        options: those that differ from the estimator's defaults.
        baseline: the label with which it is compared; None: the experiment's.

    Raises:
        EstimatorError: unknown name or option.
    """

    name: str
    label: str
    options: dict[str, Any] = field(default_factory=dict)
    baseline: str | None = None

    def __post_init__(self) -> None:
        self.create()

    @cached_property
    def config(self) -> Any:
        """What a run's spec says of the estimator's options: every one, defaults included."""
        return plain(self.create())

    @cached_property
    def lag_s(self) -> float:
        """How far the estimator looks back; 0 where it has no such option."""
        return float(getattr(self.create(), "lag_s", 0.0))

    def create(self) -> Estimator:
        """Return the configured estimator.

        Raises:
            EstimatorError: unknown name or option.
        """
        return create(self.name, **self.options)


class Run(NamedTuple):
    """One estimator on one log; seed is None for a recorded log."""

    log: LogSpec
    estimator: EstimatorSpec
    seed: int | None

    @property
    def key(self) -> tuple[str, str, int | None]:
        """Log, label and seed: what a row of the store says of which run it is."""
        return self.log.name, self.estimator.label, self.seed

    def __str__(self) -> str:
        seed = "" if self.seed is None else f" seed {self.seed}"
        return f"{self.log.name} / {self.estimator.label}{seed}"


def plain(value: Any) -> Any:
    """Return a configuration as dicts, sorted lists and numbers, the same on every machine."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, set | frozenset):
        return sorted(plain(item) for item in value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
