"""The same runs on a Dask cluster: descriptions go there, rows and trajectories come back.

Each worker has one task at a time. If a worker dies, another worker tries its task. Tasks that are not yet running stay
here: the scheduler holds one small task per worker, however many runs there are.
"""

from __future__ import annotations

import json
import os
import pickle
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from logging import CRITICAL
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from ...datasets.errors import one_line
from ..errors import ExperimentError
from .dask_worker import Greeting, dismiss, do, greet, greeting
from .pool import Queue
from .task import Finished, Task

if TYPE_CHECKING:
    from distributed import Client, Future
    from distributed.security import Security

TRIES = 3
"""After so many lost workers a run is recorded as failed: it is then more likely the cause than bad luck is."""

CONNECT_S = 15.0
"""How long a scheduler may take to answer, s; one on another continent takes less than one."""

LOOK_S = 1.0
"""How often the list of workers is read, s; runs take longer than that."""

ASSEMBLE_S = 30.0
"""How long the first runs wait until all workers have said which versions they have, s; a busy one may not answer."""

FETCH_S = 60.0
"""How long a finished worker may take to send its rows and trajectories, s; some megabytes."""


@dataclass(frozen=True)
class Tls:
    """The PEM files by which a scheduler and this process know each other.

    Attributes:
        ca: certificates of the authorities that sign.
        cert, key: certificate of this process, and its private key.
    """

    ca: Path
    cert: Path
    key: Path


def run_on_cluster(
    tasks: Sequence[Task], address: str, jobs: int, say: Callable[[str], None], tls: Tls | None = None
) -> Generator[Finished]:
    """Yield the result of each task as it ends, from the workers of a Dask cluster.

    Args:
        tasks: the runs.
        address: of a scheduler ("tcp://host:8786", "tls://host:8786"), or its scheduler file (.json); or "local", which
            makes a cluster of processes here for as long as this lasts. By a certificate that only these processes
            have, it lets no other user of the machine in.
        jobs: worker processes of a local cluster; 0 for one per core.
        say: called with messages for the user.
        tls: for a "tls://" address; by default what Dask's own configuration says.

    Raises:
        ExperimentError: the extra is missing; the scheduler cannot be reached, or is lost; a worker has other
            versions than this process, whose versions identify the runs.
    """
    if not tasks:
        return
    jobs = min(jobs or os.cpu_count() or 1, len(tasks)) if address == "local" else jobs
    with _connected(address, jobs, tls) as client:
        yield from _Cluster(client, tasks, say).run()


@contextmanager
def _connected(address: str, jobs: int, tls: Tls | None = None) -> Iterator[Client]:
    try:
        from distributed import Client, LocalCluster
        from distributed.security import Security

        own = Security.temporary() if address == "local" else None
    except ImportError as error:
        raise ExperimentError(f"{error}; --dask needs an extra: pip install 'fathom-bench[dask]'") from None
    if address == "local":
        from dask.config import set as configured

        with (
            configured(
                {
                    "distributed.scheduler.worker-ttl": None,
                    "distributed.scheduler.http.routes": [],  # nothing is served to who has no certificate
                    "distributed.worker.http.routes": [],
                }
            ),
            LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                memory_limit=0,
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=CRITICAL,
                security=own,
                preload=[f"{__package__}.dask_worker"],
            ) as cluster,
            Client(cluster, security=own, set_as_default=False) as client,
        ):
            yield client
        return
    if jobs:
        raise ExperimentError(f"--jobs {jobs}: only for --dask local; the cluster at {address} has its own workers")
    scheduler = _scheduler(address)
    security = _security(address, scheduler, tls)
    try:
        client = Client(scheduler, timeout=CONNECT_S, security=security, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ExperimentError(
            f"--dask {address}: no Dask scheduler answers within {CONNECT_S:.0f} s ({error}); expected local, "
            "tcp://host:port, tls://host:port, or a scheduler file (.json)"
        ) from None
    with client:
        yield client


def _security(address: str, scheduler: str, tls: Tls | None) -> Security | None:
    """Return what Dask wants of the files of a tls:// scheduler, or what its own configuration says; else None.

    Raises:
        ExperimentError: no certificates for tls://, some that cannot be read, or some for another kind of address.
    """
    from distributed.security import Security

    if not scheduler.startswith("tls://"):
        if tls is not None:
            raise ExperimentError(f"--dask {address}: --tls is for an address tls://host:port")
        return None
    files = {} if tls is None else {"tls_ca_file": tls.ca, "tls_client_cert": tls.cert, "tls_client_key": tls.key}
    security = Security(require_encryption=True, **{name: str(path) for name, path in files.items()})
    try:
        context = security.get_connection_args("client")["ssl_context"]
    except OSError as error:
        raise ExperimentError(f"--dask {address}: the files of --tls are no certificates and key ({error})") from None
    if context is None:
        raise ExperimentError(f"--dask {address}: give --tls CA CERT KEY, or Dask's own configuration of TLS")
    return security


def _scheduler(address: str) -> str:
    """Return the address in a scheduler file; any other as it is."""
    if not address.endswith(".json"):
        return address
    try:
        return str(json.loads(Path(address).read_text(encoding="utf-8"))["address"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ExperimentError(
            f"--dask {address}: not a scheduler file ({one_line(error)}); "
            f"`dask scheduler --scheduler-file {address}` makes one"
        ) from None


@dataclass(eq=False)
class _RemoteWorker:
    """A worker of the cluster: its present call, and its greeting."""

    address: str
    future: Future
    greeting: Greeting | None = None
    task: Task | None = None
    last: Task | None = None
    refused: bool = False

    @property
    def idle(self) -> bool:
        return self.greeting is not None and self.task is None and not self.refused


class _Cluster:
    """The workers of a cluster, and the task of each."""

    def __init__(self, client: Client, tasks: Sequence[Task], say: Callable[[str], None]) -> None:
        self.client, self.say, self.queue = client, say, Queue(tasks)
        self.sweep = uuid4().hex
        self.estimators = sorted({task.run.estimator.name for task in tasks})
        self.ours = greeting(self.estimators)
        self.workers: dict[str, _RemoteWorker] = {}
        self.answered: SimpleQueue[Future] = SimpleQueue()
        self.lost_with: dict[str, list[str]] = defaultdict(list)
        self.begun = self.waiting = False
        self.look_at_s = 0.0
        self.assembled_by_s = monotonic() + ASSEMBLE_S

    def run(self) -> Iterator[Finished]:
        """Yield the result of each task as it ends."""
        try:
            while self.queue or any(worker.task for worker in self.workers.values()):
                yield from self._look()
                self._hand_out()
                yield from self._collect()
        except (OSError, TimeoutError) as error:  # Dask's errors of communication among them
            where = self.client.scheduler.address if self.client.scheduler else "its address"
            raise ExperimentError(
                f"the scheduler at {where} is lost ({error}); finished runs are kept, and the same command continues"
            ) from None
        finally:
            self._dismiss()

    def _look(self) -> Iterator[Finished]:
        """Find workers that left, and put their tasks back; ask new ones for their versions."""
        if monotonic() < self.look_at_s:
            return
        workers: Any = self.client.nthreads()
        there = set(workers)
        self.look_at_s = monotonic() + LOOK_S
        for address in self.workers.keys() - there:
            yield from self._lost(self.workers.pop(address))
        for address in there - self.workers.keys():
            self.workers[address] = _RemoteWorker(address, self._ask(address, greet, self.estimators))
        if not self.workers and not self.waiting:
            self.say("waiting for workers to join the scheduler (Ctrl-C stops, and keeps finished runs)")
        self.waiting = not self.workers

    def _ask(self, address: str, function: Callable[..., Any], *args: Any) -> Future:
        """Call a function on this worker and no other."""
        key = f"fathom-{function.__name__}-{uuid4().hex}"
        future = self.client.submit(function, *args, key=key, workers=[address], allow_other_workers=False)
        future.add_done_callback(self.answered.put)
        return future

    def _hand_out(self) -> None:
        """Give every idle worker a task, once the first workers have said which versions they have."""
        if not self.begun and monotonic() < self.assembled_by_s and not all(h.greeting for h in self.workers.values()):
            return
        for worker in self.workers.values():
            if worker.idle and self.queue:
                others = [other.last for other in self.workers.values() if other is not worker]
                worker.task = worker.last = task = self.queue.take(worker.last, others)
                worker.future = self._ask(worker.address, do, self.sweep, pickle.dumps(task))
                self.begun = True

    def _collect(self) -> Iterator[Finished]:
        """Wait a while for an answer, and take it."""
        try:
            future = self.answered.get(timeout=LOOK_S)
        except Empty:
            return
        worker = next((worker for worker in self.workers.values() if worker.future is future), None)
        if worker is None:  # of a worker that is gone
            return
        try:
            answer = future.result(timeout=FETCH_S)
        except Exception as error:
            yield from self._failed(worker, error)
            return
        finally:
            future.release()
        if isinstance(answer, Greeting):
            self._meet(worker, answer)
        else:
            yield from self._accept(worker, answer)

    def _accept(self, worker: _RemoteWorker, answer: object) -> Iterator[Finished]:
        """Take the result of a worker's task; what is no result of it fails the task."""
        task, worker.task = worker.task, None
        if task is None:
            return
        if isinstance(answer, Finished) and task.answered_by(answer):
            yield answer
        else:
            cause = f"worker {worker.address} gave {type(answer).__name__}, which is no result of this run"
            yield Finished([task.row("failed", cause) | _provenance(worker)])

    def _meet(self, worker: _RemoteWorker, answer: Greeting) -> None:
        """Accept a worker whose versions are those of this process; its rows would otherwise name the wrong ones."""
        worker.greeting = answer
        mine, theirs = self.ours.versions, answer.versions
        differ = [
            f"{name} {theirs.get(name, 'absent')} there, {mine[name]} here"
            for name in mine
            if theirs.get(name) != mine[name]
        ]
        if differ:
            self._refuse(worker, f"{'; '.join(differ)}: install the same there, and start it again")
        elif answer.threads > 1:
            self.say(
                f"worker {worker.address} has {answer.threads} threads and is given one run at a time; "
                "start it with --nthreads 1, and more of them"
            )

    def _refuse(self, worker: _RemoteWorker, why: str) -> None:
        worker.refused = True
        if not self.begun:
            raise ExperimentError(f"worker {worker.address} is not like this process: {why}")
        self.say(f"worker {worker.address} is left out: {why}")

    def _failed(self, worker: _RemoteWorker, error: Exception) -> Iterator[Finished]:
        """Handle an error that Dask reports for a call."""
        from distributed import CancelledError, KilledWorker

        if isinstance(error, CancelledError | KilledWorker | OSError | TimeoutError):
            del self.workers[worker.address]  # if it is still there, it is greeted anew
            yield from self._lost(worker)
        elif worker.task is None:
            worker.greeting = worker.greeting or Greeting({}, {})
            self._refuse(worker, one_line(error))
        else:
            task, worker.task = worker.task, None
            yield Finished([task.row("failed", one_line(error)) | _provenance(worker)])

    def _lost(self, worker: _RemoteWorker) -> Iterator[Finished]:
        """Put back the task of a lost worker, unless it has lost TRIES workers."""
        self.client.cancel([worker.future], force=True)
        task = worker.task
        if task is None:
            return
        lost = self.lost_with[task.identity]
        lost.append(worker.address)
        if len(lost) < TRIES:
            self.queue.put_back(task)
            self.say(f"worker {worker.address} is gone; {task.run} is tried again")
        else:
            cause = f"its worker was lost {TRIES} times ({', '.join(lost)}): killed, out of memory, or out of reach"
            yield Finished([task.row("failed", cause) | _provenance(worker)])

    def _dismiss(self) -> None:
        """Cancel all tasks at the scheduler and end the processes on the workers."""
        with suppress(OSError, TimeoutError, RuntimeError):
            self.client.cancel([worker.future for worker in self.workers.values()], force=True)
            self.client.run(dismiss, self.sweep, workers=list(self.workers), on_error="ignore")
        self.workers.clear()


def _provenance(worker: _RemoteWorker) -> dict[str, str]:
    return worker.greeting.provenance if worker.greeting else {}
