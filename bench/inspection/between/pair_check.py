"""The result of a check of two sensors: the check for the page, and the delays for the clock check to combine."""

from __future__ import annotations

from dataclasses import dataclass

from ..findings.finding import Check
from ..findings.fitting import Estimate


@dataclass(frozen=True)
class Delay:
    """By how much (s) the stamps of `late` are later than those of `than` for the same event; negative: earlier."""

    late: str
    than: str
    by: Estimate


@dataclass(frozen=True)
class PairCheck:
    """A check and the delays that it measured."""

    check: Check
    delays: tuple[Delay, ...] = ()
