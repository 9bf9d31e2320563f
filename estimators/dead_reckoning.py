"""Dead reckoning: attitude from the gyro or from the heading sensor, velocity from the DVL, depth from pressure."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic.dataclasses import dataclass

from ..datasets.epochs import ATTITUDE, DEPTH, DVL, HEADING, Epoch
from ..datasets.rig import Rig
from ..datasets.state import Array, Belief, NavState
from .interface import FACTORS


@dataclass(frozen=True)
class DeadReckoning:
    """No fusion: the DVL's velocity, held between readings, rotated by the attitude and summed.

    Attributes:
        attitude: "gyro" integrates the rates from the prior's attitude (its bias removed); "heading" takes the yaw
            of the heading sensor, roll and pitch being level (or all three, from a sensor that gives them).
        factors: "heading" and "depth" may be left out; without "dvl" it stands still.
    """

    attitude: Literal["gyro", "heading"] = "heading"
    factors: frozenset[str] = FACTORS

    def begin(self, prior: Belief, rig: Rig) -> DeadReckoningPass:
        """See `Estimator.begin`."""
        return DeadReckoningPass(self, prior, rig)


class DeadReckoningPass:
    """One pass of `DeadReckoning`."""

    def __init__(self, config: DeadReckoning, prior: Belief, rig: Rig) -> None:
        raise NotImplementedError
