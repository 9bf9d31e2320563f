"""Metrics, experiments, runner, store, reports, command line. Names load their module when first asked for."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .experiment import Experiment, ExperimentError
    from .metrics import ate, nees, rpe
    from .run import Result, Scoring, run_log, scores, warm_up
    from .runner import run_experiment

HOME = {
    "Experiment": "experiment",
    "ExperimentError": "experiment",
    "Result": "run",
    "Scoring": "run",
    "ate": "metrics",
    "nees": "metrics",
    "rpe": "metrics",
    "run_experiment": "runner",
    "run_log": "run",
    "scores": "run",
    "warm_up": "run",
}
"""Which module each public name lives in; so `fathom --help` does not wait for numba."""

__all__ = [
    "Experiment",
    "ExperimentError",
    "Result",
    "Scoring",
    "ate",
    "nees",
    "rpe",
    "run_experiment",
    "run_log",
    "scores",
    "warm_up",
]


def __getattr__(name: str) -> Any:
    if name not in HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{HOME[name]}", __name__), name)
