"""What comes in by a description or a scenario: rotations are mended alike and refused alike, whoever states them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError, Log, Mounting, Scenario, Trajectory, open_log, simulate
from fathom.datasets.log import AttitudeStream
from fathom.datasets.rotations import UNHEARD, off_rotation
from scipy.spatial.transform import Rotation

NOISE = dict.fromkeys(("gyro_density", "accel_density", "gyro_walk", "accel_walk"), 1e-4)
NOISE |= {"gyro_bias_sigma": 1e-3, "accel_bias_sigma": 1e-2}
TRUE = Rotation.from_euler("ZYX", [33.3, 12.3, -4.5], degrees=True)
IMU = "\n".join(f"{100 + k / 10:.1f},0,0,0,0,0,9.81" for k in range(20))


def opened(folder: Path, streams: dict[str, Any] | None = None, imu: dict[str, Any] | None = None, **more: Any) -> Log:
    """Open a log of two seconds of an IMU, with these streams and keys besides."""
    (folder / "imu.csv").write_text(IMU)
    stream = {"table": {"file": "imu.csv", "header": False}, "time": {"column": 0}, "noise": NOISE}
    stream |= {"gyro": {"columns": [1, 2, 3], "unit": "rad/s"}, "accel": {"columns": [4, 5, 6], "unit": "m/s^2"}}
    described = {"streams": {"imu": stream | (imu or {}), **(streams or {})}, **more}
    (folder / "log.yaml").write_text(yaml.safe_dump(described))
    return open_log(folder)


def matrix(R: Any) -> list[list[float]]:
    return np.asarray(R, float).tolist()


def row(values: Any) -> str:
    return ",".join(map(str, np.ravel(values).tolist()))


# Each gives one rotation, the last one written last, through a door, and returns it with the log's notes.


def by_mounting(folder: Path, R: Any) -> tuple[Any, Any]:
    log = opened(folder, imu={"mounting": {"R_BS": matrix(R)}})
    return log.rig.imu.R_BS, log.notes


def by_prior(folder: Path, R: Any) -> tuple[Any, Any]:
    vectors = {key: [0, 0, 0] for key in ("p_WB_W", "v_WB_W", "b_a", "b_g")}
    log = opened(folder, prior={"t_ns": 100 * 10**9, "R_WB": matrix(R), **vectors, "P": np.eye(15).tolist()})
    assert log.prior is not None
    return log.prior.state.R_WB, log.notes


def by_attitude(folder: Path, R: Any) -> tuple[Any, Any]:
    (folder / "a.csv").write_text(f"100,1,0,0,0,1,0,0,0,1\n101,{row(R)}\n")
    attitude = {"columns": list(range(1, 10)), "form": "matrix"}
    table = {"file": "a.csv", "header": False}
    part = {"table": table, "time": {"column": 0}, "sigma_deg": 1.0, "attitude": attitude}
    log = opened(folder, {"heading": part})
    assert isinstance(log.heading, AttitudeStream)
    return log.heading.z[-1].reshape(3, 3), log.notes


def by_truth(folder: Path, R: Any) -> tuple[Any, Any]:
    truth = Trajectory(np.array([100, 101]) * 10**9, np.stack([np.eye(3), np.asarray(R, float)]), np.zeros((2, 3)))
    truth.to_pandas().to_parquet(folder / "truth.parquet")
    log = opened(folder, truth={"trajectory": "truth.parquet"})
    assert log.truth is not None
    return log.truth.R_WB[-1], log.notes


def by_scenario(folder: Path, R: Any) -> tuple[Any, Any]:
    scenario = {"duration_s": 20, "imu": {"mounting": {"R_BS": matrix(R)}}, "heading": None, "dvl": None}
    log = simulate(Scenario.from_dict(scenario), 1)
    return log.rig.imu.R_BS, log.notes


DOORS = (by_mounting, by_prior, by_attitude, by_truth, by_scenario)


@pytest.mark.parametrize("door", DOORS)
def test_a_matrix_of_six_decimals_is_orthonormalised_with_a_note(door: Any, tmp_path: Path) -> None:
    found, notes = door(tmp_path, TRUE.as_matrix().round(6))
    assert off_rotation(found) < 1e-14
    np.testing.assert_allclose(found, TRUE.as_matrix(), rtol=0, atol=1e-6)
    assert [note for note in notes if "1 rotations were up to" in note and "orthonormalised" in note]


@pytest.mark.parametrize("door", DOORS)
def test_an_exact_matrix_stays_as_it_is_without_a_note(door: Any, tmp_path: Path) -> None:
    found, notes = door(tmp_path, TRUE.as_matrix())
    np.testing.assert_array_equal(found, TRUE.as_matrix())
    assert "orthonormalised" not in " ".join(notes)


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (2 * np.eye(3), "not a rotation: .* is 1.5 off"),
        (TRUE.as_matrix() * [1, 1, -1], "not a rotation, but mirrors"),
        (TRUE.as_matrix().round(1), "not a rotation: .* is 0.0[0-9]+ off"),
    ],
)
def test_what_is_no_rotation_is_refused(door: Any, wrong: Any, says: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=says):
        door(tmp_path, wrong)


def test_quaternions_of_four_decimals_are_normalised_with_a_note(tmp_path: Path) -> None:
    q = TRUE.as_quat().round(4) * (1 + 1e-4)
    (tmp_path / "truth.tum").write_text(f"100 0 0 0 {row(q).replace(',', ' ')}\n101 0 0 0 0 0 0 1\n")
    log = opened(tmp_path, truth={"tum": "truth.tum"})
    assert log.truth is not None
    assert off_rotation(log.truth.R_WB).max() < 1e-14
    assert "truth: trajectory: 1 rotations were up to" in " ".join(log.notes)


def test_types_take_rotations_that_are_mended_already() -> None:
    rounded = TRUE.as_matrix().round(6)
    assert off_rotation(rounded) > UNHEARD
    with pytest.raises(DatasetError, match=r"R_BS must be a 3 × 3 rotation; it is .* off"):
        Mounting(rounded)
    t_ns = np.array([1])
    with pytest.raises(DatasetError, match=r"attitude: row 0 \(1 in all\) is not a rotation: .* off"):
        AttitudeStream(t_ns, t_ns, rounded.reshape(1, 9), np.ones((1, 3)))


@pytest.mark.parametrize("name", ["gyro_density", "accel_density", "gyro_bias_sigma", "accel_bias_sigma"])
@pytest.mark.parametrize("bad", [0.0, -1.0, float("inf"), float("nan"), True])
def test_an_imu_without_noise_is_refused(name: str, bad: float, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=f"`streams.imu.noise.{name}`"):
        opened(tmp_path, imu={"noise": NOISE | {name: bad}})


@pytest.mark.parametrize("sigma", [float("inf"), [float("inf")] * 3, 0.0, -1.0, float("nan"), [1.0, 0.0, 1.0], True])
def test_a_sensor_that_measures_nothing_is_refused(sigma: Any, tmp_path: Path) -> None:
    velocity = {"columns": [1, 2, 3], "unit": "m/s"}
    part = {"table": {"file": "imu.csv", "header": False}, "time": {"column": 0}, "velocity": velocity}
    with pytest.raises(DatasetError, match=r"streams\.dvl.*(with no finite sigma|greater than 0|expected a number)"):
        opened(tmp_path, {"dvl": part | {"sigma_m_s": sigma}})
