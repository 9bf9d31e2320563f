"""Where the stopwatch sits in our estimators: set from outside, in a process of its own, so that no estimator knows.

A compiled function is replaced by a compiled one around it before anybody has called it, so that compiled callers get
that one, too. What runs is the same source, on another cache of compiled code.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import wraps
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ... import estimators
from .driver import PARTS

if TYPE_CHECKING:
    from .stopwatch import Part

ESTIMATORS = estimators.__name__
FOLDER = Path(__file__).parents[2] / "estimators"

PROBES: dict[str, tuple[str, ...]] = {
    "PROPAGATION": (
        "imu.integrate",
        "imu.over_world",
        "imu.predict",
        "imu.process_noise",
        "dvl_preintegration.preintegrate_dvl",
        "kalman.propagate",
        "iekf.propagate_invariant",
        "eskf_filterpy.FilterpyKalman.predict",
        "ukf.UnscentedKalman.predict",
        "graph_pass.GraphPass._block",
        "graph_pass.GraphPass._predict",
        "graph_pass.preintegrate_imu",
    ),
    "LINEARISATION": (
        "measurements.measure",
        "elimination.decorrelate",
        "innovation.judge",
        "eskf_filterpy.stack",
        "ukf.measure_points",
        "window_factors.linearise_factor",
        "window_factors.linearise_prior",
        "window_factors.linearise_tie",
        "gtsam_border.reading_factor",
        "gtsam_border.carried_factor",
        "gtsam_border.displacement_factor",
        "gtsam_border.tight_displacement_factor",
        "gtsam_border.prior_factor",
        "robust.with_loss",
    ),
    "SOLVE": (
        "dead_reckoning.DeadReckoningPass._take",
        "kalman.correct",
        "iekf.correct_invariant",
        "eskf_filterpy.FilterpyKalman.correct",
        "ukf.UnscentedKalman.correct",
        "rts.smooth",
        "window_steps.update",
        "solvers.IncrementalSolver.update",
        "solvers.IncrementalSolver.state",
        "solvers.BatchLagSolver.update",
        "solvers.BatchLagSolver.state",
        "solvers.BatchSolver.update",
        "solvers.BatchSolver.state",
        "solvers.BatchSolver.finish",
    ),
    "OUTPUT": (
        "rts.RauchTungStriebelPass._remember_epoch",
        "window_steps.leave",
        "window_steps.count_outliers",
        "window.WindowPass._take_out",
        "graph_pass.GraphPass._leave",
    ),
    "MARGINAL": (
        "iekf.InvariantKalman.error_covariance",
        "window_chain.covariance_with_hindsight",
        "window_steps.forget",
        "solvers.IncrementalSolver.belief",
        "solvers.BatchLagSolver.belief",
    ),
}
"""What belongs to which part, as module.name; of one inside another see `stopwatch.enter`."""

FROM_GTSAM = {"CustomFactor": "LINEARISATION", "CombinedImuFactor": "LINEARISATION"}
"""Of a CustomFactor what GTSAM calls back, of the other its making."""


def cache_folder() -> Path:
    """Return where compiled code with probes is kept: a folder for these very sources, those of others removed."""
    sources = b"".join(path.read_bytes() for path in sorted(FOLDER.glob("*.py")))
    name = sha256(sources + repr((PROBES, PARTS)).encode()).hexdigest()[:12]
    parent = FOLDER / "__pycache__" / "probed"
    if not os.access(FOLDER, os.W_OK):
        parent = Path(tempfile.gettempdir()) / f"fathom-probed-{os.getuid()}"
    for old in parent.glob("*"):
        if old.name != name:
            shutil.rmtree(old, ignore_errors=True)
    (parent / name).mkdir(parents=True, exist_ok=True)
    return parent / name


def fit(folder: Path) -> None:
    """Put every probe in its place, in this process and for good.

    Args:
        folder: `cache_folder()`, which NUMBA_CACHE_DIR has named since before numba was imported.

    Raises:
        AttributeError: an estimator has no longer what PROBES names.
    """
    from numba.core.dispatcher import Dispatcher

    from .stopwatch import Part

    compiled: dict[str, tuple[Dispatcher, Part]] = {}
    for part_name, names in PROBES.items():
        part = Part[part_name]
        for name in names:
            home, _, attribute = name.rpartition(".")
            module = import_module(f"{ESTIMATORS}.{home.partition('.')[0]}")
            owner: Any = getattr(module, home.partition(".")[2]) if "." in home else module
            was = vars(owner)[attribute]
            if isinstance(was, Dispatcher):
                compiled[name] = was, part
            elif owner is module:
                _replace(was, timed(was, part))
            else:
                setattr(owner, attribute, timed(was, part))
    wrappers = _load(_write(folder, compiled))
    for name, (was, _) in compiled.items():
        _replace(was, getattr(wrappers, name.replace(".", "_")))
    _fit_gtsam()


def timed(function: Callable[..., Any], part: Part) -> Callable[..., Any]:
    """Return a Python function with the stopwatch around it."""
    from .stopwatch import enter, leave

    code = int(part)

    @wraps(function)
    def probed(*arguments: Any, **options: Any) -> Any:
        enter(code)
        try:
            return function(*arguments, **options)
        finally:
            leave()

    return probed


def _replace(was: Any, now: Any) -> None:
    """Let every module of the estimators that has `was` under some name have `now`."""
    for module_name, module in list(sys.modules.items()):
        if module_name.startswith(f"{ESTIMATORS}."):
            for name, value in list(vars(module).items()):
                if value is was:
                    setattr(module, name, now)


def _write(folder: Path, compiled: dict[str, tuple[Any, Part]]) -> Path:
    """Write the compiled functions' wrappers down: numba keeps compiled code for functions that stand in a file."""
    lines = ["from numba import njit", f"from {__package__}.stopwatch import ENTER, LEAVE", ""]
    lines += sorted({f"from {ESTIMATORS} import {name.partition('.')[0]}" for name in compiled})
    for name, (dispatcher, part) in compiled.items():
        alias, arguments = name.replace(".", "_"), ", ".join(inspect.signature(dispatcher.py_func).parameters)
        lines += [
            f"inner_{alias} = {name}",
            "@njit(cache=True)",
            f"def {alias}({arguments}):",
            f"    ENTER({int(part)})",
            f"    answer = inner_{alias}({arguments})",
            "    LEAVE()",
            "    return answer",
            "",
        ]
    file, text = folder / "wrappers.py", "\n".join(lines)
    if not file.is_file():
        unfinished = folder / f"wrappers.{os.getpid()}"
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(file)
    return file


def _load(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("fathom_probes", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _fit_gtsam() -> None:
    """Let the modules that make GTSAM's factors see a GTSAM whose factors are timed."""
    import gtsam

    from .stopwatch import Part

    seen = ModuleType("gtsam")
    vars(seen).update(vars(gtsam))
    part = Part[FROM_GTSAM["CustomFactor"]]
    vars(seen)["CustomFactor"] = lambda noise, keys, error: gtsam.CustomFactor(noise, keys, timed(error, part))
    vars(seen)["CombinedImuFactor"] = timed(gtsam.CombinedImuFactor, Part[FROM_GTSAM["CombinedImuFactor"]])
    for name in ("gtsam_border", "graph_pass"):
        vars(import_module(f"{ESTIMATORS}.{name}"))["gtsam"] = seen
