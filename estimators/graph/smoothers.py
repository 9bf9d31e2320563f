"""The smoothers on GTSAM: a fixed lag and the whole log, each incrementally and by batches."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Literal

import gtsam
from pydantic import Field
from pydantic.dataclasses import dataclass

from ...datasets.quantities import NotNegative, Positive, Whole
from ...datasets.rig import Rig
from ...datasets.state import Array, Belief
from ..interface import Pass
from ..smoothers import GraphSmoother, LaggedSmoother
from ..unknown_start import refuse_unknown_heading, refuse_unknown_velocity
from .graph_pass import GraphPass, ImuFactor
from .solvers import BatchLagSolver, IncrementalSolver, Solver, isam2_params


@dataclass(frozen=True)
class GtsamSmoother(GraphSmoother):
    """Further options of the smoothers on GTSAM.

    Attributes:
        factorization: of the linear system; Cholesky fails on the IMU noise of a tactical grade.
        imu_factor: "fathom" is our own (`imu_factor`), "gtsam" GTSAM's CombinedImuFactor, at the same cost. After a
            large correction, as by the first fix for two minutes without a DVL, GTSAM's is overconfident of attitude:
            NEES of 8 per degree of freedom, and twice the ATE; ours has 1.3.
    """

    imu_factor: ImuFactor = "fathom"
    factorization: Literal["QR", "CHOLESKY"] = "QR"

    @abstractmethod
    def solver(self, R_BI: Array) -> Solver:
        """Return a new solver for one pass."""

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        if not (math.isinf(self.window_s) and not self.preintegrates):
            refuse_unknown_heading(prior)
            refuse_unknown_velocity(prior)
        return GraphPass(self, self.solver(rig.imu.R_BS), prior, rig, self.imu_factor)


@dataclass(frozen=True)
class IncrementalSmoother(GtsamSmoother):
    """Further options of the smoothers on iSAM2: how near the optimum they stay, and at what cost.

    With relinearize and wildfire all 0 and two extra updates, every step ends at the optimum of the graph; the cost
    then grows with the length of the window.

    Attributes:
        relinearize: thresholds of rotation (rad), position (m), velocity (m/s) and bias (its units) above which iSAM2
            relinearises a variable. Position enters every factor linearly but for its rotation into B. Under a loss
            (`robust`) weights are computed anew with the linearisation: choose a fraction of the sensor's sigma.
        wildfire: an update goes down the tree while variables move by more than this (in their own units).
        extra_updates: Gauss–Newton steps after the one that takes in new factors.
    """

    relinearize: tuple[NotNegative, NotNegative, NotNegative, NotNegative] = (0.005, 10.0, 0.05, 1.0)
    wildfire: NotNegative = 1e-3
    extra_updates: Annotated[Whole, Field(ge=0)] = 0

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

    The estimate equals that of an iSAM2 that relinearises everything in every step; the cost grows with the lag.
    """

    def solver(self, R_BI: Array) -> Solver:
        """See `GtsamSmoother.solver`."""
        return BatchLagSolver(self.factorization, R_BI, self.lag_s)


@dataclass(frozen=True)
class WholeLogSmoother(IncrementalSmoother):
    """MAP over the whole log, incrementally (GTSAM's iSAM2, nothing marginalised)."""

    smoothed_covariance_s: Positive = 60.0

    @property
    def window_s(self) -> float:
        """Every state is kept to the end."""
        return math.inf

    def solver(self, R_BI: Array) -> Solver:
        """See `GtsamSmoother.solver`."""
        return IncrementalSolver(self.isam2_params(), R_BI, extra_updates=self.extra_updates)
