"""IMU grades: noise and bias figures of one product each, from its data sheet."""

from __future__ import annotations

import math

from ..quantities import DEGREE
from ..rig import ImuNoise

DEGREE_PER_HOUR = DEGREE / 3600
"""rad/s."""
DEGREE_PER_ROOT_HOUR = DEGREE / 60
"""rad/√s, which is rad/s/√Hz."""
MILLI_G = 9.81e-3
"""m/s²."""

WALK_HORIZON_S = 1000.0
"""Data sheets state an in-run bias stability B and no random walk. We take the random walk K whose Allan deviation,
K √(τ/3), equals B at this τ."""


def from_data_sheet(
    gyro_density: float,
    accel_density: float,
    gyro_in_run: float,
    accel_in_run: float,
    gyro_bias: float,
    accel_bias: float,
) -> ImuNoise:
    """Return the noise of an IMU from its data sheet, in SI units: densities, in-run stabilities, turn-on biases."""
    walk = math.sqrt(3 / WALK_HORIZON_S)
    return ImuNoise(gyro_density, accel_density, walk * gyro_in_run, walk * accel_in_run, gyro_bias, accel_bias)


IMU_GRADES = {
    # Xsens MTi-1 data sheet: 0.007 °/s/√Hz, 120 µg/√Hz, in-run 10 °/h and 0.03 mg. Turn-on: its maker's support page
    # gives the gyro ±0.5 °/s within a year, of which a tenth is assumed left after a calibration at rest; 3 mg assumed.
    "consumer": from_data_sheet(
        0.007 * DEGREE, 0.120 * MILLI_G, 10 * DEGREE_PER_HOUR, 0.03 * MILLI_G, 0.05 * DEGREE, 3 * MILLI_G
    ),
    # SBG Ellipse-N data sheet: 0.18 °/√h, 57 µg/√Hz, in-run 7 °/h and 14 µg. Turn-on: 0.01 °/s and 1 mg assumed.
    "industrial": from_data_sheet(
        0.18 * DEGREE_PER_ROOT_HOUR, 0.057 * MILLI_G, 7 * DEGREE_PER_HOUR, 0.014 * MILLI_G, 0.01 * DEGREE, 1 * MILLI_G
    ),
    # Sensonor STIM300 data sheet (TS1524): 0.15 °/√h, 0.06 m/s/√h, in-run 0.5 °/h and 0.05 mg; turn-on: gyro from its
    # 10 °/h rms over temperature gradients, accel 0.75 mg.
    "tactical": from_data_sheet(
        0.15 * DEGREE_PER_ROOT_HOUR,
        0.06 / 60,
        0.5 * DEGREE_PER_HOUR,
        0.05 * MILLI_G,
        10 * DEGREE_PER_HOUR,
        0.75 * MILLI_G,
    ),
    # Honeywell HG9900 brochure (N61-1638): 0.002 °/√h, bias 0.0035 °/h and 25 µg, 1 σ. It states no accelerometer noise
    # and no in-run figures: assumed are 2.2 µg/√Hz (7 µg rms in 0–10 Hz, usual for its quartz accelerometers), and a
    # tenth of the bias in run.
    "navigation": from_data_sheet(
        0.002 * DEGREE_PER_ROOT_HOUR,
        2.2e-3 * MILLI_G,
        0.00035 * DEGREE_PER_HOUR,
        2.5e-3 * MILLI_G,
        0.0035 * DEGREE_PER_HOUR,
        0.025 * MILLI_G,
    ),
}
