"""Which runs train a search, and which are held out."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from ...datasets.described.opening import catalog_names
from ..errors import ExperimentError
from ..experiment.plan import Experiment, Run, SplitPatterns

NAME_THEM = 'name them: `tune: {train: [...], held_out: [...]}`, or --train and --held-out, by log or by "log/seed"'


class Split(NamedTuple):
    """The runs of one estimator: training, held out, and the names of logs that are neither."""

    train: list[Run]
    held_out: list[Run]
    aside: list[str]


def unit(run: Run) -> str:
    """Return the name of a run's log and seed: "lawnmower/3", or "dive_7" of a recorded log."""
    return run.log.name if run.seed is None else f"{run.log.name}/{run.seed}"


def in_words(runs: Sequence[Run]) -> str:
    """Return the names of the logs of these runs, each once, with its seeds."""
    seeds: dict[str, list[str]] = {}
    for run in runs:
        seeds.setdefault(run.log.name, []).extend([] if run.seed is None else [str(run.seed)])
    return "; ".join(f"{name}, seeds {', '.join(of)}" if of else name for name, of in seeds.items())


def divide(experiment: Experiment, label: str, patterns: SplitPatterns) -> Split:
    """Divide the runs of the estimator of this label; see `SplitPatterns`.

    Raises:
        ExperimentError: one part is empty; a log (or a seed of simulated logs) is in both; a pattern matches nothing.
    """
    runs = [run for run in experiment.runs() if run.estimator.label == label]
    if patterns.train or patterns.held_out:
        train, held_out = _named(runs, patterns.train, "train"), _named(runs, patterns.held_out, "held out")
        train = train if patterns.train else [run for run in runs if run not in held_out]
        held_out = held_out if patterns.held_out else [run for run in runs if run not in train]
    else:
        half = (len(experiment.seeds) + 1) // 2
        train = [run for run in runs if run.seed in experiment.seeds[:half]]
        held_out = [run for run in runs if run.seed in experiment.seeds[half:]]
    for side, name in ((train, "trains"), (held_out, "is held out")):
        if not side:
            raise ExperimentError(f"{experiment.name}: nothing {name} of {', '.join(map(unit, runs))}; {NAME_THEM}")
    _refuse_both(train, held_out)
    aside = dict.fromkeys(unit(run) for run in runs if run not in train and run not in held_out)
    return Split(train, held_out, list(aside))


def _named(runs: Sequence[Run], patterns: Sequence[str], side: str) -> list[Run]:
    for pattern in patterns:
        if not any(_matches(run, pattern) for run in runs):
            raise ExperimentError(f"{side}: {pattern!r} matches none of: {', '.join(map(unit, runs))}")
    return [run for run in runs if any(_matches(run, pattern) for pattern in patterns)]


def _matches(run: Run, pattern: str) -> bool:
    return fnmatchcase(run.log.name, pattern) or fnmatchcase(unit(run), pattern)


def _refuse_both(train: Sequence[Run], held_out: Sequence[Run]) -> None:
    """Refuse a recording, or a seed, that is on both patterns: the search would see what is held out."""
    for ours in train:
        for theirs in held_out:
            if _source(ours) == _source(theirs):
                what = "the same recording" if ours.seed is None else "the same random numbers"
                raise ExperimentError(
                    f"{unit(ours)} trains and {unit(theirs)} is held out: {what}; held-out data must be new"
                )


def _source(run: Run) -> object:
    """Return what the two parts must not share: a recording, by path or catalog name; or a seed."""
    if run.seed is not None:
        return run.seed
    path = Path(run.log.log or "")
    return path.resolve() if path.exists() and path.resolve().name not in catalog_names() else path.name
