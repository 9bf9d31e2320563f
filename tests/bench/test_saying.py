"""Lines on standard error are folded between words on a terminal, and whole elsewhere."""

from __future__ import annotations

import sys

import pytest
from fathom.bench.saying import folded, say

LINE = "  → log.yaml: gps: {time: received, note: a line that is longer than a terminal of forty columns}"


@pytest.mark.parametrize("terminal", [True, False])
def test_a_line_is_folded_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], terminal: bool
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    say(f"{LINE}\x1b")
    told = capsys.readouterr().err.splitlines()
    assert (len(told) > 1, max(map(len, told)) <= 40) == (terminal, terminal)
    assert " ".join(" ".join(told).split()) == " ".join(LINE.split()) + r"\x1b"


def test_lines_after_the_first_stand_farther_in_and_a_path_stays_whole() -> None:
    first, *others = folded(LINE, 40).splitlines()
    assert first.startswith("  → ")
    assert all(line.startswith("    ") and line[4] != " " for line in others)
    path = "results/" + 10 * "a-long-name/"
    assert path in folded(f"{path}report.html: tables, for a browser", 40)
    assert folded("a b", 0) == "a b"
