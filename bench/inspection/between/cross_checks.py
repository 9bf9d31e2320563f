"""All checks of one sensor against another, for the sensors that a log has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ....datasets.log import Log
from ..findings.finding import Check
from .clock import clock_check
from .headings import gyro_against_heading, heading_against_truth
from .inertial import inertial_of
from .lever_arm import imu_against_dvl, mirrored_dvl, up_check
from .pair_check import PairCheck
from .path_fit import positions
from .references import depth_against_truth, dvl_against_truth, gps_against_truth, reference_of, truth_against_itself
from .velocity import dvl_against_positions


def cross_checks(log: Log) -> list[Check]:
    """Return a check for every pair of sensors that see the same motion, if both are there for long enough.

    Every estimate has a standard deviation taken from the data (`fitting`). A finding needs a difference from the
    description that is larger than chance and large enough to matter. A fix is relative to what log.yaml has already:
    offsets and delays add, scales multiply.
    """
    silent: dict[str, Any] = {name: None for name, stream in log.streams.items() if not len(stream)}
    log = replace(log, **silent)  # a stream without rows counts as absent
    imu, reference = inertial_of(log), reference_of(log)
    answers: list[PairCheck | None] = []
    if log.dvl is None:
        answers.append(PairCheck(up_check(log, imu)))
    if log.heading is not None:
        answers += [gyro_against_heading(log, imu), heading_against_truth(log)]
    if log.dvl is not None:
        if (mirrored := mirrored_dvl(log, imu)) is not None:
            answer, log = mirrored  # the other checks use the corrected axes
            answers.append(answer)
        of_truth = None if reference is None else dvl_against_truth(log, imu, reference)
        elsewhere = of_truth is not None and any(finding.stream == "truth" for finding in of_truth.check.findings)
        for where in positions(log, imu):
            answer = dvl_against_positions(log, imu, where)
            if answer is not None and elsewhere and where.whose == log.truth_kind:
                answer = PairCheck(answer.check)  # the truth's lever arm looks like delays there
            answers.append(answer)
        answers.append(of_truth)
        answers.append(imu_against_dvl(log, imu))
    if reference is not None:
        answers += [gps_against_truth(log, reference), depth_against_truth(log, reference), truth_against_itself(log)]
    met = [answer for answer in answers if answer is not None]
    delays = [delay for answer in met for delay in answer.delays]
    return [*(answer.check for answer in met), clock_check(log, delays)]
