"""Names and causes that want to hurt whoever reads them: on the terminal, in a page, in LaTeX and in a spreadsheet."""

from __future__ import annotations

import gzip
import json
import re
from base64 import b64decode
from pathlib import Path

import pandas as pd
import pytest
from fathom.bench.experiment.plan import Experiment
from fathom.bench.files import from_csv, write_csv
from fathom.bench.inspection.contents import print_contents
from fathom.bench.output.report.page import render
from fathom.bench.output.tables import terminal
from fathom.bench.output.tables.latex import latex
from fathom.bench.output.tables.table import print_table, write_table
from fathom.bench.results.store import COLUMNS
from fathom.datasets.formats.recording import TopicInfo

HOSTILE = "=cmd|' /C calc'!A0 \x1b[2J\x9b31m\u202egnp\x07\x00"
SHOWN = r"=cmd|' /C calc'!A0 \x1b[2J\x9b31m\u202egnp\x07\x00"


def store() -> pd.DataFrame:
    names = {"experiment": "e", "log": HOSTILE, "label": HOSTILE, "seed": 1, "output": "online", "status": "failed"}
    origin = {
        "cause": HOSTILE,
        "spec": json.dumps({"log": HOSTILE}),
        "notes": json.dumps([{"kind": "about", "text": HOSTILE}]),
        "commit_id": "x",
    }
    row = dict.fromkeys(COLUMNS) | names | origin | {"align": "none", "dims": "3d", "estimator": HOSTILE}
    numbers = [name for name, kind in COLUMNS.items() if kind == "REAL"]
    return pd.DataFrame([row]).astype(dict.fromkeys(numbers, "float64") | {"seed": "Int64"})


def is_plain(text: str) -> bool:
    return all(line.isprintable() for line in text.split("\n"))


def test_a_table_on_the_terminal_shows_codes(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(store())
    printed = capsys.readouterr().out
    assert is_plain(printed)
    assert SHOWN.replace(r"\x07", "") in printed  # rich leaves the bell out


def test_a_page_shows_codes(tmp_path: Path) -> None:
    page = render(store(), tmp_path, [])
    assert is_plain(page[: page.index("<style>")] + page[page.index("</style>") :])
    assert r"\x1b[2J\x9b31m\u202egnp" in page  # in a table
    packed = re.findall(r'<script type="application/gzip"[^>]*>([^<]+)</script>', page)
    texts = [gzip.decompress(b64decode(text)).decode() for text in packed]
    details = [text for text in texts if text.startswith(("{", "["))]  # what is opened by a script, and no script
    assert all(is_plain(text) for text in details)
    assert any(r"\\x1b[2J\\x9b31m\\u202egnp" in text for text in details)


def test_latex_shows_codes() -> None:
    assert is_plain(latex(store()))


def test_no_cell_of_a_csv_file_is_a_formula(tmp_path: Path) -> None:
    write_table(store(), tmp_path / "table.csv")
    assert f"'{SHOWN}" in (tmp_path / "table.csv").read_text(encoding="utf-8")


def test_text_comes_back_from_csv_and_numbers_stay_numbers(tmp_path: Path) -> None:
    texts = ["=1+1", "+A1", "-A1", "@SUM(A1)", "＝1", "'=1", "''-x", "it's", "'quoted'", "a-b", "-1.5", "plain"]
    write_csv(pd.DataFrame({"@name": texts, "value": -1.5}), tmp_path / "a.csv")
    read = pd.read_csv(tmp_path / "a.csv", dtype={"'@name": str})
    assert read["value"].tolist() == [-1.5] * len(texts)
    assert read["'@name"].map(from_csv).tolist() == texts
    assert not [cell for cell in read["'@name"] if cell[0] in "=+-@＝" and cell != "-1.5"]


def test_topics_of_a_recording_show_codes_and_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    print_contents([TopicInfo("/imu[/red]\x1b[2J", "a/Type", 3, 1.0, ("x[bold]",))], terminal.console())
    printed = capsys.readouterr().out
    assert is_plain(printed)
    assert r"/imu[/red]\x1b[2J" in printed
    assert "x[bold]" in printed


def test_names_of_logs_and_estimators_are_plain_before_anything_runs() -> None:
    plan = Experiment.from_dict(
        {
            "name": "e",
            "logs": [{"scenario": {"duration_s": 20}, "name": "l\x1b[2J"}],
            "estimators": [{"name": "eskf", "label": "a\nb"}],
        }
    )
    assert (plan.logs[0].name, plan.estimators[0].label) == (r"l\x1b[2J", r"a\nb")
