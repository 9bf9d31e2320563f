"""The smoothers on GTSAM: a fixed lag, the whole log incrementally, and the whole log at once."""

from __future__ import annotations

import math

from pydantic.dataclasses import dataclass

from ..datasets.state import Array
from .graph_pass import GraphSmoother, Positive
from .solvers import BatchSolver, IncrementalSolver, Solver, isam2_params


@dataclass(frozen=True)
class FixedLagSmoother(GraphSmoother):
    """MAP over the last lag_s seconds; older states are marginalised out (GTSAM's IncrementalFixedLagSmoother).

    Attributes:
        lag_s: length of the window.
    """

    lag_s: Positive = 3.0

    @property
    def window_s(self) -> float:
        """See `GraphSmoother.window_s`."""
        return self.lag_s

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return IncrementalSolver(isam2_params(self.factorization, self.relinearize), R_BI, self.lag_s)


@dataclass(frozen=True)
class WholeLogSmoother(GraphSmoother):
    """MAP over the whole log, incrementally (GTSAM's iSAM2, nothing marginalised)."""

    hindsight_covariance_s: Positive = 60.0

    @property
    def window_s(self) -> float:
        """Every state is kept to the end."""
        return math.inf

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return IncrementalSolver(isam2_params(self.factorization, self.relinearize), R_BI)


@dataclass(frozen=True)
class BatchSmoother(WholeLogSmoother):
    """MAP over the whole log at its end, by Levenberg–Marquardt: the best a smoother can do.

    Until then it is iSAM2, which also gives the guess to start from.
    """

    def solver(self, R_BI: Array) -> Solver:
        """See `GraphSmoother.solver`."""
        return BatchSolver(isam2_params(self.factorization, self.relinearize), R_BI)
