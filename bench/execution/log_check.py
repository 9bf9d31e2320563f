"""The check of recorded logs before an experiment: what is grossly wrong in them, and how to mend it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from ...datasets.described.description import read_description
from ...datasets.described.opening import find_log
from ...datasets.log import Log
from ...datasets.notes import Note
from ..errors import ExperimentError

if TYPE_CHECKING:
    from ..inspection.findings.finding import Finding

Findings: TypeAlias = "Mapping[str, Sequence[Finding]]"
"""What looks wrong, by the name of the log."""


def check_log(log: Log, name: str, data: Path | None = None) -> tuple[Finding, ...]:
    """Return what looks grossly wrong in a log that `open_log(name, data)` gave, with advice for its log.yaml."""
    from ..inspection.findings.advice import resolved  # both load matplotlib, which tables do without
    from ..inspection.gross.gross import quick_findings

    found = quick_findings(log)
    if not found:
        return ()
    description = read_description(find_log(name, data)[0])
    return tuple(resolved(finding, description) for finding in found)


def note_of(finding: Finding) -> Note:
    """Return a finding as a note of a run, its stream first in the text."""
    return Note(f"{finding.stream}: {finding.message}", "check", finding.stream)


def report(findings: Findings, strict: bool, say: Callable[[str], None]) -> None:
    """Say what looks wrong, a line for each finding and each line of advice; or refuse.

    Raises:
        ExperimentError: something looks wrong, and `strict` asks to refuse it then.
    """
    lines = list(_lines(findings))
    if lines and strict:
        raise ExperimentError(f"refused by --strict: {' '.join(lines)}")
    for line in lines:
        say(line)
    if lines:
        say("`fathom inspect LOG` shows more; --strict refuses such logs, and --no-check leaves this out.")


def _lines(findings: Findings) -> Iterator[str]:
    for log, found in findings.items():
        for finding in found:
            yield f"{log}: {finding.stream}: {finding.message}"
            yield from (f"  → log.yaml: {line}" for line in finding.fix.split("\n") if line)
            if finding.hint:
                yield f"  → {finding.hint}"
