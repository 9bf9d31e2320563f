"""An experiment: which estimators on which logs, from which seeds, scored and compared how; one YAML file."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from ...datasets.described.opening import CATALOG
from ...datasets.errors import complaints, nearest
from ...datasets.log import Log
from ...datasets.simulated.scenario import Scenario
from ...estimators.interface import FACTORS, Estimator, sensors_among
from ...estimators.registry import create
from ..errors import ExperimentError
from ..metrics import Alignment, Dims
from ..metrics.scoring import Scoring
from .comparison import OVER_SEEDS, Comparison
from .packaged import shipped_experiments
from .variants import Grid, changed, points

STRICT = ConfigDict(extra="forbid", populate_by_name=True)

MOST_SEEDS = 100_000
"""A larger number of seeds is a seed that lacks its brackets."""


@dataclass(frozen=True, config=STRICT)
class LogSpec:
    """One log of an experiment: simulated from a `scenario`, or recorded, by catalog name or folder (`log`).

    Attributes:
        scenario: keys of a `Scenario`; simulated once per seed.
        log: a name that `fathom list logs` prints, or a folder with a log.yaml.
        name: what tables call it; made from the mission and the IMU, or from the folder, when left out.
        align, dims: override the experiment's scores for this log.
        grid: keys of the scenario, dotted where they are nested, and the values that they take: the entry stands for a
            log at every point of it.
        estimators: labels, or patterns of labels, of those that run on it; all, when left out.
        baseline: the name of the log with which each estimator's scores on this one are compared, seed by seed.
    """

    scenario: dict[str, Any] | None = None
    log: str | None = None
    name: str = ""
    align: Alignment | None = None
    dims: Dims | None = None
    grid: Grid = Field(default_factory=dict)
    estimators: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    baseline: str | None = None

    @model_validator(mode="after")
    def _one_source(self) -> LogSpec:
        if (self.scenario is None) == (self.log is None):
            raise ValueError("a log needs either `scenario` or `log`, and not both")
        if self.log is not None and (self.grid or self.baseline):
            raise ValueError(f"`{'grid' if self.grid else 'baseline'}` is for simulated logs, which share their seeds")
        if self.scenario is not None:
            Scenario.from_dict(self.scenario)
        if not self.name:
            object.__setattr__(self, "name", self._default_name())
        self.variants()
        return self

    def variants(self) -> tuple[LogSpec, ...]:
        """Return the logs that this entry stands for: itself, where it has no grid.

        Raises:
            ValueError: a point of the grid is no scenario (a DatasetError that names the key).
        """
        if not self.grid:
            return (self,)
        return tuple(
            replace(self, name=f"{self.name} {words}", scenario=changed(self.scenario or {}, changes), grid={})
            for words, changes in points(self.grid)
        )

    def runs_on_it(self, label: str) -> bool:
        """Return whether the estimator of this label does."""
        return self.estimators is None or any(fnmatchcase(label, pattern) for pattern in self.estimators)

    def _default_name(self) -> str:
        if self.log is not None:
            return Path(self.log).name or Path(self.log).resolve().name
        scenario = Scenario.from_dict(self.scenario or {})
        noise = scenario.imu.noise
        return f"{scenario.mission}-{noise}" if isinstance(noise, str) else scenario.mission

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
        """Of the recorded path that a simulated log follows; None where there is none, or it cannot be read."""
        path = Scenario.from_dict(self.scenario or {}).path if self.scenario is not None else None
        try:
            return None if path is None else sha256(Path(path).read_bytes()).hexdigest()
        except OSError:  # the run will say so
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


Sensors = Annotated[tuple[str, ...], sensors_among(FACTORS)]


@dataclass(frozen=True, config=STRICT)
class EstimatorSpec:
    """One estimator of an experiment.

    Attributes:
        name: as in `fathom list estimators`.
        label: what tables call it; the name, when left out. No two may be the same.
        options: written `with:`; the options that differ from the estimator's defaults.
        grid: options, dotted where they are nested, and the values that they take: the entry stands for an estimator
            at every point of it.
        drop: sensors; besides the entry as it is there is one without each of them, compared with it.
        only: sets of sensors; likewise one with none but those of each set.
        baseline: the label with which the entry, or every point of its grid, is compared; else the experiment's.
    """

    name: str
    label: str = ""
    options: dict[str, Any] = Field(default_factory=dict, alias="with")
    grid: Grid = Field(default_factory=dict)
    drop: Sensors = ()
    only: tuple[Sensors, ...] = ()
    baseline: str | None = None

    @model_validator(mode="after")
    def _known(self) -> EstimatorSpec:
        self.create()
        if not self.label:
            object.__setattr__(self, "label", self.name)
        self.variants()
        return self

    @cached_property
    def config(self) -> Any:
        """What a run's spec says of the estimator's options: every one, defaults included."""
        return plain(self.create())

    @cached_property
    def lag_s(self) -> float:
        """How far the estimator looks back; 0 where it has no such option."""
        return float(getattr(self.create(), "lag_s", 0.0))

    def variants(self) -> tuple[EstimatorSpec, ...]:
        """Return the estimators that this entry stands for: itself, or its grid; each followed by those with less.

        Raises:
            ValueError: an option of the grid is unknown or cannot take a value (an EstimatorError); or there is no such
                sensor to drop or to keep.
        """
        if not (self.grid or self.drop or self.only):
            return (self,)
        found = []
        for words, changes in points(self.grid):
            options = changed(self.options, changes)
            full = replace(self, label=f"{self.label} {words}".rstrip(), options=options, grid={}, drop=(), only=())
            has = full.create().factors
            less = {f"no {sensor}": has - {sensor} for sensor in self.drop}
            less |= {f"only {' + '.join(kept) or 'the IMU'}": frozenset(kept) for kept in self.only}
            for sensor in sorted({*self.drop, *(sensor for kept in self.only for sensor in kept)} - has):
                raise ValueError(f"{full.label} does not use {sensor!r} (it uses: {', '.join(sorted(has))})")
            found.append(full)
            found += [
                replace(
                    full,
                    label=f"{full.label} {words}",
                    options=options | {"factors": sorted(factors)},
                    baseline=full.label,
                )
                for words, factors in less.items()
            ]
        return tuple(found)

    def create(self) -> Estimator:
        """Return the configured estimator.

        Raises:
            EstimatorError: unknown name or option.
        """
        return create(self.name, **self.options)


def _counted_from_one(seeds: Any) -> Any:
    """Return the seeds that a number of them stands for; a list as it is."""
    if isinstance(seeds, list | tuple):
        return seeds
    if type(seeds) is not int or not 1 <= seeds <= MOST_SEEDS:
        raise ValueError(f"expected a list of seeds, or how many (1 to {MOST_SEEDS}), found {seeds!r:.60}")
    return tuple(range(1, seeds + 1))


def _can_be_compared(scores: tuple[str, ...]) -> tuple[str, ...]:
    for score in scores:
        _refuse_unknown("no score to compare by", score, OVER_SEEDS)
    _refuse_twice("score", scores)
    return scores


@dataclass(frozen=True, config=STRICT)
class Sides:
    """What `fathom tune` may look at: patterns of a log's name, or of "log/seed".

    Attributes:
        train: what the search sees; without patterns, all that is not held out.
        held_out: what it never sees; without patterns, all that does not train. Without either, of simulated logs the
            first half of the seeds trains and the rest is held out, and recorded logs take no part.
    """

    train: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()


class Run(NamedTuple):
    """One estimator on one log; seed is None for a recorded log."""

    log: LogSpec
    estimator: EstimatorSpec
    seed: int | None

    def __str__(self) -> str:
        seed = "" if self.seed is None else f" seed {self.seed}"
        return f"{self.log.name} / {self.estimator.label}{seed}"


@dataclass(frozen=True, config=STRICT)
class Experiment:
    """Every estimator on every log; simulated logs once per seed, recorded logs once.

    Entries that stand for several (`grid`, `drop`, `only`) are replaced by what they stand for.

    Attributes:
        name: its folder under `results`.
        description: what it asks, in a sentence or two.
        logs, estimators: at least one each.
        seeds: of the simulated logs, or how many, counted from 1; all estimators share a seed's log, so differences are
            paired.
        scores: how runs are scored; a log may override `align` and `dims`.
        baseline: the label with which every estimator is compared that names no other.
        compare: scores in which variants are compared with their baselines; every one more is more tests to correct
            for.
        tune: which logs and seeds train `fathom tune`, and which are held out.
        max_gap_s: longest gap in the IMU that is bridged.
        timeout_s: longest time for one run.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    logs: Annotated[tuple[LogSpec, ...], Field(min_length=1)]
    estimators: Annotated[tuple[EstimatorSpec, ...], Field(min_length=1)]
    description: str = ""
    seeds: Annotated[
        tuple[Annotated[int, Field(ge=0, lt=2**63)], ...], Field(min_length=1), BeforeValidator(_counted_from_one)
    ] = (1,)
    scores: Scoring = Scoring()
    baseline: str | None = None
    compare: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_can_be_compared)] = (
        "ate_rmse_m",
        "heading_rmse_deg",
        "velocity_rmse_m_s",
    )
    tune: Sides = Sides()
    max_gap_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1800.0

    @model_validator(mode="after")
    def _expanded(self) -> Experiment:
        object.__setattr__(self, "estimators", tuple(each for entry in self.estimators for each in entry.variants()))
        object.__setattr__(self, "logs", tuple(each for entry in self.logs for each in entry.variants()))
        labels, names = [estimator.label for estimator in self.estimators], [log.name for log in self.logs]
        _refuse_twice("label", labels)
        _refuse_twice("log name", names)
        _refuse_twice("seed", self.seeds)
        for label in (self.baseline, *(estimator.baseline for estimator in self.estimators)):
            _refuse_unknown("baseline: no estimator has the label", label, labels)
        for log in self.logs:
            _refuse_unknown("baseline: no log has the name", log.baseline, names)
            for pattern in log.estimators or ():
                if not any(fnmatchcase(label, pattern) for label in labels):
                    _refuse_unknown(f"{log.name}: estimators: no label matches", pattern, labels)
        return self

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str = "experiment") -> Experiment:
        """Check what a YAML file holds; `source` names the file in errors.

        Raises:
            ExperimentError: unknown or missing key, unknown estimator, option or mission, a value that does not fit.
        """
        try:
            return TypeAdapter(cls).validate_python(content)
        except ValidationError as error:
            raise ExperimentError(f"{source}: {'; '.join(complaints(error, cls))}") from None

    @classmethod
    def load(cls, name_or_path: str | Path) -> Experiment:
        """Read a shipped experiment by its name, or anybody's by the path of its YAML file.

        Raises:
            ExperimentError: no such file, not YAML, or as in `from_dict`.
        """
        path = find_experiment(name_or_path)
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
            raise ExperimentError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from None
        if not isinstance(content, dict):
            raise ExperimentError(f"{path}: expected keys such as `name`, `logs`, `estimators`, found {content!r:.60}")
        return cls.from_dict({"name": path.stem} | content, str(path))

    def runs(self) -> list[Run]:
        """Return every run, log by log, seed by seed, so that runs on one log are neighbours."""
        return [
            Run(log, estimator, seed)
            for log in self.logs
            for seed in (self.seeds if log.scenario is not None else (None,))
            for estimator in self.estimators
            if log.runs_on_it(estimator.label)
        ]

    def comparisons(self) -> list[Comparison]:
        """Return which estimator on which log is compared with which on which.

        Each with its own baseline on the same log, and with itself on the log's baseline.
        """
        ran = {(log.name, each.label) for log in self.logs for each in self.estimators if log.runs_on_it(each.label)}
        return [
            Comparison(log.name, each.label, str(of_log), str(of_label))
            for log in self.logs
            for each in self.estimators
            for of_log, of_label in ((log.name, each.baseline or self.baseline), (log.baseline, each.label))
            if (of_log, of_label) != (log.name, each.label) and {(log.name, each.label), (of_log, of_label)} <= ran
        ]

    def scoring(self, log: LogSpec) -> Scoring:
        """Return how runs on this log are scored."""
        return replace(self.scores, align=log.align or self.scores.align, dims=log.dims or self.scores.dims)

    def spec(self, run: Run, repair: bool = False) -> dict[str, Any]:
        """Return all that decides a run's numbers, as JSON can hold it: defaults included."""
        return {
            "log": run.log.source,
            "log_sha256": run.log.description_sha256,
            "repair": repair,
            "estimator": {"name": run.estimator.name, "config": run.estimator.config},
            "seed": run.seed,
            "scores": plain(self.scoring(run.log)),
            "max_gap_s": self.max_gap_s,
            "timeout_s": self.timeout_s,
        }


def find_experiment(name_or_path: str | Path) -> Path:
    """Return the YAML file of a shipped experiment, or the path as it stands.

    Raises:
        ExperimentError: neither a shipped name nor a file.
    """
    shipped, name = shipped_experiments(), str(name_or_path)
    path = shipped.get(name) or shipped.get(name.replace("-", "_")) or Path(name_or_path)
    try:
        there = path.is_file()
    except (OSError, ValueError):  # too long for a name, or no text for one
        there = False
    if not there:
        raise ExperimentError(
            f"{name}: no such experiment or file{nearest(name, shipped)} (shipped: {', '.join(shipped)})"
        )
    return path


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


def _refuse_unknown(complaint: str, name: str | None, known: Iterable[str]) -> None:
    known = list(known)
    if name is not None and name not in known:
        raise ValueError(f"{complaint} {name!r}{nearest(name, known)} (known: {', '.join(known)})")


def _refuse_twice(what: str, values: Iterable[Any]) -> None:
    twice = [value for value, n in Counter(values).items() if n > 1]
    if twice:
        hint = {"label": "; give each its own `label`", "log name": "; give each its own `name`"}.get(what, "")
        raise ValueError(f"the {what} {twice[0]!r} is there twice{hint}")
