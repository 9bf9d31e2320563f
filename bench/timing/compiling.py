"""Cost of compiling with an empty cache: processor time and number of compilations, by estimator."""

from __future__ import annotations

import os
import tempfile
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any

from ..execution.child import start


@dataclass(frozen=True)
class Compiling:
    """What compiling took in a fresh process with an empty cache.

    Attributes:
        cpu_s: processor time of all functions, without importing and without running.
        compilations: how many there were, those of numba's own functions included.
        by_function: (name, seconds without its callees, compilations), the slowest first.
    """

    cpu_s: float
    compilations: int
    by_function: tuple[tuple[str, float, int], ...]


def compile_cpu_seconds(names: Sequence[str]) -> Compiling:
    """Return what compiling takes for these estimators, with their default options, one after the other.

    Args:
        names: of `fathom.estimators`.

    Raises:
        EOFError: the process died.
    """
    with (
        tempfile.TemporaryDirectory(prefix="fathom-compiling-") as folder,
        start(f"{__spec__.name}:measure", *names, environment={"NUMBA_CACHE_DIR": folder}) as child,
    ):
        return child.connection.recv()


def measure(connection: Any, *names: str) -> None:
    """Compile in this process, and send a `Compiling`: the child's side."""
    from numba.core import event

    from ...estimators.registry import create
    from ..execution.drive import warm_up

    own_s: defaultdict[str, float] = defaultdict(float)
    times: Counter[str] = Counter()
    running: list[list[float]] = []  # of each function that is being compiled: its start, and the time of its callees

    class Clock(event.Listener):
        def on_start(self, event: Any) -> None:
            running.append([process_time(), 0.0])

        def on_end(self, event: Any) -> None:
            began_s, callees_s = running.pop()
            took_s = process_time() - began_s
            function = event.data["dispatcher"].py_func
            name = f"{function.__module__}.{function.__name__}"
            own_s[name] += took_s - callees_s
            times[name] += 1
            if running:
                running[-1][1] += took_s

    event.register("numba:compile", Clock())
    for name in names:
        warm_up(create(name))
    by_function = tuple(
        (name, seconds, times[name]) for name, seconds in sorted(own_s.items(), key=lambda each: -each[1])
    )
    connection.send(Compiling(sum(own_s.values()), sum(times.values()), by_function))


def main() -> None:
    """Print what compiling takes for the estimators on the command line: `python -m fathom.bench.timing.compiling`."""
    import sys

    found = compile_cpu_seconds(sys.argv[1:])
    for name, seconds, times in found.by_function[: int(os.environ.get("ROWS", "40"))]:
        print(f"{seconds:8.2f} s {times:4d} × {name}")
    print(f"{found.cpu_s:8.2f} s {found.compilations:4d} × all")


if __name__ == "__main__":
    main()
