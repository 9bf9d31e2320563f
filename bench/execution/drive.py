"""Drive one estimator through one log, and time every step."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from time import perf_counter_ns, thread_time_ns
from traceback import format_exception
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ...datasets.epochs import Epoch, Voyage, cut
from ...datasets.errors import message_of, one_line
from ...datasets.log import AttitudeStream, HeadingStream, Log
from ...datasets.read_only import read_only
from ...datasets.rig import Rig
from ...datasets.state import DIM, Belief, TimeArray
from ...datasets.trajectory import Trajectory
from ...estimators.contract import check_estimator, check_pass, checked_counts
from ...estimators.interface import Diverged, Estimator, Pass
from ...estimators.other_code import process_kept
from ...estimators.physics.imu import compile_rig
from ...estimators.physics.innovation import INNOVATION, innovations
from ...estimators.registry import is_ours
from ..results.identity import content_sha256
from .noticed import ON_TIME_NS, late_readings, noticed
from .outputs import check_counts, check_form, check_smoothed, check_time, wrong_value
from .result import Result, Status

LOST_M = 1e7
"""An estimate farther than this from W's origin has diverged, m: a quarter of the Earth's circumference."""


class Ending(NamedTuple):
    """How a run ended, and when; t_ns is None if it reached the end of the log."""

    status: Status
    cause: str | None = None
    t_ns: int | None = None
    traceback: str | None = None

    @staticmethod
    def by(error: BaseException, t_ns: int) -> Ending:
        """Return the ending by an error of the estimator; an interruption by the user is raised again."""
        if isinstance(error, KeyboardInterrupt):
            raise error
        if isinstance(error, Diverged):
            return Ending("diverged", message_of(error), t_ns)
        return Ending("failed", one_line(error), t_ns, traceback_of(error))


class Recorder:
    """Records the beliefs of a run and the times that they took. Beliefs are copied, so a pass may reuse its arrays."""

    def __init__(self, ticks: int) -> None:
        self.step_ns: list[int] = []
        self.step_cpu_ns: list[int] = []
        self.belief_ns: list[int] = []
        self.t_ns = np.zeros(ticks, np.int64)
        self.R_WB = np.zeros((ticks, 3, 3))
        self.vectors = np.zeros((ticks, 4, 3))  # p_WB_W, v_WB_W, b_a, b_g
        self.P = np.zeros((ticks, DIM, DIM))
        self.has_P = True  # settled by the first belief

    def keep(self, belief: Belief, t_ns: int) -> None:
        """Add a belief.

        Raises:
            Diverged: it is not finite, is farther than LOST_M away, or has no covariance although the first one had.
            TypeError, ValueError: it is no belief of t_ns, see `check_form`.
        """
        check_form(belief, t_ns)
        k, state = len(self.belief_ns), belief.state
        self.t_ns[k], self.R_WB[k], self.P[k] = t_ns, state.R_WB, belief.P
        row = self.vectors[k]
        row[0], row[1], row[2], row[3] = state.p_WB_W, state.v_WB_W, state.b_a, state.b_g
        if k == 0:
            self.has_P = not np.isnan(self.P[0]).all()
        if not (np.isfinite(row).all() and np.isfinite(self.R_WB[k]).all()):
            raise Diverged("the state is not finite")
        if np.abs(row[0]).max() > LOST_M:
            raise Diverged(f"the position is {np.abs(row[0]).max():.1e} m away")
        if self.has_P and not np.isfinite(self.P[k]).all():
            raise Diverged("the covariance is not finite")

    @property
    def ticks_ns(self) -> TimeArray:
        """Times of the beliefs that were kept and timed, (n,) ns."""
        return self.t_ns[: len(self.belief_ns)]

    def trajectory(self) -> Trajectory | None:
        """Return the beliefs that were kept and timed; None where there are none."""
        n = len(self.belief_ns)
        if n == 0:
            return None
        p, v, b_a, b_g = (self.vectors[:n, i] for i in range(4))
        return Trajectory(self.ticks_ns, self.R_WB[:n], p, v, b_a, b_g, self.P[:n] if self.has_P else None)


class NisCollector:
    """Collects the NIS of each reading, against the belief predicted before any reading of its epoch.

    An epoch is driven in two halves, its motion and its readings; the belief is asked for between them. Late readings
    are about an earlier state. An estimator that can judge them itself, as it ties them, has a method `watch_late`, as
    filters that replay do; of others they are left out. An estimator that keeps no covariance has no NIS.

    Attributes:
        counts: readings left out because they came late ("nis_late"), or because S is not positive ("nis_undefined").
    """

    def __init__(self, estimator: Estimator, rig: Rig) -> None:
        self.counts = {"nis_late": 0, "nis_undefined": 0}
        self._rig = compile_rig(rig, estimator.factors, getattr(estimator, "inflate", {}))
        self._tables: list[NDArray[Any]] = []
        self._of_late: list[NDArray[Any]] = []

    def wants(self, epoch: Epoch) -> bool:
        """Return whether any reading of the epoch is on time."""
        on_time = self._on_time(epoch)
        self.counts["nis_late"] += len(epoch.readings) - int(on_time.sum())
        return bool(on_time.any())

    def judge(self, belief: Belief, epoch: Epoch) -> None:
        """Add the innovations of the epoch's readings, given the belief at its time before them.

        Raises:
            ValueError: the belief is for another time.
        """
        check_time(belief, epoch.t_ns)
        if np.isnan(belief.P).all():
            return
        table = innovations(belief, epoch.readings[self._on_time(epoch)], self._rig)
        defined = np.isfinite(table["nis"])
        self.counts["nis_undefined"] += int((~defined).sum())
        self._tables.append(table[defined])

    def watch(self, run: Pass) -> None:
        """Let a pass judge the late readings that it ties, if it can."""
        watch_late = getattr(run, "watch_late", None)
        self._of_late = [] if watch_late is None else watch_late()

    def table(self) -> NDArray[Any]:
        """Return all innovations, once, as INNOVATION rows in the order of their times; count those left out."""
        late = np.concatenate([np.zeros(0, INNOVATION), *self._of_late])
        defined = np.isfinite(late["nis"]) & (late["dof"] > 0)
        self.counts["nis_late"] -= len(late)
        self.counts["nis_undefined"] += int((~defined).sum())
        every = np.concatenate([late[defined], *self._tables])
        return every[np.argsort(every["t_ns"], kind="stable")]

    @staticmethod
    def _on_time(epoch: Epoch) -> NDArray[np.bool_]:
        return epoch.t_ns - epoch.readings["t_ns"] <= ON_TIME_NS


def run_log(
    log: Log,
    estimator: Estimator,
    *,
    score_period_s: float = 1.0,
    max_gap_s: float = 1.0,
    timeout_s: float | None = None,
    nis: bool = False,
    ours: bool | None = None,
) -> Result:
    """Drive an estimator through a log, in the order of reception.

    Any exception of the estimator ends the run, not the caller; only KeyboardInterrupt passes. Another package's
    estimator is checked before and its output after: see `contract` and `outputs`. It gets read-only copies, and if it
    changes the log nevertheless, the run fails and has no trajectory.

    Args:
        log: where it states no prior, `initialise` makes one.
        estimator: a configuration, as `create` returns it; it gets the sensors of its `factors`.
        score_period_s: beliefs are asked for this far apart: at the truth's own stamps, else on a regular grid.
        max_gap_s: longest gap in the IMU that is bridged.
        timeout_s: longest time for the whole run, looked at after each step; None for no limit.
        nis: judge the estimator by its innovations. It then gets each epoch in two halves, first the motion without
            readings, then the readings without motion, and is asked for its belief in between. A step's time is that of
            both halves; the belief is not charged, but what it leaves computed may make a smoother's next step cheaper.
            The estimates stay the same, except for a graph smoother with late readings: asked for a belief, it adds
            their factors at once and not with its next keyframe.
        ours: whether the estimator is this package's; None to tell by its type. A wrapper around one of ours says so:
            read-only copies are another type, for which all of it would be compiled once more.

    Raises:
        DatasetError: no prior can be made for the log.
    """
    log, start, notes = _with_prior(log)
    assert log.prior is not None
    limit_ns = math.inf if timeout_s is None else perf_counter_ns() + timeout_s * 1e9
    smoothed, finish_ns, counts, collector = None, (0, 0), {}, None
    ours = is_ours(estimator) if ours is None else ours
    content = None if ours else content_sha256(log)
    with _collector_off(), nullcontext() if ours else process_kept():
        factors, ending = _factors(estimator, ours, log.start_ns)
        readings = sum(len(stream) for sensor, stream in log.streams.items() if sensor in factors)
        voyage = cut(log, score_ticks(log, score_period_s), factors, max_gap_s)
        if not ours:
            voyage = _read_only(voyage)
        recorder = Recorder(sum(epoch.tick for epoch in voyage.epochs))
        if ending is None:
            try:
                collector = NisCollector(estimator, log.rig) if nis else None
                run = estimator.begin(log.prior, log.rig)
                if not ours:
                    check_pass(run, estimator)
                elif collector is not None:
                    collector.watch(run)
            except BaseException as error:  # another package's code may raise anything
                ending = Ending.by(error, voyage.start_ns)
            else:
                ending = _drive(run, voyage, recorder, limit_ns, collector)
                smoothed, finish_ns, counts, ending = _finish(run, voyage, recorder.ticks_ns, ending)
    online, ending = _checked(recorder.trajectory(), ending)
    if content is not None and content_sha256(log) != content:
        cause = f"{type(estimator).__name__} changed arrays of the log, the prior or the rig, which other runs use too"
        online, smoothed, ending = None, None, Ending("failed", cause, ending.t_ns, ending.traceback)

    step_ns = np.array(recorder.step_ns, np.int64)
    driven = voyage.epochs[: len(step_ns)]
    end_ns = driven[-1].t_ns if driven else voyage.start_ns
    innovations_found = collector.table() if collector else None
    late = late_readings(log, factors, voyage.start_ns, end_ns)
    known = {"readings": readings, "readings_late": late} | voyage.counts | (collector.counts if collector else {})
    counts |= known  # what is counted here is no estimator's to say
    return Result(
        ending.status,
        ending.cause,
        None if ending.t_ns is None else (ending.t_ns - voyage.start_ns) * 1e-9,
        online,
        smoothed,
        step_ns,
        np.array(recorder.belief_ns, np.int64),
        finish_ns[0],
        counts,
        (end_ns - voyage.start_ns) * 1e-9,
        sum(len(epoch.imu) for epoch in driven),
        start,
        (*notes, *noticed(log, counts, estimator)),
        innovations_found,
        ending.traceback,
        (np.array(recorder.step_cpu_ns, np.int64) - _of_driving_ns(voyage)).clip(0, step_ns),
        finish_ns[1],
    )


def _with_prior(log: Log) -> tuple[Log, str, tuple[str, ...]]:
    """Return the log with a prior, where that came from, and in sentences how it was made."""
    if log.prior is not None:
        return log, "given", ()
    from ...estimators.alignment.initialise import initialise

    found = initialise(log)
    return log.with_prior(found.belief), found.start, found.notes


def _factors(estimator: Estimator, ours: bool, t_ns: int) -> tuple[frozenset[str], Ending | None]:
    """Return the sensors an estimator may use; or none, and the ending of a run that cannot begin."""
    try:
        return estimator.factors if ours else check_estimator(estimator), None
    except BaseException as error:  # another package's code may raise anything
        return frozenset(), Ending.by(error, t_ns)


def _read_only(voyage: Voyage) -> Voyage:
    """Return the voyage with read-only copies of its arrays; those of an epoch lead to no later one."""
    epochs = [
        epoch._replace(imu=read_only(epoch.imu.copy()), readings=read_only(epoch.readings.copy()))
        for epoch in voyage.epochs
    ]
    return replace(voyage, epochs=epochs)


def _checked(online: Trajectory | None, ending: Ending) -> tuple[Trajectory | None, Ending]:
    """Return the beliefs before the first wrong value of a run that reached the end, and how it ended by that."""
    wrong = None if online is None or ending.status != "done" else wrong_value(online)
    if online is None or wrong is None:
        return online, ending
    before = online.select(slice(wrong.row)) if wrong.row else None
    return before, Ending(wrong.status, f"belief(): {wrong.cause}", int(online.t_ns[wrong.row]))


def _drive(run: Pass, voyage: Voyage, recorder: Recorder, limit_ns: float, collector: NisCollector | None) -> Ending:
    """Hand over every epoch, in halves for a collector; time `step` and `belief` apart, and collect garbage outside.

    The processor's clock takes up to 0.6 µs to read. It is read once a step, so what is kept has this loop in it. That
    is taken off later, as an idle step has it, and varies: a step has at most the time that it took.
    """
    clock, cpu, step = perf_counter_ns, thread_time_ns, run.step
    step_ns, step_cpu_ns = recorder.step_ns.append, recorder.step_cpu_ns.append
    t_ns, before_ns = voyage.start_ns, cpu()
    try:
        for epoch in voyage.epochs:
            t_ns, spent_ns = epoch.t_ns, 0
            if collector is not None and collector.wants(epoch):
                started = clock()
                step(epoch._replace(readings=epoch.readings[:0], tick=False))
                spent_ns, judging_ns = clock() - started, cpu()
                collector.judge(run.belief(), epoch)
                epoch = epoch._replace(imu=epoch.imu[:0])
                before_ns += cpu() - judging_ns
            started = clock()
            step(epoch)
            ended, after_ns = clock(), cpu()
            step_ns(spent_ns + ended - started)
            step_cpu_ns(after_ns - before_ns)
            before_ns = after_ns
            if ended > limit_ns:
                return Ending("failed", "out of time", t_ns)
            if epoch.tick:
                started = clock()
                belief = run.belief()
                ended = clock()
                recorder.keep(belief, t_ns)
                recorder.belief_ns.append(ended - started)
                gc.collect(0)
                before_ns = cpu()
    except BaseException as error:  # another package's code may raise anything
        return Ending.by(error, t_ns)
    if voyage.failure is not None:
        return Ending("failed", voyage.failure, t_ns)
    return Ending("done")


def _do_nothing(epoch: Epoch) -> None:
    """Be a step of no estimator."""


def _of_driving_ns(voyage: Voyage) -> int:
    """Return the processor time of a step that does nothing: the least of a hundred."""
    recorder, epochs = Recorder(0), [epoch._replace(tick=False) for epoch in voyage.epochs[:1]] * 100
    idle = cast(Pass, SimpleNamespace(step=_do_nothing))
    _drive(idle, replace(voyage, epochs=epochs), recorder, math.inf, None)
    return min(recorder.step_cpu_ns, default=0)


def _finish(
    run: Pass, voyage: Voyage, given_ns: TimeArray, ending: Ending
) -> tuple[Trajectory | None, tuple[int, int], dict[str, int], Ending]:
    """Return (smoothed trajectory, time and processor time it took, counts, ending).

    `given_ns` (k,) are the ticks at which it gave a belief. A run that had ended early keeps its own cause.
    """
    end_ns = voyage.epochs[-1].t_ns if voyage.epochs else voyage.start_ns
    smoothed, counts, end = None, {}, Ending("done")
    started, cpu_started = perf_counter_ns(), thread_time_ns()
    took_ns = (0, 0)
    try:
        try:
            smoothed = run.finish()
        finally:
            took_ns = perf_counter_ns() - started, thread_time_ns() - cpu_started
            found = checked_counts(run, type(run).__name__)
            check_counts(found)
            counts = found
        if smoothed is not None:
            end = _smoothed_ending(smoothed, voyage, given_ns)
    except BaseException as error:  # another package's code may raise anything
        end = Ending.by(error, end_ns)
    if end.status != "done":
        smoothed = None
    return smoothed, took_ns, counts, end if ending.status == "done" else ending


def _smoothed_ending(smoothed: Trajectory, voyage: Voyage, given_ns: TimeArray) -> Ending:
    """Return how a run ends with these smoothed states: done, unless one of them cannot be.

    Raises:
        Diverged, TypeError, ValueError: they are lost, or not the states at the ticks.
    """
    ticks_ns = np.array([epoch.t_ns for epoch in voyage.epochs if epoch.tick], np.int64)
    check_smoothed(smoothed, ticks_ns, given_ns)
    if not (np.abs(smoothed.p_WB_W).max(initial=0.0) < LOST_M):  # nor NaN
        raise Diverged("the smoothed state is not finite, or far beyond the Earth's surface")
    wrong = wrong_value(smoothed)
    if wrong is None:
        return Ending("done")
    return Ending(wrong.status, f"finish(): {wrong.cause}", int(smoothed.t_ns[wrong.row]))


LONGEST_TRACEBACK = 20_000
"""Characters of a traceback that are kept, its end: some two hundred frames."""


def traceback_of(error: BaseException) -> str:
    """Return the end of an error's traceback, as Python prints it."""
    return "".join(format_exception(error))[-LONGEST_TRACEBACK:]


@contextmanager
def _collector_off() -> Iterator[None]:
    """Keep Python's garbage collector out of the timed steps."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def score_ticks(log: Log, period_s: float) -> TimeArray:
    """Return the times at which beliefs are asked for, (k,) ns.

    With ground truth they are its own stamps, so that nothing is interpolated: the nearest to each point of a
    regular grid that begins one period after the start. Without it, or if it is empty, a regular grid from the start.
    """
    period_ns = int(period_s * 1e9)
    if log.truth is None or len(log.truth) == 0:
        return np.arange(log.start_ns + period_ns, int(log.imu.t_ns[-1]) + 1, period_ns, dtype=np.int64)
    stamps, first_ns = log.truth.t_ns, log.start_ns + period_ns
    begin_ns = stamps[np.abs(stamps - first_ns).argmin()]
    beside = (stamps - begin_ns) // period_ns  # points of the grid near a stamp: in a hole of years there are none
    points = np.unique(np.concatenate([beside, beside + 1]))
    grid = begin_ns + points[(points >= 0) & (points <= (stamps[-1] - begin_ns) // period_ns)] * period_ns
    after = np.searchsorted(stamps, grid)
    before = (after - 1).clip(0)
    return np.unique(stamps[np.where(grid - stamps[before] <= stamps[after] - grid, before, after)])


# -- before a run -----------------------------------------------------------------------------------------------------


def warm_up(estimator: Estimator) -> None:
    """Run the estimator over a few simulated seconds, so that compiling is over before anything is timed.

    Once with a heading sensor, once with one that gives the full attitude.
    """
    from ...datasets.simulated.scenario import Scenario
    from ...datasets.simulated.simulator import simulate

    log = simulate(Scenario(duration_s=20.0), seed=0)
    run_log(log, estimator)
    if isinstance(log.heading, HeadingStream):
        run_log(replace(log, heading=_level_attitude(log.heading)), estimator)


def _level_attitude(heading: HeadingStream) -> AttitudeStream:
    """Return the headings as full attitudes, roll and pitch being level."""
    c, s, zero = np.cos(heading.z[:, 0]), np.sin(heading.z[:, 0]), np.zeros(len(heading))
    z = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1)
    return AttitudeStream(heading.t_ns, heading.received_ns, z, np.repeat(heading.sigma, 3, axis=1))
