"""A smooth motion of a body, known in closed form, and what its sensors would read: the oracle of the physics tests.

The motion uses none of the code under test: velocities and accelerations are central differences of the sensor's path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from fathom.datasets import Belief, ImuNoise, Mounting, NavState, Rig
from fathom.datasets.epochs import IMU_SAMPLE, READING
from fathom.estimators import FACTORS
from fathom.estimators.physics.imu import compile_rig
from fathom.estimators.physics.measurements import measure
from fathom.estimators.physics.state import as_record
from scipy.spatial.transform import Rotation

NOISE = ImuNoise(4e-5, 1e-3, 1e-6, 3e-5, 5e-5, 7e-3)
GRAVITY = 9.81


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return Rotation.random(rng=rng).as_matrix()


def random_rig(rng: np.random.Generator, lever_m: float = 0.5, noise: ImuNoise = NOISE) -> Rig:
    mountings = [Mounting(random_rotation(rng), rng.normal(size=3) * lever_m) for _ in range(4)]
    return Rig(noise, *mountings, gravity=GRAVITY)


def random_state(rng: np.random.Generator) -> NavState:
    return NavState(
        random_rotation(rng),
        rng.normal(size=3) * 20,
        rng.normal(size=3),
        rng.normal(size=3) * 0.02,
        rng.normal(size=3) * 0.002,
    )


@dataclass(frozen=True)
class Path:
    """Sums of sines for position and for a rotation vector on top of a fixed attitude."""

    seed: int

    def _sines(self, t_s: np.ndarray, amplitude: float, salt: int) -> np.ndarray:
        rng = np.random.default_rng([self.seed, salt])
        w, phase = rng.uniform(0.3, 1.5, (3, 3)), rng.uniform(0, 6, (3, 3))
        return amplitude * np.sin(np.multiply.outer(t_s, w) + phase).sum(axis=-1)

    def p_WB_W(self, t_s: np.ndarray) -> np.ndarray:
        return self._sines(np.asarray(t_s), 1.0, 0)

    def R_WB(self, t_s: np.ndarray) -> np.ndarray:
        start = Rotation.random(rng=np.random.default_rng([self.seed, 2]))
        return (start * Rotation.from_rotvec(self._sines(np.asarray(t_s), 0.25, 1))).as_matrix()

    def point(self, t_s: np.ndarray, p_BS_B: np.ndarray) -> np.ndarray:
        """Position of a point fixed on the body, in W."""
        return self.p_WB_W(t_s) + self.R_WB(t_s) @ p_BS_B

    def velocity(self, t_s: np.ndarray, p_BS_B: np.ndarray, h: float = 1e-4) -> np.ndarray:
        return (self.point(t_s + h, p_BS_B) - self.point(t_s - h, p_BS_B)) / (2 * h)

    def acceleration(self, t_s: np.ndarray, p_BS_B: np.ndarray, h: float = 1e-3) -> np.ndarray:
        near = self.point(t_s + h, p_BS_B) - 2 * self.point(t_s, p_BS_B) + self.point(t_s - h, p_BS_B)
        far = self.point(t_s + 2 * h, p_BS_B) - 2 * self.point(t_s, p_BS_B) + self.point(t_s - 2 * h, p_BS_B)
        return (16 * near - far) / (12 * h**2)

    def rate(self, t_s: np.ndarray, h: float = 1e-4) -> np.ndarray:
        """Body rate in B, from the path's rotations only."""
        turn = Rotation.from_matrix(self.R_WB(t_s - h)).inv() * Rotation.from_matrix(self.R_WB(t_s + h))
        return turn.as_rotvec() / (2 * h)

    def state(self, t_s: float, b_a: np.ndarray, b_g: np.ndarray) -> NavState:
        at = np.array([t_s])
        return NavState(self.R_WB(at)[0], self.p_WB_W(at)[0], self.velocity(at, np.zeros(3))[0], b_a, b_g)

    def imu(self, t_end_s: np.ndarray, dt_s: float, rig: Rig, b_a: np.ndarray, b_g: np.ndarray) -> np.ndarray:
        """IMU_SAMPLE rows: means over the intervals, by Gauss–Legendre quadrature of the IMU's own path."""
        nodes, weights = np.polynomial.legendre.leggauss(4)
        t_end_s = np.r_[t_end_s[0] - dt_s, t_end_s]  # the sample before the first, by which its rate changes
        rows = np.zeros(len(t_end_s), IMU_SAMPLE)
        rows["t_ns"], rows["dt_s"], rows["period_s"] = np.round(t_end_s * 1e9), dt_s, dt_s
        g_W = np.array([0, 0, -rig.gravity])
        for node, weight in zip(nodes, weights, strict=True):
            t = t_end_s - dt_s * (0.5 - 0.5 * node)
            R_WI = self.R_WB(t) @ rig.imu.R_BS
            f_W = self.acceleration(t, rig.imu.p_BS_B) - g_W
            rows["w_WI_I"] += 0.5 * weight * self.rate(t) @ rig.imu.R_BS
            rows["f_I"] += 0.5 * weight * np.einsum("nji,nj->ni", R_WI, f_W)
        rows["w_WI_I"] += b_g
        rows["f_I"] += b_a
        rows["alpha_I"][1:], rows["after_s"] = np.diff(rows["w_WI_I"], axis=0) / dt_s, 0.5 * dt_s
        return rows[1:].copy()


def reading(kind: int, z: np.ndarray, sigma: np.ndarray, t_ns: int = 0) -> np.ndarray:
    """One READING row."""
    row = np.zeros(1, READING)
    row["kind"], row["t_ns"], row["received_ns"], row["sigma"] = kind, t_ns, t_ns, np.inf
    row["z"][0, : np.size(z)], row["sigma"][0, : np.size(sigma)] = np.ravel(z), sigma
    return row


def residual(
    row: np.ndarray, state: NavState, rig: Rig, inflate: dict[str, float] | None = None
) -> tuple[np.ndarray, ...]:
    """What a reading's own code says: r, its Jacobian (·, 15) and the covariance of its noise."""
    r, H, C = np.zeros(3), np.zeros((3, 15)), np.zeros((3, 3))
    record = as_record(Belief(0, state, np.zeros((15, 15))))
    n = measure(row, 0, record, compile_rig(rig, FACTORS, inflate or {}), r, H, C)
    return r[:n].copy(), H[:n].copy(), C[:n, :n].copy()
