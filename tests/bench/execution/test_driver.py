"""The harness and the driver that the tests of estimators have of their own say the same, by different roads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import BLOCKS, error_states, heading_error_rad, nees, rmse_m, run_log
from fathom.bench.execution import drive
from fathom.bench.metrics import ate, error_state, state_errors
from fathom.bench.metrics import nees as nees_of
from fathom.datasets import Log, Scenario, simulate
from fathom.estimators import create


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(duration_s=20.0), seed=5)


@pytest.mark.parametrize("name", ["dead-reckoning", "eskf", "rts"])
@pytest.mark.parametrize("period_s", [1.0, 0.37])
def test_both_make_the_same_run(log: Log, name: str, period_s: float) -> None:
    ours, theirs = run_log(log, create(name), period_s), drive.run_log(log, create(name), score_period_s=period_s)
    assert ours.status == theirs.status == "done"
    assert ours.counts.items() <= theirs.counts.items()
    assert (ours.smoothed is None) == (theirs.smoothed is None)
    for a, b in ((ours.online, theirs.online), (ours.smoothed, theirs.smoothed)):
        for part in ("t_ns", "R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g", "P"):
            assert a is None or np.array_equal(getattr(a, part), getattr(b, part)), part


def test_both_find_the_same_errors(log: Log) -> None:
    track = run_log(log, create("eskf")).online
    truth = log.truth.select(np.searchsorted(log.truth.t_ns, track.t_ns))
    errors = error_states(log.truth, track)
    assert np.allclose(errors, error_state(truth, track), rtol=1e-9, atol=1e-12)
    for block, of in BLOCKS.items():
        assert np.allclose(nees(errors, track.P, of), nees_of(log.truth, track, block), rtol=1e-6)
    assert rmse_m(log.truth, track) == pytest.approx(ate(log.truth, track).rmse_m)
    heading_deg = np.degrees(np.sqrt(np.mean(heading_error_rad(log.truth, track) ** 2)))
    assert heading_deg == pytest.approx(state_errors(log.truth, track).heading_deg)


def test_a_hole_of_months_in_the_truth_costs_no_memory(log: Log) -> None:
    truth = log.truth
    far = np.where(truth.t_ns > 10 * 10**9, truth.t_ns + 100 * 86_400 * 10**9, truth.t_ns)
    ticks = drive.score_ticks(replace(log, truth=replace(truth, t_ns=far)), 1e-3)  # a grid would need 69 GB
    assert set(ticks.tolist()) <= set(far.tolist())
    assert {far[0], far[-1]} <= set(ticks.tolist())
