"""The parent's side of local workers: processes that do one task at a time, and what becomes of them."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import wait
from typing import Any

from .store import Row
from .working import Task, work

THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")

GRACE_S = 120.0
"""A worker that is this far past its run's timeout hangs inside one call, and is killed."""


@dataclass
class Worker:
    """One process, with the task it is at."""

    connection: Any = field(init=False)
    process: Any = field(init=False)
    task: Task | None = None
    give_up_s: float = float("inf")

    def __post_init__(self) -> None:
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs,), daemon=True)
        with _deaf_to_ctrl_c():
            self.process.start()
        theirs.close()

    def begin(self, task: Task) -> None:
        """Hand over a task; a worker that is already dead is found out by `wait`."""
        self.task, self.give_up_s = task, time.monotonic() + 2 * task.experiment.timeout_s + GRACE_S
        try:
            self.connection.send(task)
        except OSError:
            return

    def kill(self) -> None:
        """End the process, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run_all(tasks: Sequence[Task], jobs: int = 0) -> Iterator[list[Row]]:
    """Yield the rows of each task as it ends, from `jobs` worker processes (0: one per core).

    Each worker has one task at a time, so a death is that task's, and is made good by a fresh worker.
    """
    waiting = deque(tasks)
    with _single_threaded_children():
        workers = [Worker() for _ in range(min(jobs or os.cpu_count() or 1, len(waiting)))]
        try:
            while waiting or any(worker.task for worker in workers):
                for worker in workers:
                    if worker.task is None and waiting:
                        worker.begin(waiting.popleft())
                busy = [worker for worker in workers if worker.task]
                ready = wait([worker.connection for worker in busy], max(0.0, _soonest(busy) - time.monotonic()))
                for worker in busy:
                    hung = time.monotonic() > worker.give_up_s
                    if worker.connection not in ready and not hung:
                        continue
                    rows = _collect(worker, hung)
                    if worker.task is not None:  # it did not survive
                        worker.kill()
                        workers[workers.index(worker)] = Worker()
                    yield rows
        finally:
            for worker in workers:
                worker.kill()


def _soonest(workers: Sequence[Worker]) -> float:
    return min(worker.give_up_s for worker in workers)


def _collect(worker: Worker, hung: bool) -> list[Row]:
    """Return the rows of a worker's task; the task stays with it where the worker is lost."""
    task = worker.task
    assert task is not None
    if hung and not worker.connection.poll():
        return [task.row("failed", "out of time: hung inside one call; its worker was killed")]
    try:
        rows = worker.connection.recv()
    except (EOFError, OSError):
        worker.process.join(10)
        return [task.row("failed", f"worker died (exit code {worker.process.exitcode})")]
    worker.task = None
    return rows


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Ignore SIGINT, so that a child started here ignores it from its first moment on; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Set the variables that libraries read when a child starts; timings are single-threaded."""
    before = {name: os.environ.get(name) for name in THREAD_COUNTS}
    os.environ.update(dict.fromkeys(THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
