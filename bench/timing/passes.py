"""Runs of estimators, timed step by step and, where asked, stage by stage, in a single-threaded process of their own.

A pass is wrapped in a pass that reads the clock of `estimators.stages` before and after each call. What an estimator
marks as no stage is the rest of a step, and the output of a belief.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter_ns
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...datasets.epochs import Epoch, cut
from ...datasets.log import Log
from ...datasets.rig import Rig
from ...datasets.state import Belief, TimeArray
from ...datasets.trajectory import Trajectory
from ...estimators.interface import Estimator, Pass
from ...estimators.registry import EstimatorError, is_ours
from ...estimators.stages import STAGES, clock
from ..execution.child import start
from ..execution.drive import run_log, score_ticks, warm_up

PARTS = (*STAGES, "rest")
Parts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Timed:
    """What one run took.

    Attributes:
        t_ns: (epochs,) times of the epochs, from the start of the log.
        step_ns: (epochs,) time of each step.
        belief_ns: (ticks,) time of each belief.
        finish_ns: time of `finish`.
        imu_samples, counts, online: as in `Result`.
        step_parts, belief_parts: (epochs, 6) and (ticks, 6) ns by PARTS; all 0 where no stages were timed.
    """

    t_ns: TimeArray
    step_ns: TimeArray
    belief_ns: TimeArray
    finish_ns: int
    imu_samples: int
    counts: dict[str, int]
    step_parts: Parts
    belief_parts: Parts
    online: Trajectory | None

    @property
    def whole_ns(self) -> int:
        """Steps and beliefs."""
        return int(self.step_ns.sum() + self.belief_ns.sum())

    @property
    def parts_ns(self) -> Parts:
        """(6,) steps and beliefs, by PARTS."""
        return self.step_parts.sum(axis=0) + self.belief_parts.sum(axis=0)


def quickest(runs: Sequence[Timed]) -> Timed:
    """Return the quickest of each step and of each belief, with its parts.

    All runs do the same work: what a step takes longer than in another run was spent on something else.
    """
    step, belief = (np.array([getattr(run, name) for run in runs]) for name in ("step_ns", "belief_ns"))
    best_step, best_belief = step.argmin(axis=0), belief.argmin(axis=0)
    epochs, ticks = np.arange(step.shape[1]), np.arange(belief.shape[1])
    return replace(
        min(runs, key=lambda run: run.finish_ns),
        step_ns=step[best_step, epochs],
        belief_ns=belief[best_belief, ticks],
        step_parts=np.array([run.step_parts for run in runs])[best_step, epochs],
        belief_parts=np.array([run.belief_parts for run in runs])[best_belief, ticks],
    )


class Stopwatch:
    """A process that runs estimators over logs, one after the other; see `stopwatch`."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    def warm_up(self, estimator: Estimator) -> None:
        """Compile or load all that the estimator needs."""
        self._ask(None, estimator, False)

    def run(self, log: Log, estimator: Estimator, stages: bool = False) -> Timed:
        """Run the estimator over the log.

        Raises:
            EstimatorError: it did not reach the end.
        """
        return self._ask(log, estimator, stages)

    def _ask(self, *question: Any) -> Any:
        try:
            self._connection.send(question)
            answer = self._connection.recv()
        except (OSError, EOFError):
            raise EstimatorError(f"{question[1]}: its process died") from None
        if isinstance(answer, EstimatorError):
            raise answer
        return answer


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    """Start a process to time runs in; it is ended afterwards."""
    with start(f"{__name__}:serve") as child:
        yield Stopwatch(child.connection)


# -- in the process ---------------------------------------------------------------------------------------------------


def serve(connection: Any) -> None:
    """Answer until the connection closes."""
    while True:
        try:
            log, estimator, stages = connection.recv()
        except EOFError:
            return
        connection.send(warm_up(estimator) if log is None else timed_run(log, estimator, stages))


def timed_run(log: Log, estimator: Estimator, stages: bool) -> Timed | EstimatorError:
    """Run the estimator over the log in this process."""
    watched = Watched(estimator)
    if stages:
        clock.start()
    try:
        result = run_log(log, watched if stages else estimator, ours=is_ours(estimator))
    finally:
        clock.stop()
    if result.status != "done":
        return EstimatorError(f"{estimator}: {result.status}: {result.cause}")
    voyage = cut(log, score_ticks(log, 1.0), estimator.factors, 1.0)
    no_parts = [np.zeros((len(times), len(PARTS)), np.int64) for times in (result.step_ns, result.belief_ns)]
    step_parts, belief_parts = no_parts
    if stages:
        step_parts, belief_parts = parts_of(watched.steps, "rest"), parts_of(watched.beliefs, "output")
    return Timed(
        np.array([epoch.t_ns for epoch in voyage.epochs]) - voyage.start_ns,
        result.step_ns,
        result.belief_ns,
        result.finish_ns,
        result.imu_samples,
        result.counts,
        step_parts,
        belief_parts,
        result.online,
    )


class Call(NamedTuple):
    """One call: the clock of stages before it, its whole time, and the clock after it, ns."""

    before: tuple[int, ...]
    elapsed_ns: int
    after: tuple[int, ...]


@dataclass(frozen=True)
class Watched:
    """An estimator whose pass is timed stage by stage.

    Attributes:
        steps, beliefs: the calls of its pass.
    """

    estimator: Estimator
    steps: list[Call] = field(default_factory=list)
    beliefs: list[Call] = field(default_factory=list)

    @property
    def factors(self) -> frozenset[str]:
        """See `Estimator`."""
        return self.estimator.factors

    def begin(self, prior: Belief, rig: Rig) -> WatchedPass:
        """See `Estimator.begin`."""
        return WatchedPass(self.estimator.begin(prior, rig), self.steps, self.beliefs)


class WatchedPass:
    """A pass whose steps and beliefs are timed stage by stage. It only notes times, for its own time is in a step's."""

    def __init__(self, inner: Pass, steps: list[Call], beliefs: list[Call]) -> None:
        self._inner, self._steps, self._beliefs = inner, steps, beliefs

    @property
    def counts(self) -> dict[str, int]:
        """See `Pass.counts`."""
        return self._inner.counts

    def step(self, epoch: Epoch) -> None:
        """See `Pass.step`."""
        before, started = clock.read(), perf_counter_ns()
        self._inner.step(epoch)
        self._steps.append(Call(before, perf_counter_ns() - started, clock.read()))

    def belief(self) -> Belief:
        """See `Pass.belief`."""
        before, started = clock.read(), perf_counter_ns()
        belief = self._inner.belief()
        self._beliefs.append(Call(before, perf_counter_ns() - started, clock.read()))
        return belief

    def finish(self) -> Trajectory | None:
        """See `Pass.finish`."""
        return self._inner.finish()


def parts_of(calls: Sequence[Call], unmarked: str) -> Parts:
    """Return the time of each call by PARTS, (calls, 6) ns; what no stage has belongs to the part `unmarked`."""
    parts = np.zeros((len(calls), len(PARTS)), np.int64)
    for row, call in zip(parts, calls, strict=True):
        row[: len(STAGES)] = np.subtract(call.after, call.before)
        row[PARTS.index(unmarked)] += call.elapsed_ns - row.sum()
    return parts
