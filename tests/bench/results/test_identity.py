"""The hash of our own sources: every module counts, and no other file that may lie beside them."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fathom.bench.results.identity import code_sha256, sources_sha256

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three small packages."""
    for package in ("bench", "datasets", "estimators"):
        (tmp_path / package / "inner").mkdir(parents=True)
        for name in ("__init__.py", "one.py", "inner/__init__.py", "inner/two.py"):
            (tmp_path / package / name).write_text(f"# {package} {name}\n")
    return tmp_path


@pytest.mark.parametrize(
    "stray",
    [
        "bench/notes.py~",
        "bench/.one.py.swp",
        "bench/.#one.py",
        "bench/#one.py#",
        "bench/one (copy).py",
        "bench/one.orig.py",
        "bench/one.py.bak",
        "bench/__pycache__/one.cpython-311.pyc",
        "bench/__pycache__/wrapper.py",
        "bench/__pycache__/__init__.py",
        "datasets/.ipynb_checkpoints/one-checkpoint.py",
        "estimators/inner/.ipynb_checkpoints/__init__.py",
        "estimators/build/lib/fathom/estimators/__init__.py",
        "bench/fathom_bench.egg-info/__init__.py",
        "bench/scratch/try.py",
        "bench/fathom/__init__.py",
        "bench/experiments/mine.yaml",
    ],
)
def test_a_stray_file_is_no_other_version(root: Path, stray: str) -> None:
    before = sources_sha256(root)
    (root / stray).parent.mkdir(parents=True, exist_ok=True)
    (root / stray).write_text("x = 1\n")
    assert sources_sha256(root) == before


def test_a_dangling_lock_of_an_editor_is_no_other_version(root: Path) -> None:
    before = sources_sha256(root)
    (root / "bench" / ".#one.py").symlink_to("user@host.123")
    (root / "bench" / "gone.py").symlink_to("nowhere")
    assert sources_sha256(root) == before


@pytest.mark.parametrize("name", ["bench/one.py", "datasets/inner/two.py", "estimators/__init__.py"])
def test_every_module_counts_by_name_and_content(root: Path, name: str) -> None:
    before = sources_sha256(root)
    (root / name).write_text("x = 1\n")
    changed = sources_sha256(root)
    (root / name).rename((root / name).with_name("other.py"))
    assert len({before, changed, sources_sha256(root)}) == 3


@pytest.mark.slow
def test_an_installed_wheel_has_the_hash_of_its_checkout(tmp_path: Path) -> None:
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, text=True, check=False).stdout
    if not listed:
        pytest.skip("no checkout of git to build from")
    for name in listed.strip("\0").split("\0"):
        if (ROOT / name).is_file() and not name.startswith(("tests/", "docs/")):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name)
    build = "import setuptools.build_meta as build; print(build.build_wheel('dist'))"
    built = subprocess.run([sys.executable, "-c", build], cwd=tmp_path, capture_output=True, text=True, check=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert wheel.name in built.stdout
    with zipfile.ZipFile(wheel) as content:
        content.extractall(tmp_path / "installed")
    assert sources_sha256(tmp_path / "installed" / "fathom") == sources_sha256(tmp_path)


def test_this_process_hashes_its_own_sources() -> None:
    assert code_sha256() == sources_sha256(ROOT)
