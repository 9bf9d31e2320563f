"""An axis that is not measured has no innovation, and lowers no floor."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.bench.execution.drive import run_log, score_ticks
from fathom.bench.execution.result import innovation_dof
from fathom.bench.metrics.floor import floors_along
from fathom.datasets.epochs import DVL
from fathom.estimators import create
from logs import full, unmeasured
from scipy.stats import chi2

PATTERNS = ("wheel", "by rows")
FLEET = {"eskf": {}, "ukf": {}, "fls": {"lag_s": 3.0}}


@pytest.mark.parametrize("name", FLEET)
def test_nis_counts_the_axes_that_are_measured(name):
    for pattern in PATTERNS:
        log = unmeasured(pattern)
        result = run_log(log, create(name, **FLEET[name]), nis=True)
        assert innovation_dof(result)["dvl"] == np.isfinite(log.dvl.sigma).sum()
        nis = result.nis[result.nis["kind"] == DVL]
        low, high = chi2.interval(0.9999, nis["dof"].sum())
        assert low < nis["nis"].sum() < high


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_floor_leaves_the_same_axes_out(pattern):
    ticks = score_ticks(full(), 4.0)
    every, none, poor = (
        floors_along(log, ticks, (0.0, 3.0)) for log in (full(), unmeasured(pattern), unmeasured(pattern, 1e6, None))
    )
    for ahead in (0.0, 3.0):
        of_every, of_none, of_poor = (np.einsum("nii->ni", f[ahead].P) for f in (every, none, poor))
        np.testing.assert_allclose(of_none, of_poor, rtol=1e-6)
        assert (of_none >= of_every * (1 - 1e-9)).all()
        assert (of_none[-1, 6:8] > 1.05 * of_every[-1, 6:8]).any()
