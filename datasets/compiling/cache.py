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
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
import platformdirs
from numba.core import caching, config

ROOT = Path(__file__).resolve().parents[2]
KEPT = 20
"""How many states of the sources keep their compiled code, 10 to 30 MB each; the one used longest ago goes first."""


@cache
def read_sources() -> dict[Path, str]:
    """Return the files that compiled code is made from, as they were first read: a log's types and the estimators."""
    folders = (ROOT / "datasets", ROOT / "datasets" / "compiling")
    paths = [path for folder in folders for path in sorted(folder.glob("*.py"))]
    paths += sorted((ROOT / "estimators").rglob("*.py"))
    return {path: path.read_text(encoding="utf-8") for path in paths}


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
        noted = known.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        noted = ""
    if not re.fullmatch("[0-9a-f]{16}", noted):
        noted = sha256(repr(([(name, code_of(text)) for name, text in content], machine)).encode()).hexdigest()[:16]
        part = known.with_name(f"{known.name}.{os.getpid()}")
        with suppress(OSError):  # then the next process parses the sources again
            part.write_text(noted, encoding="ascii")
            part.replace(known)
    return noted


def _flags() -> list[str]:
    """Return numba's settings that decide the machine code."""
    names = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "CPU_NAME", "CPU_FEATURES", "BOUNDSCHECK")
    return [f"{name}={getattr(config, name, None)}" for name in names]


def base_folder() -> Path:
    """Return the folder of all compiled code: below NUMBA_CACHE_DIR where that is set, else in the user's cache."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(named).expanduser().absolute() if named else platformdirs.user_cache_path("fathom")
    return base / "fathom-compiled"


@cache
def compiled_folder() -> Path:
    """Return the folder of the code compiled from the sources as they are; where none can be written, a temporary one.

    Child processes find a temporary folder by NUMBA_CACHE_DIR.
    """
    texts = [(path.relative_to(ROOT).as_posix(), text) for path, text in read_sources().items()]
    try:
        return _made(base_folder(), texts)
    except OSError as error:
        base = temporary_folder()
        _warn_once(
            f"{base_folder()}: cannot be written ({error.strerror}); compiled code goes to {base} until this process "
            "ends; set NUMBA_CACHE_DIR to a folder that can be written"
        )
        os.environ["NUMBA_CACHE_DIR"] = str(base)
        return _made(base_folder(), texts)


class NoPlaceError(OSError):
    """There is no folder at all that can be written."""


@cache
def temporary_folder() -> Path:
    """Return a folder that is removed when this process ends.

    Raises:
        NoPlaceError: none can be made.
    """
    try:
        base = Path(tempfile.mkdtemp(prefix="fathom-compiled-"))
    except OSError as error:
        _warn_once(
            "no folder can be written, not even a temporary one: every process compiles anew, for half a minute; set "
            "NUMBA_CACHE_DIR to a folder that can be written"
        )
        raise NoPlaceError from error
    atexit.register(shutil.rmtree, base, ignore_errors=True)
    return base


_reloaded: set[Path] = set()
"""Sources that have changed since they were first read, in this process."""


def folder_for(path: Path) -> Path:
    """Return the folder for the code of functions in `path`.

    Where any source has changed since it was first read (`importlib.reload`), no folder is the right one to share: then
    it is a temporary one.
    """
    first = read_sources().get(path)
    if first is not None and path.read_text(encoding="utf-8") != first:
        _reloaded.add(path)
    return temporary_folder() / f"reloaded-{next(_numbers)}" if _reloaded else compiled_folder()


_numbers = count()


def _made(base: Path, texts: list[tuple[str, str]]) -> Path:
    notes = base / "sources"
    folder = base / key_of(texts, notes)
    if not folder.is_dir():
        notes.mkdir(parents=True, exist_ok=True)
        folder.mkdir(exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        _forget_oldest(base, notes)
    with suppress(OSError):  # a folder that can be read but not written serves what it has
        os.utime(folder)  # the order in which folders were used
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
    """Tells numba the folder and the key of a function's compiled code."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file, self._path = py_file, Path(py_file).resolve()
        self._lineno = py_func.__code__.co_firstlineno
        self._folder = folder_for(self._path)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Locator:
        """See numba's `_CacheLocator`."""
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """See numba's `_CacheLocator`."""
        inside = self._path.parent.relative_to(ROOT) if self._path.is_relative_to(ROOT) else Path(self._path.stem)
        return str(self._folder / ".".join(inside.parts))

    def get_source_stamp(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return what else than the folder's name decides the code: of a function beside the estimators, its file."""
        if self._path in read_sources():
            return ""
        return sha256(code_of(self._path.read_text(encoding="utf-8")).encode()).hexdigest()

    def get_disambiguator(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """See numba's `_CacheLocator`; no line number, for that moves with every comment."""
        return "code"


class _CodeCacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [Locator]  # noqa: RUF012 - as numba has it


class CodeCache(caching.FunctionCache):
    """Numba's cache of one function's code, kept by `Locator`; a cache that fails costs time, never a run."""

    _impl_class = _CodeCacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature, or None; files that cannot be read are forgotten, and compiled anew."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged pickle raises many kinds
            why = f"{type(error).__name__}: {error}"
            _warn_once(f"{self.cache_path}: compiled code cannot be read ({why}); it is compiled anew")
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for a signature, where it can be kept."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_once(
                f"{self.cache_path}: compiled code cannot be kept ({error.strerror}); every process compiles anew; set "
                "NUMBA_CACHE_DIR to a folder that can be written"
            )


@cache
def _warn_once(message: str) -> None:
    logging.getLogger("fathom").warning(message)
