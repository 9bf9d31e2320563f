"""Every residual vanishes on its sensor's own path, and every Jacobian is its derivative; mountings are random."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fathom.datasets import Mounting, NavState, Rig
from fathom.datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING
from fathom.datasets.state import Belief
from fathom.estimators import FACTORS
from fathom.estimators.physics.imu import compile_rig
from fathom.estimators.physics.measurements import measure, preintegrated_dvl_residual
from fathom.estimators.physics.state import as_record
from paths import NOISE, Path, random_rig, random_rotation, random_state, reading, residual
from scipy.spatial.transform import Rotation

KINDS = {"dvl": DVL, "depth": DEPTH, "gps": GPS, "heading": HEADING, "attitude": ATTITUDE}


def numeric_jacobian(f: Callable[[NavState], np.ndarray], x: NavState, step: float = 1e-6) -> np.ndarray:
    """Central differences through the state's own ⊕, so conventions cannot disagree."""
    columns = [f(x.retract(step * e)) - f(x.retract(-step * e)) for e in np.eye(x.dim)]
    return np.stack(columns, axis=1) / (2 * step)


def what_the_sensor_reads(kind: str, path: Path, t_s: float, rig: Rig) -> np.ndarray:
    at = np.array([t_s])
    R_WB = path.R_WB(at)[0]
    R_WH = R_WB @ rig.heading.R_BS
    return {
        "dvl": R_WB.T @ path.velocity(at, np.zeros(3))[0],
        "depth": path.point(at, rig.depth.p_BS_B)[0, 2:],
        "gps": path.point(at, rig.gps.p_BS_B)[0],
        "heading": np.array([Rotation.from_matrix(R_WH).as_euler("ZYX")[0]]),
        "attitude": R_WH.ravel(),
    }[kind]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("kind", KINDS)
def test_residual_vanishes_where_the_sensor_is(kind: str, seed: int) -> None:
    rig, path = random_rig(np.random.default_rng(seed)), Path(seed)
    row = reading(KINDS[kind], what_the_sensor_reads(kind, path, 1.3, rig), np.full(3, 0.1))
    r, _, _ = residual(row, path.state(1.3, np.zeros(3), np.zeros(3)), rig)
    assert np.abs(r).max() < 1e-7


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("kind", KINDS)
def test_jacobian_is_the_derivative_of_the_residual(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, state = random_rig(rng), random_state(rng)
    z = random_rotation(rng).ravel() if kind == "attitude" else rng.normal(size={"depth": 1, "heading": 1}.get(kind, 3))
    row = reading(KINDS[kind], z, np.full(3, 0.1))
    _, H, _ = residual(row, state, rig)
    numeric = numeric_jacobian(lambda x: residual(row, x, rig)[0], state)
    assert np.allclose(H, numeric, atol=1e-6 * max(1, np.abs(numeric).max()))


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(30, 20), (-30, 20), (30, 30), (10, -20)])
def test_heading_alone_is_unbiased_on_a_tilted_vehicle(pitch_deg: float, roll_deg: float) -> None:
    """Equation 3 with R_meas = Rz(yaw) would be off by pitch·roll/2: degrees."""
    R_WB = Rotation.from_euler("ZYX", [40, pitch_deg, roll_deg], degrees=True).as_matrix()
    state = NavState(R_WB, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    r, H, _ = residual(reading(HEADING, np.radians([40.0]), np.array([0.02])), state, Rig(NOISE))
    phi, theta = np.radians(roll_deg), np.radians(pitch_deg)
    assert abs(r[0]) < 1e-12
    assert np.allclose(H[0, :3], [0, np.sin(phi) / np.cos(theta), np.cos(phi) / np.cos(theta)], atol=1e-12)


def test_heading_residual_takes_the_short_way_round() -> None:
    state = NavState(Rotation.from_euler("Z", 179, degrees=True).as_matrix(), *np.zeros((4, 3)))
    r, _, _ = residual(reading(HEADING, np.radians([-179.0]), np.array([0.02])), state, Rig(NOISE))
    assert r[0] == pytest.approx(np.radians(-2))


def test_components_that_were_not_measured_are_left_out() -> None:
    rng = np.random.default_rng(0)
    state, rig = random_state(rng), random_rig(rng)
    full, H, _ = residual(reading(DVL, np.ones(3), np.full(3, 0.1)), state, rig)
    part, H_part, C = residual(reading(DVL, np.ones(3), np.array([np.inf, 0.1, np.inf])), state, rig)
    assert np.array_equal(part, full[1:2])
    assert np.array_equal(H_part, H[1:2])
    assert C.shape == (1, 1)


@pytest.mark.parametrize("mask", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)])
def test_covariance_of_a_partial_reading_is_the_block_of_the_whole(mask: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    state, rig = random_state(rng), compile_rig(random_rig(rng), FACTORS, {})
    A = rng.normal(size=(3, 3))
    rig["rate_cov"] = A @ A.T
    measured = np.array(mask, bool)
    row = reading(DVL, np.ones(3), np.where(measured, [0.1, 0.2, 0.3], np.inf))
    r, H, C = np.zeros(3), np.zeros((3, 15)), np.zeros((3, 3))
    n = measure(row, 0, as_record(Belief(0, state, np.zeros((15, 15)))), rig, r, H, C)
    whole = A @ A.T + np.diag([0.01, 0.04, 0.09])
    assert np.allclose(C[:n, :n], whole[np.ix_(measured, measured)])


def test_a_heading_gives_no_reading_when_its_axis_points_up() -> None:
    R_WB = Rotation.from_euler("ZYX", [40, 89.0, 0], degrees=True).as_matrix()
    state = NavState(R_WB, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    r, H, _ = residual(reading(HEADING, np.radians([70.0]), np.array([0.02])), state, Rig(NOISE))
    assert r[0] == 0.0
    assert not H.any()


def test_inflation_scales_sigma_and_infinity_switches_a_sensor_off() -> None:
    state, rig = random_state(np.random.default_rng(1)), Rig(NOISE, imu=Mounting())
    row = reading(DEPTH, np.zeros(1), np.array([0.1]))
    assert residual(row, state, rig, {"depth": 3.0})[2][0, 0] == pytest.approx(0.09)
    assert len(residual(row, state, rig, {"depth": np.inf})[0]) == 0


@pytest.mark.parametrize("seed", range(10))
def test_preintegrated_dvl_jacobians_are_derivatives_and_the_residual_vanishes_on_a_path(seed: int) -> None:
    path, zero = Path(seed), np.zeros(3)
    i, j = path.state(0.2, zero, zero), path.state(1.4, zero, zero)
    moved = i.R_WB.T @ (j.p_WB_W - i.p_WB_W)
    H_i, H_j = np.zeros((3, 15)), np.zeros((3, 15))
    assert np.abs(preintegrated_dvl_residual(i.R_WB, i.p_WB_W, j.p_WB_W, moved, H_i, H_j)).max() < 1e-12

    def r(a: NavState, b: NavState) -> np.ndarray:
        return preintegrated_dvl_residual(a.R_WB, a.p_WB_W, b.p_WB_W, moved, np.zeros((3, 15)), np.zeros((3, 15)))

    assert np.allclose(H_i, numeric_jacobian(lambda x: r(x, j), i), atol=1e-7)
    assert np.allclose(H_j, numeric_jacobian(lambda x: r(i, x), j), atol=1e-7)
