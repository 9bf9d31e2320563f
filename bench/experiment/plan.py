"""An experiment: which estimators on which logs, from which seeds, scored and compared how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from ...datasets.errors import DatasetError, complaints, nearest
from ...datasets.formats.yaml_file import read_yaml
from ...datasets.simulated.scenario import Scenario
from ..errors import ExperimentError
from ..metrics.comparison import Comparison
from ..metrics.scoring import Scoring
from .file import STRICT, ExperimentFile, Settings, SplitPatterns, refuse_twice, refuse_unknown
from .packaged import shipped_experiments
from .specs import EstimatorSpec, LogSpec, Run, plain

__all__ = [
    "EstimatorSpec",
    "Experiment",
    "LogSpec",
    "Run",
    "SplitPatterns",
    "find_experiment",
    "plain",
    "shipped_experiments",
]


MOST_RUNS = 1_000_000
"""Of an experiment; a run takes at least some milliseconds, and its row some 10 kB while it is summarised."""


@dataclass(frozen=True, config=STRICT, kw_only=True)
class Experiment(Settings):
    """Every estimator on every log; simulated logs once per seed, recorded logs once.

    Attributes:
        logs, estimators: those that the entries of the file stand for, in its order.
    """

    logs: tuple[LogSpec, ...]
    estimators: tuple[EstimatorSpec, ...]

    @model_validator(mode="after")
    def _fits_together(self) -> Experiment:
        labels, names = [estimator.label for estimator in self.estimators], [log.name for log in self.logs]
        refuse_twice("label", labels)
        refuse_twice("log name", names)
        refuse_twice("seed", self.seeds)
        count = len(names) * len(self.seeds) * len(labels)
        if count > MOST_RUNS:
            sizes = f"{len(names)} logs · {len(self.seeds)} seeds · {len(labels)} estimators"
            raise ValueError(f"{sizes} = {count} runs are more than {MOST_RUNS}; split the experiment")
        for label in (self.baseline, *(estimator.baseline for estimator in self.estimators)):
            refuse_unknown("baseline: no estimator has the label", label, labels)
        for log in self.logs:
            refuse_unknown("baseline: no log has the name", log.baseline, names)
            for pattern in log.estimators or ():
                if not any(fnmatchcase(label, pattern) for label in labels):
                    refuse_unknown(f"{log.name}: estimators: no label matches", pattern, labels)
        return self

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str = "experiment") -> Experiment:
        """Check what a YAML file holds, and fill in what it leaves out; `source` names the file in errors.

        Raises:
            ExperimentError: unknown or missing key, unknown estimator, option or mission, a value that does not fit.
        """
        _refuse_no_text(content, source)
        try:
            asked = TypeAdapter(ExperimentFile).validate_python(content)
            return cls(
                **{field.name: getattr(asked, field.name) for field in fields(Settings)},
                logs=tuple(log for entry in asked.logs for log in entry.variants()),
                estimators=tuple(each for entry in asked.estimators for each in entry.variants()),
            )
        except ValidationError as error:
            raise ExperimentError(*(f"{source}: {each}" for each in complaints(error, ExperimentFile))) from None

    @classmethod
    def load(cls, name_or_path: str | Path) -> Experiment:
        """Read a shipped experiment by its name, or anybody's by the path of its YAML file.

        Raises:
            ExperimentError: no such file, not YAML, or as in `from_dict`.
        """
        path = find_experiment(name_or_path)
        try:
            content = read_yaml(path)
        except DatasetError as error:
            raise ExperimentError(*error.args) from None
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

    def least_tests(self) -> int:
        """Return how many paired tests there are at least: those of the online outputs on simulated logs.

        A comparison of two runs of one configuration is none: of two labels of it, or without a sensor that the log has
        not anyway.
        """
        logs, estimators = {log.name: log for log in self.logs}, {each.label: each for each in self.estimators}

        def what_runs(log: str, label: str) -> tuple[Any, ...]:
            scenario, estimator = Scenario.from_dict(logs[log].scenario or {}), estimators[label]
            used = [sensor for sensor in estimator.create().factors if getattr(scenario, sensor, None) is not None]
            return scenario, estimator.name, {**estimator.config, "factors": sorted(used)}

        return len(self.compare) * sum(
            what_runs(log, label) != what_runs(of_log, of_label)
            for log, label, of_log, of_label in self.comparisons()
            if logs[log].scenario is not None and logs[of_log].scenario is not None
        )

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
            "scores": _plain_scores(self.scoring(run.log)),
            "max_gap_s": self.max_gap_s,
            "timeout_s": self.timeout_s,
        }


@lru_cache
def _plain_scores(scoring: Scoring) -> dict[str, Any]:
    """Return what every run's spec says of the scores; all runs share it."""
    return plain(scoring)


def find_experiment(name_or_path: str | Path) -> Path:
    """Return the YAML file of a shipped experiment, or the path unchanged.

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


def _refuse_no_text(content: Any, source: str) -> None:
    """Refuse a character that no file can hold: half of a surrogate pair, which YAML can write as "\\ud800".

    Raises:
        ExperimentError: names the text.
    """
    if isinstance(content, str):
        try:
            content.encode()
        except UnicodeEncodeError:
            raise ExperimentError(f"{source}: {content!r:.60} has a character that is no text; leave it out") from None
    elif isinstance(content, Mapping):
        _refuse_no_text([*content, *content.values()], source)
    elif isinstance(content, list | tuple):
        for each in content:
            _refuse_no_text(each, source)
