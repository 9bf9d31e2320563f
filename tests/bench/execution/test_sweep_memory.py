"""A sweep of any length needs no more memory than its plan and its table: what runs leave goes to the disk at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SWEEP = """
import resource, sys
from pathlib import Path
from fathom.bench.experiment.plan import Experiment
from fathom.bench.execution.sweep import run_experiment

def peak_kb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "darwin" else 1)

def sweep(runs):
    plan = {
        "name": f"t{runs}",
        "logs": [{"scenario": {"mission": "lawnmower", "duration_s": 20}}],
        "estimators": [{"name": "eskf"}],
        "seeds": runs,
        "scores": {"score_period_s": 0.05},
    }
    rows = run_experiment(Experiment.from_dict(plan), out=sys.argv[1], jobs=2)
    assert (rows["status"] == "done").all(), rows["cause"].tolist()
    files = Path(sys.argv[1], f"t{runs}", "trajectories").iterdir()
    return peak_kb(), sum(file.stat().st_size for file in files) / 1024 / runs

if __name__ == "__main__":
    sweep(20), sweep(21)  # what is kept once for all sweeps
    few_kb, _ = sweep(22)
    many_kb, files_kb = sweep(102)
    print((many_kb - few_kb) / 80, files_kb)
"""


@pytest.mark.slow
def test_the_parents_memory_grows_by_a_runs_plan_and_row_and_not_by_its_trajectories(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SWEEP, str(tmp_path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=900).stdout
    grown_kb, files_kb = map(float, printed.split())
    # a plan and a row take some 10 kB, and what the allocator keeps is spread over eighty runs: far below what
    # holding on to what a run sends would take
    assert grown_kb < files_kb / 2
