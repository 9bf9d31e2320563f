"""A stopwatch for Python and compiled code alike: it has a stack, and every nanosecond belongs to one part.

Compiled code that is kept on disk cannot hold an address of this process. So it calls two functions by their names, as
it would call the C library, and each process says where those are; what they write lies in one array.
"""

from __future__ import annotations

import time
from enum import IntEnum
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import cfunc, njit
from numba.core import cgutils, types
from numba.core.extending import intrinsic
from numba.np.numpy_support import carray
from numpy.typing import NDArray


class Part(IntEnum):
    """Where time goes. Of two, one inside the other, the greater counts: see `enter`."""

    IDLE = 0
    REST = 1
    SOLVE = 2
    PROPAGATION = 3
    LINEARISATION = 4
    OUTPUT = 5
    MARGINAL = 6


DEPTH, CURRENT, SINCE, CLOCK, TOTALS, STACK = 0, 1, 2, 3, 5, 16
"""Where on the board they stand; the clock's answer takes two places, seconds and nanoseconds."""
MONOTONIC = int(getattr(time, "CLOCK_MONOTONIC", 1))

BOARD: NDArray[np.int64] = np.zeros(256, np.int64)
_ADDRESS, _SIZE = BOARD.ctypes.data, len(BOARD)


def _as_pointer(_: Any, address: Any) -> Any:
    """An integer as a pointer, as numba wants to be told."""
    return types.CPointer(types.int64)(address), lambda _, builder, __, args: builder.inttoptr(
        args[0], cgutils.intp_t.as_pointer()
    )


_pointer: Any = intrinsic(_as_pointer)


_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.CPointer(types.int64)))


@cfunc("void(int64)")
def _enter(part: int) -> None:
    board = carray(_pointer(_ADDRESS), _SIZE)
    _clock_gettime(np.int32(MONOTONIC), _pointer(_ADDRESS + 8 * CLOCK))
    now_ns, current = board[CLOCK] * 1_000_000_000 + board[CLOCK + 1], board[CURRENT]
    board[TOTALS + current] += now_ns - board[SINCE]
    board[STACK + board[DEPTH]] = current
    board[DEPTH] += 1
    board[CURRENT], board[SINCE] = max(current, part), now_ns


@cfunc("void()")
def _leave() -> None:
    board = carray(_pointer(_ADDRESS), _SIZE)
    _clock_gettime(np.int32(MONOTONIC), _pointer(_ADDRESS + 8 * CLOCK))
    now_ns = board[CLOCK] * 1_000_000_000 + board[CLOCK + 1]
    board[TOTALS + board[CURRENT]] += now_ns - board[SINCE]
    board[DEPTH] -= 1
    board[CURRENT], board[SINCE] = board[STACK + board[DEPTH]], now_ns


llvm.add_symbol("fathom_enter", _enter.address)
llvm.add_symbol("fathom_leave", _leave.address)
ENTER = types.ExternalFunction("fathom_enter", types.void(types.int64))
LEAVE = types.ExternalFunction("fathom_leave", types.void())
"""For compiled code."""


@njit
def enter(part: int) -> None:
    """Begin a part; inside a greater one, go on with that.

    So a solver's call of a residual is linearisation, and what is predicted in order to answer for a belief is output.
    """
    ENTER(part)


@njit
def leave() -> None:
    """End the part that was begun last."""
    LEAVE()


def totals() -> NDArray[np.int64]:
    """Return the time of each part so far, (len(Part),) ns."""
    return BOARD[TOTALS : TOTALS + len(Part)].copy()
