"""Heading sensor against gyro, and against truth: signs, units, bias, delay, offset, magnetic disturbance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter1d

from ....datasets.log import Log
from ....datasets.quantities import DEGREE
from ....datasets.state import Array
from ..findings.finding import Check, Finding
from ..findings.fitting import (
    BLOCKS,
    Estimate,
    Fit,
    Index,
    Mask,
    blocks_of,
    blocks_of_windows,
    least_squares,
    mean_of,
    windows_of,
    without_trend,
)
from ..streams.channels import seconds
from .inertial import LEVEL_S, Inertial, headings
from .pair_check import Delay, PairCheck
from .path_fit import fit_path, positions

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WINDOW_S = 60.0
"""A mean is removed per window: a consumer gyro's bias drifts by under 0.1° in it, and a turn still fits."""
LAGS_S = np.arange(-3.0, 3.01, 0.25)
"""s: where the search for the delay starts; steps shorter than a turn, so that the fit converges from the best one."""
SLOPE_MATTERS = 0.03
"""Relative: 1° of error in a turn of 33°, more than compass deviation that is left after calibration."""
FOLLOWS = 0.7
"""Least length of the mean of e^{i error}; it is 1 without errors and 0 for errors in all directions."""
OFFSET_MATTERS = 1.0 * DEGREE
"""A magnetic compass is good to 1 to 2°; 1° is 1.7 % of the distance travelled, across the track."""
SLOW_MATTERS = 0.5 * DEGREE
"""Slow errors below this are within the rounding of many compasses."""
OVERCONFIDENT = 2.0
"""A stated sigma smaller by this factor than one that accounts for lasting errors is a finding."""
MOST_ROWS = 20_000
"""Readings used; a longer stream is thinned, since slow errors do not average out anyway."""
GRID_ROWS = 3_000
"""Readings used on the coarse grid of delays, for speed."""


@dataclass(frozen=True, eq=False)
class GyroHeading:
    """psi(t) = slope · theta(t − delay) − bias · t + …, theta the integrated gyro.

    Attributes:
        t_s, psi: (n,) the heading readings.
        slope: of the heading by the gyro; 1 where both are right.
        bias: of the gyro about the vertical, rad/s.
        delay: of the heading after the gyro, s.
        left: (n,) rad, heading less the gyro, its bias and its delay.
        kept: (n,) rows that were not outliers.
    """

    t_s: Array
    psi: Array
    slope: Estimate
    bias: Estimate
    delay: Estimate
    left: Array
    kept: Mask


def fit_gyro_to_heading(log: Log, imu: Inertial) -> GyroHeading | None:
    """Fit the heading by the integrated gyro; None where the two share too little time."""
    t_s, psi = headings(log)
    inside = (t_s > imu.t_s[0] + 3) & (t_s < imu.t_s[-1] - 3)
    t_s, psi = t_s[inside], psi[inside]
    stride = max(len(t_s) // MOST_ROWS, 1)
    t_s, psi = t_s[::stride], psi[::stride]
    if len(t_s) < 30:
        return None
    theta = imu.turned(np.asarray(log.rig.heading.R_BS)[:, 0])
    long = _turns(t_s, psi, imu, theta, min(WINDOW_S, (t_s[-1] - t_s[0]) / 12), 0, None)
    if long is None:
        return None
    best, delay_s = long
    slope, bias = best["slope"], best["bias"]
    sigma_s = best["delay"].sigma / max(abs(slope.value), 1e-9)
    short = _turns(t_s, psi, imu, theta, WINDOW_S / 4, 1, delay_s)
    if short is not None and short[0]["delay"].known_to(0.5):
        apart = abs(short[1] - delay_s)
        if apart > 3 * np.hypot(sigma_s, short[0]["delay"].sigma):
            sigma_s = float(
                np.hypot(sigma_s, apart)
            )  # slow and fast turns give different delays: a filter's lag, or a disturbed compass
    left = psi - slope.value * np.interp(t_s - delay_s, imu.t_s, theta) + bias.value * t_s
    delay = Estimate(delay_s, sigma_s, slope.dof)
    return GyroHeading(t_s, psi, slope, bias, delay, left - np.median(left), best.kept)


def _turns(
    t_s: Array, psi: Array, imu: Inertial, theta: Array, window_s: float, degree: int, delay_s: float | None
) -> tuple[Fit, float] | None:
    """Return the fit of the heading by the integrated gyro, and the delay (s); the search starts on a coarse grid."""
    if delay_s is None and len(t_s) > 2 * GRID_ROWS:
        stride = len(t_s) // GRID_ROWS
        coarse = _turns(t_s[::stride], psi[::stride], imu, theta, window_s, degree, None)
        delay_s = None if coarse is None else coarse[1]
    window = windows_of(t_s, window_s, 5.0)
    block = blocks_of_windows(window)
    y = without_trend(psi, t_s, window, degree)

    def fit(delay_s: float) -> Fit | None:
        def at(more_s: float) -> Array:
            return np.interp(t_s - delay_s - more_s, imu.t_s, theta)

        step_s = max(imu.period_s, 0.05)
        columns = {"slope": at(0), "delay": (at(step_s) - at(-step_s)) / (2 * step_s)}
        if not degree:
            columns["bias"] = -t_s
        return least_squares({k: without_trend(c, t_s, window, degree) for k, c in columns.items()}, y, block)

    if delay_s is None:
        fits = {lag: found for lag in LAGS_S if (found := fit(lag)) is not None}
        if not fits:
            return None
        delay_s = float(min(fits, key=lambda lag: float(np.median(np.abs(fits[lag].residual)))))
    best = fit(delay_s)
    for _ in range(6):
        if best is None:
            return None
        more_s = best["delay"].value / (best["slope"].value or 1.0)
        if not abs(more_s) < 1.0 or abs(delay_s + more_s) > 4.0:
            break
        delay_s += more_s
        best = fit(delay_s)
        if abs(more_s) < 1e-5:
            break
    return None if best is None else (best, delay_s)


def gyro_against_heading(log: Log, imu: Inertial) -> PairCheck | None:
    """Compare the integrated gyro with the heading."""
    found = fit_gyro_to_heading(log, imu)
    if found is None:
        return None
    facts, findings = {}, []
    turning = found.slope.known_to(0.2 * max(abs(found.slope.value), 0.01))
    axis, correlation = _turning_axis(log, found)
    facts["axis of B that turns with the heading"] = f"{axis} (correlation {abs(correlation):.2f})"
    facts["heading by gyro, slope"] = found.slope.text() if turning else "not observable: the vehicle hardly turns"
    if turning:
        findings += _slope_findings(log, imu, found, correlation)
        findings += _axis_findings(log, axis, correlation, imu)
        facts["gyro bias about the vertical"] = found.bias.text("rad/s")
        facts["heading later than the IMU by"] = found.delay.text_if(0.5, "s")
        stated = log.rig.imu_noise.gyro_bias_sigma
        if found.bias.differs(0.0, 4 * stated) and abs(found.slope.value - 1) < 0.3:
            findings.append(
                Finding(
                    "imu",
                    f"The gyro reads {found.bias.text('rad/s')} about the vertical while the heading is constant; that "
                    f"is over four times the stated gyro_bias_sigma, {stated:.2g} rad/s.",
                    f"streams.imu.noise.gyro_bias_sigma: {1.2 * abs(found.bias.value):.2g}",
                )
            )
    spread = _error_growth(log, imu, found) if turning and abs(found.slope.value - 1) < 0.3 else None
    if spread is not None:
        facts["heading less integrated gyro: rms growth"] = ", ".join(
            f"{np.degrees(np.sqrt(max(v, 0))):.2g}° in {lag:.3g} s" for lag, v in spread.shown
        )
        findings += spread.findings(log, found)
    delays = (Delay("heading", "imu", found.delay),) if turning and found.delay.known_to(0.5) else ()

    def draw(axes: Axes) -> None:
        axes.plot(found.t_s, np.degrees(found.left), ".", markersize=2)
        axes.set(xlabel="time (s)", ylabel="heading less gyro (°)", title="gyro against heading")
        level = 1.5 * np.quantile(np.abs(np.degrees(found.left)), 0.99) + 0.1
        axes.set_ylim(-level, level)

    return PairCheck(Check("gyro against heading", facts, tuple(findings), draw), delays)


def _turning_axis(log: Log, found: GyroHeading) -> tuple[str, float]:
    """Return the axis of B, as described, whose rate correlates most with the heading's, and the correlation."""
    t_s = seconds(log, log.imu.t_ns)
    dt_s = np.diff(t_s, prepend=t_s[0] - log.imu.period_ns * 1e-9)
    turned = np.cumsum(log.imu.w_WI_I @ np.asarray(log.rig.imu.R_BS).T * dt_s[:, None], axis=0)
    step_s = max(3.0, 2 * float(np.median(np.diff(found.t_s))))
    grid = np.arange(found.t_s[0] + 3, found.t_s[-1] - 3, step_s)
    if len(grid) < 10:
        return "none", 0.0
    by_heading = np.diff(np.interp(grid, found.t_s, found.psi))
    by_gyro = [np.diff(np.interp(grid - found.delay.value, t_s, turned[:, i])) for i in range(3)]
    correlations = [
        float(np.corrcoef(by_heading, g)[0, 1]) if g.std() > 0 and by_heading.std() > 0 else 0.0 for g in by_gyro
    ]
    best = int(np.argmax(np.abs(correlations)))
    return ("−" if correlations[best] < 0 else "") + "xyz"[best], correlations[best]


def _slope_findings(log: Log, imu: Inertial, found: GyroHeading, correlation: float) -> list[Finding]:
    slope, size = found.slope, abs(found.slope.value)
    if np.ptp(found.psi) < 2.05 * np.pi * DEGREE and np.ptp(imu.turned()) > 1.0:
        message = (
            f"The heading stays within {np.degrees(np.ptp(found.psi)):.1f}° while the gyro turns: radians are read as "
            "degrees."
        )
        return [Finding("heading", message, "streams.heading.heading.unit: rad")]
    for ratio, gyro, heading in ((DEGREE, "deg/s", "rad"), (1 / DEGREE, "rad/s", "deg")):
        if abs(size / ratio - 1) < 0.3 and slope.known_to(0.3 * ratio):
            message = (
                f"The heading turns {slope.text()} times as far as the gyro, which is the ratio of degrees and "
                "radians: the unit of the gyro is wrong, or that of the heading "
                f"(`streams.heading.heading.unit: {heading}`)."
            )
            return [Finding("imu", message, f"streams.imu.gyro.unit: {gyro}")]
    if not slope.differs(1.0, SLOPE_MATTERS) or abs(correlation) < 0.5:
        return []
    right = _gyro_is_right(log, imu)
    if slope.value < 0:
        message = f"The heading turns against the gyro (slope {slope.text()}): "
        if right is False:
            up = int(np.argmax(np.abs(np.asarray(log.rig.imu.R_BS)[2])))
            scale = ", ".join("-1" if i == up else "1" for i in range(3))
            message += "the gyro's sign is wrong, since the positions follow the heading."
            return [Finding("imu", message, f"streams.imu.gyro.scale: [{scale}]")]
        message += "a compass is read as a yaw, or a yaw as a compass"
        message += "." if right else "; or the gyro's sign is wrong."
        return [Finding("heading", message, "streams.heading.convention: yaw  # or compass, whichever it is not")]
    message = f"The heading turns {slope.text()} times as far as the gyro: "
    if right is False:
        return [Finding("imu", message + "the gyro's scale is off.", f"streams.imu.gyro.scale: {slope.value:.4g}")]
    message += "the compass deviates with the heading" + ("." if right else ", or else the gyro's scale is off.")
    return [Finding("heading", message)]


def _gyro_is_right(log: Log, imu: Inertial) -> bool | None:
    """Whether the truth's attitude, or else the positions, agree with the gyro rather than with the heading."""
    yaw = _truth_yaw(log)
    if yaw is not None:
        fit = _turns(*yaw, imu, imu.turned(), (yaw[0][-1] - yaw[0][0]) / BLOCKS, 0, 0.0)
        if fit is not None and fit[0]["slope"].known_to(0.3):
            return not fit[0]["slope"].differs(1.0, SLOPE_MATTERS)
    if log.dvl is not None:
        for where in positions(log, imu):
            path = fit_path(log, imu, where, "heading")
            if path is not None and (path.mirrored or path.scale.known_to(0.3)):
                return path.mirrored
    return None


def _truth_yaw(log: Log) -> tuple[Array, Array] | None:
    """Return when (n,) s, and the azimuth (n,) rad of B's x axis by the truth, unwrapped; None where it has none."""
    if log.truth is None:
        return None
    known = np.isfinite(log.truth.R_WB).all(axis=(1, 2))
    t_s, R = seconds(log, log.truth.t_ns[known]), log.truth.R_WB[known]
    if len(t_s) < 30:
        return None
    stride = max(len(t_s) // MOST_ROWS, 1)
    return t_s[::stride], np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))[::stride]


def _axis_findings(log: Log, axis: str, correlation: float, imu: Inertial) -> list[Finding]:
    if axis.lstrip("−") == "z" or abs(correlation) < 0.7:
        return []
    return [
        Finding(
            "imu",
            f"The turn is on axis {axis} of B as described, not on z (correlation {abs(correlation):.2f}), and the "
            f"accelerometers' mean up is ({imu.up_B[0]:.2f}, {imu.up_B[1]:.2f}, {imu.up_B[2]:.2f}) there: the IMU's "
            "mounting or axes are wrong.",
            "streams.imu.mounting: " + mounting_text(imu.R_LB @ np.asarray(log.rig.imu.R_BS), None),
        )
    ]


def mounting_text(R_BS: Array, p_BS_B: Array | None) -> str:
    """Return a mounting in the form of log.yaml: three angles, and a lever arm if one is given."""
    pitch = np.arcsin(np.clip(-R_BS[2, 0], -1, 1))
    roll, yaw = np.arctan2(R_BS[2, 1], R_BS[2, 2]), np.arctan2(R_BS[1, 0], R_BS[0, 0])
    names = zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees([roll, pitch, yaw]), strict=True)
    said = [f"{name}: {value:.1f}" for name, value in names if abs(value) > 0.05]
    if p_BS_B is not None:
        said.append("translation_m: [" + ", ".join(f"{x:.2f}" for x in p_BS_B) + "]")
    return "{" + ", ".join(said) + "}"


@dataclass(frozen=True, eq=False)
class ErrorGrowth:
    """How heading errors decorrelate: half the mean square of the difference of two errors, by their time apart.

    Attributes:
        shown: pairs (s, rad²).
        white, slow: variances of the two parts, rad².
        correlation_s: correlation time of the slow part.
        growth: from neighbouring readings to the maximum, rad².
    """

    shown: list[tuple[float, float]]
    white: float
    slow: float
    correlation_s: float
    growth: Estimate
    tilt: float
    """The part of the growth that a tilted level in turns may cause, rad²."""

    def findings(self, log: Log, found: GyroHeading) -> list[Finding]:
        """Return a finding if the stated sigma neglects that errors last."""
        assert log.heading is not None
        if not self.growth.differs(0.0, SLOW_MATTERS**2 + self.tilt):
            return []
        stated = float(np.median(np.min(log.heading.sigma, axis=1)))
        period_s = float(np.median(np.diff(seconds(log, log.heading.t_ns))))
        equal = float(np.sqrt(self.white + self.slow * max(2 * self.correlation_s / period_s, 1.0)))
        if equal < OVERCONFIDENT * stated:
            return []
        every = max(round(2 * self.correlation_s / period_s), 1)
        total = np.degrees(np.sqrt(self.white + self.slow))
        return [
            Finding(
                "heading",
                f"The heading's errors last: {np.degrees(np.sqrt(self.slow)):.1f}° of them stay for about "
                f"{self.correlation_s:.2g} s (a disturbed compass), while {np.degrees(stated):.2g}° is stated, which "
                f"an estimator takes for white noise every {period_s:.2g} s. Instead of a larger sigma, one reading "
                f"in {every} can be kept (`every`) at {total:.2g}°.",
                f"streams.heading.sigma_deg: {np.degrees(equal):.2g}",
            )
        ]


def _variance_from_tilt(log: Log, imu: Inertial) -> float:
    """Return the variance of the heading error, rad², that a tilted level in turns can cause.

    Accelerometers take a turning vehicle's own acceleration for a tilt. A tilt of δ turns the azimuth of an axis that
    is pitched by θ by δ tan θ. Its sign may change, and half the mean square of 2 δ tan θ is 2 (δ tan θ)².
    """
    mean_f = uniform_filter1d(imu.f_L, max(round(LEVEL_S / imu.period_s), 1), axis=0, mode="nearest")
    lean = np.sqrt(np.maximum(np.sum(mean_f**2, axis=1) / log.rig.gravity**2 - 1.0, 0.0))
    tilt = np.tan(np.arccos(np.clip(imu.up_L[:, 2], 0.1, 1.0)))
    return float(2.0 * np.mean((lean * tilt) ** 2))


def _error_growth(log: Log, imu: Inertial, found: GyroHeading) -> ErrorGrowth | None:
    """Compare heading errors some time apart; the gyro's own noise is subtracted."""
    t_s, left = found.t_s[found.kept], found.left[found.kept]
    if len(t_s) < 50:
        return None
    period_s = float(np.median(np.diff(t_s)))
    longest = (t_s[-1] - t_s[0]) / BLOCKS
    steps = np.unique(np.rint(np.geomspace(1, max(longest / period_s, 1), 16)).astype(int))
    block = blocks_of(len(t_s))
    density = log.rig.imu_noise.gyro_density

    def halves(step: int) -> tuple[Array, Mask, float]:
        apart = t_s[step:] - t_s[:-step]
        good = np.abs(apart - step * period_s) < 0.3 * step * period_s
        square = 0.5 * (left[step:] - left[:-step]) ** 2 - 0.5 * density**2 * apart
        return square, good, step * period_s

    shown: list[tuple[float, float]] = []
    for step in steps:
        square, good, lag_s = halves(int(step))
        if good.sum() > 30:
            shown.append((lag_s, float(square[good].mean())))
    if len(shown) < 2:
        return None
    near, _, _ = halves(int(steps[0]))
    growths: list[tuple[Estimate, float, float]] = []
    for step in steps[1:]:
        far, good, lag_s = halves(int(step))
        growth = mean_of((far - near[: len(far)])[good], block[: len(far)][good]) if good.sum() > 30 else None
        if growth is not None:
            growths.append((growth, lag_s, float(far[good].mean())))
    if not growths:
        return None
    white = shown[0][1]
    growth, _, top = max(growths, key=lambda each: each[0].value - each[0].reach)  # where it is surest
    slow = max(top - white, 0.0)
    correlation_s = next(lag for lag, value in shown if value - white >= 0.63 * slow)
    return ErrorGrowth(
        shown[:: max(len(shown) // 6, 1)], max(white, 0.0), slow, correlation_s, growth, _variance_from_tilt(log, imu)
    )


def heading_against_truth(log: Log) -> PairCheck | None:
    """Compare the heading with the truth's: offset, delay, deviation; None if the truth has no attitude."""
    truth = log.truth
    if truth is None or log.heading is None:
        return None
    known = np.isfinite(truth.R_WB).all(axis=(1, 2))
    if np.count_nonzero(known) < 30:
        return None
    t_truth = seconds(log, truth.t_ns[known])
    h_W = truth.R_WB[known] @ np.asarray(log.rig.heading.R_BS)[:, 0]
    psi_truth = np.unwrap(np.arctan2(h_W[:, 1], h_W[:, 0]))
    t_s, psi = headings(log)
    inside = (t_s > t_truth[0] + 1) & (t_s < t_truth[-1] - 1)
    t_s, psi = t_s[inside], psi[inside]
    if len(t_s) < 30:
        return None
    true = np.interp(t_s, t_truth, psi_truth)
    rate = (np.interp(t_s + 0.25, t_truth, psi_truth) - np.interp(t_s - 0.25, t_truth, psi_truth)) / 0.5
    whose = log.truth_kind
    aligned, mirrored = (abs(np.exp(1j * (psi - sign * true)).mean()) for sign in (1, -1))
    if mirrored > 0.95 and mirrored > aligned + 0.05:
        message = f"The heading turns against the {whose}'s: a compass is read as a yaw, or a yaw as a compass."
        finding = Finding("heading", message, "streams.heading.convention: yaw  # or compass, whichever it is not")
        return PairCheck(Check(f"heading against {whose}", {"turns": "the other way"}, (finding,)))
    if aligned < FOLLOWS:
        return PairCheck(Check(f"heading against {whose}", {"turns": f"not with the {whose}"}))
    middle = float(np.angle(np.exp(1j * (psi - true)).mean()))
    error = np.angle(np.exp(1j * (psi - true - middle)))
    block = blocks_of(len(t_s))
    fit = least_squares({"offset": np.ones(len(t_s)), "delay": -rate}, error, block)
    if fit is None:
        return None
    offset = Estimate(fit["offset"].value + middle, fit["offset"].sigma, fit.dof)
    facts = {
        f"heading less {whose}": offset.times(1 / DEGREE).text("°"),
        "rms of the residual": f"{np.degrees(fit.rms):.2f} °",
        f"heading later than {whose} by": fit["delay"].text_if(0.5, "s"),
    }
    facts |= _deviation(true, fit.residual, block)
    findings = []
    if offset.differs(0.0, OFFSET_MATTERS):
        add = np.degrees(offset.value)
        findings.append(
            Finding(
                "heading",
                f"The heading is {offset.times(1 / DEGREE).text('°')} counter-clockwise of the {whose}'s, on average: "
                "declination, deviation or mounting.",
                f"streams.heading.add_deg: {add:.1f}  # convention: compass; with yaw {-add:.1f}",
            )
        )
    delays = (Delay("heading", "truth attitude", fit["delay"]),) if fit["delay"].known_to(0.5) else ()

    def draw(axes: Axes) -> None:
        axes.plot(np.degrees(true) % 360, np.degrees(error + middle), ".", markersize=2)
        axes.set(
            xlabel=f"yaw by {whose} (°)", ylabel=f"heading less yaw by {whose} (°)", title=f"heading against {whose}"
        )

    return PairCheck(Check(f"heading against {whose}", facts, tuple(findings), draw), delays)


def _deviation(true: Array, left: Array, block: Index) -> dict[str, str]:
    """Return the amplitudes of the compass deviation, once and twice per turn, if the vehicle turned full circle."""
    sectors = np.unique(np.floor((true % (2 * np.pi)) / (np.pi / 4)))
    if len(sectors) < 8:
        return {}
    waves = {f"{name}{k}": f(k * true) for k in (1, 2) for name, f in (("sin", np.sin), ("cos", np.cos))}
    fit = least_squares({"mean": np.ones(len(true)), **waves}, left, block)
    if fit is None:
        return {}
    said = {}
    for k, name in ((1, "once around (hard iron)"), (2, "twice around (soft iron)")):
        parts = fit[f"sin{k}"], fit[f"cos{k}"]
        size = np.hypot(parts[0].value, parts[1].value)
        sigma = max(part.sigma for part in parts)
        said[f"deviation {name}"] = Estimate(float(size), sigma, fit.dof).times(1 / DEGREE).text("°")
    return said
