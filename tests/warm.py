"""Compile what the tests run before they start, on every core: at once, their processes would compile much of it twice.

The compiled code is kept in the user's cache, where each process finds it (`fathom.estimators.compiled_cache`).
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from fathom.datasets import Scenario, simulate
from fathom.estimators import ESTIMATORS, create

sys.path.append(str(Path(__file__).parent / "estimators"))
SHARED = ("eskf", {})
"""Its physics is everybody's, so it is compiled first, and once."""
OTHERS: list[tuple[str, dict[str, Any]]] = [
    ("window", {}),  # the longest by far
    ("window", {"dvl": ["preintegrated-loose"]}),
    ("fls", {"dvl": ["preintegrated-tight"]}),
    *((name, {}) for name in ESTIMATORS if name not in ("eskf", "window")),
]


def compiled(name: str, options: dict[str, Any]) -> str:
    from driver import run_log

    run_log(simulate(Scenario(duration_s=20.0), seed=0), create(name, **options))
    return name


if __name__ == "__main__":
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        print("compiling", pool.submit(compiled, *SHARED).result(), end="", flush=True)
        for name in pool.map(compiled, *zip(*OTHERS, strict=True)):
            print(",", name, end="", flush=True)
    print()
