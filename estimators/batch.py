"""The smoother over the whole log at once, on GTSAM's solver or on our own."""

from __future__ import annotations

from typing import Literal

from pydantic.dataclasses import dataclass

from ..datasets.rig import Rig
from ..datasets.state import Array, Belief
from .graph.smoothers import WholeLogSmoother
from .graph.solvers import BatchSolver, Solver
from .interface import Pass
from .unknown_start import refuse_unknown_heading, refuse_unknown_velocity
from .window.window_pass import Solving, WindowPass

GUESS_KEYFRAMES = 50
"""Keyframes, 10 s at 5 Hz: how far back `batch` on our own solver relinearises during the log. Only a first guess."""


@dataclass(frozen=True)
class BatchSmoother(WholeLogSmoother):
    """MAP over the whole log, solved at its end: the most accurate smoother.

    Attributes:
        engine: "gtsam" runs iSAM2 during the log, then Levenberg–Marquardt from its estimate. "window" is our own
            solver (docs/window.md): a fixed-lag smoother during the log, then Gauss–Newton over all of it. Both reach
            the same optimum; "window" takes a hundredth of the time.
    """

    engine: Literal["gtsam", "window"] = "gtsam"

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        if self.engine == "gtsam":
            return super().begin(prior, rig)
        if self.preintegrates:
            refuse_unknown_heading(prior)
        refuse_unknown_velocity(prior)
        solving = Solving(self.relinearize, self.extra_updates, reach=GUESS_KEYFRAMES, to_optimum=True)
        return WindowPass(self, solving, prior, rig)

    def solver(self, R_BI: Array) -> Solver:
        """See `GtsamSmoother.solver`."""
        return BatchSolver(self.isam2_params(), R_BI, self.factorization, self.extra_updates)
