"""The IMU against the DVL: delay, mounting, lever arm, from velocities alone.

The IMU's velocity over ground is v_I = v_B + w × p. In a frame that does not turn, it changes by specific force and
gravity: R (A z + w × p) = V + v_0 + g t, with R the integrated gyro, V = ∫ R f dt, z the DVL's reading, and A the
rotation and scale into the IMU's axes. Start velocity v_0 and gravity g are free vectors in every window, so neither
attitude nor gravity need be known. Both biases are fitted as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ....datasets.log import DvlStream, Log
from ....datasets.quantities import DEGREE
from ....datasets.state import Array
from ..findings.finding import Check, Finding
from ..findings.fitting import BLOCKS, Estimate, Fit, Index, blocks_of_windows, least_squares, windows_of, without_trend
from .headings import mounting_text
from .inertial import Inertial, cross
from .pair_check import Delay, PairCheck
from .path_fit import velocities

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WINDOW_S = 20.0
"""A start velocity and gravity are fitted per window: long enough for a turn, short enough for a consumer IMU."""
DEGREE_OF_TREND = 2
"""Of the polynomial removed in each window: start velocity, gravity, and the effect of a growing tilt."""
LAGS_S = np.arange(-2.0, 2.01, 0.25)
"""s: where the search for the delay starts."""
ARM_MATTERS_M = 0.1
"""At 0.1 rad/s an arm that is off by this makes 1 cm/s, the noise of a good DVL."""
TURN_MATTERS = 2.0 * DEGREE
"""rad: mountings are measured to about a degree, and this fit knows them to a fraction of one at best."""
FASTEST_HZ = 25.0
"""Samples are first summed to about this rate: a DVL sees nothing faster."""
UNIT = np.eye(3)
"""The three axes, by rows."""


@dataclass(frozen=True, eq=False)
class Strapdown:
    """The gyro and the accelerometers, integrated from the start, in a frame that does not turn.

    Attributes:
        t_s: (n,).
        R: (n, 3, 3) from L at each time to L at the start.
        V: (n, 3) m/s, ∫ R f dt.
        G: (n, 3, 3) s, ∫ R dt: how a gyro bias turns R.
        J: (n, 3, 3) m, ∫ G_k × R f dt, by k along the last axis: how a gyro bias k changes V.
        w: (n, 3) rad/s.
    """

    t_s: Array
    R: Array
    V: Array
    G: Array
    J: Array
    w: Array

    def at(self, t_s: Array, name: str) -> Array:
        """Interpolate one of the arrays."""
        values: Array = getattr(self, name)
        after = np.searchsorted(self.t_s, t_s).clip(1, len(self.t_s) - 1)
        share = (t_s - self.t_s[after - 1]) / (self.t_s[after] - self.t_s[after - 1])
        share = share.clip(0.0, 1.0).reshape(-1, *(1,) * (values.ndim - 1))
        return values[after - 1] * (1 - share) + values[after] * share


def integrate(imu: Inertial, bias: Array) -> Strapdown:
    """Integrate the IMU, with a bias (3,) rad/s subtracted from the gyro."""
    many = max(int(1 / (imu.period_s * FASTEST_HZ)), 1)
    n = len(imu.t_s) // many * many
    dt_s = imu.dt_s[:n].reshape(-1, many).sum(axis=1)
    angle = (imu.w_L[:n] * imu.dt_s[:n, None]).reshape(-1, many, 3).sum(axis=1) - bias * dt_s[:, None]
    push = (imu.f_L[:n] * imu.dt_s[:n, None]).reshape(-1, many, 3).sum(axis=1)
    R = products(Rotation.from_rotvec(angle).as_matrix().reshape(-1, 3, 3))
    middle = (R[1:] + R[:-1]) / 2
    pushed = np.einsum("nij,nj->ni", middle, push)
    V = np.cumsum(pushed, axis=0)
    G = np.cumsum(middle * dt_s[:, None, None], axis=0)
    J = np.cumsum(np.cross(G, pushed[:, :, None], axis=1), axis=0)
    return Strapdown(imu.t_s[:n].reshape(-1, many)[:, -1], R[1:], V, G, J, angle / dt_s[:, None])


def products(steps: Array) -> Array:
    """Return I, S_0, S_0 S_1, … (n + 1, 3, 3) for steps S (n, 3, 3): within pieces all at once, then piece by piece."""
    n = len(steps)
    piece = max(int(np.sqrt(n)), 1)
    count = -(-n // piece)
    padded = np.concatenate([steps, np.tile(UNIT, (count * piece - n, 1, 1))]).reshape(count, piece, 3, 3)
    inside = np.empty_like(padded)
    inside[:, 0] = padded[:, 0]
    for k in range(1, piece):
        inside[:, k] = inside[:, k - 1] @ padded[:, k]
    before = np.empty((count, 3, 3))
    before[0] = UNIT
    for k in range(1, count):
        before[k] = before[k - 1] @ inside[k - 1, -1]
    return np.concatenate([UNIT[None], (before[:, None] @ inside).reshape(-1, 3, 3)[:n]])


@dataclass(frozen=True, eq=False)
class MountingFit:
    """The IMU's pose relative to the DVL, from their velocities.

    Attributes:
        delay: of the DVL after the IMU, s.
        scale: factor on the DVL's velocity that makes it agree with the accelerometers.
        yaw: of the DVL's axes in L, rad.
        tilt: roll and pitch of them, rad.
        p_BI_B: IMU's place from the DVL, m, by axis of B.
        left: (n, 3) m/s, residual; t_s (n,).
    """

    delay: Estimate
    scale: Estimate
    yaw: Estimate
    tilt: tuple[Estimate, Estimate]
    p_BI_B: tuple[Estimate, Estimate, Estimate]
    t_s: Array
    left: Array


def fit_mounting(log: Log, imu: Inertial) -> MountingFit | None:
    """Fit delay, rotation and lever arm; None if IMU and DVL overlap too little."""
    t_s, z, never = velocities(log)
    inside = (t_s > imu.t_s[0] + 3) & (t_s < imu.t_s[-1] - 3)
    t_s, z = t_s[inside], z[inside]
    if len(t_s) < 60 or "x" in never:
        return None
    window = windows_of(t_s, min(WINDOW_S, (t_s[-1] - t_s[0]) / BLOCKS), 3.0)
    moved = integrate(imu, np.zeros(3))
    delay_s = _best_lag(moved, t_s, z, window)
    if delay_s is None:
        return None
    arm = imu.R_LB @ np.asarray(log.rig.imu.p_BS_B)
    start = _Guess(delay_s, 1.0, _first_yaw(moved, t_s, z, window, delay_s), arm, np.zeros(3))
    found = _converged(imu, t_s, z, window, start)
    if found is None or not found[0]["scale"].known_to(0.3):
        return None
    fit, guess = found
    back = Rotation.from_euler("z", -guess.yaw).as_matrix()
    place = back @ guess.arm
    arm_sigma = np.sqrt(np.diag(back @ _part(fit, [f"arm {axis}" for axis in "xyz"]) @ back.T))
    forward, left, up = (Estimate(float(place[i]), float(arm_sigma[i]), fit.dof) for i in range(3))
    return MountingFit(
        delay=Estimate(guess.delay_s, fit["delay"].sigma, fit.dof),
        scale=Estimate(guess.scale, fit["scale"].sigma * guess.scale, fit.dof),
        yaw=Estimate(float(np.angle(np.exp(1j * guess.yaw))), fit["turn z"].sigma, fit.dof),
        tilt=(fit["turn x"], fit["turn y"]),
        p_BI_B=(forward, left, up),
        t_s=t_s,
        left=fit.residual.reshape(-1, 3),
    )


def _converged(imu: Inertial, t_s: Array, z: Array, window: Index, guess: _Guess) -> tuple[Fit, _Guess] | None:
    """Iterate the fit from a guess; None if it does not converge."""
    found: Fit | None = None
    for _ in range(8):
        found = _fit(integrate(imu, guess.bias), t_s, z, window, guess)
        if found is None:
            return None
        before, guess = guess, guess.stepped(found)
        if np.allclose(guess.numbers, before.numbers, rtol=0, atol=1e-5):
            break
        if not (abs(guess.delay_s) < 4 and 0.3 < guess.scale < 3):
            return None
    return None if found is None else (found, guess)


@dataclass(frozen=True, eq=False)
class _Guess:
    """The linearisation point: delay s, A = scale · Rz(yaw), arm (3,) m in L, gyro bias (3,) rad/s in L."""

    delay_s: float
    scale: float
    yaw: float
    arm: Array
    bias: Array

    @property
    def numbers(self) -> Array:
        """All of it in one row."""
        return np.array([self.delay_s, self.scale, self.yaw, *self.arm, *self.bias])

    def stepped(self, fit: Fit) -> _Guess:
        """Return the guess moved by a fit, in the coefficients that the data determine."""

        def step(name: str, most: float) -> float:
            if name not in fit.names or not fit[name].known_to(3 * most):
                return 0.0
            return float(np.clip(fit[name].value, -most, most))

        return _Guess(
            self.delay_s + step("delay", 0.5),
            self.scale * float(np.exp(step("scale", 0.3))),
            self.yaw + step("turn z", 0.5),
            self.arm + [step(f"arm {axis}", 1.0) for axis in "xyz"],
            self.bias + [step(f"bias {axis}", 0.02) for axis in "xyz"],
        )


def _turn(R: Array, v: Array) -> Array:
    return np.einsum("nij,nj->ni", R, v)


def _in_windows(columns: dict[str, Array], t_s: Array, window: Index, degree: int) -> dict[str, Array]:
    every = without_trend(np.stack(list(columns.values()), axis=2), t_s, window, degree)
    return {name: every[:, :, i].ravel() for i, name in enumerate(columns)}


def _fit(moved: Strapdown, t_s: Array, z: Array, window: Index, guess: _Guess) -> Fit | None:
    """Fit the correction to a guess.

    The DVL's noise must be on one side of the equation only. So the columns are built from the velocity as the IMU
    carries it through the window: R z less the residual.
    """
    at_s, step_s = t_s - guess.delay_s, 0.1
    R, V, w, G, J = (moved.at(at_s, name) for name in ("R", "V", "w", "G", "J"))
    first = np.searchsorted(window, window)
    z_L = guess.scale * z @ Rotation.from_euler("z", guess.yaw).as_matrix().T
    V = V - V[first]
    moving = _turn(R, z_L + cross(w, guess.arm))
    left = without_trend(moving - V, t_s, window, DEGREE_OF_TREND)
    v_W = _turn(R, z_L) - left
    v_L = np.einsum("nji,nj->ni", R, v_W)

    def shifted(shift: float) -> Array:
        R, w = moved.at(at_s + shift, "R"), moved.at(at_s + shift, "w")
        return _turn(R, v_L + cross(w, guess.arm)) - moved.at(at_s + shift, "V")

    columns = {"scale": v_W, "delay": (shifted(-step_s) - shifted(step_s)) / (2 * step_s)}
    columns |= {f"turn {axis}": _turn(R, cross(UNIT[i], v_L)) for i, axis in enumerate("xyz")}
    columns |= {f"arm {axis}": _turn(R, cross(w, UNIT[i])) for i, axis in enumerate("xyz")}
    for i, axis in enumerate("xyz"):
        since = G[:, :, i] - G[first, :, i]
        columns[f"accel {axis}"] = since
        columns[f"bias {axis}"] = J[:, :, i] - cross(G[first, :, i], V) - cross(since, v_W)
    every = _in_windows(columns, t_s, window, DEGREE_OF_TREND)
    return least_squares(every, -left.ravel(), np.repeat(blocks_of_windows(window), 3))


def _coarse(moved: Strapdown, t_s: Array, z: Array, window: Index, delay_s: float) -> tuple[dict[str, Array], Array]:
    """Return columns and right-hand side of a fit without a guess: a parabola per window covers the gyro's bias."""
    R, V, w = (moved.at(t_s - delay_s, name) for name in ("R", "V", "w"))
    columns = {"along": _turn(R, z), "across": _turn(R, cross(UNIT[2], z))}
    columns |= {f"arm {axis}": _turn(R, cross(w, UNIT[i])) for i, axis in enumerate("xyz")}
    every = _in_windows({**columns, "V": V - V.mean(axis=0)}, t_s, window, 2)
    return every, every.pop("V")


def _first_yaw(moved: Strapdown, t_s: Array, z: Array, window: Index, delay_s: float) -> float:
    """Return the DVL's yaw in L from a fit without a guess; zero if that does not determine it."""
    every, y = _coarse(moved, t_s, z, window, delay_s)
    fit = least_squares(every, y, np.repeat(blocks_of_windows(window), 3))
    if fit is None:
        return 0.0
    along, across = fit["along"], fit["across"]
    size = float(np.hypot(along.value, across.value))
    return float(np.arctan2(across.value, along.value)) if size > 4 * max(along.sigma, across.sigma) else 0.0


def _best_lag(moved: Strapdown, t_s: Array, z: Array, window: Index) -> float | None:
    """Return the delay (s) on a coarse grid with the least residual."""
    some = np.isin(window, np.unique(np.linspace(0, window[-1], 40).astype(np.intp)))
    t_s, z, window = t_s[some], z[some], window[some]
    left = []
    for lag in LAGS_S:
        every, y = _coarse(moved, t_s, z, window, lag)
        X = np.stack(list(every.values()), axis=1)
        beta = np.linalg.lstsq(X, y, rcond=1e-9)[0]
        left.append(float(np.median(np.abs(y - X @ beta))))
    return float(LAGS_S[int(np.argmin(left))]) if np.isfinite(left).all() else None


def _signs(moved: Strapdown, t_s: Array, z: Array, window: Index, delay_s: float) -> tuple[bool, bool]:
    """Whether the map from the DVL to the IMU mirrors the horizontal plane, and whether it swaps up and down."""
    R, V, w, G = (moved.at(t_s - delay_s, name) for name in ("R", "V", "w", "G"))
    G = G - G[np.searchsorted(window, window)]
    columns = {f"{a}{b}": _turn(R, z[:, [i]] * UNIT[j]) for i, a in enumerate("xy") for j, b in enumerate("xy")}
    columns["zz"] = _turn(R, z[:, [2]] * UNIT[2])
    columns |= {f"arm {axis}": _turn(R, cross(w, UNIT[i])) for i, axis in enumerate("xyz")}
    columns |= {f"accel {axis}": G[:, :, i] for i, axis in enumerate("xyz")}
    every = _in_windows({**columns, "V": V - V.mean(axis=0)}, t_s, window, DEGREE_OF_TREND)
    y = every.pop("V")
    fit = least_squares(every, y, np.repeat(blocks_of_windows(window), 3))
    if fit is None:
        return False, False
    m = {name: fit[name] for name in ("xx", "xy", "yx", "yy", "zz")}
    flat = all(m[name].known_to(0.5) for name in ("xx", "xy", "yx", "yy"))
    area = m["xx"].value * m["yy"].value - m["xy"].value * m["yx"].value
    return flat and area < -0.25, m["zz"].known_to(0.5) and m["zz"].value < -0.5


def mirrored_dvl(log: Log, imu: Inertial) -> tuple[PairCheck, Log] | None:
    """Return the check of a DVL with axes opposite to the IMU's, and the log with them corrected; None if none are."""
    t_s, z, never = velocities(log)
    assert log.dvl is not None
    if len(t_s) < 60 or never:
        return None
    window = windows_of(t_s, min(WINDOW_S, (t_s[-1] - t_s[0]) / BLOCKS), 3.0)
    moved = integrate(imu, np.zeros(3))
    delay_s = _best_lag(moved, t_s, z, window)
    flat, vertical = (False, False) if delay_s is None else _signs(moved, t_s, z, window, delay_s)
    if not (flat or vertical):
        return None
    signs = np.array([1.0, -1.0 if flat else 1.0, -1.0 if vertical else 1.0])
    which = " and ".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0)
    message = f"The DVL's {which} point{'s' * (which in 'xyz')} opposite to the IMU's"
    if flat and vertical:
        message += ": one of the two is read as forward-left-up and is forward-right-down, or the reverse."
        fix = "streams.dvl.axes: FRD  # or FLU, whichever it is not"
    else:
        message += ": a sign is wrong."
        fix = "streams.dvl.velocity.scale: [" + ", ".join(f"{sign:g}" for sign in signs) + "]"
    turned = DvlStream(log.dvl.t_ns, log.dvl.received_ns, log.dvl.z * signs, log.dvl.sigma)
    check = Check("axes of the DVL against the IMU's", {"turned over": which}, (Finding("dvl", message, fix),))
    return PairCheck(check), replace(log, dvl=turned)


def _part(fit: Fit, names: list[str]) -> Array:
    rows = [fit.names.index(name) for name in names]
    return fit.cov[np.ix_(rows, rows)]


def imu_against_dvl(log: Log, imu: Inertial) -> PairCheck | None:
    """Whether IMU and DVL move as one rigid body with the mountings of the description."""
    found = fit_mounting(log, imu)
    if found is None:
        why = "not observable: over a window, the IMU's noise is larger than the changes of velocity"
        check = up_check(log, imu)
        return PairCheck(Check("IMU against DVL", {"delay, mounting, lever arm": why, **check.facts}, check.findings))
    facts = {"DVL later than the IMU by": found.delay.text_if(0.5, "s")}
    facts["DVL's axes in the IMU's as mounted, yaw"] = found.yaw.times(1 / DEGREE).text_if(15, "°")
    for name, tilt in zip(("roll", "pitch"), found.tilt, strict=True):
        facts[f"DVL's axes in the IMU's as mounted, {name}"] = tilt.times(1 / DEGREE).text_if(15, "°")
    facts["scale that the DVL needs"] = found.scale.text_if(0.2)
    said = [arm.text_if(0.5, "m") for arm in found.p_BI_B]
    facts["IMU's place from the DVL"] = f"forward {said[0]}, left {said[1]}, up {said[2]}"
    stated = np.asarray(log.rig.imu.p_BS_B)
    facts["as stated"] = f"forward {stated[0]:.2f} m, left {stated[1]:.2f} m, up {stated[2]:.2f} m"
    never = velocities(log)[2]
    if never:
        facts["taken for zero, as not measured"] = f"velocity along {' and '.join(never)}; no lever arm is concluded"
    findings = _findings(log, imu, found, bool(never))

    def draw(axes: Axes) -> None:
        for i, axis in enumerate(("forward", "left", "up")):
            axes.plot(found.t_s, found.left[:, i], ".", markersize=2, label=f"{axis} at the start")
        axes.legend(fontsize=7)
        axes.set(xlabel="time (s)", ylabel="m/s", title="IMU's velocity less the DVL's, each window's trend taken off")

    delays = (Delay("dvl", "imu", found.delay),) if found.delay.known_to(0.5) else ()
    return PairCheck(Check("IMU against DVL", facts, tuple(findings), draw), delays)


def up_check(log: Log, imu: Inertial) -> Check:
    """Whether B's z is up by the accelerometers as mounted; it needs no DVL."""
    lean = np.degrees(np.arccos(np.clip(imu.up_B[2], -1, 1)))
    facts = {"mean up in B": "({:.2f}, {:.2f}, {:.2f})".format(*imu.up_B), "leans from z by": f"{lean:.1f} °"}
    findings = () if np.allclose(imu.R_LB, UNIT) else (_mounting_finding(log, imu, _not_up(imu), UNIT),)
    return Check("which way is up", facts, findings)


def _not_up(imu: Inertial) -> str:
    up = "({:.2f}, {:.2f}, {:.2f})".format(*imu.up_B)
    message = f"With this mounting of the IMU, B's z is not up: the mean specific force points to {up}."
    return message + " Forward-right-down is read as forward-left-up, or the reverse." * imu.flipped


def _mounting_finding(log: Log, imu: Inertial, message: str, back: Array) -> Finding:
    """Return the finding with the mounting of the IMU that makes B's z up, rotated further by `back`."""
    if imu.flipped and np.allclose(back, UNIT):
        return Finding("imu", message, "streams.imu.axes: FRD  # or FLU, whichever it is not")
    R_BI = back @ imu.R_LB @ np.asarray(log.rig.imu.R_BS)
    return Finding("imu", message, "streams.imu.mounting: " + mounting_text(R_BI, np.asarray(log.rig.imu.p_BS_B)))


def _findings(log: Log, imu: Inertial, found: MountingFit, incomplete: bool) -> list[Finding]:
    roll, pitch = (
        tilt.value if not incomplete and tilt.known_to(10 * DEGREE) and tilt.differs(0.0, TURN_MATTERS) else 0.0
        for tilt in found.tilt
    )
    turned = found.yaw.known_to(15 * DEGREE) and found.yaw.differs(0.0, TURN_MATTERS)
    tilted = Rotation.from_rotvec([-roll, -pitch, 0.0]).as_matrix()
    back = (Rotation.from_euler("z", -found.yaw.value).as_matrix() if turned else UNIT) @ tilted
    if not np.allclose(imu.R_LB, UNIT):
        return [_mounting_finding(log, imu, _not_up(imu) + " The remaining rotation is from the DVL.", back)]
    if turned or roll or pitch:
        yaw, *tilts = (e.times(1 / DEGREE).text("°") for e in (found.yaw, *found.tilt))
        message = (
            f"The DVL's axes are turned by {yaw} in yaw, {tilts[0]} in roll and {tilts[1]} in pitch from the IMU's as "
            "mounted. A heading sensor in the IMU's housing is turned by the same."
        )
        return [_mounting_finding(log, imu, message, back)]
    stated = np.asarray(log.rig.imu.p_BS_B)
    wrong = [
        i for i, arm in enumerate(found.p_BI_B) if arm.known_to(0.5) and arm.differs(float(stated[i]), ARM_MATTERS_M)
    ]
    if incomplete or not wrong:
        return []
    place = stated.copy()
    for i, arm in enumerate(found.p_BI_B):
        if arm.known_to(ARM_MATTERS_M * 1.5) or i in wrong:
            place[i] = arm.value
    names = ("forward", "left", "up")
    listed = ", ".join(f"{found.p_BI_B[i].text('m')} {names[i]} (stated {stated[i]:.2f} m)" for i in wrong)
    return [
        Finding(
            "imu",
            f"From their velocities in turns, the IMU is {listed} of the DVL.",
            "streams.imu.mounting.translation_m: [" + ", ".join(f"{x:.2f}" for x in place) + "]",
        )
    ]
