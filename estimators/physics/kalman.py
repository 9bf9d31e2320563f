"""The two steps of the error-state Kalman filter, compiled: for the filters, and for smoothers between keyframes.

The equations are docs/conventions.md (26), (32), (33), (35) and (36).

Source: Solà 2017, arXiv:1711.02298, sections 5–6, with the error on the right of R_WB and the block of `imu` as the
transition.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled
from ...datasets.state import DIM, Array
from .elimination import absorb
from .imu import integrate, predict, process_noise, sandwich
from .measurements import measure
from .state import inject


@compiled
def propagate(
    state: NDArray[Any], rig: NDArray[Any], before: NDArray[Any], imu: NDArray[Any], block: NDArray[Any]
) -> None:
    """x ← f(x, imu), P ← F P Fᵀ + Q; fills `block` with the motion."""
    integrate(imu, before, state[0].b_a[:], state[0].b_g[:], rig, block)
    carry(block, state, rig[0].gravity)


@compiled
def carry(block: NDArray[Any], state: NDArray[Any], gravity: float) -> None:
    """Carry a STATE record, with its P, over a BLOCK, in place."""
    F, Q = np.empty((DIM, DIM)), np.empty((DIM, DIM))
    process_noise(block, state[0].R_WB[:], Q)
    predict(block, state, gravity, F, state)
    sandwich(F, state[0].P[:], Q, state[0].P[:])


@compiled
def correct(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any]) -> bool:
    """Correct by all readings, linearised together at the predicted state; False where that is impossible."""
    dx = np.zeros(DIM)
    if not find_correction(state, rig, readings, dx):
        return False
    inject(state, dx)
    return True


@compiled
def find_correction(state: NDArray[Any], rig: NDArray[Any], readings: NDArray[Any], dx: Array) -> bool:
    """Add to dx (15,), which is zero, the correction by all readings; P becomes that of the error less dx, (35)."""
    r, H, C, total = np.empty(3), np.empty((3, DIM)), np.empty((3, 3)), 0.0
    for m in range(len(readings)):
        n = measure(readings, m, state, rig, r, H, C)
        if not absorb(n, r, H, C, dx, state[0].P[:]):
            return False
    for i in range(DIM):
        total += dx[i]
    return math.isfinite(total)
