"""`import fathom` alone is quick, and its three packages are there when they are asked for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

IMPORT = """
import sys
from importlib.util import module_from_spec, spec_from_file_location

import fathom

# from this file, however the package was installed
spec = spec_from_file_location("fathom", sys.argv[1], submodule_search_locations=list(fathom.__path__))
fathom = sys.modules["fathom"] = module_from_spec(spec)
spec.loader.exec_module(fathom)
"""


def run(code: str) -> str:
    file = Path(__file__).parents[2] / "bench" / "fathom" / "__init__.py"
    done = subprocess.run([sys.executable, "-c", IMPORT + code, file], capture_output=True, text=True, check=True)
    return done.stdout


def test_the_packages_are_reached_from_the_package_alone() -> None:
    code = "print(fathom.datasets.Log.__name__, fathom.estimators.create.__name__, fathom.bench.run_log.__name__)"
    assert run(code).split() == ["Log", "create", "run_log"]


def test_importing_the_package_alone_imports_nothing_heavy() -> None:
    code = "print(*(name for name in sys.modules if name.split('.')[0] in ('numpy', 'numba', 'pandas', 'pydantic')))"
    assert run(code).split() == []
    assert run("print(*(name for name in sys.modules if name.startswith('fathom.')))").split() == []


def test_what_there_is_is_listed_and_anything_else_is_an_attribute_error() -> None:
    assert {"bench", "datasets", "estimators", "__version__"} <= set(run("print(*dir(fathom))").split())
    assert run("print(hasattr(fathom, 'nothing'))").strip() == "False"
