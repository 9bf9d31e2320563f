"""What there is to know: logs, readings, the rig, the truth; the simulator; one loader per format."""

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
