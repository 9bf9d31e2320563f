"""The check before an experiment: it warns, refuses with --strict, is left out with --no-check, stays in rows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from fathom.bench import Experiment, ExperimentError, run_experiment
from fathom.bench.cli.app import app
from fathom.datasets import Scenario, simulate
from fathom.datasets.described.folder import write_folder
from fathom.datasets.log import ImuStream
from typer.testing import CliRunner

IN_G = "m/s² strong where gravity is 9.81: it is in g."


@pytest.fixture
def plan(tmp_path: Path) -> dict[str, Any]:
    """An experiment on a right log, and on one whose accelerometer is in g."""
    log = simulate(Scenario(mission="lawnmower", duration_s=20), seed=1)
    in_g = replace(log, imu=ImuStream(log.imu.t_ns, log.imu.w_WI_I, log.imu.f_I / 9.80665))
    folders = [write_folder(each, tmp_path / name) for each, name in ((log, "right"), (in_g, "in_g"))]
    logs = [{"log": str(folder), "name": folder.name} for folder in folders]
    return {"name": "t", "logs": logs, "estimators": [{"name": "dead-reckoning"}]}


def test_what_looks_wrong_is_said_and_stays_among_the_notes(
    plan: dict[str, Any], tmp_path: Path, ran: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = run_experiment(Experiment.from_dict(plan), out=tmp_path / "out")
    said = capsys.readouterr().err
    assert f"{IN_G}\n  → log.yaml: streams.imu.accel.unit: g\n" in said
    assert said.count("strong where") == said.count("in_g: imu: ") == 1
    notes = {row.log: [note for note in json.loads(row.notes) if "check" in str(note)] for row in rows.itertuples()}
    assert notes["right"] == []
    assert len(notes["in_g"]) == 1
    assert IN_G in str(notes["in_g"][0])
    assert len(ran) == 2


def test_strict_refuses_and_runs_nothing(plan: dict[str, Any], tmp_path: Path, ran: list[str]) -> None:
    with pytest.raises(ExperimentError, match="refused by --strict: in_g: imu: The specific force"):
        run_experiment(Experiment.from_dict(plan), out=tmp_path / "out", strict=True)
    assert ran == []
    assert not (tmp_path / "out").exists()
    right = plan | {"logs": plan["logs"][:1]}
    run_experiment(Experiment.from_dict(right), out=tmp_path / "out", strict=True)
    assert len(ran) == 1


def test_without_the_check_nothing_is_said(
    plan: dict[str, Any], tmp_path: Path, ran: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = run_experiment(Experiment.from_dict(plan), out=tmp_path / "out", check=False)
    assert IN_G not in capsys.readouterr().err
    assert not any(IN_G in notes for notes in rows["notes"])


def test_the_command_takes_both_and_not_together(plan: dict[str, Any], tmp_path: Path, ran: list[str]) -> None:
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    command = ["run", str(tmp_path / "plan.yaml"), "--out", str(tmp_path / "out")]
    results = [CliRunner().invoke(app, [*command, *more]) for more in (["--strict"], ["--strict", "--no-check"])]
    assert [result.exit_code for result in results] == [2, 2]
    assert IN_G in results[0].stderr
    assert "leaves the check out" in results[1].stderr
    assert ran == []
