"""Faults of simulated sensors: all that a sensor does and its log never tells.

Each is off by default and draws from a random stream of its own. Faults change the readings, never the rig nor a stated
sigma. They keep their size when a scenario scales its noise.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from ..quantities import DEGREE, STRICT, Finite, NotNegative, Number, Positive, Probability, Vector
from ..rig import Mounting
from ..state import Array, TimeArray

LONGEST_CLOCK_OFFSET_S = 5.0
"""Largest clock offset, s: well inside the margin of a mission's splines beyond both its ends."""


def _in_order(interval: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= interval[0] < interval[1]:
        raise ValueError(f"an outage runs from one time to a later one, found {list(interval)}")
    return interval


Interval = Annotated[tuple[Finite, Finite], AfterValidator(_in_order)]
ClockOffset = Annotated[Number, Field(ge=-LONGEST_CLOCK_OFFSET_S, le=LONGEST_CLOCK_OFFSET_S)]


class Marring(NamedTuple):
    """Outlier sigma, saturation limit and quantisation step, in the unit of a sensor's readings; one, or per column."""

    outlier: float | Array
    limit: float | Array = np.inf
    quantum: float | Array = 0.0


@dataclass(frozen=True, config=STRICT)
class Faults:
    """Faults that any sensor can have.

    Attributes:
        dropout_probability: of each reading, to be lost.
        outages_s: [from, to] pairs, s from the log's start: no reading is stamped inside.
        outlier_probability: of each reading, to carry a gross error: normal, zero-mean, with the standard deviation of
            the sensor's own `outlier` dial on every axis (a contaminated normal distribution).
        repeat_probability: of each reading, to repeat the values of the one before it, at its own time.
        clock_offset_s: readings are stamped this much later than they were true; reception is by the right clock, but
            never before the stamp.
    """

    dropout_probability: Probability = 0.0
    outages_s: tuple[Interval, ...] = ()
    outlier_probability: Probability = 0.0
    repeat_probability: Probability = 0.0
    clock_offset_s: ClockOffset = 0.0


@dataclass(frozen=True, config=STRICT)
class DvlFaults(Faults):
    """Of a DVL.

    Attributes:
        scale: of the velocity it reads to the true one: a wrong speed of sound.
        misalignment_deg: roll, pitch and yaw of its true axes in B, which the rig says are B's.
        lever_arm_error_m: where it really is, in B; the rig says at its origin.
        limit_m_s: what no component of a reading exceeds.
        quantum_m_s: to the nearest multiple of which each component is rounded.
    """

    outlier_m_s: NotNegative = 1.0
    scale: Positive = 1.0
    misalignment_deg: Vector = (0.0, 0.0, 0.0)
    lever_arm_error_m: Vector = (0.0, 0.0, 0.0)
    limit_m_s: Positive | None = None
    quantum_m_s: NotNegative = 0.0

    @property
    def marring(self) -> Marring:
        """In m/s."""
        return Marring(self.outlier_m_s, _none_is_infinite(self.limit_m_s), self.quantum_m_s)


@dataclass(frozen=True, config=STRICT)
class DepthFaults(Faults):
    """Of a pressure sensor.

    Attributes:
        scale: of the depth it reads to the true one: a wrong density of the water.
        lever_arm_error_m: where it really is, less where the rig says, in B.
        limit_m: the depth at which it saturates.
        quantum_m: its resolution.
    """

    outlier_m: NotNegative = 5.0
    scale: Positive = 1.0
    lever_arm_error_m: Vector = (0.0, 0.0, 0.0)
    limit_m: Positive | None = None
    quantum_m: NotNegative = 0.0

    @property
    def marring(self) -> Marring:
        """In m."""
        return Marring(self.outlier_m, _none_is_infinite(self.limit_m), self.quantum_m)


@dataclass(frozen=True, config=STRICT)
class GpsFaults(Faults):
    """Of a GPS receiver.

    Attributes:
        lever_arm_error_m: where its antenna really is, less where the rig says, in B.
        quantum_m: to the nearest multiple of which each coordinate is rounded.
    """

    outlier_m: NotNegative = 50.0
    lever_arm_error_m: Vector = (0.0, 0.0, 0.0)
    quantum_m: NotNegative = 0.0

    @property
    def marring(self) -> Marring:
        """In m."""
        return Marring(self.outlier_m, quantum=self.quantum_m)


@dataclass(frozen=True, config=STRICT)
class HeadingFaults(Faults):
    """Of a heading sensor.

    Attributes:
        bias_deg: added to every heading.
        soft_iron_deg, soft_iron_axis_deg: it adds soft_iron_deg · sin 2(ψ − soft_iron_axis_deg), the quadrantal
            deviation of a compass.
        misalignment_deg: roll, pitch and yaw of its true axes in those that the rig says.
        quantum_deg: its resolution.
    """

    outlier_deg: NotNegative = 45.0
    bias_deg: Finite = 0.0
    soft_iron_deg: NotNegative = 0.0
    soft_iron_axis_deg: Finite = 0.0
    misalignment_deg: Vector = (0.0, 0.0, 0.0)
    quantum_deg: NotNegative = 0.0

    @property
    def marring(self) -> Marring:
        """In rad."""
        return Marring(self.outlier_deg * DEGREE, quantum=self.quantum_deg * DEGREE)


@dataclass(frozen=True, config=STRICT)
class ImuFaults(Faults):
    """Of an IMU; a reading is one sample of its gyro and its accelerometer.

    Attributes:
        bias_correlation_s: of biases that are first-order Gauss–Markov processes, where the rig says that they walk;
            None: they do walk.
        gyro_scale, accel_scale: of what each axis reads to the truth, before bias and noise.
        misalignment_deg: roll, pitch and yaw of its true axes in those that the rig says.
        lever_arm_error_m: where it really is, less where the rig says, in B.
        gyro_limit_deg_s, accel_limit_m_s2: where a sample saturates; it is the mean over an interval that is clipped.
        gyro_quantum_deg_s, accel_quantum_m_s2: to the nearest multiple of which a sample is rounded.
    """

    bias_correlation_s: Positive | None = None
    gyro_outlier_deg_s: NotNegative = 20.0
    accel_outlier_m_s2: NotNegative = 5.0
    gyro_scale: Vector = (1.0, 1.0, 1.0)
    accel_scale: Vector = (1.0, 1.0, 1.0)
    misalignment_deg: Vector = (0.0, 0.0, 0.0)
    lever_arm_error_m: Vector = (0.0, 0.0, 0.0)
    gyro_limit_deg_s: Positive | None = None
    accel_limit_m_s2: Positive | None = None
    gyro_quantum_deg_s: NotNegative = 0.0
    accel_quantum_m_s2: NotNegative = 0.0

    @property
    def marring(self) -> Marring:
        """Of (f, w), (6,), in m/s² and rad/s."""

        def six(accel: float, gyro: float) -> Array:
            return np.repeat([accel, gyro * DEGREE], 3)

        return Marring(
            six(self.accel_outlier_m_s2, self.gyro_outlier_deg_s),
            six(_none_is_infinite(self.accel_limit_m_s2), _none_is_infinite(self.gyro_limit_deg_s)),
            six(self.accel_quantum_m_s2, self.gyro_quantum_deg_s),
        )

    @property
    def scale(self) -> Array:
        """Of (f, w), (6,)."""
        return np.array([*self.accel_scale, *self.gyro_scale])


AnyFaults = DvlFaults | DepthFaults | GpsFaults | HeadingFaults | ImuFaults


def _none_is_infinite(limit: float | None) -> float:
    return np.inf if limit is None else limit


def true_mounting(stated: Mounting, faults: AnyFaults) -> Mounting:
    """Return where a sensor really sits, for where the rig says: R_BS turned in its own axes, p_BS_B shifted."""
    R_BS, p_BS_B = stated.R_BS, stated.p_BS_B
    if not isinstance(faults, DepthFaults | GpsFaults) and any(faults.misalignment_deg):
        R_BS = R_BS @ Rotation.from_euler("xyz", faults.misalignment_deg, degrees=True).as_matrix()
    if not isinstance(faults, HeadingFaults) and any(faults.lever_arm_error_m):
        p_BS_B = p_BS_B + faults.lever_arm_error_m
    return Mounting(R_BS, p_BS_B)


def mar(z: Array, faults: AnyFaults, rng: np.random.Generator) -> Array:
    """Return readings z (n, k) with outliers added, then clipped, then rounded."""
    outlier, limit, quantum = faults.marring
    if faults.outlier_probability:
        hit = rng.random(len(z)) < faults.outlier_probability
        z = z + hit[:, None] * outlier * rng.standard_normal(z.shape)
    if np.isfinite(limit).any():
        z = np.clip(z, -limit, limit)
    if np.any(quantum):
        step = np.where(quantum, quantum, 1.0)
        z = np.where(quantum, np.rint(z / step) * step, z)
    return z


def arrives(t_ns: TimeArray, faults: AnyFaults, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which readings (n,) are neither dropped nor stamped in an outage; t_ns is from the log's start."""
    heard = np.ones(len(t_ns), bool)
    if faults.dropout_probability:
        heard &= rng.random(len(t_ns)) >= faults.dropout_probability
    for begin_s, end_s in faults.outages_s:
        heard &= ~((t_ns >= begin_s * 1e9) & (t_ns <= end_s * 1e9))
    return heard


def repeated(heard: NDArray[np.bool_], faults: AnyFaults, rng: np.random.Generator) -> TimeArray:
    """Return, for each reading that is heard, the row (of all) whose values it carries: its own or an earlier one."""
    rows = np.flatnonzero(heard)
    if not (faults.repeat_probability and len(rows)):
        return rows
    fresh = rng.random(len(heard))[rows] >= faults.repeat_probability
    return rows[np.maximum.accumulate(np.where(fresh, np.arange(len(rows)), 0))]
