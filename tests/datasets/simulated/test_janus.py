"""Bottom lock: which beams reach the seabed, and the velocity and sigma that they give."""

import dataclasses

import numpy as np
import pytest
from fathom.datasets import DatasetError, Log
from fathom.datasets.epochs import cut
from fathom.datasets.simulated.faults import DvlFaults
from fathom.datasets.simulated.janus import janus_beams
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.seabed import SeabedSpec
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.simulated.specs import DvlSpec
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from variances import assert_variance


def log_of(noise_scale: float = 1.0, seabed: SeabedSpec | None = None, duration_s: float = 300, **dvl) -> Log:
    spec = DvlSpec(**({"rate_hz": 10} | dvl))
    return simulate(
        Scenario(mission="yo-yo", duration_s=duration_s, dvl=spec, seabed=seabed, noise_scale=noise_scale), 6
    )


def poses_at_every_ping(log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, attitudes and positions of B every 0.1 s."""
    rows = np.arange(10, len(log.truth), 10)
    return log.truth.t_ns[rows], log.truth.R_WB[rows], log.truth.p_WB_W[rows]


def test_beams_look_down_and_around():
    A = janus_beams(np.radians(22.5))
    np.testing.assert_allclose(np.linalg.norm(A, axis=1), 1)
    np.testing.assert_allclose(A[:, 2], -np.cos(np.radians(22.5)))
    np.testing.assert_allclose(A.sum(axis=0)[:2], 0, atol=1e-15)


# -- range and tilt


HILLS = SeabedSpec(depth_m=30, relief_m=2.5, relief_length_m=80)


@pytest.mark.parametrize("seabed", [SeabedSpec(depth_m=30), HILLS])
def test_a_beam_reaches_as_far_as_the_seabed(seabed):
    """Along each ray, the root of its height above the seabed; no fixed point."""
    rng = np.random.default_rng(1)
    p_W = rng.uniform([-200, -200, -20], [200, 200, 0], (100, 3))
    R_WB = Rotation.from_euler("ZYX", rng.uniform(-0.5, 0.5, (100, 3))).as_matrix()
    beams_W = janus_beams(np.radians(25)) @ R_WB.transpose(0, 2, 1)
    found = seabed.ranges(p_W, beams_W)
    for p, beams, ranges in zip(p_W, beams_W, found, strict=True):
        for beam, r in zip(beams, ranges, strict=True):

            def above(r, p=p, beam=beam):
                x, y, z = p + r * beam
                return z - seabed.height_m(x, y)

            assert r == pytest.approx(brentq(above, 0, 500, xtol=1e-9), abs=1e-4)
    assert np.ptp(found) > 10


def test_beams_that_do_not_point_down_never_reach_it():
    level = np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, -0.8]]])
    np.testing.assert_allclose(
        SeabedSpec(depth_m=30).ranges(np.array([[0.0, 0.0, -22.0]]), level), [[np.inf, np.inf, 10]]
    )


def test_there_are_readings_while_three_beams_are_in_range():
    log = log_of(seabed=SeabedSpec(depth_m=30), min_range_m=12, max_range_m=22)
    t_ns, R_WB, p_WB_W = poses_at_every_ping(log)
    slant_m = (p_WB_W[:, 2:] + 30) / -(janus_beams(np.radians(22.5)) @ R_WB.transpose(0, 2, 1))[..., 2]
    in_range = ((slant_m >= 12) & (slant_m <= 22)).sum(axis=1)
    assert np.array_equal(log.dvl.t_ns, t_ns[in_range >= 3])
    four = log.dvl.sigma[:, 0] == log.dvl.sigma[:, 0].min()
    assert np.array_equal(log.dvl.t_ns[four], t_ns[in_range == 4])
    assert len(set(in_range)) == 5  # each number of beams occurs
    strict = log_of(seabed=SeabedSpec(depth_m=30), min_range_m=12, max_range_m=22, three_beams=False)
    assert np.array_equal(strict.dvl.t_ns, t_ns[in_range == 4])


def test_hills_decide_too():
    flat, hilly = (log_of(seabed=bed, max_range_m=20) for bed in (SeabedSpec(depth_m=30), HILLS))
    assert set(flat.dvl.t_ns) - set(hilly.dvl.t_ns)
    assert set(hilly.dvl.t_ns) - set(flat.dvl.t_ns)


def test_a_dvl_leaning_too_far_gives_no_reading():
    log = log_of(max_tilt_deg=15, faults=DvlFaults(misalignment_deg=(0, 10, 0)))
    t_ns, R_WB, _ = poses_at_every_ping(log)
    up_D = R_WB @ Rotation.from_euler("Y", 10, degrees=True).as_matrix()
    upright = np.degrees(np.arccos(up_D[:, 2, 2])) <= 15
    assert np.array_equal(log.dvl.t_ns, t_ns[upright])
    assert 0.2 < upright.mean() < 0.8


# -- three beams


def test_lost_beams_leave_the_stated_shares():
    log, p = log_of(beam_loss_probability=0.15), 0.15
    three = log.dvl.sigma[:, 0] > 1.2 * log.dvl.sigma[:, 0].min()
    for count, share in (((~three).sum(), (1 - p) ** 4), (three.sum(), 4 * p * (1 - p) ** 3)):
        low, high = binom.interval(0.999, 3000, share)
        assert low <= count <= high
    strict = log_of(beam_loss_probability=p, three_beams=False)
    assert np.array_equal(strict.dvl.t_ns, log.dvl.t_ns[~three])


def test_three_beams_give_the_velocity_with_sigmas_root_two_larger():
    """By hand, along the opposite pair u = (b1 − b2) / 2s and c w = −(b1 + b2) / 2; the third beam gives the other axis
    with 3 / 2s². Turned by 45°: 1 / s² for x and for y, and 1 / 2c² for z."""
    dials = {"beam_sigma_m_s": 0.01, "beam_angle_deg": 30, "beam_loss_probability": 0.2, "rate_hz": 50}
    noisy, quiet, whole = log_of(**dials), log_of(0.0, **dials), log_of(**dials | {"beam_loss_probability": 0})
    three = noisy.dvl.sigma[:, 0] > 0.019
    np.testing.assert_allclose(
        noisy.dvl.sigma[three], 0.01 * np.array([[2, 2, (2 / 3) ** 0.5]] * three.sum()), rtol=1e-9
    )
    np.testing.assert_allclose(noisy.dvl.sigma[~three], whole.dvl.sigma[: (~three).sum()], rtol=1e-12)
    assert three.sum() > 3000
    error = (noisy.dvl.z - quiet.dvl.z) / noisy.dvl.sigma
    for axis in range(3):
        assert_variance(error[three, axis], 1.0)
    same = np.isin(whole.dvl.t_ns, noisy.dvl.t_ns[~three])
    assert np.array_equal(whole.dvl.z[same], noisy.dvl.z[~three])  # four beams, the same noise


@pytest.mark.parametrize("lost", range(4))
def test_errors_of_three_beams_are_correlated_as_their_covariance_predicts(lost):
    """The DVL leans so that one beam alone is out of range."""
    A = np.delete(janus_beams(np.radians(22.5)), lost, axis=0)
    cov = np.linalg.inv(A.T @ A)
    correlation = cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    np.testing.assert_allclose(np.abs(correlation), 0.5 + 0.5 * np.eye(3), atol=1e-12)
    roll, pitch = {0: (12, -12), 1: (12, 12), 2: (-12, 12), 3: (-12, -12)}[lost]  # this beam's side up
    spec = DvlSpec(rate_hz=50, max_range_m=38, faults=DvlFaults(misalignment_deg=(roll, pitch, 0)))
    base = Scenario(
        mission="transit",
        duration_s=200,
        dvl=spec,
        seabed=SeabedSpec(depth_m=53),
        wobble_deg=0,
        depth_m=20,
        surface_every_s=200,
    )
    noisy, quiet = simulate(base, 1), simulate(dataclasses.replace(base, noise_scale=0.0), 1)
    three = np.isclose(noisy.dvl.sigma[:, 0], 0.005 / np.sin(np.radians(22.5)))
    error = ((noisy.dvl.z - quiet.dvl.z) / noisy.dvl.sigma)[three]
    assert len(error) > 2000
    np.testing.assert_allclose(error.T @ error / len(error), correlation, atol=4.5 / np.sqrt(len(error)))


def test_lock_draws_from_no_other_stream():
    plain, lossy = log_of(), log_of(beam_loss_probability=0.2, seabed=HILLS, max_tilt_deg=20)
    for sensor in ("depth", "gps", "heading"):
        assert np.array_equal(plain.streams[sensor].z, lossy.streams[sensor].z)
    assert np.array_equal(plain.imu.f_I, lossy.imu.f_I)
    assert cut(lossy).failure is None
    assert lossy.notes[1:] == (
        "seabed: depth_m 30, relief_m 2.5, relief_length_m 80.",
        "dvl: max_tilt_deg 20, beam_loss_probability 0.2.",
    )


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"seabed": {"depth": 30}}, ["seabed.depth", "did you mean 'depth_m'"]),
        ({"seabed": {"relief_m": 20}}, ["seabed", "slope of 1.3"]),
        ({"seabed": {"depth_m": 20}}, ["a seabed 20 m deep", "depth_m 20"]),
        ({"seabed": {}, "dvl": {"max_tilt_deg": 100}}, ["dvl.max_tilt_deg", "100"]),
        ({"dvl": {"beam_loss_probability": -0.1}}, ["dvl.beam_loss_probability"]),
    ],
)
def test_a_bad_seabed_is_refused_by_name(values, words):
    with pytest.raises(DatasetError) as caught:
        Scenario.from_dict(values, source="here.yaml")
    for word in ["here.yaml", *words]:
        assert word in str(caught.value)
