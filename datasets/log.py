"""A log: streams of readings in SI units and our frames, the rig they were taken with, and the truth if known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .errors import DatasetError
from .imu_time import first_sampling_ns, gaps_ns, sampling_ns
from .read_only import make_read_only
from .rig import Rig
from .rotations import UNHEARD, complaint, off_rotation
from .state import Array, Belief, TimeArray
from .times import far, far_complaint
from .trajectory import Trajectory


def is_noise(sigma: Array) -> NDArray[np.bool_]:
    """Return (n,): whether all of a row's standard deviations (n, m) are positive."""
    return np.all(sigma > 0, axis=1)


def check_rows(stream: str, t_ns: TimeArray, columns: Mapping[str, Array], *, strict: bool) -> None:
    """Refuse times out of order, or far from all others, and values that are not finite.

    Args:
        stream: name used in the error.
        t_ns: (n,) times.
        columns: name to (n,) or (n, k) values.
        strict: times must increase; otherwise two rows may share one.

    Raises:
        DatasetError: naming stream, row, and value.
    """
    for name, values in columns.items():
        if len(values) != len(t_ns):
            raise DatasetError(f"{stream}: {len(t_ns)} times but {len(values)} rows of {name}")
        bad = np.flatnonzero(~np.isfinite(np.asarray(values).reshape(len(t_ns), -1)).all(axis=1)) if len(t_ns) else []
        if len(bad):
            raise DatasetError(f"{stream}: row {bad[0]} ({len(bad)} in all): {name} is {values[bad[0]]}")
    step = np.diff(t_ns)
    bad = np.flatnonzero(step <= 0 if strict else step < 0)
    if len(bad):
        row = int(bad[0]) + 1
        how = "repeats" if step[row - 1] == 0 else "comes before"
        raise DatasetError(f"{stream}: row {row} ({len(bad)} in all): time {t_ns[row]} {how} the row above")
    bad = np.flatnonzero(far(t_ns))
    if len(bad):
        raise DatasetError(f"{stream}: row {bad[0]} ({len(bad)} in all): {far_complaint(t_ns, int(bad[0]))}")


@dataclass(frozen=True, eq=False)
class ImuStream:
    """Inertial samples; each is the mean over the interval that ends at its time.

    Attributes:
        t_ns: (n,) end of each sample's interval, increasing.
        w_WI_I: (n, 3) rad/s, gyro, in the IMU's axes.
        f_I: (n, 3) m/s², specific force, in the IMU's axes.
    """

    t_ns: TimeArray
    w_WI_I: Array
    f_I: Array

    def __post_init__(self) -> None:
        if len(self.t_ns) < 2:
            raise DatasetError(f"imu: {len(self.t_ns)} samples; at least two are needed")
        check_rows("imu", self.t_ns, {"gyro": self.w_WI_I, "accel": self.f_I}, strict=True)

    @property
    def sampling_ns(self) -> TimeArray:
        """(n,) sampling interval about each sample; a rate may change during a log."""
        return sampling_ns(self.t_ns)

    @property
    def gaps_ns(self) -> TimeArray:
        """(n,) how long samples are missing before each sample, 0 where none is; see `imu_time`."""
        return gaps_ns(self.t_ns)

    @property
    def start_ns(self) -> int:
        """Start of the first sample's interval."""
        return int(self.t_ns[0]) - first_sampling_ns(self.t_ns)

    @property
    def period_ns(self) -> int:
        """Typical sampling interval: the median of `sampling_ns`."""
        return int(np.median(self.sampling_ns))


@dataclass(frozen=True, eq=False)
class ReadingStream:
    """Readings of one aiding sensor.

    Attributes:
        t_ns: (n,) when each was true, in order.
        received_ns: (n,) when each was received; never before it was true.
        z: (n, k) readings: dvl v_WB_B m/s (k = 3), depth z_W m (1, up positive), gps p_WG_W m (3),
            heading psi rad (1: yaw of the sensor's x axis, counter-clockwise from east), attitude R_WH (9, by rows).
        sigma: (n, m) standard deviation of each component of the residual (m = 3, 1, 3, 1, 3), inf where that
            component was not measured.
    """

    name: ClassVar[str]
    width: ClassVar[int]
    residual_width: ClassVar[int]

    t_ns: TimeArray
    received_ns: TimeArray
    z: Array
    sigma: Array

    def __post_init__(self) -> None:
        n = len(self.t_ns)
        if self.z.shape != (n, self.width) or self.sigma.shape != (n, self.residual_width):
            raise DatasetError(
                f"{self.name}: expected z ({n}, {self.width}) and sigma ({n}, {self.residual_width}), "
                f"found {self.z.shape} and {self.sigma.shape}"
            )
        check_rows(self.name, self.t_ns, {"value": self.z}, strict=True)
        bad = np.flatnonzero(~is_noise(self.sigma))
        if len(bad):
            raise DatasetError(f"{self.name}: row {bad[0]}: sigma must be positive, found {self.sigma[bad[0]]}")
        early = np.flatnonzero(self.received_ns < self.t_ns)
        if len(early):
            raise DatasetError(f"{self.name}: row {early[0]} was received before it was true")

    def __len__(self) -> int:
        return len(self.t_ns)


class DvlStream(ReadingStream):
    """Bottom-track velocity of B, in B axes; docs/conventions.md (4)."""

    name, width, residual_width = "dvl", 3, 3


class DepthStream(ReadingStream):
    """Height of the pressure sensor in W, up positive; docs/conventions.md (1)."""

    name, width, residual_width = "depth", 1, 1


class GpsStream(ReadingStream):
    """Position of the antenna in W; docs/conventions.md (2)."""

    name, width, residual_width = "gps", 3, 3


class HeadingStream(ReadingStream):
    """Yaw of the heading sensor's x axis and nothing else; docs/conventions.md (15)."""

    name, width, residual_width = "heading", 1, 1

    @property
    def psi(self) -> Array:
        """(n,) rad, counter-clockwise from east."""
        return self.z[:, 0]


class AttitudeStream(ReadingStream):
    """Full attitude R_WH of the heading sensor; docs/conventions.md (3). It counts as the sensor "heading"."""

    name, width, residual_width = "attitude", 9, 3

    @property
    def psi(self) -> Array:
        """(n,) rad: azimuth of the sensor's x axis, counter-clockwise from east."""
        return np.arctan2(self.z[:, 3], self.z[:, 0])

    def __post_init__(self) -> None:
        super().__post_init__()
        R = self.z.reshape(-1, 3, 3)
        bad = np.flatnonzero(off_rotation(R) > UNHEARD)
        if len(bad):
            raise DatasetError(f"attitude: row {bad[0]} ({len(bad)} in all) is {complaint(R[bad[0]], UNHEARD)}")


@dataclass(frozen=True, eq=False)
class Log:
    """One voyage. Its arrays are read-only, those of the rig, the truth and the prior too: runs share a log.

    Attributes:
        name: its name in tables.
        rig: extrinsics, noise, gravity.
        imu: inertial samples; every log has them.
        dvl, depth, gps, heading: aiding sensors, each None where the vehicle has none.
        truth: trajectory to score against; None if unknown.
        truth_kind: "truth", or "reference" for the output of another filter; tables print it.
        prior: belief at the start, if the log states one (simulated logs do); else `initialise` makes it.
        notes: what was repaired, converted, counted or fitted on reading, one sentence each; a `notes.Note` where a
            reader of the numbers should know it.
        origin: (latitude °, longitude °) of W's origin, if the log is geodetic.
        max_wait_s: how long the start may wait for its sensors, s; None: as long as `initialise` does by default.
    """

    name: str
    rig: Rig
    imu: ImuStream
    dvl: DvlStream | None = None
    depth: DepthStream | None = None
    gps: GpsStream | None = None
    heading: HeadingStream | AttitudeStream | None = None
    truth: Trajectory | None = None
    truth_kind: str = "truth"
    prior: Belief | None = None
    notes: tuple[str, ...] = ()
    origin: tuple[float, float] | None = None
    max_wait_s: float | None = None

    def __post_init__(self) -> None:
        make_read_only(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Be what a copy or another process gets, whose arrays numpy has made writable."""
        self.__dict__.update(state)
        make_read_only(self)

    @property
    def streams(self) -> dict[str, ReadingStream]:
        """The aiding streams that this log has, by sensor name."""
        every = {"dvl": self.dvl, "depth": self.depth, "gps": self.gps, "heading": self.heading}
        return {name: stream for name, stream in every.items() if stream is not None}

    @property
    def start_ns(self) -> int:
        """Start of the voyage: the prior's time, else the start of the first IMU sample's interval."""
        return self.prior.t_ns if self.prior is not None else self.imu.start_ns

    @property
    def duration_s(self) -> float:
        """From the start to the last IMU sample, s."""
        return (int(self.imu.t_ns[-1]) - self.start_ns) * 1e-9

    @property
    def nbytes(self) -> int:
        """Memory of the log's own arrays (IMU and readings), bytes."""
        arrays = [self.imu.t_ns, self.imu.w_WI_I, self.imu.f_I]
        for stream in self.streams.values():
            arrays += [stream.t_ns, stream.received_ns, stream.z, stream.sigma]
        return sum(array.nbytes for array in arrays)

    def with_prior(self, prior: Belief) -> Log:
        """Return this log, starting from `prior`."""
        return replace(self, prior=prior)
