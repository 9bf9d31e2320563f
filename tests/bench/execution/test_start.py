"""Where every run's prior came from stands beside its numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.execution.task import Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment, LogSpec
from fathom.bench.output.tables.table import write_table
from fathom.bench.results.store import COLUMNS, Store
from fathom.bench.results.summary import summarise
from fathom.datasets import Log, Scenario, simulate
from fathom.estimators import create

PLAN = {
    "name": "start",
    "logs": [{"scenario": {"duration_s": 20}}],
    "estimators": [{"name": "dead-reckoning"}],
    "seeds": [1],
}


def test_a_result_says_where_its_prior_came_from() -> None:
    log = simulate(Scenario(duration_s=20), seed=1)
    given = run_log(log, create("dead-reckoning"))
    assert (given.start, given.notes) == ("given", ())
    made = run_log(replace(log, prior=None), create("dead-reckoning"))
    assert made.start == "moving"
    assert any("level from" in note for note in made.notes)
    assert any("heading from" in note for note in made.notes)


@pytest.mark.parametrize("prior", ["given", "made"])
def test_a_run_is_stored_with_its_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prior: str) -> None:
    if prior == "made":
        opened: Any = LogSpec.open

        def without_prior(*args: Any, **options: Any) -> Log:
            return replace(opened(*args, **options), prior=None, heading=None, gps=None)

        monkeypatch.setattr(LogSpec, "open", without_prior)
    plan = Experiment.from_dict(PLAN)
    with Store(tmp_path / "runs.sqlite") as store:
        for run in plan.runs():
            store.write(WorkerCache().execute(Task.of(plan, run)).keep(tmp_path))
        rows = store.read()
    start = "given" if prior == "given" else "moving, heading unknown"
    assert rows["status"].tolist() == ["done"]
    assert rows["start"].tolist() == [start]
    assert any("heading unknown" in note["text"] for note in json.loads(rows["notes"][0])) == (prior == "made")
    write_table(rows, tmp_path / "table.csv")
    assert pd.read_csv(tmp_path / "table.csv")["start"].tolist() == [start]


def test_seeds_that_start_otherwise_are_all_named() -> None:
    identity = {"experiment": "e", "log": "l", "label": "eskf", "output": "online", "status": "done"}
    starts = ("static", "moving", "static", None)
    rows = [identity | {"seed": seed, "start": start} for seed, start in enumerate(starts)]
    (summary,) = summarise(pd.DataFrame(rows).reindex(columns=list(COLUMNS)))
    assert summary["start"] == "static | moving"


def test_a_run_that_never_began_has_no_start(tmp_path: Path) -> None:
    with Store(tmp_path / "runs.sqlite") as store:
        store.write(
            [{"experiment": "e", "log": "l", "label": "a", "seed": None, "output": "online", "status": "failed"}]
        )
        rows = store.read()
        assert rows["start"].isna().tolist() == [True]
        assert summarise(rows)[0]["start"] is None
