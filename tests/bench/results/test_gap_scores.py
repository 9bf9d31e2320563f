"""A run that ends at a gap of the IMU is failed, and its scores are of the part before."""

from __future__ import annotations

from typing import Any

import pandas as pd
from fathom.bench.output.remarks import failures
from fathom.bench.results.store import COLUMNS
from fathom.bench.results.summary import records, summarise


def row(seed: int, status: str, ate_m: float, cause: str | None = None) -> dict[str, Any]:
    return {
        "experiment": "e", "log": "l", "label": "eskf", "output": "online", "seed": seed, "status": status,
        "cause": cause, "ate_rmse_m": ate_m, "n_scored": 10, "failed_at_s": 10.0 if cause else None,
    }  # fmt: skip


def table(*rows: dict[str, Any]) -> pd.DataFrame:
    return pd.DataFrame(rows).reindex(columns=list(COLUMNS))


GAP = "imu gap at 10.000 s: 3.000 s without a sample"


def test_where_no_run_finished_those_up_to_a_gap_are_scored() -> None:
    (summary,) = summarise(table(row(1, "failed", 3.0, GAP), row(2, "failed", 4.0, "out of time")))
    assert (summary["ate_rmse_m"], summary["done"], summary["failed"]) == (3.0, 0, 2)


def test_beside_finished_runs_they_do_not_count() -> None:
    (summary,) = summarise(table(row(1, "failed", 3.0, GAP), row(2, "done", 1.0)))
    assert (summary["ate_rmse_m"], summary["done"]) == (1.0, 1)


def test_seeds_that_ended_alike_share_a_line() -> None:
    refused = [row(seed, "failed", 3.0, "the heading is unknown") for seed in range(1, 51)]
    alike, other = failures(records(table(*refused, row(51, "failed", 4.0, "out of time"), row(52, "done", 1.0))))
    assert "seeds 1–50: failed" in alike
    assert alike.endswith("the heading is unknown")
    assert "seed 51: failed" in other


def test_the_remark_says_that_the_score_is_of_a_part() -> None:
    gap, late = failures(records(table(row(1, "failed", 3.0, GAP), row(2, "failed", 4.0, "out of time"))))
    assert gap.endswith(f"{GAP}; scored up to there")
    assert not late.endswith("there")
