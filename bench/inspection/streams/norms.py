"""The IMU against gravity: units, axes, mounting, and whether gyro and accelerometer turn together."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ....datasets.described.description import Acceleration
from ....datasets.log import Log
from ....datasets.quantities import DEGREE
from ....datasets.rig import Rig
from ....datasets.state import Array
from ..findings.finding import Check, Finding
from ..findings.panels import AXIS_COLOURS, thinned
from .channels import seconds
from .neighbours import robust_sigma

if TYPE_CHECKING:
    from matplotlib.axes import Axes

G = Acceleration.units["g"]
MISREAD = {
    1 / G: ("g", "unit: g"),
    1e3 / G: ("mg", "unit: mg"),
    G: ("m/s² already", "unit: m/s^2"),
    G / 1e3: ("m/s² already", "unit: m/s^2"),
    1e3: ("mm/s²", "{unit: m/s^2, scale: 0.001}"),
    1e2: ("cm/s²", "{unit: m/s^2, scale: 0.01}"),
    1 / 0.3048: ("ft/s²", "{unit: m/s^2, scale: 0.3048}"),
}
"""|f| over gravity, if a unit is read as another: the true unit, and the key for log.yaml."""
UNIT_TOLERANCE = 0.1
"""Relative: the neighbouring ratios are 10 and 3.3 times apart, and a bias of 1 m/s² still fits."""
NO_GRAVITY = 0.2
"""Of gravity: below this mean |f|, gravity was removed from the data."""
GRAVITY_UNSURE = 0.03
"""m/s²: half of gravity's variation over the globe, since many logs state a round figure."""
LEVEL_OVER_UPRIGHT = 10.0
"""Variance of the level accelerations over that of the vertical one, which |f| shows; at sea it is about two."""
UNKNOWN_SPEED_M_S = 2.0
"""Assumed without a DVL: a usual speed of an underwater vehicle."""
SIGMAS = 4.0
"""Of the stated accelerometer bias: normal biases exceed it once in 16,000."""
TILTED_DEG = 20.0
"""No vehicle travels with its nose or a side so far down on average."""
SQUARE_DEG = 20.0
"""Mountings are usually at right angles: a tilt this near to one is taken for it."""
BLOCK_S = 0.5
"""Means over this: vibration averages out, and a vehicle still tilts within it."""
TOGETHER = 0.5
"""Least correlation between the tilting by gyro and by accelerometer for the slope to be used."""
FASTEST_RAD_S = 10.0
"""570 °/s: faster than any underwater vehicle, ship or car turns."""
LONGEST_GAP_S = 0.2
"""Longer gaps between two means are skipped: the rate between is not known."""


class Tilting(NamedTuple):
    """Regression of the change of f on the change that the gyro predicts: its slope and correlation."""

    slope: float
    correlation: float


def check_norms(log: Log) -> Check:
    """Compare the mean specific force with gravity, and its rotation with the gyro's."""
    f_I, rig = log.imu.f_I, log.rig
    norm = np.linalg.norm(f_I, axis=1)
    mean_f_B = np.median(f_I, axis=0) @ rig.imu.R_BS.T
    size, ratio = float(np.median(norm)), float(np.median(norm)) / rig.gravity
    rate = float(np.quantile(np.linalg.norm(log.imu.w_WI_I, axis=1), 0.99))
    tilting = gyro_against_gravity(log)
    facts = {
        "|f|, median": f"{size:.4f} m/s² ({ratio:.4f} of the stated gravity, {rig.gravity:.4f})",
        "f in body axes, median": "({:.3f}, {:.3f}, {:.3f}) m/s²".format(*mean_f_B),
        "angular rate, 99th percentile": f"{rate:.4g} rad/s ({rate / DEGREE:.3g} °/s)",
        "change of f's direction against the gyro": f"slope {tilting.slope:.3g}, correlation {tilting.correlation:.2f}",
    }
    findings = _misread(size, rig.gravity) or _strength(log, norm)
    findings += _upright(rig, np.median(f_I, axis=0), size)
    findings += _rates(rate, tilting)

    def draw(axes: Axes) -> None:
        t_s = seconds(log, log.imu.t_ns)
        kept = thinned(norm)
        axes.plot(t_s[kept], norm[kept], lw=0.4, color=AXIS_COLOURS[0], label="|f|", rasterized=True)
        axes.axhline(rig.gravity, color="black", lw=1, label="gravity")
        low, high = np.quantile(norm, [0.001, 0.999])
        room = 0.2 * (high - low) + 1e-3
        axes.set_ylim(min(low, rig.gravity) - room, max(high, rig.gravity) + room)
        axes.set(xlabel="time (s)", ylabel="specific force (m/s²)")
        axes.legend(fontsize=6)

    return Check("gravity, units and axes of the IMU", facts, tuple(findings), draw)


def _misread(size: float, gravity: float) -> list[Finding]:
    """Find a specific force in a unit other than the stated one."""
    for factor, (unit, fix) in MISREAD.items():
        if abs(size / gravity / factor - 1) < UNIT_TOLERANCE:
            message = f"The specific force is {size:.4g} m/s² strong where gravity is {gravity:.4g}: it is in {unit}."
            return [Finding("imu", message, f"streams.imu.accel{': ' if fix[0] == '{' else '.'}{fix}")]
    return []


def _strength(log: Log, norm: Array) -> list[Finding]:
    """Find a mean |f| that neither gravity, nor bias, nor the vehicle's own acceleration explains."""
    gravity, size = log.rig.gravity, float(np.median(norm))
    if size < NO_GRAVITY * gravity:
        message = f"The specific force is {size:.3g} m/s² strong: gravity was removed from it."
        return [Finding("imu", message, hint="streams.imu.accel.columns must name those of the raw specific force")]
    spread = float(robust_sigma(norm[:, None])[0])
    turning = float(np.mean(np.sum(log.imu.w_WI_I**2, axis=1))) * _speed(log) ** 2
    moving = (LEVEL_OVER_UPRIGHT * spread**2 + turning) / (
        2 * gravity
    )  # added by accelerations perpendicular to gravity
    allowed = GRAVITY_UNSURE + SIGMAS * log.rig.imu_noise.accel_bias_sigma + moving
    if abs(size - gravity) <= allowed:
        return []
    message = (
        f"The specific force is {size:.4f} m/s² strong where gravity is {gravity:.4f}: off by {size - gravity:+.3f}, "
        "and "
        f"bias ({SIGMAS:g} × {log.rig.imu_noise.accel_bias_sigma:.2g}) and motion explain {allowed:.2g}. Scale or bias."
    )
    return [Finding("imu", message, f"streams.imu.accel.scale: {gravity / size:.4f}", "or streams.imu.accel.offset")]


def _speed(log: Log) -> float:
    if log.dvl is None or not len(log.dvl):
        return UNKNOWN_SPEED_M_S
    return float(np.median(np.linalg.norm(log.dvl.z, axis=1)))


def _upright(rig: Rig, f_I: Array, size: float) -> list[Finding]:
    """Find an IMU whose mean specific force does not point up in the body, and how to mount it so that it does."""
    f_B = rig.imu.R_BS @ f_I
    length = float(np.linalg.norm(f_B))
    tilt_deg = float(np.degrees(np.arccos(np.clip(f_B[2] / max(length, 1e-12), -1, 1))))
    if length < NO_GRAVITY * size or size == 0 or tilt_deg <= TILTED_DEG:
        return []
    if 180 - tilt_deg < SQUARE_DEG:
        return []  # the signs of gyro, heading and motion tell why
    R_BI, square = levelled(rig.imu.R_BS, f_B / length)
    yaw, pitch, roll = Rotation.from_matrix(R_BI).as_euler("ZYX", degrees=True) + 0.0
    axis = int(np.argmax(np.abs(f_I)))
    message = (
        f"The specific force points {tilt_deg:.0f}° off the body's z axis; in the IMU's own axes up is "
        f"{'−' if f_I[axis] < 0 else '+'}{'xyz'[axis]}."
        + ("" if square else " It is not a right angle: a tilted mounting, or a vehicle not level on average.")
    )
    fix = f"streams.imu.mounting: {{roll_deg: {roll:.4g}, pitch_deg: {pitch:.4g}, yaw_deg: {yaw:.4g}}}"
    hint = "gravity does not show the yaw, so add the one that turns the gyro's axes the vehicle's way"
    return [Finding("imu", message, fix, hint)]


def levelled(R_BI: Array, up_B: Array) -> tuple[Array, bool]:
    """Return the mounting nearest to R_BI that makes up_B (3,) up, and whether the correction is by right angles.

    An up that is near an axis of the body is taken to be that axis.
    """
    axis = int(np.argmax(np.abs(up_B)))
    square = bool(abs(up_B[axis]) > np.cos(SQUARE_DEG * DEGREE))
    if square:
        up_B = np.sign(up_B[axis]) * np.eye(3)[axis]
    return onto_z(up_B) @ R_BI, square


def onto_z(up: Array) -> Array:
    """Return the shortest rotation that takes `up` to z; half a turn about x where it points straight down."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, up[2])
    axis = np.array([1.0, 0.0, 0.0]) if sine < 0.1 and up[2] < 0 else axis / max(sine, 1e-12)
    return Rotation.from_rotvec(angle * axis).as_matrix()


def gyro_against_gravity(log: Log) -> Tilting:
    """Compare the rotation of f with the gyro's, by means over half a second: df = −∫w dt × f without acceleration.

    The slope is 1 if all is well, and 1/57 if degrees are read as radians. A rotation of both sensors' axes, the unit
    of f and its sign do not change it. Accelerations act as noise, hence the correlation.
    """
    t_ns, period_ns = log.imu.t_ns, log.imu.period_ns
    size = max(round(BLOCK_S * 1e9 / period_ns), 1)
    n = len(t_ns) // size * size
    if n < 10 * size:
        return Tilting(float("nan"), 0.0)
    w, f = (x[:n].reshape(-1, size, 3).mean(axis=1) for x in (log.imu.w_WI_I, log.imu.f_I))
    step_s = np.diff(t_ns[:n].reshape(-1, size).mean(axis=1)) * 1e-9
    whole = step_s < size * period_ns * 1e-9 + LONGEST_GAP_S
    turned = 0.5 * (w[1:] + w[:-1]) * step_s[:, None]
    by_gyro = -np.cross(turned, 0.5 * (f[1:] + f[:-1]))[whole]
    by_f = np.diff(f, axis=0)[whole]
    both, gyro, accel = (float(np.sum(a * b)) for a, b in ((by_gyro, by_f), (by_gyro,) * 2, (by_f,) * 2))
    if gyro == 0 or accel == 0:
        return Tilting(float("nan"), 0.0)
    return Tilting(both / gyro, both / np.sqrt(gyro * accel))


def _rates(rate: float, tilting: Tilting) -> list[Finding]:
    """Find rates in the wrong unit."""
    in_degrees = "streams.imu.gyro.unit: deg/s"
    if tilting.correlation > TOGETHER and 0.5 < tilting.slope / DEGREE < 2:
        message = f"f tilts by {tilting.slope:.3f} of the gyro's rotation, about 1/57: degrees are read as radians."
        return [Finding("imu", message, in_degrees)]
    if tilting.correlation > TOGETHER and 0.5 < tilting.slope * DEGREE < 2:
        message = f"f tilts by {tilting.slope:.3g} times the gyro's rotation, about 57: radians are read as degrees."
        return [Finding("imu", message, "streams.imu.gyro.unit: rad/s")]
    if rate > FASTEST_RAD_S:
        return [
            Finding(
                "imu", f"The gyro reads over {rate:.3g} rad/s for 1 % of the time, which no vehicle does.", in_degrees
            )
        ]
    return []
