"""Only regular files are opened; and the limits under which hostile files are read hold."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fathom.datasets import DatasetError
from fathom.datasets.files import regular_file
from limited import limited


def test_a_pipe_a_device_and_a_folder_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path / "link", Path("/dev/zero")):
        with pytest.raises(DatasetError, match=r"expected a file, found a pipe, a device or a socket"):
            regular_file(path)
    with pytest.raises(DatasetError, match=r"expected a file, found a folder"):
        regular_file(tmp_path)
    assert regular_file(tmp_path, or_folder=True) == tmp_path


def test_a_file_that_is_missing_is_named_with_its_nearest(tmp_path):
    (tmp_path / "imu.csv").write_text("")
    assert regular_file(tmp_path / "imu.csv") == tmp_path / "imu.csv"
    with pytest.raises(DatasetError, match=r"imu.cvs: no such file; did you mean 'imu.csv'\?"):
        regular_file(tmp_path / "imu.cvs")
    with pytest.raises(DatasetError, match=r"cannot be read: .*null"):
        regular_file(tmp_path / "imu\0")


def test_a_limited_action_returns_raises_and_is_stopped():
    assert limited(lambda: len(bytes(10 << 20)), 100) == 10 << 20
    with pytest.raises(DatasetError, match="wrong"):
        limited(lambda: regular_file(Path("wrong")), 100)
    with pytest.raises(MemoryError):
        limited(lambda: bytes(200 << 20), 100)
    with pytest.raises(TimeoutError):
        limited(spin, 100, seconds=1)


def spin() -> None:
    while True:
        pass
