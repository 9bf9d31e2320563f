"""Options that all smoothers share, on GTSAM (`graph`) and on our own solver (`window`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from ..datasets.quantities import NotNegative, Positive, Whole
from ..datasets.rig import Rig
from ..datasets.state import Belief
from .interface import FACTORS, MERGE_NS, Factors, Inflation, Pass
from .physics.imu import EarthRotation
from .robust import Losses

DvlFactor = Literal["velocity", "preintegrated-loose", "preintegrated-tight"]


def _once(dvl: frozenset[DvlFactor]) -> frozenset[DvlFactor]:
    if dvl >= {"preintegrated-loose", "preintegrated-tight"}:
        raise ValueError(
            "preintegrated-loose and preintegrated-tight sum the same readings, so each would be used twice: name one"
        )
    return dvl


@dataclass(frozen=True)
class GraphSmoother(ABC):
    """Options of every factor-graph smoother; its DVL factors are docs/conventions.md (4), (6) and (20).

    Each DVL reading makes a keyframe; with keyframe_period_s, the first DVL reading after that time does. If the DVL is
    silent for keyframe_timeout_s, the next reading of another sensor makes one. If all sensors are silent, time makes
    one, so that no IMU factor spans much more than a second. The rules are in `keyframes`. Between keyframes the belief
    is carried on by the IMU and corrected as in a filter; the graph does not use that.

    Attributes:
        dvl: how DVL readings enter. "velocity": one velocity factor for each. "preintegrated-loose": readings
            are summed to a displacement between keyframes, rotated by the gyro at its current bias, as if that
            gyro were independent of the IMU factor's. "preintegrated-tight": the same displacement, conditioned on the
            rotation between the keyframes and on the gyro bias, so that each gyro sample is used once. Name at most one
            of the two. Over a second they differ little; over 5 s with a consumer-grade gyro, loose is overconfident
            of attitude. With "velocity" as well, the reading at a keyframe enters by its velocity and the others are
            summed, so that none is used twice. A reading received after its interval was closed always enters by its
            velocity. So does every reading of an interval in which one leaves an axis unmeasured (wheel speed): as the
            vehicle turns, the unknown axis of B spreads over all axes of the sum. `not_summed` counts the readings of
            such intervals, and of those that max_hold_s excludes.
        dvl_between: within a preintegrated interval, "straight" interpolates from one reading to the next, up to the
            reading at the interval's end (which then has a part in two factors); "held" holds the velocity. What the
            vehicle does between readings is in the covariance of both, found from the readings' own differences
            (`VelocityWalk`); holding loses four times as much, in one direction for as long as a manoeuvre lasts.
        keyframe_period_s: None for a keyframe at every DVL reading (1 s with a preintegrated factor).
        keyframe_timeout_s: see above.
        max_hold_s: an interval with a longer silence of the DVL is not preintegrated; its readings enter by velocity.
        merge_ns: a reading this close to a keyframe is treated as taken at the keyframe, and counted.
        factors: sensors that may be used.
        inflate: factor on the stated sigma by sensor; also "gyro" and "accel".
        robust: loss by sensor, "huber", "cauchy" or "tukey", with the widths of `robust`. It applies to every factor
            of the sensor; `outliers_<sensor>` counts the residuals beyond the width when their keyframe leaves. A
            weight is computed when its factor is linearised, and is fixed once a neighbour of its keyframe has been
            marginalised out. Tukey's loss and, less so, Cauchy's can have several minima: a reading beyond the width at
            the first guess, the IMU's prediction, has no weight until other readings move the estimate. So a vehicle
            whose error exceeds the width never uses that sensor again.
        smoothed_covariance_s: a smoothed state has its covariance once in this period; those between have none.
        earth_rotation: W turns with the Earth (see `imu`); "auto": if the rig knows its latitude.
    """

    dvl: Annotated[frozenset[DvlFactor], Field(min_length=1), AfterValidator(_once)] = frozenset({"velocity"})
    dvl_between: Literal["straight", "held"] = "straight"
    keyframe_period_s: Positive | None = None
    keyframe_timeout_s: Positive = 0.5
    max_hold_s: Positive = 1.5
    merge_ns: Whole = Field(default=MERGE_NS, ge=0)
    factors: Factors = FACTORS
    inflate: Inflation = Field(default_factory=dict)
    robust: Losses = Field(default_factory=dict)
    smoothed_covariance_s: Positive = 5.0
    earth_rotation: EarthRotation = "auto"

    @property
    @abstractmethod
    def window_s(self) -> float:
        """How long a state is kept and improved before it leaves, s; infinite for the whole log."""

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
    """Options of the fixed-lag smoothers: they keep the last lag_s seconds and marginalise out what is older.

    Attributes:
        lag_s: length of the window; with 0 it keeps the newest keyframe only, and is a filter.
    """

    lag_s: NotNegative = 3.0

    @property
    def window_s(self) -> float:
        """See `GraphSmoother.window_s`."""
        return self.lag_s
