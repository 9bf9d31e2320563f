"""From a description and a folder to a Log: rows are read, checked, and converted to our frames and units.

The steps are the same for every stream. Rows declared invalid or outside the window are dropped. Rows with numbers
that are not finite are an error, or dropped with `repair`. Declared outliers are dropped. Times out of order are an
error, or dropped with `repair`. Of means that overlap, those are kept that do not; of these, every n-th. `Log.notes`
counts all that was dropped. A truth or a stream that does not overlap the IMU's time is an error: some clock is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import DatasetError
from ..files import inside
from ..formats.tables.parquet import read_known
from ..formats.tables.text_table import EXACT
from ..log import AttitudeStream, DepthStream, DvlStream, GpsStream, HeadingStream, Log
from ..notes import Note
from ..rig import Rig
from ..rotations import (
    complaint,
    complaint_of_quaternion,
    is_rotation,
    note,
    off_rotation,
    off_unit,
    orthonormalised,
)
from ..state import Array
from ..trajectory import COLUMNS, Trajectory
from . import description as d
from .inertial import FLIP_YZ, flu, read_imu
from .positions import enu, enu_from_ecef, first_fix, position, position_rows
from .rows import Rows, check_width, drop_outliers, read_rows, sigma
from .sources import Opening, wrong_clock


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
    opening = Opening(description, folder, repair)
    streams = description.streams
    imu = read_imu(opening, streams.imu)
    dvl = None if streams.dvl is None else _dvl(opening, streams.dvl)
    depth = None if streams.depth is None else _depth(opening, streams.depth)
    gps_rows = None if streams.gps is None else position_rows(opening, "gps", streams.gps)
    truth_part, truth_rows = description.truth, None
    if truth_part is not None and (truth_part.table or truth_part.message):
        others = [part.columns for part in (truth_part.velocity, truth_part.attitude) if part is not None]
        truth_rows = position_rows(opening, "truth", truth_part, tuple(chain(*others)))

    origin = None
    if description.origin is not None:
        origin = (np.radians(description.origin.latitude_deg), np.radians(description.origin.longitude_deg))
    else:
        for part, rows in ((streams.gps, gps_rows), (truth_part, truth_rows)):
            if origin is None and part is not None and part.on_the_globe and rows is not None:
                origin = first_fix(part, rows, int(imu.t_ns[0]))
    if description.origin is None and streams.gps is not None and streams.gps.on_the_globe and truth_part is not None:
        opening.notes += _origin_unsaid(truth_part)
    gps = None if gps_rows is None or streams.gps is None else _gps(streams.gps, gps_rows, origin)
    heading = None if streams.heading is None else _heading(opening, streams.heading, origin)
    truth = None
    if truth_part is not None:
        truth = _truth(opening, truth_part, truth_rows, origin)
        opening.notes += map(_of_truth, truth.notes)
    for name, part in description.parts.items():
        mounting = getattr(part, "mounting", None)
        opening.notes += () if mounting is None else mounting.notes(name)
    opening.notes += () if description.prior is None else description.prior.notes

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


def _origin_unsaid(truth: d.TruthDescription) -> list[Note]:
    """Return that W begins at the first fix of the GPS, while the truth has an origin of its own."""
    if truth.on_the_globe:
        return []
    text = (
        "W begins at the first fix of the GPS, with its error, while the truth is in local axes whose origin is "
        "not said; state `origin`, the place of the truth's zero"
    )
    return [Note(text, "check", "truth")]


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
                wrong_clock(name, (int(part.t_ns[0]), int(part.t_ns[-1])), (int(log.imu.t_ns[0]), end_ns))
            )


def _dvl(opening: Opening, part: d.DvlDescription) -> DvlStream:
    rows = read_rows(opening, "dvl", part, list(part.velocity.columns))
    measured = ["xyz".index(axis) for axis in part.measures]
    check_width(rows, part, len(measured))
    rows.values["z"] = rows.si(part.velocity)
    drop_outliers(rows, part.outliers, "z", "m/s")
    rows.put_in_order(part.every, part.averaged_over_s)
    v_S, spread = np.zeros((len(rows.t_ns), 3)), np.full((len(rows.t_ns), 3), np.inf)
    v_S[:, measured], spread[:, measured] = rows.values["z"], sigma(rows, part, len(measured))
    v_S = flu(v_S, part.axes)
    if part.mounting != d.MountingSpec():
        R_BS = part.mounting.mounting().R_BS
        v_S, spread = v_S @ R_BS.T, _turned(spread, R_BS)
    return DvlStream(rows.t_ns, rows.received_ns, v_S, spread)


def _turned(sigma: Array, R_BS: Array) -> Array:
    """Return (n, 3): sigma along B's axes, without the correlations that unequal axes get.

    An infinite sigma makes those axes of B infinite that have a component along it, and no others.
    """
    with np.errstate(invalid="ignore"):
        shares = sigma[:, None, :] ** 2 * R_BS**2
    return np.sqrt(np.where(np.abs(R_BS) < 1e-12, 0.0, shares).sum(axis=2))


def _depth(opening: Opening, part: d.DepthDescription) -> DepthStream:
    rows = read_rows(opening, "depth", part, list(part.depth.columns))
    rows.values["z"] = rows.si(part.depth)
    drop_outliers(rows, part.outliers, "z", "m")
    rows.put_in_order(part.every, part.averaged_over_s)
    z_m = -rows.values["z"] if part.positive == "down" else rows.values["z"]
    return DepthStream(rows.t_ns, rows.received_ns, z_m, sigma(rows, part, 1))


def _heading(
    opening: Opening, part: d.HeadingDescription, origin: tuple[float, float] | None
) -> HeadingStream | AttitudeStream:
    if part.attitude is not None:
        rows = read_rows(opening, "heading", part, list(part.attitude.columns))
        check_width(rows, part, 3)
        _put_rotations(rows, part.attitude, origin)
        rows.put_in_order(part.every, part.averaged_over_s)
        return AttitudeStream(rows.t_ns, rows.received_ns, rows.values["R"].reshape(-1, 9), sigma(rows, part, 3))
    assert part.heading is not None
    rows = read_rows(opening, "heading", part, list(part.heading.columns))
    check_width(rows, part, 1)
    psi = rows.si(part.heading)
    if part.add_deg:
        psi = psi + np.radians(part.add_deg)
    if part.convention == "compass":
        psi = np.pi / 2 - psi
        psi = np.arctan2(np.sin(psi), np.cos(psi))
    rows.values["z"] = psi
    drop_outliers(rows, part.outliers, "z", "rad")
    rows.put_in_order(part.every, part.averaged_over_s)
    return HeadingStream(rows.t_ns, rows.received_ns, rows.values["z"], sigma(rows, part, 1))


def _put_rotations(rows: Rows, part: d.Attitude, origin: tuple[float, float] | None) -> None:
    """Put the value "R" (n, 3, 3), body FLU to W; refuse what is not a rotation."""
    values = np.stack([rows.raw[c] for c in part.columns], axis=1).astype(float, copy=False)
    if part.form == "roll_pitch_yaw":
        angles = np.radians(values) if part.unit == "deg" else values
        R = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix().reshape(-1, 3, 3)
    elif part.form == "matrix":
        R = values.reshape(-1, 3, 3)
        off = off_rotation(R)
        good = is_rotation(off)
        rows.refuse(~good, lambda row: complaint(R[row]), "without a rotation")
        rows.opening.notes += note(rows.stream, off[good], rows.stream)
        R = orthonormalised(R[good], off[good])
    else:
        off = off_unit(values)
        good = is_rotation(off)
        rows.refuse(~good, lambda row: complaint_of_quaternion(values[row]), "without a unit quaternion")
        rows.opening.notes += note(rows.stream, off[good], rows.stream)
        q_xyzw = values[good] if part.form == "quaternion_xyzw" else np.roll(values[good], -1, axis=1)
        R = Rotation.from_quat(q_xyzw).as_matrix().reshape(-1, 3, 3)
    if part.world == "NED":
        R = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ R
    elif part.world == "ECEF":
        R = enu_from_ecef(rows, origin) @ R
    rows.values["R"] = R * FLIP_YZ if part.axes == "FRD" else R


def _gps(part: d.GpsDescription, rows: Rows, origin: tuple[float, float] | None) -> GpsStream:
    check_width(rows, part, 3)
    rows.values["z"] = position(rows, part, origin)
    drop_outliers(rows, part.outliers, "z", "m")
    rows.put_in_order(part.every, part.averaged_over_s)
    spread = sigma(rows, part, 3)
    if part.position is None and part.geodetic is not None and part.geodetic.altitude is None:
        spread[:, 2] = np.inf
    return GpsStream(rows.t_ns, rows.received_ns, rows.values["z"], spread)


def _truth(
    opening: Opening, part: d.TruthDescription, rows: Rows | None, origin: tuple[float, float] | None
) -> Trajectory:
    if rows is None:
        if part.tum is not None:
            truth = Trajectory.from_tum(inside(opening.folder, part.tum), part.lookahead_s)
        else:
            truth = _read_trajectory(inside(opening.folder, str(part.trajectory)), part.lookahead_s)
        return truth.select(opening.window("truth", part, truth.t_ns))
    if part.attitude is not None:
        _put_rotations(rows, part.attitude, origin)
    p = rows.values["p"] = position(rows, part, origin)
    if part.height_m is not None:
        p[:, 2] = part.height_m
    if part.velocity is not None:
        v = rows.si(part.velocity)
        rows.values["v"] = v @ enu_from_ecef(rows, origin).T if part.frame == "ECEF" else enu(v, part.frame)
    rows.put_in_order(part.every)
    found = rows.values
    R = found["R"] if "R" in found else np.full((len(rows.t_ns), 3, 3), np.nan)
    return Trajectory(rows.t_ns, R, found["p"], found.get("v"), lookahead_s=part.lookahead_s)


def _of_truth(mended: Note) -> Note:
    """Return what was mended in a trajectory as a note on the truth of a log."""
    return Note(f"truth: {mended.removeprefix('trajectory: ')}", mended.kind, "truth", mended.count, mended.of)


def _read_trajectory(path: Path, lookahead_s: float) -> Trajectory:
    import pandas as pd

    try:
        if path.suffix == ".parquet":
            frame = read_known(path, COLUMNS)
        else:
            with path.open("rb") as file:  # of a name alone pandas might make an address or a home
                frame = pd.read_csv(file, usecols=lambda name: name in COLUMNS, **EXACT)
        truth = Trajectory.from_pandas(frame, lookahead_s).with_times_checked().with_rotations()
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None
    except KeyError as error:
        raise DatasetError(f"{path}: missing columns: {error}") from None
    except Exception as error:  # pandas and pyarrow raise many kinds for a file that is not what it seems
        raise DatasetError(f"{path}: cannot be read as a trajectory: {str(error)[:200]}") from None
    bad = np.flatnonzero(~np.isfinite(truth.p_WB_W).all(axis=1))
    if len(bad):
        raise DatasetError(f"{path}: row {bad[0]} ({len(bad)} in all): position is {truth.p_WB_W[bad[0]]}")
    return truth
