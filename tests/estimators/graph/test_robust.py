"""Robust losses: their widths, their weights, and what they are worth where readings lie."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from driver import Driven, rmse_m, run_log
from fathom.datasets import Belief, Log, Trajectory
from fathom.datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import GpsSpec
from fathom.estimators import FACTORS, create
from fathom.estimators.graph.gtsam_border import carried_factor, displacement_factor, insert_state, reading_factor
from fathom.estimators.graph.losses import distance, m_estimator, rows, with_loss
from fathom.estimators.physics.imu import BLOCK, compile_rig, integrate
from fathom.estimators.physics.state import as_record
from fathom.estimators.robust import WIDTHS, Loss, width
from paths import Path, random_rig, random_rotation, random_state, reading
from scipy.integrate import quad
from scipy.stats import binom, chi2, norm

LOSSES: list[Loss] = ["huber", "cauchy", "tukey"]
SURFACE = Scenario(duration_s=60.0, imu="tactical", gps=GpsSpec(rate_hz=5.0))


def weight_of(loss: Loss, d: float, k: float) -> float:
    if loss == "huber":
        return min(1.0, k / d)
    return 1 / (1 + (d / k) ** 2) if loss == "cauchy" else max(0.0, 1 - (d / k) ** 2) ** 2


# --- widths and weights ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_costs_five_percent_where_noise_is_normal(loss: Loss) -> None:
    """Asymptotic efficiency of a location estimate, (E ψ')² / E ψ², with ψ(d) = w(d) d: 95 % at the width."""
    k = WIDTHS[loss]

    def psi(d: float) -> float:
        return d * weight_of(loss, abs(d), k) if d else 0.0

    edges = [-k, k]
    square = quad(lambda d: psi(d) ** 2 * norm.pdf(d), -12, 12, points=edges)[0]
    slope = quad(lambda d: psi(d) * d * norm.pdf(d), -12, 12, points=edges)[0]  # E ψ' = E[ψ d], by parts
    assert slope**2 / square == pytest.approx(0.95, abs=2e-4)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_normal_residual_is_beyond_its_width_as_often_for_any_number_of_rows(loss: Loss, n: int) -> None:
    draws = 200_000
    beyond = np.linalg.norm(np.random.default_rng(n).normal(size=(draws, n)), axis=1) > width(loss, n)
    low, high = binom.interval(0.999, draws, 2 * norm.sf(WIDTHS[loss]))
    assert low <= beyond.sum() <= high


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(
    "what", ["dvl", "wheels", "depth", "gps", "flat gps", "heading", "attitude", "carried", "displacement"]
)
def test_under_a_loss_a_factor_keeps_its_residual_and_is_weighted(what: str, loss: Loss, seed: int) -> None:
    """At random states and mountings; what is not measured (an infinite sigma) stays without a pull."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    record, values = compile_rig(rig, FACTORS, {}), gtsam.Values()
    for i in range(2):
        insert_state(values, i, random_state(rng), rig.imu.R_BS)
    kinds = {"dvl": DVL, "wheels": DVL, "depth": DEPTH, "gps": GPS, "flat gps": GPS, "heading": HEADING}
    n = {"depth": 1, "heading": 1, "wheels": 2, "flat gps": 2}.get(what, 3)
    if what in kinds or what == "attitude":
        z = random_rotation(rng).ravel() if what == "attitude" else rng.normal(size=3)
        sigma = np.full(3, 20.0)
        sigma[n:] = np.inf
        factor = reading_factor(0, reading(kinds.get(what, ATTITUDE), z, sigma), record)
    elif what == "carried":
        imu, block = Path(seed).imu(0.01 * np.arange(0, 31), 0.01, rig, np.zeros(3), np.zeros(3)), np.zeros(1, BLOCK)
        integrate(imu[1:], imu[:1], np.zeros(3), np.zeros(3), record, block)
        at_i = as_record(Belief(0, random_state(rng), np.eye(15)))
        factor = carried_factor(0, reading(DVL, rng.normal(size=3), np.full(3, 0.3)), block, at_i, record)
    else:
        A = rng.normal(size=(3, 3))
        factor = displacement_factor(0, 1, 10 * rng.normal(size=3), 100 * (A @ A.T + np.eye(3)))
    assert rows(factor) == n
    robust = with_loss(factor, loss)
    d = float(np.linalg.norm(factor.whitenedError(values)))
    assert distance(robust, values) == pytest.approx(d)
    A, b = factor.linearize(values).jacobian()
    A_robust, b_robust = robust.linearize(values).jacobian()
    root = np.sqrt(weight_of(loss, d, width(loss, n)))
    assert np.allclose(A_robust, root * A, atol=1e-9 * np.abs(A).max())
    assert np.allclose(b_robust, root * b, atol=1e-9 * np.abs(b).max())
    assert m_estimator(loss, n).weight(d) == pytest.approx(root**2)


# --- what they are worth ---------------------------------------------------------------------------------------------


def _gap_squared(a: Trajectory, b: Trajectory, after: int) -> np.ndarray:
    return ((a.p_WB_W - b.p_WB_W) ** 2 / np.einsum("nii->ni", a.P)[:, 3:6])[after:]


@cache
def _plain() -> tuple[Log, Driven]:
    log = simulate(SURFACE, seed=4)
    return log, run_log(log, create("fls"))


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_with_normal_noise_a_loss_changes_little_and_counts_the_share_of_theory(loss: Loss) -> None:
    """The plain estimate is efficient, so the robust one's variance is the plain one's plus that of their difference
    (Hausman 1978): 1/0.95 − 1 of a variance. Positions are three numbers over such a log, their course is smooth. An
    estimate leans towards each reading, which hides at most a tenth of a residual's variance here.
    """  # fmt: skip
    log, plain = _plain()
    sensors = ["gps", "heading"] + (["dvl", "depth"] if loss != "tukey" else [])
    result = run_log(log, create("fls", robust=dict.fromkeys(sensors, loss)))
    assert result.status == "done", result.cause
    assert _gap_squared(plain.online, result.online, 20).mean() < (1 / 0.95 - 1) * chi2.isf(1e-3, 3) / 3
    for sensor in sensors:
        n, k = np.count_nonzero(getattr(log, sensor).received_ns <= log.imu.t_ns[-1]), WIDTHS[loss]
        low, high = binom.ppf(5e-4, n, 2 * norm.sf(k / np.sqrt(0.9))), binom.ppf(1 - 5e-4, n, 2 * norm.sf(k))
        assert low <= result.counts[f"outliers_{sensor}"] <= high, (sensor, n)


def _spoilt(log: Log) -> tuple[Log, int]:
    """Move one GPS reading in ten by 50 m east and 50 m north, but for the first three seconds."""
    bad, z = np.zeros(len(log.gps), bool), log.gps.z.copy()
    bad[18::10] = True
    z[bad, :2] += 50.0
    return replace(log, gps=replace(log.gps, z=z)), int(np.count_nonzero(log.gps.received_ns[bad] <= log.imu.t_ns[-1]))


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_one_gps_reading_in_ten_fifty_metres_off_ruins_the_plain_smoother_only(loss: Loss) -> None:
    log, plain = _plain()
    spoilt, n = _spoilt(log)
    assert n >= 10
    ruined, robust = run_log(spoilt, create("fls")), run_log(spoilt, create("fls", robust={"gps": loss}))
    good_m = rmse_m(log.truth, plain.smoothed)
    assert rmse_m(log.truth, ruined.smoothed) > good_m + 3.0
    assert rmse_m(log.truth, robust.smoothed) < good_m + (1.0 if loss == "huber" else 0.3)
    low, high = binom.interval(0.999, len(log.gps) - n, 2 * norm.sf(WIDTHS[loss]))
    assert low <= robust.counts["outliers_gps"] - n <= high


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fls-batch", "isam2", "batch"])
def test_every_smoother_on_gtsam_takes_a_loss(name: str) -> None:
    log, plain = _plain()
    spoilt, n = _spoilt(log)
    result = run_log(spoilt, create(name, robust={"gps": "tukey"}))
    assert rmse_m(log.truth, result.online) < rmse_m(log.truth, plain.online) + 0.3
    assert result.counts["outliers_gps"] == n


def test_an_outlier_between_keyframes_does_not_move_the_belief_either() -> None:
    """Beliefs five times a second at keyframes two seconds apart: most see readings that the graph has not seen."""
    log, _ = _plain()
    spoilt, _ = _spoilt(log)
    smoother = create("fls", keyframe_period_s=2.0, robust={"gps": "tukey"})
    clean, robust = (run_log(x, smoother, period_s=0.2).online for x in (log, spoilt))
    assert np.abs(clean.p_WB_W - robust.p_WB_W).max() < 1.0


@pytest.mark.parametrize("loss", LOSSES)
def test_a_gps_without_height_works_under_a_loss(loss: Loss) -> None:
    log, plain = _plain()
    sigma = log.gps.sigma.copy()
    sigma[:, 2] = np.inf
    result = run_log(replace(log, gps=replace(log.gps, sigma=sigma)), create("fls", robust={"gps": loss}))
    assert result.status == "done", result.cause
    assert rmse_m(log.truth, result.online) < rmse_m(log.truth, plain.online) + 0.3


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [0.0, 0.5, 3.0])
def test_preintegrated_dvl_survives_outliers_and_takes_the_dvls_loss(lag_s: float) -> None:
    """Once the biases are known, one velocity in forty is 5 m/s off, so one displacement in eight is 1 m off.

    The walk between its readings makes the covariance of such a sum large, and of no other: it protects itself.
    """
    log = simulate(SURFACE, seed=4)
    z = log.dvl.z.copy()
    z[112::40, 0] += 5.0
    spoilt = replace(log, dvl=replace(log.dvl, z=z))
    options = {"lag_s": lag_s, "dvl": ["preintegrated-loose"]}
    robust = run_log(spoilt, create("fls", robust={"dvl": "cauchy"}, **options))
    plain, spoiled = run_log(log, create("fls", **options)), run_log(spoilt, create("fls", **options))
    assert robust.status == "done", robust.cause
    late = plain.online.t_ns > log.start_ns + 20 * 10**9
    for result in (robust, spoiled):
        assert np.abs(result.online.v_WB_W - plain.online.v_WB_W)[late].max() < 0.02
    assert np.abs(robust.online.v_WB_W - spoiled.online.v_WB_W).max() > 1e-4


def test_tukey_never_hears_a_sensor_that_it_starts_too_far_from() -> None:
    """Known: a prior's velocity is ten of the DVL's sigmas wide; what is beyond five of them has no pull on Tukey."""
    log, _ = _plain()
    state = replace(log.prior.state, v_WB_W=log.truth.v_WB_W[0] + np.array([0.2, 0.0, 0.0]))
    lost = log.with_prior(replace(log.prior, state=state))
    deaf, huber = (run_log(lost, create("fls", robust={"dvl": loss}, factors=["dvl"])) for loss in ("tukey", "huber"))
    assert deaf.counts["outliers_dvl"] == len(log.dvl)
    assert huber.counts["outliers_dvl"] < 0.3 * len(log.dvl)


def test_without_a_loss_nothing_is_counted() -> None:
    assert not [name for name in _plain()[1].counts if name.startswith("outliers")]
