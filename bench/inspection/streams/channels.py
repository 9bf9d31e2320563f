"""A log as channels: the values of one quantity over time, with what the log states of their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ....datasets.log import AttitudeStream, ImuStream, Log, ReadingStream
from ....datasets.quantities import DEGREE
from ....datasets.state import Array, TimeArray
from .quantisation import Quantisation, quantisation_of

XYZ, ENU = ("x", "y", "z"), ("east", "north", "up")


@dataclass(frozen=True, eq=False)
class Channel:
    """One quantity of one stream.

    Attributes:
        stream: its name in log.yaml: "imu", "dvl".
        name: "gyro", "accel", and otherwise the stream's.
        quantity: the key of log.yaml that names its columns: "gyro", "velocity", "depth".
        t_ns: (n,)
        x: (n, k) values, SI, in the axes of the log; angles unwrapped.
        sigma: (k,) stated sigma of one reading: the median over its rows, inf where it was not measured.
        unit: of printed figures.
        shown: printed figure per SI unit.
        axes: (k,) names.
        turn: 2π for an angle, else 0.
    """

    stream: str
    name: str
    quantity: str
    t_ns: TimeArray
    x: Array
    sigma: Array
    unit: str
    shown: float
    axes: tuple[str, ...]
    turn: float = 0.0

    @property
    def period_s(self) -> float:
        """Median interval; NaN with fewer than two values."""
        return float(np.median(np.diff(self.t_ns))) * 1e-9 if len(self.t_ns) > 1 else float("nan")

    @property
    def raw(self) -> Array:
        """(n, k) x, angles within half a turn of zero."""
        return self.x - self.turn * np.rint(self.x / self.turn) if self.turn else self.x

    @cached_property
    def steps(self) -> list[Quantisation]:
        """The resolution of each axis."""
        return [quantisation_of(axis) for axis in self.raw.T]

    @property
    def sigma_key(self) -> str:
        """The key of log.yaml that states the sigma of one reading of an aiding sensor."""
        return f"streams.{self.stream}." + {"dvl": "sigma_m_s", "heading": "sigma_deg"}.get(self.stream, "sigma_m")

    def rows(self, chosen: NDArray[np.bool_]) -> Channel:
        """Return the channel with only some of its rows."""
        return replace(self, t_ns=self.t_ns[chosen], x=self.x[chosen])

    def text(self, value: float) -> str:
        """Return an SI value as text, in the channel's unit."""
        return f"{value * self.shown:.3g} {self.unit}"

    def of_axis(self, axis: int) -> str:
        """Return "gyro x"; the name alone where there is one axis."""
        return f"{self.name} {self.axes[axis]}" if len(self.axes) > 1 else self.name


@lru_cache(maxsize=1)
def imu_period_ns(imu: ImuStream) -> int:
    """Return an IMU's typical sampling interval, ns; the checks ask for it often, and it takes a millisecond."""
    return imu.period_ns


@lru_cache(maxsize=1)
def imu_start_ns(imu: ImuStream) -> int:
    """Return the start of an IMU's first interval, ns; the checks ask for it hundreds of times."""
    return imu.start_ns


@lru_cache(maxsize=1)
def channels_of(log: Log) -> tuple[Channel, ...]:
    """Return the channels of every stream that is there: gyro, accel, dvl, depth, gps, heading."""
    noise, root_s = log.rig.imu_noise, float(np.sqrt(imu_period_ns(log.imu) * 1e-9))
    gyro, accel = np.full(3, noise.gyro_density / root_s), np.full(3, noise.accel_density / root_s)
    return (
        Channel("imu", "gyro", "gyro", log.imu.t_ns, log.imu.w_WI_I, gyro, "rad/s", 1.0, XYZ),
        Channel("imu", "accel", "accel", log.imu.t_ns, log.imu.f_I, accel, "m/s²", 1.0, XYZ),
        *(_aiding(name, stream) for name, stream in log.streams.items() if len(stream)),
    )


@lru_cache(maxsize=4)
def stated_sigma(stream: ReadingStream) -> Array:
    """Return the median (m,) of the sigmas that a stream states, of each component; several checks ask for it."""
    return np.median(stream.sigma, axis=0)


def _aiding(name: str, stream: ReadingStream) -> Channel:
    sigma = stated_sigma(stream)
    if name == "heading":
        x, turn, axes = np.unwrap(stream.z, axis=0), 2 * np.pi, ("",)
        if isinstance(stream, AttitudeStream):
            x, turn, axes = _turned(stream), 0.0, XYZ
        quantity = "attitude" if isinstance(stream, AttitudeStream) else "heading"
        return Channel(name, name, quantity, stream.t_ns, x, sigma, "°", 1 / DEGREE, axes, turn)
    quantity = {"dvl": "velocity", "depth": "depth", "gps": "position"}[name]
    unit, axes = {"dvl": ("m/s", XYZ), "depth": ("m", ("",)), "gps": ("m", ENU)}[name]
    return Channel(name, name, quantity, stream.t_ns, stream.z, sigma, unit, 1.0, axes)


def _turned(stream: AttitudeStream) -> Array:
    """Return (n, 3) rad: the sum of the rotations from one attitude to the next, in the sensor's axes."""
    R_WH = stream.z.reshape(-1, 3, 3)
    steps = Rotation.from_matrix(R_WH[:-1].transpose(0, 2, 1) @ R_WH[1:]).as_rotvec().reshape(-1, 3)
    return np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def seconds(log: Log, t_ns: TimeArray) -> Array:
    """Return times from the log's start, s."""
    start_ns = imu_start_ns(log.imu) if log.prior is None else log.prior.t_ns
    return np.asarray((t_ns - start_ns) * 1e-9, dtype=np.float64)
