"""The compiled ⊕ and ⊖ are those that define the state, and the covariance follows its state."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets import Belief
from fathom.estimators.physics.state import STATE, as_belief, as_record, inject, local, retract
from paths import random_state


def record(state: object) -> np.ndarray:
    return as_record(Belief(0, state, np.zeros((15, 15))))


@pytest.mark.parametrize("seed", range(10))
def test_compiled_plus_and_minus_are_those_of_the_state(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, error, out = random_state(rng), rng.normal(size=15), np.zeros(1, STATE)
    defined = x.retract(error)
    retract(record(x), error, out)
    for name in ("R_WB", "p_WB_W", "v_WB_W", "b_a", "b_g"):
        assert np.allclose(out[0][name], getattr(defined, name), rtol=1e-13, atol=1e-13)
    found = np.empty(15)
    local(record(x), out, found)
    assert np.allclose(found, x.local(defined), rtol=1e-12, atol=1e-12)


def test_plus_in_place_is_plus() -> None:
    rng = np.random.default_rng(0)
    x, error, out = random_state(rng), rng.normal(size=15), np.zeros(1, STATE)
    here = record(x)
    retract(here, error, out)
    retract(here, error, here)
    assert np.array_equal(here, out)


def test_what_is_injected_moves_the_covariance_into_the_new_tangent() -> None:
    """Errors drawn about x, said about x ⊕ d instead: their covariance to first order."""
    rng = np.random.default_rng(0)
    x, d, M = random_state(rng), 0.5 * rng.normal(size=15), rng.normal(size=(15, 15))
    moved, step = x.retract(d), 1e-6
    J = np.stack([moved.local(x.retract(d + step * e)) - moved.local(x.retract(d - step * e)) for e in np.eye(15)])
    J = J.T / (2 * step)
    state = as_record(Belief(0, x, M @ M.T))
    inject(state, d)
    assert np.allclose(as_belief(0, state).P, J @ M @ M.T @ J.T, rtol=1e-7, atol=1e-7)
    assert np.array_equal(state[0]["P"], state[0]["P"].T)
