"""The smoothers on GTSAM: a fixed lag and the whole log, each incrementally and by batches."""

from __future__ import annotations

import math
from typing import Annotated

import gtsam
from pydantic import Field
from pydantic.dataclasses import dataclass

from ..datasets.state import Array
from .graph_pass import GraphSmoother, NonNegative, Positive
from .solvers import BatchLagSolver, BatchSolver, IncrementalSolver, Solver, isam2_params


@dataclass(frozen=True)
class IncrementalSmoother(GraphSmoother):
    """What the smoothers on iSAM2 can be told besides: how near the optimum they stay, and at what cost.

    With relinearize and wildfire all 0 and two extra updates every step ends at the optimum of what is in the graph,
    for a cost that grows with the length of the window.

    Attributes:
        relinearize: thresholds of rotation (rad), position (m), velocity (m/s) and bias (its units) above which iSAM2
            linearises a variable anew. Position enters every factor linearly but for its rotation into B; under a
            loss (`robust`), whose weights are renewed with the linearisation, give it a part of the sensor's sigma.
        wildfire: an update goes down the tree as far as variables move by more than this (in their own units).
        extra_updates: Gauss–Newton steps after the one that takes in new factors.
    """

    relinearize: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (0.005, 10.0, 0.05, 1.0)
    wildfire: NonNegative = 1e-3
    extra_updates: Annotated[int, Field(ge=0)] = 0

    def isam2_params(self) -> gtsam.ISAM2Params:
        """Return iSAM2's parameters."""
        return isam2_params(self.factorization, self.relinearize, self.wildfire)


@dataclass(frozen=True)
class LaggedSmoother(GraphSmoother):
    """What keeps the last lag_s seconds and marginalises out what is older.

    Attributes:
        lag_s: length of the window; 0 keeps the newest keyframe alone, and is a filter.
    """

    lag_s: NonNegative = 3.0

    @property
    def window_s(self) -> float:
        """See `GraphSmoother.window_s`."""
        return self.lag_s


@dataclass(frozen=True)
class FixedLagSmoother(LaggedSmoother, IncrementalSmoother):
    """MAP over the last lag_s seconds; older states are marginalised out (GTSAM's IncrementalFixedLagSmoother)."""

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return IncrementalSolver(self.isam2_params(), R_BI, self.lag_s, self.extra_updates)


@dataclass(frozen=True)
class BatchFixedLagSmoother(LaggedSmoother):
    """MAP over the last lag_s seconds, solved anew at every keyframe (GTSAM's BatchFixedLagSmoother).

    The same estimate as an iSAM2 that linearises everything anew in every step; a keyframe's cost grows with the lag.
    """

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return BatchLagSolver(self.factorization, R_BI, self.lag_s)


@dataclass(frozen=True)
class WholeLogSmoother(IncrementalSmoother):
    """MAP over the whole log, incrementally (GTSAM's iSAM2, nothing marginalised)."""

    hindsight_covariance_s: Positive = 60.0

    @property
    def window_s(self) -> float:
        """Every state is kept to the end."""
        return math.inf

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return IncrementalSolver(self.isam2_params(), R_BI, extra_updates=self.extra_updates)


@dataclass(frozen=True)
class BatchSmoother(WholeLogSmoother):
    """MAP over the whole log at its end, by Levenberg–Marquardt: the best a smoother can do.

    Until then it is iSAM2, which also gives the guess to start from.
    """

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return BatchSolver(self.isam2_params(), R_BI, self.factorization, self.extra_updates)
