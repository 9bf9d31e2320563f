"""Remarks on the numbers: runs that did not finish, and results not to be trusted; a line each."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from textwrap import shorten

from ..results.summary import Record, ended_at_gap, groups
from .cells import spans

LONGEST_WAIT = 1.1
"""Of wall time over processor time: costs that differ by a tenth are told apart, so a tenth of waiting matters."""
NO_CAUSE = "no cause is recorded"
CAUSE_WIDTH = 400
"""Letters of a cause that are shown: what went wrong and what to do about it, on five lines of 80 columns."""


def failures(rows: Sequence[Record]) -> list[str]:
    """Return a line for each run that did not finish; a recording that is not here has one line in all.

    Seeds that ended by the same cause share a line, which says when the first of them did. The first line with a
    traceback, by label and cause, says where it ends.
    """
    lines, placed = [], set()
    ended = (row for row, *_ in groups(rows, "log", "label", "seed").values() if row["status"] != "done")
    for (log, label, status, cause), of in groups(ended, "log", "label", "status", "cause").items():
        if status == "absent":
            lines.append(absence(log, cause))
            continue
        row, seeds = of[0], sorted(int(row["seed"]) for row in of if row["seed"] is not None)
        of_seed = f" seed{'s' if len(seeds) > 1 else ''} {spans(seeds)}" if seeds else ""
        when = "" if row["failed_at_s"] is None else f" at {row['failed_at_s']:.1f} s"
        part = "; scored up to there" if ended_at_gap(row) else ""
        kind, place = (label, cause), ""
        if row["traceback"] and kind not in placed:
            placed.add(kind)
            place = f" ({_place(row['traceback'])}; the column `traceback` of runs.sqlite has all)"
        why = shorten(cause or NO_CAUSE, CAUSE_WIDTH)
        lines.append(f"{log} / {label}{of_seed}: {status}{when}: {why}{part}{place}")
    return list(dict.fromkeys(lines))


def _place(traceback: str) -> str:
    """Return the innermost place of a traceback: file, line and function."""
    found = re.findall(r'^  File "(?:.*/)?(.+)", line (\d+), in (.+)$', traceback, re.MULTILINE)
    return "{}, line {}, in {}".format(*found[-1]) if found else "no place is known"


def absence(log: str, cause: str | None) -> str:
    """Return that a log's recording is not here and why, with its name once: a cause may begin with the name."""
    return f"{log}: {(cause or NO_CAUSE).replace(f'not here: {log}: ', 'not here: ', 1)}"


def mostly_outside(rows: Sequence[Record]) -> list[str]:
    """Return a line for each log most of whose readings lie outside the IMU's time."""
    lines = {}
    for row in rows:
        counts = json.loads(row["counts"] or "{}")
        outside, readings = counts.get("readings_outside", 0), counts.get("readings", math.inf)
        if row["status"] == "done" and outside > readings / 2:
            lines[row["log"]] = (
                f"{row['log']}: {outside} of {readings} readings lay outside the log; correct the clock of their stream"
            )
    return list(lines.values())


def waited(summary: Sequence[Record]) -> list[str]:
    """Return a line if steps took longer than the processor worked on them, of where it was most."""
    parted = {
        (row["log"], row["label"]): row["total_s"] / row["cpu_s"]
        for row in summary
        if row["cpu_s"] and row["total_s"] > LONGEST_WAIT * row["cpu_s"]
    }
    if not parted:
        return []
    log, label = max(parted, key=lambda of: parted[of])
    more = f", and {len(parted) - 1} more less" if len(parted) > 1 else ""
    return [
        f"the steps took up to {parted[log, label]:.2g} times their processor time ({log} / {label}{more}): the "
        "machine was busy, or threads waited for one another; compare costs by cpu_s in table.csv, or run again with "
        "fewer --jobs"
    ]


def not_positive(summary: Sequence[Record]) -> list[str]:
    """Return a line for each output whose covariance is somewhere not positive definite."""
    return [
        f"{row['log']} / {row['label']} {row['output']}: {row['n_not_positive']} covariances are not positive definite"
        for row in summary
        if row["n_not_positive"]
    ]
