"""The DVL against positions: its path, turned by the heading or the gyro, laid on the GPS or the truth.

A path x(t) = ∫ v e^{iψ} dt, east + i north, fits a position as p(t) = z x(t) + c, z = scale · e^{i turn}, with a c of
its own in each stretch of the log, so that slow drift is nobody's error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...datasets.log import Log
from ...datasets.state import Array
from .answers import Answer, Delay
from .findings import Check, Finding
from .fitting import (
    BLOCKS,
    Estimate,
    Fit,
    Index,
    Mask,
    Plane,
    blocks_of_windows,
    least_squares,
    stacked,
    without_trend,
)
from .inertial import Inertial, seconds, yaw_by_heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DEGREE = np.pi / 180
SCALE_MATTERS = 0.01
TURN_MATTERS = 1.0 * DEGREE
POSITION_PERIOD_S = 0.5
GAP_S = 5.0
ARM_DOUBT_M = 0.3
"""No lever arm is trusted beyond this, and at a steady speed one looks like a delay."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Horizontal positions of B: when (n,) s, east + i north (n,) m, whose, and how well they are known, m."""

    t_s: Array
    p: Plane
    whose: str
    sigma_m: float


@dataclass(frozen=True, eq=False)
class PathFit:
    """p(t − delay) = scale · e^{i turn} · x, and the DVL read `dvl_delay` after the yaw that turns it.

    Attributes:
        scale, turn: what the path must be multiplied with, and turned by (rad, counter-clockwise).
        dvl_delay: of the DVL after the yaw, s.
        delay: of the positions after the yaw, s.
        bias: rate (rad/s) taken from the yaw where it is a gyro's; None where a heading sensor turns the path.
        rms_m: of what is left within a stretch, per axis.
        mirrored: whether the path fits far better turned over.
        x, p: (n,) what is laid on what, each less its mean in each stretch; t_s (n,).
    """

    scale: Estimate
    turn: Estimate
    dvl_delay: Estimate
    delay: Estimate
    bias: Estimate | None
    rms_m: float
    mirrored: bool
    t_s: Array
    x: Plane
    p: Plane


def velocities(log: Log) -> tuple[Array, Array, list[str]]:
    """Return when (n,) s and v_WB_B (n, 3) m/s, unmeasured axes as zero, and the names of those."""
    assert log.dvl is not None
    known: Mask = np.isfinite(log.dvl.sigma)
    never = [axis for i, axis in enumerate("xyz") if not known[:, i].any()]
    return seconds(log, log.dvl.t_ns), np.where(known, log.dvl.z, 0.0), never


def positions(log: Log, imu: Inertial) -> list[Positions]:
    """Return the positions there are: the truth's and the GPS's, brought to B as far as the level allows."""
    found = []
    if log.gps is not None:
        good = np.isfinite(log.gps.sigma[:, :2]).all(axis=1)
        t_s, p = seconds(log, log.gps.t_ns[good]), log.gps.z[good]
        arm = np.asarray(log.rig.gps.p_BS_B)
        if len(t_s) and arm[:2].any() and log.heading is not None:
            t_yaw, yaw = yaw_by_heading(log, imu)
            reach = np.einsum("nij,j->ni", imu.level(t_s), arm)
            turn = np.exp(1j * np.interp(t_s, t_yaw, yaw)) * (reach[:, 0] + 1j * reach[:, 1])
            found.append(Positions(t_s, p[:, 0] + 1j * p[:, 1] - turn, "GPS", _typical(log.gps.sigma[good])))
        elif len(t_s):
            found.append(Positions(t_s, p[:, 0] + 1j * p[:, 1], "GPS", _typical(log.gps.sigma[good])))
    if log.truth is not None:
        p = log.truth.p_WB_W
        found.append(Positions(seconds(log, log.truth.t_ns), p[:, 0] + 1j * p[:, 1], log.truth_kind, 0.01))
    return [_thinned(each) for each in found if len(each.t_s) >= 30]


def _typical(sigma: Array) -> float:
    return float(np.median(sigma[:, :2]))


def _thinned(every: Positions) -> Positions:
    slot = np.floor(every.t_s / POSITION_PERIOD_S)
    first = np.flatnonzero(np.diff(slot, prepend=-1e9) > 0)
    return Positions(every.t_s[first], every.p[first], every.whose, every.sigma_m)


def fit_path(log: Log, imu: Inertial, where: Positions, by: str) -> PathFit | None:
    """Lay the DVL's path, turned "by" heading or gyro, on positions; None where they share too little."""
    t_dvl, v_B, _ = velocities(log)
    if len(t_dvl) < 30:
        return None
    if by == "heading":
        t_yaw, yaw = yaw_by_heading(log, imu)
    else:
        t_yaw, yaw = imu.t_s, imu.turned()
    v_level = np.einsum("nij,nj->ni", imu.level(t_dvl), v_B)
    v = v_level[:, 0] + 1j * v_level[:, 1]
    dt_s = np.diff(t_dvl, prepend=t_dvl[0])

    def path(t_s: Array, dvl_delay_s: float, bias: float, mirror: bool = False) -> Plane:
        t_true = t_dvl - dvl_delay_s
        psi = np.interp(t_true, t_yaw, yaw) - bias * t_true
        each = v * np.exp(1j * psi)
        if mirror:
            each = each.conj()
        x: Plane = np.cumsum((each + np.concatenate([each[:1], each[:-1]])) / 2 * dt_s)
        return np.interp(t_s, t_true, x.real) + 1j * np.interp(t_s, t_true, x.imag)

    inside = (where.t_s > max(t_dvl[0], t_yaw[0]) + 3) & (where.t_s < min(t_dvl[-1], t_yaw[-1]) - 3)
    inside &= np.abs(t_dvl[np.searchsorted(t_dvl, where.t_s).clip(0, len(t_dvl) - 1)] - where.t_s) < GAP_S
    t_s, p = where.t_s[inside], where.p[inside]
    if len(t_s) < 30 or t_s[-1] - t_s[0] < 20:
        return None
    window = _stretches(t_s, t_dvl)
    block = blocks_of_windows(window)
    p = without_trend(p, t_s, window, 0)

    def fit(dvl_delay_s: float, delay_s: float, bias: float, mirror: bool = False) -> tuple[Fit | None, complex]:
        def x_at(shift: float = 0.0, dvl: float = 0.0, rate: float = 0.0) -> Plane:
            x = path(t_s - delay_s - shift, dvl_delay_s + dvl, bias + rate, mirror)
            return without_trend(x, t_s, window, 0)

        x = x_at()
        squares = float(np.vdot(x, x).real)
        if squares < 1e-12:  # by the DVL it never moved
            return None, 0j
        z = complex(np.vdot(x, p) / squares)
        columns: dict[str, Plane] = {"scale": z * x, "turn": 1j * z * x}
        columns["delay"] = z * (x_at(shift=0.1) - x_at(shift=-0.1)) / 0.2
        columns["dvl"] = z * (x_at(dvl=0.1) - x_at(dvl=-0.1)) / 0.2
        if by == "gyro":
            columns["bias"] = z * (x_at(rate=1e-5) - x_at(rate=-1e-5)) / 2e-5
        left = p - z * x
        rows = np.concatenate([block, block])
        both = {name: stacked(column) for name, column in columns.items()}
        return least_squares(both, stacked(left), rows), z

    dvl_s, delay_s, bias = 0.0, 0.0, 0.0
    best, z = fit(dvl_s, delay_s, bias)
    for _ in range(8):
        if best is None:
            return None
        steps = [best[name].value for name in ("dvl", "delay")] + ([best["bias"].value] if by == "gyro" else [])
        limited = np.clip(steps[:2], -0.5, 0.5)
        if abs(dvl_s + limited[0]) > 5 or abs(delay_s + limited[1]) > 5:
            break
        dvl_s, delay_s = dvl_s + float(limited[0]), delay_s + float(limited[1])
        bias += float(np.clip(steps[2], -2e-3, 2e-3)) if by == "gyro" else 0.0
        best, z = fit(dvl_s, delay_s, bias)
        if max(map(abs, limited)) < 1e-4 and (by != "gyro" or abs(steps[2]) < 1e-7):
            break
    if best is None:
        return None
    over, _ = fit(0.0, 0.0, 0.0, True) if by == "heading" else (None, z)
    straight, _ = fit(0.0, 0.0, 0.0)
    mirrored = over is not None and straight is not None and over.rms < 0.3 * straight.rms
    grown = complex(z * np.exp(best["scale"].value + 1j * best["turn"].value))
    x = without_trend(path(t_s - delay_s, dvl_s, bias), t_s, window, 0)
    dof, speed = best.dof, float(np.sqrt(np.mean(np.abs(v) ** 2)))
    return PathFit(
        scale=Estimate(abs(grown), best["scale"].sigma * abs(grown), dof),
        turn=Estimate(float(np.angle(grown)), best["turn"].sigma, dof),
        dvl_delay=Estimate(dvl_s, best["dvl"].sigma, dof),
        delay=Estimate(delay_s, float(np.hypot(best["delay"].sigma, ARM_DOUBT_M / max(speed, 1e-3))), dof),
        bias=Estimate(bias, best["bias"].sigma, dof) if by == "gyro" else None,
        rms_m=best.rms,
        mirrored=mirrored,
        t_s=t_s,
        x=grown * x,
        p=p,
    )


def _stretches(t_s: Array, t_dvl: Array) -> Index:
    """Return windows (n,): as many as there are blocks, cut where the DVL is silent."""
    silent = np.cumsum(np.diff(t_dvl, prepend=t_dvl[0]) > GAP_S)
    piece = silent[np.searchsorted(t_dvl, t_s).clip(0, len(t_dvl) - 1)]
    even = np.arange(len(t_s)) * BLOCKS // len(t_s)
    return np.cumsum((np.diff(piece, prepend=piece[0]) > 0) | (np.diff(even, prepend=0) > 0), dtype=np.intp)


def dvl_against_positions(log: Log, imu: Inertial, where: Positions) -> Answer | None:
    """Whether the DVL's path is as long as the positions' and runs where theirs does."""
    by = "gyro" if log.heading is None else "heading"
    found = fit_path(log, imu, where, by)
    if found is None:
        return None
    whose = where.whose
    moved = found.scale.known_to(0.3 * max(abs(found.scale.value), 0.1))
    facts = {"turned by": by, "scale that the DVL needs": found.scale.text_if(0.3)}
    facts["rms left in a twelfth of the log"] = f"{found.rms_m:.2g} m per axis"
    findings: list[Finding] = []
    if found.mirrored:
        says = (
            f"The DVL's path fits the {whose}'s only turned over: north and east are exchanged, or the heading "
            "turns the wrong way (a compass read as a yaw)."
        )
        part = "streams.gps" if whose == "GPS" else "truth"
        says += f" Or `{part}.frame` is wrong."
        findings.append(Finding("heading", says, "streams.heading.convention: yaw  # or compass, whichever it is not"))
    elif moved:
        facts[f"turn of the DVL's path onto the {whose}'s"] = (
            found.turn.times(1 / DEGREE).text("°") if by == "heading" else "free: no heading sensor"
        )
        facts["DVL later than the yaw by"] = found.dvl_delay.text_if(0.5, "s")
        facts[f"{whose} later than the yaw by"] = found.delay.text_if(0.5, "s")
        if found.bias is not None:
            facts["gyro bias about the vertical"] = found.bias.text("rad/s")
        findings += _scale_findings(found, whose)
        findings += _turn_findings(log, found, whose) if by == "heading" else []
    delays = []
    if moved and not found.mirrored:
        yaw = "heading" if by == "heading" else "imu"
        delays.append(Delay("dvl", yaw, found.dvl_delay))
        delays.append(Delay("gps" if whose == "GPS" else "truth position", yaw, found.delay))

    def draw(axes: Axes) -> None:
        left = found.p - found.x
        axes.plot(found.t_s / 60, left.real, ".", markersize=2, label="east")
        axes.plot(found.t_s / 60, left.imag, ".", markersize=2, label="north")
        axes.legend(fontsize=7)
        axes.set(xlabel="time (min)", ylabel=f"{whose} less DVL's path (m)", title=f"DVL against {whose}")

    kept = tuple(delay for delay in delays if delay.by.known_to(0.5))
    return Answer(Check(f"DVL against the positions of the {whose}", facts, tuple(findings), draw), kept)


def _scale_findings(found: PathFit, whose: str) -> list[Finding]:
    if not found.scale.differs(1.0, SCALE_MATTERS):
        return []
    scale = found.scale.value
    units = {"cm/s": 0.01, "mm/s": 0.001, "m/s": 100.0, "kn": 1852 / 3600, "km/h": 1 / 3.6}
    near = [unit for unit, ratio in units.items() if abs(scale / ratio - 1) < 0.1 and abs(scale - 1) > 0.3]
    guess = f" That is the ratio of {near[0]} to what is stated." if near else ""
    return [
        Finding(
            "dvl",
            f"The DVL's path must be multiplied by {found.scale.text()} to be as long as the {whose}'s.{guess}",
            f"streams.dvl.velocity.unit: {near[0]}" if near else f"streams.dvl.velocity.scale: {scale:.4g}",
        )
    ]


def _turn_findings(log: Log, found: PathFit, whose: str) -> list[Finding]:
    if not found.turn.differs(0.0, TURN_MATTERS):
        return []
    attitude = log.truth is not None and bool(np.isfinite(log.truth.R_WB).all(axis=(1, 2)).any())
    if attitude and whose != "GPS":
        return []  # its attitude says whether heading or DVL is turned: other checks tell
    add = np.degrees(found.turn.value)
    return [
        Finding(
            "heading",
            f"Dead reckoned with DVL and heading, the path must be turned by {found.turn.times(1 / DEGREE).text('°')} "
            f"counter-clockwise to run as the {whose}'s: declination, deviation or mounting of the heading sensor, or "
            "the DVL's own yaw on the vehicle.",
            f"streams.heading.add_deg: {-add:.1f}  # convention: compass; with yaw {add:.1f}",
        )
    ]
