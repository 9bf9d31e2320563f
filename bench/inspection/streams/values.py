"""The values themselves: stuck axes, zeros and markers of missing rows, repeats, coarse steps, clipping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....datasets.log import Log
from ....datasets.state import Array
from ..findings.finding import Check, Finding
from .channels import Channel, channels_of
from .frozen import frozen_findings
from .missing import FEWEST_MARKED, missing_rows
from .neighbours import FEWEST
from .quantisation import Quantisation

FEW_VALUES = 10
"""Different values: a channel with no more is reported as coarse."""
MANY_ROWS = 100
"""With fewer rows, few different values are no finding."""
FEWEST_CLIPPED = 5
"""Readings on the last value: fewer may be chance."""
CLIPPED_RATIO = 5.0
"""A distribution thins out towards its ends; clipping collects everything beyond on the last value."""
STALE_SHARE = 1e-3
"""Share of repeated readings that is ignored."""
SMALL_CHANGE = 0.01
"""Of the median change from reading to reading: a smaller change may round to zero."""
UNSURE_GPS_M = 100.0
"""Stated by receivers that have lost their satellites; a fix of one satellite system is good to 10 m."""
UNSURE_SHARE = 0.01
"""Share of such fixes that is ignored: a receiver needs a few to start."""


def check_values(log: Log) -> Check:
    """Find values that are not readings, or coarser than the stated noise."""
    facts, findings = {}, []
    for channel in channels_of(log):
        measured = [k for k in range(channel.x.shape[1]) if np.isfinite(channel.sigma[k])]
        if not measured:
            continue
        x = channel.raw[:, measured]
        names = [channel.of_axis(k) for k in measured]
        steps = [channel.steps[k] for k in measured]
        facts[channel.name] = _described(channel, x, steps)
        if len(x) < FEWEST:
            continue
        dull, stuck = dead_axes(channel, x, names)
        findings += dull
        live = [k for k in range(len(measured)) if not stuck[k]]
        if not live:
            continue
        x, names, steps = x[:, live], [names[k] for k in live], [steps[k] for k in live]
        sigma = channel.sigma[measured][live]
        findings += missing_findings(channel) + frozen_findings(log, channel)
        good = missing_rows(channel).readings
        findings += _repeats(channel, x, good, steps)
        findings += _coarse(channel, x[good], names, steps, sigma)
        findings += _clipped(channel, x[good], names, steps)
    findings += _unsure(log)
    return Check("values", facts, tuple(findings))


def _described(channel: Channel, x: Array, steps: list[Quantisation]) -> str:
    least, largest = (f"{v * channel.shown:.4g}" for v in (x.min(), x.max()))
    text = f"{least} to {largest} {channel.unit}"
    quanta = [s.quantum * channel.shown for s in steps if s.quantum]
    if quanta:
        text += f", in steps of {min(quanta):.3g} {channel.unit}"
    few = min(s.levels for s in steps)
    return text + (f", {few} different values" if few <= FEW_VALUES and len(x) > FEW_VALUES else "")


def dead_axes(channel: Channel, x: Array, names: list[str]) -> tuple[list[Finding], list[bool]]:
    """Return what is wrong with the axes x (n, k) that never change, and which they are."""
    stuck = [bool(np.all(axis == axis[0])) for axis in x.T]
    path = f"streams.{channel.stream}"
    if all(stuck):
        value = ", ".join(f"{v:.4g}" for v in x[0] * channel.shown + 0.0)
        message = f"{channel.name} never changes: it reads ({value}) {channel.unit} in all {len(x)} rows."
        if channel.stream == "imu":
            return [Finding("imu", message, hint=f"{path}.{channel.quantity}.columns must name others")], stuck
        return [Finding(channel.stream, message, f"{path}: null")], stuck
    found = []
    for k, name in enumerate(names):
        if stuck[k]:
            message = f"{name} is {channel.text(float(x[0, k]))} in every row: it was not measured, or it is stuck."
            by_axis = channel.stream in ("dvl", "gps")
            left_out = [s if not stuck[j] else np.inf for j, s in enumerate(channel.sigma * channel.shown)]
            values = ", ".join(f"{s:.4g}" if np.isfinite(s) else ".inf" for s in left_out)
            whole = by_axis and len(left_out) == channel.x.shape[1]
            fix = f"{channel.sigma_key}: [{values}]" if whole else ""
            hint = "" if whole else f"{path}.{channel.quantity}.columns must name others"
            found.append(Finding(channel.stream, message, fix, hint))
    return found, stuck


def missing_findings(channel: Channel) -> list[Finding]:
    """Report the rows without a reading."""
    missing = missing_rows(channel)
    path = f"streams.{channel.stream}"
    valid = f"{path}.valid: {{column: its validity, values: […]}}"
    found, size = [], np.linalg.norm(channel.raw[:, np.isfinite(channel.sigma)], axis=1)
    if missing.marked.any():
        message = (
            f"{int(missing.marked.sum())} rows of {channel.name} hold {missing.marker * channel.shown:g} "
            f"{channel.unit}, far outside all others: a mark of rows without a reading, which is used as a reading."
        )
        above = _between(size[~missing.marked], size[missing.marked])
        plain = above is not None and channel.stream != "imu" and not channel.turn
        fix = f"{path}.outliers.above: {above:g}" if plain else ""
        found.append(Finding(channel.stream, message, fix, f"or {valid}" if plain else valid))
    if missing.zero.any():
        message = (
            f"{int(missing.zero.sum())} of {len(size)} rows of {channel.name} are exactly zero on every axis, the "
            f"others about {channel.text(float(np.median(size[missing.readings])))}: they hold no reading, but "
            "are used as readings."
        )
        found.append(Finding(channel.stream, message, hint=valid))
    return found


def _between(good: Array, bad: Array) -> float | None:
    """Return a round bound that separates the good sizes from the bad ones; None if no bound does."""
    if not len(good) or not len(bad) or 1.2 * good.max() >= bad.min():
        return None
    low, high = max(float(good.max()), 1e-12), float(bad.min())
    return float(f"{min(np.sqrt(low * high), 2 * low):.2g}")


def _repeats(channel: Channel, x: Array, good: NDArray[np.bool_], steps: list[Quantisation]) -> list[Finding]:
    """Find readings that equal the one before on every axis, more often than small changes explain."""
    if any(s.coarse for s in steps):
        return []
    pairs = good[1:] & good[:-1]
    change = np.abs(np.diff(x, axis=0))[pairs]
    if len(change) < FEWEST:
        return []
    by_chance = 1.0
    for axis, step in zip(change.T, steps, strict=True):
        moved = axis[axis > 0]
        small = max(SMALL_CHANGE * float(np.median(moved)) if len(moved) else 0.0, 1.5 * step.quantum)
        by_chance *= float(np.mean((axis > 0) & (axis <= small)))  # rounding makes no more of them into none than so
    expected, count = by_chance * len(change), int((change == 0).all(axis=1).sum())
    if count <= expected + 5 * np.sqrt(expected) + STALE_SHARE * len(change) or count < FEWEST_MARKED:
        return []
    message = (
        f"{count} of {len(x)} {channel.name} readings equal the one before exactly"
        + (f" ({expected:.0f} would by chance)" if expected >= 1 else "")
        + ": they were repeated, not measured, and count twice."
    )
    hint = f"streams.{channel.stream}.every, if each comes a fixed number of times; else drop them in the file"
    return [Finding(channel.stream, message, hint=hint)]


def _coarse(channel: Channel, x: Array, names: list[str], steps: list[Quantisation], sigma: Array) -> list[Finding]:
    """Find steps larger than the stated noise, and channels of hardly any values."""
    found, worst = [], None
    few = [k for k, step in enumerate(steps) if step.levels <= FEW_VALUES and len(x) >= MANY_ROWS]
    if few:
        quantum = max(steps[k].quantum or float(np.ptp(x[:, k])) for k in few)
        message = (
            f"{_joined([names[k] for k in few])} take{'s' if len(few) == 1 else ''} only "
            f"{max(steps[k].levels for k in few)} values in {len(x)} rows, {channel.text(quantum)} apart: the error "
            "is up to half a step, and constant for as long as the reading is."
        )
        found.append(Finding(channel.stream, message, _sigma_key(channel, quantum / 2)))
    for k, (name, step) in enumerate(zip(names, steps, strict=True)):
        if k not in few and step.quantum / np.sqrt(12) > sigma[k] and (worst is None or step.quantum > worst[2]):
            worst = (float(sigma[k]), name, step.quantum)
    if worst is not None:
        stated, name, quantum = worst
        error = quantum / np.sqrt(12)
        message = (
            f"{name} comes in steps of {channel.text(quantum)}: rounding alone errs by {channel.text(error)} (1 σ), "
            f"{error / stated:.1f} times the stated sigma."
        )
        found.append(Finding(channel.stream, message, _sigma_key(channel, error)))
    return found


def _joined(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _sigma_key(channel: Channel, sigma: float) -> str:
    """Return the key of log.yaml that states this sigma of one reading."""
    if channel.stream == "imu":
        return f"streams.imu.noise.{channel.name}_density: {sigma * np.sqrt(channel.period_s):.2g}"
    return f"{channel.sigma_key}: {sigma * channel.shown:.2g}"


def _clipped(channel: Channel, x: Array, names: list[str], steps: list[Quantisation]) -> list[Finding]:
    """Find ends of the range on which readings pile up."""
    found, kept = [], [k for k, step in enumerate(steps) if not step.coarse and step.levels > FEW_VALUES]
    for k in kept if not channel.turn else []:
        levels, counts = np.unique(x[:, k], return_counts=True)
        ends = []
        for end, inner in ((-1, slice(-4, -1)), (0, slice(1, 4))):
            count = int(counts[end])
            if levels[end] and count >= FEWEST_CLIPPED and count > CLIPPED_RATIO * counts[inner].max(initial=1):
                ends.append((float(levels[end]), count))
        if ends:
            count = sum(n for _, n in ends)
            values = " and ".join(f"{v * channel.shown:.4g}" for v, _ in ends)
            message = (
                f"{names[k]} is clipped: {count} of {len(x)} readings are exactly {values} {channel.unit}, the end "
                "of its range; larger values are lost."
            )
            fix = ""
            if channel.stream != "imu":
                bound = min(abs(v) for v, _ in ends) * 0.999
                component = "" if x.shape[1] == 1 else f", components: [{k}]"
                fix = f"streams.{channel.stream}.outliers: {{above: {bound:.4g}{component}}}  # leaves those rows out"
            found.append(Finding(channel.stream, message, fix))
    return found


def _unsure(log: Log) -> list[Finding]:
    """Find GPS fixes with a sigma so large that they are no fixes."""
    if log.gps is None or not len(log.gps):
        return []
    horizontal = log.gps.sigma[:, :2].max(axis=1)
    unsure = np.isfinite(horizontal) & (horizontal > UNSURE_GPS_M)
    if np.mean(unsure) <= UNSURE_SHARE:
        return []
    message = (
        f"{int(unsure.sum())} of {len(unsure)} GPS fixes state a sigma over {UNSURE_GPS_M:g} m: the receiver had "
        "lost its satellites and repeats its last position, or a guess."
    )
    return [Finding("gps", message, hint="streams.gps.valid: {column: its status, values: […]}")]
