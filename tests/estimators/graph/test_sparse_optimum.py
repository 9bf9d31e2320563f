"""On a real mission `batch` finds the optimum that sparse least squares finds without GTSAM: to 1 mm, at every tick."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from driver import run_log, ticks
from fathom.datasets import Belief, Log, NavState, Trajectory
from fathom.datasets.epochs import Epoch, cut
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.state import DIM
from fathom.estimators import create
from fathom.estimators.filters.eskf_filterpy import stack
from fathom.estimators.interface import FACTORS
from fathom.estimators.physics.imu import BLOCK, compile_rig, first_sample, integrate, predict, process_noise
from fathom.estimators.physics.state import as_belief, as_record

SMALL = {"depth_m": 5.0, "shallow_m": 1.0, "leg_m": 15.0, "turn_radius_m": 5.0, "surface_for_s": 20.0}
"""A minute of it holds two stays at the surface, and legs and turns, or dives and climbs, between them."""


class WholeLog:
    """MAP over a state at every epoch of a log: rows of the prior, of each motion, and of each epoch's readings.

    Motions are integrated anew at each state's own biases, and every reading stands at the epoch of its own time.
    """

    def __init__(self, log: Log) -> None:
        self.prior, self.gravity = log.prior, log.rig.gravity
        self.epochs: list[Epoch] = cut(log, ticks(log, 1.0)).epochs
        assert all((epoch.readings["t_ns"] == epoch.t_ns).all() for epoch in self.epochs)
        self.rig = compile_rig(log.rig, FACTORS, {})
        first = first_sample(self.epochs[0].imu, self.rig)
        self.before = [first, *(epoch.imu[-1:] for epoch in self.epochs[:-1])]

    def motion(self, k: int, x: NavState) -> tuple[NavState, np.ndarray, np.ndarray]:
        """Where epoch k takes the state x, its derivative F, and what noise that adds, Q (15, 15)."""
        state, block, F, Q = (
            as_record(Belief(0, x, np.eye(DIM))),
            np.zeros(1, BLOCK),
            np.empty((15, 15)),
            np.empty((15, 15)),
        )
        integrate(self.epochs[k].imu, self.before[k], x.b_a, x.b_g, self.rig, block)
        process_noise(block, x.R_WB, Q)
        predict(block, state, self.gravity, F, state)
        return as_belief(0, state).state, F, Q

    def rows(self, states: list[NavState]) -> tuple[scipy.sparse.csr_array, np.ndarray]:
        """Whitened A (m, 15 n) and r (m,) with cost |A d + r|² for a change d of the states."""
        blocks, residuals, height = [], [], 0

        def add(r: np.ndarray, C: np.ndarray, parts: dict[int, np.ndarray]) -> None:
            nonlocal height
            L = np.linalg.cholesky(C)
            residuals.append(scipy.linalg.solve_triangular(L, r, lower=True))
            for k, A in parts.items():
                row, column = np.indices(A.shape)
                A_white = scipy.linalg.solve_triangular(L, A, lower=True)
                blocks.append((A_white.ravel(), (row + height).ravel(), (column + DIM * k).ravel()))
            height += len(r)

        add(self.prior.state.local(states[0]), self.prior.P, {0: np.eye(DIM)})
        for k, epoch in enumerate(self.epochs):
            end, F, Q = self.motion(k, states[k])
            add(end.local(states[k + 1]), Q, {k: -F, k + 1: np.eye(DIM)})
            r, H, C = stack(as_record(Belief(0, states[k + 1], np.eye(DIM))), self.rig, epoch.readings)
            if len(r):
                add(r, C, {k + 1: H})
        data, row, column = (np.concatenate(part) for part in zip(*blocks, strict=True))
        return scipy.sparse.csr_array((data, (row, column)), shape=(height, DIM * len(states))), np.concatenate(
            residuals
        )

    def optimum(self) -> tuple[Trajectory, list[float]]:
        """Gauss–Newton from the prior carried on by the IMU alone: the states at the ticks, and each step.

        A step is the largest change over the sigma that the component had if all others were known.
        """
        states = [self.prior.state]
        for k in range(len(self.epochs)):
            states.append(self.motion(k, states[k])[0])
        steps: list[float] = []
        while len(steps) < 20 and (not steps or steps[-1] > 1e-6):
            A, r = self.rows(states)
            size = np.sqrt(A.power(2).sum(axis=0))
            A = A @ scipy.sparse.diags_array(1 / size)
            normal = scipy.sparse.linalg.splu((A.T @ A).tocsc(), permc_spec="NATURAL", options={"SymmetricMode": True})
            d = normal.solve(-A.T @ r)
            steps.append(float(np.abs(d).max()))
            states = [x.retract(error) for x, error in zip(states, (d / size).reshape(-1, DIM), strict=True)]
        ticks = [k for k, epoch in enumerate(self.epochs) if epoch.tick]
        beliefs = [Belief(self.epochs[k].t_ns, states[k + 1], np.full((DIM, DIM), np.nan)) for k in ticks]
        return Trajectory.from_beliefs(beliefs, np.inf), steps


def gaps(a: Trajectory, b: Trajectory) -> dict[str, float]:
    """The largest distance between two trajectories in each part of the state."""
    assert np.array_equal(a.t_ns, b.t_ns)
    d = np.array([a.state(k).local(b.state(k)) for k in range(len(a))]).reshape(-1, 5, 3)
    return dict(zip(("rad", "m", "m/s", "m/s²", "rad/s"), np.linalg.norm(d, axis=2).max(axis=0).tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("mission", ["lawnmower", "yo-yo"])
def test_batch_is_the_sparse_optimum_to_a_millimetre_at_every_tick(mission: str) -> None:
    log = simulate(Scenario(mission=mission, duration_s=60.0, imu="tactical", **SMALL), seed=3)
    optimum, steps = WholeLog(log).optimum()
    assert steps[-1] < 1e-6
    gap = gaps(optimum, run_log(log, create("batch")).smoothed)
    assert gap["m"] < 1e-3
    assert gap["rad"] < 1e-4
    assert gap["m/s"] < 1e-4
