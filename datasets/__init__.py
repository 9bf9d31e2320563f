"""Logs: what they are made of, where they come from, and the simulator.

- this folder: the types, and nothing else. `log` (streams and a log), `rig` (mountings, noise), `state` (state, error
  order, belief), `trajectory`, `epochs` (a log cut in the order of reception), `quantities`, `times`, `errors`.
- `compiling`: how functions are compiled, and where compiled code is kept.
- `formats`: one loader per file format, and all YAML; knows files, and no vehicle.
- `described`: log.yaml, and from it and the files to a `Log`; also writes a log as a described folder.
- `simulated`: missions, sensors and faults; `simulate(Scenario(...), seed)`.
- `catalog`: descriptions of known recordings, without the recordings.

Frames, signs and units are those of docs/conventions.md. The types import none of the folders; `formats` stands below
`described`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .errors import DatasetError
from .log import Log
from .rig import ImuNoise, Mounting, Rig
from .state import Belief, NavState
from .trajectory import Trajectory

if TYPE_CHECKING:
    from .described.opening import RecordingNotFound, catalog_names, open_log
    from .simulated.scenario import Scenario
    from .simulated.simulator import simulate

_LATER = {
    "Scenario": "simulated.scenario",
    "simulate": "simulated.simulator",
    "open_log": "described.opening",
    "catalog_names": "described.opening",
    "RecordingNotFound": "described.opening",
}
"""Names whose modules bring pydantic, pandas or splines along: imported when first asked for."""

__all__ = [
    "Belief",
    "DatasetError",
    "ImuNoise",
    "Log",
    "Mounting",
    "NavState",
    "RecordingNotFound",
    "Rig",
    "Scenario",
    "Trajectory",
    "catalog_names",
    "open_log",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name in _LATER:
        value = globals()[name] = getattr(import_module(f".{_LATER[name]}", __name__), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
