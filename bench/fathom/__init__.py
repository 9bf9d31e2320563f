"""Fathom: filter or smoother, at what lag, with which sensors, at what cost? A benchmark for underwater navigation.

Three packages, of which each imports only those before it:

- `fathom.datasets`: logs (streams, rig, truth), their files and descriptions, and the simulator.
- `fathom.estimators`: the measurement physics, once, and every filter and smoother on top of it.
- `fathom.bench`: scores, experiments, runs, results, tables, figures, reports, timing, and the command `fathom`.

W is east-north-up, B forward-left-up at the DVL, times are int64 nanoseconds; docs/conventions.md has the rest, with
every equation that code cites. `__version__` is that of the installed distribution, fathom-bench.
"""

from __future__ import annotations

from typing import Any

PACKAGES = ("bench", "datasets", "estimators")


def __getattr__(name: str) -> Any:
    """Import a package on first use, so that `import fathom` is quick."""
    if name == "__version__":
        from importlib.metadata import version  # slow to import

        return version("fathom-bench")
    if name in PACKAGES:
        from importlib import import_module

        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *PACKAGES, "__version__"])
