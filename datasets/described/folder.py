"""Write a log as a described folder: log.yaml and one file per stream; it reads back bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import yaml

from ..errors import DatasetError
from ..log import AttitudeStream, Log, ReadingStream
from ..rig import Mounting
from ..state import Array
from .description import check_description

READS = {
    "dvl": ["v_WB_B_x", "v_WB_B_y", "v_WB_B_z"],
    "depth": ["z_W"],
    "gps": ["p_WG_W_x", "p_WG_W_y", "p_WG_W_z"],
    "heading": ["psi"],
    "attitude": [f"R_WH_{i}{j}" for i in range(3) for j in range(3)],
}
"""Names of the columns of z."""


def write_folder(log: Log, folder: Path | str, fmt: Literal["parquet", "csv"] = "parquet") -> Path:
    """Write log.yaml and one table per stream into `folder`, log.yaml last; `open_log(folder)` gives the log back.

    Raises:
        DatasetError: unknown format, the folder holds a log (or one of the files) already, or it cannot be written.
    """
    if fmt not in ("parquet", "csv"):
        raise DatasetError(f"unknown format {fmt!r}; known: parquet, csv")
    folder = Path(folder)
    imu_columns = {"gyro": [f"w_WI_I_{a}" for a in "xyz"], "accel": [f"f_I_{a}" for a in "xyz"]}
    tables = {"imu": pd.DataFrame({"t_ns": log.imu.t_ns})}
    for name, values in (("gyro", log.imu.w_WI_I), ("accel", log.imu.f_I)):
        tables["imu"][imu_columns[name]] = values
    noise = log.rig.imu_noise
    streams: dict[str, Any] = {
        "imu": {
            "table": {"file": f"imu.{fmt}"},
            "time": {"column": "t_ns", "unit": "ns"},
            "gyro": {"columns": imu_columns["gyro"], "unit": "rad/s"},
            "accel": {"columns": imu_columns["accel"], "unit": "m/s^2"},
            "mounting": _mounting(log.rig.imu),
            "noise": {name: float(value) for name, value in vars(noise).items()},
        }
    }
    for name, stream in log.streams.items():
        tables[name] = _table(stream)
        streams[name] = {"table": {"file": f"{name}.{fmt}"}, **_aiding(name, stream)}
        if name != "dvl":
            streams[name]["mounting"] = _mounting(getattr(log.rig, name))
    described: dict[str, Any] = {
        "name": log.name,
        "notes": [str(note) for note in log.notes],
        "gravity": float(log.rig.gravity),
    }
    if log.origin is not None:
        described["origin"] = {"latitude_deg": float(log.origin[0]), "longitude_deg": float(log.origin[1])}
    if log.max_wait_s is not None:
        described["max_wait_s"] = float(log.max_wait_s)
    described["streams"] = streams
    if log.truth is not None:
        tables["truth"] = log.truth.to_pandas()
        lookahead_s = float(log.truth.lookahead_s)
        described["truth"] = {"kind": log.truth_kind, "trajectory": f"truth.{fmt}", "lookahead_s": lookahead_s}
    if log.prior is not None:
        state = log.prior.state
        vectors = {name: getattr(state, name).tolist() for name in ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g")}
        described["prior"] = {"t_ns": int(log.prior.t_ns), **vectors, "P": log.prior.P.tolist()}
    check_description(described, str(folder))
    text = yaml.safe_dump(described, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    files: dict[str, Callable[[Any], object]] = {
        f"{name}.{fmt}": partial(table.to_parquet, index=False)
        if fmt == "parquet"
        else partial(table.to_csv, index=False, mode="wb")
        for name, table in tables.items()
    }
    files["log.yaml"] = lambda file: file.write(text.encode())
    try:
        _write_new(folder, files)
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be written: {error}") from None
    return folder


def _write_new(folder: Path, files: dict[str, Callable[[Any], object]]) -> None:
    """Write files that are not there yet: all, or none where one fails.

    Raises:
        DatasetError: one of them is there, be it a link that leads nowhere.
    """
    for name in reversed(files):
        if os.path.lexists(folder / name):
            raise DatasetError(f"{folder}: holds a {name} already; choose another folder, or remove that one")
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    try:
        for name, write in files.items():
            with (folder / name).open("xb") as file:  # x: not what came there meanwhile
                written.append(folder / name)
                write(file)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise


def _table(stream: ReadingStream) -> pd.DataFrame:
    table = pd.DataFrame({"t_ns": stream.t_ns, "received_ns": stream.received_ns})
    table[READS[stream.name]] = stream.z
    table[_sigma_columns(stream)] = stream.sigma
    return table


def _sigma_columns(stream: ReadingStream) -> list[str]:
    return [f"sigma_{i}" for i in range(stream.residual_width)]


def _aiding(name: str, stream: ReadingStream) -> dict[str, Any]:
    """Return the description of one aiding stream's table."""
    unit = {"dvl": "m/s", "depth": "m", "gps": "m", "heading": "rad"}[name]
    quantity = {"columns": READS[stream.name], "unit": unit}
    sigma = {"columns": _sigma_columns(stream), "unit": unit}
    time = {"column": "t_ns", "unit": "ns", "received": "received_ns"}
    if isinstance(stream, AttitudeStream):
        return {"time": time, "attitude": {"columns": READS["attitude"], "form": "matrix"}, "sigma": sigma}
    key = {"dvl": "velocity", "depth": "depth", "gps": "position", "heading": "heading"}[name]
    convention = {"depth": {"positive": "up"}, "heading": {"convention": "yaw"}}.get(name, {})
    return {"time": time, key: quantity, **convention, "sigma": sigma}


def _mounting(mounting: Mounting) -> dict[str, Any]:
    def rows(values: Array) -> list[Any]:
        return np.asarray(values, float).tolist()

    return {"translation_m": rows(mounting.p_BS_B), "R_BS": rows(mounting.R_BS)}
