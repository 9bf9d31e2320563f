"""Dead reckoning: attitude from the gyro or from the heading sensor, velocity from the DVL, depth from pressure."""

from __future__ import annotations

from collections import Counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ..datasets.epochs import ATTITUDE, DEPTH, DVL, HEADING, SENSOR, Epoch
from ..datasets.rig import Rig
from ..datasets.state import DIM, Array, Belief, NavState
from ..datasets.trajectory import Trajectory
from .interface import FACTORS, Factors, unknown_kind
from .physics.dvl_preintegration import preintegrate_dvl
from .physics.imu import EarthRotation, compile_rig, over_world
from .physics.so3 import exp
from .stages import stage


@dataclass(frozen=True)
class DeadReckoning:
    """No fusion: the DVL's velocity, held between readings, rotated by the attitude and summed.

    An axis that a reading does not measure is taken to have no velocity, as on a wheeled vehicle.

    Attributes:
        attitude: "gyro" integrates the rates from the prior's attitude (its bias removed); "heading" takes the yaw
            of the heading sensor, roll and pitch being level (or all three, from a sensor that gives them).
        factors: "heading" and "depth" may be left out; without "dvl" it stands still.
        earth_rotation: with "gyro", subtract the Earth's rate from the gyro's; "auto": if the rig knows its
            latitude.
    """

    attitude: Literal["gyro", "heading"] = "heading"
    factors: Factors = FACTORS
    earth_rotation: EarthRotation = "auto"

    def begin(self, prior: Belief, rig: Rig) -> DeadReckoningPass:
        """See `Estimator.begin`."""
        return DeadReckoningPass(self, prior, rig)


class DeadReckoningPass:
    """One pass of `DeadReckoning`; it keeps no covariance."""

    def __init__(self, config: DeadReckoning, prior: Belief, rig: Rig) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._rig = rig
        self._records = compile_rig(rig, config.factors, {}, config.earth_rotation)
        self._t_ns = prior.t_ns
        self._prior = prior.state
        self._R_WB, self._p_WB_W = prior.state.R_WB, prior.state.p_WB_W
        self._v_WB_B = prior.state.R_WB.T @ prior.state.v_WB_W
        self._newest_ns = dict.fromkeys(range(5), prior.t_ns)

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`. A reading that comes late is taken as if it were of now, unless a newer one is known."""
        if len(epoch.imu):
            self._propagate(epoch.imu)
        for reading in epoch.readings:
            self._take(reading)
        self._t_ns = epoch.t_ns

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        state = NavState(self._R_WB, self._p_WB_W, self._R_WB @ self._v_WB_B, self._prior.b_a, self._prior.b_g)
        return Belief(self._t_ns, state, np.full((DIM, DIM), np.nan))

    def finish(self) -> Trajectory | None:
        """Dead reckoning has no smoothed states."""
        return None

    @stage("propagation")
    def _propagate(self, samples: NDArray[Any]) -> None:
        held_ns = np.array([self._t_ns])
        rate_bias = self._prior.b_g
        imu = over_world(samples, self._R_WB, rate_bias, self._records)
        if self._config.attitude == "heading":  # nothing turns between two headings
            imu = imu.copy()
            imu["w_WI_I"] = rate_bias
        displacement = preintegrate_dvl(
            imu, self._t_ns, held_ns, self._v_WB_B[None], np.zeros((1, 3)), rate_bias, self._records, False, np.zeros(3)
        )
        self._p_WB_W = self._p_WB_W + self._R_WB @ displacement["dp"][0]
        if self._config.attitude == "gyro":
            self._R_WB = self._R_WB @ displacement["dR"][0]

    @stage("solve")
    def _take(self, reading: Any) -> None:
        kind, z = int(reading["kind"]), reading["z"]
        if not 0 <= kind < len(SENSOR):
            raise unknown_kind(kind)
        if SENSOR[kind] not in self._config.factors or np.isinf(reading["sigma"]).all():
            return
        if reading["t_ns"] <= self._newest_ns[kind]:
            self.counts["late"] += 1
            return
        self._newest_ns[kind] = int(reading["t_ns"])
        if kind == DVL:
            measured = np.isfinite(reading["sigma"])
            self._v_WB_B = np.where(measured, z[:3], 0.0)
        elif kind == DEPTH:
            lever_m = (self._R_WB @ self._rig.depth.p_BS_B)[2]
            self._p_WB_W = np.array([self._p_WB_W[0], self._p_WB_W[1], z[0] - lever_m])
        elif self._config.attitude == "heading" and kind == HEADING:
            self._R_WB = level(z[0], self._rig.heading.R_BS)
        elif self._config.attitude == "heading" and kind == ATTITUDE:
            self._R_WB = z.reshape(3, 3) @ self._rig.heading.R_BS.T


def level(yaw_rad: float, R_BH: Array) -> Array:
    """Return the level R_WB (3, 3) at which the x axis of the heading sensor has this yaw."""
    offset_rad = np.arctan2(R_BH[1, 0], R_BH[0, 0])
    return exp(np.array([0.0, 0.0, yaw_rad - offset_rad]))
