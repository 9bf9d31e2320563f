"""The smoothers on GTSAM: a fixed lag and the whole log, each incrementally and by batches."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Literal

import gtsam
from pydantic import Field
from pydantic.dataclasses import dataclass

from ...datasets.rig import Rig
from ...datasets.state import Array, Belief
from ..interface import Pass
from ..smoothers import GraphSmoother, LaggedSmoother, NonNegative, Positive
from ..window.window_pass import Solving, WindowPass
from .graph_pass import GraphPass
from .solvers import BatchLagSolver, BatchSolver, IncrementalSolver, Solver, isam2_params


@dataclass(frozen=True)
class GtsamSmoother(GraphSmoother):
    """What the smoothers on GTSAM can be told besides.

    Attributes:
        factorization: of the linear system; Cholesky fails on the IMU noise of a tactical grade.
    """

    factorization: Literal["QR", "CHOLESKY"] = "QR"

    @abstractmethod
    def solver(self, R_BI: Array) -> Solver:
        """Return a new solver for one pass."""

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        return GraphPass(self, self.solver(rig.imu.R_BS), prior, rig)


@dataclass(frozen=True)
class IncrementalSmoother(GtsamSmoother):
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
class FixedLagSmoother(LaggedSmoother, IncrementalSmoother):
    """MAP over the last lag_s seconds; older states are marginalised out (GTSAM's IncrementalFixedLagSmoother)."""

    def solver(self, R_BI: Array) -> Solver:
        """See `GtsamSmoother.solver`."""
        return IncrementalSolver(self.isam2_params(), R_BI, self.lag_s, self.extra_updates)


@dataclass(frozen=True)
class BatchFixedLagSmoother(LaggedSmoother, GtsamSmoother):
    """MAP over the last lag_s seconds, solved anew at every keyframe (GTSAM's BatchFixedLagSmoother).

    The same estimate as an iSAM2 that linearises everything anew in every step; a keyframe's cost grows with the lag.
    """

    def solver(self, R_BI: Array) -> Solver:
        """See `GtsamSmoother.solver`."""
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
        """See `GtsamSmoother.solver`."""
        return IncrementalSolver(self.isam2_params(), R_BI, extra_updates=self.extra_updates)


GUESS_KEYFRAMES = 50
"""While a log lasts, `batch` on our own solver goes back so far for what it linearises anew."""


@dataclass(frozen=True)
class BatchSmoother(WholeLogSmoother):
    """MAP over the whole log at its end: the best a smoother can do.

    Attributes:
        engine: "gtsam" is iSAM2 until then, which also gives the guess that Levenberg–Marquardt starts from. "window"
            is our own solver (`window_chain`): a filter that goes back a little while the log lasts, then Gauss–Newton
            over all of it. One optimum; the second is there in a hundredth of the time.
    """

    engine: Literal["gtsam", "window"] = "gtsam"

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        if self.engine == "gtsam":
            return super().begin(prior, rig)
        solving = Solving(self.relinearize, self.extra_updates, reach=GUESS_KEYFRAMES, to_optimum=True)
        return WindowPass(self, solving, prior, rig)

    def solver(self, R_BI: Array) -> Solver:
        """See `GtsamSmoother.solver`."""
        return BatchSolver(self.isam2_params(), R_BI, self.factorization, self.extra_updates)
