"""A cluster does what the local workers do: the same rows, bit for bit, even if workers are lost."""

from __future__ import annotations

import ast
import inspect
import json
import os
import pickle
import re
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pandas as pd
import pytest
from distributed import Client
from distributed.security import Security
from fathom.bench.cli.app import app
from fathom.bench.errors import ExperimentError
from fathom.bench.execution import dask_pool as cluster
from fathom.bench.execution import dask_worker as remote
from fathom.bench.execution.pool import Queue, log_of
from fathom.bench.execution.sweep import run_experiment, sweep
from fathom.bench.execution.task import Finished, Task
from fathom.bench.execution.worker import WorkerCache
from fathom.bench.experiment.plan import Experiment
from fathom.bench.metrics.scoring import SCORES
from fathom.bench.results import identity as ledger
from fathom.bench.results.identity import content_sha256
from fathom.bench.results.store import load_runs
from fathom.datasets import Scenario, simulate
from fathom.datasets.described.folder import write_folder
from typer.testing import CliRunner

SHORT: dict[str, Any] = {"scenario": {"mission": "lawnmower", "duration_s": 20}}
POISON = """
if self.steps == 100:
    match self.kind:
        case "dies": os._exit(3)
        case "kills": os.kill(os.getppid(), signal.SIGKILL)
        case "dawdles": time.sleep(1.0)
if self.steps > 100 and self.kind == "kills":
    time.sleep(60)
"""


def experiment(**changes: Any) -> Experiment:
    content = {"name": "t", "logs": [SHORT], "estimators": [{"name": "dead-reckoning"}]} | changes
    return Experiment.from_dict(content, "t.yaml")


def poisoned(*kinds: str) -> list[dict[str, Any]]:
    return [{"name": "poison", "label": kind, "with": {"kind": kind}} for kind in kinds]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Somebody's package with an estimator `poison`, here and in every process started from here."""
    from packages import distribution, idler  # not above: a cluster's processes import this page, and find no other

    folder = tmp_path_factory.mktemp("site")
    distribution(folder, "poisons", "[fathom.estimators]\npoison = poisons:Idler\n", poisons=idler(POISON))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
        yield folder


@contextmanager
def started(*arguments: str) -> Iterator[None]:
    command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def scheduler(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The file of a scheduler with two workers, all processes of their own."""
    folder = tmp_path_factory.mktemp("dask")
    file = str(folder / "scheduler.json")
    here = ["--local-directory", str(folder)]
    with (
        started("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", file),
        started("dask_worker", "--scheduler-file", file, "--nworkers", "2", "--nthreads", "1", "--no-dashboard", *here),
    ):
        yield file


@pytest.fixture
def client(scheduler: str) -> Iterator[Client]:
    """Somebody who looks at the cluster from outside, once its two workers are there."""
    give_up_s = time.monotonic() + 60
    while not Path(scheduler).exists() and time.monotonic() < give_up_s:
        time.sleep(0.05)
    with Client(json.loads(Path(scheduler).read_text())["address"], timeout=60, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=120)
        yield client


def tasks_at(dask_scheduler: Any) -> list[str]:
    return list(dask_scheduler.tasks)


def holds_a_process() -> bool:
    return remote._SweepWorker.worker is not None


def assert_nothing_is_left(client: Client) -> None:
    give_up_s = time.monotonic() + 20
    while client.run_on_scheduler(tasks_at) and time.monotonic() < give_up_s:
        time.sleep(0.05)
    assert client.run_on_scheduler(tasks_at) == []
    while any(client.run(holds_a_process).values()) and time.monotonic() < give_up_s:
        time.sleep(0.05)
    assert not any(client.run(holds_a_process).values())


def assert_same(rows: pd.DataFrame, others: pd.DataFrame) -> None:
    """Compare two stores bit for bit, except for times."""
    names = ["log", "label", "seed", "status", "identity", "counts", "trajectory", "truth_trajectory", *SCORES]
    pd.testing.assert_frame_equal(rows[names], others[names], check_exact=True)


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_a_retry_and_the_rows_are_those_of_a_local_run(
    client: Client, scheduler: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    plan = experiment(estimators=[{"name": "eskf"}, *poisoned("dawdles")], seeds=4)
    pids = client.run(os.getpid)
    killed: list[str] = []

    def kill_one_at_work() -> None:
        while not killed:
            for worker, keys in client.processing().items():
                if any("do" in key for key in keys):
                    killed.append(worker)
                    os.kill(pids[worker], signal.SIGKILL)
                    return
            time.sleep(0.02)

    killer = threading.Thread(target=kill_one_at_work)
    killer.start()
    rows = run_experiment(plan, out=tmp_path / "cluster", dask=scheduler)
    killer.join()
    assert rows["status"].tolist() == ["done"] * 8
    assert f"worker {killed[0]} is gone; lawnmower-tactical" in capfd.readouterr().err
    assert_nothing_is_left(client)
    local = run_experiment(plan, out=tmp_path / "local", jobs=1)
    assert_same(rows, local)
    for name in {*rows["trajectory"], *rows["truth_trajectory"]}:
        tables = [pd.read_parquet(tmp_path / where / "t" / "trajectories" / name) for where in ("cluster", "local")]
        pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert sweep(plan, out=tmp_path / "cluster", jobs=1).standing == 8  # one ledger for both


@pytest.mark.slow
def test_a_run_that_takes_its_workers_along_is_a_failed_row_and_the_rest_is_done(
    client: Client, scheduler: str, tmp_path: Path
) -> None:
    plan = experiment(estimators=poisoned("kills", "dies", "none"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "TRIES", 2)
        rows = run_experiment(plan, out=tmp_path, dask=scheduler)
    assert rows["label"].tolist() == ["kills", "dies", "none"]
    assert rows["status"].tolist() == ["failed", "failed", "done"]
    kills, dies, none = (rows[rows["label"] == label] for label in ("kills", "dies", "none"))
    assert all(cause.startswith("its worker was lost 2 times (tcp://") for cause in kills["cause"])
    assert dies["cause"].tolist() == ["worker died (exit code 3)"]
    assert json.loads(kills["machine"].iloc[0]) == json.loads(none["machine"].iloc[0])
    assert_nothing_is_left(client)


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_takes_the_rest_off_the_cluster(
    client: Client, scheduler: str, tmp_path: Path
) -> None:
    plan = experiment(estimators=poisoned("dawdles"), seeds=30)
    over = threading.Event()

    def interrupt() -> None:
        while not over.is_set():
            if len(list(tmp_path.glob("t/trajectories/*.parquet"))) > 4:  # two of each run, written before its row
                os.kill(os.getpid(), signal.SIGINT)
                return
            time.sleep(0.05)

    watcher = threading.Thread(target=interrupt)
    watcher.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_experiment(plan, out=tmp_path, dask=scheduler)
    finally:
        over.set()
        watcher.join()
    assert_nothing_is_left(client)
    finished = load_runs(tmp_path / "t")
    assert 2 <= len(finished) < 30
    assert (finished["status"] == "done").all()


@pytest.mark.slow
def test_a_worker_that_computes_with_something_else_is_refused_by_name_before_anything_runs(
    client: Client, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = ledger.versions()
    monkeypatch.setattr(ledger, "versions", lambda: there | {"numpy": "1.0", "code": "0" * 64})
    with pytest.raises(ExperimentError, match=rf"tcp://.*numpy {there['numpy']} there, 1.0 here; code {there['code']}"):
        run_experiment(experiment(), out=tmp_path, dask=scheduler)
    assert len(load_runs(tmp_path / "t")) == 0
    assert_nothing_is_left(client)


@pytest.mark.slow
def test_a_recording_that_is_another_one_over_there_is_a_failed_row(
    client: Client, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_folder(simulate(Scenario(mission="lawnmower", duration_s=20), seed=1), tmp_path / "dive", "csv")
    monkeypatch.setattr("fathom.bench.execution.sweep.content_sha256", lambda log: "of another dive")
    rows = run_experiment(experiment(logs=[{"log": str(folder)}]), out=tmp_path / "out", dask=scheduler)
    assert rows["status"].tolist() == ["failed"]
    assert "DatasetError: dive: the recording on" in rows["cause"].iloc[0]


@pytest.mark.slow
def test_the_command_runs_on_a_cluster_of_its_own(tmp_path: Path, site: Path) -> None:
    file = tmp_path / "e.yaml"
    file.write_text(json.dumps({"logs": [SHORT], "estimators": [{"name": "dead-reckoning"}], "seeds": 2}))
    command = ["run", str(file), "--out", str(tmp_path / "out"), "--dask", "local", "--jobs", "2"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert load_runs(tmp_path / "out" / "e")["status"].tolist() == ["done", "done"]


@pytest.fixture
def certificates(tmp_path: Path) -> list[str]:
    """The files of an authority's certificate, of one for all roles, and of its key."""
    made = Security.temporary()
    texts = (made.tls_ca_file, made.tls_client_cert, made.tls_client_key)
    files = [tmp_path / name for name in ("ca.pem", "cert.pem", "key.pem")]
    for file, text in zip(files, texts, strict=True):
        file.write_text(str(text))
    return [str(file) for file in files]


def knock(address: str, context: ssl.SSLContext) -> bytes:
    """Return what a scheduler says to somebody on this machine; TLS 1.3 refuses a client after its handshake."""
    host, _, port = address.rpartition("://")[2].partition(":")
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        socket.create_connection((host, int(port)), timeout=30) as plain,
        context.wrap_socket(plain, server_hostname=host) as hidden,
    ):
        return hidden.recv(1)


@pytest.mark.slow
def test_a_cluster_on_this_machine_lets_nobody_else_in() -> None:
    with cluster._connected("local", 1) as client:
        assert client.scheduler is not None
        address = client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        assert all(worker.startswith("tls://127.0.0.1:") for worker in client.nthreads())
        of_another = Security.temporary().get_connection_args("client")["ssl_context"]
        for context in (ssl.create_default_context(), of_another):
            with pytest.raises((ssl.SSLError, ConnectionError)):
                knock(address, context)
        for page in client.run_on_scheduler(pages), *client.run(pages).values():
            with pytest.raises(HTTPError, match="404"):
                urlopen(page, timeout=30)


def pages(dask_scheduler: Any = None, dask_worker: Any = None) -> str:
    return f"http://127.0.0.1:{(dask_scheduler or dask_worker).http_server.port}/health"


@pytest.mark.slow
def test_a_cluster_behind_tls_is_reached_by_the_files_on_the_command(tmp_path: Path, certificates: list[str]) -> None:
    ca, cert, key = certificates
    tls = ["--tls-ca-file", ca, "--tls-cert", cert, "--tls-key", key, "--no-dashboard", "--protocol", "tls"]
    scheduler, file = str(tmp_path / "scheduler.json"), tmp_path / "e.yaml"
    file.write_text(json.dumps({"logs": [SHORT], "estimators": [{"name": "dead-reckoning"}]}))
    here = ["--nthreads", "1", "--local-directory", str(tmp_path)]
    with (
        started("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", scheduler, *tls),
        started("dask_worker", "--scheduler-file", scheduler, *here, *tls),
    ):
        give_up_s = time.monotonic() + 60
        while not Path(scheduler).exists() and time.monotonic() < give_up_s:
            time.sleep(0.05)
        command = ["run", str(file), "--out", str(tmp_path), "--dask", scheduler, "--tls", *certificates]
        result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output


def test_a_result_of_another_run_fails_the_run_that_was_asked_for() -> None:
    plan = experiment(estimators=[{"name": "dead-reckoning"}, {"name": "eskf"}])
    task, other = (Task.of(plan, run) for run in plan.runs())
    pool = object.__new__(cluster._Cluster)
    for answer in (Finished([other.row("done", None)]), Finished([]), "done", None):
        worker = cluster._RemoteWorker("tcp://there:1", None, task=task)  # type: ignore[arg-type]
        (finished,) = pool._accept(worker, answer)
        (row,) = finished.rows
        assert (row["status"], row["label"], worker.task) == ("failed", "dead-reckoning", None)
        assert "which is no result of this run" in row["cause"]


# -- what needs no cluster --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "options", "says"),
    [
        ("tcp://127.0.0.1:9", [], "no Dask scheduler answers within 1 s"),
        ("nowhere", [], "no Dask scheduler answers"),
        ("gone.json", [], "gone.json: not a scheduler file (FileNotFoundError"),
        ("tcp://127.0.0.1:9", ["--jobs", "3"], "--jobs 3: only for --dask local; the cluster at"),
        ("tcp://127.0.0.1:9", ["--tls", "a", "b", "c"], "--tls is for an address tls://host:port"),
        ("tls://127.0.0.1:9", [], "give --tls CA CERT KEY, or Dask's own configuration of TLS"),
        ("tls://127.0.0.1:9", ["--tls", "a", "b", "c"], "the files of --tls are no certificates and key"),
    ],
)
def test_an_address_where_no_scheduler_is_gets_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str, options: list[str], says: str
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    file = tmp_path / "e.yaml"
    file.write_text(json.dumps({"logs": [SHORT], "estimators": [{"name": "dead-reckoning"}]}))
    result = CliRunner().invoke(app, ["run", str(file), "--out", str(tmp_path), "--dask", address, *options])
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_the_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ExperimentError, match=r"pip install 'fathom-bench\[dask\]'"):
        run_experiment(experiment(), out=tmp_path, dask="local")


def test_a_task_is_a_few_kilobytes_however_many_runs_there_are() -> None:
    def size(seeds: int, estimators: int) -> int:
        plan = experiment(estimators=[{"name": "fls", "label": f"fls {k}"} for k in range(estimators)], seeds=seeds)
        task = Task.of(plan, plan.runs()[0])
        assert task.identity
        return len(pickle.dumps(task))

    assert size(1, 1) < 12_000
    assert abs(size(1000, 20) - size(1, 1)) < 100


def test_a_worker_goes_on_with_the_log_it_has_and_leaves_the_others_theirs() -> None:
    plan = experiment(estimators=[{"name": "dead-reckoning", "label": label} for label in "abc"], seeds=3)
    tasks = [Task.of(plan, run) for run in plan.runs()]
    queue, last, opened = Queue(tasks), [None, None], [0, 0]
    taken: list[Task] = []
    for k in (0, 1, 0, 1, 0, 1, 0, 1, 0):
        task = queue.take(last[k], [last[1 - k]])
        opened[k] += last[k] is None or log_of(task) != log_of(last[k])
        last[k] = task
        taken.append(task)
    assert not queue
    assert sorted(map(str, (task.run for task in taken))) == sorted(map(str, (task.run for task in tasks)))
    assert opened in ([2, 2], [2, 1])  # three logs, of which the last may be shared; in turns it would be three each
    queue.put_back(taken[4])
    assert queue.take(None, [taken[4]]) is taken[4]  # nobody starves for want of a log of his own


def test_a_log_that_differs_from_the_one_planned_is_refused_and_one_that_does_not_is_opened_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = simulate(Scenario(mission="lawnmower", duration_s=20), seed=1)
    folder = write_folder(log, tmp_path / "dive", "csv")
    plan = experiment(logs=[{"log": str(folder)}], estimators=[{"name": "dead-reckoning", "label": k} for k in "ab"])
    bench = WorkerCache()
    first, second = (Task.of(plan, run) for run in plan.runs())
    right = content_sha256(plan.logs[0].open(None))
    assert bench.execute(replace(first, readings_sha256=right)).rows[0]["status"] == "done"
    monkeypatch.setattr("fathom.bench.execution.worker.content_sha256", lambda value: pytest.fail("hashed twice"))
    assert bench.open(replace(second, readings_sha256=right)) is not None
    monkeypatch.undo()
    (row,) = bench.execute(replace(first, readings_sha256="x")).rows
    assert row["status"] == "failed"
    assert "dive: the recording on" in row["cause"]


def test_recordings_are_sought_where_the_worker_has_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = experiment()
    task = Task.of(plan, plan.runs()[0], data=tmp_path / "not here")
    monkeypatch.setenv("FATHOM_DATA", str(tmp_path))
    assert remote._with_data_here(task).data is None
    (tmp_path / "not here").mkdir()
    assert remote._with_data_here(task) is task


PAGE = Path(__file__).resolve().parents[3] / "docs" / "cluster.md"


@pytest.mark.slow
def test_the_page_says_what_the_commands_have() -> None:
    page = PAGE.read_text(encoding="utf-8")
    known = {
        "fathom run": CliRunner().invoke(app, ["run", "--help"], env={"COLUMNS": "200"}).output,
        "dask scheduler": help_of("dask_scheduler"),
        "dask worker": help_of("dask_worker"),
    }
    shown = [line for block in re.findall(r"```\n(.*?)```", page, re.DOTALL) for line in block.splitlines()]
    told = 0
    for line in shown:
        (command,) = (command for command in known if command in line)
        for option in re.findall(r"--[a-z-]+", line):
            assert option in known[command], line
            told += 1
    assert told >= 7
    for script in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        calls = [node for node in ast.walk(ast.parse(script)) if isinstance(node, ast.Call)]
        (call,) = (call for call in calls if ast.unparse(call.func) == "run_experiment")
        given = {keyword.arg for keyword in call.keywords}
        assert given <= set(inspect.signature(run_experiment).parameters)
        assert Experiment.load(ast.literal_eval(call.args[0])).runs()


def help_of(command: str) -> str:
    asked = [sys.executable, "-m", f"distributed.cli.{command}", "--help"]
    return subprocess.run(asked, capture_output=True, text=True, check=True, timeout=300).stdout
