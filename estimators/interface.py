"""The interface of estimators: `Estimator`, a frozen configuration, and `Pass`, one run over one log."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Protocol, TypeVar, runtime_checkable

from pydantic import AfterValidator, Field

from ..datasets.epochs import SENSOR, Epoch
from ..datasets.errors import nearest
from ..datasets.quantities import Number, Positive
from ..datasets.rig import Rig
from ..datasets.state import Belief
from ..datasets.trajectory import Trajectory

FACTORS = frozenset({"depth", "gps", "heading", "dvl"})
"""The aiding sensors that an estimator may be allowed."""


SensorNames = TypeVar("SensorNames", bound=Collection[str])


def sensors_among(known: frozenset[str]) -> AfterValidator:
    """Return a validator of names, or of a mapping by name, that refuses a sensor that is not one of those known."""

    def check(names: SensorNames) -> SensorNames:
        for name in names:
            if name not in known:
                raise ValueError(f"no sensor {name!r}{nearest(name, known)} (known: {', '.join(sorted(known))})")
        return names

    return AfterValidator(check)


Factors = Annotated[frozenset[str], sensors_among(FACTORS)]
"""Which aiding sensors an estimator may use."""
Inflation = Annotated[dict[str, Positive], sensors_among(FACTORS | {"gyro", "accel"})]
"""Factor on the stated sigma by sensor; also "gyro" and "accel"."""
Gate = Annotated[dict[str, Annotated[Number, Field(gt=0, lt=1)]], sensors_among(FACTORS)]
"""Probability by sensor: a reading is left out if its NIS exceeds the chi-square quantile of this probability."""

MERGE_NS = 1_000_000
"""A reading this close to an epoch or a keyframe is taken as of its time, by filters and smoothers alike, unless an
option says otherwise: 1 ms, in which 2 m/s is 2 mm and 30°/s is 0.03°."""

OUTLIERS = "outliers_"
"""Prefix, before the sensor's name, of the counts of readings left out by a gate, or given less weight by a loss."""


def unknown_kind(kind: int) -> ValueError:
    """Return the error for a reading of a kind that no sensor of ours has."""
    known = ", ".join(f"{k} {sensor}" for k, sensor in enumerate(SENSOR))
    return ValueError(f"a reading of unknown kind {kind} (known: {known})")


class Diverged(RuntimeError):  # noqa: N818 - the run's status, by its name
    """The estimator cannot go on: numbers not finite, a covariance not positive definite, a solver that gave up.

    The run is recorded as diverged, with this message as its cause.
    """


class Pass(Protocol):
    """One pass over one log, driven in time order; it sees neither the truth nor the future."""

    @property
    def counts(self) -> dict[str, int]:
        """What happened to readings and solvers, by name (readings used, late, merged, ...)."""
        ...

    def step(self, epoch: Epoch) -> None:
        """Take in the IMU block up to epoch.t_ns, then the readings received there.

        Raises:
            Diverged: the estimate is lost.
        """
        ...

    def belief(self) -> Belief:
        """Return the belief at the last epoch's time, with no delay."""
        ...

    def finish(self) -> Trajectory | None:
        """Return the smoothed states at the ticks; None for an estimator that only filters."""
        ...


@runtime_checkable
class Estimator(Protocol):
    """A frozen configuration; `factors` are the sensors it may use.

    One that is honest only where it is started with a heading known to some sigma may say so in an attribute
    `honest_yaw_rad`. A run that starts with less is told of under the table.
    """

    @property
    def factors(self) -> frozenset[str]:
        """The sensors it may use."""
        ...

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """Return a new pass that starts from the prior, on a vehicle with this rig."""
        ...
