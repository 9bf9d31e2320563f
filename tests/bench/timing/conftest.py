"""The inputs of the benchmarks, and what pytest-benchmark writes: small, with machine and versions, without a name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fathom.bench.results.store import provenance
from fathom.bench.timing.benchmarks import BENCHMARKS, write_inputs
from fathom.bench.timing.printing import machine


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder, BENCHMARKS)
    return folder


def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict[str, Any]) -> None:
    machine_info.clear()
    machine_info |= machine() | {"versions": json.loads(provenance()["versions"])}


def pytest_benchmark_update_json(
    config: pytest.Config, benchmarks: list[dict[str, Any]], output_json: dict[str, Any]
) -> None:
    """Leave out every single time: the statistics are what a baseline needs, and `--benchmark-compare` reads."""
    for each in output_json["benchmarks"]:
        each["stats"].pop("data", None)
        each["params"] = None
    output_json["commit_info"] = {"id": output_json["commit_info"].get("id")}
