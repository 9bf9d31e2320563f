"""What the documentation shows can be used as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from fathom.bench.experiment.plan import Experiment
from fathom.datasets.described.description import check_description
from fathom.datasets.errors import DatasetError
from fathom.datasets.simulated.scenario import Scenario

ROOT = Path(__file__).resolve().parents[1]
NEEDS_ITS_PACKAGE = "your-own-estimator.md"
"""This page's experiment names an estimator that it makes; `test_own_estimator` installs that, and runs the page."""

PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").glob("*.md")) if p.name != NEEDS_ITS_PACKAGE)]
NOISE = (
    "{gyro_density: 1.0e-4, accel_density: 1.0e-3, gyro_walk: 1.0e-6, accel_walk: 1.0e-5, "
    "gyro_bias_sigma: 1.0e-3, accel_bias_sigma: 0.02}"
)


def examples() -> list[tuple[str, str]]:
    """Return where each YAML example stands, and its text."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in re.finditer(r"```yaml\n(.*?)```", text, re.DOTALL):
            line = text.count("\n", 0, block.start()) + 1
            found.append((f"{page.name}:{line}", block[1]))
    return found


def check(text: str, where: str) -> None:
    """Check an example as what its keys say it is: a log.yaml, an experiment, or a scenario."""
    content = yaml.safe_load(text)
    if "streams" in content:
        check_description(content, where)
    elif "estimators" in content:
        Experiment.from_dict({"name": "example"} | content, where)
    else:
        Scenario.from_dict(content, where)


@pytest.mark.parametrize(("where", "text"), [pytest.param(*each, id=each[0]) for each in examples()])
def test_every_example_is_valid(where: str, text: str) -> None:
    if text.rstrip().endswith("…"):  # the rest of a log.yaml is left out: its beginning must be right
        beginning = text.replace("    …\n", "")
        missing = f"    accel: {{columns: [x, y, z], unit: m/s^2}}\n    noise: {NOISE}\n"
        check(beginning + missing, where)
    else:
        check(text.replace("{...}", NOISE), where)


def test_the_examples_are_found_and_a_wrong_one_is_refused() -> None:
    texts = dict(examples())
    assert {where.split(":")[0] for where in texts} >= {"your-own-log.md", "formats.md", "ablation.md"}
    whole = next(text for where, text in texts.items() if where.startswith("your-own-log.md"))
    with pytest.raises(DatasetError, match="did you mean 'table'"):
        check(whole.replace("table: {file: ins.txt", "tabel: {file: ins.txt"), "here")
