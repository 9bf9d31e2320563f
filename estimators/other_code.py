"""Run other people's code in this process without a change to the process: to numbers, files or endings after it."""

from __future__ import annotations

import locale
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from decimal import localcontext

import numpy as np


@contextmanager
def process_kept() -> Iterator[None]:
    """Undo on leaving: folder, environment, signal handlers, locale, recursion limit, warnings, NumPy, decimal.

    What the code prints goes to standard error, since standard output is for results.
    """
    folder, environment, deepest = _folder(), dict(os.environ), sys.getrecursionlimit()
    language, handlers = locale.setlocale(locale.LC_ALL), _handlers()
    with warnings.catch_warnings(), np.errstate(), localcontext(), redirect_stdout(sys.stderr):
        try:
            yield
        finally:
            if folder is not None and _folder() != folder:
                os.chdir(folder)
            if environment != os.environ:
                os.environ.clear()
                os.environ.update(environment)
            sys.setrecursionlimit(deepest)
            locale.setlocale(locale.LC_ALL, language)
            for number, handler in _handlers().items():
                if handler is not handlers[number] and handlers[number] is not None:
                    signal.signal(number, handlers[number])


def _folder() -> str | None:
    with suppress(OSError):  # it may be deleted
        return os.getcwd()
    return None


def _handlers() -> dict[signal.Signals, signal._HANDLER]:
    """Return the handlers of signals; none in a thread, which cannot set any."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.getsignal(number) for number in signal.Signals}
