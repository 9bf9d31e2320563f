"""What an estimator is: a frozen configuration that begins passes, and a pass that is driven through one log."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ..datasets.epochs import Epoch
from ..datasets.rig import Rig
from ..datasets.state import Belief
from ..datasets.trajectory import Trajectory

FACTORS = frozenset({"depth", "gps", "heading", "dvl"})
"""The aiding sensors that an estimator may be allowed."""


class Diverged(RuntimeError):  # noqa: N818 - the run's status, by its name
    """The estimator cannot go on: numbers that are not finite, a covariance that is none, a solver that gave up.

    The run is recorded as diverged, with this message as its cause.
    """


class Pass(Protocol):
    """One pass over one log, driven in time order; it sees neither the truth nor the future.

    Attributes:
        counts: what happened to readings and solvers, by name (readings used, late, merged, ...).
    """

    counts: dict[str, int]

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
        """Return the states with hindsight, at the ticks; None for an estimator that has none."""
        ...


@runtime_checkable
class Estimator(Protocol):
    """A frozen configuration; `factors` are the sensors it may use."""

    factors: frozenset[str]

    def begin(self, prior: Belief, rig: Rig) -> Pass:
        """Return a new pass that starts from the prior, on a vehicle with this rig."""
        ...
