"""From a description and a folder to a Log: rows are read, checked, and converted to our frames and units.

The steps are the same for every stream. Rows declared invalid or outside the window are dropped. Rows with numbers
that are not finite are an error, or dropped with `repair`. Declared outliers are dropped. Times out of order are an
error, or dropped with `repair`. Every n-th row is kept. `Log.notes` counts all that was dropped. A truth or a stream
that does not overlap the IMU's time is an error: some clock is wrong.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import DatasetError
from ..formats.columns import EXACT, Columns, read_table
from ..formats.recording import Recording, Wanted
from ..log import AttitudeStream, DepthStream, DvlStream, GpsStream, HeadingStream, ImuStream, Log
from ..notes import Note
from ..rig import Rig
from ..state import Array, TimeArray
from ..times import NS_PER, times_ns
from ..trajectory import Trajectory
from . import description as d
from .device_clock import common_instants
from .geodesy import SEMI_MAJOR_M, ecef_from_geodetic, enu_axes, enu_from_geodetic, geodetic_from_ecef

Mask = NDArray[Any]
FLIP_YZ = np.array([1.0, -1.0, -1.0])
"""FRD to FLU, and back."""
FAR_M = 100e3
"""From a spherical Earth of the semi-major axis: the ellipsoid is within 21 km of it, and a receiver without a fix
reports (0, 0, 0)."""
DEVICE = "device"
"""The column added by a message's own clock."""


@dataclass
class _Opening:
    """The state of opening one folder: description, strictness, notes, the IMU's time, and messages so far."""

    description: d.Description
    folder: Path
    repair: bool
    notes: list[str] = field(default_factory=list)
    imu_ns: tuple[int, int] | None = None
    messages: dict[tuple[str, int | None], Mapping[str, NDArray[Any]]] | None = None

    def columns(self, part: d.SourceDescription | d.TruthDescription, wanted: Iterable[d.Column]) -> Columns:
        """Read the raw columns of a part from its table or its messages; times are not converted."""
        times = [] if part.time is None else [c for c in (part.time.column, part.time.received) if c is not None]
        if part.table is not None:
            return read_table(self.folder, part.table, [c for c in wanted if c not in times], times)
        assert part.message is not None
        return self._joined(part.message, list(wanted))

    def window(self, stream: str, part: d.Window, t_ns: TimeArray) -> Mask:
        """Return which rows of a stream or of the truth are in the window; the IMU's rows, read first, set its zero.

        Raises:
            DatasetError: the stream lies wholly outside the IMU's time, so that some clock is wrong.
        """
        inside = np.ones(len(t_ns), bool)
        if not len(t_ns):
            return inside
        span_ns = int(t_ns.min()), int(t_ns.max())
        self.imu_ns = self.imu_ns or span_ns
        window = self.description.window(part)
        if not window.from_s and window.until_s is None:
            return inside
        start_ns = self.imu_ns[0]
        if span_ns[1] < start_ns or span_ns[0] > self.imu_ns[1]:
            raise DatasetError(f"{self.folder}: {_wrong_clock(stream, span_ns, self.imu_ns)}")
        inside &= t_ns >= start_ns + round(window.from_s * 1e9) if window.from_s else True
        inside &= t_ns < start_ns + round(window.until_s * 1e9) if window.until_s is not None else True
        end = "" if window.until_s is None else f" until {window.until_s:g} s"
        left_out = (
            f"{np.count_nonzero(~inside)} of {len(t_ns)} rows are outside the window from {window.from_s:g} s{end}"
        )
        if stream == "imu" and np.count_nonzero(inside) < 2:
            raise DatasetError(f"{self.folder}: imu: {left_out}; change `from_s` or `until_s`")
        if not inside.all():
            self.notes.append(f"{stream}: {left_out} and left out")
        return inside

    def _joined(self, message: d.Message, wanted: list[d.Column]) -> Columns:
        """Return columns of messages; `device` is their own clock, mapped to the host's."""
        if self.messages is None:
            self._read_messages()
        assert self.messages is not None
        recording = self.description.recording
        assert recording is not None
        found = [self.messages[name, message.entity] for name in message.names]
        picks: list[Any] = [slice(None)] * len(found)
        device: Array | None = None
        if message.clock is not None:
            column, unit = recording.host_clock
            host_s = [part[column] * (NS_PER[unit] * 1e-9) for part in found]
            device_s = [part[message.clock.field].astype(float) for part in found]
            picks, device = common_instants(host_s, device_s, message.clock.wraps_at_s)
            if not len(device):
                where = recording.path(self.folder)
                raise DatasetError(f"{where}: {' and '.join(message.names)} have no device time in common")
        columns: Columns = {}
        for column in wanted:
            if column == DEVICE and device is not None:
                columns[column] = device
            else:
                which, field_name = _field(message, str(column), recording, self.folder)
                columns[column] = found[which][field_name][picks[which]]
        return columns

    def _read_messages(self) -> None:
        """Read everything that the description needs from its recording, in one pass."""
        recording = self.description.recording
        assert recording is not None
        asked: dict[tuple[str, int | None], dict[str, None]] = {}
        for part, wanted in _sources(self.description):
            if part.message is None:
                continue
            for name in part.message.names:
                columns = asked.setdefault((name, part.message.entity), {})
                if part.message.clock is not None:
                    columns |= dict.fromkeys((recording.host_clock[0], part.message.clock.field))
            for column in wanted:
                if column != DEVICE or part.message.clock is None:
                    which, field_name = _field(part.message, str(column), recording, self.folder)
                    asked[part.message.names[which], part.message.entity][field_name] = None
        read = recording.read(self.folder, [Wanted(*key, tuple(columns)) for key, columns in asked.items()])
        self.messages = dict(zip(asked, read.columns, strict=True))
        self.notes += [note if isinstance(note, Note) else Note(note, "damage") for note in read.notes]


def _field(message: d.Message, column: str, recording: Recording, folder: Path) -> tuple[int, str]:
    """Return the index of the joined message that has a column, and its field; the host's stamp is the first one's."""
    if len(message.names) == 1 or column == recording.host_clock[0]:
        return 0, column
    for which, name in enumerate(message.names):
        if column.startswith(f"{name}."):
            return which, column.removeprefix(f"{name}.")
    raise DatasetError(f"{folder}: column {column!r}: expected `Name.field` of one of {', '.join(message.names)}")


def _sources(description: d.Description) -> Iterator[tuple[Any, list[d.Column]]]:
    """Yield every source of columns of a description, with the columns to read from it."""
    for part in description.parts.values():
        if isinstance(part, d.ImuDescription) and part.accel_source is not None:
            yield part.accel_source, [*d.columns_of(part.accel_source), *part.accel.columns]
            yield part, d.columns_of(part.model_copy(update={"accel": None}))
        else:
            yield part, d.columns_of(part)


@dataclass
class _Rows:
    """The remaining rows of one stream, with their number in the source.

    Attributes:
        raw: (n,) per column, not converted.
        number: (n,) row in the source, from 0.
        t_ns, received_ns: (n,).
        total: how many rows the source has.
    """

    stream: str
    opening: _Opening
    raw: Columns
    number: TimeArray
    t_ns: TimeArray
    received_ns: TimeArray
    total: int

    def keep(self, mask: Mask) -> None:
        self.raw = {column: values[mask] for column, values in self.raw.items()}
        self.number, self.t_ns, self.received_ns = self.number[mask], self.t_ns[mask], self.received_ns[mask]

    def note(self, count: int, what: str) -> None:
        if count:
            text = f"{self.stream}: {count} rows {what} dropped"
            self.opening.notes.append(Note(text, "dropped", self.stream, count, self.total))

    def refuse(self, bad: Mask, complaint: Any, what: str) -> None:
        """With repair, drop the rows of `bad`; without, raise complaint(first bad row)."""
        if not bad.any():
            return
        first, count = int(np.flatnonzero(bad)[0]), int(np.count_nonzero(bad))
        if not self.opening.repair:
            raise DatasetError(
                f"{self.opening.folder}: {self.stream}: row {self.number[first]} ({count} in all): {complaint(first)}; "
                "--repair drops such rows"
            )
        self.note(count, f"{what} (repair)")
        self.keep(~bad)

    def si(self, quantity: d.Quantity) -> Array:
        """Return (n, k): the quantity's columns in SI, in the axes of the source."""
        values = np.stack([self.raw[c] for c in quantity.columns], axis=1).astype(float, copy=False)
        factor = quantity.units[quantity.unit]
        with np.errstate(over="ignore", invalid="ignore"):
            if np.any(np.not_equal(quantity.scale, 1.0)):
                values = values * np.asarray(quantity.scale)
            if np.any(np.not_equal(quantity.offset, 0.0)):
                values = values + np.asarray(quantity.offset)
            return values if factor == 1.0 else values * factor


@contextmanager
def _named(folder: Path) -> Iterator[None]:
    """Prefix errors with the folder, for types that do not know it."""
    try:
        yield
    except DatasetError as error:
        raise DatasetError(f"{folder}: {error}") from None


def build_log(description: d.Description, folder: Path, *, repair: bool = False) -> Log:
    """Read the recording of a description.

    Raises:
        DatasetError: names the problem with file or stream, row and value.
    """
    opening = _Opening(description, folder, repair)
    streams = description.streams
    imu = _imu(opening, streams.imu)
    dvl = None if streams.dvl is None else _dvl(opening, streams.dvl)
    depth = None if streams.depth is None else _depth(opening, streams.depth)
    gps_rows = None if streams.gps is None else _stream(opening, "gps", streams.gps, _position_columns(streams.gps))
    truth_part = description.truth
    truth_rows = None
    if truth_part is not None and truth_part.time is not None and (truth_part.table or truth_part.message):
        truth_rows = _stream(opening, "truth", truth_part, _truth_columns(truth_part))

    origin = None
    if description.origin is not None:
        origin = (np.radians(description.origin.latitude_deg), np.radians(description.origin.longitude_deg))
    else:
        for part, rows in ((streams.gps, gps_rows), (truth_part, truth_rows)):
            if origin is None and part is not None and part.on_the_globe and rows is not None:
                origin = _first_fix(part, rows, int(imu.t_ns[0]))
    gps = None if gps_rows is None or streams.gps is None else _gps(streams.gps, gps_rows, origin)
    heading = None if streams.heading is None else _heading(opening, streams.heading, origin)
    truth = None
    if truth_part is not None:
        truth = _truth(opening, truth_part, truth_rows, origin)
        if truth_rows is None:
            truth = truth.select(opening.window("truth", truth_part, truth.t_ns))

    with _named(folder):
        mountings = {
            name: part.mounting.mounting()
            for name in ("depth", "gps", "heading")
            if (part := getattr(streams, name)) is not None
        }
        degrees = None if origin is None else (float(np.degrees(origin[0])), float(np.degrees(origin[1])))
        if description.origin is not None:
            degrees = (description.origin.latitude_deg, description.origin.longitude_deg)
        rig = Rig(
            streams.imu.noise.noise(),
            streams.imu.mounting.mounting(),
            **mountings,
            gravity=description.gravity,
            latitude_deg=None if degrees is None else degrees[0],
        )
    log = Log(
        name=description.name or folder.resolve().name,
        rig=rig,
        imu=imu,
        dvl=dvl,
        depth=depth,
        gps=gps,
        heading=heading,
        truth=truth,
        truth_kind="truth" if truth_part is None else truth_part.kind,
        prior=None if description.prior is None else description.prior.belief(),
        notes=(*description.notes, *opening.notes),
        origin=degrees,
        max_wait_s=description.max_wait_s,
    )
    with _named(folder):
        _check_clocks(log)
    return log


def _check_clocks(log: Log) -> None:
    """Refuse a prior outside the IMU's time, and a truth or a stream that does not overlap it."""
    start_ns, end_ns = int(log.imu.t_ns[0]) - 2 * log.imu.period_ns, int(log.imu.t_ns[-1])
    imu = f"the IMU's time, {log.imu.t_ns[0] * 1e-9:.3f} s to {end_ns * 1e-9:.3f} s"
    if log.prior is not None and not start_ns <= log.prior.t_ns < end_ns:
        raise DatasetError(f"prior: t_ns, {log.prior.t_ns * 1e-9:.3f} s, lies outside {imu}")
    if log.truth is not None and not len(log.truth):
        raise DatasetError("truth: no rows; leave `truth` out if it is unknown")
    for name, part in {**log.streams, "truth": log.truth}.items():
        if part is not None and len(part) and (part.t_ns[-1] < start_ns or part.t_ns[0] > end_ns):
            raise DatasetError(
                _wrong_clock(name, (int(part.t_ns[0]), int(part.t_ns[-1])), (int(log.imu.t_ns[0]), end_ns))
            )


def _wrong_clock(name: str, span_ns: tuple[int, int], imu_ns: tuple[int, int]) -> str:
    """Return that a stream lies wholly outside the IMU's time; both from first to last, ns."""
    span, imu = (f"{first * 1e-9:.3f} s to {last * 1e-9:.3f} s" for first, last in (span_ns, imu_ns))
    return (
        f"{name}: {span} lies wholly outside the IMU's time, {imu}; "
        "check its clock (`clock_offset_s`) and the `unit` of its time"
    )


def _stream(opening: _Opening, stream: str, part: Any, columns: list[d.Column]) -> _Rows:
    """Read a stream's rows, and drop or refuse those without a valid time or finite numbers."""
    time: d.Time = part.time
    sigma = getattr(part, "sigma", None)
    sigma_columns = [] if sigma is None else list(sigma.columns)
    valid: d.Valid | None = part.valid
    times = [c for c in (time.column, time.received) if c is not None]
    plain = [*columns, *sigma_columns, *([] if valid is None else [valid.column])]
    twice = [c for c in times if c in plain]
    if twice:
        raise DatasetError(f"{opening.folder}: {stream}: column {twice[0]!r} cannot be a time and something else")
    raw = opening.columns(part, [*plain, *times])
    count = len(next(iter(raw.values())))
    offset_ns = round(time.clock_offset_s * 1e9)

    if time.column is None:
        assert time.row_rate_hz is not None
        seconds = time.start_s + np.arange(count) / time.row_rate_hz
        stamp_ns, timed = times_ns(seconds, "s")
    else:
        stamp_ns, timed = times_ns(raw[time.column], time.unit)
    t_ns = stamp_ns + offset_ns - round(time.delay_s * 1e9)
    received_ns = stamp_ns + offset_ns
    if time.received is not None:
        received_ns, also = times_ns(raw[time.received], time.unit)
        received_ns, timed = received_ns + offset_ns, timed & also

    rows = _Rows(stream, opening, raw, np.arange(count), t_ns, received_ns, count)
    if valid is not None:
        good = np.isin(raw[valid.column], valid.values)
        rows.note(int(np.count_nonzero(~good)), "invalid")
        rows.keep(good)
        timed = timed[good]

    def untimed(row: int) -> str:
        values = {c: rows.raw[c][row] for c in times}
        return f"time is {', '.join(map(str, values.values())) or 'beyond the clock'}"

    rows.refuse(np.asarray(~timed), untimed, "without a time")
    if isinstance(part, d.Window):
        rows.keep(opening.window(stream, part, rows.t_ns))
    if columns:
        finite = np.isfinite(np.stack([rows.raw[c].astype(float) for c in columns], axis=1))

        def infinite(row: int) -> str:
            column = columns[int(np.flatnonzero(~finite[row])[0])]
            return f"column {column!r} is {rows.raw[column][row]}"

        rows.refuse(np.asarray(~finite.all(axis=1)), infinite, "not finite")
    if sigma_columns:
        values = np.stack([rows.raw[c] for c in sigma_columns], axis=1)
        bad_sigma = np.asarray(~(values > 0).all(axis=1))
        rows.refuse(
            bad_sigma,
            lambda row: f"sigma must be positive, found {values[row]}",
            "without a positive sigma",
        )
    early = np.asarray(rows.received_ns < rows.t_ns)
    rows.refuse(early, lambda row: "received before it was true", "received before they were true")
    return rows


def _stray(t_ns: TimeArray) -> Mask:
    """Return the fewest rows without which times increase; of two such choices, the one that keeps the earlier rows."""
    late = np.zeros(len(t_ns), bool)
    late[1:] = t_ns[1:] <= np.maximum.accumulate(t_ns)[:-1]
    if not late.any():
        return late
    last: list[int] = []  # of the increasing runs of length 1, 2, …: the least last time
    rank = []  # of each row: the longest run that ends there, less one
    for t in t_ns.tolist():
        rank.append(bisect_left(last, t))
        last[rank[-1] : rank[-1] + 1] = [t]
    if len(last) == np.count_nonzero(~late):
        return late
    stray = np.ones(len(t_ns), bool)
    wanted, below = len(last) - 1, last[-1] + 1
    for row in range(len(t_ns) - 1, -1, -1):
        if rank[row] == wanted and t_ns[row] < below:
            stray[row] = False
            wanted, below = wanted - 1, t_ns[row]
    return stray


def _in_order(rows: _Rows, every: int) -> NDArray[np.int64]:
    """Refuse times out of order; return which of the rows (as they were) are left, every n-th of them."""
    t_ns = rows.t_ns
    stray = _stray(t_ns)

    def out_of_order(row: int) -> str:
        if row == 0 or t_ns[row] > t_ns[row - 1]:
            return f"time {t_ns[row]} ns is ahead of rows below"
        how = "repeats" if t_ns[row] == t_ns[row - 1] else "comes before"
        return f"time {t_ns[row]} ns {how} the row above"

    lost = np.count_nonzero(stray & ~np.isin(t_ns, t_ns[~stray]))  # a row that repeats a time is no loss
    if rows.opening.repair and 2 * lost > len(t_ns):
        raise DatasetError(
            f"{rows.opening.folder}: {rows.stream}: {lost} of {len(t_ns)} rows are out of order, too many to drop; "
            "check the column of its time"
        )
    rows.refuse(stray, out_of_order, "out of order")
    left = np.flatnonzero(~stray)[::every]
    if every > 1:
        mask = np.zeros(len(rows.t_ns), bool)
        mask[::every] = True
        rows.opening.notes.append(f"{rows.stream}: every {every}th row kept, {int(mask.sum())} of {len(mask)}")
        rows.keep(mask)
    return left


def _without_outliers(rows: _Rows, outliers: d.Outliers | None, values: Array, unit: str) -> Array:
    """Drop rows whose norm exceeds the bound; return the remaining values."""
    if outliers is None:
        return values
    chosen = list(range(values.shape[1])) if outliers.components is None else list(outliers.components)
    if max(chosen, default=0) >= values.shape[1]:
        raise DatasetError(f"{rows.opening.folder}: {rows.stream}: outliers: it has {values.shape[1]} components only")
    far = np.linalg.norm(values[:, chosen], axis=1) > outliers.above
    rows.note(int(np.count_nonzero(far)), f"over {outliers.above:g} {unit}")
    rows.keep(~far)
    return values[~far]


def _sigma(rows: _Rows, part: Any, width: int) -> Array:
    """Return (n, width), SI."""
    if part.sigma is not None:
        sigma = rows.si(part.sigma)
        return sigma if sigma.shape[1] == width else np.repeat(sigma, width, axis=1)
    fixed = np.asarray(getattr(part, part.sigma_field), float)
    if part.sigma_field == "sigma_deg":
        fixed = np.radians(fixed)
    return np.tile(np.broadcast_to(fixed, (width,)), (len(rows.t_ns), 1))


def _checked_width(rows: _Rows, part: Any, width: int) -> None:
    if part.sigma is not None and len(part.sigma.columns) not in (1, width):
        raise DatasetError(f"{rows.opening.folder}: {rows.stream}: sigma: expected {width} columns")


def _flu(values: Array, axes: str) -> Array:
    return values * FLIP_YZ if axes == "FRD" else values


def _enu(values: Array, frame: str) -> Array:
    return np.stack([values[:, 1], values[:, 0], -values[:, 2]], axis=1) if frame == "NED" else values


def _imu(opening: _Opening, part: d.ImuDescription) -> ImuStream:
    if part.accel_source is not None:
        t_ns, gyro, accel = _gyro_and_accel(opening, part, part.accel_source)
    else:
        rows = _stream(opening, "imu", part, [*part.gyro.columns, *part.accel.columns])
        _in_order(rows, part.every)
        t_ns, gyro, accel = rows.t_ns, rows.si(part.gyro), rows.si(part.accel)
    with _named(opening.folder):
        return ImuStream(t_ns, _flu(gyro, part.axes), _flu(accel, part.axes))


def _gyro_and_accel(
    opening: _Opening, part: d.ImuDescription, source: d.SourceDescription
) -> tuple[TimeArray, Array, Array]:
    """Return the gyro's times and samples, and the accelerometer's interpolated linearly to them.

    A gyro sample without accelerometer samples on both sides, within two of their periods, is dropped and counted.
    """
    rows = _stream(opening, "imu", part, list(part.gyro.columns))
    _in_order(rows, 1)
    other = _stream(opening, "imu", source, list(part.accel.columns))
    _in_order(other, 1)
    accel, gyro = other.si(part.accel), rows.si(part.gyro)
    if len(other.t_ns) < 2:
        raise DatasetError(f"{opening.folder}: imu: {len(other.t_ns)} accelerometer rows, at least 2 are needed")
    after = np.searchsorted(other.t_ns, rows.t_ns).clip(1, len(other.t_ns) - 1)
    step = other.t_ns[after] - other.t_ns[after - 1]
    weight = (rows.t_ns - other.t_ns[after - 1]) / step
    alone = (weight < 0) | (weight > 1) | ((step > 2 * np.median(np.diff(other.t_ns))) & (weight % 1 != 0))
    rows.note(int(np.count_nonzero(alone)), "of the gyro without the accelerometer's beside them")
    at, share = after[~alone], weight[~alone, None]
    accel = accel[at - 1] * (1 - share) + accel[at] * share
    kept = slice(None, None, part.every)
    return rows.t_ns[~alone][kept], gyro[~alone][kept], accel[kept]


def _dvl(opening: _Opening, part: d.DvlDescription) -> DvlStream:
    rows = _stream(opening, "dvl", part, list(part.velocity.columns))
    measured = ["xyz".index(axis) for axis in part.measures]
    _checked_width(rows, part, len(measured))
    values = _without_outliers(rows, part.outliers, rows.si(part.velocity), "m/s")
    values = values[_in_order(rows, part.every)]
    v_S, sigma = np.zeros((len(values), 3)), np.full((len(values), 3), np.inf)
    v_S[:, measured], sigma[:, measured] = values, _sigma(rows, part, len(measured))
    v_S = _flu(v_S, part.axes)
    if part.mounting != d.MountingSpec():
        R_BS = part.mounting.mounting().R_BS
        v_S, sigma = v_S @ R_BS.T, _turned(sigma, R_BS)
    return DvlStream(rows.t_ns, rows.received_ns, v_S, sigma)


def _turned(sigma: Array, R_BS: Array) -> Array:
    """Return (n, 3): sigma along B's axes, without the correlations that unequal axes get.

    An infinite sigma makes those axes of B infinite that have a component along it, and no others.
    """
    with np.errstate(invalid="ignore"):
        shares = sigma[:, None, :] ** 2 * R_BS**2
    return np.sqrt(np.where(np.abs(R_BS) < 1e-12, 0.0, shares).sum(axis=2))


def _depth(opening: _Opening, part: d.DepthDescription) -> DepthStream:
    rows = _stream(opening, "depth", part, list(part.depth.columns))
    values = _without_outliers(rows, part.outliers, rows.si(part.depth), "m")
    values = values[_in_order(rows, part.every)]
    z_m = -values if part.positive == "down" else values
    return DepthStream(rows.t_ns, rows.received_ns, z_m, _sigma(rows, part, 1))


def _heading(
    opening: _Opening, part: d.HeadingDescription, origin: tuple[float, float] | None
) -> HeadingStream | AttitudeStream:
    if part.attitude is not None:
        rows = _stream(opening, "heading", part, list(part.attitude.columns))
        _checked_width(rows, part, 3)
        R = _rotations(rows, part.attitude, origin)
        R = R[_in_order(rows, part.every)]
        return AttitudeStream(rows.t_ns, rows.received_ns, R.reshape(-1, 9), _sigma(rows, part, 3))
    assert part.heading is not None
    rows = _stream(opening, "heading", part, list(part.heading.columns))
    _checked_width(rows, part, 1)
    psi = rows.si(part.heading)
    if part.add_deg:
        psi = psi + np.radians(part.add_deg)
    if part.convention == "compass":
        psi = np.pi / 2 - psi
        psi = np.arctan2(np.sin(psi), np.cos(psi))
    psi = _without_outliers(rows, part.outliers, psi, "rad")
    psi = psi[_in_order(rows, part.every)]
    return HeadingStream(rows.t_ns, rows.received_ns, psi, _sigma(rows, part, 1))


def _not_rotations(R: Array) -> Mask:
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        return np.asarray(~(off < 1e-6) | ~(np.linalg.det(R) > 0))


def _enu_from_ecef(rows: _Rows, origin: tuple[float, float] | None) -> Array:
    """Return (3, 3): rows are east, north and up at W's origin, in ECEF axes."""
    if origin is None:
        raise DatasetError(f"{rows.opening.folder}: {rows.stream}: ECEF axes need W's origin; give `origin`")
    return enu_axes(np.array(origin[0]), np.array(origin[1]))


def _rotations(rows: _Rows, part: d.Attitude, origin: tuple[float, float] | None) -> Array:
    """Return (n, 3, 3), body FLU to W; refuse what is not a rotation."""
    values = np.stack([rows.raw[c] for c in part.columns], axis=1).astype(float, copy=False)
    if part.form == "roll_pitch_yaw":
        angles = np.radians(values) if part.unit == "deg" else values
        R = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix().reshape(-1, 3, 3)
    elif part.form == "matrix":
        R = values.reshape(-1, 3, 3)
        bad = _not_rotations(R)
        rows.refuse(bad, lambda row: f"not a rotation matrix: {values[row]}", "that are not rotations")
        R = R[~bad]
    else:
        with np.errstate(over="ignore"):
            length = np.linalg.norm(values, axis=1)
        bad = ~(np.abs(length - 1) < 1e-3)
        rows.refuse(
            bad, lambda row: f"not a unit quaternion (|q| = {length[row]:.6g})", "that are not unit quaternions"
        )
        q_xyzw = values[~bad] if part.form == "quaternion_xyzw" else np.roll(values[~bad], -1, axis=1)
        R = Rotation.from_quat(q_xyzw).as_matrix().reshape(-1, 3, 3)
    if part.world == "NED":
        R = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ R
    elif part.world == "ECEF":
        R = _enu_from_ecef(rows, origin) @ R
    return R * FLIP_YZ if part.axes == "FRD" else R


def _position_columns(part: Any) -> list[d.Column]:
    columns: list[d.Column] = [] if part.position is None else list(part.position.columns)
    if part.geodetic is not None:
        columns += [part.geodetic.latitude, part.geodetic.longitude]
        columns += [] if part.geodetic.altitude is None else list(part.geodetic.altitude.columns)
    return columns


def _truth_columns(part: d.TruthDescription) -> list[d.Column]:
    columns = _position_columns(part)
    columns += [] if part.velocity is None else list(part.velocity.columns)
    return columns + ([] if part.attitude is None else list(part.attitude.columns))


def degrees_from_ddmm(ddmm: Array) -> Array:
    """Return degrees from degrees · 100 + minutes, sign kept."""
    degrees = np.trunc(ddmm / 100)
    return degrees + (ddmm - 100 * degrees) / 60


def _latitude_longitude(rows: _Rows, part: d.Geodetic) -> tuple[Array, Array]:
    """Return radians; refuse impossible latitudes and longitudes."""

    def convert() -> tuple[Array, Array]:
        lat, lon = rows.raw[part.latitude].astype(float), rows.raw[part.longitude].astype(float)
        if part.unit == "ddmm":
            lat, lon = degrees_from_ddmm(lat), degrees_from_ddmm(lon)
        return (lat, lon) if part.unit == "rad" else (np.radians(lat), np.radians(lon))

    lat, lon = convert()
    bad = ~((np.abs(lat) <= np.pi / 2) & (np.abs(lon) <= 2 * np.pi))
    rows.refuse(
        bad,
        lambda row: f"no place on earth: {rows.raw[part.latitude][row]}, {rows.raw[part.longitude][row]} ({part.unit})",
        "at no place on earth",
    )
    return lat[~bad], lon[~bad]


def _on_the_globe(rows: _Rows, part: Any) -> tuple[Array, Array, Array | None]:
    """Return latitude, longitude (rad) and height (m, or None) of rows with a global position."""
    if part.geodetic is None:
        p_ecef = rows.si(part.position)
        far = ~(np.abs(np.linalg.norm(p_ecef, axis=1) - SEMI_MAJOR_M) < FAR_M)
        rows.refuse(
            far,
            lambda row: f"no place on earth: ({', '.join(f'{x:g}' for x in p_ecef[row])}) m, ECEF",
            "at no place on earth",
        )
        return geodetic_from_ecef(p_ecef[~far])
    lat, lon = _latitude_longitude(rows, part.geodetic)  # may drop rows, so it comes first
    return lat, lon, None if part.geodetic.altitude is None else rows.si(part.geodetic.altitude)[:, 0]


def _offset(rows: _Rows, part: Any) -> Array | None:
    """Return (n, 3) m, the local offset from the global position; None without one."""
    return None if part.geodetic is None or part.position is None else _enu(rows.si(part.position), part.frame)


def _first_fix(part: Any, rows: _Rows, start_ns: int) -> tuple[float, float] | None:
    """Return latitude and longitude (rad) of the first row at or after the IMU's start, local offset included."""
    lat, lon, _ = _on_the_globe(rows, part)
    after = np.flatnonzero(rows.t_ns >= start_ns)
    if not len(after):
        return None
    row = after[:1]
    p_ecef = ecef_from_geodetic(lat[row], lon[row], np.zeros(1))
    offset = _offset(rows, part)
    if offset is not None:
        p_ecef = p_ecef + np.einsum("nji,nj->ni", enu_axes(lat[row], lon[row]), offset[row] * [1.0, 1.0, 0.0])
    latitude, longitude, _ = geodetic_from_ecef(p_ecef)
    return float(latitude[0]), float(longitude[0])


def _position(rows: _Rows, part: Any, origin: tuple[float, float] | None) -> Array:
    """Return (n, 3) m in W. Heights are above the sea surface, as those of the depth sensor, not the tangent plane."""
    if not part.on_the_globe:
        return _enu(rows.si(part.position), part.frame)
    lat, lon, height = _on_the_globe(rows, part)
    if origin is None:
        raise DatasetError(f"{rows.opening.folder}: {rows.stream}: no fix after the IMU's start; give `origin`")
    p = enu_from_geodetic(lat, lon, np.zeros(len(lat)), (*origin, 0.0))
    p[:, 2] = 0.0 if height is None else height
    offset = _offset(rows, part)
    return p if offset is None else p + offset


def _gps(part: d.GpsDescription, rows: _Rows, origin: tuple[float, float] | None) -> GpsStream:
    _checked_width(rows, part, 3)
    p_WG_W = _position(rows, part, origin)
    p_WG_W = _without_outliers(rows, part.outliers, p_WG_W, "m")
    p_WG_W = p_WG_W[_in_order(rows, part.every)]
    sigma = _sigma(rows, part, 3)
    if part.position is None and part.geodetic is not None and part.geodetic.altitude is None:
        sigma[:, 2] = np.inf
    return GpsStream(rows.t_ns, rows.received_ns, p_WG_W, sigma)


def _truth(
    opening: _Opening, part: d.TruthDescription, rows: _Rows | None, origin: tuple[float, float] | None
) -> Trajectory:
    if part.tum is not None:
        return Trajectory.from_tum(opening.folder / part.tum, part.lookahead_s)
    if part.trajectory is not None:
        return _read_trajectory(opening.folder / part.trajectory, part.lookahead_s)
    assert rows is not None
    R = None if part.attitude is None else _rotations(rows, part.attitude, origin)  # may drop rows, so it comes first
    before = rows.number
    p = _position(rows, part, origin)
    if part.height_m is not None:
        p[:, 2] = part.height_m
    R = np.full((len(p), 3, 3), np.nan) if R is None else R[np.isin(before, rows.number)]
    velocity = None if part.velocity is None else rows.si(part.velocity)
    if velocity is not None:
        velocity = velocity @ _enu_from_ecef(rows, origin).T if part.frame == "ECEF" else _enu(velocity, part.frame)
    left = _in_order(rows, part.every)
    v_WB_W = None if velocity is None else velocity[left]
    return Trajectory(rows.t_ns, R[left], p[left], v_WB_W, lookahead_s=part.lookahead_s)


def _read_trajectory(path: Path, lookahead_s: float) -> Trajectory:
    import pandas as pd

    if not path.is_file():
        raise DatasetError(f"{path}: no such file")
    try:
        frame = pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path, **EXACT)
        truth = Trajectory.from_pandas(frame, lookahead_s)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None
    except KeyError as error:
        raise DatasetError(f"{path}: missing columns: {error}") from None
    except Exception as error:  # pandas and pyarrow raise many kinds for a file that is not what it seems
        raise DatasetError(f"{path}: cannot be read as a trajectory: {str(error)[:200]}") from None
    bad = np.flatnonzero(~np.isfinite(truth.p_WB_W).all(axis=1))
    if len(bad):
        raise DatasetError(f"{path}: row {bad[0]} ({len(bad)} in all): position is {truth.p_WB_W[bad[0]]}")
    unknown = np.isnan(truth.R_WB).all(axis=(1, 2))
    bad = np.flatnonzero(_not_rotations(truth.R_WB) & ~unknown)
    if len(bad):
        raise DatasetError(
            f"{path}: row {bad[0]} ({len(bad)} in all): R_WB is not a rotation: {truth.R_WB[bad[0]].ravel()}"
        )
    return truth
