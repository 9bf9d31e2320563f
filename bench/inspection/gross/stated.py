"""What a description states of units of time and of noise, where no sensor is so."""

from __future__ import annotations

import numpy as np

from ....datasets.log import Log, ReadingStream
from ....datasets.quantities import DEGREE
from ....datasets.times import NS_PER
from ..findings.finding import Finding
from ..findings.fitting import MAD_TO_SIGMA
from ..streams.channels import imu_period_ns, stated_sigma

SLOWEST_IMU_HZ = 2.0
"""Below this an IMU's samples say nothing of a vehicle's motion between them: its time is in another unit."""
ALIKE = 0.2
"""Relative: two streams of one log cover the same time, within a fifth."""
BOUNDS = {"dvl": (1e-6, 5.0, "m/s"), "depth": (1e-6, 50.0, "m"), "gps": (1e-4, 1e3, "m"), "heading": (1e-7, 1.6, "°")}
"""Least and largest sigma of one reading of any such sensor, SI: the noise of the best laboratory instruments, and an
error that makes a reading worthless; of a heading a quarter turn."""
ROWS = 2000
"""Readings, from the middle of a stream, of which the scatter is taken."""
FEWEST = 50
"""With fewer, none is."""
OVERCONFIDENT = 30.0
"""Scatter over stated sigma: readings then count a thousand times too much."""
UNDERCONFIDENT, WORTHLESS = 100.0, {"dvl": 0.5, "depth": 5.0, "gps": 100.0, "heading": 45 * DEGREE}
"""Stated sigma over scatter, and the least stated sigma, SI, that make a finding: such readings then hardly count.
Slow errors do not scatter, so that a smaller sigma may be right."""
SECOND_DIFFERENCE = np.sqrt(6.0)
"""Standard deviation of x₀ − 2x₁ + x₂ over that of x, for white noise."""


def time_findings(log: Log) -> list[Finding]:
    """Find streams whose times are in another unit than the IMU's."""
    hz = 1e9 / imu_period_ns(log.imu)
    spans = {name: int(s.t_ns[-1]) - int(s.t_ns[0]) for name, s in log.streams.items() if len(s) >= FEWEST}
    imu_ns = int(log.imu.t_ns[-1]) - int(log.imu.t_ns[0])
    factors = {name: factor for name, span in spans.items() if (factor := _unit_ratio(span / imu_ns)) is not None}
    if factors and len(factors) == len(spans) and len(set(factors.values())) == 1 and hz < SLOWEST_IMU_HZ:
        (factor,) = set(factors.values())
        return [_other_unit("imu", factor, "the others")]
    found = [_other_unit(name, 1 / factor, "the IMU") for name, factor in factors.items()]
    if not found and hz < SLOWEST_IMU_HZ:
        message = f"The IMU samples at {hz:.3g} Hz: between two samples a vehicle turns and turns back. Is its time in "
        found.append(Finding("imu", message + "another unit?"))
    return found


def _unit_ratio(ratio: float) -> float | None:
    """Return the power of a thousand that a ratio is near to, other than 1."""
    powers = (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9)
    return next((power for power in powers if abs(ratio / power - 1) < ALIKE), None)


def _other_unit(name: str, factor: float, than: str) -> Finding:
    unit = next((unit for unit, ns in NS_PER.items() if abs(ns * 1e-9 / factor - 1) < ALIKE), "s")
    message = (
        f"By their stamps the {name} readings last {1 / factor:g} times as long as those of {than}: their time is "
    )
    return Finding(name, message + f"in {unit}.", f"streams.{name}.time.unit: {unit}  # if it says s now")


def sigma_findings(log: Log) -> list[Finding]:
    """Find stated sigmas that no sensor has, or that the scatter of the readings contradicts."""
    found = []
    for name, stream in log.streams.items():
        if not len(stream):
            continue
        least, largest, unit = BOUNDS[name]
        shown = 1 / DEGREE if name == "heading" else 1.0
        sigma = stated_sigma(stream)
        sigma = sigma[np.isfinite(sigma)]
        key = f"streams.{name}." + {"dvl": "sigma_m_s", "heading": "sigma_deg"}.get(name, "sigma_m")
        scatter, most = _scatter(stream)
        odd = sigma[(sigma > largest) | (sigma < least)]
        if len(odd):
            message = f"The stated sigma of the {name} is {odd[0] * shown:.3g} {unit}, which is no sensor's."
            fix = f"{key}: {scatter * shown:.2g}" if scatter > least else ""
            found.append(Finding(name, message, fix))
        elif len(sigma) and scatter > OVERCONFIDENT * sigma.max():
            message = (
                f"The {name} scatters from reading to reading by {scatter * shown:.3g} {unit}, "
                f"{scatter / sigma.max():.0f} times the stated sigma."
            )
            found.append(Finding(name, message, f"{key}: {scatter * shown:.2g}"))
        elif len(sigma) and sigma.min() > max(WORTHLESS[name], UNDERCONFIDENT * most) and scatter > least:
            message = (
                f"The stated sigma of the {name} is {sigma.min() * shown:.3g} {unit}, and it scatters from reading to "
                f"reading by {most * shown:.3g} {unit}: its readings hardly count."
            )
            hint = "unless its slow errors are as large as stated"
            found.append(Finding(name, message, f"{key}: {most * shown:.2g}", hint))
    return found


def _scatter(stream: ReadingStream) -> tuple[float, float]:
    """Return robust sigmas of the noise of the best and the worst measured axis, SI, constant rates left out; or 0."""
    n = len(stream)
    if n < FEWEST or stream.width == 9:
        return 0.0, 0.0
    rows = slice(max((n - ROWS) // 2, 0), (n + ROWS) // 2)
    z = stream.z[rows][:, np.isfinite(stream.sigma[rows]).all(axis=0)]
    if not z.shape[1]:
        return 0.0, 0.0
    step = np.diff(z, axis=0)
    step = np.angle(np.exp(1j * step)) if stream.name == "heading" else step
    second = np.abs(np.diff(step, axis=0))
    sigma = MAD_TO_SIGMA * np.median(second, axis=0) / SECOND_DIFFERENCE
    return float(sigma.min()), float(sigma.max())
