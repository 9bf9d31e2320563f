"""The source archive holds all that its tests need, pins carry hashes, and lower bounds are those that are tested."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KEPT = ("bench", "datasets", "estimators", "tests", "docs", "results/reference", ".ci")
TOP = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "Makefile", ".gitignore")
PINS = ("constraints.txt", "constraints-bench.txt", "constraints-lowest.txt")
BUILD = "import sys, setuptools.build_meta as build; build.build_sdist(sys.argv[1])"
WHEEL = "import sys, setuptools.build_meta as build; build.build_wheel(sys.argv[1])"


def sources(root: Path) -> set[str]:
    """The files that the project is made of, without what running and building leave."""
    found = [path for folder in KEPT for path in (root / folder).rglob("*") if path.is_file()]
    names = {path.relative_to(root).as_posix() for path in found if "__pycache__" not in path.parts}
    return names | {name for name in (*TOP, *PINS) if (root / name).is_file()}


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an unpacked source archive, built from a copy of the sources."""
    folder = tmp_path_factory.mktemp("archive")
    for name in sources(ROOT):
        (folder / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / "tree" / name)
    subprocess.run([sys.executable, "-c", BUILD, str(folder)], cwd=folder / "tree", check=True, capture_output=True)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(folder, filter="data")
    return folder / archive.name.removesuffix(".tar.gz")


@pytest.mark.slow
def test_the_source_archive_holds_everything(unpacked: Path) -> None:
    assert sources(unpacked) == sources(ROOT)


@pytest.mark.slow
def test_what_is_built_from_the_source_archive_passes_its_tests(unpacked: Path) -> None:
    subprocess.run([sys.executable, "-c", WHEEL, str(unpacked)], cwd=unpacked, check=True, capture_output=True)
    (wheel,) = unpacked.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        file.extractall(unpacked / "installed")
    some = ["tests/datasets/test_errors.py", "tests/datasets/test_rotations.py", "tests/bench/experiment"]
    few = [sys.executable, "-P", "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *some]
    environment = os.environ | {"PYTHONPATH": str(unpacked / "installed")}
    done = subprocess.run(few, cwd=unpacked, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    where = [sys.executable, "-P", "-c", "import fathom.datasets as d; print(d.__file__)"]
    place = subprocess.run(where, env=environment, capture_output=True, text=True, check=True).stdout.strip()
    assert Path(place).is_relative_to(unpacked)


def pins(name: str) -> dict[str, str]:
    """Package and version of every pin; each has hashes."""
    text = (ROOT / name).read_text(encoding="utf-8")
    found = {}
    for entry in text.replace("\\\n", " ").splitlines():
        line = re.fullmatch(r"([\w.-]+)==(\S+)(?: ; [^\\]+?)?((?: +--hash=sha256:[0-9a-f]{64})+) *", entry)
        assert line, entry
        found[line[1]] = line[2]
    return found


@pytest.mark.parametrize("name", PINS)
def test_every_pin_has_hashes_and_none_says_where_to_fetch_it(name: str) -> None:
    assert len(pins(name)) > 30


def test_what_is_built_with_is_pinned_as_it_is_asked_for() -> None:
    (wanted,) = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]["requires"]
    assert {f"setuptools=={pins(name)['setuptools']}" for name in PINS} == {wanted}


def test_the_environment_of_make_bench_is_part_of_that_of_make_test() -> None:
    assert pins("constraints-bench.txt").items() <= pins("constraints.txt").items()


def test_every_lower_bound_is_the_version_that_is_tested() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lowest = pins("constraints-lowest.txt")
    for wanted in [*project["dependencies"], *project["optional-dependencies"]["report"]]:
        name, _, bound = re.split("(>=|==)", wanted)
        found = lowest[name.lower()]
        assert re.fullmatch(re.escape(bound) + r"(\.0)*", found), f"{wanted}: {found} is tested"
