"""GTSAM's solvers behind one small interface: what a graph pass asks of them."""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ..datasets.state import Array, Belief, NavState
from .gtsam_border import as_covariance, as_state

Thresholds = tuple[float, float, float, float]
"""Of rotation (rad), position (m), velocity (m/s) and bias: beyond them iSAM2 linearises a variable anew."""


class Solver(Protocol):
    """Takes factors and new keyframes in, and says what it believes of each keyframe that it still has."""

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[Any, Any]) -> None:
        """Add factors, and new variables with their times in seconds."""
        ...

    def state(self, i: int) -> NavState:
        """Return keyframe i."""
        ...

    def belief(self, i: int, t_ns: int) -> Belief:
        """Return keyframe i, of time t_ns, with its covariance."""
        ...

    def finish(self) -> None:
        """There will be no more factors."""
        ...


def isam2_params(factorization: str, relinearize: Thresholds) -> gtsam.ISAM2Params:
    """Return iSAM2's parameters: every update may relinearise, and slots of factors that are gone are used again."""
    rotation, position, velocity, bias = relinearize
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", np.array([rotation] * 3 + [position] * 3)))
    thresholds.insert(("v", np.full(3, velocity)))
    thresholds.insert(("b", np.full(6, bias)))
    params = gtsam.ISAM2Params()
    params.setFactorization(factorization)
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


class IncrementalSolver:
    """iSAM2, with marginalisation of what is older than lag_s, or without where that is None."""

    def __init__(self, params: gtsam.ISAM2Params, R_BI: Array, lag_s: float | None = None) -> None:
        self._R_BI = R_BI
        self._lagged = None if lag_s is None else gtsam.IncrementalFixedLagSmoother(lag_s, params)
        self._isam2 = gtsam.ISAM2(params) if self._lagged is None else None

    @property
    def _estimates(self) -> Any:
        return self._isam2 if self._lagged is None else self._lagged

    @property
    def isam2(self) -> gtsam.ISAM2:
        """The tree itself, for its marginals and its factors."""
        return self._isam2 or self._estimates.getISAM2()

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[Any, Any]) -> None:
        """See `Solver.update`."""
        if self._lagged is None:
            self.isam2.update(graph, values)
        else:
            self._lagged.update(graph, values, stamps)

    def state(self, i: int) -> NavState:
        """See `Solver.state`."""
        source = self._estimates
        pose, bias = source.calculateEstimatePose3(X(i)), source.calculateEstimateConstantBias(B(i))
        return as_state(pose, source.calculateEstimateVector(V(i)), bias, self._R_BI)

    def belief(self, i: int, t_ns: int) -> Belief:
        """See `Solver.belief`."""
        state = self.state(i)
        joint = self.isam2.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix()
        return Belief(t_ns, state, as_covariance(joint, state.R_WB, self._R_BI))

    def finish(self) -> None:
        """iSAM2 has nothing left to do."""


class BatchSolver(IncrementalSolver):
    """iSAM2 while the log lasts, for a guess; in the end Levenberg–Marquardt over every factor there was.

    Covariances are iSAM2's, whose linearisation points are the optimum's within its thresholds.
    """

    def __init__(self, params: gtsam.ISAM2Params, R_BI: Array) -> None:
        super().__init__(params, R_BI)
        self._every_factor = gtsam.NonlinearFactorGraph()
        self._optimum: gtsam.Values | None = None

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[Any, Any]) -> None:
        """See `Solver.update`."""
        super().update(graph, values, stamps)
        self._every_factor.push_back(graph)

    def state(self, i: int) -> NavState:
        """See `Solver.state`."""
        optimum = self._optimum
        if optimum is None:
            return super().state(i)
        pose, bias = optimum.atPose3(X(i)), optimum.atConstantBias(B(i))
        return as_state(pose, optimum.atVector(V(i)), bias, self._R_BI)

    def finish(self) -> None:
        """Solve the whole log."""
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky fails on the IMU noise of a tactical grade
        guess = self.isam2.calculateBestEstimate()
        self._optimum = gtsam.LevenbergMarquardtOptimizer(self._every_factor, guess, params).optimize()
