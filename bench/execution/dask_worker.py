"""The worker's side of a Dask cluster: one run at a time, in a process like a local worker's.

The run has a process of its own, because Dask's process must answer the scheduler: GTSAM holds Python's lock through
long calls, and a worker that is silent for minutes counts as dead. The process also keeps Dask's work out of the
timings, and a crash or hang costs one run.

The scheduler imports this module too, so the rest of the package is imported inside the functions.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from .pool import Worker
    from .task import Finished, Task


@dataclass(frozen=True)
class Greeting:
    """The versions that a worker computes with.

    Attributes:
        versions: as `identity.versions` gives them, and of the packages that estimators come from.
        provenance: what its rows say of commit, versions and machine.
        threads: how many tasks Dask would give it at once.
    """

    versions: dict[str, str]
    provenance: dict[str, str]
    threads: int = 1


class _SweepWorker:
    """The process for the runs of one sweep, which keeps logs and compiled code from one run to the next."""

    lock = threading.Lock()
    sweep: str = ""
    worker: Worker | None = None
    dismissed: ClassVar[set[str]] = set()


def greet(estimators: Sequence[str]) -> Greeting:
    """Return the versions of this process; `estimators` are the names of those that will be run."""
    from distributed import get_worker

    return replace(greeting(estimators), threads=get_worker().state.nthreads)


def greeting(estimators: Sequence[str]) -> Greeting:
    """Return the versions of this process, on a cluster or not."""
    from ...estimators.registry import package_of
    from ..results.identity import versions
    from ..results.store import provenance

    packages = {f"package of {name}": package_of(name) or "absent" for name in estimators}
    return Greeting(versions() | packages, provenance())


def do(sweep: str, task: bytes) -> Finished:
    """Do a pickled task in the process that this worker keeps for the sweep, and return its result.

    Recordings are read from the task's folder if it exists on this machine, else from FATHOM_DATA.
    """
    from .pool import Worker, next_finished

    with _SweepWorker.lock:  # one run at a time even with several threads, or timings would be wrong
        if sweep in _SweepWorker.dismissed:
            raise RuntimeError("the sweep has ended")  # nobody waits for the result
        if _SweepWorker.worker is None or _SweepWorker.sweep != sweep:
            _let_go()
            _SweepWorker.worker, _SweepWorker.sweep = Worker(), sweep
        worker = _SweepWorker.worker
        worker.begin(_with_data_here(pickle.loads(task)))
        finished = next_finished([worker], worker.answers)
        if worker.lost or sweep in _SweepWorker.dismissed:  # it did not survive, or is needed no longer
            _let_go()
        return finished


def dismiss(sweep: str) -> None:
    """End the sweep's process and the run in it; a run of the sweep that Dask hands over later does not begin."""
    _SweepWorker.dismissed.add(sweep)
    worker = _SweepWorker.worker
    if worker is None or _SweepWorker.sweep != sweep:
        return
    worker.child.process.kill()  # a `do` that waits for it ends, and forgets it
    if _SweepWorker.lock.acquire(blocking=False):
        try:
            _let_go()
        finally:
            _SweepWorker.lock.release()


def _let_go() -> None:
    if _SweepWorker.worker is not None:
        _SweepWorker.worker.child.kill()
        _SweepWorker.worker = None


def _with_data_here(task: Task) -> Task:
    if task.data is None or task.data.is_dir() or not os.environ.get("FATHOM_DATA"):
        return task
    return replace(task, data=None)


def dask_setup(_: Any) -> None:
    """Leave Ctrl-C to the process that started this one; Dask calls it in workers that preload this module."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
