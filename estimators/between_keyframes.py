"""Beliefs between keyframes: predicted by the IMU and corrected as in a filter; the smoother does not use them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets.epochs import SENSOR
from ..datasets.state import DIM
from .interface import Diverged
from .physics.elimination import normalised_square
from .physics.imu import BLOCK, split
from .physics.kalman import correct, propagate
from .physics.measurements import measure
from .robust import LOSSES, Loss, weight_of, width
from .stages import stage


@stage("propagation")
def carry_on(
    state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], now_ns: int,
    waiting: Sequence[NDArray[Any]] = (), losses: Mapping[str, Loss] | None = None,
) -> None:  # fmt: skip
    """Predict a belief at a keyframe to now_ns, in place, and correct it by the waiting readings.

    Args:
        state: STATE record.
        rig: RIG record.
        before: the IMU sample that ends at the keyframe.
        imu: samples since then, up to now_ns at least.
        now_ns: time to end at.
        waiting: READING rows in the order of their times; one from before the keyframe is taken as of it.
        losses: loss by sensor, under which readings are weighted.

    Raises:
        Diverged: a correction is impossible.
    """
    block = np.zeros(1, BLOCK)
    for reading in [*waiting, None]:
        part, imu = split(imu, now_ns if reading is None else int(reading["t_ns"][0]))
        if len(part):
            propagate(state, rig, before, part, block)
            before = part[-1:]
        if reading is not None and not correct(state, rig, weighted(reading, state, rig, losses or {})):
            raise Diverged("the innovation covariance is not positive definite, or the state is not finite")


def weighted(reading: NDArray[Any], state: NDArray[Any], rig: NDArray[Any], losses: Mapping[str, Loss]) -> NDArray[Any]:
    """Return a reading with the noise that corresponds to its weight under its loss, at a predicted STATE record."""
    loss = losses.get(SENSOR[int(reading["kind"][0])])
    r, H, C = np.empty(3), np.empty((3, DIM)), np.empty((3, 3))
    if loss is None or not (n := measure(reading, 0, state, rig, r, H, C)):
        return reading
    weight = weight_of(LOSSES.index(loss), math.sqrt(normalised_square(n, r, H, C)), width(loss, n))
    reading = reading.copy()
    reading["sigma"] = reading["sigma"] / math.sqrt(weight) if weight > 0 else np.inf
    return reading
