"""Run a piece of a test in a child with little memory and time, for files that claim to be larger than they are."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def limited(action: Callable[[], Any], megabytes: int, seconds: int = 20) -> Any:
    """Return what `action` returns or raise what it raises, in a fork with so much more address space and CPU time.

    What is returned or raised must pickle. An excess is a MemoryError, or a TimeoutError.
    """
    if not sys.platform.startswith("linux"):
        pytest.skip("the limit of address space is Linux's")
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside idle threads of the libraries
        child = os.fork()
    if not child:
        os.close(reading)
        resource.setrlimit(resource.RLIMIT_AS, (used + (megabytes << 20),) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            answer: tuple[bool, Any] = True, action()
        except BaseException as error:  # it is raised again in the parent
            answer = False, error
        try:
            data = pickle.dumps(answer)
        except Exception as error:
            data = pickle.dumps((False, TypeError(f"{answer[1]!r} does not pickle: {error}")))
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(data)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        data = pipe.read()
    status = os.waitpid(child, 0)[1]
    if not data:
        killed = os.WTERMSIG(status) if os.WIFSIGNALED(status) else None
        raise (
            TimeoutError(f"over {seconds} s") if killed == signal.SIGXCPU else MemoryError(f"the child died: {status}")
        )
    done, found = pickle.loads(data)
    if not done:
        raise found
    return found
