"""The machine, and which of its properties decide how floating-point numbers are rounded.

The same versions give the same bits where these facts are the same: the kind of processor, for which numba compiles and
by which OpenBLAS, numpy and the C library choose among their kernels (fused or not, sums of four or of eight); and
the C library itself, whose sine may differ. How a library was built is part of its version.
"""

from __future__ import annotations

import os
import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

DECIDES = ("cpu", "architecture", "c_library", "compiled_for", "simd", "blas")
"""The keys of `machine` that affect rounding; the rest (cores, platform, node) is for information."""

CHOOSES = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "GLIBC_TUNABLES")
"""Variables of the environment by which a user chooses other kernels than the processor asks for."""


GIT_S = 60.0
"""s: whoever waits longer for git, on a share that hangs, does without."""


@cache
def machine() -> dict[str, Any]:
    """Return what a row says of the machine it was made on."""
    import numpy as np
    from llvmlite import binding

    build: Any = np.show_config(mode="dicts")
    blas = build["Build Dependencies"]["blas"]
    chosen = [f"{name}={os.environ[name]}" for name in CHOOSES if name in os.environ]
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "node": platform.node(),
        "architecture": f"{platform.system()} {platform.machine()}",
        "c_library": " ".join(platform.libc_ver()).strip(),
        "compiled_for": " ".join([binding.get_host_cpu_name(), *chosen]),
        "simd": " ".join(build.get("SIMD Extensions", {}).get("found", [])),
        "blas": f"{blas.get('name')} {blas.get('version')}",
    }


def git(folder: Path, *arguments: str) -> str | None:
    """Return the output of git in a folder; None where it fails, or there is none."""
    try:
        command = ["git", "-C", str(folder), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=GIT_S)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor()
    )
