"""A process that times benchmarks for `comparison`, with the packages of one revision to import.

`execution.child` starts this file. It answers commands: {"prepare": NAME} or {"time": NAME, "repeat": N}. The file of
the benchmarks may be another revision's than the packages; so this one imports nothing of ours at its top.
"""

from __future__ import annotations

import gc
import importlib.util
import sys
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

HOME = "fathom.bench.timing.benchmarks"
"""The benchmarks are loaded under this name: their relative imports then lead into the packages."""


def load(packages: Path, benchmarks: Path) -> dict[str, Any]:
    """Return the benchmarks of a file by name, for the packages of a folder."""
    sys.path.insert(0, str(packages))
    spec = importlib.util.spec_from_file_location(HOME, benchmarks)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[HOME] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    import fathom.bench  # the one in `packages`, even if another is installed

    assert Path(fathom.bench.__path__[0]).parents[1] == packages, fathom.bench.__path__
    return {each.name: each for each in module.BENCHMARKS}


def main(connection: Any, packages: str, benchmarks: str, inputs: str) -> None:
    """Answer commands until the connection closes."""
    known = load(Path(packages), Path(benchmarks))
    ready: dict[str, Any] = {}
    gc.disable()
    while True:
        try:
            command = connection.recv()
        except EOFError:
            return
        if "prepare" in command:
            name = command["prepare"]
            try:
                ready[name] = known[name].prepare(Path(inputs))
                ready[name].do()
                answer = {"units": ready[name].units} | timed(ready[name].do, 1)
            except Exception as error:  # a revision may lack anything, or do it differently
                answer = {"lacks": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        else:
            answer = timed(ready[command["time"]].do, command["repeat"])
        connection.send(answer)


def timed(do: Any, repeat: int) -> dict[str, float]:
    """Return the processor time and the time by the clock of one of `repeat` calls, s."""
    gc.collect()
    wall, cpu = perf_counter(), process_time()
    for _ in range(repeat):
        do()
    return {"cpu_s": (process_time() - cpu) / repeat, "wall_s": (perf_counter() - wall) / repeat}
