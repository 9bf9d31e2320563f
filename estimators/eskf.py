"""The error-state Kalman filter: predict by the IMU block, correct by every reading of an epoch at once.

Source: Solà 2017, arXiv:1711.02298, sections 5–6, with the error on the right of R_WB and the block of `imu` as the
transition.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from ..datasets.epochs import Epoch
from ..datasets.rig import Rig
from ..datasets.state import THETA, Array, Belief
from ..datasets.trajectory import Trajectory
from .imu import BLOCK, compile_rig, first_sample, integrate, predict, process_noise, sandwich
from .interface import FACTORS, Diverged
from .measurements import measure
from .records import as_belief, as_record, split, with_rate_noise
from .so3 import exp, product, right_jacobian


@dataclass(frozen=True)
class ErrorStateKalmanFilter:
    """Error-state extended Kalman filter over (theta, p, v, b_a, b_g).

    A reading that comes late, by at most max_delay_s, is put where it belongs: the filter goes back to the state it had
    then and lives through the epochs since once more. One that comes later still is counted and left out.

    Attributes:
        factors: the sensors it may use.
        inflate: factor on the stated sigma by sensor; also "gyro" and "accel".
        max_delay_s: how far back it can go.
        merge_ns: a reading at most this much older than its epoch counts as of its epoch.
    """

    factors: frozenset[str] = FACTORS
    inflate: dict[str, float] = Field(default_factory=dict)
    max_delay_s: float = Field(default=5.0, ge=0)
    merge_ns: int = Field(default=1_000_000, ge=0)

    def begin(self, prior: Belief, rig: Rig) -> ErrorStatePass:
        """See `Estimator.begin`."""
        return ErrorStatePass(self, prior, rig)


class Lived(NamedTuple):
    """An epoch that has been lived through, and the state and the sample before it."""

    epoch: Epoch
    state: NDArray[Any]
    before: NDArray[Any]


class ErrorStatePass:
    """One pass of `ErrorStateKalmanFilter`."""

    def __init__(self, config: ErrorStateKalmanFilter, prior: Belief, rig: Rig) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._rig = compile_rig(rig, config.factors, config.inflate)
        self._t_ns = prior.t_ns
        self._state = as_record(prior)
        self._before: NDArray[Any] | None = None
        self._block = np.zeros(1, BLOCK)
        self._past: deque[Lived] = deque()

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        # an epoch's readings stand in the order of their truth
        if len(epoch.readings) and epoch.readings["t_ns"][0] < epoch.t_ns - self._config.merge_ns:
            epoch = self._go_back_for_late(epoch)
        self._live(epoch)

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        return with_rate_noise(as_belief(self._t_ns, self._state), self._rig)

    def finish(self) -> Trajectory | None:
        """A filter has no hindsight."""
        return None

    def _live(self, epoch: Epoch) -> None:
        """Predict to the epoch's end, correct by its readings, and remember."""
        if self._before is None:
            self._before = first_sample(epoch.imu, self._rig)
        if self._config.max_delay_s > 0:
            self._past.append(Lived(epoch, self._state.copy(), self._before))
            horizon_ns = epoch.t_ns - int(self._config.max_delay_s * 1e9)
            while self._past[0].epoch.t_ns < horizon_ns:
                self._past.popleft()
        if not filter_step(self._state, self._rig, self._before, epoch.imu, epoch.readings, self._block):
            raise Diverged("the innovation covariance is not positive, or the state is not finite")
        if len(epoch.imu):
            self._before = epoch.imu[-1:]
        self._t_ns = epoch.t_ns

    def _go_back_for_late(self, epoch: Epoch) -> Epoch:
        """Live through the past again with the epoch's late readings in it; return the epoch without them."""
        is_late = epoch.readings["t_ns"] < epoch.t_ns - self._config.merge_ns
        late = epoch.readings[is_late]
        late = late[np.argsort(late["t_ns"], kind="stable")]
        past = [
            *self._past,
            Lived(epoch._replace(readings=epoch.readings[~is_late]), self._state, self._before_or(epoch)),
        ]
        began_ns = past[0].epoch.t_ns - round(float(past[0].epoch.imu["dt_s"].sum()) * 1e9)
        reachable = late[late["t_ns"] > began_ns]
        self.counts["late"] += len(late) - len(reachable)
        self.counts["replayed"] += len(reachable)
        if len(reachable):
            first = next(i for i, lived in enumerate(past) if lived.epoch.t_ns >= reachable["t_ns"][0])
            again = [lived.epoch for lived in past[first:]]
            if first < len(past) - 1:
                self._state, self._before = past[first].state.copy(), past[first].before
            for _ in again[:-1]:
                self._past.pop()
            for reading in reachable:
                again = _insert(again, reading)
            for lived_again in again[:-1]:
                self._live(lived_again)
            return again[-1]
        return past[-1].epoch

    def _before_or(self, epoch: Epoch) -> NDArray[Any]:
        return first_sample(epoch.imu, self._rig) if self._before is None else self._before


def _insert(epochs: list[Epoch], reading: Any) -> list[Epoch]:
    """Return the epochs with `reading` at its time, splitting the one that it falls into."""
    t_ns = int(reading["t_ns"])
    k = next(i for i, epoch in enumerate(epochs) if epoch.t_ns >= t_ns)
    epoch, row = epochs[k], np.array([reading])
    if epoch.t_ns == t_ns:
        split_up = [epoch._replace(readings=np.concatenate([epoch.readings, row]))]
    else:
        head, tail = split(epoch.imu, t_ns)
        split_up = [Epoch(t_ns, head, row, False), epoch._replace(imu=tail)]
    return [*epochs[:k], *split_up, *epochs[k + 1 :]]


@njit(cache=True)
def filter_step(
    state: NDArray[Any],
    rig: NDArray[Any],
    before: NDArray[Any],
    imu: NDArray[Any],
    readings: NDArray[Any],
    block: NDArray[Any],
) -> bool:
    """One epoch of the filter, in place on `state`; False where it diverged."""
    if len(imu) > 0:
        propagate(state, rig, before, imu, block)
    if len(readings) > 0:
        return correct(state, rig, readings)
    return True


@njit(cache=True)
def propagate(
    state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
) -> None:
    """x ← f(x, imu), P ← F P Fᵀ + Q."""
    s = state[0]
    F, Q, R_i = np.empty((15, 15)), np.empty((15, 15)), s.R_WB.copy()
    integrate(imu, before, s.b_a, s.b_g, rig, block)
    predict(block, state, rig[0].gravity, F, state)
    process_noise(block, R_i, Q)
    s.P[:] = sandwich(F, s.P) + Q


@njit(cache=True)
def correct(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
    """Correct by all readings, linearised together at the predicted state; False where that is impossible.

    Rows of independent errors are taken one by one: exactly the joint update, and no matrix to invert. A reading whose
    own rows are correlated is first turned into one whose rows are not.
    """
    s = state[0]
    P = s.P
    dx = np.zeros(15)
    r, H, C = np.empty(3), np.empty((3, 15)), np.empty((3, 3))
    PH = np.empty(15)
    for m in range(len(readings)):
        n = measure(readings, m, state, rig, r, H, C)
        decorrelate(n, r, H, C)
        for row in range(n):
            innovation, S = -r[row], C[row, row]
            for i in range(15):
                PH[i] = 0.0
                for j in range(15):
                    PH[i] += P[i, j] * H[row, j]
            for i in range(15):
                S += H[row, i] * PH[i]
                innovation -= H[row, i] * dx[i]
            if not S > 0.0:
                return False
            for i in range(15):
                gain = PH[i] / S
                dx[i] += gain * innovation
                for j in range(15):
                    P[i, j] -= gain * PH[j]
    _inject(state, dx)
    total = 0.0
    for i in range(15):
        total += dx[i]
    return np.isfinite(total)


@njit(cache=True)
def decorrelate(n: int, r: Array, H: Array, C: Array) -> None:
    """Subtract from each of the first n rows what the rows before it say of its error: C becomes diagonal (L D Lᵀ)."""
    for k in range(n):
        for i in range(k + 1, n):
            if C[i, k] != 0.0:
                share = C[i, k] / C[k, k]
                r[i] -= share * r[k]
                for j in range(15):
                    H[i, j] -= share * H[k, j]
                for j in range(k + 1, n):
                    C[i, j] -= share * C[k, j]
                C[i, k] = 0.0


@njit(cache=True)
def _inject(state: NDArray[Any], dx: Array) -> None:
    """x ← x ⊕ dx, and P for the error that is left: theta ← J_r(dtheta) (theta − dtheta)."""
    s = state[0]
    dtheta = dx[0:3]
    s.R_WB[:] = product(s.R_WB, exp(dtheta))
    for i in range(3):
        s.p_WB_W[i] += dx[3 + i]
        s.v_WB_W[i] += dx[6 + i]
        s.b_a[i] += dx[9 + i]
        s.b_g[i] += dx[12 + i]
    J = right_jacobian(dtheta)
    P_J = J @ np.ascontiguousarray(s.P[THETA, :])
    s.P[THETA, :] = P_J
    s.P[:, THETA] = np.ascontiguousarray(s.P[:, THETA]) @ J.T
    for i in range(15):
        for j in range(i):
            s.P[i, j] = s.P[j, i] = 0.5 * (s.P[i, j] + s.P[j, i])
