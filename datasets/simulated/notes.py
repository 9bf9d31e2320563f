"""The notes of a simulated log: a sentence for every setting that differs from its default."""

from __future__ import annotations

import dataclasses
from typing import Any

from .scenario import Scenario
from .specs import SENSORS

UNSEEN = {
    *("min_range_m", "max_range_m", "max_tilt_deg", "beam_loss_probability", "three_beams"),
    *("reacquisition_s", "velocity_in", "wrong_by_deg"),
}
"""Settings of sensors and of the prior that neither the rig nor the readings nor the prior show."""


def scenario_notes(scenario: Scenario) -> list[str]:
    """Return sentences on the world, and on each sensor's settings, delays and faults, where there are any."""
    parts = (_world, _mountings, _sensors, _late, _faults, _told, _prior)
    return [note for part in parts for note in part(scenario)]


def _world(scenario: Scenario) -> list[str]:
    return [
        f"{name}: {listed(dataclasses.asdict(part))}."
        for name in ("seabed", "waves", "tide")
        if (part := getattr(scenario, name)) is not None
    ]


def _mountings(scenario: Scenario) -> list[str]:
    aboard = {sensor: getattr(getattr(scenario, sensor), "mounting", None) for sensor in ("imu", *SENSORS)}
    return [note for sensor, spec in aboard.items() if spec is not None for note in spec.notes(sensor)]


def _sensors(scenario: Scenario) -> list[str]:
    return [note for sensor in SENSORS for note in _unseen(scenario, sensor)]


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


def _told(scenario: Scenario) -> list[str]:
    told = {name: changed(part.told) for name, part in scenario.noisy.items()}
    return [f"{name} is told otherwise than simulated: {listed(dials)}." for name, dials in told.items() if dials]


def _prior(scenario: Scenario) -> list[str]:
    return _unseen(scenario, "prior")


def _unseen(scenario: Scenario, name: str) -> list[str]:
    spec = getattr(scenario, name)
    dials = {} if spec is None else {name: value for name, value in changed(spec).items() if name in UNSEEN}
    return [f"{name}: {listed(dials)}."] if dials else []


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
