"""Truth or reference against itself, and against the sensors that see the same: GPS, depth, DVL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ....datasets.log import Log
from ....datasets.quantities import DEGREE
from ....datasets.state import Array, TimeArray
from ..findings.advice import DEPTH_OFFSET
from ..findings.finding import Check, Finding
from ..findings.fitting import Estimate, Fit, Mask, blocks_of, least_squares, mean_of
from ..gross.datum import ZERO_M, zero_finding
from ..streams.channels import seconds
from .inertial import Inertial, cross
from .pair_check import Delay, PairCheck
from .path_fit import velocities
from .velocity import SCALE_MATTERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DRIFT_MATTERS_M_S = 0.02
"""A velocity that is off its own positions by this would be the largest part of most velocity scores."""
OFFSET_MATTERS_M = 1.0
"""Below a metre an offset is within a GPS fix."""
DEPTH_OFFSET_MATTERS_M = 0.2
"""The tide over an hour, or the height of the sensor in a hull, is as much."""
SPEED_MATTERS_M_S = 0.05
"""A DVL's bias is 1 % of its speed at worst, and 5 cm/s is more than that at 4 m/s."""
TURN_MATTERS = 1.0 * DEGREE
"""rad: mountings are measured to about a degree."""
ARM_M = 0.3
"""At 0.1 rad/s an arm that is off by this makes 3 cm/s, most of an error of velocity; positions are off by as much."""
AXES = ("east", "north", "up")
AWAY = (("forward", "x"), ("left", "y"), ("up", "z"))


@dataclass(frozen=True, eq=False)
class Reference:
    """The truth: t_s (n,), p_W and v_W (n, 3), R_WB (n, 3, 3), NaN where unknown."""

    t_s: Array
    p_W: Array
    v_W: Array
    R_WB: Array

    def at(self, t_s: Array, values: Array) -> Array:
        """Interpolate one of its arrays."""
        flat = values.reshape(len(values), -1)
        found = np.stack([np.interp(t_s, self.t_s, column) for column in flat.T], axis=1)
        return found.reshape(len(t_s), *values.shape[1:])

    def covers(self, t_s: Array) -> Mask:
        """Return which times (n,) are at least a second inside the span, in a gap of rows under 2 s."""
        near = np.searchsorted(self.t_s, t_s).clip(1, len(self.t_s) - 1)
        gap = self.t_s[near] - self.t_s[near - 1]
        return np.asarray((t_s > self.t_s[0] + 1) & (t_s < self.t_s[-1] - 1) & (gap < 2.0))


def reference_of(log: Log) -> Reference | None:
    """Return the truth, with a velocity.

    If the truth has no velocity, or one that its positions contradict, positions are differenced over a second.
    """
    truth = log.truth
    if truth is None or len(truth) < 30:
        return None
    t_s = seconds(log, truth.t_ns)
    v_W = truth.v_WB_W
    if v_W is not None:
        said = ((v_W[1:] + v_W[:-1]) / 2 * np.diff(t_s)[:, None]).sum(axis=0)
        off = np.abs(said - (truth.p_WB_W[-1] - truth.p_WB_W[0])) / (t_s[-1] - t_s[0])
        v_W = None if (off > DRIFT_MATTERS_M_S).any() else v_W
    if v_W is None:
        half = max(0.5, float(np.median(np.diff(t_s))))
        ahead, behind = (
            np.stack([np.interp(t_s + shift, t_s, p) for p in truth.p_WB_W.T], axis=1) for shift in (half, -half)
        )
        v_W = (ahead - behind) / (2 * half)
    return Reference(t_s, truth.p_WB_W, v_W, truth.R_WB)


def _at_sensor(log: Log, reference: Reference, t_ns: TimeArray, p_BS_B: Array) -> tuple[Array, Mask, Array]:
    """Return the times of a sensor that the reference covers, their mask, and the sensor's position then (n, 3) m."""
    t_s = seconds(log, t_ns)
    inside = reference.covers(t_s)
    t_s = t_s[inside]
    R_WB = np.nan_to_num(reference.at(t_s, reference.R_WB))
    return t_s, inside, reference.at(t_s, reference.p_W) + R_WB @ p_BS_B


def truth_against_itself(log: Log) -> PairCheck | None:
    """Whether the truth's positions agree with its velocities; None if it has no velocities."""
    truth = log.truth
    if truth is None or truth.v_WB_W is None or len(truth) < 30:
        return None
    t_s, whose = seconds(log, truth.t_ns), log.truth_kind
    dt_s = np.diff(t_s)
    moved = np.diff(truth.p_WB_W, axis=0)
    said = (truth.v_WB_W[1:] + truth.v_WB_W[:-1]) / 2 * dt_s[:, None]
    faster = np.diff(truth.v_WB_W, axis=0)
    columns = {name: np.outer(dt_s, unit).ravel() for name, unit in zip(AXES, np.eye(3), strict=True)}
    columns["delay"] = faster.ravel()
    fit = least_squares(columns, (said - moved).ravel(), np.repeat(blocks_of(len(dt_s)), 3))
    if fit is None:
        return None
    facts, findings = {}, []
    for name in AXES:
        facts[f"velocity less what the positions do, {name}"] = fit[name].text("m/s")
        if fit[name].differs(0.0, DRIFT_MATTERS_M_S):
            message = (
                f"The {whose}'s velocity {name} is {fit[name].text('m/s')} off the rate of its own positions: do not "
                "score velocities against it, or leave `truth.velocity` out."
            )
            findings.append(Finding("truth", message, "truth.velocity: null"))
    facts["positions later than velocities by"] = fit["delay"].text_if(0.5, "s")
    known = fit["delay"].known_to(0.5)
    delays = (Delay("truth position", "truth velocity", fit["delay"]),) if known else ()

    def draw(axes: Axes) -> None:
        off = np.cumsum(said - moved, axis=0)
        for axis, name in enumerate(AXES):
            axes.plot(t_s[1:], off[:, axis], label=name)
        axes.legend(fontsize=7)
        axes.set(xlabel="time (s)", ylabel="∫ velocity less position (m)", title=f"{whose} against itself")

    return PairCheck(Check(f"{whose} against itself", facts, tuple(findings), draw), delays)


def gps_against_truth(log: Log, reference: Reference) -> PairCheck | None:
    """Whether GPS and truth agree in position, height and time."""
    if log.gps is None:
        return None
    t_s, inside, place = _at_sensor(log, reference, log.gps.t_ns, log.rig.gps.p_BS_B)
    if len(t_s) < 30:
        return None
    z, sigma = log.gps.z[inside], log.gps.sigma[inside]
    error = z - place
    swapped = z[:, [1, 0]] - place[:, :2]
    if np.median(np.abs(swapped)) < 0.2 * np.median(np.abs(error[:, :2])):
        message = f"GPS lies on the {log.truth_kind} only with east and north exchanged: one of the two is read as NED."
        finding = Finding("gps", message, "streams.gps.frame: NED  # or ENU, whichever it is not")
        return PairCheck(Check(f"GPS against {log.truth_kind}", {"lies": "exchanged, east for north"}, (finding,)))
    v = reference.at(t_s, reference.v_W)
    block = blocks_of(len(t_s))
    whose = log.truth_kind
    flat = np.isfinite(sigma[:, :2]).all(axis=1)
    rows = np.concatenate([block[flat], block[flat]])
    one, zero = np.ones(flat.sum()), np.zeros(flat.sum())
    columns = {
        "east": np.concatenate([one, zero]),
        "north": np.concatenate([zero, one]),
        "delay": -np.concatenate([v[flat, 0], v[flat, 1]]),
    }
    fit = least_squares(columns, np.concatenate([error[flat, 0], error[flat, 1]]), rows)
    if fit is None:
        return None
    facts = {f"GPS less {whose}, {name}": fit[name].text("m") for name in ("east", "north")}
    facts["rms of the residual"] = f"{fit.rms:.2g} m per axis"
    facts[f"GPS later than {whose} by"] = fit["delay"].text_if(1.0, "s")
    findings = []
    stated = float(np.median(sigma[flat, :2]))
    if any(fit[name].differs(0.0, max(OFFSET_MATTERS_M, 2 * stated)) for name in ("east", "north")):
        message = f"GPS lies {fit['east'].text('m')} east and {fit['north'].text('m')} north of the {whose}."
        findings.append(Finding("gps", message + " Origins, datums or lever arms differ."))
    high = np.isfinite(sigma[:, 2])
    up = mean_of(error[high, 2], block[high]) if np.count_nonzero(high) > 30 else None
    if up is not None:
        facts[f"GPS less {whose}, up"] = up.text("m")
        if up.differs(0.0, max(OFFSET_MATTERS_M, 2 * float(np.median(sigma[high, 2])))):
            message = f"GPS heights are {up.text('m')} above the {whose}'s: ellipsoid and geoid, or different origins."
            findings.append(Finding("gps", message, f"streams.gps: raise {-up.value:.2f}"))
    delays = (Delay("gps", "truth position", fit["delay"]),) if fit["delay"].known_to(1.0) else ()

    def draw(axes: Axes) -> None:
        axes.plot(error[flat, 0], error[flat, 1], ".", markersize=2)
        axes.set(xlabel="east (m)", ylabel="north (m)", title=f"GPS less {whose}", aspect="equal")

    return PairCheck(Check(f"GPS against {whose}", facts, tuple(findings), draw), delays)


def depth_against_truth(log: Log, reference: Reference) -> PairCheck | None:
    """Whether depth sensor and truth agree on the height."""
    if log.depth is None:
        return None
    t_s, inside, place = _at_sensor(log, reference, log.depth.t_ns, log.rig.depth.p_BS_B)
    if len(t_s) < 30:
        return None
    z, height = log.depth.z[inside, 0], place[:, 2]
    middle = float(height.mean())
    whose, block = log.truth_kind, blocks_of(len(t_s))
    columns = {"offset": np.ones(len(t_s))}
    climb = np.gradient(height, t_s)
    if height.std() > 10 * float(np.median(log.depth.sigma)):
        columns |= {"scale": height - middle, "delay": -climb}
    fit = least_squares(columns, z - height, block)
    if fit is None:
        return None
    offset = fit["offset"]
    facts = {f"depth sensor's height less the {whose}'s": offset.text("m"), "rms of the residual": f"{fit.rms:.2g} m"}
    delays: tuple[Delay, ...] = ()
    findings = []
    if "scale" in columns:
        scale = Estimate(1 + fit["scale"].value, fit["scale"].sigma, fit.dof)
        facts[f"depth sensor by {whose}, slope"] = scale.text_if(0.3)
        facts[f"depth sensor later than {whose} by"] = fit["delay"].text_if(0.5, "s")
        delays = (Delay("depth", "truth position", fit["delay"]),) if fit["delay"].known_to(0.5) else ()
        if scale.differs(1.0, 0.01):
            message = f"The depth sensor reads {scale.text()} of the {whose}'s height changes: unit, sign or density."
            turned = abs(scale.value + 1) < 0.05
            fix = f"streams.depth.depth.scale: {1 / scale.value:.4g}"
            fix = "streams.depth.positive: up  # or down, whichever it is not" if turned else fix
            findings.append(Finding("depth", message, fix))
    if offset.differs(0.0, DEPTH_OFFSET_MATTERS_M) and not findings:
        shift = offset.value
        message = f"The {whose}'s height is {offset.times(-1).text('m')} above the depth sensor's throughout."
        of_truth = Finding("truth", message, f"truth: raise {shift:.3f}")
        of_depth = Finding("depth", message, DEPTH_OFFSET.format(shift, -shift))
        near = of_truth if log.truth_kind == "reference" else of_depth
        findings.append(near if abs(shift) < ZERO_M else zero_finding(log, shift))

    def draw(axes: Axes) -> None:
        axes.plot(t_s, z, label="depth sensor")
        axes.plot(t_s, height, label=whose)
        axes.legend(fontsize=7)
        axes.set(xlabel="time (s)", ylabel="height (m)", title=f"depth against {whose}")

    return PairCheck(Check(f"depth against {whose}", facts, tuple(findings), draw), delays)


def dvl_against_truth(log: Log, imu: Inertial, reference: Reference) -> PairCheck | None:
    """Compare the DVL with the truth's velocity, axis by axis; None if the truth has no attitude."""
    if log.dvl is None or not np.isfinite(reference.R_WB).any():
        return None
    t_s, z, _ = velocities(log)
    inside = reference.covers(t_s)
    R = reference.at(t_s, reference.R_WB)
    inside &= np.isfinite(R).all(axis=(1, 2))
    if np.count_nonzero(inside) < 30:
        return None
    t_s, z, R, known = t_s[inside], z[inside], R[inside], np.isfinite(log.dvl.sigma[inside])

    def v_at(shift: float) -> Array:
        R = reference.at(t_s + shift, reference.R_WB)
        return np.einsum("nji,nj->ni", R, reference.at(t_s + shift, reference.v_W))

    found = _fit_velocity(t_s, z, known, v_at, imu)
    if found is None:
        return None
    fit, scale, delay, R_BD, p_BD_B = found
    error = z - v_at(0.0)
    whose, facts, findings, more = log.truth_kind, {}, [], []
    for i, axis in enumerate(("forward", "left", "up")):
        if not known[:, i].any():
            facts[f"DVL less {whose}, {axis}"] = "not measured"
            continue
        mean = mean_of(error[known[:, i], i], blocks_of(len(t_s))[known[:, i]])
        if mean is not None:
            facts[f"DVL less {whose}, {axis}"] = mean.text("m/s")
            stated = float(np.median(log.dvl.sigma[inside][known[:, i], i]))
            if mean.differs(0.0, max(SPEED_MATTERS_M_S, stated)):
                message = f"The DVL reads {mean.text('m/s')} more {axis} than the {whose}'s velocity."
                more.append(Finding("dvl", message))
    facts[f"DVL by {whose}, scale"] = scale.text_if(0.3)
    facts[f"DVL later than {whose} by"] = delay.text_if(0.5, "s")
    turned = Rotation.from_matrix(R_BD).as_rotvec()
    for i, (name, axis) in enumerate((("roll", "x"), ("pitch", "y"), ("yaw", "z"))):
        if f"turn {axis}" not in fit.names:
            continue
        turn = Estimate(float(turned[i]), fit[f"turn {axis}"].sigma, fit.dof)
        facts[f"DVL's axes in the {whose}'s, {name}"] = turn.times(1 / DEGREE).text_if(10.0, "°")
        if turn.known_to(10 * DEGREE) and turn.differs(0.0, TURN_MATTERS):
            message = (
                f"The DVL's axes are turned by {turn.times(1 / DEGREE).text('°')} in {name} from those of the {whose}. "
                "The DVL's axes are the body's, so the mountings of the other sensors, and the truth's attitude, must "
                "be turned the other way."
            )
            findings.append(Finding("dvl", message))
    findings = findings or ([] if scale.differs(1.0, SCALE_MATTERS) else more)
    arm = [
        Estimate(float(p_BD_B[i]), fit[f"arm {axis}"].sigma, fit.dof) if f"arm {axis}" in fit.names else None
        for i, axis in enumerate("xyz")
    ]
    said = [e.text("m") if e is not None and e.known_to(0.5) else "not observable" for e in arm]
    facts[f"lever arm of the DVL from the {whose}'s point"] = "forward " + ", left ".join(said[:2]) + f", up {said[2]}"
    away = [a for a, e in zip(AWAY, arm, strict=True) if e is not None and e.known_to(0.5) and e.differs(0.0, ARM_M)]
    if away and not findings:
        listed = ", ".join(f"{said['xyz'.index(axis)]} {name}" for name, axis in away)
        message = (
            f"The DVL is {listed} of the point whose positions and velocities the {whose} gives: the lever arm of the "
            f"{whose} is not taken into account."
        )
        findings.append(Finding("truth", message, hint=f"move the {whose} to the DVL's place before it is used"))
    delays = (Delay("dvl", "truth velocity", delay),) if delay.known_to(0.5) else ()

    def draw(axes: Axes) -> None:
        for i, axis in enumerate(("forward", "left", "up")):
            if known[:, i].any():
                axes.plot(t_s[known[:, i]], error[known[:, i], i], ".", markersize=2, label=axis)
        axes.legend(fontsize=7)
        axes.set(xlabel="time (s)", ylabel="m/s", title=f"DVL less velocity of the {whose}")

    return PairCheck(Check(f"DVL against the velocity of the {whose}", facts, tuple(findings), draw), delays)


def _fit_velocity(
    t_s: Array, z: Array, known: Mask, v_at: Callable[[float], Array], imu: Inertial
) -> tuple[Fit, Estimate, Estimate, Array, Array] | None:
    """Fit z(t) = scale · R_DB (v_B + w × p)(t − delay) to the measured axes.

    Returns:
        The last fit, scale, delay, R_BD (3, 3) and p_BD_B (3,); None if the data do not determine them.
    """
    scale, delay_s, R_BD, p_BD_B = 1.0, 0.0, np.eye(3), np.zeros(3)
    block, rows, step_s = np.repeat(blocks_of(len(t_s)), 3), known.ravel(), 0.1
    fit: Fit | None = None

    def said(shift: float) -> tuple[Array, Array]:
        w_B = np.stack([np.interp(t_s - shift, imu.t_s, imu.w_L[:, i]) for i in range(3)], axis=1)
        return scale * (v_at(-shift) + cross(w_B, p_BD_B)) @ R_BD, w_B

    for _ in range(6):
        here, w_B = said(delay_s)
        unit = np.eye(3)
        columns = {"scale": here / scale}
        columns["delay"] = (said(delay_s + step_s)[0] - said(delay_s - step_s)[0]) / (2 * step_s)
        columns |= {f"turn {a}": -cross(unit[i], here) for i, a in enumerate("xyz")}
        columns |= {f"arm {a}": scale * cross(w_B, unit[i]) @ R_BD for i, a in enumerate("xyz")}
        columns = {name: c.ravel()[rows] for name, c in columns.items()}
        columns = {name: c for name, c in columns.items() if np.any(np.abs(c) > 1e-9)}
        fit = least_squares(columns, (z - here).ravel()[rows], block[rows])
        if fit is None or "scale" not in fit.names:
            return None

        def step(name: str, most: float, fit: Fit = fit) -> float:
            """Return a coefficient's step; zero if the data do not determine it."""
            usable = name in fit.names and fit[name].known_to(20 * most)
            return float(np.clip(fit[name].value, -most, most)) if usable else 0.0

        scale += step("scale", 0.5)
        delay_s += step("delay", 0.5)
        R_BD = R_BD @ Rotation.from_rotvec([step(f"turn {a}", 0.5) for a in "xyz"]).as_matrix()
        p_BD_B = p_BD_B + [step(f"arm {a}", 1.0) for a in "xyz"]
    assert fit is not None
    sigma_s = fit["delay"].sigma if "delay" in fit.names else np.inf
    return fit, Estimate(scale, fit["scale"].sigma, fit.dof), Estimate(delay_s, sigma_s, fit.dof), R_BD, p_BD_B
