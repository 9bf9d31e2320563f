"""An estimator that refuses a log makes a failed run, which says why."""

from __future__ import annotations

import pytest
from fathom.bench.execution.drive import run_log
from fathom.datasets import Scenario, simulate
from fathom.estimators import ESTIMATORS, create


@pytest.mark.parametrize("name", ESTIMATORS)
def test_without_a_latitude_the_run_fails_and_names_it(name: str) -> None:
    log = simulate(Scenario(duration_s=20.0), seed=1)
    result = run_log(log, create(name, earth_rotation=True))
    assert result.status == "failed"
    assert "latitude" in result.cause
