"""Positions of a description in W, from latitude and longitude, from earth-centred or from local axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..notes import Note
from ..places import angle, is_place, radians, sexagesimal, turned_by
from ..state import Array
from . import description as d
from .geodesy import SEMI_MAJOR_M, ecef_from_geodetic, enu_axes, enu_from_geodetic, geodetic_from_ecef
from .rows import Rows, number_or_nan, read_rows
from .sources import Opening

FAR_M = 100e3
"""From a spherical Earth of the semi-major axis: the ellipsoid is within 21 km of it, and a receiver without a fix
reports (0, 0, 0)."""
NEAR_RAD = np.radians(1.0)
"""Within 1° of latitude and longitude 0, a place of exactly 0, 0 may be one, and is none reported without a fix."""
HEMISPHERES = {"NS": ("N", "S", "NORTH", "SOUTH"), "EW": ("E", "W", "EAST", "WEST")}
"""What a column of hemispheres may hold, in letters of either case."""
GUESSES = (("degE7", 1_800_000.0), ("ddmmss", 18_000.0), ("ddmm", 90.0))
"""The unit in which a latitude above this probably is: 180° are 18,000 in ddmm, and 1,800,000 in ddmmss."""


def enu(values: Array, frame: str) -> Array:
    """Return (n, 3) in east, north, up; ECEF axes stay."""
    return np.stack([values[:, 1], values[:, 0], -values[:, 2]], axis=1) if frame == "NED" else values


def enu_from_ecef(rows: Rows, origin: tuple[float, float] | None) -> Array:
    """Return (3, 3): rows are east, north and up at W's origin, in ECEF axes."""
    if origin is None:
        raise rows.error("ECEF axes need W's origin; give `origin`")
    return enu_axes(np.array(origin[0]), np.array(origin[1]))


def position_rows(opening: Opening, stream: str, part: Any, others: tuple[d.Column, ...] = ()) -> Rows:
    """Read the rows of a part with positions (and the columns of `others`); refuse those at no place on Earth.

    The rows have the values "latitude" and "longitude" (rad) if the position is global, and "height_m" if it has one.
    """
    position: d.Quantity | None = part.position
    numbers = [] if position is None else list(position.columns)
    geodetic: d.Geodetic | None = part.geodetic
    if geodetic is not None and geodetic.altitude is not None:
        numbers += geodetic.altitude.columns
    rows = read_rows(opening, stream, part, [*numbers, *others], () if geodetic is None else geodetic.columns)
    if geodetic is not None:
        _locate(rows, geodetic)
    elif position is not None and part.on_the_globe:
        _locate_ecef(rows, position)
    return rows


def _locate(rows: Rows, part: d.Geodetic) -> None:
    _refuse_no_hemisphere(rows, part.north_south, "NS")
    _refuse_no_hemisphere(rows, part.east_west, "EW")
    scales = np.broadcast_to(part.scale, (2,))
    latitude = _angle(rows, part.latitude, part.unit, float(scales[0]), "NS", part.north_south)
    longitude = _angle(rows, part.longitude, part.unit, float(scales[1]), "EW", part.east_west)
    rows.values |= {"latitude": latitude, "longitude": longitude}
    if part.signs_unsaid and len(latitude) and not (latitude < 0).any() and not (longitude < 0).any():
        text = (
            f"{rows.stream}: all places are taken for north and east, since {part.unit} has no sign; `north_south` and "
            "`east_west` name the columns of hemispheres, and `scale: [1, -1]` turns east to west"
        )
        rows.opening.notes.append(Note(text, "check", rows.stream))
    there = is_place(np.degrees(latitude), np.degrees(longitude))
    zero = (latitude == 0) & (longitude == 0)
    nowhere = zero & _away_from_zero(latitude, longitude, there & ~zero)

    def found(row: int) -> str:
        told = ", ".join(str(rows.raw[column][row]) for column in part.columns)
        hint = "; as a receiver without a fix reports" if nowhere[row] else _guess(rows, part, row)
        return f"no place on earth: {told} ({part.unit}){hint}"

    if part.altitude is not None:
        rows.values["height_m"] = rows.si(part.altitude)[:, 0]
    rows.refuse(~there | nowhere, found, "at no place on earth")


def _refuse_no_hemisphere(rows: Rows, column: d.Column | None, signs: str) -> None:
    if column is None:
        return
    known = [isinstance(text, str) and text.strip().upper() in HEMISPHERES[signs] for text in rows.raw[column]]
    rows.refuse(
        ~np.array(known, bool),
        lambda row: f"no hemisphere: column {column!r} is {_held(rows.raw[column][row])}, not {signs[0]} or {signs[1]}",
        "without a hemisphere",
    )


def _held(value: Any) -> str:
    return repr(str(value))[:40] if isinstance(value, str) else "empty" if np.isnan(value) else str(value)


def _away_from_zero(latitude: Array, longitude: Array, rows: NDArray[np.bool_]) -> bool:
    """Return whether the median place of some rows is not near latitude and longitude 0."""
    return bool(rows.any()) and np.hypot(np.median(latitude[rows]), np.median(longitude[rows])) > NEAR_RAD


def _angle(
    rows: Rows, columns: d.Column | tuple[d.Column, ...], unit: str, scale: float, signs: str, letters: d.Column | None
) -> Array:
    """Return (n,) rad of an angle, from its column (or those of degrees, minutes, seconds) and its hemispheres."""
    if isinstance(columns, tuple):
        values = np.radians(sexagesimal([_floats(rows.raw[column]) for column in columns]) * scale)
    else:
        raw = rows.raw[columns]
        values = radians(_floats(raw) * scale, unit)
        if raw.dtype.kind == "T":
            for row in np.flatnonzero(np.isnan(values)).tolist():
                values[row] = scale * angle(raw[row], unit, signs) if isinstance(raw[row], str) else np.nan
    return values if letters is None else turned_by([str(letter) for letter in rows.raw[letters]], signs, values)


def _floats(raw: NDArray[Any]) -> Array:
    """Return numbers as read, NaN where they are none."""
    return np.array([number_or_nan(text) for text in raw]) if raw.dtype.kind == "T" else raw.astype(float)


def _guess(rows: Rows, part: d.Geodetic, row: int) -> str:
    """Return which unit a place is probably in."""
    if part.unit != "deg" or isinstance(part.latitude, tuple):
        return ""
    size = abs(_floats(rows.raw[part.latitude][row : row + 1])[0])
    unit = next((unit for unit, above in GUESSES if size > above), "")
    return f"; unit: {unit}?" if unit else ""


def _locate_ecef(rows: Rows, quantity: d.Quantity) -> None:
    p_ecef = rows.si(quantity)
    with np.errstate(over="ignore", invalid="ignore"):
        latitude, longitude, height_m = geodetic_from_ecef(p_ecef)
    rows.values |= {"latitude": latitude, "longitude": longitude, "height_m": height_m}
    rows.refuse(
        ~(np.abs(np.linalg.norm(p_ecef, axis=1) - SEMI_MAJOR_M) < FAR_M),
        lambda row: f"no place on earth: ({', '.join(f'{x:g}' for x in p_ecef[row])}) m, ECEF",
        "at no place on earth",
    )


def _offset(rows: Rows, part: Any) -> Array | None:
    """Return (n, 3) m, the local offset from the global position; None without one."""
    return None if part.geodetic is None or part.position is None else enu(rows.si(part.position), part.frame)


def first_fix(part: Any, rows: Rows, start_ns: int) -> tuple[float, float] | None:
    """Return latitude and longitude (rad) of the first row at or after the IMU's start, local offset included."""
    after = np.flatnonzero(rows.t_ns >= start_ns)
    if not len(after):
        return None
    row = after[:1]
    lat, lon = rows.values["latitude"][row], rows.values["longitude"][row]
    p_ecef = ecef_from_geodetic(lat, lon, np.zeros(1))
    offset = _offset(rows, part)
    if offset is not None:
        p_ecef = p_ecef + np.einsum("nji,nj->ni", enu_axes(lat, lon), offset[row] * [1.0, 1.0, 0.0])
    latitude, longitude, _ = geodetic_from_ecef(p_ecef)
    return float(latitude[0]), float(longitude[0])


def position(rows: Rows, part: Any, origin: tuple[float, float] | None) -> Array:
    """Return (n, 3) m in W. Heights are above the sea surface, as those of the depth sensor, not the tangent plane."""
    if not part.on_the_globe:
        return enu(rows.si(part.position), part.frame)
    if origin is None:
        raise rows.error("no fix after the IMU's start; give `origin`")
    latitude = rows.values["latitude"]
    p = enu_from_geodetic(latitude, rows.values["longitude"], np.zeros(len(latitude)), (*origin, 0.0))
    p[:, 2] = rows.values.get("height_m", 0.0)
    offset = _offset(rows, part)
    return p if offset is None else p + offset
