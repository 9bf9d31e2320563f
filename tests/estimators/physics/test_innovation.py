"""The innovations' covariance is the one written out, and of a filter whose noise is right their NIS is chi-square."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from driver import FILTERS
from fathom.datasets import Belief, Rig
from fathom.datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING
from fathom.datasets.state import VELOCITY, NavState
from fathom.estimators import create
from fathom.estimators.filters.eskf_filterpy import stack
from fathom.estimators.interface import FACTORS
from fathom.estimators.physics.imu import compile_rig
from fathom.estimators.physics.innovation import innovations
from fathom.estimators.physics.state import as_record, with_rate_noise
from linear import TOY_RIG, linear_toy
from paths import NOISE, random_rig, random_rotation, random_state, reading
from scipy.stats import chi2, multivariate_normal

SENSORS = ("dvl", "depth", "gps", "heading", "heading")


def random_belief(rng: np.random.Generator) -> Belief:
    root = rng.normal(size=(15, 15)) * 0.1
    return Belief(0, random_state(rng), root @ root.T)


def random_readings(rng: np.random.Generator) -> np.ndarray:
    """One of each kind; of the fix, the height is not measured."""
    values = {DVL: 3, DEPTH: 1, GPS: 3, HEADING: 1}
    rows = [reading(kind, rng.normal(size=n), 0.1 * rng.uniform(1, 2, n), 0) for kind, n in values.items()]
    rows[2]["sigma"][0, 2] = np.inf
    rows.append(reading(ATTITUDE, random_rotation(rng).ravel(), np.full(3, 0.1), 0))
    return np.concatenate(rows)


@pytest.mark.parametrize("seed", range(5))
def test_nis_and_density_are_the_forms_written_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief, readings = random_belief(rng), random_readings(rng)
    rig = compile_rig(random_rig(rng), FACTORS, {"dvl": 2.0, "heading": 0.5})
    table = innovations(belief, readings, rig)
    assert table["dof"].tolist() == [3, 1, 2, 1, 3]
    assert table["kind"].tolist() == readings["kind"].tolist()
    for k, row in enumerate(table):
        r, H, C = stack(as_record(belief), rig, readings[k : k + 1])
        assert np.allclose(np.sqrt(np.diag(C)), rig["inflate"][0, row["kind"]] * readings["sigma"][k][: len(r)])
        S = H @ belief.P @ H.T + C
        assert row["nis"] == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-9)
        assert row["log_density"] == pytest.approx(multivariate_normal(cov=S).logpdf(r), rel=1e-9)
        white = row["white"][: len(r)]
        assert white == pytest.approx(np.linalg.solve(np.linalg.cholesky(S), r), rel=1e-9)
        assert not row["white"][len(r) :].any()


@pytest.mark.parametrize("seed", range(3))
def test_the_rate_noise_of_a_lever_arm_counts_once(seed: int) -> None:
    """In the belief's velocity, as the estimator hands it out; or in the reading, as it corrects by it."""
    rng = np.random.default_rng(seed)
    belief, readings = random_belief(rng), random_readings(rng)[:1]
    rig = compile_rig(random_rig(rng), FACTORS, {})
    inside = rig.copy()
    root = rng.normal(size=(3, 3)) * 0.1
    inside["rate_cov"] = root @ root.T
    handed_out = innovations(with_rate_noise(belief, inside), readings, rig)
    assert handed_out["nis"] == pytest.approx(innovations(belief, readings, inside)["nis"], rel=1e-9)
    assert handed_out["nis"] < 0.99 * innovations(belief, readings, rig)["nis"]


def test_what_measures_nothing_has_no_innovation_and_what_is_no_covariance_no_nis() -> None:
    rng = np.random.default_rng(0)
    belief, readings = random_belief(rng), random_readings(rng)
    rig = random_rig(rng)
    heard = innovations(belief, readings, compile_rig(rig, frozenset({"depth", "heading"}), {}))
    assert heard["kind"].tolist() == [DEPTH, HEADING, ATTITUDE]
    upright = NavState(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), *np.zeros((4, 3)))
    yaw = readings[readings["kind"] == HEADING]
    assert not len(innovations(Belief(0, upright, belief.P), yaw, compile_rig(Rig(NOISE), FACTORS, {})))
    P = belief.P.copy()
    P[VELOCITY, VELOCITY] -= 100 * np.eye(3)
    table = innovations(replace(belief, P=P), readings, compile_rig(rig, FACTORS, {}))
    for name in ("nis", "log_density"):
        assert np.isnan(table[name]).tolist() == [True, False, False, False, False]
    assert np.isnan(innovations(replace(belief, P=P * np.nan), readings, compile_rig(rig, FACTORS, {}))["nis"]).all()


@pytest.mark.parametrize("name", FILTERS)
def test_where_all_is_linear_nis_is_chi_square(name: str) -> None:
    """Every estimator is asked between an epoch's motion and its readings; 20 voyages, innovations being white."""
    rig = compile_rig(TOY_RIG, FACTORS, {})
    total, dof, of_prior = dict.fromkeys(SENSORS, 0.0), dict.fromkeys(SENSORS, 0), 0.0
    for seed in range(20):
        prior, epochs = linear_toy(seed, epochs=20)
        run = create(name).begin(prior, TOY_RIG)
        for epoch in epochs:
            run.step(epoch._replace(readings=epoch.readings[:0], tick=False))
            table = innovations(run.belief(), epoch.readings, rig)
            run.step(epoch._replace(imu=epoch.imu[:0]))
            of_prior += innovations(run.belief(), epoch.readings, rig)["nis"].sum()
            for row in table:
                total[SENSORS[row["kind"]]] += row["nis"]
                dof[SENSORS[row["kind"]]] += int(row["dof"])
    assert dof == {"dvl": 1200, "depth": 200, "gps": 160, "heading": 0}
    for sensor in ("dvl", "depth", "gps"):
        low, high = chi2.interval(0.999, dof[sensor])
        assert low < total[sensor] < high, sensor
    assert of_prior < chi2.ppf(1e-6, sum(dof.values()))  # against a belief that has seen them: far too small
