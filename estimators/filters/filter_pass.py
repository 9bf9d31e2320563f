"""One pass of any Kalman filter: steps through epochs, gates outliers, rewinds and replays for late readings.

A filter is a `Kalman`, which predicts and corrects within an epoch. Everything around that is here, once for all
filters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from ...datasets.epochs import DVL, SENSOR, Epoch
from ...datasets.quantities import NotNegative, Whole
from ...datasets.rig import Rig
from ...datasets.state import Array, Belief
from ...datasets.trajectory import Trajectory
from ..interface import FACTORS, MERGE_NS, OUTLIERS, Diverged, Factors, Gate, Inflation
from ..physics.imu import BLOCK, EarthRotation, compile_rig, first_sample, split
from ..physics.innovation import INNOVATION, gate_widths, judge
from ..physics.state import as_belief, as_record, with_rate_noise
from ..stages import staged
from ..unknown_start import knows_heading, refuse_unknown_heading


@dataclass(frozen=True)
class FilterOptions:
    """Options of every filter.

    Attributes:
        factors: the sensors it may use.
        inflate: factor on the stated sigma by sensor; also "gyro" and "accel".
        gate: probability by sensor, such as {gps: 0.999}. A reading whose normalised innovation squared, against the
            state predicted before any reading of its epoch, is beyond that quantile of chi-square is rejected and
            counted. A filter that has drifted rejects good readings too, and may never recover.
        max_delay_s: how far it can rewind for a late reading.
        merge_ns: a reading at most this much older than its epoch is taken as of its epoch, and counted.
        earth_rotation: W turns with the Earth (see `imu`); "auto": if the rig knows its latitude.
    """

    factors: Factors = FACTORS
    inflate: Inflation = Field(default_factory=dict)
    gate: Gate = Field(default_factory=dict)
    max_delay_s: NotNegative = 5.0
    merge_ns: Whole = Field(default=MERGE_NS, ge=0)
    earth_rotation: EarthRotation = "auto"


class Kalman(ABC):
    """A filter: predicts a STATE record (of length 1) over a motion, and corrects it by readings, in place.

    Its P is of our error, at least to first order: what it hands out is `error_covariance`. Either step may raise
    Diverged.

    Attributes:
        stopped_by: the kind of reading that it cannot take while the heading is unknown since the start; by default
            a velocity in B, which it would turn into W by a heading that it only guesses.
        freed_by: the kind of reading after which it can take all; None if there is none.
    """

    stopped_by: ClassVar[int] = DVL
    freed_by: ClassVar[int | None] = None

    @abstractmethod
    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """Predict the state over IMU_SAMPLE rows; `before` is the one before them. Fills `block` with their motion."""

    @abstractmethod
    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """Correct by readings of the present time; False if S or the state is unusable."""

    def error_covariance(self, state: NDArray[Any]) -> Array:
        """Return the covariance (15, 15) of our error state: P itself, unless the filter knows it to more orders."""
        return state["P"][0]


class PastEpoch(NamedTuple):
    """A processed epoch, kept for replay: the state and the IMU sample before it, and the outliers counted in it."""

    epoch: Epoch
    state: NDArray[Any]
    before: NDArray[Any]
    outliers: Counter[str]


class FilterPass:
    """One pass of a filter.

    If a reading is late by at most max_delay_s, the filter rewinds to the state before it and replays the epochs since,
    with the reading in its place. A reading that is later than that is counted and dropped.

    Args:
        config, prior, rig: as for `Estimator.begin`.
        kalman: the filter.
        on_epoch: called after each epoch with the epoch, the state at its end, and the block that led there; called
            again for each replayed epoch.
    """

    def __init__(
        self,
        config: FilterOptions,
        prior: Belief,
        rig: Rig,
        kalman: Kalman,
        on_epoch: Callable[[Epoch, NDArray[Any], NDArray[Any]], None] | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter({OUTLIERS + sensor: 0 for sensor in config.gate})
        self._config = config
        self._predict = staged("propagation", kalman.predict)
        self._correct = staged("solve", kalman.correct)
        self._covariance = staged("marginal", kalman.error_covariance)
        self._on_epoch = on_epoch
        self._rig = compile_rig(rig, config.factors, config.inflate, config.earth_rotation)
        self._widths = gate_widths(config.gate) if config.gate else None
        self._t_ns = prior.t_ns
        self._state = as_record(prior)
        self._before: NDArray[Any] | None = None
        self._block = np.zeros(1, BLOCK)
        self._past: deque[PastEpoch] = deque()
        self._kalman = kalman
        self._watched: list[NDArray[Any]] | None = None
        self._inserted: set[tuple[int, int]] = set()  # kind and time of the late readings of this replay
        self._is_lost = not knows_heading(self._own_belief())

    @property
    def rig(self) -> NDArray[Any]:
        """The rig as one RIG record."""
        return self._rig

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        # an epoch's readings are sorted by their own time
        if len(epoch.readings) and epoch.readings["t_ns"][0] != epoch.t_ns:
            age_ns = epoch.t_ns - epoch.readings["t_ns"]
            self.counts["merged"] += int(((age_ns > 0) & (age_ns <= self._config.merge_ns)).sum())
            if age_ns[0] > self._config.merge_ns:
                epoch = self._replay(epoch)
        self._advance(epoch)
        self._inserted = set()

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        return with_rate_noise(self._own_belief(), self._rig)

    def finish(self) -> Trajectory | None:
        """Return None: a filter does not smooth."""
        return None

    def watch_late(self) -> list[NDArray[Any]]:
        """Return a list that gets the INNOVATION rows of the late readings from now on, as each is replayed.

        Each is judged against the state predicted for its own time, by all that was true before it.
        """
        self._watched = []
        return self._watched

    def _advance(self, epoch: Epoch) -> None:
        """Predict to the end of the epoch, correct by its readings, and keep it for replay."""
        if self._before is None:
            self._before = first_sample(epoch.imu, self._rig)
        outliers: Counter[str] = Counter()
        if self._config.max_delay_s > 0:
            self._past.append(PastEpoch(epoch, self._state.copy(), self._before, outliers))
            horizon_ns = epoch.t_ns - int(self._config.max_delay_s * 1e9)
            while self._past[0].epoch.t_ns < horizon_ns:
                self._past.popleft()
        if len(epoch.imu):
            self._predict(self._state, self._rig, self._before, epoch.imu, self._block)
            self._before = epoch.imu[-1:]
        readings = epoch.readings
        if self._is_lost and len(readings):
            self._look_for_heading(readings)
        if self._inserted and self._watched is not None and len(readings):
            late = [(int(one["kind"]), int(one["t_ns"])) in self._inserted for one in readings]
            self._watched.append(self._judged(readings[late]))
        if self._widths is not None and len(readings):
            readings = self._gated(readings, self._widths, outliers)
            self.counts.update(outliers)
        if len(readings) and not self._correct(self._state, self._rig, readings):
            raise Diverged("the innovation covariance is not positive definite, or the state is not finite")
        if self._on_epoch is not None:
            self._on_epoch(epoch, self._state, self._block)
        self._t_ns = epoch.t_ns

    def _own_belief(self) -> Belief:
        """Return the belief without the rate noise of the moment."""
        return Belief(self._t_ns, as_belief(self._t_ns, self._state).state, self._covariance(self._state))

    def _look_for_heading(self, readings: NDArray[Any]) -> None:
        """Look whether readings can be taken that come while the heading is unknown since the start.

        Raises:
            StartError: they cannot.
        """
        kinds = {kind for kind in readings["kind"].tolist() if SENSOR[kind] in self._config.factors}
        if self._kalman.freed_by in kinds:
            self._is_lost = False
        elif self._kalman.stopped_by in kinds:
            refuse_unknown_heading(self._own_belief())
            self._is_lost = False

    def _gated(self, readings: NDArray[Any], widths: Array, outliers: Counter[str]) -> NDArray[Any]:
        """Return the readings that pass their gates, and count the others as outliers."""
        table = self._judged(readings)
        beyond = table["nis"] > widths[readings["kind"], table["dof"]]
        if not beyond.any():
            return readings
        outliers.update(OUTLIERS + SENSOR[kind] for kind in readings["kind"][beyond].tolist())
        return readings[~beyond]

    def _judged(self, readings: NDArray[Any]) -> NDArray[Any]:
        """Return INNOVATION rows of readings of the present time, given the state before them."""
        predicted, table = self._state.copy(), np.zeros(len(readings), INNOVATION)
        predicted["P"][0] = self._covariance(self._state)
        judge(readings, predicted, self._rig, table)
        return table

    def _replay(self, epoch: Epoch) -> Epoch:
        """Rewind, and replay with the late readings of the epoch inserted; return the epoch without them."""
        is_late = epoch.readings["t_ns"] < epoch.t_ns - self._config.merge_ns
        late = epoch.readings[is_late]
        late = late[np.argsort(late["t_ns"], kind="stable")]
        now = PastEpoch(
            epoch._replace(readings=epoch.readings[~is_late]), self._state, self._before_or(epoch), Counter()
        )
        past = [*self._past, now]
        began_ns = past[0].epoch.t_ns - round(float(past[0].epoch.imu["dt_s"].sum()) * 1e9)
        reachable = late[late["t_ns"] > began_ns]
        self.counts["late"] += len(late) - len(reachable)
        self.counts["replayed"] += len(reachable)
        if len(reachable):
            first = next(i for i, one in enumerate(past) if one.epoch.t_ns >= reachable["t_ns"][0])
            again = [one.epoch for one in past[first:]]
            if first < len(past) - 1:
                self._state, self._before = past[first].state.copy(), past[first].before
            for _ in again[:-1]:
                self.counts.subtract(self._past.pop().outliers)
            for reading in reachable:
                again = _insert(again, reading)
            self._inserted = {(int(reading["kind"]), int(reading["t_ns"])) for reading in reachable}
            for replayed in again[:-1]:
                self._advance(replayed)
            return again[-1]
        return now.epoch

    def _before_or(self, epoch: Epoch) -> NDArray[Any]:
        return first_sample(epoch.imu, self._rig) if self._before is None else self._before


def _insert(epochs: list[Epoch], reading: Any) -> list[Epoch]:
    """Return the epochs with `reading` added to the last epoch of its time, or else to a new one, split off."""
    t_ns = int(reading["t_ns"])
    same_time = [i for i, epoch in enumerate(epochs) if epoch.t_ns == t_ns]
    k = same_time[-1] if same_time else next(i for i, epoch in enumerate(epochs) if epoch.t_ns > t_ns)
    epoch, row = epochs[k], np.array([reading])
    if epoch.t_ns == t_ns:
        split_up = [epoch._replace(readings=np.concatenate([epoch.readings, row]))]
    else:
        head, tail = split(epoch.imu, t_ns)
        split_up = [Epoch(t_ns, head, row, False), epoch._replace(imu=tail)]
    return [*epochs[:k], *split_up, *epochs[k + 1 :]]
