"""The models of `log.yaml`, one per part, and the check that reports what is wrong in one.

A description states where the numbers of each stream are and what they mean; `conversion` turns them into a Log. All
checks that need no data are made here, so no data is read before the whole description is valid.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, Field, SerializeAsAny, ValidationError, model_validator

from ..errors import DatasetError, complaints, nearest
from ..formats.recording import Recording, loader
from ..formats.tables.table import Column, Part, Table
from ..formats.yaml_file import read_yaml
from ..mounting import Matrix, MountingSpec
from ..notes import Note
from ..quantities import DEGREE, Finite, Latitude, Longitude, NotNegative, Number, Positive, Vector, Whole
from ..rig import ImuNoise
from ..rotations import complaint, is_rotation, note, off_rotation, orthonormalised
from ..state import LIMIT_NS, Array, Belief, NavState

Sigma = Annotated[Number, Field(gt=0)]
"""Infinite for a component that is not measured."""
Shift = Annotated[Number, Field(gt=-LIMIT_NS / 2e9, lt=LIMIT_NS / 2e9)]
"""A shift of a time, s: at most 73 years, so that no sum overflows."""
Checked = TypeVar("Checked", bound=BaseModel)


class DeviceClock(Part):
    """A clock inside the sensor, exact but free-running, mapped to the host's.

    A straight line (offset and drift) is fitted to the smallest reception delays of the host's stamps.
    """

    field: str
    """Field of the message, s."""
    wraps_at_s: Positive
    """The clock jumps back to zero here."""


class Message(Part):
    """Messages of the recording; each field is a column, and so is what the format adds (such as its `host_clock`)."""

    names: Annotated[tuple[str, ...], Field(min_length=1)]
    """Several are joined by equal device times; columns are then `Name.field`."""
    entity: Whole | None = None
    """Which of several senders of that name. In IMC `src_ent`, any if left out; in ArduPilot the instance, which may
    be left out only if there is one."""
    clock: DeviceClock | None = None
    """Adds the column `device`: this clock, unwrapped and mapped to the host's, s."""

    @model_validator(mode="after")
    def _joined_by_a_clock(self) -> Self:
        if len(self.names) > 1 and self.clock is None:
            raise ValueError("several messages are joined on a device clock: `clock` is missing")
        return self


class Quantity(Part):
    """Columns of one physical quantity: (raw · scale + offset), in `unit`."""

    units: ClassVar[dict[str, float]] = {}
    width: ClassVar[int | None] = None

    columns: Annotated[tuple[Column, ...], Field(min_length=1)]
    unit: str
    scale: Finite | tuple[Finite, ...] = 1.0
    """One for all columns or one each; −1 turns a sign."""
    offset: Finite | tuple[Finite, ...] = 0.0

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.unit not in self.units:
            raise ValueError(
                f"unknown unit {self.unit!r}; known: {', '.join(self.units)}{nearest(self.unit, self.units)}"
            )
        if self.width is not None and len(self.columns) != self.width:
            raise ValueError(f"expected {self.width} columns, found {len(self.columns)}")
        for name in ("scale", "offset"):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != len(self.columns):
                raise ValueError(f"{name}: expected one number or {len(self.columns)}, found {len(value)}")
        return self


class Height(Quantity):
    """One length."""

    units = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048}
    width = 1


class Lengths(Height):
    """Three lengths."""

    width = 3


class Speeds(Quantity):
    """Any number of velocities."""

    units = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "kn": 1852 / 3600, "km/h": 1 / 3.6}


class Velocity(Speeds):
    """Three velocities."""

    width = 3


class Rate(Quantity):
    """Three angular rates."""

    units = {"rad/s": 1.0, "deg/s": DEGREE}
    width = 3


class Acceleration(Quantity):
    """Three specific forces; g is 9.80665 m/s²."""

    units = {"m/s^2": 1.0, "m/s²": 1.0, "g": 9.80665, "mg": 9.80665e-3}
    width = 3


class Angle(Quantity):
    """One angle."""

    units = {"rad": 1.0, "deg": DEGREE}
    width = 1


class Angles(Angle):
    """Three angles."""

    width = 3


def squared(units: Mapping[str, float]) -> dict[str, float]:
    """Return the units of the variances of a quantity: (m/s)^2 and m^2/s^2 for m/s."""
    found: dict[str, float] = {}
    for unit, factor in units.items():
        for two in ("^2", "²"):
            found[f"({unit}){two}"] = found["/".join(part + two for part in unit.split("/"))] = factor**2
    return found


class Variances(Quantity):
    """Variances instead of standard deviations, as in the diagonal of a covariance; correlations are not used."""


class SpeedVariances(Variances):
    """Of any number of velocities."""

    units = squared(Speeds.units)


class HeightVariance(Variances):
    """Of one length."""

    units = squared(Height.units)
    width = 1


class LengthVariances(HeightVariance):
    """Of three lengths."""

    width = 3


class AngleVariances(Variances):
    """Of one angle, or three."""

    units = squared(Angle.units)


class Geodetic(Part):
    """Latitude and longitude (north and east positive), and the height where there is one.

    W is tangent at the origin; heights stay above the sea surface, as those of the depth sensor. A field may also say a
    place in words: 41°11'06" N, or 8 42.36 W.
    """

    latitude: Column | Annotated[tuple[Column, ...], Field(min_length=2, max_length=3)]
    """One column; or those of the degrees, the minutes and perhaps the seconds."""
    longitude: Column | Annotated[tuple[Column, ...], Field(min_length=2, max_length=3)]
    unit: Literal["deg", "rad", "ddmm", "ddmmss", "degE7"] = "deg"
    """ddmm is degrees · 100 + minutes, as NMEA writes it; ddmmss has seconds too; degE7 is 1e-7°, as in MAVLink."""
    north_south: Column | None = None
    """Column of N or S, which give the sign of the latitude."""
    east_west: Column | None = None
    """Column of E or W, which give the sign of the longitude."""
    scale: Finite | tuple[Finite, Finite] = 1.0
    """Of latitude and longitude, before the unit; −1 turns a sign."""
    altitude: Height | None = None

    @property
    def signs_unsaid(self) -> bool:
        """Whether the unit has no sign as NMEA writes it, and nothing else says the hemispheres."""
        said = {"scale", "north_south", "east_west"} & self.model_fields_set
        return self.unit in ("ddmm", "ddmmss") and not said

    @property
    def columns(self) -> tuple[Column, ...]:
        """Every column of the two angles."""
        angles = (self.latitude, self.longitude)
        plain = [column for angle in angles for column in (angle if isinstance(angle, tuple) else (angle,))]
        return (*plain, *(column for column in (self.north_south, self.east_west) if column is not None))


class Attitude(Part):
    """Full attitude, as rotation matrix by rows (9 columns), quaternion (4) or roll, pitch, yaw (3, order Z-Y-X)."""

    columns: tuple[Column, ...]
    form: Literal["matrix", "quaternion_xyzw", "quaternion_wxyz", "roll_pitch_yaw"]
    unit: Literal["rad", "deg"] = "rad"
    world: Literal["ENU", "NED", "ECEF"] = "ENU"
    axes: Literal["FLU", "FRD"] = "FLU"

    @model_validator(mode="after")
    def _fits(self) -> Self:
        expected = {"matrix": 9, "roll_pitch_yaw": 3}.get(self.form, 4)
        if len(self.columns) != expected:
            raise ValueError(f"{self.form}: expected {expected} columns, found {len(self.columns)}")
        return self


Unit = Literal["s", "ms", "us", "ns"]


class Time(Part):
    """When a row was true, and when it was received: numbers in a unit, or dates by ISO 8601 (UTC without a zone)."""

    column: Column | tuple[Column, Column] | None = None
    """One column; or two whose sum is the time: seconds and nanoseconds, a date and a time of day."""
    unit: Unit | tuple[Unit, Unit] = "s"
    """Of plain numbers, one for each of two columns. Dates and durations say their own."""
    wraps_at_s: Positive | None = None
    """The stamps are a counter that begins again from zero here: 4294.967296 for 32 bits of microseconds."""
    row_rate_hz: Positive | None = None
    """Instead of a column: the time is the row's index at this rate."""
    start_s: Finite = 0.0
    """Time of row 0, with row_rate_hz."""
    clock_offset_s: Shift = 0.0
    """Added to the stamps, to bring this sensor's clock onto the log's."""
    delay_s: Annotated[Shift, Field(ge=0)] = 0.0
    """The stamp is the reception, and the row was true this much earlier."""
    received: Column | tuple[Column, Column] | None = None
    """Column of the reception (or two, as for `column`), same unit and clock."""

    @property
    def units(self) -> tuple[Unit, ...]:
        """The unit of each column."""
        return self.unit if isinstance(self.unit, tuple) else (self.unit,)

    @property
    def stamps(self) -> tuple[tuple[Column, ...], ...]:
        """The columns of the stamp, and those of the reception."""
        both = (self.column, self.received)
        return tuple(each if isinstance(each, tuple) else (each,) for each in both if each is not None)

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.column is None) == (self.row_rate_hz is None):
            raise ValueError("give one of `column` and `row_rate_hz`")
        if self.delay_s and self.received is not None:
            raise ValueError("give one of `delay_s` and `received`")
        for columns in self.stamps:
            if len(columns) != len(self.units):
                raise ValueError(f"unit: {len(columns)} columns need {len(columns)} units, found {len(self.units)}")
        return self


class Valid(Part):
    """Rows are used only if this column holds one of these values, which are numbers or text."""

    column: Column
    values: Annotated[tuple[Finite | str, ...], Field(min_length=1)]

    @property
    def texts(self) -> tuple[str, ...]:
        """The values that are text."""
        return tuple(value for value in self.values if isinstance(value, str))

    @property
    def numbers(self) -> tuple[float, ...]:
        """The values that are numbers."""
        return tuple(value for value in self.values if not isinstance(value, str))


class Outliers(Part):
    """The whole row is dropped if the norm of these components, in SI, exceeds `above`."""

    above: Positive
    components: tuple[Annotated[Whole, Field(ge=0, le=2)], ...] | None = None
    """Which, from 0; all when left out."""


class NoiseDescription(Part):
    """The IMU's noise, equal on three axes; `ImuNoise` has the units."""

    gyro_density: Positive
    accel_density: Positive
    gyro_walk: NotNegative
    accel_walk: NotNegative
    gyro_bias_sigma: Positive
    accel_bias_sigma: Positive

    def noise(self) -> ImuNoise:
        """Return the noise, in our types."""
        return ImuNoise(**self.model_dump())


class Window(Part):
    """What is used of a log: from `from_s` on, and before `until_s`, counted from the file's first IMU sample."""

    from_s: NotNegative = 0.0
    until_s: Positive | None = None

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s ({self.until_s:g}) must be greater than from_s ({self.from_s:g})")
        return self


class SourceDescription(Part):
    """A source of columns, a time, and which rows are valid."""

    table: Table | None = None
    message: Message | None = None
    time: Time
    valid: Valid | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.table is None) == (self.message is None):
            raise ValueError("give one of `table` and `message`")
        return self


class StreamDescription(SourceDescription, Window):
    """The keys that all streams have. Readings outside the window are left out."""

    drop_repeats: bool = False
    """Leave out a row with the same values as the row before: a reading that was published again under a new stamp."""
    every: Annotated[Whole, Field(ge=1)] = 1
    """Keep every n-th of the remaining rows; of the IMU's, the means of n."""


class ImuDescription(StreamDescription):
    """Gyro and accelerometer; each sample is taken as the mean over the interval that ends at its time."""

    gyro: Rate
    accel: Acceleration
    accel_source: SourceDescription | None = None
    """Source of the accelerometer's rows, if not the gyro's; they are interpolated linearly to the gyro's times."""
    axes: Literal["FLU", "FRD"] = "FLU"
    mounting: MountingSpec = MountingSpec()
    noise: NoiseDescription


class AidingDescription(StreamDescription):
    """An aiding sensor. Its sigma is fixed (the key with the unit), or `sigma` or `variance` names columns of it."""

    sigma_field: ClassVar[str]
    outliers: Outliers | None = None
    averaged_over_s: Annotated[Shift, Field(ge=0)] = 0.0
    """Each reading is the mean of the last so many seconds: it was true at their middle. Overlapping means share
    errors, so only those are kept that do not overlap. Sigma is that of a mean."""

    @property
    def spread(self) -> Quantity | None:
        """The columns of sigma or variance, if there are any."""
        return getattr(self, "sigma", None) or getattr(self, "variance", None)

    @model_validator(mode="after")
    def _one_sigma(self) -> Self:
        names = (self.sigma_field, "sigma", "variance")
        if sum(getattr(self, name) is not None for name in names) != 1:
            raise ValueError(f"give one of `{self.sigma_field}`, `sigma` (columns) and `variance` (columns)")
        if np.isinf(np.asarray(getattr(self, self.sigma_field) or 0.0)).all():
            raise ValueError(f"{self.sigma_field}: with no finite sigma the sensor measures nothing; leave it out")
        return self


class DvlDescription(AidingDescription):
    """Bottom-track velocity of the vehicle over ground, in the DVL's axes, which are the body's; or a wheel's speed."""

    sigma_field = "sigma_m_s"
    velocity: Speeds
    measures: Annotated[tuple[Literal["x", "y", "z"], ...], Field(min_length=1)] = ("x", "y", "z")
    """The axes of the columns of `velocity` (and of `sigma`). An axis left out is unmeasured: its sigma is infinite."""
    axes: Literal["FLU", "FRD"] = "FLU"
    mounting: MountingSpec = MountingSpec()
    """Rotates the velocity into B's axes; its translation must be zero, since the DVL is B's origin."""
    sigma_m_s: Sigma | tuple[Sigma, ...] | None = None
    sigma: Speeds | None = None
    variance: SpeedVariances | None = None

    @model_validator(mode="after")
    def _axes_fit(self) -> Self:
        if len(set(self.measures)) != len(self.measures):
            raise ValueError("measures: an axis is named twice")
        if len(self.velocity.columns) != len(self.measures):
            raise ValueError(f"velocity: expected {len(self.measures)} columns, found {len(self.velocity.columns)}")
        if isinstance(self.sigma_m_s, tuple) and len(self.sigma_m_s) != len(self.measures):
            raise ValueError(f"sigma_m_s: expected {len(self.measures)} numbers, found {len(self.sigma_m_s)}")
        if any(self.mounting.translation_m):
            raise ValueError("mounting: the DVL is the origin of B; give the other sensors' translations from there")
        if self.mounting != MountingSpec() and len(self.measures) < 3:
            raise ValueError("mounting: only a velocity measured along all three axes can be rotated")
        return self


class DepthDescription(AidingDescription):
    """Height or depth of the pressure sensor against the surface."""

    sigma_field = "sigma_m"
    depth: Height
    positive: Literal["up", "down"] = "down"
    sigma_m: Sigma | None = None
    sigma: Height | None = None
    variance: HeightVariance | None = None
    mounting: MountingSpec = MountingSpec()


class Placed(Part):
    """A position: geodetic, or in local axes, or both (a local offset from a geodetic point), or earth-centred."""

    geodetic: Geodetic | None = None
    position: Lengths | None = None
    frame: Literal["ENU", "NED", "ECEF"] = "ENU"
    """Axes of `position` (and of a truth's `velocity`); ECEF: earth-centred earth-fixed."""

    @property
    def on_the_globe(self) -> bool:
        """Whether the position is global; else it is in W."""
        return self.geodetic is not None or (self.position is not None and self.frame == "ECEF")

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if self.geodetic is not None and self.position is not None and self.frame == "ECEF":
            raise ValueError("ECEF positions are global already: leave `geodetic` out")
        return self


class GpsDescription(AidingDescription, Placed):
    """Position of the antenna."""

    sigma_field = "sigma_m"
    sigma_m: Sigma | tuple[Sigma, Sigma, Sigma] | None = None
    """East, north, up; .inf for a component that was not measured. Without a height the third is .inf."""
    sigma: Lengths | None = None
    variance: LengthVariances | None = None
    mounting: MountingSpec = MountingSpec()

    @model_validator(mode="after")
    def _somewhere(self) -> Self:
        if self.geodetic is None and self.position is None:
            raise ValueError("give `geodetic`, `position` or both")
        return self


class HeadingDescription(AidingDescription):
    """A heading, or a full attitude."""

    sigma_field = "sigma_deg"
    heading: Angle | None = None
    convention: Literal["compass", "yaw"] = "compass"
    """compass: clockwise from north; yaw: counter-clockwise from east."""
    add_deg: Finite = 0.0
    """Added to the angle in its own convention: declination, deviation, offset."""
    attitude: Attitude | None = None
    sigma_deg: Sigma | tuple[Sigma, Sigma, Sigma] | None = None
    sigma: Angle | Angles | None = None
    variance: AngleVariances | None = None
    mounting: MountingSpec = MountingSpec()

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.heading is None) == (self.attitude is None):
            raise ValueError("give one of `heading` and `attitude`")
        width = 1 if self.heading is not None else 3
        given = self.spread.columns if self.spread is not None else self.sigma_deg
        if isinstance(given, tuple) and len(given) != width:
            raise ValueError(f"expected {width} sigma, found {len(given)}")
        return self


def columns_of(part: BaseModel) -> list[Column]:
    """Return every column that a part of a description names, in the order of the keys."""
    found: list[Column] = []
    for name in type(part).model_fields:
        value = getattr(part, name)
        if isinstance(value, Quantity | Attitude):
            found += value.columns
        elif isinstance(value, Geodetic):
            found += [*value.columns, *columns_of(value)]
        elif isinstance(value, Time):
            found += [column for columns in value.stamps for column in columns]
        elif isinstance(value, Valid):
            found.append(value.column)
    return list(dict.fromkeys(found))


class Streams(Part):
    """The sensors; only the IMU is required."""

    imu: ImuDescription
    dvl: DvlDescription | None = None
    depth: DepthDescription | None = None
    gps: GpsDescription | None = None
    heading: HeadingDescription | None = None


BESIDE_POSES = {"kind", "tum", "trajectory", "lookahead_s", "from_s", "until_s"}
"""The keys of a truth that have a meaning beside a file of poses."""


class TruthDescription(Placed, Window):
    """The true trajectory: a TUM file, a table of ours (`trajectory`), or a stream like the others."""

    kind: Literal["truth", "reference"] = "truth"
    """reference: the output of another filter."""
    tum: str | None = None
    trajectory: str | None = None
    """.parquet or .csv with the columns of `Trajectory.to_pandas`."""
    lookahead_s: Annotated[Number, Field(ge=0)] = 0.0
    table: Table | None = None
    message: Message | None = None
    time: Time | None = None
    valid: Valid | None = None
    drop_repeats: bool = False
    every: Annotated[Whole, Field(ge=1)] = 1
    height_m: Finite | None = None
    """Constant height above the sea surface, if the source has no height."""
    velocity: Velocity | None = None
    attitude: Attitude | None = None
    """Without it the truth's R_WB are NaN (unknown)."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [n for n in ("tum", "trajectory", "table", "message") if getattr(self, n) is not None]
        if len(sources) != 1:
            raise ValueError("give one of `tum`, `trajectory`, `table` and `message`")
        if sources[0] in ("tum", "trajectory"):
            idle = [name for name in type(self).model_fields if name in self.model_fields_set - BESIDE_POSES]
            if idle:
                named = ", ".join(f"`{name}`" for name in idle)
                raise ValueError(
                    f"{named}: no effect beside `{sources[0]}`, whose poses are those of B in W, in our units; "
                    "leave it out, or describe the file as a `table`"
                )
        else:
            if self.time is None or (self.geodetic is None and self.position is None):
                raise ValueError("a truth from a stream needs `time`, and `geodetic` or `position`")
            if self.position is None and self.geodetic and self.geodetic.altitude is None and self.height_m is None:
                raise ValueError("no height: give `geodetic.altitude` or a constant `height_m`")
        return self


class Origin(Part):
    """The origin of W."""

    latitude_deg: Latitude
    longitude_deg: Longitude


def _is_covariance(P: Array) -> bool:
    """Whether P is symmetric and positive semi-definite, tested on its correlations, so that units do not matter."""
    sigma = np.sqrt(np.maximum(P.diagonal(), 0.0))
    sigma[sigma == 0] = 1.0
    with np.errstate(over="ignore"):
        C = P / sigma / sigma[:, None]
    if not (np.abs(C) < 1 + 1e-6).all() or not np.allclose(C, C.T, rtol=0, atol=1e-6):
        return False
    return bool(np.linalg.eigvalsh(C).min() > -1e-6)


class PriorDescription(Part):
    """A belief at the start, in our frames and SI."""

    t_ns: Annotated[Whole, Field(gt=-LIMIT_NS, lt=LIMIT_NS)]
    R_WB: Matrix
    p_WB_W: Vector
    v_WB_W: Vector
    b_a: Vector
    b_g: Vector
    P: tuple[tuple[Finite, ...], ...]
    """Symmetric and positive semi-definite; a zero variance states that there is no error."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len(self.P) != 15 or any(len(row) != 15 for row in self.P):
            raise ValueError("P: expected 15 rows of 15")
        R, P = np.array(self.R_WB), np.array(self.P)
        if not is_rotation(off_rotation(R)):
            raise ValueError(f"R_WB is {complaint(R)}")
        if not _is_covariance(P):
            raise ValueError("P is not symmetric and positive semi-definite")
        return self

    def belief(self) -> Belief:
        """Return the belief, in our types, its rotation without the rounding of its decimals."""
        R_WB = np.array(self.R_WB)
        vectors = [np.array(x) for x in (self.p_WB_W, self.v_WB_W, self.b_a, self.b_g)]
        return Belief(self.t_ns, NavState(orthonormalised(R_WB, off_rotation(R_WB)), *vectors), np.array(self.P))

    @property
    def notes(self) -> tuple[Note, ...]:
        """That R_WB was orthonormalised, in a sentence; nothing where it was not."""
        return note("prior", off_rotation(np.array([self.R_WB])))


class Description(Window):
    """A log's description, `log.yaml`. Its window holds for all streams and the truth."""

    name: str | None = None
    """Name of the log in tables; the folder's name if left out."""
    title: str = ""
    source: str = ""
    """Origin of the recording, its licence, and whom to cite."""
    notes: tuple[str, ...] = ()
    """Peculiarities of the source, one sentence each; a value that was fitted to the truth is marked as such."""
    gravity: Finite = 9.81
    """m/s²."""
    origin: Origin | None = None
    """The origin of W. If left out in a geodetic log, it is the first fix (of gps, else of truth) at or after the IMU's
    start, so that the vehicle starts at zero."""
    max_wait_s: Positive | None = None
    """How long the start may wait for its sensors; see `initialise`."""
    recording: SerializeAsAny[Recording] | None = None
    """The file with the streams' messages. Its `format` chooses the loader, which defines the other keys."""
    streams: Streams
    truth: TruthDescription | None = None
    prior: PriorDescription | None = None

    @property
    def parts(self) -> dict[str, StreamDescription | TruthDescription]:
        """The streams and the truth that are described, by name."""
        named = {name: getattr(self.streams, name) for name in Streams.model_fields} | {"truth": self.truth}
        return {name: part for name, part in named.items() if part is not None}

    def window(self, part: Window) -> Window:
        """Return what of a stream or of the truth is used: its own window within that of the log."""
        ends = [each.until_s for each in (self, part) if each.until_s is not None]
        return Window.model_construct(from_s=max(self.from_s, part.from_s), until_s=min(ends, default=None))

    @model_validator(mode="after")
    def _messages_have_a_recording(self) -> Self:
        sources = [*self.parts.values(), self.streams.imu.accel_source]
        if self.recording is None and any(part is not None and part.message is not None for part in sources):
            raise ValueError("streams name messages, but `recording` does not say which file they are in")
        return self


def read_description(path: Path) -> Description:
    """Read and check a log.yaml.

    Raises:
        DatasetError: names the file, the key, what is wrong, and the nearest known key.
    """
    raw = read_yaml(path)
    if not isinstance(raw, dict):
        raise DatasetError(f"{path}: expected keys and values, found {type(raw).__name__}")
    return check_description(raw, str(path))


def check_description(raw: dict[Any, Any], where: str) -> Description:
    """Check a parsed description; errors begin with `where`."""
    recording = raw.get("recording")
    if isinstance(recording, dict):
        raw = {**raw, "recording": _checked(_loader(recording, where), recording, where, ("recording",))}
    return _checked(Description, raw, where)


def _checked(model: type[Checked], raw: dict[Any, Any], where: str, above: tuple[str, ...] = ()) -> Checked:
    """Return the validated part, whose path in the description is `above`."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise DatasetError(*(f"{where}: {complaint}" for complaint in complaints(error, model, above))) from None
    except (RecursionError, OverflowError) as error:
        raise DatasetError(f"{where}: cannot be understood: {error}") from None


def _loader(recording: dict[Any, Any], where: str) -> type[Recording]:
    if "format" not in recording:
        raise DatasetError(f"{where}: missing key `recording.format`")
    try:
        return loader(recording["format"])
    except DatasetError as error:
        raise DatasetError(f"{where}: `recording.format`: {error}") from None
