"""From when on an attitude stays right, which share of the runs gets there, and how good these are."""

from __future__ import annotations

import json
import math
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fathom.bench.drawing import looks_of
from fathom.bench.metrics.association import ScoreError
from fathom.bench.metrics.convergence import STAYS_S, converged_s
from fathom.bench.metrics.scoring import Scoring, scored
from fathom.bench.output.figures.convergence import draw_convergence
from fathom.bench.output.tables.table import print_over_logs, write_over_logs
from fathom.bench.results.convergence import convergence
from fathom.bench.results.summary import Record
from fathom.datasets.simulated.scenario import Scenario
from fathom.datasets.simulated.simulator import simulate
from fathom.datasets.trajectory import Trajectory
from rich.console import Console
from scipy.spatial.transform import Rotation

N = 61
AGE_S = np.arange(N)
AXIS = np.array([0.6, 0.0, 0.8])


def track(error_deg: np.ndarray) -> Trajectory:
    """One pose a second, off by these angles about a slanting axis from a vehicle that is turned itself."""
    R_WB = Rotation.from_rotvec(np.radians(error_deg)[:, None] * AXIS) * Rotation.from_euler("ZX", [0.9, 0.3])
    return Trajectory(7 + AGE_S * 1_000_000_000, R_WB.as_matrix(), np.zeros((N, 3)))


TRUTH = track(np.zeros(N))
DECAY = 170 * np.exp(-AGE_S / 5.0)
"""Below 3 from 5 ln(170 / 3) = 20.2 s on."""


def test_an_error_that_decays_has_converged_where_it_falls_below_the_limit() -> None:
    assert converged_s(TRUTH, track(DECAY), 3.0) == pytest.approx(21)
    assert converged_s(TRUTH, track(DECAY), 30.0) == pytest.approx(9)  # 5 ln(170 / 30) = 8.7
    assert converged_s(TRUTH, track(np.full(N, 2.9)), 3.0) == 0.0


@pytest.mark.parametrize(
    "error_deg",
    [
        pytest.param(np.full(N, 3.1), id="never"),
        pytest.param(np.where(AGE_S == N - 1, 4.0, 0.1), id="lost in the end"),
        pytest.param(np.where(AGE_S > N - 1 - STAYS_S, 0.1, 4.0), id="not for long enough"),
        pytest.param(np.where(AGE_S < 40, 0.1, 179.9), id="turned over"),
    ],
)
def test_an_error_that_does_not_stay_below_the_limit_has_not_converged(error_deg: np.ndarray) -> None:
    with pytest.raises(ScoreError, match="does not stay below 3° for the last 10 s"):
        converged_s(TRUTH, track(error_deg), 3.0)


def test_an_error_that_comes_back_has_converged_when_it_left_for_the_last_time() -> None:
    assert converged_s(TRUTH, track(np.where((AGE_S == 30) | (AGE_S < 5), 5.0, 0.1)), 3.0) == pytest.approx(31)
    assert converged_s(TRUTH, track(np.where(AGE_S >= N - 1 - STAYS_S, 0.1, 4.0)), 3.0) == pytest.approx(
        N - 1 - STAYS_S
    )


def test_convergence_is_scored_where_its_limit_is_stated() -> None:
    log = simulate(Scenario(duration_s=20), 1)
    assert log.truth is not None
    asked, _ = scored(log, log.truth, Scoring(converged_deg=3.0, segment_lengths_m=(5.0,)))
    assert asked["converged_s"] == 0.0
    plain, missing = scored(log, log.truth, Scoring(segment_lengths_m=(5.0,)))
    assert plain["converged_s"] is None
    assert missing["converged_s"].startswith("not asked for: `converged_deg`")


SPEC = json.dumps({"scores": {"converged_deg": 3.0}})


def row(log: str, seed: int, at_s: float | None, ate_m: float = 1.0, nees: float = 3.0, **others: object) -> Record:
    """What `convergence` and `honesty` read of a row of the store."""
    nees_at = json.dumps({"t_s": [5.0, 15.0], "attitude": [nees, nees], "all": [15.0, 15.0]})
    found = {"log": log, "label": "eskf", "seed": seed, "output": "online", "status": "done", "lookahead_s": 0.0}
    scores = {"converged_s": at_s, "ate_rmse_m": ate_m, "n_scored": 10, "nees_at": nees_at}
    return found | {"spec": SPEC} | scores | others


@pytest.fixture(scope="module")
def rows() -> list[Record]:
    """Of four seeds two converge on the second log; one gets lost, and one fails. `rts` gets lost always."""
    rows = [row("wrong by 0°", seed, 0.0) for seed in range(4)]
    rows += [row("wrong by 90°", 0, 10.0, 3.0), row("wrong by 90°", 1, 20.0, 4.0, 9.0)]
    rows += [row("wrong by 90°", 2, None, 1e3, 1e5)]
    rows += [row("wrong by 90°", 3, None, status="failed", nees_at=None, ate_rmse_m=None, lookahead_s=None)]
    smooth = {"label": "rts", "output": "smoothed", "lookahead_s": math.inf}
    rows += [row("wrong by 90°", seed, 0.0, label="rts") for seed in range(4)]
    return rows + [row("wrong by 90°", seed, None, **smooth) for seed in range(3)]  # one ended before it smoothed


def test_of_the_runs_that_converge_the_scores_are_pooled(rows: list[Record]) -> None:
    at_once, some, none = convergence(rows)
    assert [at_once[name] for name in ("runs", "converged", "share", "median_s")] == [4, 4, 1.0, 0.0]
    assert [some[name] for name in ("runs", "converged", "share", "median_s")] == [4, 2, 0.5, 15.0]
    assert some["ate_rmse_m"] == pytest.approx(math.sqrt((9 + 16) / 2))
    assert some["anees_attitude"] == pytest.approx((3 + 9) / 2 / 3)
    assert some["anees_all"] == pytest.approx(1.0)
    assert [none[name] for name in ("label", "output", "converged", "median_s")] == ["rts", "smoothed", 0, None]
    assert none["runs"] == 4


def test_the_share_is_of_all_runs_those_without_this_output_too(rows: list[Record]) -> None:
    found = [each | ({"converged_s": 0.0} if each["seed"] == 0 else {}) for each in rows]
    assert convergence(found)[-1]["share"] == 1 / 4


def test_the_interval_of_the_share_is_wilsons(rows: list[Record]) -> None:
    """Closed form at a share of 1: from n / (n + z²) to 1; at a half it is symmetric."""
    at_once, some, _ = convergence(rows)
    assert at_once["low"] == pytest.approx(4 / (4 + 1.959964**2))
    assert at_once["high"] == pytest.approx(1.0)
    assert some["low"] + some["high"] == pytest.approx(1.0)


def test_runs_that_were_not_asked_have_no_convergence(rows: list[Record]) -> None:
    assert not convergence([each | {"spec": json.dumps({"scores": {"converged_deg": None}})} for each in rows])


def test_table_and_file_hold_the_shares(rows: list[Record], tmp_path: Path) -> None:
    console = Console(file=StringIO(), width=80)
    print_over_logs([], convergence(rows), console)
    lines = console.file.getvalue().splitlines()  # pyright: ignore
    assert "  eskf" in next(line for line in lines if "2/4 [15 %, 85 %]" in line)
    assert any("  rts, all" in line and "0/4" in line and line.count("–") == 4 for line in lines)
    write_over_logs([], convergence(rows), tmp_path)
    table = pd.read_csv(tmp_path / "convergence.csv")
    assert table["converged"].tolist() == [4, 2, 0]
    assert table["regime"].tolist() == ["wrong by 0°", "wrong by 90°", "wrong by 90°"]


def test_the_figure_draws_share_accuracy_and_honesty_against_the_angle(rows: list[Record]) -> None:
    figure = draw_convergence(convergence(rows), looks_of(["eskf", "rts"]))
    share, ate, anees = figure.axes
    assert [text.get_text() for text in share.get_xticklabels()] == ["0°", "90°"]
    assert share.get_xlabel() == "wrong by"
    assert [line.get_ydata().tolist() for line in share.lines[:2]] == [[1.0, 0.5], [0.0]]
    assert ate.lines[0].get_ydata() == pytest.approx([1.0, math.sqrt(12.5)])
    assert math.isnan(anees.lines[1].get_ydata()[0])
