"""How much work a step is, in numbers that no busy machine changes: they hold for one set of versions.

Counted over the first minute of a simulated survey. What the clock tells in noise, these tell exactly: a smoother that
linearises anew more than it has to, factor slots that pile up, a factor that is called twice, a step that allocates.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gtsam
from numba.core.runtime import _nrt_python as numba_memory  # pyright: ignore[reportAttributeAccessIssue]

from ...datasets import Log, Scenario, simulate
from ...datasets.epochs import Epoch, cut
from ...estimators import create
from ..execution.drive import score_ticks

COUNTED: dict[str, tuple[str, dict[str, Any]]] = {
    "eskf": ("eskf", {}),
    "fls, lag 3 s": ("fls", {"lag_s": 3.0}),
    "fls, lag 10 s": ("fls", {"lag_s": 10.0}),
    "fls, preintegrated": ("fls", {"dvl": ["preintegrated-loose"]}),
    "window, lag 3 s": ("window", {"lag_s": 3.0}),
    "window, lag 10 s": ("window", {"lag_s": 10.0}),
    "window, lag 30 s": ("window", {"lag_s": 30.0}),
}
COUNTERS = {
    "keyframes": "keyframes",
    "factor_slots": "places for factors that the smoother holds at the end, the empty ones included",
    "relinearised": "variables (fls) or keyframes (window) that were linearised anew, per keyframe",
    "refactored": "blocks that window factored, per keyframe",
    "callbacks": "calls of our Python factors by GTSAM, per keyframe",
    "python_calls": "calls that Python makes, of functions of any kind, per step",
    "allocations": "arrays that compiled code allocates, per step",
}
WARM_STEPS = 100
"""Steps before calls and allocations are counted: what compiles or grows once has then done so."""


def count(name: str) -> dict[str, float]:
    """Return the counters of one of COUNTED that there are for it.

    Raises:
        KeyError: there is no such name.
    """
    estimator, options = COUNTED[name]
    log = simulate(Scenario(duration_s=60.0, imu="tactical"), seed=4)
    found: dict[str, float] = {}
    with _callbacks() as called:
        one, relinearised = _driven(log, estimator, options, lambda step, epochs: list(map(step, epochs)))
        n = found["keyframes"] = one.counts.get("keyframes", 0)
        if estimator == "fls":
            found["factor_slots"] = one._solver.isam2.getFactorsUnsafe().size()
            found |= {"relinearised": relinearised[0] / n, "callbacks": called[0] / n}
        elif estimator == "window":
            found |= {key: one.counts[key] / n for key in ("relinearised", "refactored")}
        else:
            del found["keyframes"]
    for key, counting in (("python_calls", _python_calls), ("allocations", _allocations)):
        per_step: list[float] = []

        def counted(
            step: Callable[[Epoch], None],
            epochs: list[Epoch],
            counting: Callable[..., int] = counting,
            per_step: list[float] = per_step,
        ) -> None:
            for epoch in epochs[:WARM_STEPS]:
                step(epoch)
            per_step.append(counting(step, epochs[WARM_STEPS:]) / (len(epochs) - WARM_STEPS))

        _driven(log, estimator, options, counted)
        found[key] = per_step[0]
    return {key: round(found[key], 4) for key in COUNTERS if key in found}


def _driven(log: Log, name: str, options: dict[str, Any], drive: Callable[..., object]) -> tuple[Any, list[int]]:
    """Return a pass after all its steps, and how many variables GTSAM linearised anew, as one number in a list."""
    assert log.prior is not None
    one: Any = create(name, **options).begin(log.prior, log.rig)
    relinearised = [0]
    if name == "fls":
        update = one._solver.update

        def counting(*arguments: Any) -> None:
            update(*arguments)
            relinearised[0] += one._solver._lagged.getISAM2Result().getVariablesRelinearized()

        one._solver.update = counting
    drive(one.step, cut(log, score_ticks(log, 1.0)).epochs)
    return one, relinearised


@contextmanager
def _callbacks() -> Iterator[list[int]]:
    """Count, in a list of one number, how often GTSAM calls the factors that are made meanwhile."""
    called, made = [0], gtsam.CustomFactor

    def factor(model: Any, keys: Any, error: Callable[..., Any]) -> Any:
        def counting(*arguments: Any) -> Any:
            called[0] += 1
            return error(*arguments)

        return made(model, keys, counting)

    gtsam.CustomFactor = factor
    try:
        yield called
    finally:
        gtsam.CustomFactor = made


def _python_calls(step: Callable[[Epoch], None], epochs: list[Epoch]) -> int:
    calls = 0

    def profile(_: Any, event: str, __: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    before = sys.getprofile()
    for epoch in epochs:
        sys.setprofile(profile)
        step(epoch)
        sys.setprofile(before)
    return calls - len(epochs)  # the last call of each is ours, of setprofile


def _allocations(step: Callable[[Epoch], None], epochs: list[Epoch]) -> int:
    was_on = numba_memory.memsys_stats_enabled()
    numba_memory.memsys_enable_stats()
    before = numba_memory.memsys_get_stats_mi_alloc()
    for epoch in epochs:
        step(epoch)
    n = numba_memory.memsys_get_stats_mi_alloc() - before
    if not was_on:
        numba_memory.memsys_disable_stats()
    return n
