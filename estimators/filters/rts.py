"""Rauch–Tung–Striebel: a Kalman filter forwards, then backwards; docs/conventions.md (44).

Source: Rauch, Tung & Striebel 1965, doi:10.2514/3.3166, on the manifold. With x_k the filtered state of epoch k, P_k
its covariance, x⁻ = f(x_k) and P⁻ = F P_k Fᵀ + Q the prediction of epoch k + 1, and S for what is smoothed:

    G = P_k Fᵀ (P⁻)⁻¹        d = G (x^S_k+1 ⊖ x⁻)        x^S_k = x_k ⊕ d
    P^S_k = P_k + G (P^S_k+1 − P⁻) Gᵀ

Here P⁻ and P_k are of errors at x⁻ and x_k (the filter has already applied its reset to P_k); P^S_k+1 is of errors at
x^S_k+1, so it is carried to x⁻, and P^S_k from x_k to x^S_k.

⊕, ⊖ and the carrying are those of the filter. On `eskf` they are (7), (8) and (9), by right Jacobians; on `iekf` (39),
its inverse, and (67). Its G is of our error, and so is d: linear in the invariant error, at x_k and at x⁻, by (41).
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ...datasets.compiling.decorators import compiled
from ...datasets.epochs import Epoch
from ...datasets.rig import Rig
from ...datasets.state import DIM, THETA, Array, Belief
from ...datasets.trajectory import Trajectory
from ..interface import Diverged
from ..physics.elimination import divide_into
from ..physics.imu import BLOCK, predict, process_noise, sandwich
from ..physics.invariant import carry_over, inject_invariant, local_moved
from ..physics.so3 import inverse_right_jacobian_into
from ..physics.state import STATE, as_belief, as_record, inject, local, turn_covariance, with_rate_noise
from ..stages import stage
from ..unknown_start import refuse_unknown_velocity
from .eskf import ErrorStateKalman, ErrorStateKalmanFilter
from .filter_pass import FilterOptions, FilterPass
from .iekf import InvariantKalman, InvariantKalmanFilter

TRIANGLE = DIM * (DIM + 1) // 2
"""Numbers in one half of a symmetric matrix."""
PAGE = 1024
"""Epochs for which memory is allocated at a time."""


class Page:
    """Storage of up to PAGE epochs, 2.4 kB each; F, Q and the prediction are recomputed from the block."""

    def __init__(self) -> None:
        self.t_ns = np.zeros(PAGE, np.int64)
        self.tick = np.zeros(PAGE, np.bool_)
        self.mean = np.zeros((PAGE, 21))  # the filtered state: R_WB, p_WB_W, v_WB_W, b_a, b_g
        self.P = np.zeros((PAGE, TRIANGLE))  # its covariance, the lower triangle by rows
        self.block = np.zeros(PAGE, BLOCK)  # the motion that led to it


@dataclass(frozen=True)
class RauchTungStriebelSmoother(FilterOptions):
    """A filter forwards, then the backward pass at the end of the log; online its beliefs are those of the filter.

    Attributes:
        filter: which one, with its coordinates. `eskf` is a little cheaper, and claims too much where it starts with a
            heading that it hardly knows.
    """

    filter: Literal["eskf", "iekf"] = "iekf"

    @property
    def honest_yaw_rad(self) -> float:
        """As of its filter."""
        return (InvariantKalmanFilter if self.filter == "iekf" else ErrorStateKalmanFilter).honest_yaw_rad

    def begin(self, prior: Belief, rig: Rig) -> RauchTungStriebelPass:
        """See `Estimator.begin`."""
        if self.filter == "iekf":
            refuse_unknown_velocity(prior)
        return RauchTungStriebelPass(self, prior, rig)


class RauchTungStriebelPass:
    """One pass of `RauchTungStriebelSmoother`."""

    def __init__(self, config: RauchTungStriebelSmoother, prior: Belief, rig: Rig) -> None:
        self._is_invariant = config.filter == "iekf"
        self._kalman = InvariantKalman() if self._is_invariant else ErrorStateKalman()
        self._forwards = FilterPass(config, prior, rig, self._kalman, self._remember_epoch)
        self.counts = self._forwards.counts
        self._pages: list[Page] = []
        self._length = 0
        self._remember(prior.t_ns, False, as_record(prior), STANDSTILL)

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        self._forwards.step(epoch)

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        return self._forwards.belief()

    def watch_late(self) -> list[NDArray[Any]]:
        """See `FilterPass.watch_late`."""
        return self._forwards.watch_late()

    def finish(self) -> Trajectory | None:
        """Return the smoothed states at the ticks; the memory of the forward pass is freed page by page."""
        beliefs: list[Belief] = []
        later, block, rig = np.zeros(1, STATE), STANDSTILL.copy(), self._forwards.rig
        filled = self._length - PAGE * (len(self._pages) - 1)
        recall(self._pages[-1].mean, self._pages[-1].P, filled - 1, later)
        while self._pages:
            page = self._pages.pop()
            ticks = np.flatnonzero(page.tick[:filled])
            smoothed = np.zeros(len(ticks), STATE)
            known = page.mean, page.P, page.block, filled, page.tick
            if not smooth(*known, later, block, rig, self._is_invariant, smoothed):
                raise Diverged("a predicted covariance is not positive definite")
            for k in range(len(ticks) - 1, -1, -1):
                smoothed[k]["P"] = self._kalman.error_covariance(smoothed[k : k + 1])
                belief = as_belief(int(page.t_ns[ticks[k]]), smoothed[k : k + 1])
                beliefs.append(with_rate_noise(belief, rig))
            filled = PAGE
        self._length = 0
        return Trajectory.from_beliefs(beliefs[::-1], lookahead_s=np.inf)

    @stage("output")
    def _remember_epoch(self, epoch: Epoch, state: NDArray[Any], block: NDArray[Any]) -> None:
        """Store an epoch; one without IMU samples replaces the epoch before it, of the same time."""
        t_ns, tick = epoch.t_ns, epoch.tick
        if not len(epoch.imu):
            self._forget(t_ns + 1)
            page, row = self._pages[-1], (self._length - 1) % PAGE
            block, tick = page.block[row : row + 1].copy(), tick or bool(page.tick[row])
        self._remember(t_ns, tick, state, block)

    def _remember(self, t_ns: int, tick: bool, state: NDArray[Any], block: NDArray[Any]) -> None:
        """Store a state; a replayed epoch overwrites what was stored from its time on."""
        self._forget(t_ns)
        row = self._length % PAGE
        if row == 0:
            self._pages.append(Page())
        page = self._pages[-1]
        page.t_ns[row], page.tick[row], page.block[row] = t_ns, tick, block[0]
        keep(state, row, page.mean, page.P)
        self._length += 1

    def _forget(self, t_ns: int) -> None:
        """Remove the states stored for t_ns and later."""
        while self._length and self._pages[-1].t_ns[(self._length - 1) % PAGE] >= t_ns:
            self._length -= 1
            if self._length % PAGE == 0:
                self._pages.pop()


STANDSTILL = np.zeros(1, BLOCK)
"""The block of no motion, of zero duration."""
STANDSTILL["dR"] = np.eye(3)


@compiled
def keep(state: NDArray[Any], row: int, mean: Array, P: Array) -> None:
    """Write a STATE record into one row of a page."""
    s, n = state[0], 0
    for i in range(3):
        for j in range(3):
            mean[row, 3 * i + j] = s.R_WB[i, j]
        mean[row, 9 + i], mean[row, 12 + i] = s.p_WB_W[i], s.v_WB_W[i]
        mean[row, 15 + i], mean[row, 18 + i] = s.b_a[i], s.b_g[i]
    for i in range(DIM):
        for j in range(i + 1):
            P[row, n] = s.P[i, j]
            n += 1


@compiled
def recall(mean: Array, P: Array, row: int, state: NDArray[Any]) -> None:
    """Inverse of `keep`."""
    s, n = state[0], 0
    for i in range(3):
        for j in range(3):
            s.R_WB[i, j] = mean[row, 3 * i + j]
        s.p_WB_W[i], s.v_WB_W[i] = mean[row, 9 + i], mean[row, 12 + i]
        s.b_a[i], s.b_g[i] = mean[row, 15 + i], mean[row, 18 + i]
    for i in range(DIM):
        for j in range(i + 1):
            s.P[i, j] = s.P[j, i] = P[row, n]
            n += 1


@compiled
def smooth(
    mean: Array, P: Array, blocks: NDArray[Any], filled: int, tick: NDArray[np.bool_],
    later: NDArray[Any], block: NDArray[Any], rig: NDArray[Any], is_invariant: bool, out: NDArray[Any],
) -> bool:  # fmt: skip
    """Smooth the epochs of one page, from the last to the first; False if a prediction has a bad covariance.

    Args:
        mean, P, blocks, tick: the page's, of which the first `filled` rows count.
        later: STATE record of length 1, the smoothed state after the page's last; replaced by that of its first.
        block: BLOCK record of length 1, the motion that leads to `later`; likewise.
        rig: RIG record of length 1.
        is_invariant: the coordinates are those of `physics.invariant`; else of `physics.state`.
        out: STATE records, filled with the smoothed states of the ticks.
    """
    wanted = len(out)
    ahead = later.copy()
    for row in range(filled - 1, -1, -1):
        now = ahead.copy()
        recall(mean, P, row, now)
        if not smooth_one(now, later, block, rig[0].gravity, is_invariant, ahead):
            return False
        later[0] = now[0]
        block[0] = blocks[row]
        if tick[row]:
            wanted -= 1
            out[wanted] = now[0]
    return True


@compiled
def smooth_one(
    now: NDArray[Any], later: NDArray[Any], block: NDArray[Any], gravity: float, is_invariant: bool, ahead: NDArray[Any]
) -> bool:
    """Smooth `now`, in place, given the smoothed state `later` and the block between; `ahead` is scratch."""
    F, Q, P_ahead = np.empty((DIM, DIM)), np.empty((DIM, DIM)), np.empty((DIM, DIM))
    FP, Gt, J, d = np.empty((DIM, DIM)), np.empty((DIM, DIM)), np.empty((3, 3)), np.empty(DIM)
    P, gained = now[0].P[:], later[0].P.copy()
    predict(block, now, gravity, F, ahead)
    process_noise(block, now[0].R_WB[:], Q)
    sandwich(F, P, Q, P_ahead)

    if is_invariant:
        local_moved(ahead, later, d)
        carry_over(later, ahead, False, gained)
    else:
        local(ahead, later, d)
        inverse_right_jacobian_into(d[THETA], J)
        turn_covariance(gained, J)
    for i in range(DIM):
        for j in range(DIM):
            gained[i, j] -= P_ahead[i, j]
            FP[i, j] = 0.0
            for k in range(DIM):
                FP[i, j] += F[i, k] * P[k, j]

    if not divide_into(P_ahead, FP, Gt):
        return False
    left, step = FP, np.zeros(DIM)  # left: G (P^S − P⁻), in the memory of FP
    for i in range(DIM):
        for j in range(DIM):
            step[i] += Gt[j, i] * d[j]
            left[i, j] = 0.0
            for k in range(DIM):
                left[i, j] += Gt[k, i] * gained[k, j]
    for i in range(DIM):
        for j in range(DIM):
            for k in range(DIM):
                P[i, j] += left[i, k] * Gt[k, j]
    if is_invariant:
        inject_invariant(now, step)
    else:
        inject(now, step)
    return True
