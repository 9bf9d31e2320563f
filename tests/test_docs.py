"""The examples of the documentation are valid, its links lead somewhere, and the equations that code cites exist."""

from __future__ import annotations

import ast
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
ALL_PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
CITATION = re.compile(r"conventions\.md((?:,? (?:and |to )?\(\d+\))+)")
"""As in "docs/conventions.md (4), (5) and (6)"."""
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


def equations() -> list[int]:
    """Return the numbers of the equations of the page, each at the end of a line within a block."""
    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```\n(.*?)```", text, re.DOTALL)
    return [int(number) for block in blocks for number in re.findall(r"\((\d+)\)$", block, re.MULTILINE)]


def cited(text: str) -> set[int]:
    """Return the numbers that a text cites, which may run over a line's end."""
    joined = re.sub(r"\s+(?:# )?", " ", text)
    return {int(number) for group in CITATION.findall(joined) for number in re.findall(r"\d+", group)}


SOURCES = sorted(path for room in ("bench", "datasets", "estimators") for path in (ROOT / room).rglob("*.py"))


def test_every_equation_has_a_number_of_its_own() -> None:
    numbers = equations()
    assert len(numbers) == len(set(numbers))
    assert set(numbers) == set(range(1, len(numbers) + 1))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_equation_that_code_cites_is_on_the_page(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert cited(text) <= set(equations())
    assert not re.search(r"\bDESIGN\b|\bSTYLE\.md|\bHOUSE\.md", text)  # not in the repository


def test_a_citation_of_an_equation_that_is_not_there_is_seen() -> None:
    assert cited("see docs/conventions.md (4), (6)\n    and (999).") == {4, 6, 999}
    assert not cited("see docs/conventions.md (4), (999)") <= set(equations())


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.name)
def test_every_link_of_a_page_leads_to_a_file(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
    local = [link for link in links if not re.match(r"[a-z]+:", link)]
    assert not [link for link in local if not (page.parent / link).exists()]


def test_the_index_lists_every_page() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - {"index.md"} <= set(
        re.findall(r"\((.+?\.md)\)", index)
    )


@pytest.mark.parametrize("package", ["bench/fathom", "bench", "datasets", "estimators"])
def test_each_package_says_in_some_ten_lines_what_lives_there(package: str) -> None:
    said = ast.get_docstring(ast.parse((ROOT / package / "__init__.py").read_text(encoding="utf-8"))) or ""
    assert 8 <= len(said.splitlines()) <= 16
    folders = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
    assert not [folder for folder in folders if f"`{folder}`" not in said]
