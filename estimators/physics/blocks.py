"""Blocks of 3 × 3 in a larger matrix, written by loops, which compile ten times as fast as slices."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...datasets.compiling.decorators import compiled
from ...datasets.state import Array

TOP: Any = np.int64(0)
"""The first row; a plain 0 would be a type of its own, and the function compiled once more."""


@compiled
def clear(M: Array) -> None:
    """M ← 0."""
    for i in range(M.shape[0]):
        for j in range(M.shape[1]):
            M[i, j] = 0.0


@compiled
def identity(M: Array) -> None:
    """M ← I, square."""
    clear(M)
    for i in range(M.shape[0]):
        M[i, i] = 1.0


@compiled
def set_block(M: Array, row: int, column: int, scale: float, A: Array) -> None:
    """Write scale A (3, 3) into M, from (row, column) on."""
    for i in range(3):
        for j in range(3):
            M[row + i, column + j] = scale * A[i, j]


@compiled
def set_product(M: Array, row: int, column: int, scale: float, A: Array, B: Array) -> None:
    """Write scale A B, both (3, 3), into M, from (row, column) on."""
    for i in range(3):
        for j in range(3):
            M[row + i, column + j] = scale * (A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j])


@compiled
def rows_times(n: int, H: Array, F: Array, out: Array) -> None:
    """out = H F for n rows; F is square."""
    for i in range(n):
        for j in range(F.shape[1]):
            out[i, j] = 0.0
        for k in range(F.shape[0]):
            if H[i, k] != 0.0:
                for j in range(F.shape[1]):
                    out[i, j] += H[i, k] * F[k, j]
