"""`fathom timing` says which budgets are missed, and saves what it measured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fathom.bench.cli.app import app
from fathom.bench.timing import budget_rows, budgets, comparison
from fathom.bench.timing.budgets import Budget, Measured
from fathom.bench.timing.comparison import Compared, Comparison
from typer.testing import CliRunner


def lacking() -> Measured:
    raise ModuleNotFoundError("no oracle", name="evo")


def interrupted() -> Measured:
    raise KeyboardInterrupt


KEPT = Budget("kept", 2.0, True, lambda: Measured((2.0, 3.0, 9.0)))
MISSED = Budget("missed by far", 2.0, False, lambda: Measured((4.0,), "on a raft"), "the sea")


def test_every_budget_has_its_verdict_and_a_missed_one_its_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budget_rows, "BUDGETS", (KEPT, MISSED, Budget("lacking", 1.0, True, lacking)))
    done = CliRunner().invoke(app, ["timing", "budgets", "-o", str(tmp_path / "budgets.json")])
    assert done.exit_code == 0, done.output
    rows = json.loads((tmp_path / "budgets.json").read_text())["budgets"]
    assert [row["verdict"] for row in rows] == ["holds", "missed", "not measured"]
    assert rows[0]["values"] == [2.0, 3.0, 9.0]
    assert rows[1]["note"] == "on a raft; the sea"
    assert "evo is not installed" in rows[2]["note"]
    assert "node" not in json.loads((tmp_path / "budgets.json").read_text())["machine"]
    kept = next(line for line in done.output.splitlines() if "kept" in line)
    assert kept.split() == ["kept", "≥", "2", "3", "2", "–", "9", "holds"]


def test_strictly_a_missed_budget_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    for chosen, status in (((KEPT,), 0), ((KEPT, MISSED), 1)):
        monkeypatch.setattr(budget_rows, "BUDGETS", chosen)
        assert CliRunner().invoke(app, ["timing", "budgets", "--strict"]).exit_code == status


def test_a_row_is_printed_before_the_next_is_measured(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    seen = []

    def look() -> Measured:
        seen.append(capfd.readouterr().out)
        return Measured((1.0,))

    budgets.print_budgets((KEPT, Budget("looks", 1.0, True, look)), None, None)
    assert "holds" in seen[0].splitlines()[-1]


def test_a_budget_with_a_unit_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert budgets.print_budgets((Budget("an hour", 3600.0, False, lambda: Measured((60.0,)), unit="s"),), None, None)
    assert "≤ 3600 s" in (out := capsys.readouterr().out)
    assert "60 s" in out


@pytest.mark.parametrize(
    ("arguments", "verb"),
    [
        (["--against", "HEAD~1", "--short"], "fathom timing against REV"),
        (["--short", "--against=HEAD~1"], "fathom timing against REV"),
        (["--profile", "eskf"], "fathom timing profile NAME"),
        (["--cost"], "fathom timing cost"),
        (["--counters"], "fathom timing counters"),
        (["--only", "evo*", "--strict"], "fathom timing budgets"),
    ],
)
def test_an_option_without_its_verb_is_refused_by_a_line_that_names_the_verb(arguments: list[str], verb: str) -> None:
    done = CliRunner().invoke(app, ["timing", *arguments])
    assert done.exit_code == 2
    assert f"`{verb}`" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [["budgets", "--short"], ["profile", "eskf", "--limit", "2"], ["cost", "--only", "x"], ["against"]]
)
def test_a_verb_refuses_the_options_of_others(arguments: list[str]) -> None:
    assert CliRunner().invoke(app, ["timing", *arguments]).exit_code == 2


def test_timing_alone_lists_its_verbs() -> None:
    shown = CliRunner().invoke(app, ["timing"]).output
    for verb in ("budgets", "against", "profile", "cost", "counters"):
        assert f"\n  {verb} " in shown


def test_ctrl_c_keeps_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget_rows, "BUDGETS", (KEPT, Budget("never", 1.0, True, interrupted)))
    done = CliRunner().invoke(app, ["timing", "budgets", "-o", str(tmp_path / "budgets.json")])
    assert done.exit_code == 130
    assert [row["name"] for row in json.loads((tmp_path / "budgets.json").read_text())["budgets"]] == ["kept"]


@pytest.mark.parametrize(
    "arguments", [["budgets", "--only", "nothing"], ["against", "nosuch"], ["counters", "--only", "x"]]
)
def test_what_is_not_there_is_one_line_and_status_2(arguments: list[str]) -> None:
    done = CliRunner().invoke(app, ["timing", *arguments])
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("verdict", "status"), [("slower", 1), ("broken", 1), ("slower?", 0), ("new", 0), ("same", 0)])
def test_only_what_is_surely_slower_fails(
    verdict: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = (
        Compared("ATE", "scores", "pose", verdict, 1.2, 1.0, 1.2, 1.11, 1.3, again=True, note="other work"),  # type: ignore[arg-type]
        Compared("RPE", "scores", "pose", "same", 1.0, 1.0, 1.0, 0.9, 1.1),
    )
    found = Comparison("now", "then", "shared", 1.1, 0.99, rows)
    monkeypatch.setattr(comparison, "compare", lambda *_: found)
    done = CliRunner().invoke(app, ["timing", "against", "HEAD", "-o", str(tmp_path / "c.json")])
    assert done.exit_code == status
    assert "1.110 – 1.300" in done.output
    assert "ATE: other work" in done.output
    assert json.loads((tmp_path / "c.json").read_text())["comparison"]["rows"][0]["ratio"] == 1.2
