from __future__ import annotations

import gc
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from fathom.bench.execution.drive import run_log, score_ticks, warm_up
from fathom.bench.execution.result import costs, innovation_dof, innovation_scores
from fathom.bench.execution.task import parquet
from fathom.bench.metrics.energy_score import energy_score
from fathom.bench.metrics.scoring import COSTS, INNOVATIONS, SCORES, Scoring, scores
from fathom.datasets import Belief, Log, NavState, Rig, Trajectory
from fathom.datasets.epochs import Epoch
from fathom.datasets.log import ImuStream
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DvlSpec, GpsSpec
from fathom.estimators import FACTORS, Diverged, create
from scipy.stats import chi2


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Scenario(duration_s=30.0), seed=3)


@dataclass(frozen=True)
class Fake:
    """An estimator that answers with the state `answer(t_ns)` and, at each step, does `act(epochs so far)`."""

    answer: Callable[[int], tuple[NavState, np.ndarray]]
    act: Callable[[int], object] = lambda k: None
    smoothed: Callable[[], Trajectory | None] = lambda: None
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
        return self.fake.smoothed()


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
    assert row["nees_position"] == pytest.approx((3**2 + 4**2) / 2**2)
    assert set(row) == set(SCORES)


def test_alignment_forgives_an_offset_and_then_the_covariance_is_not_judged(log: Log) -> None:
    estimate = run_log(log, Fake(truthful(log, (3.0, 4.0, 0.0)))).online
    row = scores(log, estimate, Scoring(align="yaw"))
    assert row["ate_rmse_m"] == pytest.approx(0.0, abs=1e-8)
    assert row["nees_position"] is None


def test_covariances_are_not_judged_against_another_filters_output(log: Log) -> None:
    reference = replace(log, truth_kind="reference")
    row = scores(reference, run_log(reference, Fake(truthful(log))).online)
    assert row["nees_position"] is None
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
    exact, spoilt_ns = truthful(log), log.start_ns + 12 * 10**9
    result = run_log(log, Fake(lambda t_ns: spoil(*exact(t_ns)) if t_ns >= spoilt_ns else exact(t_ns)))
    assert result.status == "diverged"
    assert cause in str(result.cause)
    assert result.failed_at_s == pytest.approx(12.0)
    assert result.online is not None
    assert len(result.online) == 11


def test_an_estimator_without_covariance_is_none_the_worse(log: Log) -> None:
    exact = truthful(log)
    result = run_log(log, Fake(lambda t_ns: (exact(t_ns)[0], np.full((15, 15), np.nan))))
    assert result.status == "done"
    assert result.online is not None
    assert result.online.P is None
    assert scores(log, result.online)["nees_position"] is None


def test_a_pass_may_reuse_its_arrays(log: Log) -> None:
    exact, P = truthful(log), np.zeros((15, 15))
    shared = exact(log.start_ns)[0]

    def answer(t_ns: int) -> tuple[NavState, np.ndarray]:
        shared.p_WB_W[:] = exact(t_ns)[0].p_WB_W
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


def test_without_prior_one_is_made_and_reported(log: Log) -> None:
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

    result = run_log(log, Fake(truthful(log), smoothed=stuck))
    assert (result.status, result.cause) == ("diverged", "indeterminate")
    assert result.failed_at_s == pytest.approx(30.0)
    assert list(result.outputs) == ["online"]


def test_smoothed_states_come_beside_the_online_ones(log: Log) -> None:
    assert log.truth is not None
    better = replace(log.truth.select(slice(100, None, 100)), lookahead_s=7.0)
    result = run_log(log, Fake(truthful(log, (1.0, 0.0, 0.0)), smoothed=lambda: better))
    assert [(name, t.lookahead_s) for name, t in result.outputs.items()] == [("online", 0.0), ("smoothed", 7.0)]
    assert [scores(log, t)["ate_rmse_m"] for t in result.outputs.values()] == pytest.approx([1.0, 0.0])


def test_costs_add_up(log: Log) -> None:
    result = run_log(log, Fake(truthful(log), lambda k: time.sleep(0.001)))
    row = costs(result)
    assert set(row) == {*COSTS, "step_histogram"} - {"peak_mb"}
    assert row["total_s"] == pytest.approx(result.step_ns.sum() * 1e-9 + result.finish_ns * 1e-9)
    assert row["real_time_factor"] == pytest.approx(30.0 / row["total_s"])
    assert row["us_per_imu_sample"] == pytest.approx(1e6 * row["total_s"] / 3000)
    assert result.step_cpu_ns.shape == result.step_ns.shape
    assert (result.step_cpu_ns <= result.step_ns).all()
    assert row["cpu_s"] < 0.5 * row["total_s"]  # a sleeping thread does not work
    assert row["step_cpu_median_us"] == pytest.approx(np.median(result.step_cpu_ns) / 1e3)
    outputs_s = 30.0 * 50 * result.belief_ns.mean() * 1e-9
    charged = costs(result, 50.0)["us_per_imu_sample_with_outputs"]
    assert charged == pytest.approx(1e6 * (row["total_s"] + outputs_s) / 3000)
    assert costs(result, 0.0)["us_per_imu_sample_with_outputs"] == row["us_per_imu_sample"]
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
    absent = ("rotation_rmse_deg", "heading_rmse_deg", "velocity_rmse_m_s", "rpe_rmse_m", "nees_position")
    assert [row[name] for name in absent] == [None] * len(absent)


def test_a_warm_estimator_does_not_compile_in_its_first_step(log: Log) -> None:
    estimator = create("eskf")
    warm_up(estimator)
    step_ns = run_log(log, estimator).step_ns
    assert step_ns[0] < 1000 * np.median(step_ns)


# -- consistency ------------------------------------------------------------------------------------------------------


def test_nees_of_every_block_and_coverage_are_of_the_errors_there_are(log: Log) -> None:
    row = scores(log, run_log(log, Fake(truthful(log, (1.0, 3.0, 5.0)))).online)  # ½, 1½ and 2½ σ
    assert row["nees_position"] == row["nees_all"] == pytest.approx(35 / 4)
    assert [row[f"nees_{block}"] for block in ("attitude", "velocity", "biases")] == pytest.approx([0] * 3, abs=1e-9)
    assert [row[f"within_{k}sigma_position"] for k in (1, 2, 3)] == pytest.approx([1 / 3, 2 / 3, 1])
    assert [row[f"within_{k}sigma_all"] for k in (1, 2, 3)] == pytest.approx([13 / 15, 14 / 15, 1])
    assert [row[f"inside_{percent}_position"] for percent in (50, 90, 99)] == [0, 0, 1]  # P(χ²₃ < 35/4) is 0.967
    assert [row[f"inside_{percent}_all"] for percent in (50, 90, 99)] == [1, 1, 1]  # P(χ²₁₅ < 35/4) is 0.11
    sphere = energy_score(np.array([[1.0, 3.0, 5.0]]), 4 * np.eye(3)[None])
    assert row["energy_score_m"] == pytest.approx(sphere[0])
    assert row["n_not_positive"] == 0


def test_a_covariance_that_is_none_is_counted_and_spares_the_blocks_that_are(log: Log) -> None:
    exact, broken = truthful(log, (1.0, 3.0, 5.0)), 4 * np.eye(15)
    broken[14, 14] = -1e-9
    row = scores(log, run_log(log, Fake(lambda t_ns: (exact(t_ns)[0], broken))).online)
    assert row["n_not_positive"] == 30
    assert (row["nees_all"], row["nees_biases"]) == (None, None)
    assert row["nees_position"] == pytest.approx(35 / 4)


def test_a_covariance_kept_now_and_then_is_judged_then(log: Log) -> None:
    online = run_log(log, Fake(truthful(log, (1.0, 3.0, 5.0)))).online
    assert online is not None
    assert online.P is not None
    P = np.where((np.arange(30) % 7 == 0)[:, None, None], online.P, np.nan)
    row = scores(log, replace(online, P=P))
    assert row["nees_all"] == pytest.approx(35 / 4)
    assert row["within_1sigma_position"] == pytest.approx(1 / 3)
    assert [row[f"inside_{percent}_position"] for percent in (50, 90, 99)] == [0, 0, 1]
    nowhere = scores(log, replace(online, P=P * np.nan))
    assert [nowhere[name] for name in ("nees_all", "within_1sigma_all", "inside_50_all", "energy_score_m")] == [
        None
    ] * 4


@dataclass(frozen=True)
class Believing(Fake):
    """A fake that takes sensors for better or worse than they are."""

    inflate: dict[str, float] | None = None


def test_an_estimator_with_the_truth_has_the_sensors_noise_for_innovations(log: Log) -> None:
    """Theory by another road than any filter's: r is the reading's own error, and S its own covariance."""
    result = run_log(log, Believing(truthful(log, sigma=1e-9), inflate={"heading": 0.5}), nis=True)
    dof = innovation_dof(result)
    assert dof == {"dvl": 450, "depth": 300, "gps": 45, "heading": 150}
    assert result.nis is not None
    assert result.nis["dof"].sum() == sum(dof.values())
    assert (np.diff(result.nis["t_ns"]) >= 0).all()
    row = innovation_scores(result)
    assert set(row) == set(INNOVATIONS)
    for sensor, inflated in {"dvl": 1, "depth": 1, "gps": 1, "heading": 0.5}.items():
        low, high = chi2.interval(0.999, dof[sensor])
        assert low < row[f"nis_{sensor}"] * dof[sensor] * inflated**2 < high, sensor


def test_nis_is_absent_without_covariance_and_where_it_was_not_asked_for(log: Log) -> None:
    for result in (run_log(log, create("dead-reckoning"), nis=True), run_log(log, Fake(truthful(log)))):
        assert result.status == "done"
        assert set(innovation_scores(result).values()) == {None}
        assert innovation_dof(result) == {}
    assert result.nis is None


DELAYED = {"dvl": DvlSpec(delay_s=0.31), "gps": GpsSpec(delay_s=0.83)}


def test_readings_that_come_late_are_counted_and_not_judged(log: Log) -> None:
    late = simulate(Scenario(duration_s=30.0, **DELAYED), seed=3)
    result = run_log(late, Fake(truthful(late, sigma=1e-9)), nis=True)
    assert innovation_dof(result).keys() == {"depth", "heading"}
    heard = sum(int((s.received_ns <= late.imu.t_ns[-1]).sum()) for s in (late.dvl, late.gps))
    assert result.counts["nis_late"] == heard > 100
    assert result.counts["nis_undefined"] == 0


@pytest.mark.parametrize("name", ["eskf", "iekf", "rts"])
def test_late_readings_are_judged_where_they_are_replayed(name: str) -> None:
    late = simulate(Scenario(duration_s=30.0, surface_for_s=30.0, **DELAYED), seed=3)
    result, plain = run_log(late, create(name), nis=True), run_log(late, create(name))
    dof = innovation_dof(result)
    heard = {name: int((late.streams[name].received_ns <= late.imu.t_ns[-1]).sum()) for name in ("dvl", "gps")}
    assert {name: dof[name] for name in heard} == {name: 3 * n for name, n in heard.items()}  # each of them, once
    assert (result.counts["nis_late"], result.counts["nis_undefined"]) == (0, 0)
    assert (np.diff(result.nis["t_ns"]) >= 0).all()
    row = innovation_scores(result)
    for sensor, n in dof.items():
        low, high = chi2.interval(1 - 1e-4, n)
        assert low < row[f"nis_{sensor}"] * n < high, sensor
    assert np.abs(result.online.p_WB_W - plain.online.p_WB_W).max() < 1e-9


def test_a_reading_too_late_to_be_replayed_is_counted_and_not_judged() -> None:
    late = simulate(Scenario(duration_s=30.0, **DELAYED), seed=3)
    result = run_log(late, create("eskf", max_delay_s=0.5), nis=True)
    assert innovation_dof(result).keys() == {"dvl", "depth", "heading"}
    assert result.counts["nis_late"] == result.counts["late"] > 0


def test_a_belief_under_which_no_reading_is_possible_is_counted(log: Log) -> None:
    exact = truthful(log)
    result = run_log(log, Fake(lambda t_ns: (exact(t_ns)[0], -100 * np.eye(15))), nis=True)
    assert result.counts["nis_undefined"] == 150 + 300 + 15 + 150
    assert set(innovation_scores(result).values()) == {None}


def test_a_step_in_halves_is_timed_as_one_and_the_belief_between_is_not_charged(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that only steps (1 µs) and beliefs (1 ms) move on."""
    now_ns = 0

    def spend(ns: int) -> None:
        nonlocal now_ns
        now_ns += ns

    monkeypatch.setattr("fathom.bench.execution.drive.perf_counter_ns", lambda: now_ns)
    exact = truthful(log)

    def answer(t_ns: int) -> tuple[NavState, np.ndarray]:
        spend(1_000_000)
        return exact(t_ns)

    seen: list[Epoch] = []
    halves: list[Epoch] = []
    whole = run_log(log, Fake(answer, lambda k: spend(1000), seen=seen))
    result = run_log(log, Fake(answer, lambda k: spend(1000), seen=halves), nis=True)
    assert whole.step_ns.tolist() == [1000] * len(seen)
    assert result.step_ns.tolist() == [2000 if len(epoch.readings) else 1000 for epoch in seen]
    assert result.belief_ns.tolist() == whole.belief_ns.tolist() == [1_000_000] * 30
    assert (result.duration_s, result.imu_samples) == (whole.duration_s, whole.imu_samples)
    assert np.array_equal(np.concatenate([e.imu for e in halves]), np.concatenate([e.imu for e in seen]))
    assert np.array_equal(np.concatenate([e.readings for e in halves]), np.concatenate([e.readings for e in seen]))
    assert not [e for e in halves if len(e.imu) and len(e.readings)]
    assert [e.t_ns for e in halves if e.tick] == [e.t_ns for e in seen if e.tick]


@pytest.mark.parametrize(
    ("name", "readings"),
    [("eskf", {}), ("eskf", DELAYED), ("iekf", {}), ("rts", {}), ("rts", DELAYED), ("fls", {})],
    ids=lambda value: value if isinstance(value, str) else "delayed" if value else "in-time",
)
def test_collecting_nis_changes_no_estimate(name: str, readings: dict[str, object]) -> None:
    log = simulate(Scenario(duration_s=40.0, **readings), seed=4)
    plain, judged = run_log(log, create(name)), run_log(log, create(name), nis=True)
    assert judged.status == "done"
    assert plain.counts == {name: n for name, n in judged.counts.items() if not name.startswith("nis_")}
    for output, track in plain.outputs.items():
        again = judged.outputs[output]
        assert np.array_equal(again.t_ns, track.t_ns)
        worst = max(np.abs(track.state(k).local(again.state(k))).max() for k in range(len(track)))
        assert worst < 1e-9, output
        assert track.P is not None
        assert again.P is not None
        assert np.allclose(again.P, track.P, rtol=1e-9, atol=1e-15, equal_nan=True)


def test_a_trajectory_is_kept_with_the_blocks_of_its_covariance(log: Log) -> None:
    online = run_log(log, create("eskf")).online
    assert online is not None
    kept, whole = pd.read_parquet(io.BytesIO(parquet(online))), online.to_pandas()
    blocks = [f"P_{i}_{j}" for i in range(15) for j in range(i, 15) if i // 3 == j // 3]
    assert list(kept) == [name for name in whole if not name.startswith("P_") or name in blocks]
    assert set(kept[blocks].dtypes) == {np.dtype("float32")}
    pd.testing.assert_frame_equal(kept, whole[list(kept)].astype(dict.fromkeys(blocks, "float32")), check_exact=True)
