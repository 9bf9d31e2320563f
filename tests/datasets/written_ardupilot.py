"""Dataflash logs for tests, packed by hand from ArduPilot's own tables (LogStructure.h), and a simulated Log as one."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from fathom.datasets import Log
from scipy.spatial.transform import Rotation

MESSAGES: dict[str, tuple[int, str, str, str]] = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns", "-b---"),
    "UNIT": (129, "QbZ", "TimeUS,Id,Label", "s--"),
    "FMTU": (130, "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---"),
    "MULT": (131, "Qbd", "TimeUS,Id,Mult", "s--"),
    "MSG": (132, "QZ", "TimeUS,Message", "s-"),
    "IMU": (133, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz", "s#EEEooo--O--zz"),
    "GPS": (134, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
            "s#-s-S-DUmnhnh-"),
    "BARO": (135, "QBffcfIffB", "TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,Health", "s#mPOnsmO-"),
    "ATT": (136, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF", "sddddhhdh-"),
    "VISO": (137, "Qffffffff", "TimeUS,dt,AngDX,AngDY,AngDZ,PosDX,PosDY,PosDZ,conf", "ssrrrmmm-"),
    "AHR2": (138, "QccCfLLffff", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng,Q1,Q2,Q3,Q4", "sddhmDU----"),
    "XKF1": (139, "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH", "s#ddhnnnnmmmkkkm"),
    "ISBD": (140, "QHHaaa", "TimeUS,N,seqno,x,y,z", "s--ooo"),
    "ODD": (141, "gbhqMd", "Half,Byte,Word,Long,Mode,Double", "------"),
}  # fmt: skip
"""Number, letters, columns and units; XKF1 calls its instance C, and only its units say so."""
LETTERS = {"a": "64s", "b": "b", "B": "B", "g": "e", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d",
           "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "b", "q": "q",
           "Q": "Q"}  # fmt: skip
PER_UNIT = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 10**7}


def message(name: str, *values: Any) -> bytes:
    """Return one message, values as the log means them (degrees, metres), in the order of the columns."""
    number, letters, _, _ = MESSAGES[name]
    stored = [
        round(v * PER_UNIT[letter]) if letter in PER_UNIT else v.encode() if isinstance(v, str) else v
        for letter, v in zip(letters, values, strict=True)
    ]
    return struct.pack(f"<2sB{''.join(LETTERS[letter] for letter in letters)}", b"\xa3\x95", number, *stored)


def definition(name: str, **changes: Any) -> bytes:
    """Return the FMT message of a kind."""
    number, letters, columns, _ = MESSAGES[name]
    length = struct.calcsize("<" + "".join(LETTERS[letter] for letter in letters)) + 3
    told = {"number": number, "length": length, "name": name, "letters": letters, "columns": columns} | changes
    return message("FMT", *told.values())


def units(name: str) -> bytes:
    """Return the FMTU message of a kind; every multiplier is called 1."""
    number, letters, _, ids = MESSAGES[name]
    return message("FMTU", 0, number, ids, "0" * len(letters))


def head() -> bytes:
    """Return what a log begins with: all formats, then units, multipliers, and which column has which."""
    meant = [message("UNIT", 0, ord(letter), label) for letter, label in {"s": "s", "#": "instance", "m": "m"}.items()]
    meant += [message("MULT", 0, ord("0"), 1.0)]
    return b"".join([*map(definition, MESSAGES), *meant, *map(units, MESSAGES)])


def write_ardupilot(log: Log, folder: Path, file: str = "00000001.BIN") -> Path:
    """Write a Log, whose times are whole microseconds and whose DVL is regular, as a vehicle of ArduPilot's logs it.

    IMU (instance 0; 1 is another, 0.5 rad/s off), VISO (the DVL's velocity times its period), BARO[1] (depth), GPS, ATT
    (heading) and AHR2 (truth), with the log.yaml that reads them back.
    """
    assert log.dvl is not None
    assert log.depth is not None
    assert log.gps is not None
    assert log.heading is not None
    assert log.truth is not None
    lat0, lon0 = log.origin or (41.18, -8.7)
    metres_per_degree = _metres_per_degree(lat0)
    timed: list[tuple[int, bytes]] = []

    def keep(t_ns: Any, name: str, *columns: Any) -> None:
        t_us, rest = np.divmod(t_ns, 1000)
        assert not rest.any()
        rows = zip(t_us.tolist(), *(np.broadcast_to(c, len(t_us)).tolist() for c in columns), strict=True)
        timed.extend((row[0], message(name, *row)) for row in rows)

    def geodetic(p: Any) -> tuple[Any, Any]:
        return lat0 + p[:, 1] / metres_per_degree[1], lon0 + p[:, 0] / metres_per_degree[0]

    frd = np.array([1.0, -1.0, -1.0])
    gyro, accel = log.imu.w_WI_I * frd, log.imu.f_I * frd
    for instance, off in ((0, 0.0), (1, 0.5)):
        keep(log.imu.t_ns, "IMU", instance, *(gyro + off).T, *accel.T, 0, 0, 25.5, 1, 1, 1000, 1000)
    dt_s = float(np.median(np.diff(log.dvl.t_ns)) * 1e-9)
    keep(log.dvl.t_ns, "VISO", dt_s, 0.0, 0.0, 0.0, *(log.dvl.z * frd * dt_s).T, 100.0)
    keep(log.depth.t_ns, "BARO", 0, 3.0, 101325.0, 20.0, 0.0, 0, 0.0, 20.0, 1)
    keep(log.depth.t_ns, "BARO", 1, log.depth.z[:, 0], 101325.0 - 1e4 * log.depth.z[:, 0], 9.5, 0.0, 0, 0.0, 20.0, 1)
    lat, lon = geodetic(log.gps.z)
    week_ms = (log.gps.t_ns // 10**6) % (7 * 86_400_000)
    up = log.gps.z[:, 2]
    keep(log.gps.t_ns, "GPS", 0, 3, week_ms, 2392, 12, 0.87, lat, lon, up, 0.5, 0.0, 0.0, 0.0, 1)
    keep(log.gps.t_ns, "GPS", 1, 1, week_ms, 2392, 3, 9.99, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0)
    compass_deg = np.degrees(np.pi / 2 - log.heading.z[:, 0]) % 360
    keep(log.heading.t_ns, "ATT", 0.0, 0.0, 0.0, 0.0, 0.0, compass_deg, 0.0, 0.0, 3)
    ned_enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    q_wxyz = np.roll(Rotation.from_matrix(ned_enu @ log.truth.R_WB * frd).as_quat(), 1, axis=1)
    lat, lon = geodetic(log.truth.p_WB_W)
    keep(log.truth.t_ns, "AHR2", 0.0, 0.0, 0.0, log.truth.p_WB_W[:, 2], lat, lon, *q_wxyz.T)
    timed.sort(key=lambda row: row[0])

    folder.mkdir(parents=True, exist_ok=True)
    (folder / file).write_bytes(head() + message("MSG", 0, "ArduSub V4.5.0") + b"".join(row[1] for row in timed))
    noise = {name: float(value) for name, value in vars(log.rig.imu_noise).items()}
    described = {
        "name": log.name,
        "gravity": float(log.rig.gravity),
        "origin": {"latitude_deg": lat0, "longitude_deg": lon0},
        "recording": {"format": "ardupilot", "file": file},
        "streams": {
            "imu": {
                "message": {"names": ["IMU"], "entity": 0},
                "time": {"column": "TimeUS", "unit": "us"},
                "gyro": {"columns": ["GyrX", "GyrY", "GyrZ"], "unit": "rad/s"},
                "accel": {"columns": ["AccX", "AccY", "AccZ"], "unit": "m/s^2"},
                "axes": "FRD",
                "noise": noise,
                "mounting": _mounting(log.rig.imu),
            },
            "dvl": {
                "message": {"names": ["VISO"]},
                "time": {"column": "TimeUS", "unit": "us"},
                "velocity": {"columns": ["PosDX", "PosDY", "PosDZ"], "unit": "m/s", "scale": 1 / dt_s},
                "axes": "FRD",
                "sigma_m_s": [float(s) for s in log.dvl.sigma[0]],
            },
            "depth": {
                "message": {"names": ["BARO"], "entity": 1},
                "time": {"column": "TimeUS", "unit": "us"},
                "depth": {"columns": ["Alt"], "unit": "m"},
                "positive": "up",
                "sigma_m": float(log.depth.sigma[0, 0]),
                "mounting": _mounting(log.rig.depth),
            },
            "gps": {
                "message": {"names": ["GPS"], "entity": 0},
                "time": {"column": "TimeUS", "unit": "us"},
                "valid": {"column": "Status", "values": [3, 4, 5, 6]},
                "geodetic": {"latitude": "Lat", "longitude": "Lng", "altitude": {"columns": ["Alt"], "unit": "m"}},
                "sigma_m": [float(s) for s in log.gps.sigma[0]],
                "mounting": _mounting(log.rig.gps),
            },
            "heading": {
                "message": {"names": ["ATT"]},
                "time": {"column": "TimeUS", "unit": "us"},
                "heading": {"columns": ["Yaw"], "unit": "deg"},
                "sigma_deg": float(np.degrees(log.heading.sigma[0, 0])),
                "mounting": _mounting(log.rig.heading),
            },
        },
        "truth": {
            "message": {"names": ["AHR2"]},
            "time": {"column": "TimeUS", "unit": "us"},
            "geodetic": {"latitude": "Lat", "longitude": "Lng", "altitude": {"columns": ["Alt"], "unit": "m"}},
            "attitude": {"columns": ["Q1", "Q2", "Q3", "Q4"], "form": "quaternion_wxyz", "world": "NED", "axes": "FRD"},
        },
    }
    (folder / "log.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return folder


def _mounting(mounting: Any) -> dict[str, Any]:
    return {"translation_m": mounting.p_BS_B.tolist(), "R_BS": mounting.R_BS.tolist()}


def _metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Along a parallel and along a meridian of WGS84, from its radii of curvature."""
    e2, phi = 0.00669437999014, np.radians(latitude_deg)
    w = np.sqrt(1 - e2 * np.sin(phi) ** 2)
    return np.radians(6378137.0 / w * np.cos(phi)), np.radians(6378137.0 * (1 - e2) / w**3)
