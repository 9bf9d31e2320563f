"""The inputs of the benchmarks, and what pytest-benchmark writes: small, with machine and versions, without a name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fathom.bench.store import provenance
from fathom.bench.timing.benchmarks import BENCHMARKS, write_inputs
from fathom.bench.timing.command import machine

KEPT = ("min", "q1", "median", "q3", "rounds", "iterations")


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
    """Keep what a baseline needs: each benchmark's quartiles, per call and per unit."""
    small = []
    for each in output_json["benchmarks"]:
        stats = {name: each["stats"][name] for name in KEPT}
        units = each["extra_info"]["units"]
        per_unit = {"unit": each["extra_info"]["unit"], "units": units, "median_us": 1e6 * stats["median"] / units}
        small.append(
            {"group": each["group"], "name": each["extra_info"]["name"], "per_unit": per_unit, "stats_s": stats}
        )
    output_json["benchmarks"] = sorted(small, key=lambda each: (each["group"], each["name"]))
    output_json["commit_info"] = {"id": output_json["commit_info"].get("id")}
