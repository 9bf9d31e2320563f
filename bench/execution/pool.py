"""Local worker processes: each does one task at a time, and is replaced when it dies, hangs, or ran others' code."""

from __future__ import annotations

import os
import pickle
import threading
import time
from collections import deque
from collections.abc import Collection, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from subprocess import TimeoutExpired
from typing import TypeAlias

from ...datasets.errors import one_line
from ...estimators.registry import ESTIMATORS
from .child import Child, start, uninterrupted
from .task import Finished, Stage, Task

GRACE_S = 5.0
"""A worker this far past the time of its stage hangs inside one call and is killed, s; a step takes milliseconds."""

START_S = 120.0
"""How long a worker may take to start, s: seconds as a rule, more on a loaded machine or a slow disk."""

LARGEST_ANSWER = 1 << 30
"""Bytes of a result; a day at one belief per second, smoothed as well, has a tenth of that."""

LOOK_S = 3600.0
"""Longest wait at a stretch, s; what is longer does not fit the system's clock."""

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


Answers: TypeAlias = "SimpleQueue[tuple[Worker, object]]"
"""What workers said: a Stage, a Finished, None at the end of the connection, or the error of what cannot be read."""


@dataclass(eq=False)
class Worker:
    """One process, with its present task and its last one. A thread receives what it says, which may be anything.

    Attributes:
        answers: where what it says goes; workers may share it.
        lost: it died, hangs, or has run code that is not ours; it must be killed and gets no other task.
    """

    answers: Answers = field(default_factory=SimpleQueue)
    child: Child = field(default_factory=lambda: start(f"{__package__}.worker:work"))
    task: Task | None = None
    last: Task | None = None
    doing: str = ""
    give_up_s: float = float("inf")
    lost: bool = False

    def __post_init__(self) -> None:
        threading.Thread(target=self._receive, daemon=True).start()

    def begin(self, task: Task) -> None:
        """Hand over a task; if the worker is already dead, `answers` say so."""
        self.task = self.last = task
        self._enter("starting", START_S)
        with suppress(OSError):
            self.child.connection.send(task)

    def take(self, answer: object) -> Finished | None:
        """Return the result of the task, given what the worker said; None if it goes on."""
        task = self.task
        assert task is not None
        if isinstance(answer, Stage) and answer.identity == task.identity:
            self._enter(answer.doing, answer.longest_s)
            return None
        if isinstance(answer, Finished) and task.answered_by(answer):
            self.lost = task.run.estimator.name not in ESTIMATORS
            self.task = None
            return answer
        if answer is None:
            with suppress(TimeoutExpired):
                self.child.process.wait(GRACE_S)
            code = self.child.process.returncode
            return self._fail("worker closed its connection" if code is None else f"worker died (exit code {code})")
        what = f"{type(answer).__name__}, which is no result of this run"
        why = one_line(answer) if isinstance(answer, Exception) else what
        return self._fail(f"worker gave what cannot be read: {why:.200}")

    def hung(self) -> Finished:
        """Return the result of a task that is out of time."""
        return self._fail(f"out of time: hung while {self.doing}; its worker was killed")

    def _enter(self, doing: str, longest_s: float) -> None:
        self.doing, self.give_up_s = doing, time.monotonic() + longest_s + GRACE_S

    def _fail(self, cause: str) -> Finished:
        task, self.task, self.lost = self.task, None, True
        assert task is not None
        return Finished([task.row("failed", cause)])

    def _receive(self) -> None:
        answer: object = self
        while answer is not None:
            try:
                message = self.child.connection.recv_bytes(LARGEST_ANSWER)
            except (EOFError, ConnectionError):
                answer = None
            except OSError as error:  # more than that, or what is no message
                self.answers.put((self, error))
                return
            else:
                answer = _read(message)
            self.answers.put((self, answer))


def _read(message: bytes) -> object:
    try:
        return pickle.loads(message)
    except Exception as error:  # another package's code may have written it
        return error


def next_finished(workers: Sequence[Worker], answers: Answers) -> Finished:
    """Wait for the next result of any of these workers, of which one at least has a task."""
    while True:
        busy = [worker for worker in workers if worker.task is not None]
        late = next((worker for worker in busy if time.monotonic() > worker.give_up_s), None)
        if late is not None:
            return late.hung()
        soonest_s = min(worker.give_up_s for worker in busy) - time.monotonic()
        try:
            worker, answer = answers.get(timeout=min(max(0.0, soonest_s), LOOK_S))
        except Empty:
            continue
        if worker in busy:
            finished = worker.take(answer)
            if finished is not None:
                return finished
        else:
            worker.lost = True  # it died, or speaks, without a task


def run_all(tasks: Sequence[Task], jobs: int = 0) -> Generator[Finished]:
    """Yield the result of each task as it ends, from `jobs` worker processes (0: one per core).

    Each worker has one task at a time, so if it dies, only that task fails, and a new worker replaces it. One that has
    run another package's estimator is replaced too: that code may have changed anything in its process.
    """
    queue, most = Queue(tasks), jobs or os.cpu_count() or 1
    answers: Answers = SimpleQueue()
    workers: list[Worker] = []
    try:
        while queue or any(worker.task for worker in workers):
            for worker in [worker for worker in workers if worker.lost and worker.task is None]:
                workers.remove(worker)
                worker.child.kill()
            while queue:
                idle = next((worker for worker in workers if worker.task is None), None)
                if idle is None and len(workers) == most:
                    break
                if idle is None:
                    workers.append(idle := Worker(answers))
                idle.begin(queue.take(idle.last, [other.last for other in workers if other is not idle]))
            yield next_finished(workers, answers)
    finally:
        with uninterrupted():
            for worker in workers:
                worker.child.kill()
