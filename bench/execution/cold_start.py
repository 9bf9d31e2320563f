"""Compile before many processes would each compile the same, and say so: the first time, it takes minutes."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import llvmlite.binding as llvm
import numba
from rich.console import Console

from ... import estimators
from ...estimators.interface import Estimator
from ...estimators.physics.imu import integrate
from ...estimators.registry import EstimatorError
from ..experiment.plan import plain

NOTICE = "compiling the estimators, once on this machine; this takes minutes"


def compile_first(wanted: Iterable[Estimator]) -> None:
    """Compile what the estimators need and no earlier run has compiled, in one process; nothing to do as a rule.

    Every worker would compile it all by itself, a minute's computing or two and hundreds of megabytes each. Where
    anything is compiled there is a line on stderr, and on a terminal what is being done. Estimators of other packages
    are left to their workers; so is whatever goes wrong here.
    """
    own = f"{estimators.__name__}."
    unknown = {code_of(one): one for one in wanted if type(one).__module__.startswith(own)}
    with suppress(OSError):
        for code in warm():
            unknown.pop(code, None)
    if not unknown:
        return
    from ..timing.driver import Driver

    said: list[str] = []
    console = Console(stderr=True)
    with (
        console.status("looking for compiled code") as status,
        Driver(probed=False) as driver,
        suppress(EstimatorError),
    ):

        def compiling(function: str) -> None:
            if not said:
                print(NOTICE, file=sys.stderr, flush=True)
            said.append(function)
            status.update(f"compiling for {name}: {function}, {len(said)} functions so far")

        for code, estimator in unknown.items():
            name = type(estimator).__name__
            driver.warm_up(estimator, compiling)
            remember(code)


def code_of(estimator: Estimator) -> str:
    """Return what tells by which compiled code an estimator runs: its kind and options, whatever their numbers."""
    options = json.dumps(plain(dataclasses.asdict(cast(Any, estimator))), sort_keys=True)
    return f"{type(estimator).__name__} {re.sub(r'[0-9][0-9.e+-]*', '#', options)}"


def warm() -> set[str]:
    """Return the `code_of` all that has been compiled, into the cache that holds, from the sources as they are."""
    file = _stamp()
    return set(file.read_text(encoding="utf-8").splitlines()) if file.is_file() else set()


def remember(code: str) -> None:
    """Add to `warm`; where the cache cannot be written there is nothing to remember."""
    with suppress(OSError), _stamp().open("a", encoding="utf-8") as file:
        file.write(f"{code}\n")


def _stamp() -> Path:
    """Return a file that lies with the compiled code, and is another for other sources, versions and processors."""
    folder = Path(estimators.__file__).parent
    sources = [f"{path.name} {path.stat().st_mtime_ns} {path.stat().st_size}" for path in sorted(folder.rglob("*.py"))]
    state = [*sources, sys.version, numba.__version__, llvm.get_host_cpu_name()]
    return Path(str(integrate.stats.cache_path)) / f"warm-{sha256(repr(state).encode()).hexdigest()[:12]}.txt"
