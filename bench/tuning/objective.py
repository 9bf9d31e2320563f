"""The loss of a search: a score as it is, or the distance of a consistency score from its expected value."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from ...datasets.errors import nearest
from ...datasets.state import Array
from ..errors import ExperimentError
from ..metrics.comparison import OVER_SEEDS
from ..metrics.floor_ratio import FLOORS
from ..metrics.interval import interval
from ..metrics.scoring import ELLIPSOIDS, MEDIAN, NIS, OF_ELLIPSOIDS, POOLED
from ..results.paired import TAKE

EXPECTED: dict[str, float] = (
    dict.fromkeys(NIS, 1.0)
    | {f"nees_{block}": 3.0 for block in ("position", "attitude", "velocity")}
    | {"nees_biases": 6.0, "nees_all": 15.0}
    | {f"within_{k}sigma_{of}": float(chi2.cdf(k**2, 1)) for k in (1, 2, 3) for of in OF_ELLIPSOIDS}
    | {f"inside_{percent}_{of}": percent / 100 for percent in ELLIPSOIDS for of in OF_ELLIPSOIDS}
)
"""Expected values of consistency scores, for a consistent estimator."""

SCORES = [name for name in OVER_SEEDS if name not in (*MEDIAN, *FLOORS)] + list(NIS)
"""Scores that a search can minimise. Costs do not depend on the noise, and the floor not on the estimator."""


class Marks(NamedTuple):
    """One score of several runs: values (n,), and weights (n,): how many errors each was taken over."""

    values: Array
    weights: Array


@dataclass(frozen=True)
class Objective:
    """A score of one of an estimator's outputs, and the loss that it is made into.

    The loss of a consistency score is |ln(score / expected value)|, so that twice too large is as bad as half. The loss
    of any other score is the score itself. Runs are combined as in tables: squared errors are pooled before the root.

    Raises:
        ExperimentError: no such score, or not of this output.
    """

    score: str
    output: str = "online"

    def __post_init__(self) -> None:
        if self.score not in SCORES:
            known = ", ".join(SCORES)
            raise ExperimentError(f"--score: no score {self.score!r}{nearest(self.score, SCORES)} (known: {known})")
        if self.needs_nis and self.output != "online":
            raise ExperimentError(f"--score {self.score}: only the online output has innovations")

    @property
    def needs_nis(self) -> bool:
        """Whether the score needs NIS."""
        return self.score in NIS

    @property
    def is_distance(self) -> bool:
        """Whether the loss is a distance from the expected value, 0 at best."""
        return self.score in EXPECTED

    def lacking(self, row: Mapping[str, Any]) -> str | None:
        """Return why a row lacks the score; None if it has it."""
        name = row["log"] if row["seed"] is None else f"{row['log']}/{row['seed']}"
        if row["status"] != "done":
            return f"{name}: {row['status']}: {row['cause']}"
        if row["output"] != self.output or row.get(self.score) is None:
            return f"{name}: no {self.score} of the {self.output} output"
        return None

    def marks(self, rows: Sequence[Mapping[str, Any]]) -> Marks:
        """Return the score of these rows, each of which has it."""
        weights = np.ones(len(rows))
        if self.needs_nis:
            weights = np.array([json.loads(row["nis_dof"])[self.score.removeprefix("nis_")] for row in rows], float)
        elif self.score in POOLED:
            weights = np.array([row[POOLED[self.score]] for row in rows], float)
        return Marks(np.array([row[self.score] for row in rows], float), weights)

    def taken(self, values: Array, weights: Array, axis: int = -1) -> Array:
        """Return the score over runs."""
        if self.needs_nis:
            return (weights * values).sum(axis=axis) / weights.sum(axis=axis)
        return TAKE[OVER_SEEDS[self.score]](values, weights, axis)

    def loss(self, values: Array, weights: Array, axis: int = -1) -> Array:
        """Return the loss of a score."""
        score = self.taken(values, weights, axis)
        return np.abs(np.log(score / EXPECTED[self.score])) if self.is_distance else score

    def interval(self, marks: Marks) -> tuple[float, float] | None:
        """Return the 95 % interval over runs of the score; None where they are too few."""
        return interval(tuple(marks), self.taken, positive=True)

    def gain(self, tuned: Marks, sheet: Marks) -> tuple[float, tuple[float, float] | None]:
        """Return the gain of the tuned over the data sheet, and its 95 % interval, paired by run.

        The gain is the loss of the data sheet less that of the tuned, or the logarithm of their ratio where the loss is
        no distance: 0.1 is a tenth less either way.
        """

        def less(v: Array, n_v: Array, b: Array, n_b: Array, axis: int = -1) -> Array:
            of_v, of_b = self.loss(v, n_v, axis), self.loss(b, n_b, axis)
            return of_b - of_v if self.is_distance else np.log(of_b / of_v)

        data = (tuned.values, tuned.weights, sheet.values, sheet.weights)
        return float(less(*data)), interval(data, less)

    def gain_of(self, tuned: float, sheet: float) -> float:
        """Return the gain between two losses."""
        return sheet - tuned if self.is_distance else math.log(sheet / tuned)
