"""Stages of a step: each nanosecond belongs to the innermost, and every estimator marks its own."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter_ns, sleep

import pytest
from fathom.datasets import Scenario, simulate
from fathom.datasets.epochs import cut
from fathom.estimators import create
from fathom.estimators.stages import STAGES, clock, stage


@pytest.fixture(autouse=True)
def _stopped() -> Iterator[None]:
    yield
    clock.stop()


@stage("solve")
def outer() -> None:
    sleep(0.02)
    inner()
    sleep(0.02)


@stage("marginal")
def inner() -> None:
    sleep(0.03)


def test_time_belongs_to_the_innermost_stage() -> None:
    clock.start()
    outer()
    spent = dict(zip(STAGES, clock.read(), strict=True))
    assert spent["solve"] >= 0.04e9
    assert spent["marginal"] >= 0.03e9
    assert spent["propagation"] == spent["linearisation"] == spent["output"] == 0
    assert clock.calls == {"outer": 1, "inner": 1}


def test_nothing_is_timed_unless_asked_for() -> None:
    clock.start()
    clock.stop()
    outer()
    assert clock.read() == (0,) * len(STAGES)
    assert not clock.calls


def test_a_stage_is_left_when_it_raises() -> None:
    @stage("solve")
    def fails() -> None:
        raise ValueError("spoilt")

    clock.start()
    with pytest.raises(ValueError, match="spoilt"):
        fails()
    before = clock.read()
    sleep(0.01)
    assert clock.read() == before


@pytest.mark.parametrize("name", ["eskf", "fls", "window", "dead-reckoning"])
def test_the_stages_of_a_pass_add_up_to_no_more_than_its_time(name: str) -> None:
    log = simulate(Scenario(duration_s=20.0, imu="tactical"), seed=1)
    assert log.prior is not None
    for _ in range(2):  # the first compiles
        clock.start()
        one = create(name).begin(log.prior, log.rig)
        started = perf_counter_ns()
        for epoch in cut(log).epochs:
            one.step(epoch)
            one.belief()
        took_ns = perf_counter_ns() - started
        spent = dict(zip(STAGES, clock.read(), strict=True))
        clock.stop()
    assert 0 < sum(spent.values()) <= took_ns
    assert all(spent[name] > 0 for name in ("propagation", "solve"))
    if name in ("fls", "window"):
        assert spent["linearisation"] > 0
