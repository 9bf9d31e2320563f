"""A simulated dive of 60 s keeps its numbers; when they move, the commit says why.

`python tests/bench/test_golden.py` writes them anew.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.metrics.scoring import scores
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import create

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "dive_60s.json"
RUNS = {
    "dead-reckoning": ("dead-reckoning", {}),
    "eskf": ("eskf", {}),
    "fls": ("fls", {"lag_s": 3.0}),
    "fls preintegrated": ("fls", {"lag_s": 3.0, "dvl": ["preintegrated-loose"]}),
}
SHOWN = ("ate_rmse_m", "heading_rmse_deg", "velocity_rmse_m_s", "drift_end_percent", "rpe_rmse_m", "nees_position")


def dive(label: str) -> dict[str, dict[str, float | None]]:
    log = simulate(Scenario(mission="yo-yo", duration_s=60.0, imu="tactical"), seed=1)
    name, options = RUNS[label]
    outputs = run_log(log, create(name, **options)).outputs
    return {output: {k: v for k, v in scores(log, t).items() if k in SHOWN} for output, t in outputs.items()}


@pytest.mark.parametrize("label", RUNS)
def test_a_dive_keeps_its_numbers(label: str) -> None:
    expected = json.loads(GOLDEN.read_text())[label]
    found = dive(label)
    assert found.keys() == expected.keys()
    for output, numbers in expected.items():
        for score, number in numbers.items():
            assert found[output][score] == (number and pytest.approx(number, rel=1e-4)), (output, score)


@pytest.mark.parametrize("label", ["eskf", "fls"])
def test_the_same_log_gives_the_same_bits(label: str) -> None:
    assert dive(label) == dive(label)


if __name__ == "__main__":
    GOLDEN.parent.mkdir(exist_ok=True)
    GOLDEN.write_text(json.dumps({label: dive(label) for label in RUNS}, indent=2) + "\n")
