"""The documentation: examples and commands are valid, links resolve, and the equations that code cites exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from fathom.bench.cli.app import app
from fathom.bench.experiment.plan import Experiment
from fathom.datasets.described.description import check_description
from fathom.datasets.errors import DatasetError
from fathom.datasets.simulated.scenario import Scenario
from typer.main import get_command

ROOT = Path(__file__).resolve().parents[1]
NEEDS_ITS_PACKAGE = "your-own-estimator.md"
"""This page's experiment names an estimator that it makes; `test_own_estimator` installs that, and runs the page."""

PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").glob("*.md")) if p.name != NEEDS_ITS_PACKAGE)]
ALL_PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
CITATION = re.compile(r"conventions\.md((?:,? (?:and |to )?\(\d+\))+)")
"""As in "docs/conventions.md (4), (5) and (6)"."""
WINDOW = ROOT / "estimators" / "window"
"""Its modules cite the equations of docs/window.md, as in "eq. (5) to (8)"."""
WINDOW_CITATION = re.compile(r"\beq\. \((\d+)\)(?: to \((\d+)\))?")
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
    """Return the numbers of the equations of conventions.md, each at the end of a line within a block."""
    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```\n(.*?)```", text, re.DOTALL)
    return [int(number) for block in blocks for number in re.findall(r"\((\d+)\)$", block, re.MULTILINE)]


def window_equations() -> list[int]:
    """Return the numbers of the equations of window.md, each at the end of an indented line."""
    text = (ROOT / "docs" / "window.md").read_text(encoding="utf-8")
    return [int(number) for number in re.findall(r"^ {4}.* \((\d+)\)$", text, re.MULTILINE)]


def cited(text: str) -> set[int]:
    """Return the numbers that a text cites, which may run over a line's end."""
    joined = re.sub(r"\s+(?:# )?", " ", text)
    return {int(number) for group in CITATION.findall(joined) for number in re.findall(r"\d+", group)}


def cited_of_window(text: str) -> set[int]:
    """Return the numbers that a text cites by "eq.", which may run over a line's end."""
    joined = re.sub(r"\s+(?:# )?", " ", text)
    return {int(number) for pair in WINDOW_CITATION.findall(joined) for number in pair if number}


def commands() -> list[tuple[str, str]]:
    """Return the page and the text of each `fathom` command, in blocks and within sentences."""
    found = []
    for page in ALL_PAGES:
        text = page.read_text(encoding="utf-8").replace("\n            [", " [")  # an option on the next line
        blocks = re.findall(r"^(?:here\$ )?(fathom .+)$", text, re.MULTILINE)
        inline = re.findall(r"`(fathom [^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
        found += [(page.name, " ".join(re.split(r"#| {3,}", command)[0].split())) for command in blocks + inline]
    return list(dict.fromkeys(found))


def unknown_of(command: str) -> list[str]:
    """Return the verbs and the options in a command that `fathom` does not know."""
    words = command.split()[1:]
    one: Any = get_command(app)
    while hasattr(one, "commands") and words and not words[0].startswith("-") and words[0] != "VERB":
        names = words.pop(0).split("|")
        lacking = [name for name in names if name not in one.commands]
        if lacking:
            return lacking
        if len(names) > 1:
            return []
        one = one.commands[names[0]]
    known = {option for param in one.params for option in param.opts} | {"--help"}
    return [option for option in re.findall(r"(?<![\w-])--?[a-z][a-z-]*", " ".join(words)) if option not in known]


SOURCES = sorted(path for room in ("bench", "datasets", "estimators") for path in (ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("numbers", [equations(), window_equations()], ids=["conventions", "window"])
def test_every_equation_has_a_number_of_its_own(numbers: list[int]) -> None:
    assert numbers
    assert len(numbers) == len(set(numbers))
    assert set(numbers) == set(range(1, len(numbers) + 1))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_equation_that_code_cites_is_on_the_page(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert cited(text) <= set(equations())
    assert not re.search(r"\bDESIGN\b|\bSTYLE\.md|\bHOUSE\.md", text)  # not in the repository
    assert not re.search(r"[(\[]eq\. ?\d", text)  # of which page?


@pytest.mark.parametrize("path", sorted(WINDOW.glob("*.py")), ids=lambda path: path.name)
def test_every_equation_that_the_window_cites_is_on_its_page(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    numbers = cited_of_window(text)
    assert numbers <= set(window_equations())
    assert not numbers or "docs/window.md" in text  # of which page?


def test_a_citation_of_an_equation_that_is_not_there_is_seen() -> None:
    assert cited_of_window("eq. (5)\n    # to (12); eq. (99)") == {5, 12, 99}
    assert {1, 10} <= set(window_equations())
    assert not {5, 12, 99} <= set(window_equations())
    assert cited("see docs/conventions.md (4), (6)\n    and (999).") == {4, 6, 999}
    assert not cited("see docs/conventions.md (4), (999)") <= set(equations())


@pytest.mark.parametrize(("page", "command"), commands())
def test_every_command_exists(page: str, command: str) -> None:
    assert not unknown_of(command), page


def test_a_command_that_does_not_exist_is_seen() -> None:
    assert len(commands()) > 40
    assert unknown_of("fathom timing --cost") == ["--cost"]
    assert unknown_of("fathom timing budgets|costs") == ["costs"]
    assert unknown_of("fathom runs smoke") == ["runs"]
    assert unknown_of("fathom run smoke [--data DIR] [--job N]") == ["--job"]


def test_the_readme_lists_every_verb_in_the_order_of_help() -> None:
    block = re.search(r"## Use\n\n```\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert block is not None
    top: Any = get_command(app)
    assert [line.split()[1] for line in block[1].splitlines()] == list(top.commands)
    verbs = re.findall(r"([a-z]+)(?: [A-Z.]+)?(?:\||$)", block[1].splitlines()[-1].removeprefix("fathom timing "))
    assert verbs == list(top.commands["timing"].commands)


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
    assert not [folder for folder in folders if not re.search(rf"`{folder}`|\b{folder}/", said)]
