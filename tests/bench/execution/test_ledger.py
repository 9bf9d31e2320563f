"""The ledger: a finished run is never lost, never doubled, never made twice, and a changed one is another run."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fathom.bench.errors import ExperimentError, StoppedError
from fathom.bench.execution import sweep as runner
from fathom.bench.execution import worker as working
from fathom.bench.execution.sweep import run_experiment, sweep
from fathom.bench.execution.task import Finished
from fathom.bench.experiment.plan import Experiment
from fathom.bench.output.tables.table import write_table
from fathom.bench.results import identity as ledger
from fathom.bench.results.identity import content_sha256, identity
from fathom.bench.results.store import load_runs, sole_writer
from fathom.datasets import Scenario, simulate
from fathom.datasets.described.folder import write_folder

SHORT: dict[str, Any] = {"scenario": {"mission": "lawnmower", "duration_s": 20}}


def experiment(**changes: Any) -> Experiment:
    content = {"name": "t", "logs": [SHORT], "estimators": [{"name": "dead-reckoning"}]} | changes
    return Experiment.from_dict(content, "t.yaml")


def test_what_is_done_is_not_done_again_until_forced(tmp_path: Path, ran: list[str]) -> None:
    first = sweep(experiment(seeds=[1, 2]), out=tmp_path)
    assert len(ran) == 2
    assert (first.standing, first.renewed) == (0, 0)
    again = sweep(experiment(seeds=[1, 2, 3]), out=tmp_path)
    assert ran[2:] == ["lawnmower-tactical / dead-reckoning seed 3"]
    assert (again.standing, again.renewed) == (2, 0)
    assert again.rows["finished"].tolist()[:2] == first.rows["finished"].tolist()
    run_experiment(experiment(seeds=[1, 2, 3]), out=tmp_path, force=True)
    assert len(ran) == 6
    assert len(load_runs(tmp_path / "t")) == 3


def test_a_changed_option_or_score_makes_a_new_run_and_is_reported(tmp_path: Path, ran: list[str]) -> None:
    run_experiment(experiment(seeds=[1, 2]), out=tmp_path)
    changed = [{"name": "dead-reckoning", "with": {"attitude": "gyro"}}]
    outcome = sweep(experiment(seeds=[1, 2], estimators=changed), out=tmp_path)
    assert (outcome.standing, outcome.renewed) == (0, 2)
    outcome = sweep(experiment(seeds=[1, 2], estimators=changed, scores={"rpe_delta": 2.0}), out=tmp_path)
    assert (outcome.standing, outcome.renewed) == (0, 2)
    assert len(load_runs(tmp_path / "t")) == 2
    assert len(ran) == 6


def test_another_version_or_other_code_makes_new_runs(
    tmp_path: Path, ran: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_experiment(experiment(), out=tmp_path)
    there = ledger.versions()
    for name in ("numpy", "code"):
        changed = there | {name: "other"}
        monkeypatch.setattr(ledger, "versions", lambda changed=changed: changed)
        assert sweep(experiment(), out=tmp_path).renewed == 1
    assert len(ran) == 3


def test_a_recorded_log_whose_readings_have_changed_is_another_log(tmp_path: Path, ran: list[str]) -> None:
    log = simulate(Scenario(mission="lawnmower", duration_s=20), seed=1)
    folder = write_folder(log, tmp_path / "a", "csv")
    plan = experiment(logs=[{"log": str(folder)}])
    run_experiment(plan, out=tmp_path / "out")
    assert sweep(plan, out=tmp_path / "out").standing == 1
    lines = (folder / "depth.csv").read_text().splitlines()
    (folder / "depth.csv").write_text("\n".join(lines[:-1]) + "\n")
    assert sweep(plan, out=tmp_path / "out").renewed == 1
    assert len(ran) == 2


def test_a_run_that_failed_is_tried_again_and_one_that_diverged_is_not(
    tmp_path: Path, ran: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_experiment(experiment(seeds=[1, 2]), out=tmp_path)
    with closing(sqlite3.connect(tmp_path / "t" / "runs.sqlite")) as store, store:
        store.execute("UPDATE runs SET status = 'failed' WHERE seed = 1")
        store.execute("UPDATE runs SET status = 'diverged' WHERE seed = 2")
    rows = run_experiment(experiment(seeds=[1, 2]), out=tmp_path)
    assert rows["status"].tolist() == ["done", "diverged"]
    assert len(ran) == 3


def test_trajectories_that_no_row_speaks_of_are_swept(tmp_path: Path, ran: list[str]) -> None:
    run_experiment(experiment(), out=tmp_path)
    folder = tmp_path / "t" / "trajectories"
    spoken_of = {path.name for path in folder.iterdir()}
    assert len(spoken_of) == 2
    (truth,) = (name for name in spoken_of if "truth" in name)
    (folder / f"{truth}.123").write_bytes(b"x")  # of a process that was killed
    changed = [{"name": "dead-reckoning", "with": {"attitude": "gyro"}}]
    rows = run_experiment(experiment(estimators=changed), out=tmp_path)
    left = {path.name for path in folder.iterdir()}
    assert left == {rows.iloc[0]["trajectory"], rows.iloc[0]["truth_trajectory"]}
    assert rows.iloc[0]["truth_trajectory"] in spoken_of


def test_two_writers_at_once_get_a_plain_error(tmp_path: Path) -> None:
    (tmp_path / "t" / "trajectories").mkdir(parents=True)
    with sole_writer(tmp_path / "t"), pytest.raises(ExperimentError, match=f"process {os.getpid()}.*is writing here"):
        run_experiment(experiment(), out=tmp_path)
    with sole_writer(tmp_path / "t"):  # it is free again
        pass


def test_another_recorded_path_under_the_same_name_is_another_log(tmp_path: Path, ran: list[str]) -> None:
    scenario: dict[str, Any] = {"mission": "recorded", "path": str(tmp_path / "path.tum"), "duration_s": 20}
    plan = experiment(logs=[{"scenario": scenario | {"path_spacing_s": 1.0, "path_start_s": 30.0}}])
    truth = simulate(Scenario(mission="lawnmower", duration_s=80), seed=1).truth
    assert truth is not None
    truth.to_tum(tmp_path / "path.tum")
    first = run_experiment(plan, out=tmp_path / "out")
    assert first["status"].tolist() == ["done"]
    assert sweep(plan, out=tmp_path / "out").standing == 1
    replace(truth, p_WB_W=1.1 * truth.p_WB_W).to_tum(tmp_path / "path.tum")
    again = sweep(plan, out=tmp_path / "out")
    assert again.renewed == 1
    assert again.rows["identity"].tolist() != first["identity"].tolist()


def test_a_store_of_another_version_is_refused_before_anything_runs(tmp_path: Path, ran: list[str]) -> None:
    run_experiment(experiment(), out=tmp_path)
    with closing(sqlite3.connect(tmp_path / "t" / "runs.sqlite")) as store, store:
        store.execute("ALTER TABLE runs DROP COLUMN identity")
    with pytest.raises(ExperimentError, match=r"another version wrote it: it lacks column identity; .* move it away"):
        run_experiment(experiment(), out=tmp_path)
    assert len(ran) == 1


def test_a_short_first_log_goes_first_and_its_rows_are_handed_over_when_its_last_run_has_ended(
    tmp_path: Path, ran: list[str]
) -> None:
    logs = [
        {"name": name, "scenario": {"duration_s": s}} for name, s in (("short", 20), ("middle", 200), ("long", 400))
    ]
    told: list[tuple[int, pd.DataFrame]] = []
    outcome = sweep(
        experiment(logs=logs, seeds=[1, 2]), out=tmp_path, finished_log=lambda rows: told.append((len(ran), rows))
    )
    assert [name.split(" ")[0] for name in ran] == ["short", "short", "long", "long", "middle", "middle"]
    assert [(done, set(rows["log"])) for done, rows in told] == [(2, {"short"}), (4, {"long"}), (6, {"middle"})]
    in_order = [told[k][1] for k in (0, 2, 1)]
    assert pd.concat(in_order)["identity"].tolist() == outcome.rows["identity"].tolist()


def test_where_the_first_log_is_not_short_the_longest_run_first(tmp_path: Path, ran: list[str]) -> None:
    logs = [{"name": str(s), "scenario": {"duration_s": s}} for s in (30, 20, 40)]
    run_experiment(experiment(logs=logs), out=tmp_path)
    assert [name.split(" ")[0] for name in ran] == ["40", "30", "20"]


def test_progress_goes_to_a_log_file_by_lines(
    tmp_path: Path, ran: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runner, "LINE_EVERY_S", -1.0)
    run_experiment(experiment(seeds=[1, 2, 3]), out=tmp_path)
    assert capsys.readouterr().err.splitlines()[-2:] == [
        "1 of 3 runs finished; the last: lawnmower-tactical / dead-reckoning: done",
        "2 of 3 runs finished; the last: lawnmower-tactical / dead-reckoning: done",
    ]


def test_a_full_disk_does_not_keep_the_lock_from_holding(tmp_path: Path) -> None:
    (tmp_path / "lock").symlink_to("/dev/full")
    with sole_writer(tmp_path):
        pass


def test_a_folder_that_cannot_be_locked_is_reported_plainly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(ExperimentError, match="cannot be locked"), sole_writer(tmp_path):
        pass


def test_an_identity_hangs_on_everything_and_on_nothing_else() -> None:
    spec = experiment().spec(experiment().runs()[0])
    assert identity(spec, None, None) == identity(json.loads(json.dumps(spec)), None, None)
    assert identity(spec, None, None) != identity(spec | {"seed": 2}, None, None) != identity(spec, None, "x")
    log = simulate(Scenario(mission="lawnmower", duration_s=20), seed=1)
    same = simulate(Scenario(mission="lawnmower", duration_s=20), seed=1)
    assert content_sha256(log) == content_sha256(same)
    f_I = log.imu.f_I.copy()
    f_I[3, 1] = np.nextafter(f_I[3, 1], 1.0)
    assert content_sha256(replace(log, imu=replace(log.imu, f_I=f_I))) != content_sha256(log)
    assert content_sha256(replace(log, depth=None)) != content_sha256(log)


KILLED = """
import fcntl, json, os, random, signal, sqlite3, sys, time
from contextlib import closing
from multiprocessing import Pipe, get_context
from pathlib import Path
from fathom.bench.execution import pool, sweep, task, worker
from fathom.bench.experiment.plan import Experiment

plan, out = Experiment.from_dict(json.loads(sys.argv[1])), Path(sys.argv[2])
kills, part = map(int, sys.argv[3:])


class Forked:
    # a worker's process as the child of a warm one, which starts at once

    def __init__(self, target):
        self.connection, theirs = Pipe()
        self.process = get_context("fork").Process(target=worker.work, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()

    def kill(self):
        self.process.kill()
        self.process.join()
        self.connection.close()


pool.start = Forked
for run in plan.runs()[:2]:
    worker.WorkerCache().execute(task.Task.of(plan, run))


def held(what="label, seed, output, status, finished"):
    if not (out / "t" / "runs.sqlite").is_file():
        return []
    with closing(sqlite3.connect(out / "t" / "runs.sqlite", timeout=60)) as store:
        if not store.execute("SELECT 1 FROM sqlite_master WHERE name = 'runs'").fetchone():
            return []
        return store.execute(f"SELECT {what} FROM runs").fetchall()


def wait_for(rows):
    while len(held("1")) < rows:
        time.sleep(0.005)


moments, longest_s, begun = random.Random(part), None, time.monotonic()
for k in range(kills):
    before = len(held("1"))
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        sweep.run_experiment(plan, out=out, jobs=2)
        os._exit(0)
    os.setpgid(child, child)  # whichever comes first: it may be killed before it has run at all
    if longest_s is None:  # how long is a moment on this machine, as busy as it is
        wait_for(2)
        longest_s = time.monotonic() - begun
    elif k % 2:  # while it starts, or a little later
        time.sleep(moments.uniform(0.0, longest_s))
    else:  # while it runs: a moment after one more run has ended
        wait_for(min(before + 1, len(plan.runs())))
        time.sleep(moments.uniform(0.0, 0.05))
    os.killpg(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with (out / "t" / "lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a forked worker has the lock too, until it has died
    print(json.dumps([os.waitstatus_to_exitcode(status), held()]), flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("part", range(2))
def test_killed_at_a_hundred_moments_no_run_is_lost_none_doubled_and_the_table_is_the_same(
    tmp_path: Path, ran: list[str], part: int
) -> None:
    estimators = [{"name": name, "label": f"{name} {k}"} for k in range(3) for name in ("eskf", "dead-reckoning")]
    content: dict[str, Any] = {"name": "t", "logs": [SHORT], "estimators": estimators, "seeds": 30}
    kills, runs = 50, 6 * 30  # of this part: two stores are killed side by side
    (tmp_path / "killed.py").write_text(KILLED)
    command = [sys.executable, str(tmp_path / "killed.py"), json.dumps(content), str(tmp_path / "out"), str(kills)]
    printed = subprocess.run([*command, str(part)], stdout=subprocess.PIPE, text=True, check=True, timeout=900).stdout
    states = [json.loads(line) for line in printed.splitlines()]
    assert len(states) == kills
    before: set[tuple[Any, ...]] = set()
    for _, rows in states:
        held = {tuple(row) for row in rows}
        assert len({row[:3] for row in held}) == len(rows)  # none doubled
        assert before <= held  # none lost, none made again: `finished` is among what is compared
        before = held
    codes = [code for code, _ in states]
    assert set(codes) <= {0, -signal.SIGKILL}
    assert codes.count(-signal.SIGKILL) > kills / 2
    grown = [len(rows) for _, rows in states]
    assert len(set(grown)) > 22, f"kills must fall between runs, found {grown}"

    plan = Experiment.from_dict(content, "t.yaml")
    ended = run_experiment(plan, out=tmp_path / "out")
    assert len(ran) == runs - len(before)
    undisturbed = run_experiment(plan, out=tmp_path / "whole")
    assert len(load_runs(tmp_path / "out" / "t")) == len(ended) == runs
    for rows, name in ((ended, "a.csv"), (undisturbed, "b.csv")):
        timed = [c for c in rows if c in {"started", "finished", "peak_mb", *runner_costs()}]
        write_table(rows.drop(columns=timed).reindex(columns=rows.columns), tmp_path / name)
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    files = {path.name for path in (tmp_path / "out" / "t" / "trajectories").iterdir()}
    assert files == {*ended["trajectory"], *ended["truth_trajectory"]}


def runner_costs() -> list[str]:
    from fathom.bench.metrics.scoring import COSTS

    return list(COSTS)


# -- files that are not the store's -----------------------------------------------------------------------------------


def test_nothing_is_removed_that_this_store_did_not_write(tmp_path: Path, ran: list[str]) -> None:
    mine, elsewhere = tmp_path / "t" / "trajectories", tmp_path / "elsewhere"
    for folder in (mine, elsewhere):
        folder.mkdir(parents=True)
    others = [mine / "dive.parquet", mine / "dive.parquet.7", mine / "notes.txt", elsewhere / "thesis.parquet"]
    for path in others:
        path.write_bytes(b"years of work")
    (mine / "link.parquet").symlink_to(elsewhere / "thesis.parquet")
    (mine / "gone.parquet").symlink_to(tmp_path / "unmounted" / "dive.parquet")
    (tmp_path / "t" / "lock").write_text("not a number of a process\n")
    for force in (False, True):
        changed = [{"name": "dead-reckoning", "with": {"attitude": "gyro" if force else "heading"}}]
        run_experiment(experiment(estimators=changed), out=tmp_path, force=force)
    assert all(path.read_bytes() == b"years of work" for path in others)
    assert (mine / "link.parquet").is_symlink()
    assert (mine / "gone.parquet").is_symlink()
    assert (tmp_path / "t" / "lock").read_text() == "not a number of a process\n"
    assert len(list(mine.glob("lawnmower*"))) == 2


def test_a_folder_of_trajectories_that_is_a_link_is_swept_behind_it_of_our_own_files_alone(
    tmp_path: Path, ran: list[str]
) -> None:
    big = tmp_path / "big disk"
    big.mkdir()
    (big / "other.parquet").write_bytes(b"x")
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "trajectories").symlink_to(big)
    for attitude in ("gyro", "heading"):
        run_experiment(
            experiment(estimators=[{"name": "dead-reckoning", "with": {"attitude": attitude}}]), out=tmp_path
        )
    assert len(list(big.glob("lawnmower*"))) == 2
    assert (big / "other.parquet").exists()


@pytest.mark.parametrize("name", ["table.csv", "report.html", "figures/mine.pdf"])
def test_what_lies_in_the_folder_without_a_store_is_not_written_over(tmp_path: Path, ran: list[str], name: str) -> None:
    (tmp_path / "t" / name).parent.mkdir(parents=True)
    (tmp_path / "t" / name).write_text("mine")
    with pytest.raises(ExperimentError, match=rf"{name}: is there, but no runs.sqlite .* another --out"):
        run_experiment(experiment(), out=tmp_path, force=True)
    assert (tmp_path / "t" / name).read_text() == "mine"
    assert ran == []


def test_the_folder_may_have_spaces_and_letters_of_any_script_and_a_long_label(tmp_path: Path, ran: list[str]) -> None:
    label = "wörter mit Lücken, " * 20
    plan = experiment(estimators=[{"name": "dead-reckoning", "label": label}], logs=[SHORT | {"name": "海 " * 90}])
    out = tmp_path / "Ergebnisse für 海, 50 %"
    for _ in range(2):
        rows = run_experiment(plan, out=out)
    assert rows["status"].tolist() == ["done"]
    assert (out / "t" / "trajectories" / rows["trajectory"][0]).is_file()
    assert len(ran) == 1


# -- one bad run is one bad row ---------------------------------------------------------------------------------------


def test_a_message_that_is_no_text_is_one_bad_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = working.WorkerCache()

    def here(tasks: Any, jobs: int) -> Any:
        for task in tasks:
            if task.run.seed == 1:
                yield Finished([task.row("failed", "bad file name \udcff\x00") | {"peak_mb": np.float32(1.5)}])
            else:
                yield bench.execute(task)

    monkeypatch.setattr(runner, "run_all", here)
    rows = run_experiment(experiment(seeds=[1, 2]), out=tmp_path)
    assert rows["status"].tolist() == ["failed", "done"]
    assert rows["cause"][0] == "bad file name \\udcff\\x00"
    assert rows["peak_mb"][0] == 1.5


def test_a_row_that_cannot_be_read_is_made_again(tmp_path: Path, ran: list[str]) -> None:
    run_experiment(experiment(seeds=[1, 2]), out=tmp_path)
    with closing(sqlite3.connect(tmp_path / "t" / "runs.sqlite")) as store, store:
        store.execute("UPDATE runs SET counts = '{\"readings\": ' WHERE seed = 1")
    assert load_runs(tmp_path / "t")["status"].tolist() == ["failed", "done"]
    assert run_experiment(experiment(seeds=[1, 2]), out=tmp_path)["status"].tolist() == ["done", "done"]
    assert ran[2:] == ["lawnmower-tactical / dead-reckoning seed 1"]


def test_the_rows_of_a_call_hold_the_whole_spec(tmp_path: Path, ran: list[str]) -> None:
    plan = experiment(seeds=[1, 2])
    for _ in range(2):
        rows = run_experiment(plan, out=tmp_path)
        assert [json.loads(spec) for spec in rows["spec"]] == [plan.spec(run) for run in plan.runs()]


# -- a full disk ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("where", "call"), [(os, "fsync"), (Path, "replace")])
def test_a_disk_that_fills_up_keeps_what_was_finished_and_says_so(
    tmp_path: Path, ran: list[str], monkeypatch: pytest.MonkeyPatch, where: Any, call: str
) -> None:
    run_experiment(experiment(seeds=[1]), out=tmp_path)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(where, call, full)
        with pytest.raises(StoppedError, match=r"No space left on device.*the runs before are kept"):
            run_experiment(experiment(seeds=[1, 2, 3]), out=tmp_path)
    assert load_runs(tmp_path / "t")["seed"].tolist() == [1]
    assert not list((tmp_path / "t" / "trajectories").glob("*.parquet.*"))
    assert len(run_experiment(experiment(seeds=[1, 2, 3]), out=tmp_path)) == 3
