"""Honesty: ANEES of every log, estimator, output and block, as a mean over its fixed times, and who leaves the band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..metrics.consistency import Average, anees_of, interval
from ..metrics.state_error import BLOCKS, Block
from .summary import SEEDS_ENOUGH, Record, Rows, last_words, outputs

FALSE_ALARM = 0.01
"""Probability that a consistent estimator leaves the band of a block at any of the fixed times: 99 % stay inside."""
FEWEST_LOGS = 2
"""One log has its own table of consistency."""

HONESTY = (
    *("log", "label", "output", "lookahead_s", "block", "anees", "low", "high"),
    *("above", "below", "times", "seeds", "runs"),
)


def honesty(rows: Rows) -> list[Record]:
    """Return one record per log, estimator, output and block, in the order of the rows; HONESTY names its fields.

    `anees` is the mean over the fixed times of `metrics.consistency`, per degree of freedom: 1 is consistent. At each
    time a consistent estimator lies in the band from `low` to `high` with probability 1 − FALSE_ALARM / `times`, by
    docs/conventions.md (55). `above` and `below` count the times outside. `seeds` of `runs` finished; the numbers are
    None where none did, or where an output has no covariance.

    A band holds for one number of seeds; where it differs between times, `low` and `high` are the widest.
    """
    found: list[Record] = []
    for output, of in outputs(rows):
        done = [row for row in of if row["status"] == "done"]
        averages = anees_of([row["nees_at"] for row in done])
        known = output | {"seeds": len(done)}
        found += [known | {"block": block} | _judged(averages.get(block)) for block in BLOCKS]
    return found


def _judged(average: Average | None) -> Record:
    """Return the mean of an ANEES over its times, its band, and how many times are outside."""
    if average is None:
        return dict.fromkeys(("anees", "low", "high", "above", "below", "times"))
    low, high = interval(average.dof, 1.0 - FALSE_ALARM / len(average))
    return {
        "anees": float(average.value.mean()),
        "low": float(low.min()),
        "high": float(high.max()),
        "above": int(np.sum(average.value > high)),
        "below": int(np.sum(average.value < low)),
        "times": len(average),
    }


def compared(found: Sequence[Record]) -> list[Record]:
    """Return the `last_words` that a table or a figure of several logs shows; none where seeds or logs are too few."""
    logs = {row["log"] for row in found if row["anees"] is not None and row["seeds"] >= SEEDS_ENOUGH}
    if len(logs) < FEWEST_LOGS:
        return []
    return last_words([row for row in found if row["log"] in logs])


def band_of(found: Sequence[Record], block: Block) -> tuple[float, float] | None:
    """Return the band of a block for the most seeds that any record has; None where there is none."""
    known = [row for row in found if row["block"] == block and row["low"] is not None]
    best = max(known, key=lambda row: row["seeds"], default=None)
    return None if best is None else (best["low"], best["high"])
