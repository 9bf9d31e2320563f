from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from fathom.bench.run import COSTS, SCORES, Scoring, costs, run_log, score_ticks, scores, warm_up
from fathom.datasets import Belief, Log, NavState, Rig, Trajectory
from fathom.datasets.epochs import Epoch
from fathom.datasets.log import ImuStream
from fathom.datasets.scenario import Scenario
from fathom.datasets.simulator import simulate
from fathom.estimators import FACTORS, Diverged, create


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(duration_s=30.0), seed=3)


@dataclass(frozen=True)
class Fake:
    """An estimator that answers with the state `answer(t_ns)` and, at each step, does `act(epochs so far)`."""

    answer: Callable[[int], tuple[NavState, np.ndarray]]
    act: Callable[[int], object] = lambda k: None
    hindsight: Callable[[], Trajectory | None] = lambda: None
    factors: frozenset[str] = FACTORS
    seen: list[Epoch] | None = None

    def begin(self, prior: Belief, rig: Rig) -> FakePass:
        return FakePass(self, prior)


class FakePass:
    def __init__(self, fake: Fake, prior: Belief) -> None:
        self.fake, self.k, self.t_ns, self.counts = fake, 0, prior.t_ns, {"seen": 0}

    def step(self, epoch: Epoch) -> None:
        self.fake.act(self.k)
        if self.fake.seen is not None:
            self.fake.seen.append(epoch)
        self.k, self.t_ns = self.k + 1, epoch.t_ns
        self.counts["seen"] += 1

    def belief(self) -> Belief:
        return Belief(self.t_ns, *self.fake.answer(self.t_ns))

    def finish(self) -> Trajectory | None:
        return self.fake.hindsight()


def truthful(log: Log, off: tuple[float, float, float] = (0.0, 0.0, 0.0), sigma: float = 2.0) -> Callable:
    """Answer with the truth plus an offset in position, and a covariance of sigma² I."""
    assert log.truth is not None
    truth = log.truth

    def answer(t_ns: int) -> tuple[NavState, np.ndarray]:
        x = truth.state(int(np.searchsorted(truth.t_ns, t_ns)))
        return replace(x, p_WB_W=x.p_WB_W + off), sigma**2 * np.eye(15)

    return answer


def raising(error: BaseException, at: int) -> Callable[[int], None]:
    def act(k: int) -> None:
        if k == at:
            raise error

    return act


def test_beliefs_stand_at_the_truths_own_stamps_and_every_step_is_timed(log: Log) -> None:
    seen: list[Epoch] = []
    result = run_log(log, Fake(truthful(log), seen=seen))
    assert result.status == "done"
    assert result.cause is None
    assert result.online is not None
    assert result.online.t_ns.tolist() == [log.start_ns + s * 10**9 for s in range(1, 31)]
    assert np.isin(result.online.t_ns, log.truth.t_ns).all()
    assert len(result.step_ns) == len(seen) == result.counts["seen"]
    assert len(result.belief_ns) == 30
    assert result.imu_samples == 3000
    assert result.duration_s == pytest.approx(30.0)


def test_a_constant_offset_is_the_ate_and_leaves_the_rpe_at_zero(log: Log) -> None:
    row = scores(log, run_log(log, Fake(truthful(log, (3.0, 4.0, 0.0)))).online, Scoring(rpe_delta=5.0, rpe_unit="s"))
    assert row["ate_rmse_m"] == pytest.approx(5.0)
    assert [row[name] for name in ("ate_max_m", "drms_m", "cep50_m")] == pytest.approx([5.0] * 3)
    assert row["rotation_rmse_deg"] == pytest.approx(0.0, abs=1e-5)
    assert row["rpe_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert row["velocity_rmse_m_s"] == pytest.approx(0.0, abs=1e-12)
    assert row["anees_position"] == pytest.approx((3**2 + 4**2) / 2**2)
    assert set(row) == set(SCORES)


def test_alignment_forgives_an_offset_and_then_the_covariance_is_not_judged(log: Log) -> None:
    estimate = run_log(log, Fake(truthful(log, (3.0, 4.0, 0.0)))).online
    row = scores(log, estimate, Scoring(align="yaw"))
    assert row["ate_rmse_m"] == pytest.approx(0.0, abs=1e-8)
    assert row["anees_position"] is None


def test_covariances_are_not_judged_against_another_filters_output(log: Log) -> None:
    reference = replace(log, truth_kind="reference")
    row = scores(reference, run_log(reference, Fake(truthful(log))).online)
    assert row["anees_position"] is None
    assert row["ate_rmse_m"] == pytest.approx(0.0)


def test_an_estimator_gets_only_the_sensors_of_its_factors(log: Log) -> None:
    seen: list[Epoch] = []
    run_log(log, Fake(truthful(log), factors=frozenset({"depth"}), seen=seen))
    kinds = np.concatenate([epoch.readings["kind"] for epoch in seen])
    assert set(kinds.tolist()) == {1}


def test_divergence_is_a_result_with_cause_and_time(log: Log) -> None:
    seen: list[Epoch] = []
    result = run_log(log, Fake(truthful(log), raising(Diverged("lost bottom and mind"), 100), seen=seen))
    assert (result.status, result.cause) == ("diverged", "lost bottom and mind")
    assert len(result.step_ns) == 100
    assert result.failed_at_s is not None
    assert result.failed_at_s > (seen[-1].t_ns - log.start_ns) * 1e-9
    assert result.online is not None
    assert result.online.t_ns[-1] <= seen[-1].t_ns
    assert scores(log, result.online)["ate_rmse_m"] == pytest.approx(0.0)


def test_any_other_exception_fails_the_run_and_not_the_caller(log: Log) -> None:
    result = run_log(log, Fake(truthful(log), raising(ZeroDivisionError("by\n\nnought"), 100)))
    assert (result.status, result.cause) == ("failed", "ZeroDivisionError: by nought")


def test_keyboard_interrupt_passes_and_the_collector_is_back_on(log: Log) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_log(log, Fake(truthful(log), raising(KeyboardInterrupt(), 10)))
    assert gc.isenabled()


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (lambda x, P: (replace(x, p_WB_W=x.p_WB_W * np.nan), P), "not finite"),
        (lambda x, P: (replace(x, b_g=np.array([0, np.inf, -np.inf])), P), "not finite"),
        (lambda x, P: (replace(x, p_WB_W=np.array([0, 1e12, 0])), P), "m away"),
        (lambda x, P: (x, P * np.nan), "covariance"),
    ],
)
def test_a_belief_that_is_not_finite_or_sane_is_divergence(log: Log, spoil: Callable, cause: str) -> None:
    honest, spoilt_ns = truthful(log), log.start_ns + 12 * 10**9
    result = run_log(log, Fake(lambda t_ns: spoil(*honest(t_ns)) if t_ns >= spoilt_ns else honest(t_ns)))
    assert result.status == "diverged"
    assert cause in str(result.cause)
    assert result.failed_at_s == pytest.approx(12.0)
    assert result.online is not None
    assert len(result.online) == 11


def test_an_estimator_without_covariance_is_none_the_worse(log: Log) -> None:
    honest = truthful(log)
    result = run_log(log, Fake(lambda t_ns: (honest(t_ns)[0], np.full((15, 15), np.nan))))
    assert result.status == "done"
    assert result.online is not None
    assert result.online.P is None
    assert scores(log, result.online)["anees_position"] is None


def test_a_pass_may_reuse_its_arrays(log: Log) -> None:
    honest, P = truthful(log), np.zeros((15, 15))
    shared = honest(log.start_ns)[0]

    def answer(t_ns: int) -> tuple[NavState, np.ndarray]:
        shared.p_WB_W[:] = honest(t_ns)[0].p_WB_W
        return shared, P

    result = run_log(log, Fake(answer))
    assert result.online is not None
    assert scores(log, result.online)["ate_max_m"] == pytest.approx(0.0)


def test_a_belief_for_another_time_fails_the_run(log: Log) -> None:
    class Late(FakePass):
        def belief(self) -> Belief:
            return replace(super().belief(), t_ns=self.t_ns - 1)

    class LateFake(Fake):
        def begin(self, prior: Belief, rig: Rig) -> FakePass:
            return Late(self, prior)

    result = run_log(log, LateFake(truthful(log)))
    assert result.status == "failed"
    assert "asked for a belief at" in str(result.cause)
    assert result.online is None


def test_a_run_out_of_time_fails_and_keeps_its_part(log: Log) -> None:
    result = run_log(log, Fake(truthful(log), lambda k: time.sleep(0.005)), timeout_s=0.5)
    assert (result.status, result.cause) == ("failed", "out of time")
    assert result.online is not None
    assert 0 < len(result.online) < 30


def test_an_imu_gap_too_long_fails_at_its_time_with_the_part_scored(log: Log) -> None:
    imu = log.imu
    keep = (imu.t_ns <= log.start_ns + 10 * 10**9) | (imu.t_ns > log.start_ns + 13 * 10**9)
    gappy = replace(log, imu=ImuStream(imu.t_ns[keep], imu.w_WI_I[keep], imu.f_I[keep]))
    result = run_log(gappy, Fake(truthful(log, (3.0, 4.0, 0.0))))
    assert result.status == "failed"
    assert "imu gap at 10.000 s" in str(result.cause)
    assert result.failed_at_s == pytest.approx(10.0, abs=0.2)
    assert scores(gappy, result.online)["ate_rmse_m"] == pytest.approx(5.0)
    assert run_log(gappy, Fake(truthful(log)), max_gap_s=5.0).status == "done"


def test_without_truth_it_runs_on_a_grid_and_scores_are_absent_not_zero(log: Log) -> None:
    blind = replace(log, truth=None)
    result = run_log(blind, Fake(truthful(log)), score_period_s=2.0)
    assert result.status == "done"
    assert result.online is not None
    assert np.diff(result.online.t_ns).tolist() == [2 * 10**9] * 14
    assert set(scores(blind, result.online).values()) == {None}


def test_without_prior_one_is_made_and_told(log: Log) -> None:
    result = run_log(replace(log, prior=None), create("dead-reckoning"))
    assert result.status == "done"
    assert result.notes
    assert result.online is not None


def test_an_estimator_that_cannot_begin_or_finish_fails(log: Log) -> None:
    class NoStart(Fake):
        def begin(self, prior: Belief, rig: Rig) -> FakePass:
            raise TypeError("no keel")

    result = run_log(log, NoStart(truthful(log)))
    assert (result.status, result.cause, result.online) == ("failed", "TypeError: no keel", None)
    assert costs(result) == {}

    def stuck() -> None:
        raise Diverged("indeterminate")

    result = run_log(log, Fake(truthful(log), hindsight=stuck))
    assert (result.status, result.cause) == ("diverged", "indeterminate")
    assert result.failed_at_s == pytest.approx(30.0)
    assert list(result.outputs) == ["online"]


def test_hindsight_comes_beside_what_was_said_at_the_time(log: Log) -> None:
    assert log.truth is not None
    better = replace(log.truth.select(slice(100, None, 100)), lookahead_s=7.0)
    result = run_log(log, Fake(truthful(log, (1.0, 0.0, 0.0)), hindsight=lambda: better))
    assert [(name, t.lookahead_s) for name, t in result.outputs.items()] == [("online", 0.0), ("hindsight", 7.0)]
    assert [scores(log, t)["ate_rmse_m"] for t in result.outputs.values()] == pytest.approx([1.0, 0.0])


def test_costs_add_up(log: Log) -> None:
    result = run_log(log, Fake(truthful(log), lambda k: time.sleep(0.001)))
    row = costs(result)
    assert set(row) == set(COSTS) - {"peak_mb"}
    assert row["total_s"] == pytest.approx(result.step_ns.sum() * 1e-9 + result.finish_ns * 1e-9)
    assert row["real_time_factor"] == pytest.approx(30.0 / row["total_s"])
    assert row["us_per_imu_sample"] == pytest.approx(1e6 * row["total_s"] / 3000)
    assert 1000 <= row["step_median_us"] <= row["step_p99_us"] <= row["step_max_us"]


def test_a_jittery_truth_keeps_its_stamps_and_a_sparse_one_gains_none(log: Log) -> None:
    assert log.truth is not None
    rng = np.random.default_rng(5)
    rows = 100 * np.arange(1, 30) + rng.integers(-8, 9, 29)
    jittery = replace(log, truth=log.truth.select(rows))
    ticks = score_ticks(jittery, 1.0)
    assert len(ticks) >= 27
    assert np.isin(ticks, jittery.truth.t_ns).all()
    sparse = replace(log, truth=log.truth.select(slice(0, None, 700)))
    assert score_ticks(sparse, 1.0).tolist() == sparse.truth.t_ns.tolist()


def test_an_empty_truth_is_none(log: Log) -> None:
    assert log.truth is not None
    blank = replace(log, truth=log.truth.select(slice(0, 0)))
    assert score_ticks(blank, 1.0).tolist() == score_ticks(replace(log, truth=None), 1.0).tolist()
    result = run_log(blank, Fake(truthful(log)))
    assert result.status == "done"
    assert set(scores(blank, result.online).values()) == {None}


def test_readings_are_counted_with_those_outside_the_log(log: Log) -> None:
    streams = log.streams
    late = replace(streams["dvl"], received_ns=streams["dvl"].received_ns + 10**15)
    counts = run_log(replace(log, dvl=late), Fake(truthful(log), factors=frozenset({"dvl"}))).counts
    assert counts["readings"] == counts["readings_outside"] == len(streams["dvl"])


def test_scores_that_a_buoys_truth_cannot_give_are_absent(log: Log) -> None:
    assert log.truth is not None
    p = log.truth.p_WB_W.copy()
    p[:, 2] = np.nan
    buoy = Trajectory(log.truth.t_ns, np.full_like(log.truth.R_WB, np.nan), p)
    row = scores(replace(log, truth=buoy), run_log(log, Fake(truthful(log, (3, 4, 7)))).online, Scoring(dims="2d"))
    assert row["ate_rmse_m"] == pytest.approx(5.0)
    absent = ("rotation_rmse_deg", "heading_rmse_deg", "velocity_rmse_m_s", "rpe_rmse_m", "anees_position")
    assert [row[name] for name in absent] == [None] * len(absent)


def test_a_warm_estimator_does_not_compile_in_its_first_step(log: Log) -> None:
    estimator = create("eskf")
    warm_up(estimator)
    step_ns = run_log(log, estimator).step_ns
    assert step_ns[0] < 1000 * np.median(step_ns)
