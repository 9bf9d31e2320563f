"""Gates reject outliers at the stated rate, and count each once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import FILTERS, rmse_m, run_log
from fathom.datasets import Log
from fathom.datasets.epochs import KIND
from fathom.datasets.log import GpsStream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DvlSpec
from fathom.estimators import create
from fathom.estimators.physics.innovation import gate_widths
from scipy.stats import binom, chi2


def with_gps_outliers(log: Log, every: int, by_m: float) -> tuple[Log, Log, int]:
    """The log with every so many-th fix thrown sideways, without those fixes, and how many came before its end."""
    gps, bad = log.gps, np.arange(len(log.gps)) % every == every - 1
    z = gps.z + bad[:, None] * [by_m, 0.0, 0.0]
    dirty = GpsStream(gps.t_ns, gps.received_ns, z, gps.sigma)
    sparse = GpsStream(gps.t_ns[~bad], gps.received_ns[~bad], gps.z[~bad], gps.sigma[~bad])
    heard = int((bad & (gps.received_ns <= log.imu.t_ns[-1])).sum())
    return replace(log, gps=dirty), replace(log, gps=sparse), heard


def test_widths_are_quantiles_of_chi_square_and_infinite_without_a_gate() -> None:
    widths = gate_widths({"gps": 0.99, "heading": 0.9})
    assert widths[KIND["gps"], 2] == pytest.approx(chi2.ppf(0.99, 2))
    assert widths[KIND["attitude"], 3] == pytest.approx(chi2.ppf(0.9, 3))
    assert np.isinf(widths[KIND["dvl"]]).all()


@pytest.mark.parametrize("name", FILTERS)
def test_a_gate_rejects_the_stated_share_of_normal_readings(name: str) -> None:
    """Innovations of a consistent filter are white: of n readings the number left out is binomial."""
    out = n = 0
    for seed in range(2):
        log = simulate(Scenario(duration_s=30.0), seed)
        result = run_log(log, create(name, gate={"heading": 0.9}))
        out, n = out + result.counts["outliers_heading"], n + len(log.heading)
    low, high = binom.interval(0.999, n, 0.1)
    assert low <= out <= high


@pytest.mark.parametrize("delay_s", [0.0, 0.9])
@pytest.mark.parametrize("name", FILTERS)
def test_behind_a_gate_outliers_are_as_if_they_were_not_there(name: str, delay_s: float) -> None:
    """And counted once each, though a late DVL makes a filter meet them again and again."""
    scenario = Scenario(duration_s=30.0, dvl=DvlSpec(delay_s=delay_s))
    dirty, sparse, n = with_gps_outliers(simulate(scenario, seed=2), every=3, by_m=60.0)
    gated = run_log(dirty, create(name, gate={"gps": 0.99999}))
    without = run_log(sparse, create(name))
    ungated = run_log(dirty, create(name))
    assert gated.counts["outliers_gps"] == n > 3
    assert np.abs(gated.online.p_WB_W - without.online.p_WB_W).max() < 1e-6
    assert rmse_m(dirty.truth, ungated.online) > 5 * rmse_m(dirty.truth, gated.online)


@pytest.mark.parametrize(
    ("gate", "message"), [({"gsp": 0.99}, "gps"), ({"gps": 1.0}, "less than 1"), ({"gps": 0}, "0")]
)
def test_a_gate_that_cannot_be_is_an_error(gate: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        create("eskf", gate=gate)
