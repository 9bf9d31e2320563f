"""What `fathom run` prints and writes: a log's tables as soon as its runs are finished, figures and report last."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from fathom.bench.execution.sweep import Outcome
from fathom.bench.execution.task import Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.output.present import present, print_log
from fathom.bench.results.store import Store, load_runs

SHORT = {"duration_s": 20}
PLAN = {
    "name": "p",
    "logs": [{"name": name, "scenario": SHORT} for name in ("first", "second")],
    "estimators": [{"name": "dead-reckoning"}, {"name": "eskf"}],
    "baseline": "dead-reckoning",
    "seeds": [1],
    "scores": {"segment_lengths_m": [10]},
}


@pytest.fixture(scope="module")
def plan() -> Experiment:
    return Experiment.from_dict(PLAN)


@pytest.fixture(scope="module")
def folder(plan: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with the runs of two logs, in the order in which they might finish."""
    folder, bench = tmp_path_factory.mktemp("p"), WorkerCache()
    (folder / "trajectories").mkdir()
    with Store(folder / "runs.sqlite") as store:
        for run in reversed(plan.runs()):
            store.write(bench.execute(Task.of(plan, run)).keep(folder))
    return folder


def test_one_logs_tables_can_be_printed_alone_in_the_order_of_the_plan(
    plan: Experiment, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = load_runs(folder)
    print_log(rows[rows["log"] == "second"], plan)
    out = capsys.readouterr().out
    assert out.startswith("second")
    assert "first" not in out
    assert 0 < out.index("\ndead-reckoning") < out.index("\neskf")


def test_what_is_printed_already_is_not_printed_again_and_every_log_is_in_the_files(
    plan: Experiment, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcome = Outcome(load_runs(folder), standing=3, renewed=2, kept={"gone": "not here"})
    present(outcome, plan, folder, printed={"second"})
    out, err = capsys.readouterr()
    assert out.startswith("first ")
    assert out.count("against ground truth") == 1
    assert "first: against dead-reckoning" in out
    assert "second: against dead-reckoning" in out
    assert set(pd.read_csv(folder / "table.csv")["log"]) == {"first", "second"}
    assert "3 runs were finished already" in err
    assert "2 runs were of another spec" in err
    assert "gone: not here; its rows are from an earlier run" in err
    assert (folder / "figures" / "first-tracks.pdf").is_file()


def test_where_no_recording_is_here_each_log_has_one_line_and_no_file_is_written(
    plan: Experiment, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = load_runs(folder)
    causes = "not here: " + rows["log"] + ": the folder of recordings is not set"
    present(Outcome(rows.assign(status="absent", cause=causes), 0, 0, {}), plan, tmp_path)
    lines = sorted(capsys.readouterr().out.splitlines())
    assert lines == [f"{log}: not here: the folder of recordings is not set" for log in ("first", "second")]
    assert not list(tmp_path.iterdir())


def test_to_print_tables_neither_matplotlib_nor_plotly_is_loaded() -> None:
    code = (
        "import sys, fathom.bench.output.present; sys.exit(', '.join({'matplotlib', 'plotly'} & {*sys.modules}) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
