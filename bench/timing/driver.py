"""Runs in a process of their own, single-threaded: one process with the stopwatch in the estimators, one without."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...datasets.epochs import Epoch
from ...datasets.log import Log
from ...datasets.rig import Rig
from ...datasets.state import Belief, TimeArray
from ...datasets.trajectory import Trajectory
from ...estimators.interface import Estimator, Pass
from ...estimators.registry import EstimatorError

PARTS = ("idle", "rest", "solve", "propagation", "linearisation", "output", "marginal")
"""The names of `stopwatch.Part`, known without numba."""
STEP, BELIEF, FINISH = range(3)
"""The calls of a pass that are timed, as rows of the records."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")


@dataclass(frozen=True, eq=False)
class Timed:
    """What one run took.

    Attributes:
        t_ns: (epochs,) times of the epochs, from the start of the log.
        step_ns: (epochs,) time of each step, by the harness's clock.
        belief_ns: (ticks,) of each belief.
        finish_ns: of `finish`.
        imu_samples, duration_s, counts: as in `Result`.
        step_parts, belief_parts: (epochs, len(Part)) and (ticks, len(Part)) ns by part; all 0 without probes.
        finish_parts: (len(Part),), of `finish`.
        online: what it said.
    """

    t_ns: TimeArray
    step_ns: TimeArray
    belief_ns: TimeArray
    finish_ns: int
    imu_samples: int
    duration_s: float
    counts: dict[str, int]
    step_parts: NDArray[np.int64]
    belief_parts: NDArray[np.int64]
    finish_parts: NDArray[np.int64]
    online: Trajectory | None

    @property
    def whole_ns(self) -> int:
        """Steps and beliefs."""
        return int(self.step_ns.sum() + self.belief_ns.sum())

    @property
    def parts_ns(self) -> NDArray[np.int64]:
        """(len(Part),) of steps and beliefs."""
        return self.step_parts.sum(axis=0) + self.belief_parts.sum(axis=0)


def quickest(runs: Sequence[Timed]) -> Timed:
    """Return of every step and every belief the quickest there was, with its parts.

    All runs do the same; what a step took longer than in another run, something else took from it.
    """
    step, belief = (np.array([getattr(run, name) for run in runs]) for name in ("step_ns", "belief_ns"))
    best_step, best_belief = step.argmin(axis=0), belief.argmin(axis=0)
    epochs, ticks = np.arange(step.shape[1]), np.arange(belief.shape[1])
    last = min(runs, key=lambda run: run.finish_ns)
    return replace(
        last,
        step_ns=step[best_step, epochs],
        belief_ns=belief[best_belief, ticks],
        step_parts=np.array([run.step_parts for run in runs])[best_step, epochs],
        belief_parts=np.array([run.belief_parts for run in runs])[best_belief, ticks],
    )


class Driver:
    """A process that runs estimators over logs, one after the other; a context manager.

    Args:
        probed: with the stopwatch in the estimators, which it compiles the first time, into a cache of its own.
    """

    def __init__(self, probed: bool) -> None:
        environment = os.environ | dict.fromkeys(THREADS, "1")
        if probed:
            from .probes import cache_folder

            environment["NUMBA_CACHE_DIR"] = str(cache_folder())
        command = [sys.executable, "-c", f"from {__name__} import serve; serve({probed})"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, start_new_session=True
        )  # Ctrl-C is ours alone

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def warm_up(self, estimator: Estimator, compiling: Callable[[str], None] = lambda function: None) -> float:
        """Let everything be compiled, or loaded, that the estimator needs; return how long that took, s.

        Args:
            estimator: any.
            compiling: told of every function that is not in the cache, before it is compiled.
        """
        return self._ask(estimator, told=compiling)

    def run(self, log: Log, estimator: Estimator) -> Timed:
        """Run the estimator over the log.

        Raises:
            EstimatorError: it did not come to the end.
        """
        return self._ask(log, estimator)

    def _ask(self, *question: Any, told: Callable[[str], None] = lambda function: None) -> Any:
        send, receive = self._process.stdin, self._process.stdout
        assert send is not None
        assert receive is not None
        try:
            pickle.dump(question, send)
            send.flush()
            while isinstance(answer := pickle.load(receive), Compiling):
                told(answer.function)
        except (OSError, EOFError):
            raise EstimatorError(f"{question[-1]}: its process died") from None
        if isinstance(answer, EstimatorError):
            raise answer
        return answer


class Compiling(NamedTuple):
    """What the process says on the way: it compiles a function."""

    function: str


# -- in the process ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Watched:
    """An estimator whose every call is under the stopwatch."""

    estimator: Estimator
    passes: list[WatchedPass]

    @property
    def factors(self) -> frozenset[str]:
        """See `Estimator`."""
        return self.estimator.factors

    def begin(self, prior: Belief, rig: Rig) -> WatchedPass:
        """See `Estimator.begin`."""
        self.passes.append(WatchedPass(self.estimator.begin(prior, rig)))
        return self.passes[-1]


class WatchedPass:
    """A pass under the stopwatch. What no probe claims is the rest of a step, and of a belief the output.

    Attributes:
        shown: what the stopwatch showed after each call, and in front what it showed before the first.
        kinds: of the calls.
    """

    def __init__(self, run: Pass) -> None:
        from .probes import timed
        from .stopwatch import Part, totals

        self._run, self._totals = run, totals
        self._step = timed(run.step, Part.REST)
        self._belief = timed(run.belief, Part.OUTPUT)
        self._finish = timed(run.finish, Part.REST)
        self.shown, self.kinds = [totals()], []

    @property
    def counts(self) -> dict[str, int]:
        """See `Pass.counts`."""
        return self._run.counts

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        self._step(epoch)
        self.shown.append(self._totals())
        self.kinds.append(STEP)

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        belief = self._belief()
        self.shown.append(self._totals())
        self.kinds.append(BELIEF)
        return belief

    def finish(self) -> Trajectory | None:
        """See `Pass.finish`."""
        smoothed = self._finish()
        self.shown.append(self._totals())
        self.kinds.append(FINISH)
        return smoothed

    def parts(self, kind: int) -> NDArray[np.int64]:
        """Return the time by part of each call of a kind, (calls, len(Part)) ns; what was between calls is left out."""
        spent = np.diff(np.array(self.shown), axis=0)
        spent[:, 0] = 0
        return spent[np.array(self.kinds) == kind]


def _run(log: Log, estimator: Estimator, probed: bool) -> Timed | EstimatorError:
    from ..execution.drive import cut, run_log, score_ticks

    passes: list[WatchedPass] = []
    watched: Any = Watched(estimator, passes) if probed else estimator
    result = run_log(log, watched)
    if result.status != "done":
        return EstimatorError(f"{estimator}: {result.status}: {result.cause}")
    steps, beliefs = len(result.step_ns), len(result.belief_ns)
    calls = (steps, beliefs, 1)
    parts = [passes[0].parts(kind) if probed else np.zeros((calls[kind], len(PARTS)), np.int64) for kind in range(3)]
    voyage = cut(log, score_ticks(log, 1.0), estimator.factors, 1.0)
    return Timed(
        np.array([epoch.t_ns for epoch in voyage.epochs]) - voyage.start_ns,
        result.step_ns,
        result.belief_ns,
        result.finish_ns,
        result.imu_samples,
        result.duration_s,
        result.counts,
        parts[STEP],
        parts[BELIEF],
        parts[FINISH][0],
        result.online,
    )


def serve(probed: bool) -> None:
    """Answer until nobody asks any more. What libraries print goes to stderr."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def answer(said: Any) -> None:
        pickle.dump(said, answers)
        answers.flush()

    from numba.core import event

    from ..execution.drive import warm_up

    class Tell(event.Listener):
        def on_start(self, event: Any) -> None:
            answer(Compiling(event.data["dispatcher"].py_func.__name__))

        def on_end(self, event: Any) -> None:
            """It is of no use to know."""

    event.register("numba:compile", Tell())

    if probed:
        from .probes import cache_folder, fit

        fit(cache_folder())
    while True:
        try:
            question = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        if len(question) == 1:
            started = perf_counter()
            warm_up(question[0])
            answer(perf_counter() - started)
        else:
            answer(_run(question[0], question[1], probed))
