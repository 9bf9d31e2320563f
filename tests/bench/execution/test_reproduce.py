from __future__ import annotations

import json
import sqlite3
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from math import nextafter
from pathlib import Path
from shutil import copytree, rmtree

import numpy as np
import pytest
from fathom.bench.cli.app import app
from fathom.bench.execution import reproduce
from fathom.bench.execution import sweep as runner
from fathom.bench.execution import task as task_module
from fathom.bench.execution.reproduce import compare, rebuild, reproduce_all
from fathom.bench.execution.sweep import run_experiment
from fathom.bench.execution.task import Finished, Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.metrics.floor import floors
from fathom.bench.output.tables.reproduction import print_reproduction
from fathom.bench.results import machine
from fathom.bench.results.select import choose
from fathom.datasets.described.folder import write_folder
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.estimators import create
from fathom.estimators.registry import ESTIMATORS
from rich.console import Console
from typer.testing import CliRunner

pytestmark = pytest.mark.slow  # whole runs and searches: seconds each

SHORT = {
    "name": "short",
    "logs": [{"name": "short dive", "scenario": {"mission": "yo-yo", "duration_s": 20}}],
    "estimators": [
        {"name": "dead-reckoning"},
        {"name": "eskf", "label": "eskf gated", "with": {"gate": {"gps": 0.999}}},
        {"name": "rts"},
    ],
    "seeds": [3, 5],
    "scores": {"nis": True, "floor": True, "segment_lengths_m": [5]},
}


def call(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, " ".join(result.stdout.split()), result.stderr


def within_this_process(tasks: Sequence[Task], jobs: int = 0) -> Generator[Finished]:
    bench = WorkerCache()
    bench.warm = {repr(task.run.estimator.create()) for task in tasks}
    for task in tasks:
        yield bench.execute(task)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the tests the worker processes."""
    for module in (runner, reproduce):
        monkeypatch.setattr(module, "run_all", within_this_process)
        monkeypatch.setattr(module, "compile_first", lambda estimators: None)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of SHORT."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "run_all", within_this_process)
        patch.setattr(runner, "compile_first", lambda estimators: None)
        out = tmp_path_factory.mktemp("results")
        run_experiment(Experiment.from_dict(SHORT), out=out)
    return out / "short"


@pytest.fixture
def result(made: Path, tmp_path: Path, quick: None) -> Path:
    """A copy of them that a test may spoil."""
    return copytree(made, tmp_path / "short")


def alter(folder: Path, assignment: str, where: str = "1") -> None:
    with closing(sqlite3.connect(folder / "runs.sqlite")) as store, store:
        assert store.execute(f"UPDATE runs SET {assignment} WHERE {where}").rowcount > 0


def score_of(folder: Path, name: str, where: str) -> float:
    with closing(sqlite3.connect(folder / "runs.sqlite")) as store:
        return store.execute(f"SELECT {name} FROM runs WHERE {where}").fetchone()[0]


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(("-shm", "-wal")))
    return {str(path): sha256(path.read_bytes()).hexdigest() for path in files}


def test_every_run_comes_out_identical_and_the_result_stays_as_it_was(result: Path) -> None:
    before = contents(result)
    code, out, _ = call("reproduce", result)
    assert code == 0
    assert "6 of 6 runs came out identical, bit for bit" in out
    assert "are the same, so the scores must be identical" in out
    assert contents(result) == before


@pytest.mark.slow
def test_workers_give_the_bits_that_workers_gave(tmp_path: Path) -> None:
    plan = Experiment.from_dict(SHORT | {"seeds": [3]})
    run_experiment(plan, out=tmp_path, jobs=1)
    every, whole = reproduce_all(choose(tmp_path / "short"), jobs=1)
    assert whole
    assert len(every) == 3
    assert all(again.is_identical for again in every), [again.differences for again in every]


def test_the_last_bit_of_a_score_is_seen(result: Path) -> None:
    where = "label = 'rts' AND seed = 5 AND output = 'smoothed'"
    ate_m = score_of(result, "ate_rmse_m", where)
    alter(result, f"ate_rmse_m = {nextafter(ate_m, 1)!r}", where)
    code, out, _ = call("reproduce", result, "short dive/rts/5")
    assert code == 1
    assert "ate_rmse_m" in out
    assert "0 of 1 runs came out identical" in out
    (again,) = reproduce_all(choose(result, "short dive/rts/5"))[0]
    assert again.differences["online"] == ()
    (difference,) = again.differences["smoothed"]
    assert (difference.name, difference.now) == ("ate_rmse_m", ate_m)
    assert 0 < difference.relative < 3e-16


@pytest.mark.parametrize(
    ("assignment", "names"),
    [
        ("status = 'diverged', cause = 'lost'", {"status", "cause"}),
        ("counts = json_set(counts, '$.readings', 7)", {"counts.readings"}),
        ("nees_at = json_set(nees_at, '$.position[2]', 1.5)", {"nees_at.position.2"}),
        ("nis_dvl = 1.25", {"nis_dvl"}),
        ("floor_position_m = NULL", {"floor_position_m"}),
        ("start = 'moving'", {"start"}),
        ("step_median_us = 1e9, peak_mb = 1e9, total_s = 1e9", set()),
    ],
)
def test_what_decides_is_compared_and_what_it_cost_is_not(result: Path, assignment: str, names: set[str]) -> None:
    alter(result, assignment, "label = 'eskf gated' AND seed = 3")
    (again,) = reproduce_all(choose(result, "*/eskf gated/3"))[0]
    assert {each.name for each in again.differences["online"]} == names


def test_the_largest_difference_stands_first(result: Path) -> None:
    alter(result, "ate_rmse_m = ate_rmse_m * 1.001, drms_m = drms_m * 2, cep50_m = NULL", "label = 'dead-reckoning'")
    every = reproduce_all(choose(result, "dead-reckoning"))[0]
    assert [[each.name for each in again.differences["online"]] for again in every] == [
        ["cep50_m", "drms_m", "ate_rmse_m"]
    ] * 2


def test_other_versions_and_machines_are_named_with_both_values(result: Path) -> None:
    alter(result, "versions = json_set(versions, '$.numpy', '1.99.9'), machine = json_set(machine, '$.cpu', 'Abacus')")
    code, out, _ = call("reproduce", result, "short dive/dead-reckoning/3")
    assert code == 0  # the numbers are the same
    assert "1.99.9" in out
    assert "Abacus" in out
    assert "rounded differently" in out
    alter(result, "versions = json_set(versions, '$.code', 'abcdefabcdef0123')")
    out = call("reproduce", result, "short dive/dead-reckoning/3")[1]
    assert "abcdefabcdef 0" not in out
    assert "the code has changed" in out


def test_a_changed_spec_is_reported(result: Path) -> None:
    alter(result, "spec = json_set(spec, '$.scores.rpe_delta', 5.0)", "seed = 3")
    code, out, _ = call("reproduce", result, "short dive/dead-reckoning/3")
    assert code == 1
    assert "rpe_rmse_m" in out
    assert "the identity differs" in out
    alter(result, "spec = json_set(spec, '$.seed', 4)", "seed = 5")
    assert "seed: 4, which was taken for 5" in call("reproduce", result, "short dive/dead-reckoning/5")[1]


def test_another_version_of_the_estimators_package_is_reported(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (task_module, reproduce):
        monkeypatch.setattr(module, "package_of", lambda name: "navkit 2.0")
    out = call("reproduce", result, "short dive/dead-reckoning/3")[1]
    assert "the version of navkit, now navkit 2.0, must have changed" in out


def test_options_missing_from_the_spec_are_reported(result: Path) -> None:
    alter(result, "spec = json_remove(spec, '$.estimator.config.max_delay_s')", "label = 'eskf gated'")
    out = call("reproduce", result, "short dive/eskf gated/3")[1]
    assert "lacks estimator.config.max_delay_s; it was run with today's default" in out


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("spec = json_set(spec, '$.estimator.config.warp', 9)", "no option 'warp'"),
        ("spec = json_set(spec, '$.estimator.name', 'eskg')", "did you mean 'eskf'"),
        ("spec = json_remove(spec, '$.max_gap_s')", "its spec has no 'max_gap_s'"),
        ("spec = json_set(spec, '$.log', 'gone/away')", "gone/away: no such log"),
        ("spec = NULL", "the store does not hold its spec"),
        ("status = 'absent', cause = 'not here: nothing'", "never ran: not here: nothing"),
    ],
)
def test_a_run_that_cannot_be_made_again_says_why(result: Path, assignment: str, says: str) -> None:
    alter(result, assignment, "label = 'eskf gated'")
    code, out, _ = call("reproduce", result, "*/eskf gated/5")
    assert code == 2  # nothing was run
    assert says in out
    code, out, _ = call("reproduce", result)
    assert code == (0 if "absent" in assignment else 1)
    assert "short dive/eskf gated/3 and 1 more: not run again: " in out
    assert says in out
    assert out.count("not run again") == 1
    assert "4 of 4 runs came out identical" in out


def test_rows_go_by_name_pattern_and_identity(result: Path) -> None:
    names = {run.name: run for run in choose(result)}
    assert len(names) == 6
    assert [run.name for run in choose(result, "short dive/eskf gated")] == [
        f"short dive/eskf gated/{seed}" for seed in (3, 5)
    ]
    assert [run.name for run in choose(result, "*/rts/5")] == ["short dive/rts/5"]
    assert {run.name for run in choose(result, "*/5")} == {name for name in names if name.endswith("5")}
    whole = names["short dive/rts/3"].first["identity"]
    assert [run.name for run in choose(result, whole[:12].upper())] == ["short dive/rts/3"]


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("short dive/eskf gatd", "did you mean 'short dive/eskf gated'?"),
        ("abc", "no such row"),
        ("feed", "several runs begin so: feed0001 short dive/rts/3, feed0002 short dive/rts/5"),
    ],
)
def test_a_row_that_is_none_or_many_is_refused_with_what_there_is(result: Path, row: str, says: str) -> None:
    alter(result, "identity = 'feed0001'", "label = 'rts' AND seed = 3")
    alter(result, "identity = 'feed0002'", "label = 'rts' AND seed = 5")
    code, _, err = call("reproduce", result, row)
    assert code == 2
    assert says in err


def test_a_result_that_is_not_there_is_refused_with_the_nearest(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(made.parent.parent)
    (made.parent.parent / "results").symlink_to(made.parent)
    code, _, err = call("reproduce", "shrot")
    assert code == 2
    assert "did you mean 'short'" in err
    assert [run.name for run in choose(made, "*/rts/3")] == ["short dive/rts/3"]


@pytest.fixture
def recorded(tmp_path: Path, quick: None) -> Path:
    """The results of a log in a folder."""
    write_folder(simulate(Scenario(duration_s=20.0), seed=2), tmp_path / "dive")
    plan = {"name": "taped", "logs": [{"log": str(tmp_path / "dive")}], "estimators": [{"name": "eskf"}]}
    run_experiment(Experiment.from_dict(plan), out=tmp_path / "results")
    return tmp_path / "results" / "taped"


def test_a_recorded_log_comes_out_identical_too(recorded: Path) -> None:
    code, out, _ = call("reproduce", recorded, "dive/eskf")
    assert code == 0
    assert "not" not in out.partition("came out identical")[0].partition("eskf")[2]


def test_another_description_is_distinguished_from_other_readings(recorded: Path, tmp_path: Path) -> None:
    description = tmp_path / "dive" / "log.yaml"
    text = description.read_text()
    description.write_text(text + "\n# more said\n")
    code, out, _ = call("reproduce", recorded)
    assert code == 0
    assert "log.yaml" in out
    assert "the readings" not in out
    description.write_text(text.replace("position_m: [1.0", "position_m: [1.5"))
    if description.read_text() == text:  # another way to change what the log says
        description.write_text(text.replace("gravity: 9.81", "gravity: 9.82"))
    assert description.read_text() != text
    code, out, _ = call("reproduce", recorded)
    assert code == 1
    assert "the readings must have changed" in out


def test_a_log_that_is_gone_is_reported_and_nothing_is_run(recorded: Path, tmp_path: Path) -> None:
    rmtree(tmp_path / "dive")
    code, out, _ = call("reproduce", recorded)
    assert code == 2
    assert "not run again" in out
    assert "no such log" in out


@pytest.mark.parametrize(
    ("estimator", "timeout_s", "status"),
    [
        ({"name": "fls", "with": {"factorization": "CHOLESKY"}}, 60.0, "diverged"),
        ({"name": "eskf"}, 1e-6, "failed"),
    ],
)
def test_a_run_that_ended_early_ends_so_again(
    tmp_path: Path, quick: None, estimator: dict[str, object], timeout_s: float, status: str
) -> None:
    plan = SHORT | {"estimators": [estimator], "seeds": 1, "timeout_s": timeout_s, "scores": {}}
    rows = run_experiment(Experiment.from_dict(plan), out=tmp_path)
    assert rows["status"].tolist()[0] == status
    (again,) = reproduce_all(choose(tmp_path / "short"))[0]
    assert again.is_identical, again.differences


def test_an_interruption_shows_what_is_known(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(tasks: Sequence[Task], jobs: int = 0) -> Generator[Finished]:
        yield from within_this_process(tasks[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce, "run_all", interrupted)
    code, out, err = call("reproduce", result)
    assert code == 130
    assert "2 of 2 runs came out identical" in out
    assert "interrupted after 2 of 6 runs" in err


def test_a_rebuilt_task_has_the_spec_and_identity_of_its_row(made: Path) -> None:
    for stored in choose(made):
        task = rebuild(stored, None, lambda *_: pytest.fail("nothing is recorded here"))
        assert json.loads(json.dumps(task.spec)) == stored.spec
        assert task.identity == stored.first["identity"]
        assert compare(stored, stored).is_identical


def test_a_floor_does_not_depend_on_the_lags_that_it_is_found_with() -> None:
    scenario, ticks_ns = Scenario(duration_s=30.0, gps={"delay_s": 2.0}), np.arange(5, 30) * 10**9
    together = floors(scenario, 1, ticks_ns, [0.0, 1.0, 3.0, 10.0, np.inf])
    for lag_s, floor in together.items():
        assert np.array_equal(floors(scenario, 1, ticks_ns, sorted({0.0, lag_s, np.inf}))[lag_s].P, floor.P)


def test_every_option_of_every_estimator_survives_the_store() -> None:
    for name in Experiment.load("fleet").estimators + Experiment.load("ablation").estimators:
        as_stored = json.loads(json.dumps(name.config))
        assert create(name.name, **as_stored) == name.create()


def test_the_machine_has_the_facts_that_affect_rounding() -> None:
    found = machine.machine()
    assert set(machine.DECIDES) < set(found)
    assert all(found[name] for name in ("architecture", "compiled_for", "blas"))


@pytest.mark.slow
def test_every_estimator_gives_the_same_bits_again(tmp_path: Path) -> None:
    logs = [{"scenario": {"duration_s": 25, "imu": "tactical", "gps": {"disorder_s": 2.0}}}]
    estimators = [{"name": name} for name in ESTIMATORS] + [
        {"name": "fls", "label": "robust", "with": {"robust": {"dvl": "huber"}}},
        {"name": "fls", "label": "tight", "with": {"dvl": ["preintegrated-tight"]}},
        {"name": "batch", "label": "batch by window", "with": {"engine": "window"}},
    ]
    plan = Experiment.from_dict({"name": "all", "logs": logs, "estimators": estimators, "scores": {"nis": True}})
    rows = run_experiment(plan, out=tmp_path, jobs=2)
    assert set(rows["status"]) == {"done"}
    every = reproduce_all(choose(tmp_path / "all"), jobs=1)[0]
    assert len(every) == len(estimators)
    assert not [again.stored.name for again in every if not again.is_identical]


def test_nothing_is_cut_or_folded_inside_a_word_in_80_columns(result: Path) -> None:
    alter(result, "ate_rmse_m = ate_rmse_m * 1.5, label = 'dead-reckoning-of-a-dive'", "label = 'dead-reckoning'")
    every, _ = reproduce_all(choose(result, "*/3"))
    console = Console(width=80, record=True)
    print_reproduction([replace(again, time_ratio=1.5) for again in every], console)
    text = console.export_text()
    assert "dive/dead-reckoning-of-a-dive" in text
    assert "…" not in text
    assert "ate_rmse_m" in text
    assert "(median; not compared)" in text
