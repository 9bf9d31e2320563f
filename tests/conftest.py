from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recorded_data() -> Path:
    """The folder of recordings: FATHOM_DATA, else shared/data beside the repository; skips where there is none."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FATHOM_DATA") or beside)
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is not there (set FATHOM_DATA)")
    return folder
