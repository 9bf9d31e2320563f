"""The problem that `fathom tune` solves: factors on an estimator's noise, training runs, and a score."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from ...datasets.described.opening import RecordingNotFound
from ...datasets.errors import nearest
from ...datasets.log import Log
from ..errors import ExperimentError
from ..execution.task import Task
from ..experiment.plan import EstimatorSpec, Experiment, Run, SplitPatterns
from ..metrics.scoring import can_judge
from ..results.identity import content_sha256
from .objective import Objective
from .split import Split, divide

IMU = ("accel", "gyro")


@dataclass(frozen=True)
class Tuning:
    """A search: factors on an estimator's sigmas, each from low to high, on training runs.

    Attributes:
        experiment: how runs are scored, and their limits.
        estimator: its options, `inflate` among them, are kept unless a factor changes them.
        split: training runs and held-out runs.
        dials: sensors, "accel" and "gyro".
        objective: the loss.
        low, high: the factors' range.
        seed: of the search.
        readings: hash of each recorded log that trains, by its name.
        folder: where the store, the study and the figure are.
    """

    experiment: Experiment
    estimator: EstimatorSpec
    split: Split
    dials: tuple[str, ...]
    objective: Objective
    low: float
    high: float
    seed: int
    readings: Mapping[str, str]
    folder: Path
    data: Path | None = None
    repair: bool = False

    @property
    def identity(self) -> str:
        """Hash of everything that losses and the sequence of trials depend on."""
        sheet = [self.task(0, {}, run).identity for run in self.split.train]
        decides = [sheet, self.dials, self.objective.score, self.objective.output, self.low, self.high, self.seed]
        return sha256(json.dumps(decides).encode()).hexdigest()[:12]

    def options(self, factors: Mapping[str, float]) -> dict[str, Any]:
        """Return the estimator's options with these factors."""
        inflate = {**self.estimator.options.get("inflate", {}), **factors}
        return self.estimator.options | {"inflate": inflate}

    def task(self, number: int, factors: Mapping[str, float], run: Run, study: str = "") -> Task:
        """Return one run of a trial."""
        spec = replace(self.estimator, label=f"{study} {number}".strip(), options=self.options(factors))
        readings = run.log.path_sha256 if run.seed is not None else self.readings.get(run.log.name)
        task = Task.of(self.experiment, run._replace(estimator=spec), self.data, self.repair)
        return replace(task, readings_sha256=readings)


def prepare(
    experiment: Experiment,
    estimator: str | None = None,
    patterns: SplitPatterns = SplitPatterns(),  # noqa: B008
    sensors: Sequence[str] = (),
    objective: Objective = Objective("ate_rmse_m"),  # noqa: B008
    span: tuple[float, float] = (0.1, 10.0),
    seed: int = 0,
    out: Path = Path("results"),
    data: Path | None = None,
    repair: bool = False,
) -> Tuning:
    """Check a search before it begins. Of the recorded logs only those for training are opened.

    Args:
        estimator: its label; may be left out where there is only one that can be tuned.
        patterns: if empty, the experiment's `tune`.
        sensors: whose factors are searched; all that the estimator uses and the training logs have, when left out.

    Raises:
        ExperimentError, DatasetError: naming what is wrong; nothing was run.
    """
    if not 0 < span[0] < 1 < span[1]:
        raise ExperimentError(f"the range of factors must hold 1 inside, found {span[0]:g} to {span[1]:g}")
    spec = _chosen(experiment, estimator)
    split = divide(experiment, spec.label, patterns if patterns.train or patterns.held_out else experiment.tune)
    for run in split.held_out:
        _is_there(run, data)
    readings, aboard = {}, set(IMU)
    for run in {run.log.name: run for run in split.train}.values():
        if run.log.scenario is not None:
            aboard |= {sensor for sensor in spec.create().factors if run.log.source[sensor] is not None}
        else:
            log = run.log.open(None, data, repair)
            _can_score(log, run, experiment, objective)
            readings[run.log.name] = content_sha256(log)
            aboard |= log.streams.keys()
    possible = [*sorted(spec.create().factors & aboard), *IMU]
    for sensor in sensors:
        if sensor not in possible:
            raise ExperimentError(
                f"--sensor: {spec.label} has no {sensor!r} on the training logs{nearest(sensor, possible)} "
                f"(it has: {', '.join(possible)})"
            )
    dials = tuple(dial for dial in possible if dial in sensors or not sensors)
    scoring = replace(experiment.scores, nis=objective.needs_nis, floor=False)
    folder = out / experiment.name / "tuning" / re.sub(r"[^\w.=+-]+", "_", spec.label)
    experiment = replace(experiment, scores=scoring)
    return Tuning(experiment, spec, split, dials, objective, *span, seed, readings, folder, data, repair)


def _chosen(experiment: Experiment, label: str | None) -> EstimatorSpec:
    can = {each.label: each for each in experiment.estimators if hasattr(each.create(), "inflate")}
    known = ", ".join(can) or "none"
    if label is None and len(can) == 1:
        return next(iter(can.values()))
    if label is None:
        raise ExperimentError(f"{experiment.name}: say which to tune by --estimator LABEL (can be: {known})")
    if label not in can:
        why = "has no `inflate`" if any(label == each.label for each in experiment.estimators) else "no such label"
        raise ExperimentError(f"--estimator {label!r}: {why}{nearest(label, can)} (can be tuned: {known})")
    return can[label]


def _can_score(log: Log, run: Run, experiment: Experiment, objective: Objective) -> None:
    """Refuse a recorded log that cannot have the score."""
    if objective.needs_nis:
        return
    if log.truth is None:
        raise ExperimentError(
            f"{run.log.name}: no truth, so no {objective.score}; --score nis_dvl and the like need no truth"
        )
    if objective.is_distance and not can_judge(log, experiment.scoring(run.log)):
        why = f"its truth is a {log.truth_kind}" if log.truth_kind != "truth" else "it is scored aligned"
        raise ExperimentError(
            f"{run.log.name}: no {objective.score}, for {why}; --score nis_dvl and the like need no truth"
        )


def _is_there(run: Run, data: Path | None) -> None:
    """Refuse a held-out recording that is missing, without opening it."""
    root = data or os.environ.get("FATHOM_DATA")
    if run.log.log is not None and not any((Path(place) / run.log.log).exists() for place in ("", root or "")):
        raise RecordingNotFound(f"{run.log.log}: held out, but neither here nor in {root}; use --data or FATHOM_DATA")
