"""Compile before workers start: otherwise each of them would compile the same code, minutes of computing each.

One process per core compiles, one estimator at a time; all of them, and the workers later, share the cache of compiled
code. Any failure here is left to the workers.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, cast

from rich.console import Console

from ... import estimators
from ...datasets.compiling.cache import compiled_folder
from ...estimators.interface import Estimator
from ...estimators.registry import ESTIMATORS
from ..experiment.plan import plain
from ..saying import say
from .child import Child, start

NOTICE = "compiling, once on this machine"
DURATION = "; on two cores about half a minute in all"
HEAVIEST = ("WindowSmoother", "BatchSmoother", "UnscentedKalmanFilter", "InvariantKalmanFilter")
"""Kinds that take longest to compile, in this order; they go first, so that no core ends with a long one alone."""
SERVE = f"{__name__}:serve"


def compile_first(wanted: Iterable[Estimator]) -> None:
    """Compile what the estimators need and no earlier run has compiled; as a rule there is nothing to do.

    Progress goes to standard error, and only where something is compiled: on a terminal as a line that changes, else as
    one line for each estimator. Estimators of other packages are left to their workers.
    """
    own = f"{estimators.__name__}."
    unknown = {code_of(one): one for one in wanted if type(one).__module__.startswith(own)}
    with suppress(OSError):
        for code in warm():
            unknown.pop(code, None)
    queue = sorted(unknown.items(), key=lambda each: _weight(each[1]), reverse=True)
    progress = Progress([type(estimator) for _, estimator in queue])
    with progress.shown(), ExitStack() as children:
        busy: dict[Any, tuple[Child, str, str]] = {}  # by connection: the child, the code it compiles, and for whom

        def hand_over(child: Child) -> None:
            if queue:
                code, estimator = queue.pop(0)
                busy[child.connection] = child, code, type(estimator).__name__
                child.connection.send(estimator)

        for _ in range(min(len(queue), _cores())):
            hand_over(children.enter_context(start(SERVE)))
        while busy:
            for connection in wait(list(busy)):
                child, code, kind = busy[connection]
                try:
                    said = cast(Any, connection).recv()
                    if isinstance(said, str):
                        progress.compiling(kind, said)
                        continue
                    del busy[connection]
                    if said:
                        remember(code)
                    hand_over(child)
                except (OSError, EOFError):  # the process died; the workers compile the rest
                    busy.pop(connection, None)
                progress.done(kind)


def _weight(estimator: Estimator) -> int:
    kind = type(estimator).__name__
    return len(HEAVIEST) - HEAVIEST.index(kind) if kind in HEAVIEST else 0


def _cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Progress:
    """Reports the progress of compiling on standard error, from the first function on.

    Args:
        kinds: those of the estimators to compile for, one each.
    """

    def __init__(self, kinds: list[type]) -> None:
        self._console = Console(stderr=True)
        self._status = self._console.status("checking what is compiled already")
        self._estimators, self._done, self._functions = len(kinds), 0, 0
        self._names = dict.fromkeys(name for kind in kinds for name, ours in ESTIMATORS.items() if ours is kind)
        self._began_s = time.monotonic()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the line that changes, on a terminal, where there is anything to do."""
        if not self._estimators or not self._console.is_terminal:
            yield
            return
        with self._status:
            yield

    def compiling(self, kind: str, function: str) -> None:
        """Say that a function is compiled for a kind of estimator."""
        if not self._functions:
            say(f"{NOTICE}: {', '.join(self._names)}{DURATION}")
        self._functions += 1
        self._status.update(
            f"compiling for {kind}: {function}; {self._functions} functions so far, "
            f"{self._done} of {self._estimators} estimators done"
        )

    def done(self, kind: str) -> None:
        """Say that an estimator is compiled."""
        self._done += 1
        if self._functions and not self._console.is_terminal:
            elapsed_s = time.monotonic() - self._began_s
            line = f"compiled for {kind}, {self._done} of {self._estimators}: {self._functions} functions"
            print(f"{line}, {elapsed_s:.0f} s", file=sys.stderr, flush=True)


def serve(connection: Any) -> None:
    """Compile for one estimator after the other: the child's side.

    For each, sends the name of every function of ours that it compiles, then whether all went well.
    """
    from numba.core import event

    from .drive import warm_up

    class Tell(event.Listener):
        def on_start(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            if function.__module__.startswith(__name__.partition(".")[0]):
                connection.send(function.__name__)

        def on_end(self, event: Any) -> None:
            """Do nothing."""

    event.register("numba:compile", Tell())
    while True:
        try:
            estimator = connection.recv()
        except EOFError:
            return
        try:
            warm_up(estimator)
        except Exception:  # its run will say so
            connection.send(False)
        else:
            connection.send(True)


def code_of(estimator: Estimator) -> str:
    """Return a key of the compiled code that an estimator needs: its kind and options, without their numbers."""
    options = json.dumps(plain(dataclasses.asdict(cast(Any, estimator))), sort_keys=True)
    return f"{type(estimator).__name__} {re.sub(r'[0-9][0-9.e+-]*', '#', options)}"


def warm() -> set[str]:
    """Return the `code_of` everything compiled from the present sources into the present cache."""
    file = _stamp()
    return set(file.read_text(encoding="utf-8").splitlines()) if file.is_file() else set()


def remember(code: str) -> None:
    """Add to `warm`; do nothing if the cache cannot be written."""
    with suppress(OSError), _stamp().open("a", encoding="utf-8") as file:
        file.write(f"{code}\n")


def _stamp() -> Path:
    """Return the file of `warm`, in the folder of compiled code; it depends on sources, versions and processor."""
    return compiled_folder() / "warm.txt"
