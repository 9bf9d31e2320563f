"""`--repair` drops at most half of a stream, for all reasons together, and is advised only where it would help."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets import DatasetError, Log, Mounting, Trajectory
from fathom.datasets.described.folder import write_folder
from fathom.datasets.described.opening import open_log
from fathom.datasets.log import DepthStream, ImuStream
from fathom.datasets.rig import ImuNoise, Rig

N = 100
NS = 10**9


@pytest.fixture
def folder(tmp_path):
    """An IMU and a depth sensor at 10 Hz, for 10 s."""
    t_ns = np.arange(1, N + 1) * NS // 10
    imu = ImuStream(t_ns, np.zeros((N, 3)), np.tile([0, 0, 9.8], (N, 1)))
    z = -np.linspace(0, 1, N)[:, None]
    rig = Rig(ImuNoise(*[1e-3] * 6), Mounting())
    write_folder(Log("x", rig, imu, depth=DepthStream(t_ns, t_ns, z, np.full((N, 1), 0.1))), tmp_path, "csv")
    return tmp_path


def damage(folder, changes):
    """Write the fields of rows: by column, the row and its text."""
    lines = (folder / "depth.csv").read_text().splitlines()
    names = lines[0].split(",")
    for column, rows in changes.items():
        for row, text in rows.items():
            fields = lines[row + 1].split(",")
            fields[names.index(column)] = text
            lines[row + 1] = ",".join(fields)
    (folder / "depth.csv").write_text("\n".join(lines))


EACH = {
    "z_W": "nan",
    "t_ns": "never",
    "sigma_0": "0",
    "received_ns": "0",
}


@pytest.mark.parametrize(("column", "text"), EACH.items())
def test_each_reason_may_drop_half_of_a_stream_and_no_more(folder, column, text):
    damage(folder, {column: dict.fromkeys(range(50), text)})
    with pytest.raises(DatasetError, match=r"depth: row 0 \(50 in all\): .*; --repair drops such rows"):
        open_log(folder)
    assert len(open_log(folder, repair=True).streams["depth"]) == 50
    damage(folder, {column: {50: text}})
    for repair in (False, True):
        with pytest.raises(DatasetError, match=r"depth: 51 of 100 rows are .*, too many to drop") as error:
            open_log(folder, repair=repair)
        assert "drops such rows" not in str(error.value)


def test_all_reasons_together_may_drop_half_and_no_more(folder):
    damage(folder, {column: dict.fromkeys(range(12 * i, 12 * i + 12), EACH[column]) for i, column in enumerate(EACH)})
    depth = open_log(folder, repair=True)
    assert len(depth.streams["depth"]) == 52
    assert sum("(repair) dropped" in note for note in depth.notes) == 4
    damage(folder, {"z_W": dict.fromkeys(range(80, 83), "x")})
    with pytest.raises(DatasetError, match=r"51 of 100 rows are without a time or not finite or without a positive"):
        open_log(folder, repair=True)


def test_rows_out_of_order_by_accident_are_repaired(folder):
    damage(folder, {"t_ns": {20: str(NS), 60: str(9 * NS)}, "received_ns": {20: str(NS), 60: str(9 * NS)}})
    with pytest.raises(DatasetError, match=r"depth: row 20 \(2 in all\): time .* comes before.*--repair drops"):
        open_log(folder)
    assert len(open_log(folder, repair=True).streams["depth"]) == 98


@pytest.mark.parametrize(
    ("stamp", "why"),
    [
        (lambda i: (i // 10 + 1) * NS, r"90 have other values .*the stamps are too coarse \(whole seconds\?\)"),
        (lambda i: (i // 2 * 2 + 1) * NS // 10, r"50 have other values .*the stamps are too coarse"),
        (
            lambda i: (i if i < 80 else i - 30) * NS // 10 + NS // 100,
            r"time goes back by 2.9 s at row 80; was the clock set",
        ),
        (lambda i: (i - 30) % 640 * NS // 10, r"time goes back by 63.9 s at row 30; .*`wraps_at_s: 64`"),
        (lambda i: (i - 30) % 864000 * NS // 10, r"time goes back by 86399.9 s at row 30; .*`wraps_at_s: 86400`"),
    ],
)
def test_what_a_column_of_times_really_is_is_said_instead_of_repaired(folder, stamp, why):
    for column in ("t_ns", "received_ns"):
        damage(folder, {column: {i: str(stamp(i)) for i in range(N)}})
    for repair in (False, True):
        with pytest.raises(DatasetError, match=r"depth: \d+ of 100 rows are out of order, too many to drop: .*" + why):
            open_log(folder, repair=repair)


def test_rows_recorded_twice_are_no_loss(folder):
    head, *rows = (folder / "depth.csv").read_text().splitlines()
    (folder / "depth.csv").write_text("\n".join([head, *(row for row in rows for _ in range(3))]))
    with pytest.raises(
        DatasetError, match=r"depth: row 1 \(200 in all\): time .* repeats the row above; --repair drops"
    ):
        open_log(folder)
    log = open_log(folder, repair=True)
    assert len(log.streams["depth"]) == N
    assert "depth: 200 rows out of order (repair) dropped" in log.notes


def test_noise_that_is_none_and_times_of_another_year_are_refused_in_every_stream_and_truth(tmp_path):
    t_ns = np.array([NS, 2 * NS, 3 * NS])
    z = np.zeros((3, 1))
    for sigma in (0.0, -1.0, np.nan):
        with pytest.raises(DatasetError, match=r"depth: row 1: sigma must be positive"):
            DepthStream(t_ns, t_ns, z, np.array([[1.0], [sigma], [np.inf]]))
    far = np.array([NS, 2 * NS, 1_700_000_000 * NS])
    with pytest.raises(DatasetError, match=r"depth: row 2 \(1 in all\): time .* 19676 days from the middle"):
        DepthStream(far, far, z, z + 1)
    with pytest.raises(DatasetError, match=r"imu: row 2 \(1 in all\): time .* days from the middle"):
        ImuStream(far, np.zeros((3, 3)), np.zeros((3, 3)))
    (tmp_path / "a.tum").write_text("".join(f"{t} 0 0 0 0 0 0 1\n" for t in (0, 1_700_000_000, 1_700_000_001)))
    with pytest.raises(DatasetError, match=r"a.tum: trajectory: row 0 \(1 in all\): time 0 ns is 19676 days"):
        Trajectory.from_tum(tmp_path / "a.tum")
