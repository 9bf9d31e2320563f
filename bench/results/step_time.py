"""The distribution of step times: a histogram small enough for a row of the store, which adds up over runs.

Its bins are fixed, so that the histograms of many seeds are added bin by bin, and at the edges of bins the share of
steps that took longer is exact.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.state import Array, TimeArray

PER_DECADE = 40
"""Bins per factor of ten: one is 5.9 % wide."""
DECADES = 13
"""From a nanosecond to nearly three hours."""
EDGES_NS: Array = 10.0 ** (np.arange(PER_DECADE * DECADES + 1) / PER_DECADE)
"""Edges of the bins, from 1 ns, equally spaced in logarithm."""


def step_histogram(step_ns: TimeArray) -> str:
    """Return how many of the times step_ns (n,) lie in each bin, as JSON: {bin: count}, without the empty bins.

    Bin k holds EDGES_NS[k] ≤ t < EDGES_NS[k + 1]; times beyond the last edge lie in the last bin, 0 in the first.
    """
    bins = np.searchsorted(EDGES_NS, step_ns, side="right") - 1
    found, counts = np.unique(bins.clip(0, len(EDGES_NS) - 2), return_counts=True)
    return json.dumps({str(k): n for k, n in zip(found.tolist(), counts.tolist(), strict=True)})


@dataclass(frozen=True, eq=False)
class StepTimes:
    """The step times of one estimator over several runs.

    Attributes:
        counts: (bins,) of the histogram.
        max_us: the longest of all steps.
        runs: how many runs were added up.
    """

    counts: NDArray[np.int64]
    max_us: float
    runs: int

    @property
    def steps(self) -> int:
        """How many steps there were."""
        return int(self.counts.sum())

    def longer(self) -> tuple[Array, Array]:
        """Return times, µs, (k,), and the share of steps that took at least that long, (k,), up to the longest step."""
        there = np.flatnonzero(self.counts)
        first, last = int(there[0]), int(there[-1])
        edges_us = EDGES_NS[first : last + 1] / 1e3
        share = self.counts[first : last + 1][::-1].cumsum()[::-1] / self.steps
        return np.append(edges_us, max(self.max_us, edges_us[-1])), np.append(share, 1 / self.steps)

    def quantile_us(self, q: float) -> float:
        """Return the quantile q of the step times, µs, as the upper edge of its bin: at most 5.9 % too high."""
        k = int(np.searchsorted(self.counts.cumsum(), q * self.steps))
        return min(float(EDGES_NS[k + 1]) / 1e3, self.max_us)


def usual_machine(rows: Iterable[Mapping[str, Any]]) -> str | None:
    """Return the machine, as the store has it, on which most rows with step times were run; None without any."""
    made = Counter(row["machine"] for row in rows if row.get("step_histogram"))
    return made.most_common(1)[0][0] if made else None


def machine_name(machine: str | None) -> str:
    """Return the name of a machine in figures and tables: its processor and cores."""
    known = json.loads(machine or "{}")
    cores = known.get("cores")
    return f"{' '.join(known.get('cpu', '').split()) or 'unknown processor'}{f', {cores} cores' if cores else ''}"


def pooled_steps(rows: Iterable[Mapping[str, Any]]) -> StepTimes | None:
    """Add up the histograms of runs; None where no row has one."""
    known = [row for row in rows if row.get("step_histogram")]
    counts = np.zeros(len(EDGES_NS) - 1, np.int64)
    for row in known:
        for k, n in json.loads(row["step_histogram"]).items():
            counts[int(k)] += n
    return StepTimes(counts, max(row["step_max_us"] or 0.0 for row in known), len(known)) if counts.any() else None
