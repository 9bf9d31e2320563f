from __future__ import annotations

import pytest
from fathom.datasets import Log, Scenario, simulate
from written import first_seconds


@pytest.fixture(scope="session")
def log() -> Log:
    """A minute, as the tests of recorders write and read it."""
    return simulate(Scenario(mission="lawnmower", duration_s=60, imu="tactical"), seed=4)


@pytest.fixture(scope="session")
def small(log: Log) -> Log:
    """Its beginning, for tests that read it many times."""
    return first_seconds(log, 2.5)
