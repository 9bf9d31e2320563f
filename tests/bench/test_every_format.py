"""One experiment file over the recorded logs and over one simulated log in every format that Fathom reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.bench.cli.app import app
from fathom.bench.results.store import load_runs
from fathom.datasets import Log, Scenario, Trajectory, catalog_names, open_log, simulate
from fathom.datasets.described.folder import write_folder
from typer.testing import CliRunner
from written import WRITERS, geodetic_places, write_arrays
from written_ardupilot import write_ardupilot
from written_imc import write_imc

ORIGIN_DEG = (41.18, -8.7)


def write_tum(log: Log, folder: Path) -> Path:
    """Tables of ours, and the truth as a TUM file."""
    write_folder(log, folder)
    assert log.truth is not None
    described = yaml.safe_load((folder / "log.yaml").read_text())
    (folder / described["truth"].pop("trajectory")).unlink()
    described["truth"]["tum"] = "truth.tum"
    log.truth.to_tum(folder / "truth.tum")
    (folder / "log.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return folder


EXACT: dict[str, Any] = {
    "parquet": write_folder,
    "csv": lambda log, folder: write_folder(log, folder, "csv"),
    "arrays": write_arrays,
    **WRITERS,
}
"""Formats that hold a log bit for bit."""
NEARLY: dict[str, Any] = {
    "tum": write_tum,
    "imc": lambda log, folder: write_imc(log, folder, lambda p_W: geodetic_places(p_W, *np.radians(ORIGIN_DEG))),
    "ardupilot": write_ardupilot,
}
"""Formats of geodetic places, float32 samples or a device's clock: scores agree to millimetres."""


@pytest.fixture(scope="module")
def log() -> Log:
    simulated = simulate(
        Scenario(mission="lawnmower", duration_s=60, imu="industrial", latitude_deg=ORIGIN_DEG[0]), seed=2
    )
    return replace(simulated, prior=None, origin=ORIGIN_DEG)  # most formats hold no prior: every log starts alike


@pytest.mark.slow
def test_all_logs_go_through_one_experiment_and_a_format_changes_no_score(
    log: Log, tmp_path: Path, recorded_data: Path
) -> None:
    for name, write in (EXACT | NEARLY).items():
        write(log, tmp_path / name)
    estimators = [{"name": "eskf"}, {"name": "window", "with": {"lag_s": 3.0}}]
    written = [{"log": str(tmp_path / name), "name": name} for name in EXACT | NEARLY]
    recorded = [{"log": name, "align": "yaw", "dims": "2d"} for name in catalog_names()]
    plan = {"logs": written + recorded, "estimators": estimators}
    (tmp_path / "formats.yaml").write_text(yaml.safe_dump(plan))
    arguments = ["run", str(tmp_path / "formats.yaml"), "--data", str(recorded_data), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output[-2000:]
    rows = load_runs(tmp_path / "out" / "formats")
    assert set(rows["status"]) == {"done"}
    assert len(rows) == 3 * (len(written) + len(recorded))  # two estimators online, and window smoothed
    ate = rows.pivot_table(index="log", columns=["label", "output"], values="ate_rmse_m")
    assert len(recorded) >= 4
    ours = ate.loc["parquet"]
    assert ours.between(0.01, 5).all()
    for name in EXACT:
        assert (ate.loc[name] == ours).all(), name
    for name in NEARLY:
        assert (np.abs(ate.loc[name] - ours) < 2e-3).all(), name
    assert ate.loc[catalog_names()].lt(10).all().all()


@pytest.mark.parametrize("name", EXACT)
def test_a_log_comes_back_bit_for_bit(log: Log, tmp_path: Path, name: str) -> None:
    read = open_log(EXACT[name](log, tmp_path / name))
    assert read.streams.keys() == log.streams.keys()
    for field in ("t_ns", "w_WI_I", "f_I"):
        np.testing.assert_array_equal(getattr(read.imu, field), getattr(log.imu, field), strict=True)
    for sensor, stream in log.streams.items():
        for field in ("t_ns", "received_ns", "z", "sigma"):
            np.testing.assert_array_equal(getattr(read.streams[sensor], field), getattr(stream, field), strict=True)


@pytest.mark.parametrize("name", NEARLY)
def test_a_log_comes_back_as_exactly_as_the_format_can(log: Log, tmp_path: Path, name: str) -> None:
    read = open_log(NEARLY[name](log, tmp_path / name))
    np.testing.assert_array_equal(read.imu.t_ns, log.imu.t_ns)
    np.testing.assert_allclose(read.imu.f_I, log.imu.f_I, atol=1e-6)
    np.testing.assert_allclose(read.imu.w_WI_I, log.imu.w_WI_I, atol=1e-7)
    tolerance = {"dvl": 1e-6, "depth": 1e-5, "gps": 0.02, "heading": 2e-4}  # ardupilot: 1e-7 deg, 0.01 deg
    for sensor, stream in log.streams.items():
        np.testing.assert_array_equal(read.streams[sensor].t_ns, stream.t_ns)
        np.testing.assert_allclose(read.streams[sensor].z, stream.z, atol=tolerance[sensor])
    assert isinstance(read.truth, Trajectory)
    assert log.truth is not None
    np.testing.assert_allclose(read.truth.p_WB_W, log.truth.p_WB_W, atol=0.02)
