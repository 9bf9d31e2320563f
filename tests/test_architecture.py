"""The tree is the architecture: rooms, floors, downward imports; and `fathom --help` loads nothing heavy."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEVEL = {"datasets": 0, "estimators": 1, "bench": 2}
TYPES_OF_A_LOG = {"compiling", "epochs", "errors", "log", "quantities", "rig", "rotations", "state"}
TYPES_OF_A_LOG |= {"imu_time", "notes", "trajectory"}
HEAVY = {"matplotlib", "pandas", "gtsam", "numba", "numpy", "scipy", "pyarrow"}
SOURCES = [path for folder in LEVEL for path in sorted((ROOT / folder).rglob("*.py"))]
SOURCES = [path for path in SOURCES if "__pycache__" not in path.parts]
FOLDERS = sorted({path.parent for path in SOURCES})
TOP = ROOT / "bench" / "fathom"
"""Holds the `__init__` of the package `fathom` itself, which has no folder of its own at the top."""
MOST_MODULES = 16
"""In one folder; more cannot be taken in at a glance."""
MOST_FLOORS = 10
FRONTS = {"estimators.registry", "estimators.batch", "bench.output.present"}
"""Modules that gather a folder and those below it, as `__init__` does: a floor of their own, above both."""


@cache
def imports(path: Path) -> tuple[tuple[str, ...], ...]:
    """Every module a file imports, in dotted parts; our own start with "fathom"."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[str, ...]]:
    here = ("fathom", *path.relative_to(ROOT).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            module = (*base, *(node.module.split(".") if node.module else ()))
            yield from ((*module, alias.name) for alias in node.names)


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in SOURCES}


def modules_of_ours(path: Path) -> set[str]:
    """The modules of ours that a file imports, at its top or later."""
    named = {".".join(parts[1:]) for parts in imports(path) if parts[0] == "fathom"}
    return {name if name in MODULES else name.rpartition(".")[0] for name in named} & MODULES.keys() - {name_of(path)}


def room_of(module: str) -> str:
    """The folder that a module stands in; a folder's front is a room of its own."""
    path = MODULES[module]
    folder = ".".join(path.relative_to(ROOT).parts[:-1])
    return f"{folder} (front)" if path.name == "__init__.py" or module in FRONTS else folder


def rooms() -> dict[str, set[str]]:
    """Which rooms each room imports."""
    graph: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        found = {room_of(other) for other in modules_of_ours(path)}
        graph.setdefault(room_of(module), set()).update(found - {room_of(module)})
    return graph


def floors(graph: Mapping[str, Iterable[str]]) -> dict[str, int]:
    """How high each node stands: one above the highest that it imports."""
    height: dict[str, int] = {}
    for node in TopologicalSorter(graph).static_order():
        height[node] = 1 + max((height[other] for other in graph.get(node, ())), default=0)
    return height


def of_ours(path: Path) -> set[tuple[str, str]]:
    return {(parts[1], parts[2]) for parts in imports(path) if parts[0] == "fathom" and len(parts) > 2}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_downwards_and_relatively(path: Path) -> None:
    level = LEVEL[path.relative_to(ROOT).parts[0]]
    assert all(LEVEL[package] <= level for package, _ in of_ours(path))
    assert not {parts[0] for parts in imports(path)} & {*LEVEL, "results", "tests"}
    absolute = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom) and not n.level]
    assert not [node.module for node in absolute if (node.module or "").split(".")[0] == "fathom"]


@pytest.mark.parametrize("path", sorted((ROOT / "estimators").rglob("*.py")), ids=lambda path: path.name)
def test_estimators_know_only_the_types_of_a_log(path: Path) -> None:
    assert {module for package, module in of_ours(path) if package == "datasets"} <= TYPES_OF_A_LOG


def test_no_module_imports_itself_by_way_of_others() -> None:
    floors({module: modules_of_ours(path) for module, path in MODULES.items()})


def test_rooms_stand_on_few_floors_without_a_circle() -> None:
    height = floors(rooms())
    assert max(height.values()) <= MOST_FLOORS, height


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_folder_holds_more_than_can_be_taken_in(folder: Path) -> None:
    assert len(list(folder.glob("*.py"))) <= MOST_MODULES


def test_every_folder_is_installed() -> None:
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    names = {".".join(("fathom", *folder.relative_to(ROOT).parts)) for folder in FOLDERS if folder != TOP}
    assert {"fathom", *names} <= set(packages)


def test_gtsam_is_imported_in_one_folder_only() -> None:
    having = {room_of(name) for name, path in MODULES.items() if any(parts[0] == "gtsam" for parts in imports(path))}
    assert having == {"estimators.graph"}


@pytest.mark.parametrize("path", sorted((ROOT / "tests" / "estimators").rglob("*.py")), ids=lambda path: path.name)
def test_tests_of_estimators_do_without_the_harness(path: Path) -> None:
    assert not [parts for parts in imports(path) if parts[:2] == ("fathom", "bench")]


@pytest.mark.parametrize("path", sorted((ROOT / "tests").rglob("test_*.py")), ids=lambda path: path.name)
def test_no_test_module_imports_another(path: Path) -> None:
    assert not [parts for parts in imports(path) if parts[0].startswith("test_")]


def test_the_walk_sees_relative_imports() -> None:
    assert "datasets.trajectory" in modules_of_ours(ROOT / "bench" / "execution" / "drive.py")
    assert "bench.metrics.scoring" in modules_of_ours(ROOT / "bench" / "execution" / "worker.py")


def test_the_walk_sees_a_circle() -> None:
    with pytest.raises(CycleError):
        floors({"a": {"b"}, "b": {"c"}, "c": {"a"}})


def test_the_command_line_imports_nothing_heavy_at_its_top() -> None:
    for path in sorted((ROOT / "bench" / "cli").glob("*.py")):
        tree = ast.parse(path.read_text())
        top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        named = {alias.name for node in top for alias in node.names if isinstance(node, ast.Import)}
        named |= {node.module or "" for node in top if isinstance(node, ast.ImportFrom) and not node.level}
        assert not {name.split(".")[0] for name in named} & HEAVY
        assert not [node for node in top if isinstance(node, ast.ImportFrom) and node.level > 1]


def constants(path: Path) -> Iterator[tuple[str, bool]]:
    """Every numeric constant of a module, and whether a docstring or a comment (above it or its block) explains it."""
    lines, body = path.read_text(encoding="utf-8").splitlines(), ast.parse(path.read_text(encoding="utf-8")).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None or not holds_a_number(node.value):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        parts = [part for target in targets for part in (target.elts if isinstance(target, ast.Tuple) else [target])]
        named = [part.id for part in parts if isinstance(part, ast.Name) and part.id.lstrip("_").isupper()]
        if not named or len(named) < len(parts):
            continue
        above = next((line for line in lines[node.lineno - 2 :: -1] if not re.match(r"[A-Z_, ]+ = ", line)), "")
        beside = "\n".join(lines[node.lineno - 1 : node.end_lineno])
        said = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and type(after.value.value) is str
        yield ", ".join(named), said or "#" in beside or above.startswith("#")


def holds_a_number(value: ast.expr) -> bool:
    """Whether a value is made of numbers: 3, -1, 1 << 20, (4.2, 2.7), DEGREE / 60, {"imu": 0.1}, np.arange(0, 3)."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    if isinstance(value, ast.UnaryOp):
        return holds_a_number(value.operand)
    if isinstance(value, ast.BinOp):
        return any(holds_a_number(side) for side in (value.left, value.right))
    if isinstance(value, ast.Tuple | ast.List):
        return bool(value.elts) and all(map(holds_a_number, value.elts))
    if isinstance(value, ast.Dict):
        return bool(value.values) and all(map(holds_a_number, value.values))
    return isinstance(value, ast.Call) and bool(value.args) and all(map(holds_a_number, value.args))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_number_at_the_top_of_a_module_has_a_reason(path: Path) -> None:
    assert not [name for name, has_a_reason in constants(path) if not has_a_reason]


def test_a_number_without_a_reason_is_seen(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text(
        'A = 3\nB = 2.5\n"""m/s, from the data sheet."""\nC = 1 << 20  # bytes\nD = (1.0, -2.0)\nE = "x"\n'
    )
    assert dict(constants(module)) == {"A": False, "B": True, "C": True, "D": False}
