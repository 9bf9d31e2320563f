"""Advice as lines of log.yaml: what a finding proposes, put together with what the description says already.

A check knows the log and not its description, so its fix is relative: offsets, delays and add_deg add, scales multiply,
a remark "or X, whichever it is not" chooses the other of two words, and "convention: compass; with yaw X" (or
"positive: down; with up X", "frame: NED; with ENU X") gives the value for each. `resolve` makes absolute lines of it,
which parse, and which are there only if the description with them is valid.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import yaml

from ....datasets.described import description as d
from ....datasets.errors import DatasetError
from ....datasets.quantities import DEGREE
from .finding import Finding

DEFAULTS = {"convention": "compass", "positive": "down", "axes": "FLU", "frame": "ENU"}
"""What a description means where it leaves one of these words out."""
OTHER = {"compass": "yaw", "yaw": "compass", "down": "up", "up": "down", "FLU": "FRD", "FRD": "FLU"}
OTHER |= {"ENU": "NED", "NED": "ENU"}
OTHER |= {"quaternion_xyzw": "quaternion_wxyz", "quaternion_wxyz": "quaternion_xyzw"}
QUANTITIES = {"gyro": d.Rate, "accel": d.Acceleration, "velocity": d.Speeds, "depth": d.Height, "heading": d.Angle}
USUAL = {"gyro": "rad/s", "accel": "m/s^2", "velocity": "m/s", "depth": "m", "heading": "rad"}
"""The unit that a fix of another unit is relative to, or the other way round."""
WORDS = re.compile(r": (mirror|exchange|raise) ")
"""Fixes that stand for keys which only the description tells."""
IN_FILE = {
    "frame": "x is east, y north and z up; from north, east and down exchange x and y, and negate z",
    "mirror latitude and longitude": "negate x and y",
    "mirror latitude": "negate y, which is north",
    "mirror longitude": "negate x, which is east",
    "attitude.form": "a quaternion is x, y, z, w, in this order",
    "exchange": "exchange x and y",
    "raise": "take the difference from z, which is up",
}
"""What to do in a truth's own file, by a word of the fix."""
DEPTH_OFFSET = "streams.depth.depth.offset: {:.3f}  # positive: down; with up {:.3f}"
"""By how much depths are to grow, and heights therefore, m."""
ATTITUDE = "streams.heading.attitude: check form, axes and world, the unit of angles, and the order of the columns"
"""Instead of the keys of a heading."""
Raw = dict[str, Any]
Changes = dict[str, Any]
"""Values by their path in log.yaml."""


def resolved(finding: Finding, description: d.Description) -> Finding:
    """Return a finding whose fix holds absolute lines for a description; one that cannot be so becomes a hint."""
    if not finding.fix:
        return finding
    raw = description.model_dump(mode="json", exclude_unset=True)
    words = in_words(finding.fix, raw)
    lines = None if words else resolve(finding.fix, raw)
    if lines is None and not words and WORDS.search(finding.fix):
        return replace(finding, fix="")  # the message says it
    if lines is None:
        words = words or finding.fix.replace("\n", "; ")
        return replace(finding, fix="", hint="; ".join(filter(None, (words, finding.hint))))
    return replace(finding, fix="\n".join(lines))


def in_words(fix: str, raw: Raw) -> str:
    """Return what to do in words where the keys of a fix are none of this description; else ""."""
    truth, heading = _at(raw, "truth") or {}, _at(raw, "streams.heading") or {}
    if fix.startswith("truth") and not {"table", "message"} & truth.keys():
        said = next((words for key, words in IN_FILE.items() if key in fix), fix.replace("\n", "; "))
        return f"in the truth's own file, since log.yaml has no key for it: {said}"
    if "attitude" in heading and re.match(r"streams\.heading\.(heading|convention|add_deg)", fix):
        return ATTITUDE
    for name, key in (("latitude", "north_south"), ("longitude", "east_west")):
        path = f"{fix.split(': ')[0]}.geodetic.{key}"
        if ": mirror " in fix and name in fix and _at(raw, path) is not None:
            return (
                f"{path}: put the right letter into the column {_at(raw, path)}; or take the key away, and turn the "
                f"sign with {path.removesuffix(key)}scale"
            )
    return ""


def resolve(fix: str, raw: Raw) -> list[str] | None:
    """Return the lines "path: value" that carry out a fix; None if log.yaml has no such key, or not this value."""
    changed = deepcopy(raw)
    changes: Changes = {}
    try:
        for line in fix.split("\n"):
            for path, value in _changes(line, changed).items():
                changes[path] = value
                put(changed, path, value)
        d.check_description(changed, "log.yaml")
    except (DatasetError, yaml.YAMLError, KeyError, TypeError, ValueError):
        return None
    return [f"{path}: {_flow(value)}" for path, value in changes.items()]


def clock_fix(stream: str, late_s: float) -> str:
    """Return the fix that brings a stream onto the IMU's clock, or the IMU onto the others', by how late it is, s."""
    path = "truth" if stream == "truth" else f"streams.{stream}"
    if late_s > 0 and stream not in ("imu", "truth"):
        return f"{path}.time.delay_s: {late_s:.3f}"
    return f"{path}.time.clock_offset_s: {-late_s:.3f}"


def late_or_early(late_s: float) -> str:
    """Return "late" or "early", for by how much something is late."""
    return "late" if late_s > 0 else "early"


def put(raw: Raw, path: str, value: Any) -> None:
    """Set a key of a description by its path; null takes it away.

    Raises:
        KeyError: it is inside something that is not a mapping.
    """
    *parents, last = path.split(".")
    part: Any = raw
    for key in parents:
        part = part.setdefault(key, {})
        if not isinstance(part, dict):
            raise KeyError(path)
    if value is None:
        part.pop(last, None)
    else:
        part[last] = value


def _at(raw: Any, path: str) -> Any:
    """Return what stands at a path, or None."""
    for key in path.split("."):
        raw = raw.get(key) if isinstance(raw, Mapping) else None
    return raw


def _flow(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...").strip()


def _changes(line: str, raw: Raw) -> Changes:
    """Return what one line of a fix changes."""
    path, said = line.split(": ", 1)
    text, _, remark = said.partition("#")
    parent, _, key = path.rpartition(".")
    if text.startswith("exchange "):
        return _exchanged(path, raw)
    if text.startswith("mirror "):
        return _mirrored(path, text, raw)
    if text.startswith("raise "):
        return _raised(path, float(text.split()[1]), raw)
    value = yaml.safe_load(text)
    if "whichever" in remark:
        return {path: OTHER[_at(raw, path) or DEFAULTS[key]]}
    if "; with " in remark:
        value = _of_word(parent.removesuffix("." + parent.rpartition(".")[2]), parent, value, remark, raw)
    special = SPECIAL.get(key)
    return {path: value} if special is None else special(path, value, raw)


def _of_word(above: str, parent: str, value: Any, remark: str, raw: Raw) -> Any:
    """Return the value for the word that the description has: "convention: compass; with yaw 2.0"."""
    word, one, _, other, last = remark.replace(":", " ").replace(";", " ").split(maxsplit=4)
    now = _at(raw, f"{parent}.{word}") or _at(raw, f"{above}.{word}") or DEFAULTS[word]
    if now == one:
        return value
    if now != other:
        raise ValueError(remark)
    found = yaml.safe_load(last)
    return [*value[:-1], found] if isinstance(value, list) else found


def _exchanged(path: str, raw: Raw) -> Changes:
    """Exchange the columns of latitude and longitude; without those, east and north."""
    there = _at(raw, path)
    if there is None:
        frame = path.replace(".geodetic", ".frame")
        return {frame: OTHER[_at(raw, frame) or DEFAULTS["frame"]]}
    return {f"{path}.latitude": there["longitude"], f"{path}.longitude": there["latitude"]}


def _mirrored(path: str, text: str, raw: Raw) -> Changes:
    """Turn the sign of latitude, longitude, or both; without those, of north and east."""
    signs = [-1 if name in text else 1 for name in ("latitude", "longitude")]
    if _at(raw, f"{path}.geodetic") is not None:
        return _scaled(f"{path}.geodetic.scale", signs, raw)
    north, east = signs
    frame = _at(raw, f"{path}.frame") or DEFAULTS["frame"]
    axes = {"ENU": [east, north, 1], "NED": [north, east, 1]}[frame]
    return _scaled(f"{path}.position.scale", axes, raw)


def _raised(path: str, up_m: float, raw: Raw) -> Changes:
    """Add to the heights of GPS or truth, in whichever key they are.

    Raises:
        ValueError: no key of the description is a height.
    """
    there = _at(raw, path) or {}
    if there.get("height_m") is not None:
        return {f"{path}.height_m": _short(there["height_m"] + up_m)}
    if "position" in there and there.get("frame") != "ECEF":
        by = up_m / d.Lengths.units[there["position"]["unit"]]
        return _added(f"{path}.position.offset", [0.0, 0.0, -by if there.get("frame") == "NED" else by], raw)
    altitude = f"{path}.geodetic.altitude"
    if _at(raw, altitude) is None:
        raise ValueError(path)
    return _added(f"{altitude}.offset", up_m / d.Height.units[_at(raw, f"{altitude}.unit")], raw)


def _scaled(path: str, value: Any, raw: Raw) -> Changes:
    """Multiply a scale by the one there."""
    product = np.multiply(value, _at(raw, path) or 1.0)
    return {path: [_short(x) for x in product] if product.ndim else _short(float(product))}


def _added(path: str, value: Any, raw: Raw) -> Changes:
    """Add to what is there; an offset of a quantity is in its unit."""
    parent, _, key = path.rpartition(".")
    name = parent.rpartition(".")[2]
    if key == "offset" and name in QUANTITIES:
        value = np.divide(value, QUANTITIES[name].units[_at(raw, f"{parent}.unit")])
    total = np.add(value, _at(raw, path) or 0.0)
    return {path: [_short(x) for x in total] if total.ndim else _short(float(total))}


def _unit(path: str, value: Any, raw: Raw) -> Changes:
    """Set a unit; where the one there is another than the fix is relative to, scale instead."""
    parent, name = path.rpartition(".")[0], path.split(".")[-2]
    if name not in QUANTITIES:  # of a time
        return {path: value} if (_at(raw, path) or "s") == "s" else {}
    units, now, usual = QUANTITIES[name].units, _at(raw, path), USUAL[name]
    if units[now] == units[usual] == units[value]:  # it is stated already, so the file was written in another one
        if "deg" not in "".join(units):
            raise ValueError(path)
        return _scaled(f"{parent}.scale", 1 / DEGREE, raw)
    if units[now] == units[usual]:
        return {path: value}
    if units[value] == units[usual]:  # read as another unit than the usual one, which it is in
        return {path: value}
    return _scaled(f"{parent}.scale", units[value] / units[usual], raw)


def _columns(path: str, order: list[int], raw: Raw) -> Changes:
    """Put the columns of gyro or accelerometer into another order; signs are in the scale, as the columns' are."""
    parent = path.rpartition(".")[0]
    there = _at(raw, path)
    if _at(raw, f"{path.rsplit('.', 2)[0]}.axes") == "FRD" or isinstance(_at(raw, f"{parent}.scale"), list):
        raise ValueError(path)  # signs would have to be moved too
    return {path: [there[k] for k in order]}


def _delay(path: str, value: Any, raw: Raw) -> Changes:
    """Add a delay; where the reception is a column, or a delay would become negative, shift the clock."""
    parent = path.rpartition(".")[0]
    if _at(raw, f"{parent}.received") is not None:
        return _added(f"{parent}.clock_offset_s", -value, raw)
    return _added(path, value, raw)


def _mounting(path: str, value: Any, raw: Raw) -> Changes:
    """Set the angles of a mounting, and keep its translation."""
    there = _at(raw, path) or {}
    kept = {} if "translation_m" in value or "translation_m" not in there else {"translation_m": there["translation_m"]}
    return {path: {**kept, **value}}


def _yaw(path: str, value: Any, raw: Raw) -> Changes:
    """Add to a mounting's yaw, which is the last of its rotations; or turn its matrix."""
    parent = path.rpartition(".")[0]
    R_BS = _at(raw, f"{parent}.R_BS")
    if R_BS is None:
        return _added(path, value, raw)
    c, s = np.cos(np.radians(value)), np.sin(np.radians(value))
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.asarray(R_BS)
    return {f"{parent}.R_BS": turned.tolist()}


def _part(path: str, value: Any, raw: Raw) -> Changes:
    """Merge a mapping with the one there; a scale multiplies."""
    found: Changes = {}
    for key, item in value.items():
        found |= _scaled(f"{path}.{key}", item, raw) if key == "scale" else {f"{path}.{key}": item}
    return found


def _sigma(path: str, value: Any, raw: Raw) -> Changes:
    """State a sigma, instead of the columns of it."""
    parent = path.rpartition(".")[0]
    measures = _at(raw, f"{parent}.measures")
    if isinstance(value, list) and measures:
        value = [value["xyz".index(axis)] for axis in measures]
    columns = {f"{parent}.{name}": None for name in ("sigma", "variance") if _at(raw, f"{parent}.{name}") is not None}
    return {**columns, path: value}


def _short(x: Any) -> Any:
    """Return a number as a person would write it."""
    x = float(f"{float(x):.7g}")
    return int(x) if x == int(x) and abs(x) < 1e6 else x


SPECIAL: dict[str, Callable[[str, Any, Raw], Changes]] = {
    "scale": _scaled,
    "offset": _added,
    "clock_offset_s": _added,
    "add_deg": _added,
    "delay_s": _delay,
    "unit": _unit,
    "columns": _columns,
    "mounting": _mounting,
    "yaw_deg": _yaw,
    "accel": _part,
    "sigma_m": _sigma,
    "sigma_m_s": _sigma,
    "sigma_deg": _sigma,
}
"""How the value of a key is put together with what is there; other keys are set."""
