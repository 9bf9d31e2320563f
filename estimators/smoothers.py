"""What every smoother can be told, whatever solves it: on GTSAM (`graph`) or on our own solver (`window`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from ..datasets.rig import Rig
from ..datasets.state import Belief
from .interface import FACTORS, Factors, Inflation, Pass
from .robust import Losses

DvlFactor = Literal["velocity", "preintegrated-loose", "preintegrated-tight"]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _once(dvl: frozenset[DvlFactor]) -> frozenset[DvlFactor]:
    if dvl >= {"preintegrated-loose", "preintegrated-tight"}:
        raise ValueError(
            "preintegrated-loose and preintegrated-tight sum the same readings, so each would be used twice: name one"
        )
    return dvl


@dataclass(frozen=True)
class GraphSmoother(ABC):
    """What every factor-graph smoother can be told; a kind of it says how it solves.

    A DVL reading makes a keyframe, or with keyframe_period_s the first one after that long. Where the DVL is silent for
    keyframe_timeout_s, the next other reading makes one; where everything is silent, time does, so that no IMU factor
    spans much more than a second. Between keyframes the belief is carried on and corrected as a filter would; the graph
    does not see that.

    Attributes:
        dvl: how DVL readings enter. "velocity": each by its own factor. "preintegrated-loose": summed to a
            displacement from keyframe to keyframe, turned by the gyro at the bias of the moment, as if the IMU
            factor had another gyro. "preintegrated-tight": the same displacement given the rotation between the
            keyframes and the gyro bias, so that with the IMU factor each gyro sample counts once. One of these two
            at most: over a second they differ little; over 5 s with a consumer's gyro, loose claims to know the
            attitude too well. With "velocity" beside it, the reading at a keyframe goes by its velocity and the others
            are summed, so that none is used twice. A reading that comes after its interval was closed goes by its
            velocity whatever is said here. So does an interval with a reading that leaves an axis unmeasured (wheel
            speed): as the vehicle turns, what is not known of one axis of B gets into every axis of the sum, and no
            displacement is known. `not_summed` counts the readings of such intervals, and of those that max_hold_s
            leaves out.
        dvl_between: within a preintegrated interval the velocity is held from one reading to the next, or runs
            straight, up to the reading at the interval's end (which so has a small part in two factors). Held, its
            covariance knows the DVL's and the gyro's noise but not what is lost by holding: on a vehicle that
            manoeuvres it claims too much.
        keyframe_period_s: None for every DVL reading (1 s with a preintegrated factor).
        keyframe_timeout_s: see above.
        max_hold_s: an interval with a longer silence of the DVL is not preintegrated; its readings go by velocity.
        merge_ns: a reading this close to a keyframe is taken as of it, and counted.
        factors: the sensors it may use.
        inflate: factor on the stated sigma by sensor; also "gyro" and "accel".
        robust: loss by sensor, "huber", "cauchy" or "tukey", of the widths of `robust`. Every factor of the sensor has
            it; `outliers_<sensor>` counts the residuals that are beyond the width when their keyframe leaves. A weight
            is as fresh as the linearisation of its factor, and stays as it is once a neighbour of its keyframe is
            marginalised out. Tukey and, less so, Cauchy have no single minimum: what lies beyond the width at the
            first guess, the IMU's prediction, has no pull and is not reconsidered unless others move the estimate. So
            a vehicle that is lost by more than the width never hears that sensor again.
        hindsight_covariance_s: period at which states with hindsight keep their covariance.
        earth_rotation: W turns with the Earth (see `imu`); needs the rig's latitude.
    """

    dvl: Annotated[frozenset[DvlFactor], Field(min_length=1), AfterValidator(_once)] = frozenset({"velocity"})
    dvl_between: Literal["held", "straight"] = "held"
    keyframe_period_s: Positive | None = None
    keyframe_timeout_s: Positive = 0.5
    max_hold_s: Positive = 1.5
    merge_ns: int = Field(default=5_000_000, ge=0)
    factors: Factors = FACTORS
    inflate: Inflation = Field(default_factory=dict)
    robust: Losses = Field(default_factory=dict)
    hindsight_covariance_s: Positive = 5.0
    earth_rotation: bool = False

    @property
    @abstractmethod
    def window_s(self) -> float:
        """How long a state is kept before it leaves with what has been learnt of it; infinite for the whole log."""

    @abstractmethod
    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """See `Estimator.begin`."""

    @property
    def preintegrates(self) -> bool:
        """Whether DVL readings are summed between keyframes."""
        return self.dvl != {"velocity"}

    @property
    def period_s(self) -> float:
        """Time between keyframes; 0 for one at every DVL reading."""
        return self.keyframe_period_s or (1.0 if self.preintegrates else 0.0)


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
