from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from fathom.bench.errors import ExperimentError
from fathom.bench.execution.drive import warm_up
from fathom.bench.execution.pool import Worker
from fathom.bench.execution.sweep import run_experiment
from fathom.bench.execution.worker import work
from fathom.bench.experiment.packaged import shipped_experiments
from fathom.bench.experiment.plan import Experiment
from fathom.bench.output.remarks import failures
from fathom.bench.results.store import load_runs
from fathom.bench.results.summary import records, summarise
from fathom.estimators import create
from packages import distribution

SHORT = {"scenario": {"mission": "lawnmower", "duration_s": 20}}
PLUGIN = '''
import os, time
from pydantic.dataclasses import dataclass
from fathom.datasets import Belief
from fathom.estimators import FACTORS, Diverged

@dataclass(frozen=True)
class Mishap:
    """Stays where it is, until `at` epochs have gone by."""

    kind: str = "none"
    at: int = 100
    factors: frozenset[str] = FACTORS

    def begin(self, prior, rig):
        return Pass(self, prior)

class Pass:
    def __init__(self, config, prior):
        self.config, self.prior, self.t_ns, self.counts = config, prior, prior.t_ns, {}

    def step(self, epoch):
        self.t_ns = epoch.t_ns
        self.counts["steps"] = self.counts.get("steps", 0) + 1
        if self.counts["steps"] == self.config.at and self.prior.t_ns >= 0:
            match self.config.kind:
                case "dies" if os.environ.get("OMP_NUM_THREADS") == "1": os._exit(3)
                case "hangs": time.sleep(3600)
                case "diverges": raise Diverged("lost")
                case "throws": raise ZeroDivisionError("nought")

    def belief(self):
        return Belief(self.t_ns, self.prior.state, self.prior.P)

    def finish(self):
        return None
'''


@pytest.fixture
def mishap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install another package with an estimator `mishap`, here and in the workers."""
    site = tmp_path / "site"
    distribution(site, "mishaps", "[fathom.estimators]\nmishap = mishaps:Mishap\n", mishaps=PLUGIN)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))
    monkeypatch.delitem(sys.modules, "mishaps", raising=False)


def experiment(**changes: Any) -> Experiment:
    content = {"name": "t", "logs": [SHORT], "estimators": [{"name": "dead-reckoning"}]} | changes
    return Experiment.from_dict(content, "t.yaml")


def test_the_shipped_experiments_are_valid() -> None:
    for name in shipped_experiments():
        assert Experiment.load(name).runs()


def test_a_yaml_file_says_what_runs(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        """
logs:
  - scenario: {mission: yo-yo, duration_s: 30, imu: industrial}
  - {log: ictineu_stpere_2004, align: yaw, dims: 2d}
estimators:
  - {name: eskf}
  - {name: eskf, label: no dvl, with: {factors: [depth, heading]}}
seeds: [4, 5]
scores: {rpe_delta: 5}
"""
    )
    plan = Experiment.load(file)
    assert plan.name == "mine"
    assert [str(run) for run in plan.runs()] == [
        "yo-yo-industrial / eskf seed 4",
        "yo-yo-industrial / no dvl seed 4",
        "yo-yo-industrial / eskf seed 5",
        "yo-yo-industrial / no dvl seed 5",
        "ictineu_stpere_2004 / eskf",
        "ictineu_stpere_2004 / no dvl",
    ]
    assert [(plan.scoring(log).align, plan.scoring(log).dims) for log in plan.logs] == [("none", "3d"), ("yaw", "2d")]
    assert plan.scoring(plan.logs[1]).rpe_delta == 5.0


def test_a_number_of_seeds_counts_from_one() -> None:
    assert experiment(seeds=3).seeds == (1, 2, 3)
    assert experiment(seeds=[3]).seeds == (3,)


@pytest.mark.parametrize("seeds", [0, -1, 10**6, "three", True, 2.0])
def test_seeds_that_are_neither_a_list_nor_a_number_of_them_are_refused(seeds: object) -> None:
    with pytest.raises(ExperimentError, match="`seeds`: expected a list of seeds, or how many"):
        experiment(seeds=seeds)


def test_the_spec_of_a_run_holds_every_default_and_is_json() -> None:
    plan = experiment(estimators=[{"name": "eskf", "with": {"factors": ["heading", "dvl", "depth"]}}])
    spec = json.loads(json.dumps(plan.spec(plan.runs()[0])))
    assert spec["estimator"]["config"]["factors"] == ["depth", "dvl", "heading"]
    assert spec["log"]["duration_s"] == 20.0
    assert spec["log"]["gravity_m_s2"] == 9.81
    assert spec["seed"] == 1
    assert (spec["repair"], spec["log_sha256"]) == (False, None)


def test_the_spec_of_a_recorded_run_knows_its_description_and_whether_it_was_repaired(tmp_path: Path) -> None:
    (tmp_path / "dive").mkdir()
    (tmp_path / "dive" / "log.yaml").write_text("a: 1\n")
    plan = experiment(logs=[{"log": str(tmp_path / "dive")}, {"log": "ictineu_stpere_2004"}])
    dive, ictineu = plan.runs()
    before = plan.spec(dive, repair=True)
    assert before["repair"]
    assert before["log_sha256"] == sha256(b"a: 1\n").hexdigest()
    assert len(plan.spec(ictineu)["log_sha256"]) == 64
    (tmp_path / "dive" / "log.yaml").write_text("a: 2\n")
    assert plan.spec(dive)["log_sha256"] != before["log_sha256"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"sedes": [1]}, ["unknown key `sedes`", "did you mean 'seeds'"]),
        ({"logs": [SHORT | {"aline": "yaw"}]}, ["logs[0].aline", "did you mean 'align'"]),
        ({"estimators": [{"name": "eskf", "wiht": {}}]}, ["estimators[0].wiht", "did you mean 'with'"]),
        ({"estimators": [{"name": "esfk"}]}, ["estimators[0]", "no estimator 'esfk'", "did you mean 'eskf'"]),
        (
            {"estimators": [{"name": "eskf", "with": {"infalte": {}}}]},
            ["no option 'infalte'", "did you mean 'inflate'"],
        ),
        ({"estimators": [{"name": "eskf"}, {"name": "eskf"}]}, ["label 'eskf'", "twice", "`label`"]),
        ({"logs": [SHORT, SHORT]}, ["log name 'lawnmower-tactical'", "twice", "`name`"]),
        ({"logs": [{"scenario": {"mission": "lawnmover"}}]}, ["logs[0]", "lawnmover", "did you mean 'lawnmower'"]),
        ({"logs": [{"scenario": {"misson": "yo-yo"}}]}, ["logs[0]", "misson", "did you mean 'mission'"]),
        ({"logs": [SHORT | {"log": "x"}]}, ["logs[0]", "not both"]),
        ({"logs": [{}]}, ["logs[0]", "either"]),
        ({"logs": []}, ["logs"]),
        ({"seeds": []}, ["seeds"]),
        ({"seeds": [-1]}, ["seeds[0]", "-1"]),
        ({"seeds": [2**63]}, ["seeds[0]", "less than"]),
        ({"scores": {"rpe_delta": 1.5, "rpe_unit": "frames"}}, ["scores", "whole in frames", "1.5"]),
        ({"scores": {"score_period_s": 1e-12}}, ["scores.score_period_s", "0.001"]),
        ({"estimators": ["esfk"]}, ["estimators[0]", "did you mean 'eskf'"]),
        ({"estimators": 3}, ["`estimators`: expected a list, found 3"]),
        ({"estimators": [3]}, ["estimators[0]", "expected keys", "baseline"]),
        ({"scores": ["nsi"]}, ["`scores`: no score 'nsi'", "did you mean 'nis'"]),
        ({"scores": [3]}, ["`scores`: no score 3"]),
        ({"scores": [{"align": "yaw"}, {"align": "none"}]}, ["`scores`: 'align' is there twice"]),
        ({"logs": [SHORT | {"name": "a\ud800"}]}, ["'a\\ud800' has a character that is no text"]),
        ({"scores": {1: 2}}, ["`scores[1]`", "expected text as a key"]),
        ({"seeds": [1.5]}, ["`seeds[0]`: expected a whole number, found 1.5"]),
        ({"scores": 3}, ["`scores`: expected keys and values (", "nees_epochs"]),
        ({"scores": {"nis": "maybe"}}, ["`scores.nis`: expected true or false, found 'maybe'"]),
        ({"scores": {"align": "se4"}}, ["`scores.align`: expected 'none', 'origin', 'yaw' or 'se3', found 'se4'"]),
        ({"timeout_s": "x"}, ["`timeout_s`: expected a number, found 'x'"]),
        ({"timeout_s": -1}, ["`timeout_s`: expected greater than 0, found -1"]),
        ({"name": 3}, ["`name`: expected text, found 3"]),
        ({"scores": {"nees_epochs": 0}}, ["scores.nees_epochs", "greater than or equal to 1"]),
        ({"scores": {"nsi": True}}, ["scores.nsi", "did you mean 'nis'"]),
        ({"seeds": [1, 1]}, ["seed 1", "twice"]),
        ({"scores": {"align": "jaw"}}, ["scores.align", "'jaw'", "yaw"]),
        ({"scores": {"rpe_detla": 1}}, ["scores.rpe_detla", "did you mean 'rpe_delta'"]),
        ({"timeout_s": 0}, ["timeout_s"]),
        ({"name": "../up"}, ["`name`: expected text that matches"]),
    ],
)
def test_a_wrong_key_or_value_is_named_with_its_place_and_neighbour(changes: dict[str, Any], says: list[str]) -> None:
    with pytest.raises(ExperimentError) as caught:
        experiment(**changes)
    assert str(caught.value).startswith("t.yaml: ")
    for words in says:
        assert words in str(caught.value)


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ({"estimators": ["eskf", "rts"]}, {"estimators": [{"name": "eskf"}, {"name": "rts"}]}),
        ({"estimators": "eskf"}, {"estimators": [{"name": "eskf"}]}),
        ({"estimators": {"name": "eskf"}}, {"estimators": [{"name": "eskf"}]}),
        (
            {"estimators": ["eskf", {"name": "eskf", "label": "b", "drop": ["gps"]}]},
            {"estimators": [{"name": "eskf"}, {"name": "eskf", "label": "b", "drop": ["gps"]}]},
        ),
        ({"logs": ["box", "a/folder"]}, {"logs": [{"scenario": {"mission": "box"}}, {"log": "a/folder"}]}),
        ({"logs": "ictineu_stpere_2004"}, {"logs": [{"log": "ictineu_stpere_2004"}]}),
        ({"scores": ["nis", {"align": "yaw"}, "ate_rmse_m"]}, {"scores": {"nis": True, "align": "yaw"}}),
        ({"scores": "floor"}, {"scores": {"floor": True}}),
        ({"scores": ["nis_dvl", "nis"]}, {"scores": {"nis": True}}),
        ({"compare": "drms_m"}, {"compare": ["drms_m"]}),
        ({"tune": {"train": "box", "held_out": "box/2"}}, {"tune": {"train": ["box"], "held_out": ["box/2"]}}),
    ],
)
def test_a_name_alone_is_an_entry(short: dict[str, Any], long: dict[str, Any]) -> None:
    assert experiment(**short) == experiment(**long)


def test_one_mistake_is_one_complaint() -> None:
    with pytest.raises(ExperimentError) as caught:
        experiment(estimators=[{"name": "esfk"}])
    assert "at least 1 item" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [("a: [", "not YAML: did not find"), ("- 1", "expected keys"), ("", "expected keys"), ("logs: []", "estimators")],
)
def test_a_broken_file_is_named(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "e.yaml"
    file.write_text(text)
    with pytest.raises(ExperimentError, match=r"e\.yaml") as caught:
        Experiment.load(file)
    assert says in str(caught.value)


def test_an_unknown_experiment_is_answered_with_the_nearest() -> None:
    with pytest.raises(ExperimentError, match="did you mean 'smoke'"):
        Experiment.load("smoek")
    assert Experiment.load("filter-vs-smoother").name == "filter_vs_smoother"
    with pytest.raises(ExperimentError, match="no such experiment"):
        Experiment.load("x" * 300)


@pytest.mark.slow
def test_mishaps_are_rows_and_the_others_go_on(tmp_path: Path, mishap: None) -> None:
    kinds = ("dies", "diverges", "throws", "none")
    plan = experiment(
        logs=[SHORT, {"log": "ictineu_stpere_2004"}],
        estimators=[{"name": "mishap", "label": kind, "with": {"kind": kind}} for kind in kinds],
        seeds=[1, 2],
    )
    # the warm-up, too, meets the mishap of the kind that dies: it is the run's
    rows = run_experiment(plan, data=tmp_path, out=tmp_path / "out", jobs=2)
    here = rows[rows["log"] == "lawnmower-tactical"]
    assert here["label"].tolist() == [*kinds, *kinds]
    assert here["status"].tolist() == ["failed", "diverged", "failed", "done"] * 2
    assert here["cause"].tolist()[:3] == ["worker died (exit code 3)", "lost", "ZeroDivisionError: nought"]
    assert here["ate_rmse_m"].notna().tolist() == [False, True, True, True] * 2
    absent = rows[rows["log"] == "ictineu_stpere_2004"]
    assert absent["status"].tolist() == ["absent"] * 4
    assert all("not here" in cause for cause in absent["cause"])
    assert len(load_runs(tmp_path / "out" / "t")) == len(rows)
    lines = failures(records(rows))
    assert len(lines) == 4  # both seeds of a kind end alike
    assert lines[0] == "lawnmower-tactical / dies seeds 1–2: failed: worker died (exit code 3)"
    summary = {(row["log"], row["label"]): row for row in summarise(rows)}
    assert summary["lawnmower-tactical", "none"]["done"] == 2
    assert summary["lawnmower-tactical", "throws"]["ate_rmse_m"] is None


@pytest.mark.slow
def test_a_worker_hung_in_one_call_is_killed(tmp_path: Path, mishap: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fathom.bench.execution.pool.GRACE_S", 15.0)
    warm_up(create("dead-reckoning"))  # or its worker compiles for longer than that
    plan = experiment(
        estimators=[{"name": "mishap", "with": {"kind": "hangs"}}, {"name": "dead-reckoning"}], timeout_s=1.0
    )
    rows = run_experiment(plan, out=tmp_path, jobs=1).set_index("label")
    assert rows.loc["mishap", "status"] == "failed"
    assert "hung" in rows.loc["mishap", "cause"]
    assert rows.loc["dead-reckoning", "status"] == "done"


@pytest.mark.slow
def test_a_row_says_where_its_numbers_come_from_and_running_again_replaces_it(tmp_path: Path) -> None:
    first = run_experiment(experiment(), out=tmp_path, jobs=1)
    again = run_experiment(experiment(), out=tmp_path, jobs=1)
    assert len(load_runs(tmp_path / "t")) == len(first) == len(again) == 1
    row = again.iloc[0]
    assert row["ate_rmse_m"] == first.iloc[0]["ate_rmse_m"]
    assert json.loads(row["versions"])["numpy"]
    assert json.loads(row["machine"])["cores"] >= 1
    assert len(row["commit_id"]) >= 10
    assert json.loads(row["spec"])["estimator"]["name"] == "dead-reckoning"
    assert row["started"] <= row["finished"]
    for name in (row["trajectory"], row["truth_trajectory"]):
        assert (tmp_path / "t" / "trajectories" / name).stat().st_size < 100_000


@pytest.mark.slow
def test_only_runs_what_matches(tmp_path: Path) -> None:
    plan = experiment(estimators=[{"name": "dead-reckoning", "label": label} for label in ("a", "b", "bb")])
    assert run_experiment(plan, out=tmp_path, jobs=1, only="b*")["label"].tolist() == ["b", "bb"]
    assert run_experiment(plan, out=tmp_path, jobs=1, only="*/a")["label"].tolist() == ["a"]
    with pytest.raises(ExperimentError, match="lawnmower-tactical/bb"):
        run_experiment(plan, out=tmp_path, only="c")


@pytest.mark.slow
def test_estimators_share_their_random_numbers(tmp_path: Path) -> None:
    twins = [{"name": "dead-reckoning", "label": label} for label in ("one", "two")]
    rows = run_experiment(experiment(estimators=twins, seeds=[1, 2]), out=tmp_path, jobs=2)
    by_seed = rows.pivot_table(index="seed", columns="label", values="ate_rmse_m")
    assert (by_seed["one"] == by_seed["two"]).all()
    assert by_seed["one"].nunique() == 2


@pytest.mark.slow
def test_seeds_are_pooled_before_the_root(tmp_path: Path) -> None:
    rows = run_experiment(experiment(seeds=[1, 2, 3]), out=tmp_path, jobs=2)
    (summary,) = summarise(rows)
    squared = (rows["ate_rmse_m"] ** 2 * rows["n_scored"]).sum() / rows["n_scored"].sum()
    assert summary["ate_rmse_m"] == pytest.approx(squared**0.5)
    assert summary["ate_rmse_m"] != pytest.approx(rows["ate_rmse_m"].mean())


@pytest.mark.parametrize("name", ["figures", "trajectories", "table.csv", "consistency.csv"])
def test_what_is_in_the_way_of_results_is_named_before_anything_runs(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "t"
    if name.endswith(".csv"):
        (folder / name).mkdir(parents=True)
    else:
        folder.mkdir()
        (folder / name).write_text("in the way")
    with pytest.raises(ExperimentError, match=name):
        run_experiment(experiment(), out=tmp_path)
    assert not (folder / "runs.sqlite").exists()


def test_a_worker_is_out_of_reach_of_ctrl_c_from_its_first_moment() -> None:
    worker = Worker()
    try:
        assert os.getpgid(worker.child.process.pid) == worker.child.process.pid != os.getpgid(0)
    finally:
        worker.child.kill()


ORPHANED = """
import sys, time
from fathom.bench.experiment.plan import Experiment
from fathom.bench.execution.pool import Worker
from fathom.bench.execution.task import Task

log = {"scenario": {"mission": "lawnmower", "duration_s": 20}}
estimator = {"name": "mishap", "with": {"kind": "hangs"}}
plan = Experiment.from_dict({"name": "t", "logs": [log], "estimators": [estimator]})
worker = Worker()
worker.begin(Task.of(plan, plan.runs()[0]))
print(worker.child.process.pid, flush=True)
time.sleep(3600)
"""


@pytest.mark.slow
def test_a_worker_in_the_midst_of_a_run_ends_with_its_parent(tmp_path: Path, mishap: None) -> None:
    with subprocess.Popen([sys.executable, "-c", ORPHANED], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        parent.kill()
    give_up_s = time.monotonic() + 60
    while Path(f"/proc/{worker}").exists() and time.monotonic() < give_up_s:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


def test_a_worker_whose_parent_is_gone_ends_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone:
        def recv(self) -> None:
            return None

        def send(self, rows: object) -> None:
            raise BrokenPipeError

    monkeypatch.setattr("fathom.bench.execution.worker.WorkerCache.execute", lambda bench, task: [])
    work(Gone())


def test_the_log_of_the_current_folder_is_called_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    content = {"name": "e", "logs": [{"log": "."}], "estimators": [{"name": "eskf"}]}
    assert Experiment.from_dict(content).logs[0].name == tmp_path.name
