"""The clocks: one least-squares fit of all delays measured between two streams, relative to the IMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from ....datasets.log import Log
from ..findings.advice import clock_fix, late_or_early
from ..findings.finding import Check, Finding
from ..findings.fitting import FALSE_ALARM, Estimate
from ..streams.channels import seconds
from .pair_check import Delay

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DELAY_MATTERS_S = 0.05
"""At 2 m/s a reading this late is 0.1 m off, as much as a good fix."""
TRUTH_DELAY_MATTERS_S = 0.1
"""The same for a truth: its delay enters scores and no estimate, and its source is often 5 to 10 Hz."""
WELL_KNOWN_S = 0.2
"""Three sigmas within this: such delays take part in the vote on whether it is the IMU's clock that is off."""
FLOOR_S = 0.005
"""Added to the sigma of each delay: half a sample of a 100 Hz IMU."""
PARTS = ("truth position", "truth velocity", "truth attitude")


@dataclass(frozen=True)
class ClockFit:
    """By how much (s) the stamps of each stream are late on the IMU's clock, and whether the delays agree.

    Attributes:
        late: by stream, for the streams that a chain of delays connects to the IMU.
        agrees: whether the residuals are within chance; the first `DELAY_MATTERS_S` of a residual is ignored.
        worst: the delay with the largest residual; None if they agree.
    """

    late: dict[str, Estimate]
    agrees: bool
    worst: Delay | None


def fit_clocks(delays: Sequence[Delay]) -> ClockFit:
    """Return the least-squares lateness of every stream that is connected to the IMU."""
    tied = {"imu"}
    while grown := {s for d in delays if {d.late, d.than} & tied for s in (d.late, d.than)} - tied:
        tied |= grown
    used = [d for d in delays if d.late in tied]
    names = sorted(tied - {"imu"})
    if not names:
        return ClockFit({}, True, None)
    A = np.zeros((len(used), len(names)))
    for row, d in enumerate(used):
        for name, sign in ((d.late, 1.0), (d.than, -1.0)):
            if name != "imu":
                A[row, names.index(name)] = sign
    by = np.array([d.by.value for d in used])
    sigma = np.array([np.hypot(d.by.sigma, FLOOR_S) for d in used])
    cov = np.linalg.inv((A / sigma[:, None]).T @ (A / sigma[:, None]))
    late = cov @ A.T @ (by / sigma**2)
    left = by - A @ late
    dof = min(d.by.dof for d in used)
    loops = len(used) - len(names)
    excess = np.maximum(np.abs(left) - DELAY_MATTERS_S, 0.0) / sigma
    agrees = loops == 0 or float(np.sum(excess**2)) < chi2.isf(FALSE_ALARM, loops)
    found = {n: Estimate(float(late[i]), float(np.sqrt(cov[i, i])), dof) for i, n in enumerate(names)}
    return ClockFit(found, bool(agrees), used[int(np.argmax(excess))] if not agrees else None)


def clock_check(log: Log, delays: Sequence[Delay]) -> Check:
    """Fit all delays, and report which clock is off and by how much."""
    story = fit_clocks(delays)
    facts = {f"{name} later than the IMU by": late.text("s") for name, late in story.late.items()}
    facts |= _overlaps(log)
    findings = []
    off = {n: e for n, e in story.late.items() if e.differs(0.0, _matters(n))}
    sensors = {n: e for n, e in story.late.items() if n not in PARTS}
    known = {n for n, e in sensors.items() if e.known_to(WELL_KNOWN_S)}
    common = _common(sensors) if len(known) > 1 and known <= set(off) else None
    if common is not None:
        message = (
            f"Every other stream is {_late(common)} by the IMU's clock, and the others agree with each other: the "
            "IMU's clock is wrong."
        )
        findings.append(Finding("imu", message, clock_fix("imu", -common.value)))
    else:
        findings += [_finding(name, off[name]) for name in off if name not in PARTS]
        findings += _truth_findings(log, {n: e for n, e in story.late.items() if n in PARTS}, set(off))
    if story.worst is not None and not findings:
        worst = story.worst
        message = (
            f"The delays do not fit one clock per stream: {worst.late} is later than {worst.than} by "
            f"{worst.by.text('s')}, which the others contradict."
        )
        findings.append(Finding(worst.late.split()[0], message))

    def draw(axes: Axes) -> None:
        for row, d in enumerate(delays):
            axes.errorbar(d.by.value, row, xerr=3 * d.by.sigma, fmt="o", markersize=3)
        axes.set_yticks(range(len(delays)), [f"{d.late} after {d.than}" for d in delays])
        axes.axvline(0.0, linewidth=0.5)
        axes.set(xlabel="delay (s), three sigmas", title="clocks")

    return Check("clocks", facts, tuple(findings), draw if delays else None)


def _matters(name: str) -> float:
    return TRUTH_DELAY_MATTERS_S if name in PARTS else DELAY_MATTERS_S


def _common(late: dict[str, Estimate]) -> Estimate | None:
    """Return the mean lateness if all streams share it; else None."""
    weight = np.array([1 / np.hypot(e.sigma, FLOOR_S) ** 2 for e in late.values()])
    value = np.array([e.value for e in late.values()])
    mean = float(np.sum(weight * value) / np.sum(weight))
    close = all(abs(e.value - mean) < max(3 * e.sigma, DELAY_MATTERS_S) for e in late.values())
    return Estimate(mean, float(1 / np.sqrt(np.sum(weight))), min(e.dof for e in late.values())) if close else None


def _late(by: Estimate) -> str:
    return f"{Estimate(abs(by.value), by.sigma).text('s')} {late_or_early(by.value)}"


def _finding(name: str, late: Estimate) -> Finding:
    message = f"The stamps of {name} are {_late(late)} by the IMU's clock."
    if late.value > 0:
        message += f" Where `time.received` is a column: `time.clock_offset_s: {-late.value:.3f}`."
    return Finding(name, message, clock_fix(name, late.value))


def _truth_findings(log: Log, parts: dict[str, Estimate], off: set[str]) -> list[Finding]:
    if not set(parts) & off:
        return []
    whose = log.truth_kind
    common = _common(parts)
    if common is not None:
        message = f"The {whose} is {_late(common)} by the IMU's clock."
        return [Finding("truth", message, clock_fix("truth", common.value))]
    listed = ", ".join(f"{name.split()[1]} {_late(late)}" for name, late in parts.items())
    return [Finding("truth", f"The parts of the {whose} have different delays by the IMU's clock: {listed}.")]


def _overlaps(log: Log) -> dict[str, str]:
    """Return the time that each stream covers, for those that do not cover all of the IMU's."""
    said = {}
    end = seconds(log, log.imu.t_ns[-1:])[0]
    spans = {name: seconds(log, stream.t_ns) for name, stream in log.streams.items() if len(stream)}
    if log.truth is not None and len(log.truth):
        spans[log.truth_kind] = seconds(log, log.truth.t_ns)
    for name, t_s in spans.items():
        begin, last = max(float(t_s[0]), 0.0), min(float(t_s[-1]), float(end))
        if last - begin < 0.98 * end:
            said[f"{name} covers"] = f"{begin:.1f} s to {last:.1f} s of the IMU's {end:.1f} s"
    return said
