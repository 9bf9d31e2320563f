"""The fixed-lag smoother on our own solver."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from ...datasets.quantities import NotNegative, Whole
from ...datasets.rig import Rig
from ...datasets.state import Belief
from ..interface import Pass
from ..smoothers import LaggedSmoother
from ..unknown_start import refuse_unknown_heading, refuse_unknown_velocity
from .window_pass import Solving, WindowPass


@dataclass(frozen=True)
class WindowSmoother(LaggedSmoother):
    """MAP over the last lag_s seconds on our own solver: Gauss–Newton on the chain of keyframes (docs/window.md).

    It has the factors of `fls` at the same keyframes. A step factors the new block, and the blocks since the oldest
    keyframe that was relinearised; then it substitutes back through the window once. `refactored` and `relinearised`
    count blocks and keyframes. Its prior, stated and marginal, is normal in coordinates that hold for any yaw, so that
    it takes an unknown heading, unless it sums the DVL.

    Attributes:
        relinearize: thresholds of rotation (rad), position (m), velocity (m/s) and bias (its units); a keyframe that
            has moved beyond any of them is relinearised.
        extra_updates: Gauss–Newton steps after the one that takes in new factors, as long as anything moves beyond its
            threshold. With thresholds of 0 and some ten, every step ends at the optimum.
        relinearize_prior: also relinearise the keyframe that the marginal prior is on. GTSAM's smoothers do not.
    """

    relinearize: tuple[NotNegative, NotNegative, NotNegative, NotNegative] = (0.005, 10.0, 0.05, 1.0)
    extra_updates: Annotated[Whole, Field(ge=0)] = 0
    relinearize_prior: bool = True

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""
        if self.preintegrates:
            refuse_unknown_heading(prior)
        refuse_unknown_velocity(prior)
        return WindowPass(self, Solving(self.relinearize, self.extra_updates, self.relinearize_prior), prior, rig)
