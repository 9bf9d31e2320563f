"""Latitudes and longitudes: what a text of one says, and which of them are on Earth. Asked wherever one is given."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .state import Array

MOST_LATITUDE_DEG, MOST_LONGITUDE_DEG = 90.0, 360.0
"""The poles; charts count longitudes from −180° to 180° or from 0° to 360°, some of them westwards."""
UNITS = ("deg", "rad", "ddmm", "ddmmss", "degE7")
"""ddmm is degrees · 100 + minutes, as NMEA writes it; ddmmss has seconds too; degE7 is 1e-7°, as MAVLink writes it."""
LONGEST_TEXT = 40
"""Characters of a latitude in words: 41°11'06.123456789" N has 20."""
ANGLE = re.compile(
    r"([NSEW]?)\s*([-+]?)(\d+\.?\d*|\.\d+)(?:\s*[°º:d ]\s*(\d+\.?\d*))?(?:\s*['′’:m ]\s*(\d+\.?\d*))?"
    r"\s*[°º'′’\"″”]{0,2}\s*([NSEW]?)",
    re.IGNORECASE,
)
"""A hemisphere or a sign, degrees, and perhaps minutes and seconds; or the hemisphere at the end."""


def radians(values: Array, unit: str) -> Array:
    """Return radians from numbers in one of UNITS, the sign kept; NaN where minutes or seconds are 60 or more."""
    if unit == "rad":
        return values
    if unit in ("deg", "degE7"):
        return np.radians(values * 1e-7 if unit == "degE7" else values)
    rest, parts = np.abs(values), []
    for base in (1e4, 1e2) if unit == "ddmmss" else (1e2,):
        whole = np.trunc(rest / base)
        parts.append(whole)
        rest = rest - whole * base
    return np.radians(np.copysign(sexagesimal([*parts, rest]), values))


def sexagesimal(parts: list[Array]) -> Array:
    """Return degrees from degrees, minutes and perhaps seconds; NaN where these are not in 0 to 60."""
    total = np.abs(parts[0])
    for part, share in zip(parts[1:], (60.0, 3600.0), strict=False):
        total = total + np.where((part >= 0) & (part < 60), part, np.nan) / share
    return np.copysign(total, parts[0])


def angle(text: str, unit: str, hemispheres: str) -> float:
    """Return what a text says, rad: a number in `unit`, or as 41°11'06" N, N 41 11.1 or 41:11:06; else NaN.

    Args:
        text: with a sign, or with one of the two letters of `hemispheres` ("NS" or "EW"), of which the second is
            negative.
        unit: of UNITS; of a number that stands alone.
    """
    try:
        return float(radians(np.array(float(text)), unit))
    except ValueError:
        found = ANGLE.fullmatch(text.strip().upper()) if len(text) <= LONGEST_TEXT else None
    if found is None:
        return math.nan
    before, sign, *numbers, after = found.groups()
    letter = before or after
    if (before and after) or (sign and letter) or (letter and letter not in hemispheres):
        return math.nan
    parts = [np.array(float(number)) for number in numbers if number]
    value = float(radians(parts[0], unit) if len(parts) == 1 else np.radians(sexagesimal(parts)))
    return -value if sign == "-" or (letter and letter == hemispheres[1]) else value


def turned_by(letters: list[str], hemispheres: str, values: Array) -> Array:
    """Return values (n,) with the signs of their hemispheres' letters or words; NaN for others, or a contradiction."""
    first = np.array([letter.strip()[:1].upper() for letter in letters], dtype="<U1")
    negative, positive = first == hemispheres[1], first == hemispheres[0]
    good = (positive & (values >= 0)) | negative
    return np.where(good, np.where(negative, -np.abs(values), values), np.nan)


def is_place(latitude_deg: ArrayLike, longitude_deg: ArrayLike = 0.0) -> NDArray[np.bool_]:
    """Return where a latitude and a longitude, degrees, are a place on Earth; what is not finite is none."""
    with np.errstate(invalid="ignore"):
        north, east = np.abs(latitude_deg), np.abs(longitude_deg)
        return np.asarray((north <= MOST_LATITUDE_DEG) & (east <= MOST_LONGITUDE_DEG))


def degrees_said(value: Any, hemispheres: str) -> Any:
    """Return the degrees of a text as 41°11'06" N; what is no text, as it is.

    Raises:
        ValueError: the text says no such angle.
    """
    if not isinstance(value, str):
        return value
    found = math.degrees(angle(value, "deg", hemispheres))
    if math.isnan(found):
        raise ValueError(f"expected degrees, as 41.185 or 41°11'06\" {hemispheres[0]}, found {value[:LONGEST_TEXT]!r}")
    return found
