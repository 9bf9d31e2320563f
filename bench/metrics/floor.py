"""The floor of estimation errors: online, at a lag, and over the whole log.

It is the posterior Cramér–Rao bound: no estimator's error covariance is less, by any method. Motion and readings
are linearised at the truth, with the noise that is truly in them. Between two moments j − 1 and j of the voyage

    P⁻ = F P Fᵀ + Q                                                 F, Q: the IMU block between them

and each scalar row h of a reading, its error of variance c independent of the others', is taken in by

    S = h P⁻ hᵀ + c        k = P⁻ hᵀ / S        P = P⁻ − S k kᵀ

F, Q, h and c depend on the path alone, not on the biases or on what the noise drew, so the expectation that makes the
bound of Tichavský et al. a posterior one is that of a constant.

What later rows tell of a moment t is added up forwards, with B the covariance between the errors at t and at j:

    B⁻ = B Fᵀ        d = B⁻ hᵀ        P_t ← P_t − d dᵀ / S        B = B⁻ − d kᵀ

(a copy of the state at t is carried along: fixed-point smoothing), and one sweep gives every lag on its way. For the
whole log it is added up backwards, once for all t (fixed-interval smoothing, in Bierman's form):

    Λ⁻ = hᵀ h / S + (I − k h)ᵀ Λ (I − k h)        Λ ← Fᵀ Λ⁻ F        P_t ← P_t − P_t Λ P_t

Neither inverts a matrix: what has no variance, such as a bias that does not walk, is no special case.

Sources: Tichavský, Muravchik & Nehorai 1998, doi:10.1109/78.668800, in covariance form; Simon 2006, "Optimal State
Estimation", section 9.2; Bierman 1973, doi:10.1080/00207177308932487.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...datasets.compiling.decorators import compiled
from ...datasets.epochs import IMU_SAMPLE, READING, Epoch, cut
from ...datasets.log import Log
from ...datasets.simulated.scenario import Scenario
from ...datasets.simulated.simulator import simulate
from ...datasets.state import DIM, LIMIT_NS, VELOCITY, Array, TimeArray, rotation_vector
from ...datasets.trajectory import Trajectory
from ...estimators.interface import FACTORS
from ...estimators.physics.elimination import add_scaled, decorrelate, project
from ...estimators.physics.imu import BLOCK, compile_rig, first_sample, integrate, predict, process_noise, sandwich
from ...estimators.physics.measurements import measure
from ...estimators.physics.state import STATE
from .association import ScoreError


@dataclass(frozen=True, eq=False)
class Floor:
    """The bound on an estimator's error covariance.

    Attributes:
        t_ns: (k,) increasing.
        P: (k, 15, 15), of the error state; its velocity is what a belief's is, see `floors_along`.
        lookahead_s: how much of the future is known: 0, a lag, or infinity for the whole log.
    """

    t_ns: TimeArray
    P: Array
    lookahead_s: float


def floors(
    scenario: Scenario,
    seed: int,
    ticks_ns: TimeArray,
    lookahead_s: Sequence[float] = (0.0, math.inf),
    factors: Collection[str] = FACTORS,
    max_gap_s: float = 1.0,
) -> dict[float, Floor]:
    """Return the floors of a simulated log by look-ahead, found along its twin without noise.

    The twin has the same path and readings at the same times, and its IMU reports the path itself.

    Args:
        scenario, seed: as for `simulate`. Where `noise_scale` is not 1 or other noise is told, the floor is of the
            noise that there is; what waves do to a pressure sensor counts as the white noise that is told of it.
        ticks_ns, lookahead_s, factors, max_gap_s: as for `floors_along`.

    Raises:
        ScoreError: a look-ahead is negative or no number.
    """
    twin = simulate(replace(scenario.truly_told, noise_scale=0.0), seed)
    found = floors_along(twin, ticks_ns, lookahead_s, factors, max_gap_s)
    return {ahead: replace(floor, P=scenario.noise_scale**2 * floor.P) for ahead, floor in found.items()}


def floors_along(
    log: Log,
    ticks_ns: TimeArray,
    lookahead_s: Sequence[float] = (0.0, math.inf),
    factors: Collection[str] = FACTORS,
    max_gap_s: float = 1.0,
) -> dict[float, Floor]:
    """Return the floors along the truth of a log, by look-ahead.

    The floor of look-ahead L at t knows the prior, the IMU, and every reading that was received by t + L; one that came
    late counts from its reception on, and then for the time when it was true. An infinite L, or one beyond the log's
    end, knows all.

    Like a belief's, the floor's velocity has the noise of the gyro sample that carries it from the IMU to B added to
    what is known of the IMU's. It is of those who use that sample as it is: a DVL reading of the very tick tells a
    little of it, which would take off at most 2 rate_cov / (variance of the DVL), relative.

    Args:
        log: with truth and a prior that states its covariance. Its own IMU gives F and Q (less the truth's biases), so
            it had better be without noise.
        ticks_ns: (k,) increasing; those outside the IMU's time are passed over.
        lookahead_s: not negative; 0 for no delay, infinity for the whole log.
        factors: the sensors that may be used.
        max_gap_s: longest gap in the IMU that is bridged; the floor ends at a longer one, as `cut` does.

    Raises:
        ScoreError: no truth with velocities, no prior, or a look-ahead that is negative or no number.
    """
    bad = [ahead for ahead in lookahead_s if not ahead >= 0.0]
    if bad:
        raise ScoreError(f"floor: a look-ahead must not be negative, found {bad[0]} s")
    if log.truth is None or log.truth.v_WB_W is None or log.prior is None:
        raise ScoreError(f"floor: {log.name} needs a truth with velocities and a prior; simulated logs have them")
    line, rate_cov = linearise(log, log.truth, ticks_ns, frozenset(factors), max_gap_s)
    tick = np.flatnonzero(np.isin(line.t_ns[1:], ticks_ns)) + 1
    t_ns = line.t_ns[tick]

    k, S = np.zeros_like(line.h), np.zeros_like(line.c)
    P = np.repeat(log.prior.P[None], len(line.t_ns), axis=0)
    for j in range(1, len(P)):
        P[j] = P[j - 1]
        take_in(P[j], j - 1, j, line, LATEST_NS, k, S)
    whole = P[tick]
    look_back(whole, tick, line, k, S)

    finite = sorted({ahead for ahead in lookahead_s if ahead < math.inf})
    now_ns = t_ns[:, None] + np.array([round(min(ahead * 1e9, LIMIT_NS)) for ahead in finite], np.int64)
    last = np.searchsorted(line.t_ns, now_ns, side="right") - 1
    lagged = np.repeat(whole[:, None], len(finite), axis=1)
    look_ahead(lagged, tick, now_ns, last_complete(line, now_ns), last, line, P, k, S)
    for bound in (whole, *lagged.swapaxes(0, 1)):
        bound[:, VELOCITY, VELOCITY] += rate_cov[tick]
    return {
        ahead: Floor(t_ns, lagged[:, finite.index(ahead)] if ahead in finite else whole, ahead) for ahead in lookahead_s
    }


# -- the voyage, linearised at the truth ------------------------------------------------------------------------------

LATEST_NS = np.iinfo(np.int64).max


class Line(NamedTuple):
    """A voyage linearised at the truth: n moments (the start, every reading's truth, every tick) and m scalar rows."""

    t_ns: TimeArray  # (n,)
    F: Array  # (n, 15, 15), the motion that leads to each moment; the first is not used
    Q: Array  # (n, 15, 15)
    stop: NDArray[np.int64]  # (n,), the rows of moment j are stop[j − 1] to stop[j]
    h: Array  # (m, 15)
    c: Array  # (m,)
    received_ns: TimeArray  # (m,)


def linearise(
    log: Log, truth: Trajectory, ticks_ns: TimeArray, factors: frozenset[str], max_gap_s: float
) -> tuple[Line, Array]:
    """Return the voyage linearised at the truth, and rate_cov in W at each moment, (n, 3, 3)."""
    heard = [stream.t_ns for sensor, stream in log.streams.items() if sensor in factors]
    voyage = cut(log, np.unique(np.concatenate([ticks_ns, *heard])), factors, max_gap_s)
    t_ns = np.array([voyage.start_ns, *(epoch.t_ns for epoch in voyage.epochs)])
    x, rig = true_states(truth, t_ns), compile_rig(log.rig, factors, {}, log.rig.latitude_deg is not None)
    F, Q = motions(voyage.epochs, x, rig)

    readings = np.concatenate([np.zeros(0, READING), *(epoch.readings for epoch in voyage.epochs)])
    readings = readings[np.argsort(readings["t_ns"], kind="stable")]
    moment = np.searchsorted(t_ns, readings["t_ns"])
    r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    h, c, source = np.empty((3 * len(readings), DIM)), np.empty(3 * len(readings)), []
    for m, j in enumerate(moment.tolist()):
        n, begin = measure(readings, m, x[j : j + 1], rig, r, H, C), len(source)
        decorrelate(n, r, H, C)
        h[begin : begin + n], c[begin : begin + n] = H[:n], C.diagonal()[:n]
        source += [m] * n
    rows = len(source)
    stop = np.searchsorted(moment[source], np.arange(len(t_ns)), side="right")
    line = Line(t_ns, F, Q, stop, h[:rows].copy(), c[:rows].copy(), readings["received_ns"][source])
    return line, x["R_WB"] @ rig["rate_cov"][0] @ x["R_WB"].transpose(0, 2, 1)


def motions(epochs: list[Epoch], x: NDArray[Any], rig: NDArray[Any]) -> tuple[Array, Array]:
    """Return F and Q (n, 15, 15) of the blocks that lead to each of the true states x; also settles rig's rate_cov."""
    F, Q = np.zeros((len(x), DIM, DIM)), np.zeros((len(x), DIM, DIM))
    block, end = np.zeros(1, BLOCK), np.zeros(1, STATE)
    before = first_sample(epochs[0].imu if epochs else np.zeros(0, IMU_SAMPLE), rig)
    for j, epoch in enumerate(epochs, 1):
        state = x[j - 1 : j]
        integrate(epoch.imu, before, state["b_a"][0], state["b_g"][0], rig, block)
        predict(block, state, rig["gravity"][0], F[j], end)
        process_noise(block, state["R_WB"][0], Q[j])
        before = epoch.imu[-1:]
    return F, Q


def true_states(truth: Trajectory, t_ns: TimeArray) -> NDArray[Any]:
    """Return the truth as STATE records (n,), between its stamps by an even turn and an even change of velocity.

    Without positions and covariances: nothing is linearised at them.
    """
    after = np.searchsorted(truth.t_ns, t_ns).clip(1, len(truth) - 1)
    before = after - 1
    share = (t_ns - truth.t_ns[before]) / (truth.t_ns[after] - truth.t_ns[before])
    turn = rotation_vector(truth.R_WB[before].transpose(0, 2, 1) @ truth.R_WB[after])
    x = np.zeros(len(t_ns), STATE)
    x["R_WB"] = truth.R_WB[before] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    for name in ("v_WB_W", "b_a", "b_g"):
        values = getattr(truth, name)
        if values is not None:
            x[name] = values[before] + share[:, None] * (values[after] - values[before])
    return x


def last_complete(line: Line, now_ns: TimeArray) -> NDArray[np.int64]:
    """Return the last moment up to which no reading is still to be received at `now_ns`, of any shape."""
    missing = np.searchsorted(np.maximum.accumulate(line.received_ns), now_ns, side="right")  # the first row to come
    return np.searchsorted(line.stop, missing, side="right") - 1


# -- compiled ---------------------------------------------------------------------------------------------------------


@compiled
def subtract(A: Array, a: Array, scale: float, b: Array) -> None:
    """A ← A − scale a bᵀ, for fifteen components."""
    for i in range(DIM):
        add_scaled(A[i], -scale * a[i], b)


@compiled
def take_in(P: Array, first: int, last: int, line: Line, now_ns: int, k: Array, S: Array) -> None:
    """Carry P, in place, from moment `first` to `last` with what has been received by now_ns; fill k and S of its rows.

    A row that is still to come has no gain and an infinite S.
    """
    for j in range(first + 1, last + 1):
        sandwich(line.F[j], P, line.Q[j], P)
        for row in range(line.stop[j - 1], line.stop[j]):
            if line.received_ns[row] > now_ns:
                k[row], S[row] = 0.0, np.inf
                continue
            S[row] = project(line.h[row], P, line.c[row], k[row])
            subtract(P, k[row], 1.0 / S[row], k[row])
            for i in range(DIM):
                k[row, i] /= S[row]


@compiled
def learn(P_t: Array, B: Array, first: int, last: int, line: Line, k: Array, S: Array) -> None:
    """Take from P_t, in place, what the rows after moment `first` tell of it up to `last`; carry B along."""
    for j in range(first + 1, last + 1):
        B[:] = B @ line.F[j].T
        for row in range(line.stop[j - 1], line.stop[j]):
            d = B @ line.h[row]
            subtract(P_t, d, 1.0 / S[row], d)
            subtract(B, d, 1.0, k[row])


@compiled
def look_ahead(
    out: Array, tick: NDArray[np.int64], now_ns: TimeArray, complete: NDArray[np.int64], last: NDArray[np.int64],
    line: Line, P: Array, k: Array, S: Array,
) -> None:  # fmt: skip
    """Fill out (ticks, lags, 15, 15) with what is known of each tick's state at the times now_ns (ticks, lags).

    Up to moment `complete` (ticks, lags) nothing is missing then: P, k and S of the whole log hold there, and a tick's
    lags, being in order, share the way. From there to `last` it is filtered anew, with what has been received. Where
    nothing at all is missing, `out` stays as it is: the whole log's floor.
    """
    k_now, S_now = k.copy(), S.copy()
    for a in range(len(tick)):
        t = reached = tick[a]
        P_t, B = P[t].copy(), P[t].copy()
        for lag in range(now_ns.shape[1]):
            known, now = complete[a, lag], now_ns[a, lag]
            if known == len(P) - 1:
                break
            P_now = P[known].copy()
            if known < t:
                take_in(P_now, known, t, line, now, k_now, S_now)
                known, P_lag, B_lag = t, P_now.copy(), P_now.copy()
            else:
                learn(P_t, B, reached, known, line, k, S)
                reached, P_lag, B_lag = known, P_t.copy(), B.copy()
            take_in(P_now, known, last[a, lag], line, now, k_now, S_now)
            learn(P_lag, B_lag, known, last[a, lag], line, k_now, S_now)
            out[a, lag] = P_lag


@compiled
def look_back(P: Array, tick: NDArray[np.int64], line: Line, k: Array, S: Array) -> None:
    """Turn P (ticks, 15, 15), in place, from what was known at the ticks into what the whole log tells of them."""
    L, a = np.zeros((DIM, DIM)), len(tick) - 1
    for j in range(len(line.F) - 1, 0, -1):
        if a >= 0 and tick[a] == j:
            P[a] -= P[a] @ L @ P[a]
            a -= 1
        for row in range(line.stop[j] - 1, line.stop[j - 1] - 1, -1):
            h, Lk = line.h[row], L @ k[row]
            subtract(L, h, 1.0, Lk - (1.0 / S[row] + k[row] @ Lk) * h)
            subtract(L, Lk, 1.0, h)
        carried = line.F[j].T @ L @ line.F[j]
        L[:] = 0.5 * (carried + carried.T)
