"""What the sensors of a log say of each other: the cross-sensor checks, each where its sensors are there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ....datasets.log import Log
from ..findings.finding import Check
from .answers import Answer
from .clock import clock_check
from .headings import gyro_against_heading, heading_against_truth
from .inertial import inertial_of
from .lever_arm import imu_against_dvl, mirrored_dvl, up_check
from .path_fit import positions
from .references import depth_against_truth, dvl_against_truth, gps_against_truth, reference_of, truth_against_itself
from .velocity import dvl_against_positions


def cross_checks(log: Log) -> list[Check]:
    """Return a check for every pair of sensors that see the same; those that are absent, or too short, are left out.

    Every estimate comes with a standard deviation that the data tell (`fitting`). A finding is raised where it differs
    from what the description says beyond chance and by a size that matters. What to put into log.yaml comes on top of
    what stands there: offsets and delays add, scales multiply.
    """
    silent: dict[str, Any] = {name: None for name, stream in log.streams.items() if not len(stream)}
    log = replace(log, **silent)  # a sensor that never spoke is none
    imu, reference = inertial_of(log), reference_of(log)
    answers: list[Answer | None] = []
    if log.dvl is None:
        answers.append(Answer(up_check(log, imu)))
    if log.heading is not None:
        answers += [gyro_against_heading(log, imu), heading_against_truth(log)]
    if log.dvl is not None:
        if (mirrored := mirrored_dvl(log, imu)) is not None:
            answer, log = mirrored  # the other checks go on with what it means
            answers.append(answer)
        answers += [dvl_against_positions(log, imu, where) for where in positions(log, imu)]
        if reference is not None:
            answers.append(dvl_against_truth(log, imu, reference))
        answers.append(imu_against_dvl(log, imu))
    if reference is not None:
        answers += [gps_against_truth(log, reference), depth_against_truth(log, reference), truth_against_itself(log)]
    met = [answer for answer in answers if answer is not None]
    delays = [delay for answer in met for delay in answer.delays]
    return [*(answer.check for answer in met), clock_check(log, delays)]
