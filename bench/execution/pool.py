"""Local worker processes: each does one task at a time, and is replaced when it dies or hangs."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Collection, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from subprocess import TimeoutExpired
from typing import TypeAlias

from .child import Child, start, uninterrupted
from .task import Finished, Task

GRACE_S = 120.0
"""A worker this far past twice its run's timeout hangs inside one call and is killed, s; starting one takes seconds."""

LogName: TypeAlias = tuple[str, int | None]
"""A log of one experiment: its name and seed."""


class Queue:
    """Waiting tasks, in order; but a worker keeps to the log that it has in memory, if the others have logs too."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._by_log: dict[LogName, deque[Task]] = {}
        for task in tasks:
            self._by_log.setdefault(log_of(task), deque()).append(task)

    def __bool__(self) -> bool:
        return bool(self._by_log)

    def take(self, last: Task | None, others: Collection[Task | None]) -> Task:
        """Return the next task for a worker, given its last one and those of the other workers.

        It is on the log that the worker has in memory; else on the first that no other worker has; else on the first.
        """
        mine, theirs = last and log_of(last), {log_of(task) for task in others if task}
        if mine not in self._by_log:
            mine = next((log for log in self._by_log if log not in theirs), next(iter(self._by_log)))
        tasks = self._by_log[mine]
        task = tasks.popleft()
        if not tasks:
            del self._by_log[mine]
        return task

    def put_back(self, task: Task) -> None:
        """Return a task whose worker was lost; it is the next on its log."""
        self._by_log.setdefault(log_of(task), deque()).appendleft(task)


def log_of(task: Task) -> LogName:
    """Return the name of the task's log within its experiment."""
    return task.run.log.name, task.run.seed


@dataclass(eq=False)
class Worker:
    """One process, with its present task and its last one."""

    child: Child = field(default_factory=lambda: start(f"{__package__}.worker:work"))
    task: Task | None = None
    last: Task | None = None
    give_up_s: float = float("inf")

    def begin(self, task: Task) -> None:
        """Hand over a task; `wait` notices if the worker is already dead."""
        self.task = self.last = task
        self.give_up_s = time.monotonic() + 2 * task.timeout_s + GRACE_S
        with suppress(OSError):
            self.child.connection.send(task)

    def collect(self) -> Finished:
        """Return the result of the task, once the connection is ready or time is out.

        If the worker is lost it keeps its task, and must be killed.
        """
        task = self.task
        assert task is not None
        if not self.child.connection.poll():
            return Finished([task.row("failed", "out of time: hung inside one call; its worker was killed")])
        try:
            finished = self.child.connection.recv()
        except (EOFError, OSError):
            with suppress(TimeoutExpired):
                self.child.process.wait(10)
            return Finished([task.row("failed", f"worker died (exit code {self.child.process.returncode})")])
        self.task = None
        return finished


def run_all(tasks: Sequence[Task], jobs: int = 0) -> Generator[Finished]:
    """Yield the result of each task as it ends, from `jobs` worker processes (0: one per core).

    Each worker has one task at a time, so if it dies, only that task fails, and a new worker replaces it.
    """
    queue = Queue(tasks)
    workers = [Worker() for _ in range(min(jobs or os.cpu_count() or 1, len(tasks)))]
    try:
        while queue or any(worker.task for worker in workers):
            for worker in workers:
                if worker.task is None and queue:
                    others = [other.last for other in workers if other is not worker]
                    worker.begin(queue.take(worker.last, others))
            busy = [worker for worker in workers if worker.task]
            ready = wait([worker.child.connection for worker in busy], max(0.0, _soonest(busy) - time.monotonic()))
            for worker in busy:
                if worker.child.connection not in ready and time.monotonic() <= worker.give_up_s:
                    continue
                finished = worker.collect()
                if worker.task is not None:  # it did not survive
                    worker.child.kill()
                    workers[workers.index(worker)] = Worker()
                yield finished
    finally:
        with uninterrupted():
            for worker in workers:
                worker.child.kill()


def _soonest(workers: Sequence[Worker]) -> float:
    return min(worker.give_up_s for worker in workers)
