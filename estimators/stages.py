"""Where the time of a step goes, by the stages that all estimators share; for `fathom timing`, off by default.

A pass marks its functions with `stage`. While `clock` runs, each nanosecond belongs to the innermost stage entered;
what is in no stage is the rest of the caller's own time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import wraps
from time import perf_counter_ns
from typing import Any, TypeVar, cast

STAGES = ("propagation", "linearisation", "solve", "marginal", "output")
"""IMU block, preintegration, states and covariances predicted; residuals, Jacobians, factors made; gain, or
factorisation and back substitution; covariance of a state, marginalising; beliefs, and smoothed states written down."""

Function = TypeVar("Function", bound=Callable[..., Any])


class StageClock:
    """Nanoseconds by stage; there is one per process, `clock`.

    Attributes:
        running: whether stages are timed.
        calls: how often each marked function was called while the clock ran, by its name.
    """

    def __init__(self) -> None:
        self.running = False
        self.calls: Counter[str] = Counter()
        self._ns: dict[str, int] = dict.fromkeys(STAGES, 0)
        self._entered: list[str] = []
        self._since_ns = 0

    def start(self) -> None:
        """Set every stage to 0, and time from now on. Passes that are timed begin after this."""
        self._ns = dict[str, int](dict.fromkeys(STAGES, 0))
        self._entered, self.running = [], True
        self.calls.clear()

    def stop(self) -> None:
        """Time no longer."""
        self.running = False

    def read(self) -> tuple[int, ...]:
        """Return the nanoseconds of each of STAGES since the start."""
        return tuple(self._ns.values())

    def enter(self, stage: str) -> None:
        """Let time belong to `stage` until it is left, except for what is spent in stages entered meanwhile."""
        self._settle()
        self._entered.append(stage)

    def leave(self) -> None:
        """Leave the stage entered last."""
        self._settle()
        self._entered.pop()

    def _settle(self) -> None:
        now_ns = perf_counter_ns()
        if self._entered:
            self._ns[self._entered[-1]] += now_ns - self._since_ns
        self._since_ns = now_ns


clock = StageClock()


def stage(name: str) -> Callable[[Function], Function]:
    """Return a decorator: the time of the function belongs to the stage `name`, one of STAGES."""
    assert name in STAGES, name

    def decorate(function: Function) -> Function:
        @wraps(function)
        def timed(*arguments: Any, **options: Any) -> Any:
            if not clock.running:
                return function(*arguments, **options)
            clock.calls[function.__qualname__] += 1
            clock.enter(name)
            try:
                return function(*arguments, **options)
            finally:
                clock.leave()

        return cast(Function, timed)

    return decorate


def staged(name: str, function: Function) -> Function:
    """Return the function, its time belonging to the stage `name` if the clock runs now: it costs nothing otherwise."""
    return stage(name)(function) if clock.running else function
