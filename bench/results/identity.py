"""The identity of a run: a hash of everything that its numbers depend on.

That is its spec with every default, the readings of a recorded log, the sources of this package, and the versions of
what it computes with. A run that is in the store under its identity is not repeated; a changed spec or version makes
another run.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import Any

import numpy as np

COMPUTES_WITH = ("fathom-bench", "numpy", "scipy", "numba", "gtsam", "filterpy", "pandas")
FINAL = ("done", "diverged")
"""Statuses of runs that are not repeated; a failed one (its worker died, it was out of time) is."""
NO_ROOMS = ("__pycache__", "fathom")
"""Folders that hold none of our modules; `bench/fathom` is the package `fathom` itself, which lies above the three when
they are installed."""


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and packages, and the hash of our own sources."""
    found = {"python": python_version()}
    for package in COMPUTES_WITH:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "absent"
    return found | {"code": code_sha256()}


@cache
def code_sha256() -> str:
    """Return the hash of the source files of our three packages, by name and content."""
    return sources_sha256(Path(__file__).parents[2])


def sources_sha256(root: Path) -> str:
    """Return the hash of the modules of our packages below `root`: of a checkout and of its installed wheel the same.

    Other files there do not count: caches, checkpoints, an editor's copies, what was built inside the checkout.
    """
    digest = sha256()
    for package in ("bench", "datasets", "estimators"):
        for path in _modules(root / package):
            digest.update(path.relative_to(root).as_posix().encode() + sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _modules(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder that can be imported as modules of its package, in order."""
    for path in sorted(folder.iterdir()):
        if path.suffix == ".py" and path.stem.isidentifier() and path.is_file():
            yield path
        elif path.name.isidentifier() and path.name not in NO_ROOMS and (path / "__init__.py").is_file():
            yield from _modules(path)


def content_sha256(value: Any) -> str:
    """Return the hash of a log, or of anything made of dataclasses, arrays, mappings, sequences and plain values."""
    digest = sha256()
    _update(digest, value)
    return digest.hexdigest()


def _update(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(type(value).__name__.encode())
        for field in fields(value):
            digest.update(field.name.encode())
            _update(digest, getattr(value, field.name))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            digest.update(repr(key).encode())
            _update(digest, item)
    elif isinstance(value, tuple | list):
        digest.update(f"{len(value)}".encode())
        for item in value:
            _update(digest, item)
    else:
        digest.update(repr(value).encode())


def identity(
    spec: Mapping[str, Any],
    package: str | None,
    readings_sha256: str | None,
    made_by: Mapping[str, str] | None = None,
) -> str:
    """Return the identity of a run.

    Args:
        spec: as `Experiment.spec` gives it.
        package: name and version of the package that the estimator comes from; None for ours.
        readings_sha256: of a recorded log, or of the recorded path that a simulated one follows; None for any other,
            which its spec determines.
        made_by: earlier `versions`, for the identity that the run had with them; default: the present ones.
    """
    decides = {"spec": spec, "readings": readings_sha256, "versions": made_by or versions(), "package": package}
    return sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()
