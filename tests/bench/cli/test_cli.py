from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fathom.bench.cli.app import app
from fathom.bench.cli.list_ import INDENT
from fathom.bench.saying import folded
from fathom.datasets import Trajectory
from typer.testing import CliRunner

FATHOM = Path(sys.executable).with_name("fathom")


def call(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def write(folder: Path, **changes: str) -> Path:
    """Write a short experiment, with some of its lines changed."""
    lines = {
        "logs": "[{scenario: {duration_s: 20}}]",
        "estimators": "[{name: dead-reckoning}, {name: eskf}]",
    } | changes
    file = folder / "short.yaml"
    file.write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return file


def circle(errors_m: float = 0.0) -> Trajectory:
    angle = np.linspace(0, 6, 200)
    p = 20 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return Trajectory(np.arange(200) * 10**9, np.repeat(np.eye(3)[None], 200, axis=0), p + np.array([errors_m, 0, 0]))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[int, str, str]]:
    """Where the short experiment has been run, and what the command said of it."""
    out = tmp_path_factory.mktemp("finished")
    return out, call("run", write(out), "--out", out, "--jobs", 2)


@pytest.fixture
def again(finished: tuple[Path, tuple[int, str, str]], tmp_path: Path) -> Path:
    """A copy of it, to run again."""
    out, (code, _, _) = finished
    assert code == 0
    return shutil.copytree(out, tmp_path / "again")


@pytest.mark.slow
def test_run_writes_store_table_and_figures_and_prints_the_table(finished: tuple[Path, tuple[int, str, str]]) -> None:
    place, (code, out, _) = finished
    assert code == 0
    assert "eskf" in out
    assert "alignment: none" in out
    folder = place / "short"
    assert pd.read_csv(folder / "table.csv")["done"].tolist() == [1, 1]
    assert r"\toprule" in (folder / "table.tex").read_text()
    assert pd.read_csv(folder / "consistency.csv")["seeds"].unique().tolist() == [1]
    assert (folder / "runs.sqlite").is_file()
    assert len(list((folder / "figures").glob("*.pdf"))) == 5


@pytest.mark.slow
def test_a_failed_run_is_named_on_the_last_line_and_exits_1(tmp_path: Path) -> None:
    code, out, _ = call("run", write(tmp_path, timeout_s="1.0e-6"), "--out", tmp_path, "--only", "eskf")
    assert code == 1
    assert "lawnmower-tactical / eskf seed 1: failed at" in out.splitlines()[-1]
    assert "out of time" in out.splitlines()[-1]


@pytest.mark.slow
def test_a_recording_that_is_not_here_is_reported_plainly(tmp_path: Path) -> None:
    logs = "[{scenario: {duration_s: 20}}, {log: ictineu_stpere_2004}]"
    file = write(tmp_path, logs=logs, estimators="[{name: dead-reckoning}]")
    code, out, _ = call("run", file, "--out", tmp_path, "--data", tmp_path, "--jobs", 1)
    assert code == 0
    assert "ictineu_stpere_2004: not here: no folder" in " ".join(out.split())
    code, out, _ = call("run", file, "--out", tmp_path, "--data", tmp_path, "--only", "ictineu*")
    assert code == 2


def test_results_of_a_recording_that_is_gone_are_kept_and_nothing_run_is_exit_2(tmp_path: Path) -> None:
    file = write(tmp_path, logs="[{log: ictineu_stpere_2004}]", estimators="[{name: dead-reckoning}]")
    run = ("run", file, "--out", tmp_path)
    code, out, _ = call(*run, "--data", tmp_path)
    assert code == 2
    assert out.startswith("ictineu_stpere_2004: not here: no folder")
    assert " ".join(out.split()).count("not here") == 1
    assert not (tmp_path / "short" / "report.html").exists()
    with closing(sqlite3.connect(tmp_path / "short" / "runs.sqlite")) as store, store:
        store.execute("UPDATE runs SET status = 'done', ate_rmse_m = 1.5, n_scored = 9")
    code, out, err = call(*run, "--data", tmp_path)
    assert code == 2
    assert "1.50" in out
    assert "its rows are from an earlier run" in err


@pytest.mark.slow
def test_only_after_a_change_leaves_what_is_outdated_out_of_the_csv(again: Path) -> None:
    changed = write(again, scores="{rpe_delta: 5.0}")
    code, _, err = call("run", changed, "--out", again, "--jobs", 1, "--only", "dead-reckoning")
    assert code == 0
    assert pd.read_csv(again / "short" / "table.csv")["label"].tolist() == ["dead-reckoning"]
    assert "1 rows of another spec or version are left out" in err


@pytest.mark.slow
def test_only_leaves_the_others_in_the_csv(again: Path) -> None:
    code, out, _ = call("run", write(again), "--out", again, "--jobs", 1, "--only", "eskf")
    assert code == 0
    assert "dead-reckoning" not in out
    assert pd.read_csv(again / "short" / "table.csv")["label"].tolist() == ["dead-reckoning", "eskf"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "no_such"], "no such experiment"),
        (["run", "{tmp}/short.yaml", "--only", "zebra"], "matches none"),
        (["run", "{tmp}/typo.yaml"], "did you mean 'eskf'"),
        (["run", "{tmp}/nolog.yaml"], "nowhere: no such log"),
        (["simulate", "yoyo", "-o", "{tmp}/x"], "did you mean 'yo-yo'"),
        (["simulate", "{tmp}/none.yaml", "-o", "{tmp}/x"], "none.yaml"),
        (["score", "{tmp}/a.tum", "{tmp}/b.tum"], "a.tum: no such file"),
        (["score", "{tmp}", "{tmp}/b.tum"], "a folder"),
        (["score", "/proc/self/mem", "{tmp}/b.tum"], "/proc/self/mem: cannot be read"),
        (["score", "x" * 300, "{tmp}/b.tum"], "cannot be read"),
        (["score", "a", "b", "--tolerance-s", "inf"], "--tolerance-s"),
        (["score", "a", "b", "--delta", "-1"], "delta must be positive"),
        (["score", "a", "b", "--delta", "nan"], "delta must be positive"),
        (["score", "a", "b", "--delta", "1.5", "--unit", "frames"], "whole in frames"),
        (["run", "x" * 300], "no such experiment"),
    ],
)
def test_bad_input_is_one_line_and_exit_2_before_anything_runs(tmp_path: Path, arguments: list[str], says: str) -> None:
    write(tmp_path)
    (tmp_path / "typo.yaml").write_text("logs: [{scenario: {}}]\nestimators: [{name: esfk}]\n")
    (tmp_path / "nolog.yaml").write_text("logs: [{log: nowhere}]\nestimators: [{name: eskf}]\n")
    filled = [argument.format(tmp=tmp_path) for argument in arguments]
    code, out, err = call(*filled, *(["--out", tmp_path / "r"] if arguments[0] == "run" else []))
    assert code == 2
    assert out == ""
    assert says in err
    assert err.count("\n") == 1
    assert not (tmp_path / "r").exists()
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_a_table_that_cannot_be_written_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fathom.bench.output.present.write_table", full)
    code, _, err = call("run", write(tmp_path), "--out", tmp_path, "--jobs", 1, "--only", "dead*")
    assert code == 1  # runs were made, and are kept
    assert "No space left on device" in err
    assert err.count("\n") == 1


def test_list_says_which_estimator_cannot_be_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    wreck = EntryPoint("wreck", "no_such_module_here:Wreck", "fathom.estimators")
    monkeypatch.setattr("fathom.estimators.registry._plugins", lambda: {"wreck": wreck})
    code, out, _ = call("list", "estimators")
    assert code == 0
    assert "wreck: cannot be loaded" in out
    assert "eskf: factors" in out


def test_list_names_what_there_is() -> None:
    assert "eskf: factors" in call("list", "estimators")[1]
    assert "filter_vs_smoother: " in call("list", "experiments")[1]
    for score in ("ate_rmse_m", "nees_velocity", "within_2sigma_all", "nis_dvl", "step_median_us"):
        assert f"{score}: " in call("list", "scores")[1]
    assert "ictineu_stpere_2004" in call("list", "logs")[1]
    assert call("list", "fish")[0] == 2


@pytest.mark.slow
def test_a_simulated_folder_runs_like_any_log(tmp_path: Path) -> None:
    (tmp_path / "dive.yaml").write_text("{mission: yo-yo, duration_s: 20}\n")
    code, out, _ = call("simulate", tmp_path / "dive.yaml", "-o", tmp_path / "dive", "--seed", 5)
    assert code == 0
    assert "20 s" in out
    file = write(tmp_path, logs=f"[{{log: {tmp_path / 'dive'}}}]", estimators="[{name: dead-reckoning}]")
    code, out, _ = call("run", file, "--out", tmp_path, "--jobs", 1)
    assert code == 0
    assert out.startswith("dive")


def test_a_simulated_log_without_sensors_is_described(tmp_path: Path) -> None:
    off = ", ".join(f"{sensor}: null" for sensor in ("dvl", "depth", "gps", "heading"))
    (tmp_path / "blind.yaml").write_text(f"{{duration_s: 20, {off}}}\n")
    code, out, _ = call("simulate", tmp_path / "blind.yaml", "-o", tmp_path / "blind")
    assert code == 0
    assert out.rstrip().endswith(" 20 s, imu, truth")


def test_score_prints_errors_with_their_alignment(tmp_path: Path) -> None:
    circle().to_tum(tmp_path / "truth.tum")
    circle(3.0).to_tum(tmp_path / "estimate.tum")
    code, out, _ = call("score", tmp_path / "truth.tum", tmp_path / "estimate.tum", "--delta", 6)
    assert code == 0
    assert "3.000000" in out
    assert "pairs" in out
    assert "alignment: none" in out
    code, out, _ = call("score", tmp_path / "truth.tum", tmp_path / "estimate.tum", "--align", "se3")
    assert "3.000000" not in out
    assert "alignment: se3" in out
    assert "no RPE: no pair of poses is 1.0 m apart" in out  # they are 0.6 m apart
    assert call("score", tmp_path / "truth.tum", tmp_path / "estimate.tum", "--unit", "feet")[0] == 2


@pytest.mark.parametrize("width", [60, 80, 120])
def test_score_cuts_no_number_on_a_narrow_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    monkeypatch.setattr("fathom.bench.output.tables.terminal.WIDTH", width)
    circle().to_tum(tmp_path / "truth.tum")
    circle(12345.678901).to_tum(tmp_path / "estimate.tum")
    code, out, _ = call("score", tmp_path / "truth.tum", tmp_path / "estimate.tum", "--delta", 6)
    assert (code, "…" in out) == (0, False)
    assert out.count("12345.678901") == 5  # all statistics but the standard deviation
    assert "200 poses" in out
    assert max(map(len, out.splitlines())) <= max(width, 80)


def test_score_says_how_many_poses_match_and_what_would_match_more(tmp_path: Path) -> None:
    truth = circle()
    files = {"truth": truth, "late": replace(truth, t_ns=truth.t_ns + 3 * 10**9)}
    files["jitter"] = replace(truth, t_ns=truth.t_ns + np.where(np.arange(200) % 10 == 0, 0, 10**8))
    files["elsewhere"] = replace(truth, t_ns=truth.t_ns + 10**15)
    for name, trajectory in files.items():
        trajectory.to_tum(tmp_path / f"{name}.tum")

    def scored(name: str, *options: object) -> str:
        code, out, err = call("score", tmp_path / "truth.tum", tmp_path / f"{name}.tum", *options)
        assert max(map(len, out.splitlines()), default=0) <= 80
        return f"{code} {' '.join((out + err).split())}"

    assert "197 of 200 poses of the truth and of 200 of the estimate" in scored("late")
    assert "with --offset-s -3.000 the ATE would be about" in scored("late")
    late = scored("late", "--offset-s", "-3")
    assert "200 of 200 poses" in late
    assert "with --offset-s" not in late
    assert "20 of 200 poses" in scored("jitter")
    assert "few poses match: --tolerance-s 0.1 would match most of them" in scored("jitter")
    assert "few poses" not in scored("jitter", "--tolerance-s", "0.11")
    nothing = scored("elsewhere")
    assert nothing.startswith("2 fathom: no two poses are within 0.01 s of each other")
    assert "with --offset-s -1000000.000 both begin together" in nothing
    assert "--offset-s must be within" in scored("late", "--offset-s", "nan")


def test_a_choice_that_there_is_not_is_refused_without_pydantics_words() -> None:
    code, _, err = call("score", "a", "b", "--align", "se4")
    assert code == 2
    assert "'se4' is not one of 'none', 'origin', 'yaw', 'se3'" in " ".join(err.split())
    assert "Value error" not in err


def test_a_list_is_folded_between_words() -> None:
    line = "estimator: lag_s, smoothed_covariance_s, relinearize, keyframe-period, factors"
    lines = folded(line, 30, INDENT).splitlines()
    assert " ".join(part.strip() for part in lines) == line
    assert max(map(len, lines)) <= 30
    assert all(part.startswith("    ") for part in lines[1:])


def test_help_imports_nothing_heavy() -> None:
    heavy = "{'numpy', 'pandas', 'numba', 'gtsam', 'matplotlib', 'scipy', 'pydantic'}"
    code = f"import sys, fathom.bench.cli.app; sys.exit(', '.join({heavy} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    shown = subprocess.run([FATHOM, "--help"], capture_output=True, text=True, check=False)
    assert shown.returncode == 0
    for command in ("run", "list", "simulate", "score"):
        assert command in shown.stdout


def test_the_list_of_verbs_says_of_each_in_whole_sentences_what_it_does() -> None:
    for arguments in ((), ("timing",)):
        shown = call(*arguments, "--help")[1].partition("Commands:")[2]
        assert "..." not in shown
        assert shown.count(".\n") >= 5


@pytest.mark.parametrize("verb", ["run", "simulate", "inspect"])
def test_ctrl_c_is_one_line_and_status_130(verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fathom.bench.execution.sweep.sweep", interrupted)
    monkeypatch.setattr("fathom.datasets.simulated.simulator.simulate", interrupted)
    monkeypatch.setattr("fathom.bench.inspection.inspecting.open_to_inspect", interrupted)
    arguments = {
        "run": [write(tmp_path)],
        "simulate": ["yo-yo", "-o", tmp_path / "x"],
        "inspect": ["ictineu_stpere_2004"],
    }
    code, _, err = call(verb, *arguments[verb])
    assert code == 130
    assert err.splitlines()[-1].startswith("interrupted")


@pytest.mark.slow
def test_ctrl_c_keeps_the_finished_runs_and_exits_130(tmp_path: Path) -> None:
    labels = ", ".join(f"{{name: dead-reckoning, label: n{k}}}" for k in range(200))
    file = write(tmp_path, estimators=f"[{labels}]", logs="[{scenario: {duration_s: 300}}]")
    store = tmp_path / "short" / "runs.sqlite"
    running = subprocess.Popen(
        [FATHOM, "run", file, "--out", tmp_path, "--jobs", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 120
        while count(store) < 3 and time.monotonic() < deadline and running.poll() is None:
            time.sleep(0.05)
        os.killpg(running.pid, signal.SIGINT)  # as the terminal does: parent and workers
        out, err = running.communicate(timeout=120)
    finally:
        running.kill()
    assert running.returncode == 130, err
    assert f"kept in {store}" in err
    assert "Traceback" not in err
    assert out == ""
    assert 3 <= count(store) < 200
    deadline = time.monotonic() + 20
    while alive(running.pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not alive(running.pid)


def alive(group: int) -> list[str]:
    """The processes of a group that are left and no zombies."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, fields = stat.read_text().rsplit(")", 1)
        except OSError:
            continue
        state, _, its_group, *_ = fields.split()
        if int(its_group) == group and state != "Z":
            found.append(name)
    return found


def count(store: Path) -> int:
    if not store.is_file():
        return 0
    try:
        with closing(sqlite3.connect(store)) as connection:
            return int(connection.execute("SELECT count(*) FROM runs").fetchone()[0])
    except sqlite3.OperationalError:  # its table is not made yet
        return 0
