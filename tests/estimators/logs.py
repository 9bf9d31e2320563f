"""Logs that several of these tests share."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from fathom.datasets import Log, Scenario, simulate
from fathom.datasets.simulated.specs import DvlSpec, GpsSpec

DELAYED = {"dvl": DvlSpec(delay_s=0.31), "gps": GpsSpec(delay_s=0.83)}


def until(log: Log, t_ns: int, *sensors: str) -> Log:
    """The log with no reading of a later time; of some sensors, or of all."""
    streams = {}
    for name in sensors or log.streams:
        s = log.streams[name]
        rows = s.t_ns <= t_ns
        streams[name] = type(s)(s.t_ns[rows], s.received_ns[rows], s.z[rows], s.sigma[rows])
    return replace(log, **streams)


@cache
def full() -> Log:
    return simulate(Scenario(duration_s=20), seed=5)


@cache
def unmeasured(pattern: str, sigma: float = np.inf, z: float | None = 0.0) -> Log:
    """A short log, whose DVL is a wheel ("wheel"), or has one reading in three of all axes ("by rows").

    What is not measured reads z (random numbers around it where it is not zero; as it was where it is None).
    """
    log = full()
    assert log.dvl is not None
    out = np.zeros(log.dvl.z.shape, np.bool_)
    out[:, 1:] = True
    if pattern == "by rows":
        out[::3] = False
    z_all, sigmas = log.dvl.z.copy(), np.where(out, sigma, log.dvl.sigma)
    if z is not None:
        z_all[out] = z * np.random.default_rng(1).normal(size=out.sum())
    return replace(log, dvl=replace(log.dvl, z=z_all, sigma=sigmas))
