"""GTSAM's two fixed-lag smoothers are one estimator: the batch one says what iSAM2 says with nothing put off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import gaps_in_sigma, run_log
from fathom.datasets.epochs import cut
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DvlSpec, GpsSpec, HeadingSpec
from fathom.estimators import Diverged, create
from fathom.estimators.graph.gtsam_border import gtsam_failures
from fathom.estimators.graph.solvers import BatchSolver

TACTICAL = Scenario(duration_s=60.0, imu="tactical")
EVERY_STEP_ANEW = {"relinearize": (0.0, 0.0, 0.0, 0.0), "wildfire": 0.0}
ON_GTSAM = ["fls", "fls-batch", "isam2", "batch"]


@pytest.mark.slow
def test_batch_and_incremental_lags_agree_in_state_and_in_covariance() -> None:
    """All 15 components, online and smoothed, from the second tick on."""
    log = simulate(replace(TACTICAL, duration_s=30.0), seed=4)
    incremental, batch = run_log(log, create("fls", **EVERY_STEP_ANEW)), run_log(log, create("fls-batch"))
    assert batch.status == "done", batch.cause
    assert batch.counts == incremental.counts
    for a, b, bound in (
        (incremental.online, batch.online, 0.05),
        (incremental.smoothed, batch.smoothed, 0.05),
    ):
        assert np.nanmax(gaps_in_sigma(a, b)[1:]) < bound
        kept = np.isfinite(a.P[:, 0, 0])
        assert np.array_equal(kept, np.isfinite(b.P[:, 0, 0]))
        ratio = np.sqrt(np.einsum("nii->ni", b.P[kept]) / np.einsum("nii->ni", a.P[kept]))
        assert np.abs(ratio[1:] - 1).max() < 0.02


@pytest.mark.slow
def test_the_batch_lag_uses_late_readings_inside_its_window_and_counts_older_ones() -> None:
    scenario = replace(TACTICAL, duration_s=30.0, gps=GpsSpec(delay_s=1.0), heading=HeadingSpec(delay_s=1.0))
    log = simulate(scenario, seed=3)
    inside, beyond = (run_log(log, create("fls-batch", lag_s=lag_s)) for lag_s in (3.0, 0.5))
    n = sum(np.count_nonzero(s.received_ns <= log.imu.t_ns[-1]) for s in (log.gps, log.heading))
    assert inside.status == beyond.status == "done"
    assert inside.counts["late_used"] == n
    assert beyond.counts["late"] == n
    incremental = run_log(log, create("fls", lag_s=3.0, **EVERY_STEP_ANEW))
    assert gaps_in_sigma(incremental.online, inside.online)[1:].max() < 0.05


@pytest.mark.slow
def test_with_nothing_marginalised_batch_and_incremental_lags_are_one_also_preintegrated() -> None:
    """At 3 s they are 0.2 sigma apart: iSAM2 marginalises after one step of its own, the batch one at its optimum."""
    log = simulate(replace(TACTICAL, duration_s=30.0), seed=2)
    options = {"lag_s": 100.0, "dvl": ["preintegrated-loose"]}
    incremental = run_log(log, create("fls", extra_updates=2, **EVERY_STEP_ANEW, **options))
    batch = run_log(log, create("fls-batch", **options))
    assert batch.status == "done", batch.cause
    assert batch.counts["preintegrated"] == incremental.counts["preintegrated"] > 100
    for a, b in ((incremental.online, batch.online), (incremental.smoothed, batch.smoothed)):
        assert np.nanmax(gaps_in_sigma(a, b)) < 1e-3


@pytest.mark.parametrize("name", ["fls", "fls-batch"])
def test_a_lag_of_nothing_is_a_filter(name: str) -> None:
    """Online it ends where the filter ends; smoothed, its keyframes equal its online states."""
    log = simulate(TACTICAL, seed=4)
    result, eskf = run_log(log, create(name, lag_s=0.0)), run_log(log, create("eskf"))
    assert result.status == "done", result.cause
    assert gaps_in_sigma(eskf.online, result.online)[20:, 3:6].max() < 0.1
    ratio = np.sqrt(np.einsum("nii->ni", result.online.P) / np.einsum("nii->ni", eskf.online.P))
    assert np.abs(ratio[20:] - 1).max() < 0.02
    assert result.smoothed.lookahead_s == 0.0
    for part in ("t_ns", "R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g"):  # every tick is a keyframe here
        assert np.array_equal(getattr(result.smoothed, part), getattr(result.online, part)), part
    kept = np.isfinite(result.smoothed.P[:, 0, 0])
    assert np.allclose(result.smoothed.P[kept], result.online.P[kept], rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", ["fls", "fls-batch"])
def test_a_lag_of_nothing_takes_odd_rates_and_counts_what_is_late(name: str) -> None:
    scenario = replace(TACTICAL, duration_s=20.0, dvl=DvlSpec(rate_hz=3.7), heading=HeadingSpec(delay_s=0.4))
    result = run_log(simulate(scenario, seed=4), create(name, lag_s=0.0))
    assert result.status == "done", result.cause
    assert result.counts["late"] > 80
    assert len(result.smoothed) == len(result.online)


@pytest.mark.parametrize("name", ON_GTSAM)
def test_what_any_solver_throws_ends_the_run_as_diverged_with_cause_time_and_variable(name: str) -> None:
    """Cholesky on the IMU noise of a tactical grade; a wheel on which this fails has learnt to."""
    log = simulate(replace(TACTICAL, duration_s=20.0), seed=1)
    result = run_log(log, create(name, factorization="CHOLESKY"))
    assert result.status == "diverged"
    assert "Indeterminate linear system" in result.cause
    assert "Symbol: v1" in result.cause
    assert result.failed_at_s == pytest.approx(0.2)  # the first DVL reading, which makes keyframe 1


@pytest.mark.parametrize("name", ON_GTSAM)
def test_a_factor_on_a_variable_that_is_gone_ends_the_run_as_diverged(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the middle of the run: the solver's own exception, not one of ours."""
    from fathom.estimators.graph import graph_pass

    original = graph_pass.reading_factor
    monkeypatch.setattr(graph_pass, "reading_factor", lambda i, *rest: original(i if i != 25 else 12345, *rest))
    result = run_log(
        simulate(replace(TACTICAL, duration_s=20.0), seed=1), create(name, lag_s=1.0) if "fls" in name else create(name)
    )
    assert result.status == "diverged"
    assert "x12345" in result.cause
    assert result.failed_at_s == pytest.approx(5.0)


@pytest.mark.parametrize("name", ON_GTSAM)
def test_a_state_that_is_gone_is_a_divergence_too(name: str) -> None:
    """Of another exception: what C++ calls out of range, Python calls an IndexError."""
    log = simulate(replace(TACTICAL, duration_s=20.0), seed=1)
    run = create(name).begin(log.prior, log.rig)
    with pytest.raises(Diverged, match="x12345"), gtsam_failures():
        run._solver.state(12345)


def test_what_the_last_optimisation_throws_ends_the_run_as_diverged(monkeypatch: pytest.MonkeyPatch) -> None:
    import gtsam
    from gtsam.symbol_shorthand import X

    original = BatchSolver.finish

    def finish(self: BatchSolver) -> None:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
        self._every_factor.add(gtsam.PriorFactorPose3(X(12345), gtsam.Pose3(), noise))
        original(self)

    monkeypatch.setattr(BatchSolver, "finish", finish)
    log = simulate(replace(TACTICAL, duration_s=20.0), seed=1)
    result = run_log(log, create("batch"))
    assert result.status == "diverged"
    assert "x12345" in result.cause
    assert result.failed_at_s == pytest.approx(20.0)
    assert len(result.online) == 20


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fls", "fls-batch"])
def test_factor_slots_stay_bounded_over_ten_thousand_keyframes(name: str) -> None:
    scenario = replace(TACTICAL, duration_s=501.0, dvl=DvlSpec(rate_hz=20.0), depth=None, heading=HeadingSpec(1.0))
    log = simulate(scenario, seed=1)
    run, slots = create(name, lag_s=0.5).begin(log.prior, log.rig), []
    solver = run._solver
    for epoch in cut(log).epochs:
        run.step(epoch)
        if run.counts["keyframes"] % 100 == 0:
            slots.append((solver.isam2.getFactorsUnsafe() if name == "fls" else solver._smoother.getFactors()).size())
    assert run.counts["keyframes"] > 10_000
    assert max(slots[len(slots) // 2 :]) <= max(slots[: len(slots) // 10]) + 10 < 200
