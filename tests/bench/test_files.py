"""Writing files."""

from pathlib import Path

import pytest
from fathom.bench.errors import ExperimentError
from fathom.bench.files import write_whole, writing


def test_a_file_that_cannot_be_written_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ExperimentError, match=r"runs: cannot be made \(Not a directory\); give another --out$"):  # noqa: SIM117
        with writing(tmp_path / "file" / "runs", "; give another --out", "made"):
            (tmp_path / "file" / "runs").mkdir()
    with pytest.raises(ExperimentError, match=r"\(No such file or directory, .*absent.txt\)"), writing(tmp_path):
        (tmp_path / "none" / "absent.txt").write_text("")


def test_a_file_is_whole_or_not_there(tmp_path: Path) -> None:
    write_whole(tmp_path / "a", b"first")
    write_whole(tmp_path / "a", b"second")
    assert (tmp_path / "a").read_bytes() == b"second"
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_whole(tmp_path / "folder", b"third")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "folder"]
