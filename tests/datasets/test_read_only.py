"""A log's arrays cannot be written to, through whichever object one comes to them."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from fathom.datasets import Log, Scenario, simulate


def arrays(value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
    for field in fields(value):
        part, name = getattr(value, field.name), f"{path}.{field.name}"
        if isinstance(part, np.ndarray):
            yield name, part
        elif is_dataclass(part):
            yield from arrays(part, name)


def sent(log: Log) -> Log:
    """The log as another process gets it."""
    return pickle.loads(pickle.dumps(log))


@pytest.mark.parametrize("made", [replace, deepcopy, sent])
def test_every_array_of_a_log_is_read_only(made: Callable[[Log], Log]) -> None:
    log = made(simulate(Scenario(duration_s=20.0), seed=1))
    found = dict(arrays(log, "log"))
    assert {"log.imu.f_I", "log.dvl.sigma", "log.rig.gps.R_BS", "log.truth.R_WB", "log.prior.P"} <= found.keys()
    assert {"log.prior.state.R_WB", "log.rig.imu.p_BS_B", "log.heading.received_ns"} <= found.keys()
    assert not [name for name, array in found.items() if array.flags.writeable]
    assert log.prior is not None
    with pytest.raises(ValueError, match="read-only"):
        log.prior.P[:] += 1.0


def test_whoever_made_the_arrays_can_still_write_to_his_own() -> None:
    log = simulate(Scenario(duration_s=20.0), seed=1)
    assert log.prior is not None
    P = np.eye(15)
    other = log.with_prior(type(log.prior)(log.prior.t_ns, log.prior.state, P))
    P[0, 0] = 2.0
    assert other.prior is not None
    assert other.prior.P is not P
