"""What an estimator gives back is checked, and what cannot be ends the run in a sentence, never as done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fathom.bench.execution.drive import run_log
from fathom.bench.execution.outputs import wrong_value
from fathom.datasets import Belief, Log, NavState, Scenario, Trajectory, simulate
from fathom.estimators import ESTIMATORS, FACTORS, create

SPOILT_S = 3
TICKS = 20
LOG = simulate(Scenario(duration_s=20.0), seed=2)


@dataclass(frozen=True)
class Still:
    """Stays where it is; what it gives at each tick goes through `online`, what it gives at the end is `smoothed`."""

    online: Callable[[Belief], Any] = lambda belief: belief
    smoothed: Callable[[], Any] = lambda: None
    counts: Any = None
    factors: frozenset[str] = FACTORS

    def begin(self, prior: Belief, rig: Any) -> StillPass:
        return StillPass(self, prior)


class StillPass:
    def __init__(self, config: Still, prior: Belief) -> None:
        self.config, self.prior, self.t_ns = config, prior, prior.t_ns
        self.counts = {} if config.counts is None else config.counts

    def step(self, epoch: Any) -> None:
        self.t_ns = epoch.t_ns

    def belief(self) -> Any:
        return self.config.online(Belief(self.t_ns, self.prior.state, np.eye(15)))

    def finish(self) -> Any:
        return self.config.smoothed()


def spoiling(change: Callable[[Belief], Any]) -> Still:
    """Right at first, and from SPOILT_S on with this change."""
    return Still(lambda b: change(b) if b.t_ns >= LOG.start_ns + SPOILT_S * 10**9 else b)


def with_state(**parts: Callable[[Any], Any]) -> Callable[[Belief], Belief]:
    return lambda b: replace(b, state=replace(b.state, **{k: f(getattr(b.state, k)) for k, f in parts.items()}))


def with_P(change: Callable[[np.ndarray], Any]) -> Callable[[Belief], Belief]:
    return lambda b: replace(b, P=change(b.P.copy()))


def at(index: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(P: np.ndarray) -> np.ndarray:
        P[index] = value
        return P

    return change


@pytest.mark.parametrize(
    ("change", "status", "says"),
    [
        (with_state(R_WB=lambda R: 2 * R), "failed", "R_WB is not a rotation: |R Rᵀ − I| is up to 3.0e+00"),
        (with_state(R_WB=lambda R: R @ np.diag([1.0, 1.0, -1.0])), "failed", "R_WB is a reflection"),
        (with_state(R_WB=lambda R: R + 1e-4), "failed", "R_WB is not a rotation"),
        (with_state(R_WB=lambda R: np.eye(4)), "failed", "R_WB of a belief or trajectory must be a float64"),
        (with_state(R_WB=lambda R: R[0]), "failed", "found float64 (3,)"),
        (with_state(p_WB_W=lambda p: p + 1j), "failed", "must be a float64 array (3,), found complex128 (3,)"),
        (with_state(p_WB_W=lambda p: p[:1]), "failed", "found float64 (1,)"),
        (with_state(p_WB_W=lambda p: p.tolist()), "failed", "found list"),
        (with_state(v_WB_W=lambda v: v.astype(object)), "failed", "found object (3,)"),
        (with_state(b_a=lambda b: b.astype(np.float32)), "failed", "found float32 (3,)"),
        (with_state(b_g=lambda b: None), "failed", "found NoneType"),
        (with_state(v_WB_W=lambda v: v * np.nan), "diverged", "the state is not finite"),
        (with_P(lambda P: P[0]), "failed", "P of a belief or trajectory must be a float64 array (15, 15)"),
        (with_P(lambda P: 1.0), "failed", "found float"),
        (with_P(at((3, 3), -1.0)), "diverged", "belief(): P is not positive semidefinite"),
        (with_P(at((9, 9), -1e-3)), "diverged", "P is not positive semidefinite"),
        (with_P(at((0, 4), 0.5)), "diverged", "P is not symmetric"),
        (with_P(lambda P: P + 2 * (np.eye(15, k=3) + np.eye(15, k=-3))), "diverged", "P is not positive semidefinite"),
        (with_P(at((0, 0), np.inf)), "diverged", "the covariance is not finite"),
        (lambda b: replace(b, t_ns=b.t_ns + 1), "failed", "was given one at"),
        (lambda b: None, "failed", "belief() returned NoneType, expected a fathom.datasets.Belief"),
        (lambda b: SimpleNamespace(t_ns=b.t_ns, state=b.state, P=b.P), "failed", "belief() returned SimpleNamespace"),
    ],
)  # fmt: skip
def test_a_belief_that_cannot_be_ends_the_run_at_its_time(change: Any, status: str, says: str) -> None:
    result = run_log(LOG, spoiling(change))
    assert (result.status, says in str(result.cause)) == (status, True), result.cause
    assert result.failed_at_s == pytest.approx(SPOILT_S)
    assert result.online is not None
    assert len(result.online) == SPOILT_S - 1


def test_from_the_first_belief_on_there_is_no_trajectory_at_all() -> None:
    result = run_log(LOG, Still(with_state(R_WB=lambda R: 2 * R)))
    assert (result.status, result.online) == ("failed", None)


def track(**changes: Any) -> Trajectory:
    t_ns = LOG.start_ns + 10**9 * np.arange(1, TICKS + 1)
    x = NavState(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    right = Trajectory.from_beliefs([Belief(int(t), x, np.eye(15)) for t in t_ns], lookahead_s=1.0)
    return replace(right, **{name: change(getattr(right, name)) for name, change in changes.items()})


def sneaked(name: str, change: Callable[[Any], Any]) -> Trajectory:
    """A trajectory changed behind the back of its own checks."""
    right = track()
    object.__setattr__(right, name, change(getattr(right, name)))
    return right


def with_row(row: int, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[row] = value
        return values

    return change


@pytest.mark.parametrize(
    ("make", "status", "says"),
    [
        (lambda: track(R_WB=with_row(2, 2 * np.eye(3))), "failed", "finish(): R_WB is not a rotation"),
        (lambda: track(R_WB=with_row(2, -np.eye(3))), "failed", "finish(): R_WB is a reflection"),
        (lambda: track(P=with_row(2, -np.eye(15))), "diverged", "finish(): P is not positive semidefinite"),
        (lambda: track(v_WB_W=with_row(2, np.nan)), "diverged", "finish(): v_WB_W is not finite"),
        (lambda: track(p_WB_W=with_row(2, np.nan)), "diverged", "the smoothed state is not finite"),
        (lambda: track(p_WB_W=lambda p: p.astype(complex)), "failed", "found complex128 (20, 3)"),
        (lambda: track(t_ns=lambda t: t + 5), "failed", "no time at which a belief was asked for"),
        (lambda: track(t_ns=lambda t: t + 10**12), "failed", "no time at which a belief was asked for"),
        (lambda: track(t_ns=lambda t: t * 1e-9), "failed", "must be int64 nanoseconds, found float64"),
        (lambda: track(t_ns=lambda t: t[::-1]), "failed", "is not after the row above"),
        (lambda: sneaked("t_ns", lambda t: t[[0, 1, 1, *range(3, TICKS)]]), "failed", "the times are not in order"),
        (lambda: sneaked("p_WB_W", lambda p: p[:2]), "failed", "found float64 (2, 3)"),
        (lambda: track(lookahead_s=lambda _: float("nan")), "failed", "lookahead_s must be seconds"),
        (lambda: track(lookahead_s=lambda _: -1.0), "failed", "lookahead_s must be seconds"),
        (lambda: track(lookahead_s=lambda _: "all"), "failed", "lookahead_s must be seconds"),
        (lambda: track().select(slice(0, 0)), "failed", "finish(): 0 of 20 ticks; it must return the states at all"),
        (lambda: track().select(slice(6)), "failed", "finish(): 6 of 20 ticks"),
        (lambda: track().select(slice(1, None)), "failed", "the first without one is 1000000000 ns"),
        (lambda: track().select(np.arange(TICKS) != 7), "failed", "the first without one is 8000000000 ns"),
        (lambda: "a track", "failed", "finish() returned str, expected a fathom.datasets.Trajectory or None"),
    ],
)
def test_a_smoothed_trajectory_that_cannot_be_ends_the_run_and_is_not_scored(make: Any, status: str, says: str) -> None:
    result = run_log(LOG, Still(smoothed=make))
    assert (result.status, says in str(result.cause)) == (status, True), result.cause
    assert list(result.outputs) == ["online"]


def test_right_smoothed_states_are_kept_with_rows_without_covariance() -> None:
    result = run_log(LOG, Still(smoothed=lambda: track(P=with_row(1, np.nan))))
    assert (result.status, list(result.outputs)) == ("done", ["online", "smoothed"])


def test_rounding_is_no_fault() -> None:
    tilted = np.eye(3) + 1e-8
    assert wrong_value(track(R_WB=with_row(2, tilted), P=with_row(2, np.eye(15) + 1e-9 * np.eye(15, k=1)))) is None
    certain = np.diag([1.0, 1.0, 0.0] * 5)  # known for certain in one direction
    assert wrong_value(track(P=with_row(2, certain))) is None


def test_a_wrong_variance_is_seen_beside_much_larger_ones_of_other_units() -> None:
    P = np.diag([1e-4] * 3 + [1e6] * 3 + [1.0] * 3 + [1e-6] * 3 + [1e-12] * 3)
    P[14, 14] = -1e-13
    wrong = wrong_value(track(P=with_row(2, P)))
    assert wrong is not None
    assert wrong == (2, "diverged", "P is not positive semidefinite")


def raising(error: BaseException) -> Callable[[Any], Any]:
    def act(_: Any) -> Any:
        raise error

    return act


class SilentError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    "error", [SystemExit(0), GeneratorExit(), SilentError(), MemoryError("4 GB"), RecursionError("x")]
)
def test_whatever_an_estimator_raises_is_a_failed_run_with_its_traceback(error: BaseException) -> None:
    result = run_log(LOG, Still(raising(error)))
    assert result.status == "failed"
    assert str(result.cause).startswith(type(error).__name__)
    assert result.traceback is not None
    assert "test_outputs.py" in result.traceback
    assert ", in act" in result.traceback


def failing(what: str) -> Any:
    class Odd:
        factors = FACTORS

        def begin(self, prior: Belief, rig: Any) -> Any:
            run = StillPass(Still(), prior)
            match what:
                case "no counts":
                    del run.counts
                case "counts of text":
                    run.counts = {"used": "many"}
                case "step of two":
                    run.step = lambda epoch, more: None  # type: ignore[method-assign]
                case "no belief":
                    run.belief = None  # type: ignore[method-assign]
                case "no pass":
                    return None
            return run

    if what == "no factors":
        del Odd.factors
    elif what == "unknown factor":
        Odd.factors = frozenset({"dvll"})
    elif what == "begin of one":
        Odd.begin = lambda self, prior: None  # type: ignore[assignment]
    elif what == "odd inflate":
        Odd.inflate = {"dvl": -1.0}  # type: ignore[attr-defined]
    return Odd()


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("no counts", "(from Odd.begin): `counts` must be a dict of whole numbers by name, which may be empty; it"),
        ("counts of text", "found {'used': 'many'}"),
        ("step of two", "step(epoch, more) cannot be called as step(epoch)"),
        ("no belief", "StillPass (from Odd.begin) has no method belief()"),
        ("no pass", "NoneType (from Odd.begin) has no method step(epoch)"),
        ("no factors", "Odd has no `factors`, the sensors that it is given"),
        ("unknown factor", "Odd.factors: Value error, no sensor 'dvll'; did you mean 'dvl'?"),
        ("begin of one", "cannot be called as begin(prior, rig)"),
        ("odd inflate", "Odd.inflate: Input should be greater than 0"),
    ],
)  # fmt: skip
def test_what_lacks_the_interface_fails_before_its_first_step_and_names_the_page(what: str, says: str) -> None:
    result = run_log(LOG, failing(what), nis=True)
    assert (result.status, len(result.step_ns)) == ("failed", 0)
    assert says in str(result.cause)
    assert "docs/your-own-estimator.md" in str(result.cause)


def test_counts_that_turn_odd_during_the_run_fail_it() -> None:
    counts: dict[str, Any] = {}
    result = run_log(LOG, Still(lambda b: (counts.update(used=None), b)[1], counts=counts))
    assert result.status == "failed"
    assert "`counts` must be" in str(result.cause)


def test_what_the_harness_counts_is_not_the_estimators_to_say() -> None:
    def claimed(**counts: int) -> dict[str, int]:
        return run_log(LOG, Still(counts=counts)).counts

    assert claimed(imu_gaps_bridged=9, readings=10**9, readings_void=5, mine=4) == claimed() | {"mine": 4}


def test_a_negative_count_is_a_failed_run() -> None:
    result = run_log(LOG, Still(counts={"gated": -5}))
    assert (result.status, result.cause) == ("failed", "ValueError: counts['gated'] is -5; a count is 0 or more")
    assert run_log(LOG, Still(counts={"gated": 0})).status == "done"


def content(log: Log) -> list[bytes]:
    assert log.truth is not None
    assert log.prior is not None
    return [a.tobytes() for a in (log.imu.f_I, log.truth.p_WB_W, log.prior.P, log.rig.imu.R_BS)]


@pytest.mark.parametrize("reach", ["prior", "rig", "setattr", "forced", "imu", "readings"])
def test_who_writes_to_what_he_is_given_fails_and_changes_nothing_for_others(reach: str) -> None:
    log = simulate(Scenario(duration_s=20.0), seed=2)
    before = content(log)

    class Writer(Still):
        def begin(self, prior: Belief, rig: Any) -> StillPass:
            match reach:
                case "prior":
                    prior.P[:] += 1.0
                case "rig":
                    rig.imu.R_BS[0, 0] = 2.0
                case "setattr":
                    object.__setattr__(rig.imu, "R_BS", np.diag([1.0, -1.0, -1.0]))
                case "forced":
                    prior.P.base.flags.writeable = True
                    prior.P.base[0, 0] = 5.0
            return super().begin(prior, rig)

    class Stepping(StillPass):
        def step(self, epoch: Any) -> None:
            super().step(epoch)
            (epoch.imu["f_I"] if reach == "imu" else epoch.readings["z"])[:] = 0.0

    class StepWriter(Still):
        def begin(self, prior: Belief, rig: Any) -> StillPass:
            return Stepping(self, prior)

    result = run_log(log, StepWriter() if reach in ("imu", "readings") else Writer())
    assert result.status == "failed"
    if reach in ("setattr", "forced"):
        assert "changed arrays of the log, the prior or the rig" in str(result.cause)
        assert (result.online, result.smoothed) == (None, None)
    else:
        assert "read-only" in str(result.cause)
        assert content(log) == before


def test_an_epoch_leads_to_no_later_one() -> None:
    class Peeping(StillPass):
        def step(self, epoch: Any) -> None:
            for array in (epoch.imu, epoch.readings):
                while array is not None:
                    assert not len(array) or array["t_ns"].max() <= epoch.t_ns
                    array = array.base
            super().step(epoch)

    class Peeper(Still):
        def begin(self, prior: Belief, rig: Any) -> StillPass:
            return Peeping(self, prior)

    result = run_log(LOG, Peeper())
    assert (result.status, result.cause) == ("done", None)


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name not in ("ukf", "batch", "isam2")])
def test_ours_pass_as_others_do(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = run_log(LOG, create(name))
    assert ours.status == "done", ours.cause
    for output in ours.outputs.values():
        assert wrong_value(output) is None
        assert len(output) == TICKS
