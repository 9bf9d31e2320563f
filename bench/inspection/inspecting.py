"""Inspect a log: open it, run every check, and collect the findings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...datasets.described.description import Description, read_description
from ...datasets.described.opening import RecordingNotFound, find_log, open_log
from ...datasets.errors import DatasetError
from ...datasets.log import Log
from .findings.advice import resolved
from .findings.finding import Check, Finding
from .gross.datum import gps_height_check
from .gross.gross import gross_check, unsaid
from .gross.readings import reading_findings, without
from .streams.imu_noise import check_imu_noise
from .streams.noise import check_noise
from .streams.norms import check_norms
from .streams.outliers import check_outliers
from .streams.rates import check_delays, check_rates
from .streams.static import check_static
from .streams.values import check_values

SINGLE = (
    check_rates,
    check_delays,
    check_values,
    check_outliers,
    check_norms,
    check_static,
    check_imu_noise,
    check_noise,
)
LARGEST = 1e30
"""In any unit. No reading is as large, and the square of one still fits a float."""
REPAIRED = re.compile(r"^(\w+): (\d+) rows (.+) \(repair\) dropped$")
FIXES = {
    "out of order": "streams.{}.time.column: the one that runs evenly; else drop those rows in the file",
    "not finite": "streams.{}.valid: {{column: …, values: […]}} leaves those rows out",
    "received before they were true": "streams.{0}.time.received and .clock_offset_s: the two are not on one clock",
}


@dataclass(frozen=True)
class Inspection:
    """The results of all checks of one log."""

    log: Log
    checks: tuple[Check, ...]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Everything that looks wrong, in the order of the checks."""
        return tuple(finding for check in self.checks for finding in check.findings)


def description_of(name: str | Path, data: Path | None = None) -> Description:
    """Return the description of a log that `open_to_inspect` opens."""
    return read_description(find_log(name, data)[0])


def open_to_inspect(name: str | Path, data: Path | None = None, *, repair: bool = False) -> tuple[Log, tuple[str, ...]]:
    """Open a log, with repair if it is asked for, or does not open without; return it and the notes of the repairs.

    Raises:
        DatasetError: it does not open even with repair.
    """
    try:
        log = open_log(name, data, repair=repair)
    except RecordingNotFound:
        raise
    except DatasetError:
        if repair:
            raise
        log, repair = open_log(name, data, repair=True), True
    repairs = tuple(note for note in log.notes if REPAIRED.match(note)) if repair else ()
    _check_sizes(name, log)
    return log, repairs


def _check_sizes(name: str | Path, log: Log) -> None:
    """Refuse numbers whose squares overflow, and sigmas whose inverse squares do.

    Raises:
        DatasetError: names the stream, the row and the number.
    """
    held = {"imu": [log.imu.w_WI_I, log.imu.f_I], **{k: [s.z, s.sigma] for k, s in log.streams.items()}}
    if log.truth is not None:
        held[log.truth_kind] = [log.truth.p_WB_W]
    stated = {f"streams.imu.noise.{name}": value for name, value in vars(log.rig.imu_noise).items()}
    stated |= {f"streams.{k}: sigma": float(s.sigma.min(initial=np.inf)) for k, s in log.streams.items()}
    for where, value in stated.items():
        if LARGEST < value < np.inf or 0 < value < 1 / LARGEST:
            raise DatasetError(f"{name}: {where} is {value:.3g}, which is no sensor's; check the value and its unit")
    for stream, arrays in held.items():
        for values in arrays:
            beyond = np.argwhere(np.isfinite(values) & (np.abs(values) > LARGEST))
            if len(beyond):
                row, value = int(beyond[0, 0]), values[tuple(beyond[0])]
                raise DatasetError(
                    f"{name}: {stream}: row {row} ({len(beyond)} numbers in all) holds {value:.3g}, which nothing "
                    "measures; check its column, or bound it (`outliers`, `valid`)"
                )


def inspect_log(log: Log, repairs: Sequence[str] = (), description: Description | None = None) -> Inspection:
    """Run every check on a log.

    Streams in which a gross fault is found are left out of the comparisons after it, which would blame others for it.

    Args:
        log: the log.
        repairs: the notes of the rows that opening it had to drop.
        description: its log.yaml. Fixes are then absolute lines for it, which make a valid log.yaml.
    """
    from .between.cross_checks import cross_checks

    checks = [_check_repairs(log, repairs), *(check(log) for check in SINGLE)]
    broken = {finding.stream for finding in reading_findings(log)}
    if "imu" not in broken:
        gross = gross_check(without(log, broken))
        gross = replace(gross, findings=unsaid([f for check in checks for f in check.findings], gross.findings))
        faulty = broken | {finding.stream for finding in gross.findings}
        checks += [gross, *([] if "imu" in faulty else cross_checks(without(log, faulty)))]
        if "gps" not in {finding.stream for check in checks for finding in check.findings}:
            checks.append(gps_height_check(without(log, faulty)))
    if description is not None:
        checks = [replace(c, findings=tuple(resolved(f, description) for f in c.findings)) for c in checks]
    return Inspection(log, tuple(checks))


def _check_repairs(log: Log, repairs: Sequence[str]) -> Check:
    """Report the rows that were dropped to open the log."""
    findings = [Finding("imc", f"The file is damaged: {note}.") for note in log.notes if note.startswith("imc: ")]
    for note in repairs:
        match = REPAIRED.match(note)
        if match is not None:
            stream, count, what = match.groups()
            hint = FIXES.get(what, "").format(stream)
            findings.append(Finding(stream, f"{count} {stream} rows are {what}; they were left out here.", hint=hint))
    duration = f"{log.duration_s:.1f} s"
    streams = ", ".join(["imu", *log.streams, *([log.truth_kind] if log.truth is not None else [])])
    dropped = "; ".join(note for note in log.notes if note.endswith("dropped"))
    facts = {"duration": duration, "streams": streams} | ({"left out": dropped} if dropped else {})
    return Check("opening", facts, tuple(findings))
