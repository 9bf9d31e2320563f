"""The error-state Kalman filter: predict by the IMU block, correct by every reading of an epoch at once.

Its two steps are those of `physics.kalman`.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from ...datasets.rig import Rig
from ...datasets.state import Belief
from ..physics.kalman import correct, propagate
from .filter_pass import FilterOptions, FilterPass, Kalman


@dataclass(frozen=True)
class ErrorStateKalmanFilter(FilterOptions):
    """Error-state extended Kalman filter over (theta, p, v, b_a, b_g).

    It rewinds and replays for late readings, see `FilterPass`.
    """

    def begin(self, prior: Belief, rig: Rig) -> FilterPass:
        """See `Estimator.begin`."""
        return FilterPass(self, prior, rig, ErrorStateKalman())


class ErrorStateKalman(Kalman):
    """See `Kalman`."""

    def predict(
        self, state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
    ) -> None:
        """See `Kalman.predict`."""
        propagate(state, rig, before, imu, block)

    def correct(self, state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
        """See `Kalman.correct`."""
        return correct(state, rig, readings)
