"""Every score that is missing has its reason, and no score is missing for another's reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fathom.bench.metrics.scoring import ALIGNED, ANYWAY, SCORES, Scoring, by_reason, scored
from fathom.datasets import Scenario, simulate
from fathom.datasets.log import Log
from fathom.datasets.trajectory import Trajectory

LOG = simulate(Scenario(duration_s=30.0), seed=1)
assert LOG.truth is not None
TRUTH = LOG.truth.select(slice(0, None, 100))
"""Once a second."""


def log_with(**changes: object) -> Log:
    return replace(LOG, truth=replace(TRUTH, **changes))


MOORED = log_with(p_WB_W=np.zeros_like(TRUTH.p_WB_W))
NO_ATTITUDE = log_with(R_WB=np.full_like(TRUTH.R_WB, np.nan), v_WB_W=None, b_a=None, b_g=None)
LATE = log_with(t_ns=TRUTH.t_ns + 5)
LOST = replace(TRUTH, p_WB_W=TRUTH.p_WB_W * np.nan)
NO_P = replace(TRUTH, P=None)


@pytest.mark.parametrize(
    ("log", "estimate", "scoring", "name", "why"),
    [
        (replace(LOG, truth=None), TRUTH, Scoring(), "ate_rmse_m", "no ground truth"),
        (LATE, TRUTH, Scoring(), "ate_rmse_m", "association: no truth within 0 ns of any estimate"),
        (log_with(), LOST, Scoring(), "ate_rmse_m", "it diverged"),
        (log_with(), LOST, Scoring(), "drift_end_percent", "it diverged"),
        (log_with(), NO_P, Scoring(), "nees_position", "the estimate has no covariances"),
        (log_with(), NO_P, Scoring(align="yaw"), "nees_position", "only against ground truth, unaligned"),
        (
            replace(log_with(), truth_kind="reference"),
            TRUTH,
            Scoring(),
            "within_1sigma_all",
            "only against ground truth",
        ),
        (NO_ATTITUDE, TRUTH, Scoring(), "heading_rmse_deg", "no attitude in the ground truth"),
        (NO_ATTITUDE, TRUTH, Scoring(), "velocity_rmse_m_s", "no velocity in the ground truth"),
        (NO_ATTITUDE, TRUTH, Scoring(), "rpe_rmse_m", "needs the attitude"),
        (log_with(), NO_P, Scoring(segment_lengths_m=(1e4,)), "segment_percent", "shorter than every sub-trajectory"),
        (log_with(), NO_P, Scoring(), "outage_percent", "never silent"),
        (MOORED, TRUTH, Scoring(), "drift_end_percent", "the ground truth does not move"),
        (MOORED, TRUTH, Scoring(align="yaw"), "ate_rmse_m", "determine no yaw"),
        (MOORED, TRUTH, Scoring(align="se3"), "velocity_rmse_m_s", "determine no rotation"),
    ],
)
def test_a_missing_score_has_its_reason(log: Log, estimate: Trajectory, scoring: Scoring, name: str, why: str) -> None:
    values, missing = scored(log, estimate, scoring)
    assert why in missing[name]
    assert set(values) == set(SCORES)
    assert {name for name, value in values.items() if value is None} == set(missing)
    assert sorted(name for names in by_reason(missing).values() for name in names) == sorted(missing)


def test_what_needs_no_alignment_is_scored_where_none_is_determined() -> None:
    turned = replace(TRUTH, R_WB=TRUTH.R_WB @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    values, missing = scored(MOORED, turned, Scoring(align="yaw", rpe_unit="s", rpe_delta=1.0))
    assert missing["ate_rmse_m"].endswith("the heading is scored unaligned")
    assert values["heading_rmse_deg"] == pytest.approx(90.0, abs=1.0)
    assert values["gyro_bias_rmse_rad_s"] == 0.0
    assert values["rpe_rmse_m"] is not None
    assert values["ate_rmse_m"] is None


def test_the_names_of_the_parts_are_scores() -> None:
    names = [name for part in (ALIGNED | ANYWAY).values() for name in part]
    judged = [name for name in SCORES if name.startswith(("nees_", "within_", "inside_", "energy_", "n_not_positive"))]
    assert sorted([*names, *judged, "n_scored"]) == sorted(SCORES)


@pytest.mark.parametrize("part", [*ALIGNED, *ANYWAY])
def test_a_part_gives_the_scores_that_it_is_listed_with(part: Callable[..., dict[str, object]]) -> None:
    log = log_with()
    names = (ALIGNED | ANYWAY)[part]
    scoring = Scoring(segment_lengths_m=(5.0,), rpe_delta=1.0, rpe_unit="s")
    mute = replace(log, gps=None)
    assert set(part(mute, log.truth, TRUTH, scoring)) == set(names)
