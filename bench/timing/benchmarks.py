"""The benchmarks: small pieces of real work, by name and group.

`pytest tests/bench/timing` times these. `fathom timing against REV` compares them with those of another revision: it
loads this file into the packages of both revisions, so both do the same work. The modules of a revision may lie
elsewhere. So a benchmark uses the public names of README wherever it can, and imports within its function: a
revision that lacks a name lacks that benchmark only. `write_inputs` writes logs and stores once; both read them.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Work:
    """A benchmark that is ready to be timed.

    Attributes:
        do: the work; the same each time.
        units: number of samples, keyframes, poses, ... in it.
    """

    do: Callable[[], object]
    units: int


@dataclass(frozen=True)
class Benchmark:
    """A piece of work.

    Attributes:
        name: unique.
        group: part of the package that it times.
        unit: its time is given per this.
        prepare: makes it ready, given the folder that `write_inputs` filled; not timed.
        short: whether it belongs to the short comparison.
    """

    name: str
    group: str
    unit: str
    prepare: Callable[[Path], Work]
    short: bool = False


SMALL = {"depth_m": 5.0, "leg_m": 15.0, "turn_radius_m": 5.0, "surface_for_s": 10.0}
"""A mission small enough to dive and turn within 20 s."""
SCENARIOS: Mapping[str, dict[str, Any]] = {
    "short": {**SMALL, "imu": "tactical", "duration_s": 20.0},
    "minute": {**SMALL, "imu": "tactical", "duration_s": 60.0},
    "many readings": {
        **SMALL,
        "imu": "tactical",
        "duration_s": 20.0,
        "dvl": {"rate_hz": 25.0},
        "depth": {"rate_hz": 100.0},
        "heading": {"rate_hz": 50.0},
    },
}
POSES = 20_000
"""Enough that the fixed cost of a call does not show."""
ROWS = {
    "name": "rows",
    "description": "Rows for the tables.",
    "logs": [{"scenario": SCENARIOS["short"]}],
    "estimators": [{"name": "dead-reckoning", "with": {"attitude": "heading"}}, {"name": "eskf"}],
    "seeds": 5,
}


def write_inputs(folder: Path, chosen: Iterable[Benchmark]) -> None:
    """Write the logs, the track and, for the report, the store of runs that these benchmarks read."""
    from ...datasets import Scenario, simulate
    from ...datasets.described.folder import write_folder
    from .. import Experiment, run_experiment

    for name, scenario in SCENARIOS.items():
        log = simulate(Scenario.from_dict(scenario), seed=4)
        write_folder(log, folder / name)
        if name == "short":
            write_folder(log, folder / "short as csv", "csv")
    random_walk()[1].to_tum(folder / "track.tum")
    if any(each.group == "report" for each in chosen):
        run_experiment(Experiment.from_dict(ROWS), out=folder, jobs=1)


@cache
def _log(folder: Path, name: str) -> Any:
    from ...datasets import open_log

    return open_log(folder / name)


@cache
def random_walk(n: int = POSES) -> tuple[Any, Any]:
    """Return a random walk of n poses at 10 Hz, and an estimate of it with errors."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from ...datasets import Trajectory

    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.1, (n, 3)), axis=0))
    p_WB_W = np.cumsum(rng.normal(0, 0.2, (n, 3)), axis=0)
    t_ns = np.arange(n, dtype=np.int64) * 10**8
    errs = R * Rotation.from_rotvec(rng.normal(0, 0.1, (n, 3)))
    P = np.broadcast_to(0.01 * np.eye(15), (n, 15, 15)).copy()
    v, b = np.zeros((n, 3)), np.zeros((n, 3))
    estimate = Trajectory(t_ns, errs.as_matrix(), p_WB_W + rng.normal(0, 0.3, (n, 3)), v, b, b, P)
    return Trajectory(t_ns, R.as_matrix(), p_WB_W, v, b, b), estimate


# -- estimators -------------------------------------------------------------------------------------------------------


def _steps(
    folder: Path,
    log_name: str,
    unit: str,
    name: str,
    sensors: Collection[str] | None = None,
    first_s: float = math.inf,
    **options: Any,
) -> Work:
    """Begin a pass, take every step of a log, or of its first seconds, and finish."""
    from ...datasets.epochs import cut
    from ...estimators import create

    log = _log(folder, log_name)
    estimator = create(name, **options)
    ticks = log.imu.t_ns[99::100]  # one a second, as in a run
    epochs = cut(log, ticks, estimator.factors if sensors is None else sensors).epochs
    epochs = [epoch for epoch in epochs if epoch.t_ns - log.start_ns <= first_s * 1e9]

    def do() -> Any:
        one = estimator.begin(log.prior, log.rig)
        for epoch in epochs:
            one.step(epoch)
        one.finish()
        return one

    if unit == "IMU sample":
        return Work(do, sum(len(epoch.imu) for epoch in epochs))
    if unit == "reading":
        return Work(do, sum(len(epoch.readings) for epoch in epochs))
    return Work(do, do().counts["keyframes"])


def _estimator(
    label: str, unit: str, log: str, name: str, *, short: bool = False, group: str = "estimators", **options: Any
) -> Benchmark:
    return Benchmark(label, group, unit, partial(_steps, log_name=log, unit=unit, name=name, **options), short)


# -- preintegration ---------------------------------------------------------------------------------------------------


def _imu_blocks(folder: Path) -> Work:
    """Integrate the IMU of a log in blocks of a fifth of a second, as a filter does."""
    import numpy as np

    from ...datasets.epochs import cut
    from ...estimators import FACTORS
    from ...estimators.physics.imu import BLOCK, compile_rig, first_sample, integrate

    log = _log(folder, "minute")
    rig, samples = compile_rig(log.rig, FACTORS, {}), cut(log, log.imu.t_ns[-1:], ()).epochs[0].imu
    first, blocks = first_sample(samples, rig), [samples[k : k + 20] for k in range(0, len(samples), 20)]
    before = [first, *(block[-1:] for block in blocks)]
    into, zero = np.zeros(1, BLOCK), np.zeros(3)

    def do() -> None:
        for previous, block in zip(before, blocks, strict=False):
            integrate(block, previous, zero, zero, rig, into)

    return Work(do, len(samples))


def _displacements(folder: Path) -> Work:
    """Sum the DVL over blocks of a second."""
    import numpy as np

    from ...datasets.epochs import cut
    from ...estimators import FACTORS
    from ...estimators.physics.dvl_preintegration import preintegrate_dvl
    from ...estimators.physics.imu import compile_rig

    log = _log(folder, "minute")
    rig, samples = compile_rig(log.rig, FACTORS, {}), cut(log, log.imu.t_ns[-1:], ()).epochs[0].imu
    blocks = []
    for k in range(0, len(samples) - 100, 100):
        start_ns, block = int(samples["t_ns"][k] - round(samples["dt_s"][k] * 1e9)), samples[k : k + 100]
        t_ns = start_ns + np.arange(5) * 200_000_000
        blocks.append(
            (block, start_ns, t_ns, np.ones((5, 3)), np.full((5, 3), 0.01), np.zeros(3), rig, True, np.zeros(3))
        )

    def do() -> None:
        for block in blocks:
            preintegrate_dvl(*block)

    return Work(do, 100 * len(blocks))


# -- simulator, scores, loaders, harness, tables ----------------------------------------------------------------------


def _simulation(folder: Path) -> Work:
    from ...datasets import Scenario, simulate

    scenario = Scenario.from_dict(SCENARIOS["minute"])
    return Work(lambda: simulate(scenario, seed=4), len(simulate(scenario, seed=4).imu.t_ns))


def _score(folder: Path, name: str, **options: Any) -> Work:
    from ... import bench

    truth, estimate = random_walk()
    score = getattr(bench, name)
    return Work(lambda: score(truth, estimate, **options), POSES)


def _loading(folder: Path, name: str) -> Work:
    from ...datasets import open_log

    return Work(lambda: open_log(folder / name), len(open_log(folder / name).imu.t_ns))


def _tum(folder: Path) -> Work:
    from ...datasets import Trajectory

    return Work(lambda: Trajectory.from_tum(folder / "track.tum"), POSES)


def _harness(folder: Path) -> Work:
    from ...estimators import create
    from .. import run_log, scores

    log, estimator = _log(folder, "minute"), create("dead-reckoning", attitude="heading")

    def do() -> object:
        online = run_log(log, estimator).online
        assert online is not None
        return scores(log, online)

    return Work(do, len(log.imu.t_ns))


def _tables(folder: Path) -> Work:
    from rich.console import Console

    from ..output.tables.table import print_table
    from ..results.store import load_runs

    rows = load_runs(folder / "rows")
    return Work(lambda: print_table(rows, Console(file=io.StringIO(), width=120)), len(rows))


def _reading_rows(folder: Path) -> Work:
    from ..results.store import load_runs

    return Work(lambda: [load_runs(folder / "rows") for _ in range(5)], 5 * len(load_runs(folder / "rows")))


_WINDOW = ("keyframe", "minute", "window")
_FLS = ("keyframe", "short", "fls")

BENCHMARKS: tuple[Benchmark, ...] = (
    _estimator("eskf, IMU alone", "IMU sample", "minute", "eskf", sensors=(), short=True),
    _estimator("eskf", "reading", "many readings", "eskf", short=True),
    _estimator("dead-reckoning", "reading", "minute", "dead-reckoning", attitude="heading"),
    _estimator("eskf-filterpy", "reading", "short", "eskf-filterpy"),
    _estimator("iekf", "reading", "many readings", "iekf"),
    _estimator("ukf", "reading", "short", "ukf"),
    _estimator("rts", "reading", "minute", "rts"),
    _estimator("fls, lag 3 s", *_FLS, lag_s=3.0, first_s=8.0, short=True),
    _estimator("fls, lag 10 s", *_FLS, lag_s=10.0),
    _estimator("fls, preintegrated", *_FLS, lag_s=3.0, dvl=("preintegrated-loose",)),
    _estimator("fls, tight", *_FLS, lag_s=3.0, dvl=("preintegrated-tight",)),
    _estimator("isam2", "keyframe", "short", "isam2"),
    _estimator("window, lag 3 s", *_WINDOW, lag_s=3.0),
    _estimator("window, lag 10 s", *_WINDOW, lag_s=10.0),
    _estimator("window, lag 30 s", *_WINDOW, lag_s=30.0),
    _estimator("batch, window", "keyframe", "minute", "batch", engine="window"),
    Benchmark("IMU block", "preintegration", "IMU sample", _imu_blocks, short=True),
    Benchmark("DVL displacement", "preintegration", "IMU sample", _displacements),
    Benchmark("simulate", "simulator", "IMU sample", _simulation, short=True),
    Benchmark("ATE", "scores", "pose", partial(_score, name="ate"), short=True),
    Benchmark("RPE, 1 m", "scores", "pose", partial(_score, name="rpe", delta=1.0, unit="m", pairs="all"), short=True),
    Benchmark("NEES", "scores", "pose", partial(_score, name="nees")),
    Benchmark("Parquet", "loaders", "IMU sample", partial(_loading, name="short"), short=True),
    Benchmark("CSV", "loaders", "IMU sample", partial(_loading, name="short as csv")),
    Benchmark("TUM", "loaders", "pose", _tum),
    Benchmark("run and score", "harness", "IMU sample", _harness, short=True),
    Benchmark("tables", "report", "row", _tables),
    Benchmark("store", "report", "row", _reading_rows),
)
