"""Another revision to compare with: its own checkout, its own compiled code, and its own packages where pins differ."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

from ..errors import ExperimentError

ROOT = Path(__file__).resolve().parents[2]
PREFIX = "fathom-timing-"
TYPES_OF_A_LOG = ("epochs", "state", "rig", "log", "trajectory")
"""What compiled code knows of `datasets`."""


class TimingError(ExperimentError):
    """Nothing can be compared: no such revision, no repository, an environment that cannot be made."""


@dataclass(frozen=True)
class Tree:
    """A revision that can be run.

    Attributes:
        name: what to call it.
        root: its folder.
        python: its interpreter.
        environment: where its dependencies come from, in a sentence.
    """

    name: str
    root: Path
    python: Path
    environment: str

    def packages(self, folder: Path) -> Path:
        """Return `folder`, in which `fathom` now leads to this tree's packages."""
        project = tomllib.loads((self.root / "pyproject.toml").read_text(encoding="utf-8"))
        try:
            where = project["tool"]["setuptools"]["package-dir"]
        except KeyError:
            raise TimingError(
                f"{self.name}: its pyproject.toml names no package-dir; nothing to compare with"
            ) from None
        for package, source in where.items():
            link = folder.joinpath(*package.split("."))
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(self.root / source)
        return folder


def working_tree() -> Tree:
    """Return the tree that this file is in, as it is, uncommitted changes included."""
    if not (ROOT / "pyproject.toml").is_file() or _git("rev-parse", "--is-inside-work-tree") is None:
        raise TimingError(f"{ROOT}: no git checkout of fathom; --against compares a checkout with its own history")
    described = _git("describe", "--always", "--dirty", "--exclude=*") or "unknown"
    return Tree(f"working tree ({described})", ROOT, Path(sys.executable), "this environment")


@contextmanager
def checked_out(revision: str, folder: Path) -> Iterator[Tree]:
    """Give a revision as a worktree within `folder`, a temporary one; it is gone afterwards, whatever happens.

    Raises:
        TimingError: there is no such revision, or its dependencies cannot be installed.
    """
    _remove_stale()
    commit = _git("rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}")
    if commit is None:
        shallow = (
            " (this clone is shallow: `git fetch --unshallow`)"
            if _git("rev-parse", "--is-shallow-repository") == "true"
            else ""
        )
        raise TimingError(f"{revision}: no such revision of {ROOT}{shallow}")
    name = f"{revision} ({commit[:9]} {_git('log', '-1', '--format=%s', commit)})"
    path = folder / f"{PREFIX}{os.getpid()}"
    if _git("worktree", "add", "--detach", "--quiet", str(path), commit) is None:
        raise TimingError(f"{name}: git cannot check it out into {folder}")
    try:
        python, environment = _environment(path, folder / "environment")
        yield Tree(name, path, python, environment)
    finally:
        _git("worktree", "remove", "--force", str(path))


def share_compiled(ours: Path, theirs: Path) -> bool:
    """Hand over our compiled code where their sources of it are ours; return whether they are.

    numba knows code by the time and size of its source, so these files take over our times, too.
    """
    sources = [path.relative_to(ours) for path in sorted((ours / "estimators").glob("*.py"))]
    of_logs = [Path("datasets", f"{name}.py") for name in TYPES_OF_A_LOG]
    same = {path.name for path in (theirs / "estimators").glob("*.py")} == {path.name for path in sources}
    if not same or not all((theirs / path).is_file() for path in of_logs):
        return False
    if any((ours / path).read_bytes() != (theirs / path).read_bytes() for path in [*sources, *of_logs]):
        return False
    for path in sources:
        shutil.copystat(ours / path, theirs / path)
    compiled = theirs / "estimators" / "__pycache__"
    compiled.mkdir(exist_ok=True)
    for path in (ours / "estimators" / "__pycache__").iterdir():
        if path.suffix in (".nbi", ".nbc", ".txt"):
            shutil.copy2(path, compiled)
    return True


def _environment(tree: Path, folder: Path) -> tuple[Path, str]:
    """Return the interpreter for a tree, and why: this one where all that a run imports is pinned alike."""
    if _dependencies(tree) == _dependencies(ROOT):
        return Path(sys.executable), "this environment: the same dependencies, pinned alike"
    python = folder / "bin" / "python"
    wanted = _dependencies(tree)[0]
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if (tree / "constraints.txt").is_file():
        install += ["--constraint", str(tree / "constraints.txt")]
    for command in ([sys.executable, "-m", "venv", str(folder)], [*install, *wanted]):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
            raise TimingError(f"no environment with that revision's pins can be made: {said}")
    return python, "an environment of its own: its dependencies are pinned otherwise"


def _dependencies(tree: Path) -> tuple[list[str], dict[str, str]]:
    """Return what a tree's pyproject.toml asks for, and the pins of all that this brings along."""
    project = tomllib.loads((tree / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted: list[str] = sorted(project["dependencies"])
    pins: dict[str, str] = {}
    with suppress(OSError):
        for line in (tree / "constraints.txt").read_text(encoding="utf-8").splitlines():
            name, _, pin = line.partition("==")
            pins[_canonical(name)] = pin.strip()
    return wanted, {name: pins[name] for name in sorted(_brought_along(wanted)) if name in pins}


def _brought_along(wanted: list[str]) -> set[str]:
    """Return the names of packages and, as far as they are installed here, of all that these need."""
    found: set[str] = set()
    waiting = list(wanted)
    while waiting:
        asked: Any = waiting.pop()
        name = _canonical(re.split(r"[\s;\[<>=!~(]", asked, maxsplit=1)[0])
        if name not in found and "extra ==" not in asked:
            found.add(name)
            with suppress(PackageNotFoundError):
                waiting += requires(name) or []
    return found


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name.strip()).lower()


def _remove_stale() -> None:
    """Remove the worktrees of comparisons that were killed."""
    _git("worktree", "prune")
    for line in (_git("worktree", "list", "--porcelain") or "").splitlines():
        path = Path(line.removeprefix("worktree "))
        if line.startswith("worktree ") and path.name.startswith(PREFIX):
            process = path.name.removeprefix(PREFIX)
            if process.isdigit() and not _is_alive(int(process)):
                _git("worktree", "remove", "--force", str(path))
                shutil.rmtree(path.parent, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _git(*arguments: str) -> str | None:
    """Return what git says, or None where it fails."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
