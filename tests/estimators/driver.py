"""Drive an estimator through a log and compare what it says with the truth: for these tests, without `fathom.bench`."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from fathom.datasets import Belief, Log, Trajectory
from fathom.datasets.epochs import cut
from fathom.datasets.state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY
from fathom.estimators import Diverged, Estimator
from fathom.estimators.alignment.initialise import initialise
from scipy.spatial.transform import Rotation

FILTERS = ["eskf", "eskf-filterpy", "iekf", "ukf", "rts"]
"""By their online beliefs; rts gives iekf's until it finishes."""

BLOCKS = {
    "position": POSITION,
    "attitude": THETA,
    "velocity": VELOCITY,
    "biases": slice(ACCEL_BIAS.start, GYRO_BIAS.stop),
    "all": slice(0, DIM),
}
"""Where the parts of the state that have a NEES of their own stand in the error state."""


@dataclass(frozen=True, eq=False)
class Driven:
    """What an estimator said about a log.

    Attributes:
        status: "done", or "diverged" where it raised Diverged, with the cause and the time, s from the start.
        online: the beliefs at the ticks, with no delay.
        smoothed: the smoothed states; None where the estimator has none.
        counts: what happened to readings, gaps and solvers, by name.
    """

    status: str
    cause: str | None
    failed_at_s: float | None
    online: Trajectory
    smoothed: Trajectory | None
    counts: dict[str, int]

    @property
    def outputs(self) -> dict[str, Trajectory]:
        return {"online": self.online} | ({} if self.smoothed is None else {"smoothed": self.smoothed})

    @property
    def beliefs(self) -> list[Belief]:
        return [Belief(int(t), self.online.state(k), self.online.P[k]) for k, t in enumerate(self.online.t_ns)]


def run_log(log: Log, estimator: Estimator, period_s: float = 1.0) -> Driven:
    """Hand the epochs over in the order of reception, and ask for a belief at every tick.

    Only Diverged ends a run; any other exception is the test's.
    """
    prior = initialise(log).belief if log.prior is None else log.prior
    log = log.with_prior(prior)
    voyage = cut(log, ticks(log, period_s), estimator.factors)
    said: list[Belief] = []
    status, cause, failed_at_s, smoothed = "done", None, None, None
    run, t_ns = estimator.begin(prior, log.rig), voyage.start_ns
    try:
        for epoch in voyage.epochs:
            t_ns = epoch.t_ns
            run.step(epoch)
            if epoch.tick:
                said.append(copy.deepcopy(run.belief()))  # a pass may use its arrays again
                assert said[-1].t_ns == t_ns
        smoothed = run.finish()
    except Diverged as error:
        status, cause, failed_at_s = "diverged", str(error), (t_ns - voyage.start_ns) * 1e-9
    assert voyage.failure is None, voyage.failure
    return Driven(status, cause, failed_at_s, Trajectory.from_beliefs(said), smoothed, voyage.counts | dict(run.counts))


def ticks(log: Log, period_s: float) -> np.ndarray:
    """Times at which beliefs are asked for, (k,) ns: of the truth's stamps those nearest to a grid; else the grid."""
    period_ns = round(period_s * 1e9)
    first_ns = log.start_ns + period_ns
    if log.truth is None:
        return np.arange(first_ns, log.imu.t_ns[-1] + 1, period_ns)
    stamps = log.truth.t_ns
    halfway = stamps[:-1] + np.diff(stamps) // 2
    return np.unique(stamps[np.searchsorted(halfway, np.arange(first_ns, stamps[-1] + 1, period_ns))])


def matched(truth: Trajectory, track: Trajectory) -> Trajectory:
    """The rows of the truth at the track's own times, all of which it must have."""
    rows = np.searchsorted(truth.t_ns, track.t_ns)
    assert np.array_equal(truth.t_ns[rows], track.t_ns)
    return truth.select(rows)


def error_states(truth: Trajectory, track: Trajectory) -> np.ndarray:
    """(n, 15) error states e with track ⊕ e = truth, rotations by scipy."""
    truth = matched(truth, track)
    theta = (Rotation.from_matrix(track.R_WB).inv() * Rotation.from_matrix(truth.R_WB)).as_rotvec()
    rest = [getattr(truth, name) - getattr(track, name) for name in ("p_WB_W", "v_WB_W", "b_a", "b_g")]
    return np.hstack([theta, *rest])


def nees(e: np.ndarray, P: np.ndarray, of: slice = slice(None)) -> np.ndarray:
    """(n,) values of eᵀ P⁻¹ e over a part of error states (n, 15) and their covariances (n, 15, 15)."""
    return np.einsum("ni,ni->n", e[:, of], np.linalg.solve(P[:, of, of], e[:, of, None])[..., 0])


def summed_nees(
    estimator: Estimator, logs: Iterable[Log], epochs_s: Sequence[float], parts: Mapping[str, slice] = BLOCKS
) -> dict[str, dict[str, np.ndarray]]:
    """NEES summed over independent logs, by output and part of the state, at these epochs, s from the start."""
    sums: dict[str, dict[str, np.ndarray]] = {}
    for log in logs:
        result = run_log(log, estimator)
        assert result.status == "done", (log.name, result.cause)
        for output, whole in result.outputs.items():
            track = whole.select(np.searchsorted(whole.t_ns, log.start_ns + np.multiply(epochs_s, 10**9)))
            e, of_output = error_states(log.truth, track), sums.setdefault(output, {})
            for part, of in parts.items():
                of_output[part] = of_output.get(part, 0.0) + nees(e, track.P, of)
    return sums


def gaps_in_sigma(a: Trajectory, b: Trajectory) -> np.ndarray:
    """(n, 15) differences of the states over the first's standard deviations."""
    theta = np.einsum("nji,njk->nik", a.R_WB, b.R_WB)[:, [2, 0, 1], [1, 2, 0]]
    rest = [getattr(b, name) - getattr(a, name) for name in ("p_WB_W", "v_WB_W", "b_a", "b_g")]
    return np.abs(np.hstack([theta, *rest])) / np.sqrt(np.einsum("nii->ni", a.P))


def rmse_m(truth: Trajectory, track: Trajectory) -> float:
    """Root of the mean squared distance to the truth, m; nothing is aligned."""
    return float(np.sqrt(np.square(matched(truth, track).p_WB_W - track.p_WB_W).sum(axis=1).mean()))


def heading_error_rad(truth: Trajectory, track: Trajectory) -> np.ndarray:
    """(n,) differences of heading, R_WB = Rz Ry Rx, in [−π, π)."""
    psi = [np.arctan2(R_WB[:, 1, 0], R_WB[:, 0, 0]) for R_WB in (track.R_WB, matched(truth, track).R_WB)]
    return (psi[0] - psi[1] + np.pi) % (2 * np.pi) - np.pi
