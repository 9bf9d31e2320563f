"""The content of an experiment file: entries, each of which may stand for many logs or estimators."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from ...datasets.errors import nearest, shown
from ...datasets.quantities import Positive, Whole
from ...datasets.simulated.scenario import Scenario
from ...estimators.interface import FACTORS, sensors_among
from ..metrics.alignment import Alignment
from ..metrics.comparison import OVER_SEEDS
from ..metrics.pose_error import Dims
from ..metrics.scoring import Scoring
from .specs import EstimatorSpec, LogSpec
from .variants import Grid, changed, points

STRICT = ConfigDict(extra="forbid", populate_by_name=True)

MOST_SEEDS = 100_000
"""A larger number of seeds is a seed that lacks its brackets."""


@dataclass(frozen=True, config=STRICT)
class LogEntry:
    """One entry of `logs`: a simulated log, several with a grid, or a recorded one.

    Attributes:
        scenario, log, align, dims, baseline: as in LogSpec.
        name: of the log; made from the mission and the IMU, or from the folder, when left out.
        grid: keys of the scenario, dotted where they are nested, and the values that they take: the entry stands for a
            log at every point of it.
        estimators: labels, or patterns of labels, of those that run on it; all, when left out.
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
    def _fits(self) -> LogEntry:
        if self.log is not None and self.scenario is None and (self.grid or self.baseline):
            raise ValueError(f"`{'grid' if self.grid else 'baseline'}` is for simulated logs, which share their seeds")
        self.variants()
        return self

    def variants(self) -> tuple[LogSpec, ...]:
        """Return the logs that this entry stands for: one, where it has no grid.

        Raises:
            ValueError: it is no log, or a point of the grid is no scenario (a DatasetError that names the key).
        """
        others = (self.align, self.dims, self.estimators, self.baseline)
        full = LogSpec("", self.scenario, self.log, *others)
        name = self.name or _default_name(full)
        return tuple(
            replace(
                full,
                name=shown(f"{name} {words}".rstrip()),
                scenario=None if self.scenario is None else changed(self.scenario, changes),
            )
            for words, changes in points(self.grid)
        )


def _default_name(log: LogSpec) -> str:
    if log.log is not None:
        return Path(log.log).name or Path(log.log).resolve().name
    scenario = Scenario.from_dict(log.scenario or {})
    noise = scenario.imu.noise
    return f"{scenario.mission}-{noise}" if isinstance(noise, str) else scenario.mission


Sensors = Annotated[tuple[str, ...], sensors_among(FACTORS)]


@dataclass(frozen=True, config=STRICT)
class EstimatorEntry:
    """One entry of `estimators`: one estimator, or several.

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
    def _fits(self) -> EstimatorEntry:
        self.variants()
        return self

    def variants(self) -> tuple[EstimatorSpec, ...]:
        """Return the estimators that this entry stands for: every point of its grid, each followed by those with less.

        Raises:
            ValueError: an estimator or an option is unknown, or cannot take a value (an EstimatorError); or there is no
                such sensor to drop or to keep.
        """
        label = self.label or self.name
        EstimatorSpec(self.name, label, self.options)
        found = []
        for words, changes in points(self.grid):
            options = changed(self.options, changes)
            full = EstimatorSpec(self.name, shown(f"{label} {words}".rstrip()), options, self.baseline)
            has = full.create().factors
            less = {f"no {sensor}": has - {sensor} for sensor in self.drop}
            less |= {f"only {' + '.join(kept) or 'the IMU'}": frozenset(kept) for kept in self.only}
            for sensor in sorted({*self.drop, *(sensor for kept in self.only for sensor in kept)} - has):
                raise ValueError(f"{full.label} does not use {sensor!r} (it uses: {', '.join(sorted(has))})")
            found.append(full)
            found += [
                EstimatorSpec(self.name, f"{full.label} {words}", options | {"factors": sorted(factors)}, full.label)
                for words, factors in less.items()
            ]
        return tuple(found)


def _counted_from_one(seeds: Any) -> Any:
    """Return the seeds that a number of them stands for; a list as it is."""
    if isinstance(seeds, list | tuple):
        return seeds
    if type(seeds) is not int or not 1 <= seeds <= MOST_SEEDS:
        raise ValueError(f"expected a list of seeds, or how many (1 to {MOST_SEEDS}), found {seeds!r:.60}")
    return tuple(range(1, seeds + 1))


def _can_be_compared(scores: tuple[str, ...]) -> tuple[str, ...]:
    for score in scores:
        refuse_unknown("no score to compare by", score, OVER_SEEDS)
    refuse_twice("score", scores)
    return scores


@dataclass(frozen=True, config=STRICT)
class SplitPatterns:
    """Which runs `fathom tune` trains on, and which it holds out: patterns of a log's name, or of "log/seed".

    Attributes:
        train: runs for the search; without patterns, all that are not held out.
        held_out: runs for the final check; without patterns, all that are not in training. Without either, the first
            half of the seeds of simulated logs is for training and the rest is held out; recorded logs are not used.
    """

    train: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()


@dataclass(frozen=True, config=STRICT, kw_only=True)
class Settings:
    """Settings of an experiment that hold for all its runs.

    Attributes:
        name: its folder under `results`.
        description: what it asks, in a sentence or two.
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
    description: str = ""
    seeds: Annotated[
        tuple[Annotated[Whole, Field(ge=0, lt=2**63)], ...], Field(min_length=1), BeforeValidator(_counted_from_one)
    ] = (1,)
    scores: Scoring = Scoring()
    baseline: str | None = None
    compare: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_can_be_compared)] = (
        "ate_rmse_m",
        "heading_rmse_deg",
        "velocity_rmse_m_s",
    )
    tune: SplitPatterns = SplitPatterns()
    max_gap_s: Positive = 1.0
    timeout_s: Positive = 1800.0


@dataclass(frozen=True, config=STRICT, kw_only=True)
class ExperimentFile(Settings):
    """An experiment as it was read; `Experiment` is what it stands for."""

    logs: Annotated[tuple[LogEntry, ...], Field(min_length=1)]
    estimators: Annotated[tuple[EstimatorEntry, ...], Field(min_length=1)]


def refuse_unknown(complaint: str, name: str | None, known: Iterable[str]) -> None:
    """Refuse a name that is not among the known ones; None is no name."""
    known = list(known)
    if name is not None and name not in known:
        raise ValueError(f"{complaint} {name!r}{nearest(name, known)} (known: {', '.join(known)})")


def refuse_twice(what: str, values: Iterable[Any]) -> None:
    """Refuse a value that stands there twice."""
    twice = [value for value, n in Counter(values).items() if n > 1]
    if twice:
        hint = {"label": "; give each its own `label`", "log name": "; give each its own `name`"}.get(what, "")
        raise ValueError(f"the {what} {twice[0]!r} is there twice{hint}")
