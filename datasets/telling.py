"""What a simulated log says of its own making: a sentence for every dial that is not at its default."""

from __future__ import annotations

import dataclasses
from typing import Any

from .scenario import SENSORS, Scenario


def told(scenario: Scenario) -> list[str]:
    """Return a sentence on each sensor that comes late, and one on each that has faults, with every dial's name."""
    return [*_late(scenario), *_faults(scenario)]


def _late(scenario: Scenario) -> list[str]:
    specs = {sensor: getattr(scenario, sensor) for sensor in SENSORS}
    return [
        f"{sensor} comes {spec.delay_s:g} s late, and up to {spec.disorder_s:g} s more, at random."
        for sensor, spec in specs.items()
        if spec is not None and (spec.delay_s or spec.disorder_s)
    ]


def _faults(scenario: Scenario) -> list[str]:
    notes = []
    for sensor, faults in scenario.faults.items():
        dials = changed(faults)
        if faults.outlier_probability:
            dials |= {name: value for name, value in dataclasses.asdict(faults).items() if "outlier" in name}
        if dials:
            notes.append(f"{sensor} faults: {listed(dials)}.")
    return notes


def changed(spec: Any) -> dict[str, Any]:
    """Return the fields of a spec that differ from their defaults."""
    fields = dataclasses.fields(spec)
    return {field.name: getattr(spec, field.name) for field in fields if getattr(spec, field.name) != field.default}


def listed(dials: dict[str, Any]) -> str:
    """Return "name value, name value"."""
    return ", ".join(f"{name} {_plain(value)}" for name, value in dials.items())


def _plain(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
