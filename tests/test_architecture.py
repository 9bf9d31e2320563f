"""The tree is the architecture: imports point downwards, and `fathom --help` waits for nothing heavy."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEVEL = {"datasets": 0, "estimators": 1, "bench": 2}
TYPES_OF_A_LOG = {"epochs", "errors", "log", "rig", "state", "trajectory"}
HEAVY = {"matplotlib", "pandas", "gtsam", "numba", "numpy", "scipy", "pyarrow"}
SOURCES = [path for folder in LEVEL for path in sorted((ROOT / folder).rglob("*.py"))]
SOURCES = [path for path in SOURCES if "__pycache__" not in path.parts]  # a profile's wrappers lie there


def imports(path: Path) -> Iterator[tuple[str, ...]]:
    """Every module a file imports, in dotted parts; our own start with "fathom"."""
    here = ("fathom", *path.relative_to(ROOT).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            module = (*base, *(node.module.split(".") if node.module else ()))
            yield from ((*module, alias.name) for alias in node.names)


def of_ours(path: Path) -> set[tuple[str, str]]:
    return {(parts[1], parts[2]) for parts in imports(path) if parts[0] == "fathom" and len(parts) > 2}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_downwards_and_relatively(path: Path) -> None:
    level = LEVEL[path.relative_to(ROOT).parts[0]]
    assert all(LEVEL[package] <= level for package, _ in of_ours(path))
    assert not {parts[0] for parts in imports(path)} & {*LEVEL, "results", "tests"}
    absolute = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom) and not n.level]
    assert not [node.module for node in absolute if (node.module or "").split(".")[0] == "fathom"]


@pytest.mark.parametrize("path", sorted((ROOT / "estimators").glob("*.py")), ids=lambda path: path.name)
def test_estimators_know_only_the_types_of_a_log(path: Path) -> None:
    assert {module for package, module in of_ours(path) if package == "datasets"} <= TYPES_OF_A_LOG


def test_the_walk_sees_relative_imports() -> None:
    assert ("datasets", "trajectory") in of_ours(ROOT / "bench" / "run.py")
    assert ("bench", "metrics") in of_ours(ROOT / "bench" / "run.py")


def test_the_command_line_imports_nothing_heavy_at_its_top() -> None:
    tree = ast.parse((ROOT / "bench" / "cli.py").read_text())
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    named = {alias.name for node in top for alias in node.names if isinstance(node, ast.Import)}
    named |= {node.module or "" for node in top if isinstance(node, ast.ImportFrom)}
    assert not {name.split(".")[0] for name in named} & HEAVY
    assert not [node for node in top if isinstance(node, ast.ImportFrom) and node.level]
