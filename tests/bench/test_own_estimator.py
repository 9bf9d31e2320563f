"""The tutorial's promise: fifty lines in a package of their own, joined by entry point, to a figure with error bars."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import fathom.bench
import pandas as pd
import pytest
import yaml

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your-own-estimator.md"
TEXT = PAGE.read_text(encoding="utf-8")
FIGURE = "figures/my-dive_again-ablation"
LONGEST_S = 300


def block(kind: str, holding: str) -> str:
    """Return the one block of this kind that holds some text, as on the page."""
    found = [text for text in re.findall(rf"```{kind}\n(.*?)```", TEXT, re.DOTALL) if holding in text]
    assert len(found) == 1
    return found[0]


def shortened(experiment: str) -> str:
    """Return the page's experiment over fewer seeds and a shorter log."""
    assert "seeds: 10" in experiment
    assert "duration_s: 240" in experiment
    return experiment.replace("seeds: 10", "seeds: 5").replace("duration_s: 240", "duration_s: 40")


def without_index() -> list[str]:
    """Return pip's option for building with the setuptools that is here, if that can build a wheel by itself."""
    try:
        is_able = tuple(int(part) for part in version("setuptools").split(".")[:2]) >= (70, 1)
    except PackageNotFoundError:
        is_able = False
    return ["--no-build-isolation"] if is_able else []


class Reader:
    """Somebody who follows the page, in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder, folder / "site"
        ours = str(Path(fathom.bench.__file__ or "").parents[2])
        self.environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(self.site), ours])}

    def write(self, name: str, text: str) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def call(self, *command: str) -> str:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def fathom(self, *arguments: str) -> str:
        return self.call("-m", "fathom.bench.cli.app", *arguments)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    """A reader who has installed the page's package: really, by pip, but for its dependencies, which are here."""
    reader = Reader(tmp_path_factory.mktemp("reader"))
    reader.write("complementary/pyproject.toml", block("toml", "fathom.estimators"))
    reader.write("complementary/complementary.py", block("python", "class ComplementaryFilter"))
    pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", *without_index())
    reader.call(*pip, "--target", str(reader.site), "./complementary")
    return reader


def test_the_estimator_on_the_page_is_at_most_fifty_lines() -> None:
    lines = [line for line in block("python", "class ComplementaryFilter").splitlines() if line.strip()]
    assert 30 < len(lines) <= 50
    assert max(map(len, lines)) <= 120


@pytest.mark.slow
def test_the_installed_package_joins_by_its_entry_point_with_its_options(reader: Reader) -> None:
    listed = reader.fathom("list", "estimators").splitlines()
    assert "complementary: level_s, heading_s, drift, sigma_deg, factors" in listed
    assert "complementary" not in {line.split(":")[0] for line in subprocess.run(
        [sys.executable, "-m", "fathom.bench.cli.app", "list", "estimators"], capture_output=True, text=True, check=True
    ).stdout.splitlines()}  # fmt: skip


@pytest.mark.slow
def test_following_the_page_ends_in_a_figure_with_error_bars_of_a_sane_estimator(reader: Reader) -> None:
    reader.write("dive.yaml", block("yaml", "surface_every_s").replace("duration_s: 260", "duration_s: 60"))
    reader.write("mine.yaml", shortened(block("yaml", "estimators:")))
    for line in block("sh", "fathom simulate").splitlines() + block("sh", "to_tum").splitlines():
        command = line.split(maxsplit=1)
        if command[0] == "fathom":
            reader.fathom(*command[1].split())
        else:
            reader.call("-c", line.split('"')[1])
    assert block("sh", "fathom run").strip() == "fathom run mine.yaml"
    reader.fathom("run", "mine.yaml", "--jobs", "2")

    results = reader.folder / "results" / "mine"
    assert f"results/mine/{FIGURE}.pdf" in TEXT
    for suffix in (".pdf", ".png"):
        assert (results / f"{FIGURE}{suffix}").stat().st_size > 5000
    paired = pd.read_csv(results / "paired.csv").query("log == 'my-dive again' and score == 'ate_rmse_m'")
    assert len(paired) == 3
    assert (paired["low"] < paired["high"]).all()  # the error bars

    table = pd.read_csv(results / "table.csv").set_index(["log", "label"])
    assert table["done"].tolist() == table["runs"].tolist()
    for log in ("my-dive", "my-dive again"):
        ate = table.loc[log, "ate_rmse_m"]
        assert ate["eskf"] < 1.02 * ate["complementary"]  # nobody beats the Kalman filter but by luck
    again = table.loc["my-dive again"]
    assert again.loc["eskf", "heading_rmse_deg"] < again.loc["complementary", "heading_rmse_deg"]
    assert again.loc["complementary", "ate_rmse_m"] < again.loc["dead-reckoning", "ate_rmse_m"]
    assert again.loc["complementary", "velocity_rmse_m_s"] < again.loc["dead-reckoning", "velocity_rmse_m_s"]
    assert 0 < again.loc["complementary", "nees_position"] < 3 * 3  # defined, and not overconfident


def test_every_yaml_block_on_the_page_is_taken_up_by_these_tests() -> None:
    blocks = [yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)]
    assert [set(each) >= {"logs", "estimators"} for each in blocks] == [False, True]
