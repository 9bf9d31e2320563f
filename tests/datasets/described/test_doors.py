"""What comes in by a description or a scenario: rotations, noise, and files, which lie in the log's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError, Log, Mounting, Scenario, Trajectory, open_log, simulate
from fathom.datasets.log import AttitudeStream
from fathom.datasets.notes import Note
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
    assert [note for note in notes if "1 rotation made exact, off by up to" in note]


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
    (told,) = (note for note in log.notes if note.startswith("truth: 1 rotation made exact, off by up to "))
    assert isinstance(told, Note)
    assert (told.kind, told.stream, told.count, told.of) == ("repaired", "truth", 1, 2)


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


# -- files ------------------------------------------------------------------------------------------------------------

SECRET = "root:x:0:0:hidden"


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of a log, beside a file that is not its business, and links to that."""
    monkeypatch.delenv("FATHOM_DATA", raising=False)
    (tmp_path / "secret.csv").write_text(f"{SECRET}\n{SECRET}\n")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "a.db3").write_text(SECRET)
    folder = tmp_path / "log"
    (folder / "bag").mkdir(parents=True)
    for name in ("link.csv", "link.tum", "link.parquet", "link.npy", "link.lsf", "link.xml", "link.msg", "link.bag"):
        (folder / name).symlink_to(tmp_path / "secret.csv")
    (folder / "bag" / "a.db3").symlink_to(tmp_path / "bag" / "a.db3")
    (folder / "there").symlink_to(tmp_path)
    (folder / "circle.csv").symlink_to(folder / "circle.csv")
    return folder


def of_table(**table: Any) -> dict[str, Any]:
    depth = {"columns": ["b"], "unit": "m"}
    return {"streams": {"depth": {"table": table, "time": {"column": "a"}, "depth": depth, "sigma_m": 1}}}


def of_recording(**recording: Any) -> dict[str, Any]:
    depth = {"columns": ["a"], "unit": "m"}
    part = {"message": {"names": ["Depth"]}, "time": {"column": "t"}, "depth": depth, "sigma_m": 1}
    return {"streams": {"depth": part}, "recording": recording}


NAMES = ["../secret.csv", "/etc/passwd", "there/secret.csv", "link.csv", "bag/../../secret.csv"]


@pytest.mark.parametrize(
    "described",
    [
        *(of_table(file=name) for name in NAMES),
        *({"truth": {"tum": name}} for name in NAMES),
        *({"truth": {"trajectory": name}} for name in [*NAMES, "link.parquet"]),
        of_table(file="link.parquet"),
        of_table(arrays={"a": "link.npy", "b": "link.npy"}),
        *(of_recording(format="imc", file=name) for name in [*NAMES, "link.lsf"]),
        *(of_recording(format="ros", file=name) for name in [*NAMES, "link.bag", "bag", "there", "../bag"]),
        *(of_recording(format=kind, file="link.csv") for kind in ("mcap", "ardupilot")),
        of_recording(format="imc", file="imu.csv", definitions="link.xml"),
        of_recording(format="ros", file="imu.csv.mcap", definitions=["link.msg"]),
    ],
    ids=lambda described: str(next(iter(described.values())))[:60],
)
def test_a_description_reads_no_file_elsewhere(described: dict[str, Any], outside: Path) -> None:
    (outside / "imu.csv.mcap").write_bytes(b"")
    streams = described.pop("streams", {})
    with pytest.raises(DatasetError, match=r"outside the log's folder, where a log\.yaml reads no file") as error:
        opened(outside, streams, **described)
    assert "root:" not in str(error.value)


@pytest.mark.parametrize(
    "name", ["~/secret.csv", "$HOME/imu.csv", "*.csv", "http://localhost/imu.csv", "file:///imu.csv"]
)
def test_a_name_is_a_name_and_nothing_else(name: str, outside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(outside.parent))
    monkeypatch.chdir(outside)
    with pytest.raises(DatasetError, match="no such file"):
        opened(Path(), of_table(file=name)["streams"])
    with pytest.raises(DatasetError, match="no such file"):
        opened(Path(), truth={"trajectory": name})


def test_a_circle_of_links_is_an_error(outside: Path) -> None:
    with pytest.raises(DatasetError, match=r"circle.csv: cannot be read"):
        opened(outside, of_table(file="circle.csv")["streams"])


def test_the_folder_itself_and_its_parents_may_be_links(outside: Path) -> None:
    opened(outside)
    (outside.parent / "alias").symlink_to(outside)
    assert len(open_log(outside.parent / "alias").imu.t_ns) == 20


def test_the_data_folder_may_be_read_as_well(outside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (outside.parent / "truth.tum").write_text("100 0 0 0 0 0 0 1\n101 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match="outside the log's folder, where"):
        opened(outside, truth={"tum": "../truth.tum"})
    assert open_log(outside, outside.parent).truth is not None
    monkeypatch.setenv("FATHOM_DATA", str(outside.parent))
    assert open_log(outside).truth is not None
    with pytest.raises(DatasetError, match="outside the log's folder and the data folder"):
        opened(outside, truth={"tum": "/etc/passwd"})


def test_a_scenario_shows_nothing_of_the_file_that_it_names(outside: Path) -> None:
    scenario = {"mission": "recorded", "path": str(outside.parent / "secret.csv")}
    with pytest.raises(DatasetError, match=r"secret.csv: line 1: not numbers; is this a TUM file\?") as error:
        simulate(Scenario.from_dict(scenario), 1)
    assert "root:" not in str(error.value)
