"""Fit of the DVL's path, rotated by heading or gyro, to positions.

A path x(t) = ∫ v e^{iψ} dt, east + i north, fits a position as p(t) = z x(t) + c, z = scale · e^{i turn}. Each block of
the log has its own c, which absorbs slow drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.fitting import (
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
from ..streams.channels import seconds
from .inertial import Inertial, yaw_by_heading

POSITION_PERIOD_S = 0.5
"""Positions closer than this are thinned: they add rows but no information at the speed of a vehicle."""
GAP_S = 5.0
"""A silence of the DVL that is longer ends a window: dead reckoning across it is metres off."""
ARM_DOUBT_M = 0.3
"""Uncertainty of every lever arm. At a constant speed an error of the arm looks like a delay."""


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
        scale, turn: factor on the path, and its rotation (rad, counter-clockwise).
        dvl_delay: of the DVL after the yaw, s.
        delay: of the positions after the yaw, s.
        bias: rate (rad/s) subtracted from a yaw by gyro; None with a heading sensor.
        rms_m: of the residuals within a window, per axis.
        mirrored: whether the mirrored path fits far better.
        x, p: (n,) fitted path and positions, each less its mean in each window; t_s (n,).
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
    """Return the positions of GPS and truth, moved from the antenna to B if heading and level allow it."""
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


@dataclass(frozen=True, eq=False)
class Track:
    """The DVL's path: level velocities v (n,) m/s at t_s (n,), to be turned by the yaw (k,) rad at t_yaw (k,)."""

    t_s: Array
    v: Plane
    t_yaw: Array
    yaw: Array

    def at(self, t_s: Array, dvl_delay_s: float, bias: float, mirror: bool = False) -> Plane:
        """Return x(t_s) for a delay of the DVL, a bias of the yaw's rate (rad/s), or the mirrored path."""
        t_true = self.t_s - dvl_delay_s
        each = self.v * np.exp(1j * (np.interp(t_true, self.t_yaw, self.yaw) - bias * t_true))
        if mirror:
            each = each.conj()
        dt_s = np.diff(self.t_s, prepend=self.t_s[0])
        x: Plane = np.cumsum((each + np.concatenate([each[:1], each[:-1]])) / 2 * dt_s)
        return np.interp(t_s, t_true, x.real) + 1j * np.interp(t_s, t_true, x.imag)


@dataclass(frozen=True, eq=False)
class PathFitProblem:
    """A track to fit to positions p (m,) at t_s (m,), each less its mean in each window."""

    track: Track
    t_s: Array
    p: Plane
    window: Index
    by: str

    def x(self, dvl_delay_s: float, delay_s: float, bias: float, mirror: bool = False) -> Plane:
        """Return the track at the positions' times, less its means."""
        return without_trend(self.track.at(self.t_s - delay_s, dvl_delay_s, bias, mirror), self.t_s, self.window, 0)

    def fit(self, dvl_s: float, delay_s: float, bias: float, mirror: bool = False) -> tuple[Fit | None, complex]:
        """Return corrections to these delays and this bias, and to the z = scale · e^{i turn} that comes with them."""
        x = self.x(dvl_s, delay_s, bias, mirror)
        squares = float(np.vdot(x, x).real)
        if squares < 1e-12:  # by the DVL it never moved
            return None, 0j
        z = complex(np.vdot(x, self.p) / squares)

        def slope(dvl: float = 0.0, delay: float = 0.0, rate: float = 0.0) -> Plane:
            ahead = self.x(dvl_s + dvl, delay_s + delay, bias + rate, mirror)
            behind = self.x(dvl_s - dvl, delay_s - delay, bias - rate, mirror)
            return z * (ahead - behind) / (2 * (dvl + delay + rate))

        columns = {"scale": z * x, "turn": 1j * z * x, "delay": slope(delay=0.1), "dvl": slope(dvl=0.1)}
        if self.by == "gyro":
            columns["bias"] = slope(rate=1e-5)
        block = blocks_of_windows(self.window)
        both = {name: stacked(column) for name, column in columns.items()}
        return least_squares(both, stacked(self.p - z * x), np.concatenate([block, block])), z


def fit_path(log: Log, imu: Inertial, where: Positions, by: str) -> PathFit | None:
    """Fit the DVL's path, rotated `by` "heading" or "gyro", to positions; None if they overlap too little."""
    laying = _path_fit_problem(log, imu, where, by)
    if laying is None:
        return None
    dvl_s, delay_s, bias = 0.0, 0.0, 0.0
    best, z = laying.fit(dvl_s, delay_s, bias)
    for _ in range(8):
        if best is None:
            return None
        steps = [best[name].value for name in ("dvl", "delay")] + ([best["bias"].value] if by == "gyro" else [])
        limited = np.clip(steps[:2], -0.5, 0.5)
        if abs(dvl_s + limited[0]) > 5 or abs(delay_s + limited[1]) > 5:
            break
        dvl_s, delay_s = dvl_s + float(limited[0]), delay_s + float(limited[1])
        bias += float(np.clip(steps[2], -2e-3, 2e-3)) if by == "gyro" else 0.0
        best, z = laying.fit(dvl_s, delay_s, bias)
        if max(map(abs, limited)) < 1e-4 and (by != "gyro" or abs(steps[2]) < 1e-7):
            break
    if best is None:
        return None
    grown = complex(z * np.exp(best["scale"].value + 1j * best["turn"].value))
    dof, speed = best.dof, float(np.sqrt(np.mean(np.abs(laying.track.v) ** 2)))
    return PathFit(
        scale=Estimate(abs(grown), best["scale"].sigma * abs(grown), dof),
        turn=Estimate(float(np.angle(grown)), best["turn"].sigma, dof),
        dvl_delay=Estimate(dvl_s, best["dvl"].sigma, dof),
        delay=Estimate(delay_s, float(np.hypot(best["delay"].sigma, ARM_DOUBT_M / max(speed, 1e-3))), dof),
        bias=Estimate(bias, best["bias"].sigma, dof) if by == "gyro" else None,
        rms_m=best.rms,
        mirrored=by == "heading" and _fits_turned_over(laying),
        t_s=laying.t_s,
        x=grown * laying.x(dvl_s, delay_s, bias),
        p=laying.p,
    )


def _path_fit_problem(log: Log, imu: Inertial, where: Positions, by: str) -> PathFitProblem | None:
    """Return the track and the positions to fit it to; None if DVL, yaw and positions overlap too little."""
    t_dvl, v_B, _ = velocities(log)
    if len(t_dvl) < 30:
        return None
    t_yaw, yaw = yaw_by_heading(log, imu) if by == "heading" else (imu.t_s, imu.turned())
    inside = (where.t_s > max(t_dvl[0], t_yaw[0]) + 3) & (where.t_s < min(t_dvl[-1], t_yaw[-1]) - 3)
    inside &= np.abs(t_dvl[np.searchsorted(t_dvl, where.t_s).clip(0, len(t_dvl) - 1)] - where.t_s) < GAP_S
    t_s = where.t_s[inside]
    if len(t_s) < 30 or t_s[-1] - t_s[0] < 20:
        return None
    v_level = np.einsum("nij,nj->ni", imu.level(t_dvl), v_B)
    track = Track(t_dvl, v_level[:, 0] + 1j * v_level[:, 1], t_yaw, yaw)
    window = _stretches(t_s, t_dvl)
    return PathFitProblem(track, t_s, without_trend(where.p[inside], t_s, window, 0), window, by)


def _fits_turned_over(laying: PathFitProblem) -> bool:
    """Return whether the path fits far better with left and right exchanged (0.3 of the rms)."""
    over, _ = laying.fit(0.0, 0.0, 0.0, mirror=True)
    straight, _ = laying.fit(0.0, 0.0, 0.0)
    return over is not None and straight is not None and over.rms < 0.3 * straight.rms


def _stretches(t_s: Array, t_dvl: Array) -> Index:
    """Return windows (n,): as many as there are blocks, cut where the DVL is silent."""
    silent = np.cumsum(np.diff(t_dvl, prepend=t_dvl[0]) > GAP_S)
    piece = silent[np.searchsorted(t_dvl, t_s).clip(0, len(t_dvl) - 1)]
    even = np.arange(len(t_s)) * BLOCKS // len(t_s)
    return np.cumsum((np.diff(piece, prepend=piece[0]) > 0) | (np.diff(even, prepend=0) > 0), dtype=np.intp)
