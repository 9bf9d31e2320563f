"""Where compiled code is kept: a folder of the user's cache, one per state of our sources.

Numba's own cache looks at a function's file alone, not at the files of what that function calls, and it is tied to the
place of the checkout. Ours is named by what decides the machine code: the sources of the types and the estimators
without comments and docstrings, the versions of what compiles them, and the processor. So a changed callee is never run
as old machine code, and a second clone, virtual environment or user compiles nothing anew.

NUMBA_CACHE_DIR, where it is set, takes the place of the user's cache folder.
"""

from __future__ import annotations

import ast
import atexit
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
import platformdirs
from numba.core import caching, config

ROOT = Path(__file__).resolve().parents[1]
KEPT = 20
"""How many states of the sources keep their compiled code, 10 to 30 MB each; the one used longest ago goes first."""


class CompiledCacheWarning(UserWarning):
    """Compiled code cannot be kept, so every process compiles for itself."""


@cache
def sources() -> tuple[Path, ...]:
    """Return the files that compiled code is made from: the types of a log, and the estimators."""
    return (*sorted((ROOT / "datasets").glob("*.py")), *sorted((ROOT / "estimators").rglob("*.py")))


def code_of(source: str) -> str:
    """Return a source without its comments, docstrings, type annotations and line numbers."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            node.annotation = None
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)]  # pyright: ignore[reportAttributeAccessIssue]
    return ast.dump(tree)


def _is_text(line: ast.AST) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)


def key_of(texts: Iterable[tuple[str, str]], notes: Path) -> str:
    """Return the name of the state of these sources.

    Args:
        texts: name and content of each.
        notes: folder that records which texts are the same code, so that a process need not parse them.
    """
    content = list(texts)
    machine = [sys.version, numba.__version__, np.__version__, llvm.get_host_cpu_name(), *_flags()]
    known = notes / sha256(repr((content, machine)).encode()).hexdigest()[:32]
    try:
        return known.read_text(encoding="ascii")
    except OSError:
        key = sha256(repr(([(name, code_of(text)) for name, text in content], machine)).encode()).hexdigest()[:16]
        part = known.with_name(f"{known.name}.{os.getpid()}")
        part.write_text(key, encoding="ascii")
        part.replace(known)
        return key


def _flags() -> list[str]:
    """Return numba's settings that decide the machine code."""
    names = ("OPT", "DISABLE_JIT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "CPU_NAME", "CPU_FEATURES", "BOUNDSCHECK")
    return [f"{name}={getattr(config, name, None)}" for name in names]


def base_folder() -> Path:
    """Return the folder of all compiled code: below NUMBA_CACHE_DIR where that is set, else in the user's cache."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_path("fathom")) / "fathom-compiled"


@cache
def compiled_folder() -> Path:
    """Return the folder of the code compiled from the sources as they are; where none can be written, a temporary one.

    Child processes find a temporary folder by NUMBA_CACHE_DIR.
    """
    texts = [(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")) for path in sources()]
    try:
        return _made(base_folder(), texts)
    except OSError as error:
        base = Path(tempfile.mkdtemp(prefix="fathom-compiled-"))
        atexit.register(shutil.rmtree, base, ignore_errors=True)
        warnings.warn(
            f"{base_folder()}: cannot be written ({error.strerror}); compiled code goes to {base} until this process "
            "ends; set NUMBA_CACHE_DIR to a folder that can be written",
            CompiledCacheWarning,
            stacklevel=2,
        )
        os.environ["NUMBA_CACHE_DIR"] = str(base)
        return _made(base_folder(), texts)


def _made(base: Path, texts: list[tuple[str, str]]) -> Path:
    notes = base / "sources"
    notes.mkdir(parents=True, exist_ok=True)
    folder = base / key_of(texts, notes)
    is_new = not folder.is_dir()
    folder.mkdir(exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()
    os.utime(folder)  # the order in which folders were used
    if is_new:
        _forget_oldest(base, notes)
    return folder


def _forget_oldest(base: Path, notes: Path) -> None:
    def used(folder: Path) -> float:
        try:
            return folder.stat().st_mtime
        except OSError:  # another process was quicker
            return 0.0

    folders = sorted((path for path in base.iterdir() if path.is_dir() and path != notes), key=used, reverse=True)
    for folder in folders[KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)


class Locator(caching._CacheLocator):
    """Tells numba the folder and the key of our functions' compiled code."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file, self._path = py_file, Path(py_file).resolve()
        self._lineno = py_func.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Locator | None:
        """See numba's `_CacheLocator`; functions of other packages are left to numba's own locators."""
        path = Path(py_file).resolve()
        ours = path.is_file() and any(path.is_relative_to(ROOT / name) for name in ("bench", "datasets", "estimators"))
        return cls(py_func, py_file) if ours else None

    def get_cache_path(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """See numba's `_CacheLocator`."""
        return str(compiled_folder() / self._path.relative_to(ROOT).parent.as_posix().replace("/", "."))

    def get_source_stamp(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return what else than the folder's name decides the code: of a function beside the estimators, its file."""
        return "" if self._path in sources() else sha256(code_of(self._path.read_text("utf-8")).encode()).hexdigest()

    def get_disambiguator(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """See numba's `_CacheLocator`; no line number, for that moves with every comment."""
        return "code"


def use_compiled_folder() -> None:
    """Have numba keep our functions' code in `compiled_folder`; to be called before anything is compiled or loaded."""
    defaults = [kind.__name__ for kind in caching.CacheImpl._locator_classes]
    config.CACHE_LOCATOR_CLASSES = ",".join([f"{__name__}.{Locator.__name__}", *defaults])  # pyright: ignore[reportAttributeAccessIssue]
