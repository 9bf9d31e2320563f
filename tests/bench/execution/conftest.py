from __future__ import annotations

from typing import Any

import pytest
from fathom.bench.execution import sweep as runner
from fathom.bench.execution import worker as working


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was run, by name; in this process, since what is tried here is which runs are made."""
    names: list[str] = []
    bench = working.WorkerCache()

    def here(tasks: Any, jobs: int) -> Any:
        for task in tasks:
            names.append(str(task.run))
            yield bench.execute(task)

    monkeypatch.setattr(runner, "run_all", here)
    return names
