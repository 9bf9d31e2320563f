"""Start a child process: one function, called with a connection to the parent.

Libraries in a child run on one thread. Ctrl-C does not reach a child, and a child ends when its parent ends. What it
prints goes to standard error. The parent starts this file as a script, with the packages of any revision to import; so
nothing but the standard library is imported here.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")
"""Libraries read these variables when a process starts. Timings are single-threaded."""

STDERR = 2
"""File descriptor."""
PR_SET_PDEATHSIG = 1
"""Of Linux's prctl(2): the signal that a process gets when its parent ends."""


@dataclass(frozen=True, eq=False)
class Child:
    """A process that was started, and the connection to it; a context manager that kills it."""

    connection: Any  # Connection; a socket on Windows
    process: Popen[bytes]

    def kill(self) -> None:
        """Kill the process at once, and those that it has started."""
        with suppress(ProcessLookupError, PermissionError):  # nobody is left
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.connection.close()
        if self.process.stdin is not None:
            self.process.stdin.close()

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ignore Ctrl-C inside the block: for the killing of children, which is short."""
    if threading.current_thread() is not threading.main_thread():  # others get no signals
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)


def start(
    target: str,
    *arguments: str,
    python: Path | str = sys.executable,
    path: Sequence[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> Child:
    """Start a process that calls one function, and ends when the function returns.

    Args:
        target: "module:function", or "file.py:function". The function gets the connection, then the arguments.
        arguments: what else the function gets.
        python: interpreter.
        path: folders that the child imports from; those of this process by default.
        environment: variables to set besides those of this process.
    """
    folders = [entry or os.getcwd() for entry in sys.path] if path is None else path
    ours, theirs = Pipe()
    with theirs:
        process = Popen(
            [str(python), "-P", __file__, str(theirs.fileno()), target, *arguments],
            stdin=PIPE,  # it closes when this process ends, however it ends
            stdout=STDERR,
            pass_fds=[theirs.fileno()],
            process_group=0,  # Ctrl-C goes to the group of the terminal
            env=os.environ
            | dict.fromkeys(THREAD_COUNTS, "1")
            | {"PYTHONPATH": os.pathsep.join(folders)}
            | dict(environment or {}),
        )
    return Child(ours, process)


def main(descriptor: str, target: str, *arguments: str) -> None:
    """Be the child: call the target with the connection."""
    _be_killed_with_parent()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    home, _, function = target.rpartition(":")
    found = runpy.run_path(home) if home.endswith(".py") else vars(import_module(home))
    found[function](Connection(int(descriptor)), *arguments)


def _be_killed_with_parent() -> None:
    """Ask Linux to kill this process as soon as its parent ends, even inside a long call; elsewhere do nothing."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _end_with_parent() -> None:
    """End this process as soon as its standard input closes."""
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
