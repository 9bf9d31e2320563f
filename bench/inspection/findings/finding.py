"""The result of a check of a log: what it measured, what looks wrong, and a panel for the page."""

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
        stream: the stream concerned, by its name in log.yaml: "imu", "dvl", "truth".
        message: one sentence with its figures.
        fix: what to put into log.yaml, a line for each key, by its path ("streams.dvl.time.delay_s: 0.5"), relative
            to what is there (see `advice`); "" where no key helps.
        hint: what else helps, in words.
    """

    stream: str
    message: str
    fix: str = ""
    hint: str = ""


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        title: a heading: "gyro against heading".
        facts: what was measured, by name, with its unit.
        findings: what looks wrong.
        draw: draws the panel; None for a check without one.
    """

    title: str
    facts: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    draw: Callable[[Axes], None] | None = None
