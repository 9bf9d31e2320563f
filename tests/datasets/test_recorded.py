"""The recorded logs: plain dead reckoning, straight from the streams, lands where their READMEs say."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets import Log
from fathom.datasets.described.opening import open_log
from fathom.estimators.alignment.initialise import initialise
from numpy.typing import NDArray

Array = NDArray[np.float64]


def dead_reckoned(log: Log) -> tuple[Array, Array]:
    """Level, heading and DVL only: complex east + i north (k,) at the truth's times, and the truth's."""
    assert log.dvl is not None
    assert log.heading is not None
    assert log.truth is not None
    start_ns = log.start_ns
    t_s, t_heading_s, t_truth_s = (
        (s - start_ns) * 1e-9 for s in (log.dvl.t_ns, log.heading.t_ns, log.truth.t_ns)
    )  # fmt: skip
    x_HB = log.rig.heading.R_BS.T[:, 0]  # B's x axis in the heading sensor
    psi = np.interp(t_s, t_heading_s, np.unwrap(log.heading.z[:, 0])) + np.arctan2(x_HB[1], x_HB[0])
    v = (log.dvl.z[:, 0] + 1j * log.dvl.z[:, 1]) * np.exp(1j * psi)
    p = np.concatenate([[0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(t_s))])
    inside = (t_truth_s >= t_s[0]) & (t_truth_s <= t_s[-1])
    east, north = (np.interp(t_truth_s[inside], t_s, part) for part in (p.real, p.imag))
    truth = log.truth.p_WB_W[inside]
    return east + 1j * north, truth[:, 0] + 1j * truth[:, 1]


def rms(error: Array) -> float:
    return float(np.sqrt(np.mean(np.abs(error) ** 2)))


def test_ictineu_dead_reckons_to_five_metres_over_56_minutes_once_turned(ictineu):
    p, truth = dead_reckoned(ictineu)
    p, truth = p - p.mean(), truth - truth.mean()
    turn = np.angle(np.vdot(p, truth))
    assert rms(p * np.exp(1j * turn) - truth) == pytest.approx(5.1, abs=0.3)
    assert abs(np.degrees(turn)) < 1.0


def test_lauv_dead_reckons_to_its_reference(lauv):
    p, reference = dead_reckoned(lauv)
    assert rms((p - p[0]) - (reference - reference[0])) == pytest.approx(1.47, abs=0.1)


def test_the_recordings_have_the_rows_their_readmes_count(ictineu, lauv):
    assert "dvl: 84 rows invalid dropped" in ictineu.notes
    assert "dvl: 130 rows over 0.8 m/s dropped" in ictineu.notes
    assert {name: len(s) for name, s in ictineu.streams.items()} == {"dvl": 4831, "depth": 5045, "heading": 3346}
    assert len(ictineu.imu.t_ns) == 33_457
    assert "dvl: 49 rows invalid dropped" in lauv.notes
    assert {name: len(s) for name, s in lauv.streams.items()} == {"dvl": 448, "depth": 1120, "heading": 560}
    assert len(lauv.imu.t_ns) == 11_199
    assert not any(note.startswith("imc:") for note in lauv.notes)  # the whole file parses without a bad byte
    assert (ictineu.truth_kind, lauv.truth_kind) == ("truth", "reference")


def test_a_recordings_own_folder_opens_like_its_name(ictineu, recorded_data):
    again = open_log(recorded_data / "ictineu_stpere_2004")
    np.testing.assert_array_equal(again.imu.f_I, ictineu.imu.f_I)
    assert again.notes == ictineu.notes


def test_specific_force_points_up_with_the_strength_of_gravity(ictineu, lauv):
    for log in (ictineu, lauv):
        f_B = (log.imu.f_I @ log.rig.imu.R_BS.T).mean(axis=0)
        assert f_B[2] == pytest.approx(log.rig.gravity, rel=0.01)


def test_the_gyro_agrees_with_the_heading_in_sign_and_size(ictineu, lauv):
    for log in (ictineu, lauv):
        assert log.heading is not None
        w_up = (log.imu.w_WI_I @ log.rig.imu.R_BS.T)[:, 2]
        turned = np.interp(log.heading.t_ns, log.imu.t_ns, np.cumsum(w_up * np.gradient(log.imu.t_ns * 1e-9)))
        smooth = 20  # readings
        rate_gyro, rate_heading = (
            (a[smooth:] - a[:-smooth]) / smooth for a in (turned, np.unwrap(log.heading.z[:, 0]))
        )
        slope, _ = np.polyfit(rate_heading, rate_gyro, 1)
        assert np.corrcoef(rate_gyro, rate_heading)[0, 1] > 0.9
        assert slope == pytest.approx(1.0, abs=0.15)


def test_the_two_tilt_sensors_of_ictineu_confirm_its_mounting(ictineu, recorded_data):
    """The DVL's own pitch and roll (not in the Log) move with the MTi's tilt, seen in B."""
    folder = recorded_data / "ictineu_stpere_2004"
    dvl = np.loadtxt(folder / "_040825_1735_DVL.log", comments="%", encoding="latin-1")
    mti = np.loadtxt(folder / "_040825_1735_MTI.log", comments="%", encoding="latin-1")
    roll, pitch = (np.interp(dvl[:, 0] - 0.5, mti[:, 0], mti[:, k]) for k in (1, 2))
    tilt = np.stack([roll, -pitch, np.ones(len(roll))], axis=1)  # MTi as forward-left-up
    (to_pitch, *_), (to_roll, *_) = (np.linalg.lstsq(tilt, y)[0:2] for y in (-dvl[:, 23], dvl[:, 24]))
    yaw_deg = np.degrees(np.arctan2(to_pitch[0] - to_roll[1], to_roll[0] + to_pitch[1]))
    R_BI = ictineu.rig.imu.R_BS
    assert yaw_deg == pytest.approx(np.degrees(np.arctan2(R_BI[1, 0], R_BI[0, 0])), abs=5.0)


def test_the_height_of_the_reference_is_that_of_the_depth_sensor(lauv):
    assert lauv.depth is not None
    assert lauv.truth is not None
    z = np.interp(lauv.depth.t_ns, lauv.truth.t_ns, lauv.truth.p_WB_W[:, 2])
    assert np.abs(z - lauv.depth.z[:, 0]).max() < 0.05


def test_the_reference_moves_by_its_own_velocity(lauv):
    truth = lauv.truth
    assert truth is not None
    assert truth.v_WB_W is not None
    moved = truth.p_WB_W[-1] - truth.p_WB_W[0]
    integrated = np.trapezoid(truth.v_WB_W, truth.t_ns * 1e-9, axis=0)
    np.testing.assert_allclose(integrated[:2], moved[:2], atol=1.0)  # its vertical velocity is off, see the notes
    v_B = np.einsum("nji,nj->ni", truth.R_WB, truth.v_WB_W)
    assert v_B[:, 0].mean() > 1.0
    assert np.abs(v_B[:, 1:].mean(axis=0)).max() < 0.15


def test_the_prior_of_a_recording_lies_within_three_sigma_of_its_reference(ictineu, lauv):
    for log in (ictineu, lauv):
        assert log.truth is not None
        belief = initialise(log).belief
        row = int(np.searchsorted(log.truth.t_ns, belief.t_ns))
        error = log.truth.p_WB_W[row] - belief.state.p_WB_W
        sigma = np.sqrt(np.diag(belief.P))
        assert (np.abs(error[:2]) < 3 * sigma[3:5]).all()
    theta = belief.state.local(log.truth.state(row))[:3]
    assert (np.abs(theta) < 3 * sigma[:3] + 0.005).all()
