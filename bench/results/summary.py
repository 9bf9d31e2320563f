"""Summaries of the store: one record per log, estimator and output, with its seeds pooled."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import count
from statistics import fmean, median
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from ...datasets.epochs import IMU_GAP
from ...estimators.interface import OUTLIERS
from ..metrics.consistency import anees_of, pooled, pooled_nis, pooled_whiteness
from ..metrics.floor_ratio import OVER, rmse_over_floor
from ..metrics.pose_error import pooled_rmse
from ..metrics.scoring import INNOVATIONS, MEAN, MEDIAN, NIS, POOLED, WHITENESS
from ..metrics.state_error import BLOCKS

Record: TypeAlias = dict[str, Any]
"""One row, absent values being None."""


class Records(list[Record]):
    """The rows of a table of runs, which nobody changes once they are made."""

    @cached_property
    def summary(self) -> list[Record]:
        """What `summarise` returns of them: tables, figures and report all need it."""
        return _summarise(self)


Rows: TypeAlias = pd.DataFrame | Sequence[Record]
"""A table of runs, or its `records`."""

SAME = ("estimator", "lookahead_s", "truth_kind", "align", "dims")
SEEDS_ENOUGH = 5
"""With fewer seeds the interval of ANEES is too wide to be useful, so only NIS, if requested, is tabulated."""

COUNTS = {"readings": "readings", "late": "readings_late", "late_dropped": "late", "carried": "carried"}
"""Counts of readings that were late or between keyframes, by their names in a run; summed over seeds."""

UNFINISHED = ("diverged", "failed", "absent")
"""How a run ends that does not finish."""

LONGEST_NAME = 100
"""Letters of a log's name in the name of a file, which has 255 at most, with what it is added to."""
LARGEST = 1e150
"""Of a score in any unit: its square is finite."""


def records(rows: Rows) -> Records:
    """Return the rows of a table of runs as plain Python; those that are already, unchanged."""
    if isinstance(rows, Records):
        return rows
    if not isinstance(rows, pd.DataFrame):
        return Records(rows)
    columns = [column.astype(object).where(column.notna(), None).tolist() for _, column in rows.items()]
    names = [str(name) for name in rows.columns]
    return Records(dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True))


def groups(rows: Iterable[Record], *keys: str) -> dict[tuple[Any, ...], list[Record]]:
    """Return the rows grouped by these keys, in order of first appearance."""
    found: dict[tuple[Any, ...], list[Record]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def outputs(rows: Rows) -> Iterator[tuple[Record, list[Record]]]:
    """Yield log, label, output and look-ahead of each output and how many runs there are, with the output's rows.

    Those of one log and label follow each other. A run that failed may lack an output; it is one of the runs all the
    same.
    """
    for (log, label), of_label in groups(records(rows), "log", "label").items():
        runs = len(groups(of_label, "seed"))
        for (output,), of in groups(of_label, "output").items():
            ahead = next((row["lookahead_s"] for row in of if row["lookahead_s"] is not None), None)
            yield {"log": log, "label": label, "output": output, "lookahead_s": ahead, "runs": runs}, of


def last_words(found: Sequence[Record]) -> list[Record]:
    """Return the records without what a smoother over the whole log says during the log.

    That is a filter's estimate, or a first guess.
    """
    whole = {(row["log"], row["label"]) for row in found if row["lookahead_s"] == math.inf}
    return [row for row in found if (row["log"], row["label"]) not in whole or row["lookahead_s"] == math.inf]


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Return for each name one that files and LaTeX labels can have; no two differ only in capitals."""
    found: dict[str, str] = {}
    for name in dict.fromkeys(names):
        stem = re.sub(r"[^A-Za-z0-9.=+-]+", "_", name)[:LONGEST_NAME]
        taken = {other.lower() for other in found.values()}
        numbered = (stem if k == 1 else f"{stem}-{k}" for k in count(1))
        found[name] = next(one for one in numbered if one.lower() not in taken)
    return found


def summarise(rows: Rows) -> list[Record]:
    """Return one record per log, estimator and output, over the seeds that finished; if none did, over those that ended
    at a gap of the IMU, each up to its gap.

    Squared errors are pooled before the root, NIS over all readings. Percentages, CEP50, NEES and coverage are means;
    costs are medians. `done` of `runs` are pooled; `diverged`, `failed` and `absent` count the rest; where there is
    nothing to pool, the numbers are None. `anees_*` is the mean over the fixed times of `consistency`, per degree of
    freedom, with the number of those times at which it lies above and below its interval. `start` lists where the
    priors came from, `missing` says by a score's name why it is None.
    """
    return records(rows).summary


def _summarise(every: Records) -> list[Record]:
    ends = {
        key: [run[0]["status"] for run in groups(of, "seed").values()]
        for key, of in groups(every, "log", "label").items()
    }
    counts_of = {text: json.loads(text) for text in {row["counts"] or "{}" for row in every}}
    names = {name for counts in counts_of.values() for name in counts if name.startswith(OUTLIERS)}
    counted = COUNTS | {name: name for name in sorted(names)}
    summary = []
    for (log, label, output), group in groups(every, "log", "label", "output").items():
        done = [row for row in group if row["status"] == "done"]
        scored = done or [row for row in group if ended_at_gap(row)]
        record: Record = {"log": log, "label": label, "output": output}
        record |= {name: next((row[name] for row in group if row[name] is not None), None) for name in SAME}
        starts = dict.fromkeys(row["start"] for row in group if row.get("start") is not None)
        record |= {"start": " | ".join(starts) or None}
        record |= _stated(group)
        record |= {"runs": len(ends[log, label]), "done": len(done)}
        record |= {status: ends[log, label].count(status) for status in UNFINISHED}
        record |= {n: sum(row[n] or 0 for row in scored) for n in ("n_scored", "n_rpe")}
        record |= {name: _pooled(scored, name, n) for name, n in POOLED.items()}
        record |= {name: _over_seeds(fmean, scored, name) for name in MEAN}
        record |= {name: _over_seeds(median, scored, name) for name in MEDIAN}
        record |= _over_floor(scored)
        record |= _consistency(scored)
        counts = [counts_of[row["counts"] or "{}"] for row in scored]
        record |= {name: sum(run.get(of, 0) for run in counts) for name, of in counted.items()}
        record["missing"] = {name: why for name, why in _missing(scored).items() if record.get(name) is None}
        summary.append(record)
    return summary


def ended_at_gap(row: Record) -> bool:
    """Return whether a run ended at a gap of the IMU: its scores are right, of the part before it."""
    return row["status"] == "failed" and (row.get("cause") or "").startswith(IMU_GAP)


def _stated(group: Sequence[Record]) -> Record:
    """Return what the experiment states of RPE and outputs, from a group's spec; None where that is not known."""
    scores = scores_of(group)
    return {name: scores.get(name) for name in ("rpe_delta", "rpe_unit", "rpe_pairs", "output_rate_hz")}


def scores_of(group: Sequence[Record]) -> dict[str, Any]:
    """Return how the rows of a group are scored (see `Scoring`), by the spec of the last; empty where it has none."""
    return json.loads(group[-1]["spec"] or "{}").get("scores", {})


def _missing(done: Sequence[Record]) -> dict[str, str]:
    """Return why scores are missing, by their name: the first reason that a run gives."""
    found: dict[str, str] = {}
    for row in done:
        found = why_missing(row) | found
    return found


def why_missing(row: Record) -> dict[str, str]:
    """Return by the name of each missing score why, from a row of a run."""
    return {name: why for why, names in _reasons(row.get("missing") or "{}").items() for name in names}


@lru_cache(maxsize=256)
def _reasons(text: str) -> dict[str, list[str]]:
    """Return the JSON of a row; the runs of a log mostly have the same."""
    return json.loads(text)


def _pooled(done: Sequence[Record], name: str, n: str) -> float | None:
    known = [row for row in done if row[name] is not None and row[n]]
    with np.errstate(over="ignore"):  # the square of a run that got lost beyond all bounds
        return pooled_rmse([row[name] for row in known], [row[n] for row in known]) if known else None


def has_score(row: Record, name: str) -> bool:
    """Return whether a row has a score that can be pooled: finite, as its square is, and with a weight."""
    value = row[name]
    return value is not None and abs(value) < LARGEST and (name not in POOLED or bool(row[POOLED[name]]))


def _over_seeds(statistic: Callable[[list[float]], float], done: Sequence[Record], name: str) -> float | None:
    known = [row[name] for row in done if row[name] is not None]
    return statistic(known) if known else None


def _over_floor(done: Sequence[Record]) -> Record:
    """Return each RMSE over its floor, with its 95 % interval over seeds."""
    record: Record = {}
    for block, (score, floor) in OVER.items():
        known = [row for row in done if row[score] is not None and row[floor]]  # without a floor there is no ratio
        if not all(has_score(row, name) for row in known for name in (score, floor)):
            known = []
        squared_error, bound = (np.array([row[name] ** 2 for row in known]) for name in (score, floor))
        ratio = rmse_over_floor(squared_error, bound) if known else None
        for part, name in {"": "ratio", "_low": "low", "_high": "high"}.items():
            record[f"over_floor_{block}{part}"] = None if ratio is None else getattr(ratio, name)
    return record


def _consistency(done: Sequence[Record]) -> Record:
    """Return NIS, log density and whiteness by sensor, and ANEES by block with its verdicts."""
    record: Record = dict.fromkeys([*INNOVATIONS, *(f"{name}_outside" for name in WHITENESS)])
    for score in ("nis", "log_density", "whiteness"):
        record |= {f"{score}_{sensor}": value for sensor, (value, *_) in pooled(done, score).items()}
    for sensor, average in pooled_whiteness(done).items():
        record[f"whiteness_{sensor}_outside"] = bool(average.above[0] or average.below[0])
    found = anees_of([row["nees_at"] for row in done])
    for block in BLOCKS:
        average = found.get(block)
        record[f"anees_{block}"] = None if average is None else float(average.value.mean())
        record[f"anees_{block}_above"] = None if average is None else int(average.above.sum())
        record[f"anees_{block}_below"] = None if average is None else int(average.below.sum())
    record["anees_times"] = max((len(average) for average in found.values()), default=None)
    record["n_not_positive"] = sum(int(row["n_not_positive"] or 0) for row in done)
    return record


CONSISTENCY = ("log", "label", "output", "score", "t_s", "seeds", "dof", "per_dof", "low", "high", "verdict")


def consistency(rows: Rows) -> list[Record]:
    """Return one record per ANEES (log, estimator, output, block, time) and per pooled NIS, with its interval."""
    table = []
    for (log, label, output), group in groups(records(rows), "log", "label", "output").items():
        done = [row for row in group if row["status"] == "done"]
        named = {f"nees_{block}": average for block, average in anees_of([row["nees_at"] for row in done]).items()}
        named |= {f"nis_{sensor}": average for sensor, average in pooled_nis(done).items()}
        named |= {f"whiteness_{sensor}": average for sensor, average in pooled_whiteness(done).items()}
        for name, average in named.items():
            for k in range(len(average)):
                verdict = "above" if average.above[k] else "below" if average.below[k] else "inside"
                each = {"t_s": average.t_s[k], "seeds": average.runs[k], "dof": average.dof[k]}
                each |= {"per_dof": average.value[k], "low": average.low[k], "high": average.high[k]}
                table.append(
                    {"log": log, "label": label, "output": output, "score": name} | each | {"verdict": verdict}
                )
    return table


def is_judged(summary: Sequence[Record]) -> bool:
    """Return whether a table of consistency is worth showing: there is NIS, or ANEES over enough seeds."""
    enough = [row["done"] >= SEEDS_ENOUGH and row["anees_times"] is not None for row in summary]
    return any(enough) or any(row[name] is not None for row in summary for name in NIS)
