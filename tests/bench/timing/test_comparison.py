"""No change gives no alarm, a slowdown is caught, and the other revision leaves nothing behind."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fathom.bench.timing import comparison, revision
from fathom.bench.timing.benchmarks import BENCHMARKS
from fathom.bench.timing.comparison import FULL, SHORT, Effort, ratio_of, verdict_of
from fathom.bench.timing.printing import TimingError

ROOT = Path(__file__).resolve().parents[3]
LIMIT = 1.10


# --- the verdict -----------------------------------------------------------------------------------------------------


def noisy(rng: np.random.Generator, effort: Effort, slower: float) -> np.ndarray:
    """Times on a busy machine: one process differs from another by 3 %, a turn in three is disturbed by up to 60 %."""
    of_process = np.exp(rng.normal(0, 0.03, (effort.pairs, 1, 4)))
    of_process[..., 1], of_process[..., 3] = of_process[..., 0], of_process[..., 2]
    drift = np.exp(rng.normal(0, 0.3, (effort.pairs, effort.rounds, 1)))  # of a block of turns: common to both
    shape = (effort.pairs, effort.rounds, 4)
    disturbed = 1 + (rng.random(shape) < 1 / 3) * rng.uniform(0, 0.6, shape)
    return of_process * drift * disturbed * np.array([slower, slower, 1, 1])


def alarm(rng: np.random.Generator, effort: Effort, slower: float) -> bool:
    """Measure, and again twice as much where the ratio is beyond the limit, as `compare` does."""
    for each in (effort, effort.doubled()):
        ratio, low, high = ratio_of(noisy(rng, each, slower), 0.995)
        if ratio <= LIMIT:
            return False
    return verdict_of(ratio, low, high, LIMIT) == "slower"


@pytest.mark.parametrize("effort", [FULL, SHORT], ids=["full", "short"])
def test_on_a_busy_machine_no_change_gives_no_alarm_and_20_percent_is_caught(effort: Effort) -> None:
    rng = np.random.default_rng(1)
    assert not any(alarm(rng, effort, 1.0) for _ in range(100))
    assert np.mean([alarm(rng, effort, 1.2) for _ in range(30)]) > 0.75


def test_the_interval_holds_what_is_true_about_as_often_as_its_level() -> None:
    """Few pairs make a bootstrap bold; 10 pairs at 95 % are right in nine of ten cases or more."""
    rng, inside = np.random.default_rng(2), 0
    for k in range(100):
        _, low, high = ratio_of(noisy(rng, Effort(10, 4), 1.05), 0.95, seed=k)
        inside += low <= 1.05 <= high
    assert inside >= 85


def test_a_disturbed_turn_of_each_process_changes_nothing() -> None:
    seconds = np.full((3, 3, 4), 1.0)
    seconds[..., :2] = 1.5
    seconds[:, 0, :2], seconds[:, 1, 1] = 100.0, 100.0
    assert ratio_of(seconds, 0.99)[0] == pytest.approx(1.5)


def test_verdicts() -> None:
    assert verdict_of(1.2, 1.11, 1.3, LIMIT) == "slower"
    assert verdict_of(1.2, 1.09, 1.3, LIMIT) == "slower?"
    assert verdict_of(1.0, 0.9, 1.3, LIMIT) == "same"
    assert verdict_of(0.8, 0.7, 0.9, LIMIT) == "faster"


# --- taking turns ----------------------------------------------------------------------------------------------------


class Clockwork:
    """A worker whose every call takes what it is told."""

    def __init__(self, seconds: float, calls: list[float]) -> None:
        self.seconds, self.calls = seconds, calls

    def send(self, **command: Any) -> None:
        return

    def receive(self) -> dict[str, Any]:
        return {"units": 10, "cpu_s": self.seconds}

    def ask(self, **command: Any) -> dict[str, Any]:
        self.calls.append(self.seconds)
        return self.receive()


def test_both_sides_take_turns_and_are_not_confused(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[float] = []

    @contextmanager
    def started(*_: object) -> Iterator[list[Clockwork]]:
        yield [Clockwork(0.06, calls), Clockwork(0.04, calls)]

    monkeypatch.setattr(comparison, "started", started)
    each = BENCHMARKS[0]
    rows = comparison._measure(None, None, [each], {each.name: 1}, Effort(1, 2), LIMIT, 0.95, lambda *_: None)  # type: ignore[arg-type]
    assert calls == [0.06, 0.04, 0.04, 0.06, 0.04, 0.06, 0.06, 0.04]  # A B B A, then B A A B
    row = rows[each.name]
    assert (row.ratio, row.now_us, row.then_us) == pytest.approx((1.5, 6000, 4000))
    assert row.verdict == "slower"


# --- the other revision ----------------------------------------------------------------------------------------------


def git(folder: Path, *arguments: str) -> str:
    who = ["-c", "user.name=A", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *who, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout of two commits, of which the second changes nothing."""
    folder = tmp_path / "repository"
    for name in ("bench", "datasets", "estimators"):
        (folder / name).mkdir(parents=True)
        for source in (ROOT / name).glob("*.py"):
            shutil.copy2(source, folder / name)
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy2(ROOT / name, folder)
    git(folder, "init", "-q")
    git(folder, "add", ".")
    git(folder, "commit", "-q", "-m", "Begin")
    git(folder, "commit", "-q", "-m", "Change nothing", "--allow-empty")
    monkeypatch.setattr(revision, "ROOT", folder)
    return folder


def test_a_worktree_is_gone_afterwards_even_after_ctrl_c(repository: Path, tmp_path: Path) -> None:
    seen = []

    def interrupted() -> None:
        with revision.checked_out("HEAD~1", tmp_path) as tree:
            seen.append(tree)
            assert (tree.root / "bench" / "errors.py").is_file()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert seen[0].python == Path(sys.executable)
    assert git(repository, "worktree", "list").count("\n") == 1
    assert not seen[0].root.exists()


def test_the_worktree_of_a_comparison_that_was_killed_is_removed_by_the_next(repository: Path, tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    left = tmp_path / "left" / f"{revision.PREFIX}{dead.pid}"
    alive = tmp_path / "alive" / f"{revision.PREFIX}{os.getppid()}"
    for path in (left, alive):
        git(repository, "worktree", "add", "-q", "--detach", str(path))
    with revision.checked_out("HEAD", tmp_path):
        assert alive.exists()
        assert not left.exists()


def test_the_folder_that_leads_to_a_trees_packages_writes_nothing_into_the_tree(tmp_path: Path) -> None:
    """`fathom` is a package of its own, in a folder of `bench`, and the other three stand in it."""
    tree = tmp_path / "tree"
    for package, word in (("bench/fathom", "top"), ("bench", "bench"), ("datasets", "datasets")):
        (tree / package).mkdir(parents=True, exist_ok=True)
        (tree / package / "__init__.py").write_text(f"word = {word!r}\n")
    where = '{"fathom" = "bench/fathom", "fathom.bench" = "bench", "fathom.datasets" = "datasets"}'
    (tree / "pyproject.toml").write_text(f"[tool.setuptools]\npackage-dir = {where}\n")
    before = sorted(tree.rglob("*"))
    side = revision.Tree("now", tree, Path(sys.executable), "")
    for name in ("first", "second"):
        folder = side.packages(tmp_path / name)
        code = "import fathom, fathom.bench, fathom.datasets as d; print(fathom.word, fathom.bench.word, d.word)"
        command = [sys.executable, "-B", "-S", "-c", code]
        said = subprocess.run(
            command, env={"PYTHONPATH": str(folder)}, capture_output=True, text=True, check=True
        ).stdout
        assert said.split() == ["top", "bench", "datasets"]
    assert sorted(tree.rglob("*")) == before


def test_an_unknown_revision_is_refused(repository: Path, tmp_path: Path) -> None:
    with pytest.raises(TimingError, match="nosuch: no such revision"), revision.checked_out("nosuch", tmp_path):
        pass


def test_dependencies_are_shared_where_what_is_imported_is_pinned_alike(repository: Path) -> None:
    usual = revision._dependencies(repository)
    assert usual[1]["numpy"]
    constraints = repository / "constraints.txt"
    pins = constraints.read_text(encoding="utf-8")
    constraints.write_text(pins.replace("ruff==", "ruff==99."), encoding="utf-8")
    assert revision._dependencies(repository) == usual  # a tool, which nothing of ours imports
    constraints.write_text(pins.replace("llvmlite==", "llvmlite==99."), encoding="utf-8")
    assert revision._dependencies(repository) != usual  # numba asks for it


def test_a_process_that_dies_is_an_error_that_names_its_side(tmp_path: Path) -> None:
    tree = revision.Tree("then", tmp_path, Path(sys.executable), "")
    with revision.started(revision.Side(tree, tmp_path, tmp_path)) as (worker,):  # no packages in it
        with pytest.raises(TimingError, match=r"then: its process died \(exit code 1\)"):
            worker.ask(prepare="ATE")
        with pytest.raises(TimingError):
            worker.ask(prepare="ATE")


def test_a_benchmark_that_the_other_revision_lacks_is_new_and_one_that_we_lack_is_broken() -> None:
    found = comparison.Comparison("now", "then", "", LIMIT, 0.95, ())
    new, broken = (comparison.Compared("a", "b", "c", verdict) for verdict in ("new", "broken"))
    assert not replace(found, rows=(new,)).failed
    assert replace(found, rows=(new, broken)).failed


SPIN = """

def _slower(work):
    from time import process_time
    def spinning(*arguments, **options):
        started = process_time()
        result = work(*arguments, **options)
        until = process_time() + {share} * (process_time() - started)
        while process_time() < until:
            pass
        return result
    return spinning

ate = _slower(ate)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("share", "status"), [(0.0, 0), (0.3, 1)], ids=["no change", "30 % slower"])
def test_a_planted_slowdown_of_a_score_ends_the_command_with_1(tmp_path: Path, share: float, status: int) -> None:
    folder = tmp_path / "repository"
    ignored = shutil.ignore_patterns(".git", "build", ".venv", "results", ".*_cache", "__pycache__")
    shutil.copytree(ROOT, folder, ignore=ignored)
    git(folder, "init", "-q")
    git(folder, "add", ".")
    git(folder, "commit", "-q", "-m", "Begin")
    if share:
        with (folder / "bench" / "metrics" / "__init__.py").open("a", encoding="utf-8") as file:
            file.write(SPIN.format(share=share))
    packages = tmp_path / "packages" / "fathom"
    packages.mkdir(parents=True)
    for name in ("bench", "datasets", "estimators"):
        (packages / name).symlink_to(folder / name)
    command = [sys.executable, "-m", "fathom.bench.cli.app", "timing", "against", "HEAD", "--short", "--only", "ATE"]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(packages.parent)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert ("slower or broken: ATE" in done.stdout) == bool(share), done.stdout
