"""What a check of a log hands over: what it measured, what looks wrong, and a panel for the page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Finding:
    """Something that looks wrong.

    Attributes:
        stream: where, as the description calls it: "imu", "dvl", "truth".
        says: one plain sentence with its figures.
        mend: what to put into log.yaml, by its path ("streams.dvl.time.delay_s: 0.5"); "" where that helps nothing.
    """

    stream: str
    says: str
    mend: str = ""


@dataclass(frozen=True)
class Check:
    """One question put to a log, and its answer.

    Attributes:
        title: the question, as a heading: "gyro against heading".
        facts: what was measured, by name, with its unit.
        findings: what of it looks wrong.
        draw: draws the panel, where people would rather look than read.
    """

    title: str
    facts: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    draw: Callable[[Axes], None] | None = None
