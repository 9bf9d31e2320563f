"""The result of one estimator on one log, with its costs and innovations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...datasets.epochs import SENSOR
from ...datasets.state import TimeArray
from ...datasets.trajectory import Trajectory
from ...estimators.physics.innovation import INNOVATION
from ..metrics.consistency import autocorrelation
from ..metrics.scoring import INNOVATIONS, Scoring
from ..results.step_time import step_histogram

Status: TypeAlias = Literal["done", "diverged", "failed"]


@dataclass(frozen=True, eq=False)
class Result:
    """Trajectories of one estimator on one log, and what they cost.

    Attributes:
        status: "done"; "diverged" where the estimator lost itself; "failed" for anything else that ended it early.
        cause: why it is not done, in a sentence.
        failed_at_s: when, from the start of the log.
        online: the beliefs at the ticks, with no delay; None where it never came to the first tick.
        smoothed: the smoothed states; None where the estimator has none.
        step_ns: (epochs,) time of each `step`.
        belief_ns: (ticks,) time of each `belief`.
        finish_ns: time of `finish`.
        counts: what happened to readings, gaps and solvers, by name. "readings_late" counts readings that came late,
            by the log alone; those of them that were dropped are "late".
        duration_s: how much of the log was driven through.
        imu_samples: how many IMU samples went in.
        start: where the prior came from: "given" by the log's maker, else what `initialise` found: "static", "moving",
            and after a comma what is unusual in that.
        notes: how the start was found and what was noticed of the readings, in sentences; see `datasets.notes.Note`.
        nis: INNOVATION rows, in the order of their times; None where they were not asked for.
        traceback: of the error that ended it; None for any other ending.
        step_cpu_ns: (epochs,) processor time of this thread in each `step`; it is less than `step_ns` where the thread
            had to wait, for the processor or for other threads.
        finish_cpu_ns: the same of `finish`.
    """

    status: Status
    cause: str | None
    failed_at_s: float | None
    online: Trajectory | None
    smoothed: Trajectory | None
    step_ns: TimeArray
    belief_ns: TimeArray
    finish_ns: int
    counts: dict[str, int]
    duration_s: float
    imu_samples: int
    start: str = "given"
    notes: tuple[str, ...] = ()
    nis: NDArray[Any] | None = None
    traceback: str | None = None
    step_cpu_ns: TimeArray = field(default_factory=lambda: np.zeros(0, np.int64))
    finish_cpu_ns: int = 0

    @property
    def outputs(self) -> dict[str, Trajectory]:
        """The trajectories there are: "online", "smoothed"."""
        every = {"online": self.online, "smoothed": self.smoothed}
        return {name: trajectory for name, trajectory in every.items() if trajectory is not None}


def innovation_scores(result: Result) -> dict[str, float | None]:
    """Return every score of INNOVATIONS by name; None where it was not asked for, or no such reading was judged."""
    row: dict[str, float | None] = dict.fromkeys(INNOVATIONS)
    for sensor, dof in innovation_dof(result).items():
        of_sensor = _of_sensor(result, sensor)
        row[f"nis_{sensor}"] = float(of_sensor["nis"].sum()) / dof
        row[f"log_density_{sensor}"] = float(of_sensor["log_density"].sum()) / dof
        row[f"whiteness_{sensor}"] = autocorrelation(of_sensor["white"])
    return row


def innovation_dof(result: Result) -> dict[str, int]:
    """Return over how many degrees of freedom the NIS of each sensor is; only those that have any."""
    every = {sensor: int(_of_sensor(result, sensor)["dof"].sum()) for sensor in dict.fromkeys(SENSOR)}
    return {sensor: dof for sensor, dof in every.items() if dof > 0}


def _of_sensor(result: Result, sensor: str) -> NDArray[Any]:
    nis = np.zeros(0, INNOVATION) if result.nis is None else result.nis
    return nis[np.isin(nis["kind"], [kind for kind, name in enumerate(SENSOR) if name == sensor])]


def costs(result: Result, output_rate_hz: float = Scoring().output_rate_hz) -> dict[str, float | str | None]:
    """Return every cost of COSTS that a result knows, by name, and its `step_histogram`; none where it has no step.

    Args:
        result: of a run.
        output_rate_hz: at which beliefs are charged, each with the mean time of those that were asked for.
    """
    if not len(result.step_ns):
        return {}
    median_us, p99_us, max_us = (float(q) / 1e3 for q in np.percentile(result.step_ns, [50, 99, 100]))
    total_s = (int(result.step_ns.sum()) + result.finish_ns) * 1e-9
    asked = len(result.belief_ns)
    outputs_s = float(result.belief_ns.mean()) * 1e-9 * output_rate_hz * result.duration_s if asked else None
    samples = max(result.imu_samples, 1)
    return {
        "step_median_us": median_us,
        "step_p99_us": p99_us,
        "step_max_us": max_us,
        "step_cpu_median_us": float(np.median(result.step_cpu_ns)) / 1e3,
        "belief_median_us": float(np.median(result.belief_ns)) / 1e3 if asked else None,
        "finish_s": result.finish_ns * 1e-9,
        "total_s": total_s,
        "cpu_s": (int(result.step_cpu_ns.sum()) + result.finish_cpu_ns) * 1e-9,
        "real_time_factor": result.duration_s / total_s,
        "us_per_imu_sample": 1e6 * total_s / samples,
        "us_per_imu_sample_with_outputs": None if outputs_s is None else 1e6 * (total_s + outputs_s) / samples,
        "step_histogram": step_histogram(result.step_ns),
    }
