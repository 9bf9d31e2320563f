"""Which tolerance or which shift of a clock would pair two trajectories."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fathom.bench.metrics.time_offset import best_offset_s, tolerance_needed_s
from fathom.datasets import Trajectory

N = 200


def bend(t_s: np.ndarray) -> Trajectory:
    """A path that does not repeat itself, with level attitudes."""
    p = np.stack([t_s, 5 * np.sin(t_s / 7), 2 * np.cos(t_s / 11)], axis=1)
    return Trajectory((t_s * 1e9).round().astype(np.int64), np.repeat(np.eye(3)[None], len(t_s), axis=0), p)


TRUTH = bend(np.arange(N, dtype=float))


def shifted(by_s: float) -> Trajectory:
    return replace(TRUTH, t_ns=TRUTH.t_ns + round(by_s * 1e9))


@pytest.mark.parametrize("by_s", [3.0, -7.25, 0.0])
@pytest.mark.parametrize("mode", ["none", "yaw", "origin"])
def test_the_offset_of_a_clock_is_found(by_s: float, mode: str) -> None:
    found = best_offset_s(TRUTH, shifted(by_s), mode)  # type: ignore[arg-type]
    assert found is not None
    assert found[0] == pytest.approx(-by_s, abs=0.02)
    assert found[1] < 0.1


def test_an_offset_is_not_sought_where_there_is_nothing_to_fit() -> None:
    one = TRUTH.select(slice(0, 1))
    assert best_offset_s(one, TRUTH) is None
    assert best_offset_s(TRUTH, shifted(1e6)) is None


def test_a_tolerance_pairs_what_jitters() -> None:
    rng = np.random.default_rng(0)
    late_ns = rng.integers(-120_000_000, 120_000_000, N)
    needed_s = tolerance_needed_s(TRUTH, replace(TRUTH, t_ns=TRUTH.t_ns + late_ns))
    assert needed_s == pytest.approx(np.quantile(np.abs(late_ns), 0.95) * 1e-9)
    assert tolerance_needed_s(TRUTH, shifted(1e6)) is None
