"""Steps that took longer than the processor worked on them are told, with whose and how much."""

from __future__ import annotations

from typing import Any

from fathom.bench.output.remarks import waited


def cost(label: str, total_s: float | None, cpu_s: float | None) -> dict[str, Any]:
    return {"log": "l", "label": label, "total_s": total_s, "cpu_s": cpu_s}


def test_a_busy_machine_is_told_and_a_quiet_one_is_not() -> None:
    quiet = [cost("a", 1.0, 1.0), cost("b", 1.05, 1.0), cost("none", None, None)]
    assert waited(quiet) == []
    (line,) = waited([*quiet, cost("slow", 3.0, 1.0), cost("half", 1.5, 1.0)])
    assert line.startswith("the steps took up to 3 times their processor time (l / slow, and 1 more less): the machine")
