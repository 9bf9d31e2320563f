"""What a cross-sensor check hands over: the check for the page, and the delays that the clock check weighs together."""

from __future__ import annotations

from dataclasses import dataclass

from ..findings.finding import Check
from .fitting import Estimate


@dataclass(frozen=True)
class Delay:
    """How much later `late` stamps what it saw than `than` does, s; negative: earlier."""

    late: str
    than: str
    by: Estimate


@dataclass(frozen=True)
class Answer:
    """A check and the delays that it met."""

    check: Check
    delays: tuple[Delay, ...] = ()
