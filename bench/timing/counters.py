"""Counts of the work in a step, over one minute of a simulated survey.

A busy machine does not change them; they are valid for one set of versions. They show exactly what a clock shows with
noise: a smoother that relinearises more than it has to, factor slots that pile up, a factor that is called twice, a
step that allocates.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numba.core.runtime import _nrt_python as numba_memory  # pyright: ignore[reportAttributeAccessIssue]

from ...datasets import Scenario, simulate
from ...datasets.epochs import Epoch, cut
from ...estimators import Pass, create
from ...estimators.stages import clock
from ..execution.drive import score_ticks
from ..output.cells import ABSENT, Cell
from ..output.sheets import Line, Sheet
from ..output.tables import terminal
from ..output.tables.table import print_sheet
from .printing import progress, save, select

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
    "keyframes": "keyframes made over the log",
    "factor_slots": "slots for factors in the smoother at the end, empty ones included",
    "relinearised": "variables (fls) or keyframes (window) that were linearised again, per keyframe",
    "refactored": "blocks that window factored, per keyframe",
    "callbacks": "calls of our Python factors by GTSAM, per keyframe",
    "python_calls": "calls of functions of any kind that Python makes, per step",
    "allocations": "arrays that compiled code allocates, per step",
}
PER_KEYFRAME = ("relinearised", "refactored", "callbacks")
WARM_STEPS = 100
"""Steps before calls and allocations are counted: by then everything is compiled and every buffer has grown."""


def count(name: str) -> dict[str, float]:
    """Return the counters of one of COUNTED, as far as it has them.

    Raises:
        KeyError: there is no such name.
    """
    estimator, options = COUNTED[name]
    log = simulate(Scenario(duration_s=60.0, imu="tactical"), seed=4)
    prior, epochs = log.prior, cut(log, score_ticks(log, 1.0)).epochs
    assert prior is not None

    def begin() -> Any:
        return create(estimator, **options).begin(prior, log.rig)

    found: dict[str, float] = {}
    clock.start()  # passes count while it runs
    one = begin()
    for epoch in epochs:
        one.step(epoch)
    found |= {key: n for key, n in (one.counts | getattr(one, "work", {})).items() if key in COUNTERS}
    clock.stop()
    found |= {key: found[key] / found["keyframes"] for key in PER_KEYFRAME if key in found}
    for key, counting in (("python_calls", _python_calls), ("allocations", _allocations)):
        one = begin()
        for epoch in epochs[:WARM_STEPS]:
            one.step(epoch)
        found[key] = counting(one, epochs[WARM_STEPS:]) / (len(epochs) - WARM_STEPS)
    return {key: round(found[key], 4) for key in COUNTERS if key in found}


def _python_calls(one: Pass, epochs: list[Epoch]) -> int:
    calls = 0

    def profile(_: Any, event: str, __: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    step, before = one.step, sys.getprofile()
    for epoch in epochs:
        sys.setprofile(profile)
        step(epoch)
        sys.setprofile(before)
    return calls - len(epochs)  # the last call in each turn is ours, of setprofile


def _allocations(one: Pass, epochs: list[Epoch]) -> int:
    was_on = numba_memory.memsys_stats_enabled()
    numba_memory.memsys_enable_stats()
    before = numba_memory.memsys_get_stats_mi_alloc()
    for epoch in epochs:
        one.step(epoch)
    n = numba_memory.memsys_get_stats_mi_alloc() - before
    if not was_on:
        numba_memory.memsys_disable_stats()
    return n


def print_counters(only: str | None, out: Path | None) -> None:
    """Print and save the counters of every estimator that has any.

    Raises:
        TimingError: no name matches `only`; the file cannot be written.
    """
    names = select(list(COUNTED), only)
    found = {}
    with progress() as advance:
        for k, name in enumerate(names):
            advance(name, k / len(names))
            found[name] = count(name)
    print_sheet(counters_sheet(found), terminal.console())
    save(out, {"counters": found})


def counters_sheet(found: Mapping[str, Mapping[str, float]]) -> Sheet:
    """Return the table of what `count` found, by name; the meaning of each column stands below it."""
    lines = [
        Line(name, [Cell(f"{counters[key]:,.4g}" if key in counters else ABSENT) for key in COUNTERS])
        for name, counters in found.items()
    ]
    meanings = [f"{key}: {meaning}" for key, meaning in COUNTERS.items()]
    return Sheet("work in a step", meanings, ["estimator", *COUNTERS], lines)
