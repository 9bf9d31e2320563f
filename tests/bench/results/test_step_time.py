from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from fathom.bench.drawing import looks_of
from fathom.bench.output.figures.step_time import draw_step_times, step_times
from fathom.bench.results.step_time import EDGES_NS, PER_DECADE, machine_name, pooled_steps, step_histogram

HERE = json.dumps({"cpu": "Some  Processor", "cores": 4, "node": "a"})
THERE = json.dumps({"cpu": "Another", "cores": 8, "node": "b"})


def row(step_ns: np.ndarray, **other: Any) -> dict[str, Any]:
    known = {"status": "done", "output": "online", "label": "x", "machine": HERE}
    return known | {"step_histogram": step_histogram(step_ns), "step_max_us": float(step_ns.max()) / 1e3} | other


def times(seed: int, n: int = 5000) -> np.ndarray:
    """Step times with a long tail, ns."""
    rng = np.random.default_rng(seed)
    return np.exp(rng.normal(10.0, 1.5, n)).astype(np.int64)


def test_histograms_of_seeds_add_up_to_that_of_all_their_steps() -> None:
    each = [times(seed) for seed in range(4)]
    one_by_one, at_once = pooled_steps(map(row, each)), pooled_steps([row(np.concatenate(each))])
    assert one_by_one is not None
    assert at_once is not None
    assert np.array_equal(one_by_one.counts, at_once.counts)
    assert (one_by_one.steps, one_by_one.runs, at_once.runs) == (20_000, 4, 1)
    assert one_by_one.max_us == at_once.max_us == np.concatenate(each).max() / 1e3


def test_the_share_of_longer_steps_is_exact() -> None:
    step_ns = times(7)
    pooled = pooled_steps([row(step_ns)])
    assert pooled is not None
    t_us, share = pooled.longer()
    assert share[:-1] == pytest.approx([(step_ns >= t * 1e3).mean() for t in t_us[:-1]])
    assert (t_us[-1], share[-1]) == (step_ns.max() / 1e3, 1 / len(step_ns))
    assert share[0] == 1


@pytest.mark.parametrize("q", [0.01, 0.5, 0.9, 0.99, 1.0])
def test_a_quantile_is_right_to_the_width_of_a_bin(q: float) -> None:
    step_ns = times(3)
    pooled = pooled_steps([row(step_ns)])
    assert pooled is not None
    exact_us = float(np.quantile(step_ns, q, method="inverted_cdf")) / 1e3
    assert exact_us <= pooled.quantile_us(q) <= exact_us * 10 ** (1 / PER_DECADE)


def test_a_step_on_an_edge_or_beyond_all_is_counted_once() -> None:
    edges = np.array([0, 1, 10, 100, int(EDGES_NS[-1]), 10**15])
    counts = json.loads(step_histogram(edges))
    assert counts == {"0": 2, "40": 1, "80": 1, str(len(EDGES_NS) - 2): 2}


def test_runs_on_other_machines_are_left_out_and_reported() -> None:
    rows = [row(times(seed), seed=seed) for seed in range(3)] + [row(times(9) * 100, machine=THERE)]
    found, machine = step_times(rows)
    assert machine == HERE
    assert found["x"].runs == 3
    assert found["x"].max_us == max(times(seed).max() for seed in range(3)) / 1e3
    title = draw_step_times(rows, looks_of(["x"]), "t").get_suptitle()
    assert "Some Processor, 4 cores (runs on 1 other machine left out)" in " ".join(title.split())


def test_runs_of_an_older_version_have_no_step_times() -> None:
    assert step_times([row(times(1)) | {"step_histogram": None}]) == ({}, None)
    assert pooled_steps([]) is None
    assert machine_name(None) == "unknown processor"


def test_the_markers_stand_at_the_median_p99_and_the_longest() -> None:
    step_ns = times(2)
    (axes,) = draw_step_times([row(step_ns)], looks_of(["x"]), "t").axes
    t_us, share = axes.lines[1].get_xydata().T
    assert t_us == pytest.approx(np.percentile(step_ns, [50, 99, 100]) / 1e3, rel=0.06)
    assert share == pytest.approx([0.5, 0.01, 1 / 5000])
