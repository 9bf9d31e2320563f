"""Compiled code is kept by what decides it, and by nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fathom.datasets.compiling import cache as compiled_cache
from fathom.datasets.compiling.cache import code_of, compiled_folder, key_of
from fathom.datasets.compiling.decorators import compiled

ROOT = Path(__file__).resolve().parents[2]
CALL = """
from fathom.estimators.physics.calling import caller
print(caller(1.0), sum(caller.stats.cache_hits.values()), caller.stats.cache_path)
"""
CALLED = """
from fathom.datasets.compiling.decorators import compiled

@compiled
def callee(x):
    return x + 1.0
"""
CALLING = """
from fathom.datasets.compiling.decorators import compiled
from .called import callee

@compiled
def caller(x):
    return callee(x)
"""


def copy_of_the_package(folder: Path) -> Path:
    """Return the file of a compiled function in a checkout elsewhere; the file beside it has one that calls it."""
    for name in ("bench", "datasets", "estimators"):
        shutil.copytree(ROOT / name, folder / "fathom" / name, ignore=shutil.ignore_patterns("__pycache__"))
    physics = folder / "fathom" / "estimators" / "physics"
    (physics / "calling.py").write_text(CALLING)
    (physics / "called.py").write_text(CALLED)
    return physics / "called.py"


def run(folder: Path, **environment: str) -> tuple[float, int, Path, str]:
    """Return the value, how often the cache was hit, where it lies, and what was said on stderr."""
    done = subprocess.run(
        [sys.executable, "-c", CALL],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder), "PYTHONSAFEPATH": ""} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    value, hits, path = done.stdout.split()
    return float(value), int(hits), Path(path), done.stderr


@pytest.mark.slow
def test_a_changed_callee_never_runs_as_old_machine_code(tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    called = copy_of_the_package(tmp_path)
    assert run(tmp_path, NUMBA_CACHE_DIR=cache)[:2] == (2.0, 0)
    assert run(tmp_path, NUMBA_CACHE_DIR=cache)[:2] == (2.0, 1)
    called.write_text(CALLED.replace("x + 1.0", "x + 9.0"))
    assert run(tmp_path, NUMBA_CACHE_DIR=cache)[:2] == (10.0, 0)


@pytest.mark.slow
def test_a_second_clone_and_a_changed_comment_compile_nothing(tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    copy_of_the_package(tmp_path / "first")
    called = copy_of_the_package(tmp_path / "second")
    called.write_text(CALLED.replace("@compiled", "# a comment\n@compiled"))
    assert run(tmp_path / "first", NUMBA_CACHE_DIR=cache)[1] == 0
    assert run(tmp_path / "second", NUMBA_CACHE_DIR=cache)[1] == 1


@pytest.mark.slow
def test_where_no_folder_can_be_written_a_temporary_one_is_used_with_a_warning(tmp_path: Path) -> None:
    copy_of_the_package(tmp_path)
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the folder would be")
    value, _, path, said = run(tmp_path, NUMBA_CACHE_DIR=str(blocked))
    assert value == 2.0
    assert said.count("cannot be written") == 1
    assert str(blocked) in said
    assert not path.exists()


@pytest.mark.parametrize(
    ("change", "same"),
    [
        (("x + 1", "x + 2"), False),
        (("x + 1", "x  +  1  # one more"), True),
        (('"""Doc."""', '"""Other."""'), True),
        (("def f", "\n\ndef f"), True),
        (("'label'", "'other'"), False),
        (("def f(x):", "def f(x: int) -> int:"), True),
    ],
)
def test_code_is_what_is_left_without_comments_and_docstrings(change: tuple[str, str], same: bool) -> None:
    source = 'def f(x):\n    """Doc."""\n    g(\'label\')\n    return x + 1\n'
    assert (code_of(source) == code_of(source.replace(*change))) is same


def test_the_oldest_states_of_the_sources_are_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled_cache, "KEPT", 2)
    notes = tmp_path / "sources"
    notes.mkdir()
    for k in range(4):
        folder = tmp_path / key_of([("a.py", f"x = {k}")], notes)
        folder.mkdir()
        os.utime(folder, (k, k))
    compiled_cache._forget_oldest(tmp_path, notes)
    kept = {folder.name for folder in tmp_path.iterdir()} - {"sources"}
    assert kept == {key_of([("a.py", f"x = {k}")], notes) for k in (2, 3)}


def test_the_folder_is_the_users_not_the_checkouts() -> None:
    assert not compiled_folder().is_relative_to(ROOT)


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package, and a cache that a second process has used."""
    folder = tmp_path_factory.mktemp("used")
    copy_of_the_package(folder)
    for _ in range(2):
        run(folder, NUMBA_CACHE_DIR=str(folder / "cache"))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "damage"),
    [("*.nbi", b""), ("*.nbi", b"short"), ("*.nbc", bytes(range(256)) * 8), ("sources/*", bytes(range(256)))],
)
def test_damaged_files_are_compiled_anew_and_mended(used: Path, tmp_path: Path, kind: str, damage: bytes) -> None:
    cache = tmp_path / "cache"
    shutil.copytree(used / "cache", cache)
    damaged = list(cache.rglob(kind))
    assert damaged
    for path in damaged:
        path.write_bytes(damage)
    assert run(used, NUMBA_CACHE_DIR=str(cache))[0] == 2.0
    value, hits, _, said = run(used, NUMBA_CACHE_DIR=str(cache))
    assert (value, hits, said) == (2.0, 1, "")


RELOADED = """
import importlib, pathlib
from fathom.estimators.physics import called, calling
path = pathlib.Path(called.__file__)
source = path.read_text()
path.write_text(source.replace("x + 1.0", "x + 19.0"))
importlib.reload(called)
importlib.reload(calling)
path.write_text(source)
print(calling.caller(1.0), 0, calling.caller.stats.cache_path)
"""


def test_code_of_sources_that_were_reloaded_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = str(tmp_path / "cache")
    copy_of_the_package(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules[__name__], "CALL", RELOADED)
        assert run(tmp_path, NUMBA_CACHE_DIR=cache)[0] == 20.0
    assert run(tmp_path, NUMBA_CACHE_DIR=cache)[:2] == (2.0, 0)


def test_a_cache_that_cannot_be_written_costs_no_run(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)

    @compiled
    def twice(x: float) -> float:
        return 2.0 * x

    assert twice(2.0) == 4.0
    assert "cannot be kept (No space left on device)" in caplog.text


def test_without_any_place_to_write_functions_are_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch, caplog: Any, tmp_path: Path
) -> None:
    def nowhere(*_: object, **__: object) -> str:
        raise FileNotFoundError(2, "No usable temporary directory found")

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    monkeypatch.setattr("tempfile.mkdtemp", nowhere)
    for function in (compiled_cache.compiled_folder, compiled_cache.temporary_folder):
        monkeypatch.setattr(compiled_cache, function.__name__, function.__wrapped__)  # not what this process found

    @compiled
    def twice(x: float) -> float:
        return 2.0 * x

    assert twice(2.0) == 4.0
    assert caplog.text.count("no folder can be written, not even a temporary one") == 1
