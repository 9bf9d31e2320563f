"""The smoothers: a fixed lag and the whole log, each incrementally and by batches, on GTSAM and on our own window."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import gtsam
from pydantic import Field
from pydantic.dataclasses import dataclass

from ..datasets.rig import Rig
from ..datasets.state import Array, Belief
from .graph.graph_pass import GraphSmoother, GtsamSmoother, NonNegative, Positive
from .graph.solvers import BatchLagSolver, BatchSolver, IncrementalSolver, Solver, isam2_params
from .interface import Pass
from .window.window_pass import Solving, WindowPass


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
class WindowSmoother(LaggedSmoother):
    """MAP over the last lag_s seconds on our own solver: Gauss–Newton on the chain of keyframes (see `window_chain`).

    The estimate of `fls`, by the same factors at the same keyframes. A step factors one block, those that were
    linearised anew and all since, and goes back through the window once; `refactored` and `relinearised` count them.

    Attributes:
        relinearize: thresholds of rotation (rad), position (m), velocity (m/s) and bias (its units); a keyframe that
            has moved beyond any of them is linearised anew.
        extra_updates: Gauss–Newton steps after the one that takes in new factors, as long as anything moves beyond its
            threshold. With thresholds of 0 and some ten, every step ends at the optimum.
        relinearize_prior: also linearise anew what touches the marginal prior. GTSAM's smoothers leave that be.
    """

    relinearize: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (0.005, 10.0, 0.05, 1.0)
    extra_updates: Annotated[int, Field(ge=0)] = 0
    relinearize_prior: bool = False

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        return WindowPass(self, Solving(self.relinearize, self.extra_updates, self.relinearize_prior), prior, rig)


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
