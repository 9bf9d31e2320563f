"""A simulated log as an LSF of IMC messages, beside its log.yaml; for tests."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from fathom.datasets import Log
from fathom.datasets.described.folder import write_folder
from fathom.datasets.formats.imc import CRC_TABLE

MESSAGES = {
    "GpsFix": (253, {"validity": "uint16_t", "lat": "fp64_t", "lon": "fp64_t", "height": "fp64_t"}),
    "EulerAngles": (254, {"time": "fp64_t", "psi": "fp64_t"}),
    "AngularVelocity": (256, dict.fromkeys(["time", "x", "y", "z"], "fp64_t")),
    "Acceleration": (257, dict.fromkeys(["time", "x", "y", "z"], "fp64_t")),
    "GroundVelocity": (259, {"validity": "uint8_t", "x": "fp64_t", "y": "fp64_t", "z": "fp64_t"}),
    "Depth": (265, {"value": "fp64_t"}),
}
"""Their numbers are IMC's; some leave out fields that nobody reads here, so the log brings its own definitions."""
PACKED = {"fp64_t": "d", "uint8_t": "B", "uint16_t": "H"}
LAP_S = 64.0
FRD = np.array([1.0, -1.0, -1.0])


def definitions() -> str:
    messages = [
        f'<message abbrev="{name}" id="{number}">'
        + "".join(f'<field abbrev="{field}" type="{kind}"/>' for field, kind in fields.items())
        + "</message>"
        for name, (number, fields) in MESSAGES.items()
    ]
    return f"<messages>{''.join(messages)}</messages>"


def message(name: str, timestamp_s: float, *values: float, entity: int = 65) -> bytes:
    number, fields = MESSAGES[name]
    body = struct.pack("<" + "".join(PACKED[kind] for kind in fields.values()), *values)
    head = struct.pack("<HHHdHBHB", 0xFE54, number, len(body), timestamp_s, 27, entity, 0, 0)
    crc = 0
    for byte in head + body:
        crc = (crc >> 8) ^ int(CRC_TABLE[(crc ^ byte) & 0xFF])
    return head + body + struct.pack("<H", crc)


def write_imc(log: Log, folder: Path, places: Any) -> Path:
    """Write a log with DVL, depth, GPS and heading as an LSF, as an LAUV's; the truth stays a table of ours.

    `places` gives the latitude and longitude (rad) of positions in W, whose origin the log states.
    """
    rows: list[tuple[float, bytes]] = []

    def keep(name: str, t_ns: Any, *columns: Any, entity: int = 65) -> None:
        table = np.column_stack([np.broadcast_to(np.asarray(c, float), len(t_ns)) for c in columns])
        integers = [kind != "fp64_t" for kind in MESSAGES[name][1].values()]
        for t_s, row in zip((t_ns / 1e9).tolist(), table.tolist(), strict=True):
            whole = (int(x) if i else x for x, i in zip(row, integers, strict=True))
            rows.append((t_s, message(name, t_s, *whole, entity=entity)))

    device_s = (log.imu.t_ns / 1e9) % LAP_S
    keep("AngularVelocity", log.imu.t_ns, device_s, *(log.imu.w_WI_I * FRD).T)
    keep("Acceleration", log.imu.t_ns, device_s, *(log.imu.f_I * FRD).T)
    dvl, depth, gps, heading = (log.streams[name] for name in ("dvl", "depth", "gps", "heading"))
    keep("GroundVelocity", dvl.t_ns, 7, *(dvl.z * FRD).T, entity=66)
    keep("Depth", depth.t_ns, -depth.z[:, 0], entity=64)
    keep("GpsFix", gps.t_ns, 1, *places(gps.z), gps.z[:, 2], entity=61)
    keep("EulerAngles", heading.t_ns, (heading.t_ns / 1e9) % LAP_S, np.pi / 2 - heading.z[:, 0])
    rows.sort(key=lambda row: row[0])

    write_folder(log, folder)
    (folder / "Data.lsf").write_bytes(b"".join(row[1] for row in rows))
    (folder / "IMC.xml").write_text(definitions())
    described = yaml.safe_load((folder / "log.yaml").read_text())
    streams = described["streams"]
    clock = {"field": "time", "wraps_at_s": LAP_S}
    xyz = ["x", "y", "z"]
    said: dict[str, dict[str, Any]] = {
        "imu": {
            "message": {"names": ["AngularVelocity", "Acceleration"], "entity": 65, "clock": clock},
            "time": {"column": "device"},
            "gyro": {"columns": [f"AngularVelocity.{a}" for a in xyz], "unit": "rad/s"},
            "accel": {"columns": [f"Acceleration.{a}" for a in xyz], "unit": "m/s^2"},
            "axes": "FRD",
            "noise": streams["imu"]["noise"],
        },
        "dvl": {
            "message": {"names": ["GroundVelocity"], "entity": 66},
            "time": {"column": "timestamp"},
            "velocity": {"columns": xyz, "unit": "m/s"},
            "axes": "FRD",
            "valid": {"column": "validity", "values": [7]},
            "sigma_m_s": dvl.sigma[0].tolist(),
        },
        "depth": {
            "message": {"names": ["Depth"]},
            "time": {"column": "timestamp"},
            "depth": {"columns": ["value"], "unit": "m"},
            "sigma_m": float(depth.sigma[0, 0]),
        },
        "gps": {
            "message": {"names": ["GpsFix"]},
            "time": {"column": "timestamp"},
            "geodetic": {
                "latitude": "lat", "longitude": "lon", "unit": "rad",
                "altitude": {"columns": ["height"], "unit": "m"},
            },
            "sigma_m": gps.sigma[0].tolist(),
        },
        "heading": {
            "message": {"names": ["EulerAngles"]},
            "time": {"column": "timestamp"},
            "heading": {"columns": ["psi"], "unit": "rad"},
            "sigma_deg": float(np.degrees(heading.sigma[0, 0])),
        },
    }  # fmt: skip
    for name, part in streams.items():
        (folder / part["table"]["file"]).unlink()
        if "mounting" in part:
            said[name]["mounting"] = part["mounting"]
    described |= {"streams": said}
    described["recording"] = {"format": "imc", "file": "Data.lsf", "definitions": "IMC.xml", "source": 27}
    (folder / "log.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return folder
