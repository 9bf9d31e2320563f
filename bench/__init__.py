"""Scores, experiments, runs and results, and the command `fathom`. Names load their module when first asked for.

- `metrics`: scores of a trajectory against the truth, consistency over seeds, the floor.
- `experiment`: what an experiment's file may state, and its variants; `experiments` holds the shipped ones.
- `execution`: one run, worker processes, Dask, and reproducing a row.
- `results`: the store, selection, summaries over seeds, paired differences.
- `output`: tables, figures and the report; `inspection`: checks of a log; `tuning`: search for noise scalars.
- `timing`: budgets, profiles, and comparison with another revision; `cli`: the command line, one file per verb.
- `fathom`: the front of the whole package, `import fathom`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .errors import ExperimentError
    from .execution.drive import run_log, warm_up
    from .execution.result import Result
    from .execution.sweep import run_experiment
    from .experiment.plan import Experiment
    from .metrics import ate, nees, rpe
    from .metrics.scoring import Scoring, scores

HOME = {
    "Experiment": "experiment.plan",
    "ExperimentError": "errors",
    "Result": "execution.result",
    "Scoring": "metrics.scoring",
    "ate": "metrics",
    "nees": "metrics",
    "rpe": "metrics",
    "run_experiment": "execution.sweep",
    "run_log": "execution.drive",
    "scores": "metrics.scoring",
    "warm_up": "execution.drive",
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
