"""Another revision to compare with: a checkout of it, with packages of its own where its pins differ from ours."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

from ..execution.child import Child, start
from ..results.machine import git
from .printing import TimingError

ROOT = Path(__file__).resolve().parents[2]
PREFIX = "fathom-timing-"
"""A worktree's folder is called so, with the number of the process that made it."""


@dataclass(frozen=True)
class Tree:
    """A revision that can be run.

    Attributes:
        name: what to call it.
        root: folder of its checkout.
        python: interpreter to run it with.
        environment: where its dependencies come from, in words.
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
            own = folder.joinpath(*package.split("."))
            own.mkdir(parents=True, exist_ok=True)  # no link: another package may stand in it, and not in the tree
            for entry in (self.root / source).iterdir():
                (own / entry.name).symlink_to(entry)
        return folder


@dataclass(frozen=True)
class Side:
    """A tree, the folder that leads to its packages, and the inputs; processes of it can be started."""

    tree: Tree
    packages: Path
    inputs: Path

    def start(self) -> Worker:
        """Start a process."""
        here = Path(__file__).parent
        child = start(
            f"{here / 'worker.py'}:main",
            *map(str, (self.packages, here / "benchmarks.py", self.inputs)),
            python=self.tree.python,
            path=(),
            environment={"PYTHONHASHSEED": "0"},
        )
        return Worker(self.tree.name, child)


@dataclass(frozen=True, eq=False)
class Worker:
    """A process that times benchmarks, see `worker`."""

    name: str
    child: Child

    def send(self, **command: Any) -> None:
        """Hand over a command; the answer can then be received."""
        with suppress(OSError):  # `receive` reports it
            self.child.connection.send(command)

    def receive(self) -> dict[str, Any]:
        """Return the answer to the last command.

        Raises:
            TimingError: the process has died.
        """
        try:
            return self.child.connection.recv()
        except (EOFError, OSError):
            code = self.child.process.wait()
            raise TimingError(f"{self.name}: its process died (exit code {code}); its output is above") from None

    def ask(self, **command: Any) -> dict[str, Any]:
        """Send a command and return the answer."""
        self.send(**command)
        return self.receive()


@contextmanager
def started(*sides: Side) -> Iterator[list[Worker]]:
    """Start a process of each side; they are ended afterwards."""
    with ExitStack() as stack:
        workers = []
        for side in sides:
            workers.append(side.start())
            stack.enter_context(workers[-1].child)
        yield workers


def working_tree() -> Tree:
    """Return the tree that this file is in, as it is, uncommitted changes included."""
    if not (ROOT / "pyproject.toml").is_file() or git(ROOT, "rev-parse", "--is-inside-work-tree") is None:
        raise TimingError(
            f"{ROOT}: no git checkout of fathom; `fathom timing against` compares a checkout with its history"
        )
    described = git(ROOT, "describe", "--always", "--dirty", "--exclude=*") or "unknown"
    return Tree(f"working tree ({described})", ROOT, Path(sys.executable), "this environment")


@contextmanager
def checked_out(revision: str, folder: Path) -> Iterator[Tree]:
    """Check a revision out as a worktree within `folder`, a temporary one; it is always removed afterwards.

    Raises:
        TimingError: there is no such revision, or its dependencies cannot be installed.
    """
    _remove_stale()
    commit = git(ROOT, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}")
    if commit is None:
        shallow = (
            " (this clone is shallow: `git fetch --unshallow`)"
            if git(ROOT, "rev-parse", "--is-shallow-repository") == "true"
            else ""
        )
        raise TimingError(f"{revision}: no such revision of {ROOT}{shallow}")
    name = f"{revision} ({commit[:9]} {git(ROOT, 'log', '-1', '--format=%s', commit)})"
    path = folder / f"{PREFIX}{os.getpid()}"
    if git(ROOT, "worktree", "add", "--detach", "--quiet", str(path), commit) is None:
        raise TimingError(f"{name}: git cannot check it out into {folder}")
    try:
        python, environment = _environment(path, folder / "environment")
        yield Tree(name, path, python, environment)
    finally:
        git(ROOT, "worktree", "remove", "--force", str(path))


def _environment(tree: Path, folder: Path) -> tuple[Path, str]:
    """Return the interpreter for a tree, and why; it is ours if both pin alike what a run imports."""
    if _dependencies(tree) == _dependencies(ROOT):
        return Path(sys.executable), "this environment: the same dependencies, pinned alike"
    python = folder / "bin" / "python"
    wanted = _dependencies(tree)[0]
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if (tree / "constraints-bench.txt").is_file():
        install += ["--require-hashes", "--requirement", str(tree / "constraints-bench.txt")]
    else:  # pins without hashes, or none
        pins = tree / "constraints.txt"
        install += [*(["--constraint", str(pins)] if pins.is_file() else []), *wanted]
    for command in ([sys.executable, "-m", "venv", str(folder)], install):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
            raise TimingError(f"no environment with that revision's pins can be made: {said}")
    return python, "an environment of its own: its dependencies are pinned otherwise"


def _dependencies(tree: Path) -> tuple[list[str], dict[str, str]]:
    """Return the dependencies in a tree's pyproject.toml, and the pins of these and of what they need."""
    project = tomllib.loads((tree / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted: list[str] = sorted(project["dependencies"])
    pins: dict[str, str] = {}
    with suppress(OSError):
        for line in (tree / "constraints.txt").read_text(encoding="utf-8").splitlines():
            name, _, pin = line.partition("==")
            pins[_canonical(name)] = re.split(r"[;\\]", pin)[0].strip()  # hashes follow
    return wanted, {name: pins[name] for name in sorted(_brought_along(wanted)) if name in pins}


def _brought_along(wanted: list[str]) -> set[str]:
    """Return the names of packages and of all that they need, as far as they are installed here."""
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
    """Remove the worktrees that killed comparisons left behind."""
    git(ROOT, "worktree", "prune")
    for line in (git(ROOT, "worktree", "list", "--porcelain") or "").splitlines():
        path = Path(line.removeprefix("worktree "))
        if line.startswith("worktree ") and path.name.startswith(PREFIX):
            process = path.name.removeprefix(PREFIX)
            if process.isdigit() and not _is_alive(int(process)):
                git(ROOT, "worktree", "remove", "--force", str(path))
                shutil.rmtree(path.parent, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
