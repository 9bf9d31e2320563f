"""Between beliefs and the records that compiled code works on; and the splitting of IMU blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.state import VELOCITY, Belief, NavState
from .imu import STATE


def as_record(belief: Belief) -> NDArray[Any]:
    """Return the belief as one STATE record."""
    record, x = np.zeros(1, STATE), belief.state
    record["R_WB"], record["p_WB_W"], record["v_WB_W"] = x.R_WB, x.p_WB_W, x.v_WB_W
    record["b_a"], record["b_g"], record["P"] = x.b_a, x.b_g, belief.P
    return record


def as_belief(t_ns: int, record: NDArray[Any]) -> Belief:
    """Return one STATE record as a belief, copied."""
    s = record[0]
    state = NavState(*(s[name].copy() for name in ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g")))
    return Belief(t_ns, state, s["P"].copy())


def with_rate_noise(belief: Belief, rig: NDArray[Any]) -> Belief:
    """Return the belief with the rate noise of the IMU's lever arm in its velocity (see `imu`)."""
    R_WB, P = belief.state.R_WB, belief.P.copy()
    P[VELOCITY, VELOCITY] += R_WB @ rig["rate_cov"][0] @ R_WB.T
    return Belief(belief.t_ns, belief.state, P)


def split(imu: NDArray[Any], t_ns: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Split IMU_SAMPLE rows at t_ns; a sample that straddles it becomes two of the same rates."""
    k = int(np.searchsorted(imu["t_ns"], t_ns, side="right"))
    head, tail = imu[:k], imu[k:]
    if len(tail):
        began_ns = int(tail["t_ns"][0]) - round(float(tail["dt_s"][0]) * 1e9)
        if began_ns < t_ns:
            head, tail = np.concatenate([head, tail[:1]]), tail.copy()
            head["dt_s"][-1], tail["dt_s"][0] = (t_ns - began_ns) * 1e-9, (int(tail["t_ns"][0]) - t_ns) * 1e-9
            head["t_ns"][-1] = t_ns
    return head, tail
