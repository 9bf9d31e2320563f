"""ANEES of all logs in one table and one figure: the mean over times, the 99 % band, and who leaves it."""

from __future__ import annotations

import json
import math
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fathom.bench.drawing import looks_of
from fathom.bench.metrics.state_error import BLOCKS, DOF
from fathom.bench.output.figures.honesty import LEAST, MOST, draw_honesty
from fathom.bench.output.tables.table import print_over_logs, write_over_logs
from fathom.bench.results.honesty import FALSE_ALARM, compared, honesty
from fathom.bench.results.summary import Record
from rich.console import Console
from scipy.stats import chi2

TIMES, SEEDS = 10, 50
T_S = [3.0 + 6.0 * k for k in range(TIMES)]


def row(log: str, label: str, seed: int, nees: dict[str, list[float]] | None, **others: object) -> Record:
    """What `honesty` reads of a row of the store."""
    nees_at = json.dumps({"t_s": T_S} | nees) if nees else "{}"
    found = {"log": log, "label": label, "seed": seed, "output": "online", "status": "done", "lookahead_s": 0.0}
    return found | {"nees_at": nees_at} | others


def drawn(rng: np.random.Generator, factor: float = 1.0) -> dict[str, list[float]]:
    """NEES of one seed whose errors are `factor` of what the covariance says, squared."""
    return {block: (factor * rng.chisquare(DOF[block], TIMES)).tolist() for block in BLOCKS}


def runs(log: str, label: str, factor: float = 1.0, seeds: int = SEEDS, **others: object) -> list[Record]:
    rng = np.random.default_rng([ord(letter) for letter in log + label])
    return [row(log, label, seed, drawn(rng, factor), **others) for seed in range(seeds)]


@pytest.fixture(scope="module")
def found() -> list[Record]:
    """Two logs; on the second one estimator overclaims, one is too modest, and one never finished."""
    rows = [*runs("easy", "eskf"), *runs("hard", "eskf", 3.0), *runs("hard", "shy", 0.4)]
    rows += [row("hard", "lost", seed, None, status="failed", lookahead_s=None) for seed in range(SEEDS)]
    smooth = {"output": "smoothed", "lookahead_s": math.inf}
    return honesty([*rows, *runs("hard", "rts", 3.0), *runs("hard", "rts", **smooth)])


def of(found: list[Record], log: str, label: str, block: str = "all", output: str = "online") -> Record:
    keys = {"log": log, "label": label, "block": block, "output": output}
    (one,) = [each for each in found if keys.items() <= each.items()]
    return one


@pytest.mark.parametrize("block", BLOCKS)
def test_the_band_is_chi_squares_with_the_false_alarm_shared_by_the_times(found: list[Record], block: str) -> None:
    k = SEEDS * DOF[block]
    honest, over, shy = (of(found, *whose, block) for whose in (("easy", "eskf"), ("hard", "eskf"), ("hard", "shy")))
    assert (honest["low"], honest["high"]) == pytest.approx(
        [chi2.ppf(q, k) / k for q in (FALSE_ALARM / TIMES / 2, 1 - FALSE_ALARM / TIMES / 2)]
    )
    assert (honest["above"], honest["below"], honest["times"]) == (0, 0, TIMES)
    assert honest["anees"] == pytest.approx(1.0, abs=4 * math.sqrt(2 / (k * TIMES)))
    assert over["anees"] == pytest.approx(3.0, rel=0.2)
    assert (over["above"], over["below"]) == (TIMES, 0)
    assert (shy["above"], shy["below"]) == (0, TIMES)


def test_one_consistent_estimator_in_a_hundred_leaves_its_band() -> None:
    rng = np.random.default_rng(5)
    logs = 600
    rows = [
        row(f"{k}", "eskf", seed, {"all": rng.chisquare(15, TIMES).tolist()}) for k in range(logs) for seed in (1, 2)
    ]
    left = sum(bool(each["above"] or each["below"]) for each in honesty(rows) if each["block"] == "all")
    assert left <= 18  # of 600 at 1 %, more with probability 3e-5
    assert left >= 1


def test_who_did_not_finish_has_a_line_and_no_number(found: list[Record], tmp_path: Path) -> None:
    lost = of(found, "hard", "lost")
    assert (lost["anees"], lost["seeds"], lost["runs"]) == (None, 0, SEEDS)
    write_over_logs(found, [], tmp_path)
    table = pd.read_csv(tmp_path / "honesty.csv")
    assert list(table)[:5] == ["regime", "estimator", "output", "lookahead_s", "block"]
    assert len(table) == len(found)
    assert table.loc[table["estimator"] == "lost", "above"].isna().all()
    text = (tmp_path / "honesty.csv").read_text()
    assert f",0,0,{TIMES},{SEEDS},{SEEDS}\n" in text  # counts without decimals


def test_of_a_whole_log_smoother_only_what_it_says_in_the_end_is_compared(found: list[Record]) -> None:
    shown = compared(found)
    assert {row["output"] for row in shown if row["label"] == "rts"} == {"smoothed"}
    assert {row["output"] for row in found if row["label"] == "rts"} == {"online", "smoothed"}


def test_one_log_or_few_seeds_have_no_table_over_logs(found: list[Record]) -> None:
    assert compared(found)
    assert not compared([row for row in found if row["log"] == "hard"])
    assert not compared(honesty([*runs("easy", "eskf", seeds=4), *runs("hard", "eskf", seeds=4)]))


def printed(found: list[Record], width: int = 80) -> str:
    console = Console(file=StringIO(), width=width)
    print_over_logs(found, [], console)
    return console.file.getvalue()  # pyright: ignore


def test_the_table_has_a_group_of_lines_for_each_log(found: list[Record]) -> None:
    lines = [line.rstrip() for line in printed(found).splitlines()]
    assert max(map(len, lines)) <= 80
    assert not any("continued" in line for line in lines)
    assert lines.index("easy") < lines.index("hard")
    names = [line.split("  ")[1] for line in lines if line.startswith("  ")]
    assert names == ["eskf", "eskf", "shy", f"lost 0/{SEEDS}", "rts, all"]
    over = next(line for line in lines[lines.index("hard") :] if line.startswith("  eskf"))
    assert over.count(f"▲{TIMES}") == len(BLOCKS)
    low, high = (of(found, "easy", "eskf")[end] for end in ("low", "high"))
    assert f"[{low:.3f}, {high:.2f}] of 15 states" in " ".join(lines)
    assert printed([row for row in found if row["log"] == "easy"]) == ""


def test_the_figure_has_a_point_for_each_number_and_a_cross_for_none(found: list[Record]) -> None:
    shown = compared(found)
    figure = draw_honesty(shown, looks_of(["eskf", "shy", "lost", "rts"]))
    panels = dict(zip(BLOCKS, figure.axes, strict=True))
    for block, axes in panels.items():
        points = [line for line in axes.lines if line.get_linestyle() == "None"]
        expected = [row["anees"] for row in shown if row["block"] == block]
        assert [line.get_xdata()[0] for line in points] == [MOST if value is None else value for value in expected]
        assert [line.get_marker() == "x" for line in points] == [value is None for value in expected]
        (band,) = [patch for patch in axes.patches if patch.get_width() < MOST - LEAST]
        assert band.get_x() == pytest.approx(of(found, "easy", "eskf", block)["low"])
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["easy", "hard"]


def test_the_figure_marks_what_is_beyond_its_edge() -> None:
    found = compared(honesty([*runs("easy", "eskf"), *runs("hard", "eskf", 1000.0)]))
    axes = draw_honesty(found, looks_of(["eskf"])).axes[0]
    assert [line.get_marker() for line in axes.lines if line.get_linestyle() == "None"] == ["o", ">"]
