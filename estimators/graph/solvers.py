"""GTSAM's solvers behind one interface, `Solver`, for `graph_pass`."""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ...datasets.state import Array, Belief, NavState
from ..stages import clock, stage
from .gtsam_border import as_covariance, as_state

Thresholds = tuple[float, float, float, float]
"""Of rotation (rad), position (m), velocity (m/s) and bias: beyond them iSAM2 linearises a variable anew."""


class Solver(Protocol):
    """Solves for the keyframes in its window, given factors."""

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

    def work(self) -> dict[str, int]:
        """Return how much was done: `factor_slots` now, and variables `relinearised` while `stages.clock` ran."""
        ...


def isam2_params(factorization: str, relinearize: Thresholds, wildfire: float) -> gtsam.ISAM2Params:
    """Return iSAM2's parameters: every update may relinearise, and slots of factors that are gone are used again."""
    rotation, position, velocity, bias = relinearize
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", np.array([rotation] * 3 + [position] * 3)))
    thresholds.insert(("v", np.full(3, velocity)))
    thresholds.insert(("b", np.full(6, bias)))
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(wildfire))
    params.setFactorization(factorization)
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


def levenberg_marquardt_params(factorization: str) -> gtsam.LevenbergMarquardtParams:
    """Return Levenberg–Marquardt's parameters; GTSAM's default, Cholesky, fails on IMU noise of a tactical grade.

    Its default bound on the damping, 1e5, is nothing beside information of 1e10: a reading that is far out would leave
    it without an acceptable step, and it would stop without an error.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setlambdaUpperBound(1e30)
    params.setLinearSolverType(f"MULTIFRONTAL_{factorization}")
    return params


EDGE_S = 1e-3
"""The solver's window is longer than the lag by this, so that a state of exactly that age can still be queried."""


class IncrementalSolver:
    """iSAM2, with marginalisation of what is older than lag_s, or without where that is None.

    Each update is one Gauss–Newton step; extra_updates without anything new follow it, a step each.
    """

    def __init__(
        self, params: gtsam.ISAM2Params, R_BI: Array, lag_s: float | None = None, extra_updates: int = 0
    ) -> None:
        self._R_BI, self._extra_updates, self._relinearised = R_BI, extra_updates, 0
        self._lagged = None if lag_s is None else gtsam.IncrementalFixedLagSmoother(lag_s + EDGE_S, params)
        self._isam2 = gtsam.ISAM2(params) if self._lagged is None else None

    @property
    def _estimates(self) -> Any:
        return self._isam2 if self._lagged is None else self._lagged

    @property
    def isam2(self) -> gtsam.ISAM2:
        """The tree itself, for its marginals and its factors."""
        return self._isam2 or self._estimates.getISAM2()

    @stage("solve")
    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[Any, Any]) -> None:
        """See `Solver.update`."""
        if self._lagged is None:
            self.isam2.update(graph, values)
        else:
            self._lagged.update(graph, values, stamps)
        self._count()
        for _ in range(self._extra_updates):
            self._estimates.update()
            self._count()

    @stage("solve")
    def state(self, i: int) -> NavState:
        """See `Solver.state`."""
        return _estimate(self._estimates, i, self._R_BI)

    @stage("marginal")
    def belief(self, i: int, t_ns: int) -> Belief:
        """See `Solver.belief`."""
        state = self.state(i)
        joint = self.isam2.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix()
        linearised_at = self.isam2.getLinearizationPoint().atPose3(X(i)).rotation().matrix()
        return Belief(t_ns, state, as_covariance(joint, state.R_WB, self._R_BI, linearised_at))

    @stage("solve")
    def finish(self) -> None:
        """iSAM2 has nothing left to do."""

    def work(self) -> dict[str, int]:
        """See `Solver.work`."""
        return {"factor_slots": self.isam2.getFactorsUnsafe().size(), "relinearised": self._relinearised}

    def _count(self) -> None:
        if clock.running and self._lagged is not None:
            self._relinearised += self._lagged.getISAM2Result().getVariablesRelinearized()


class BatchLagSolver:
    """GTSAM's BatchFixedLagSmoother: Levenberg–Marquardt over the window at every update, the rest marginalised out.

    Variables that a marginalised one was tied to keep their linearisation point, as in iSAM2; all others are linearised
    anew in every iteration, so there are no thresholds.
    """

    def __init__(self, factorization: str, R_BI: Array, lag_s: float) -> None:
        self._R_BI = R_BI
        self._smoother = gtsam.BatchFixedLagSmoother(lag_s + EDGE_S, levenberg_marquardt_params(factorization))

    @stage("solve")
    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[Any, Any]) -> None:
        """See `Solver.update`."""
        self._smoother.update(graph, values, stamps)

    @stage("solve")
    def state(self, i: int) -> NavState:
        """See `Solver.state`."""
        return _estimate(self._smoother, i, self._R_BI)

    @stage("marginal")
    def belief(self, i: int, t_ns: int) -> Belief:
        """See `Solver.belief`. The smoother keeps no factorisation: the window is eliminated anew, by QR, down to i."""
        state, keys, order = self.state(i), [X(i), V(i), B(i)], gtsam.Ordering()
        for key in keys:
            order.push_back(key)
        window = self._smoother.getFactors().linearize(self._smoother.calculateEstimate())
        A = window.marginal(keys, gtsam.EliminateQR).jacobian(order)[0]
        S = np.linalg.inv(np.linalg.qr(A, mode="r"))
        return Belief(t_ns, state, as_covariance(S @ S.T, state.R_WB, self._R_BI))

    @stage("solve")
    def finish(self) -> None:
        """Every update has converged."""

    def work(self) -> dict[str, int]:
        """See `Solver.work`."""
        return {}


def _estimate(source: Any, i: int, R_BI: Array) -> NavState:
    """Return keyframe i of iSAM2 or of a smoother on either."""
    pose, bias = source.calculateEstimatePose3(X(i)), source.calculateEstimateConstantBias(B(i))
    return as_state(pose, source.calculateEstimateVector(V(i)), bias, R_BI)


class BatchSolver(IncrementalSolver):
    """iSAM2 during the log, for an initial guess; at the end Levenberg–Marquardt over all factors.

    Covariances are iSAM2's, whose linearisation points are the optimum's within its thresholds, in the optimum's axes.
    """

    def __init__(self, params: gtsam.ISAM2Params, R_BI: Array, factorization: str, extra_updates: int = 0) -> None:
        super().__init__(params, R_BI, extra_updates=extra_updates)
        self._factorization = factorization
        self._every_factor = gtsam.NonlinearFactorGraph()
        self._optimum: gtsam.Values | None = None

    @stage("solve")
    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[Any, Any]) -> None:
        """See `Solver.update`."""
        super().update(graph, values, stamps)
        self._every_factor.push_back(graph)

    @stage("solve")
    def state(self, i: int) -> NavState:
        """See `Solver.state`."""
        optimum = self._optimum
        if optimum is None:
            return super().state(i)
        pose, bias = optimum.atPose3(X(i)), optimum.atConstantBias(B(i))
        return as_state(pose, optimum.atVector(V(i)), bias, self._R_BI)

    @stage("solve")
    def finish(self) -> None:
        """Solve the whole log."""
        params = levenberg_marquardt_params(self._factorization)
        guess = self.isam2.calculateBestEstimate()
        self._optimum = gtsam.LevenbergMarquardtOptimizer(self._every_factor, guess, params).optimize()
