"""Every benchmark still runs. They are timed, too, where pytest-benchmark is asked to: see docs/timing.md."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import fathom.bench.timing.benchmarks as module
import pytest
from fathom.bench.timing.benchmarks import BENCHMARKS, Benchmark


@pytest.mark.parametrize("each", BENCHMARKS, ids=lambda each: each.name)
def test_its_work_can_be_done(each: Benchmark, inputs: Path, benchmark: Any) -> None:
    work = each.prepare(inputs)
    work.do()  # compiles
    benchmark.group = each.group
    benchmark.extra_info |= {"name": each.name, "unit": each.unit, "units": work.units}
    benchmark(work.do)
    assert work.units > 0


def test_every_part_that_could_become_slow_has_a_benchmark() -> None:
    assert len({each.name for each in BENCHMARKS}) == len(BENCHMARKS)
    groups = {"estimators", "preintegration", "simulator", "scores", "loaders", "harness", "report"}
    assert {each.group for each in BENCHMARKS} == groups
    assert {each.unit for each in BENCHMARKS} >= {"IMU sample", "reading", "keyframe"}
    assert {each.group for each in BENCHMARKS if each.short} == groups - {"report"}


def test_a_revision_that_lacks_something_lacks_one_benchmark_only() -> None:
    """At its top the file imports nothing of ours: it is loaded into other revisions."""
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    assert not [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.level]
