"""The tutorial's promise: a format never seen before, described by its log.yaml alone, gives the original's scores."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fathom.bench import ate, run_log
from fathom.datasets import DatasetError, Log, Scenario, open_log, simulate
from fathom.estimators import create
from scipy.spatial.transform import Rotation
from written import geodetic_places

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "your-own-log.md"
ORIGIN = np.radians([41.185, -8.706])
EPOCH_US = 1_700_000_000_000_000
FOOT, GRAVITY = 0.3048, 9.80665
FRD = np.array([1.0, -1.0, -1.0])
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def microseconds(t_ns: np.ndarray) -> np.ndarray:
    assert not (t_ns % 1000).any()
    return EPOCH_US + t_ns // 1000


def ddmm(radians: np.ndarray) -> list[str]:
    degrees = np.abs(np.degrees(radians))
    whole = np.floor(degrees)
    return [
        f"{'-' if x < 0 else ''}{100 * d + m:.11f}"
        for x, d, m in zip(radians, whole, 60 * (degrees - whole), strict=True)
    ]


def write_strangers_files(log: Log, folder: Path) -> None:
    imu = np.column_stack([np.degrees(log.imu.w_WI_I * FRD), log.imu.f_I * FRD / (GRAVITY * 1e-3)])
    lines = [
        f"{t} " + " ".join(f"{x:.10f}" for x in row) for t, row in zip(microseconds(log.imu.t_ns), imu, strict=True)
    ]
    (folder / "ins.txt").write_text("# Inertial log v2   usec  p q r  ax ay az\n" + "\n".join(lines) + "\n")

    dvl, depth, gps, heading, truth = (
        log.streams["dvl"],
        log.streams["depth"],
        log.streams["gps"],
        log.streams["heading"],
        log.truth,
    )
    assert truth is not None
    s = np.sqrt(0.5)
    R_SB = np.array([[s, s, 0.0], [-s, s, 0.0], [0.0, 0.0, 1.0]])  # clockwise from the bow, before z is turned down
    R_SB = R_SB.T
    velocity = pd.DataFrame(dvl.z @ R_SB.T * FRD * 1000, columns=["VX", "VY", "VZ"])
    velocity.insert(0, "usec", microseconds(dvl.t_ns))
    velocity["BT"] = 1
    blind = velocity.iloc[::50].assign(VX=-32768, VY=-32768, VZ=-32768, BT=0)
    blind["usec"] += 50_000
    velocity = pd.concat([velocity, blind]).sort_values("usec")
    latitude, longitude = geodetic_places(gps.z, *ORIGIN)
    roll_pitch_yaw = Rotation.from_matrix(NED_FROM_ENU @ truth.R_WB * FRD).as_euler("ZYX", degrees=True)[:, ::-1]
    tables = {
        "dvl.csv": velocity,
        "ctd.csv": pd.DataFrame({"usec": microseconds(depth.t_ns), "depth_ft": -depth.z[:, 0] / FOOT}),
        "gnss.csv": pd.DataFrame(
            {
                "usec": microseconds(gps.t_ns) + 18_000_000,
                "lat": ddmm(latitude),
                "lon": ddmm(longitude),
                "height_m": gps.z[:, 2],
            }
        ),
        "compass.csv": pd.DataFrame(
            {"usec": microseconds(heading.t_ns), "deg": np.mod(90.0 - np.degrees(heading.z[:, 0]) + 2.6, 360.0)}
        ),
        "usbl.csv": pd.DataFrame(
            {"usec": microseconds(truth.t_ns)}
            | dict(zip(["north_m", "east_m", "down_m"], (truth.p_WB_W @ NED_FROM_ENU.T).T, strict=True))
            | dict(zip(["roll_deg", "pitch_deg", "yaw_deg"], roll_pitch_yaw.T, strict=True))
        ),
    }
    for name, table in tables.items():
        table.to_csv(folder / name, sep=";", index=False, float_format="%.10f")


def tutorial_yaml() -> str:
    found = re.findall(r"```yaml\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
    assert len(found) == 1
    return found[0]


@pytest.fixture(scope="module")
def original() -> Log:
    log = simulate(Scenario(mission="lawnmower", duration_s=150, imu="industrial", latitude_deg=41.185), seed=4)
    return replace(log, prior=None)  # a stranger has none


@pytest.fixture(scope="module")
def folder(original: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("strangers")
    write_strangers_files(original, path)
    (path / "log.yaml").write_text(tutorial_yaml(), encoding="utf-8")
    return path


def test_a_log_yaml_alone_gives_back_the_readings(original, folder):
    log = open_log(folder)
    shift_ns = EPOCH_US * 1000
    np.testing.assert_array_equal(log.imu.t_ns, original.imu.t_ns + shift_ns)
    np.testing.assert_allclose(log.imu.f_I, original.imu.f_I, atol=1e-11)
    np.testing.assert_allclose(log.imu.w_WI_I, original.imu.w_WI_I, atol=1e-11)
    for name, stream in original.streams.items():
        read = log.streams[name]
        np.testing.assert_array_equal(read.t_ns, stream.t_ns + shift_ns)
        np.testing.assert_allclose(read.z, stream.z, atol=1e-8)
        np.testing.assert_allclose(read.sigma, stream.sigma, rtol=0.01)
    for sensor in ("imu", "depth", "gps", "heading"):
        np.testing.assert_allclose(getattr(log.rig, sensor).R_BS, getattr(original.rig, sensor).R_BS, atol=1e-12)
        np.testing.assert_allclose(getattr(log.rig, sensor).p_BS_B, getattr(original.rig, sensor).p_BS_B, atol=1e-12)
    assert original.truth is not None
    assert log.truth is not None
    np.testing.assert_allclose(log.truth.p_WB_W, original.truth.p_WB_W, atol=1e-9)
    np.testing.assert_allclose(log.truth.R_WB, original.truth.R_WB, atol=1e-9)
    assert "dvl: 15 rows invalid dropped" in log.notes


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [("eskf", {}), ("fls", {"lag_s": 3.0}), ("dead-reckoning", {})])
def test_the_strangers_log_scores_as_the_original_does(original, folder, name, options):
    """Sigmas and densities are the data sheet's round figures, as in the tutorial; all else is the original's."""
    theirs = open_log(folder)
    ours = replace(original, rig=replace(original.rig, imu_noise=theirs.rig.imu_noise))
    ours = replace(
        ours, **{s: replace(stream, sigma=theirs.streams[s].sigma) for s, stream in original.streams.items()}
    )
    scores = []
    for log in (ours, theirs):
        result = run_log(log, create(name, **options))
        assert result.status == "done"
        assert result.online is not None
        scores.append(ate(log.truth, result.online))
    assert scores[0].rmse_m == pytest.approx(scores[1].rmse_m, abs=1e-6)
    assert scores[0].rotation_rmse_deg == pytest.approx(scores[1].rotation_rmse_deg, abs=1e-6)
    assert 0.05 < scores[0].rmse_m < 10


@pytest.mark.parametrize(
    ("wrong", "right", "complaint"),
    [
        ("unit: mg", "unit: mgg", "unknown unit 'mgg'; known: .*; did you mean 'mg'"),
        ("columns: [VX, VY, VZ]", "columns: [Vx, VY, VZ]", "no column 'Vx'; did you mean 'VX'"),
        ("positive: down", "positve: down", "unknown key `streams.depth.positve`; did you mean 'positive'"),
        ("file: ctd.csv", "file: cdt.csv", "no such file; did you mean 'ctd.csv'"),
        ("unit: ddmm", "unit: deg", "no place on earth"),
        ("clock_offset_s: -18", "clock_offset_s: -1800", "gps: .* lies wholly outside the IMU's time"),
    ],
)
def test_a_slip_in_it_is_named(folder, tmp_path, wrong, right, complaint):
    text = tutorial_yaml()
    assert wrong in text
    (tmp_path / "log.yaml").write_text(text.replace(wrong, right), encoding="utf-8")
    with pytest.raises(DatasetError, match=complaint):
        open_log(tmp_path / "log.yaml", data=folder)
