from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from fathom.datasets import Log, open_log


@pytest.fixture(scope="session")
def recorded_data() -> Path:
    """The folder of recordings: FATHOM_DATA, else shared/data beside the repository; skips the test without it."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FATHOM_DATA") or beside)
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is not there (set FATHOM_DATA)")
    return folder


@pytest.fixture(scope="session")
def recording(recorded_data: Path) -> Callable[[str], Path]:
    """Gives the folder of a recording by its name in the catalog; skips where it is not there."""

    def folder_of(name: str) -> Path:
        if not (recorded_data / name).is_dir():
            pytest.skip(f"no recording {name} in {recorded_data}")
        return recorded_data / name

    return folder_of


@pytest.fixture(scope="session")
def ictineu(recording: Callable[[str], Path]) -> Log:
    return open_log("ictineu_stpere_2004", recording("ictineu_stpere_2004").parent)


@pytest.fixture(scope="session")
def lauv(recording: Callable[[str], Path]) -> Log:
    return open_log("lauv_noptilus2_2015", recording("lauv_noptilus2_2015").parent)
