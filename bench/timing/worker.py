"""One process that times benchmarks for `comparison`: started as a file, with one revision's packages to import.

    python -P worker.py PACKAGES BENCHMARKS INPUTS

reads a command per line, {"prepare": NAME} or {"time": NAME, "repeat": N}, and answers each by a line of JSON. The file
of the benchmarks may be another revision's than the packages.
"""

from __future__ import annotations

import gc
import importlib.util
import json
import os
import sys
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

HOME = "fathom.bench.timing.benchmarks"
"""As this the benchmarks are loaded: their relative imports then lead into PACKAGES."""


def load(packages: Path, benchmarks: Path) -> dict[str, Any]:
    """Return the benchmarks of a file by name, for the packages of a folder."""
    sys.path.insert(0, str(packages))
    spec = importlib.util.spec_from_file_location(HOME, benchmarks)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[HOME] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    import fathom.bench  # of PACKAGES, whatever else is installed

    assert Path(fathom.bench.__path__[0]).parents[1] == packages, fathom.bench.__path__
    return {each.name: each for each in module.BENCHMARKS}


def main(packages: str, benchmarks: str, inputs: str) -> None:
    """Answer commands until there are no more."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what anybody prints is no answer
    known = load(Path(packages), Path(benchmarks))
    ready: dict[str, Any] = {}
    gc.disable()
    for line in sys.stdin:
        command = json.loads(line)
        if "prepare" in command:
            name = command["prepare"]
            try:
                ready[name] = known[name].prepare(Path(inputs))
                ready[name].do()
                answer = {"units": ready[name].units} | timed(ready[name].do, 1)
            except Exception as error:  # whatever a revision does not have, or does otherwise
                answer = {"lacks": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        else:
            answer = timed(ready[command["time"]].do, command["repeat"])
        answers.write(json.dumps(answer) + "\n")


def timed(do: Any, repeat: int) -> dict[str, float]:
    """Return the seconds of processor and of clock that one of `repeat` calls takes."""
    gc.collect()
    wall, cpu = perf_counter(), process_time()
    for _ in range(repeat):
        do()
    return {"cpu_s": (process_time() - cpu) / repeat, "wall_s": (perf_counter() - wall) / repeat}


if __name__ == "__main__":
    main(*sys.argv[1:])
