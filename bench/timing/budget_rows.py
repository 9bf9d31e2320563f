"""The budgets of speed and memory: the measurement and the limit of each row."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...datasets import Log, Scenario, open_log, simulate
from ...datasets.described.folder import write_folder
from ...datasets.epochs import cut
from ...estimators import create
from ..execution.drive import run_log, score_ticks, warm_up
from ..execution.pool import run_all
from ..execution.result import Result
from ..execution.task import Task
from ..experiment.plan import Experiment
from ..inspection.gross.gross import quick_findings
from ..metrics import ate
from ..metrics.scoring import scores
from . import evo
from .budgets import Budget, Measured, take_turns
from .compiling import compile_cpu_seconds
from .whole_runs import finished_again_mb, finished_again_s, page_of_finished_mb, plan_of, whole_run

LAGS_S = (3.0, 10.0, 30.0)
"""The lags of the main experiment, and a long one."""
CHEAPER = ({}, {"wildfire": 0.1}, {"wildfire": 0.1, "relinearize": [0.05, 1e3, 0.5, 10.0]})
"""Settings of `fls`, each cheaper than the one before, in time per keyframe."""

RUNS, WARM_RUNS = 100, 10
"""Runs that are measured, by two workers and by one; and runs before them, so that the workers are warm."""
FACTORS = 5000
"""Factors linearised in a turn: some 50 ms."""


def _mission(duration_s: float) -> Log:
    return simulate(Scenario(mission="lawnmower", duration_s=duration_s, imu="tactical"), seed=4)


_simulated = cache(_mission)


def _stepping(log: Log, name: str, **options: Any) -> Callable[[], Any]:
    """Return a call that takes every step of a log."""
    estimator, epochs = create(name, **options), cut(log, score_ticks(log, 1.0)).epochs

    def steps() -> Any:
        assert log.prior is not None
        one = estimator.begin(log.prior, log.rig)
        for epoch in epochs:
            one.step(epoch)
        return one

    steps()
    return steps


# -- the rows ---------------------------------------------------------------------------------------------------------


def filter_against_filterpy() -> Measured:
    """Measure how much longer `eskf-filterpy` takes than `eskf`."""
    log = _simulated(60.0)
    return Measured(take_turns(_stepping(log, "eskf-filterpy"), _stepping(log, "eskf"), 5))


def python_factor() -> Measured:
    """Measure linearising our displacement factor over a native one of GTSAM, both 3 × 12."""
    from ...estimators.graph.gtsam_border import linearise_alike

    log = _simulated(60.0)
    assert log.prior is not None
    ours, native = linearise_alike(log.prior.state, log.rig.imu.R_BS)
    ours(FACTORS)
    native(FACTORS)
    return Measured(take_turns(partial(ours, FACTORS), partial(native, FACTORS), 7))


def compiling() -> Measured:
    """Measure the processor time of compiling `eskf`, `fls` and `window` into an empty cache, s."""
    found = compile_cpu_seconds(("eskf", "fls", "window"))
    return Measured((found.cpu_s,), f"{found.compilations} compilations")


def window_against_fls(lag_s: float) -> Measured:
    """Measure how much longer than `window` the cheapest setting of `fls` takes whose RMSE is within 1 % of its."""
    log = _simulated(90.0)

    def rmse_m(result: Result) -> float:
        assert log.truth is not None
        assert result.online is not None, result.cause
        return ate(log.truth, result.online).rmse_m

    best = rmse_m(run_log(log, create("window", lag_s=lag_s)))
    good = []
    for options in CHEAPER:
        result = run_log(log, create("fls", lag_s=lag_s, **options))
        if result.status == "done" and rmse_m(result) <= 1.01 * best:
            good.append((int(result.step_ns.sum()), options))
    assert good, "no setting of fls is as good"
    options = min(good, key=lambda each: each[0])[1]
    said = ", ".join(f"{name} {value}" for name, value in options.items()) or "its defaults"
    ratios = take_turns(_stepping(log, "fls", lag_s=lag_s, **options), _stepping(log, "window", lag_s=lag_s), 3)
    return Measured(ratios, f"cheapest fls: {said}")


def harness_against_steps() -> Measured:
    """Measure all but `eskf`'s steps, from a log of ten minutes in memory to its scores, over these steps."""
    log, estimator, ratios = _simulated(600.0), create("eskf"), []
    warm_up(estimator)
    for _ in range(9):
        started = time.perf_counter_ns()
        result = run_log(log, estimator)
        assert result.online is not None
        scores(log, result.online)
        total_ns = time.perf_counter_ns() - started
        steps_ns = int(result.step_ns.sum()) + result.finish_ns
        ratios.append((total_ns - steps_ns) / steps_ns)
    return Measured(tuple(ratios))


def simulation_against_filter() -> Measured:
    """Measure simulating ten minutes over running `eskf` on them."""
    log, estimator = _simulated(600.0), create("eskf")
    warm_up(estimator)
    return Measured(take_turns(partial(_mission, 600.0), partial(run_log, log, estimator), 5))


def check_against_run() -> Measured:
    """Measure the check before an experiment over a run of `eskf`, from the ten minutes on disk to the scores."""
    estimator = create("eskf")
    warm_up(estimator)
    with TemporaryDirectory() as temporary:
        folder = write_folder(_simulated(600.0), Path(temporary) / "ten")

        def run() -> None:
            log = open_log(folder)
            result = run_log(log, estimator)
            assert result.online is not None
            scores(log, result.online)

        return Measured(take_turns(partial(quick_findings, open_log(folder)), run, 5))


def two_workers_against_one() -> Measured:
    """Measure the rate of two worker processes over that of one, on 100 runs, the workers being warm."""
    experiment = Experiment.from_dict(plan_of(60.0, RUNS + WARM_RUNS))

    def rate(jobs: int) -> float:
        tasks, started = [Task.of(experiment, run) for run in experiment.runs()], 0.0
        for done, _ in enumerate(run_all(tasks, jobs), 1):
            if done == WARM_RUNS:
                started = time.perf_counter()
        return RUNS / (time.perf_counter() - started)

    ratios = []
    for _ in range(2):
        one, two = rate(1), rate(2)
        ratios.append(two / one)
    load = os.getloadavg()[0]
    return Measured(tuple(ratios), f"{os.cpu_count()} cores; load at the end, our own part included: {load:.1f}")


def memory_of_an_hour() -> Measured:
    """Measure the peak memory of opening and running an hour, less that of our imports, over the log's own arrays."""
    log = _mission(3600.0)
    imports = (
        "from fathom.bench import run_log; from fathom.datasets import open_log; from fathom.estimators import create"
    )
    run = "import sys; assert run_log(open_log(sys.argv[1]), create('eskf')).status == 'done'"
    own = array_bytes(log)
    with TemporaryDirectory() as temporary:
        folder = str(write_folder(log, Path(temporary) / "hour"))
        empty, full = (_peak_bytes(code, folder) for code in (imports, f"{imports}; {run}"))
    return Measured(((full - empty) / own,), f"{own / 1e6:.0f} MB of arrays; {(full - empty) / 1e6:.0f} MB to run them")


def array_bytes(value: Any) -> int:
    """Return how many bytes the arrays of a log take."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if is_dataclass(value):
        return sum(array_bytes(getattr(value, field.name)) for field in fields(value))
    return sum(map(array_bytes, value.values())) if isinstance(value, dict) else 0


PEAK = """
try:
    text = open("/proc/self/status").read()
    peak = 1024 * int(text.split("VmHWM:")[1].split()[0])
except OSError:
    import resource
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(peak)
"""


def _peak_bytes(code: str, *arguments: str) -> int:
    """Return the peak memory of a process that runs some code."""
    command = [sys.executable, "-c", code + PEAK, *arguments]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def help_against_numpy() -> Measured:
    """Measure the processor time of `fathom --help` over that of importing numpy."""

    def seconds(*arguments: str) -> float:
        before = os.times()
        subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    ask, load = partial(seconds, "-m", "fathom.bench.cli.app", "--help"), partial(seconds, "-c", "import numpy")
    ask()
    load()
    return Measured(tuple(min(ask(), ask()) / min(load(), load()) for _ in range(5)))


def scores_against_evo() -> Measured:
    """Measure how much longer evo takes for ATE and RPE of 100,000 poses; where the two differ, the ratio is 0."""
    compared = evo.compare(100_000)
    note = f"they differ by {compared.largest_difference:.0e} at most"
    if compared.largest_difference > evo.TOLERANCE:
        return Measured((0.0,), f"not equal: {note}")
    return Measured(compared.ratios, note)


BUDGETS: Sequence[Budget] = (
    Budget("eskf-filterpy over eskf, same log", 5.0, True, filter_against_filterpy),
    Budget("our Python factor over a native one, 3 × 12", 10.0, False, python_factor),
    *(Budget(f"fls over window, lag {s:g} s", 20.0, True, partial(window_against_fls, s)) for s in LAGS_S),
    Budget("compiling eskf, fls and window from nothing", 75.0, False, compiling, unit="s"),
    Budget("20,000 finished runs, the same command again", 15.0, False, finished_again_s, unit="s"),
    Budget("20,000 finished runs, peak memory of it", 500.0, False, finished_again_mb, unit="MB"),
    Budget("20,000 finished runs, the report's page", 10.0, False, page_of_finished_mb, unit="MB"),
    Budget("eskf's run in a worker over its work, 20 s", 2.5, False, partial(whole_run, 20.0)),
    Budget("eskf's run in a worker over its work, 10 min", 1.3, False, partial(whole_run, 600.0)),
    Budget("harness over eskf's steps, 10 min", 0.5, False, harness_against_steps),
    Budget("check before an experiment over eskf's run, 10 min", 0.05, False, check_against_run),
    Budget("evo over ATE and RPE, 100,000 poses", 100.0, True, scores_against_evo),
    Budget("simulate over eskf, 10 min", 2.0, False, simulation_against_filter),
    Budget("two workers over one, 100 runs", 1.8, True, two_workers_against_one),
    Budget("memory of 1 h over its arrays", 10.0, False, memory_of_an_hour),
    Budget("fathom --help over import numpy", 4.0, False, help_against_numpy),
)
