"""Work per step is what it was: slots, relinearisations, callbacks, calls and allocations, which no machine changes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fathom.bench.output.tables.table import print_sheet
from fathom.bench.results.identity import versions
from fathom.bench.timing.counters import COUNTED, COUNTERS, count, counters_sheet
from rich.console import Console

BASELINE = Path(__file__).parent / "counters.json"
DECIDES = ("numpy", "numba", "gtsam")


@pytest.mark.parametrize("name", COUNTED)
def test_no_step_does_more_or_less_than_the_baseline(name: str) -> None:
    """Where that is meant: `fathom timing counters -o tests/bench/timing/counters.json`, and the commit says why."""
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    here, there = versions(), baseline["versions"]
    differ = [package for package in DECIDES if here[package] != there[package]]
    if here["python"].rpartition(".")[0] != there["python"].rpartition(".")[0]:
        differ.append("python")
    if differ:
        pytest.skip(f"the baseline was counted with another {', '.join(differ)}")
    assert count(name) == pytest.approx(baseline["counters"][name], rel=0.02)


@pytest.mark.slow
def test_a_factor_that_is_called_more_often_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """iSAM2 with its thresholds at zero linearises everything anew in every step."""
    usual = json.loads(BASELINE.read_text(encoding="utf-8"))["counters"]["fls, lag 3 s"]
    monkeypatch.setitem(COUNTED, "fls, lag 3 s", ("fls", {"lag_s": 3.0, "relinearize": [0.0] * 4}))
    zealous = count("fls, lag 3 s")
    assert zealous["callbacks"] > 2 * usual["callbacks"]
    assert zealous["relinearised"] > 2 * usual["relinearised"]


def test_the_table_has_every_count_in_80_columns() -> None:
    console = Console(width=80, record=True)
    found = {name: dict.fromkeys(COUNTERS, 1234.5) for name in COUNTED}
    print_sheet(counters_sheet(found), console)
    text = console.export_text()
    assert "…" not in text
    table = text.partition("\nkeyframes:")[0]
    assert all(key in table for key in COUNTERS)
    assert all(name in table for name in COUNTED)
    assert table.count("1,234") + table.count("1,235") == len(COUNTERS) * len(COUNTED)
