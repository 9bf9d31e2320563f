from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fathom.bench.output.cells import ACCURACY as COLUMNS
from fathom.bench.output.tables.latex import latex, number, write_latex
from fathom.bench.output.tables.latex_text import ACCENTS, ESCAPED, GREEK, escape
from fathom.bench.output.tables.table import write_table
from fathom.bench.results.store import COLUMNS as STORED
from hypothesis import given
from hypothesis import strategies as st

OUTPUTS = {"dr": ["online"], "eskf": ["online"], "fls": ["online", "smoothed"], "rts": ["online", "smoothed"]}
LOOKAHEAD_S = {"online": 0.0, "fls": 3.0, "rts": np.inf}


def table(seeds: int = 6, **other: Any) -> pd.DataFrame:
    """Rows of an experiment as the store has them, with made-up scores."""
    rng = np.random.default_rng(5)
    rows = []
    for seed in range(1, seeds + 1):
        for label, outputs in OUTPUTS.items():
            cost = {"step_median_us": rng.uniform(5, 900), "step_p99_us": rng.uniform(900, 90_000)}
            for output in outputs:
                row: dict[str, Any] = {"experiment": "e", "log": "survey", "label": label, "seed": seed}
                row |= {"output": output, "status": "done", "truth_kind": "truth", "align": "none", "dims": "3d"}
                row |= {"lookahead_s": LOOKAHEAD_S[output if output == "online" else label]}
                row |= {"ate_rmse_m": rng.lognormal(0, 1), "heading_rmse_deg": rng.lognormal(-3, 1), "n_scored": 60.0}
                row |= {"rpe_rmse_m": rng.lognormal(-9, 1), "n_rpe": 50.0, "drift_end_percent": rng.lognormal(-1, 2)}
                row |= {"nees_position": None if label == "dr" else rng.uniform(1, 9)}
                row |= cost | {"real_time_factor": rng.uniform(1, 9000)}
                row |= {"spec": json.dumps({"scores": {"rpe_delta": 10.0, "rpe_unit": "m", "rpe_pairs": "all"}})}
                row |= {"machine": json.dumps({"cpu": "Some Processor", "cores": 2})}
                rows.append(row | other)
    numbers = [name for name, kind in STORED.items() if kind == "REAL"]
    frame = pd.DataFrame(rows).reindex(columns=list(STORED))
    return frame.astype(dict.fromkeys(numbers, "float64") | {"seed": "Int64"}).astype({"nees_at": object})


NUMBER = re.compile(
    r"^(?P<bold>\\mathbf\{)?(?P<value>-?[\d.{},]+?)(?(bold)\})"
    r"(?:_\{(?P<low>[-+][\d.{},]+)\}\^\{(?P<high>[-+][\d.{},]+)\})?(?: \\times 10\^\{(?P<power>-?\d+)\})?$"
)


def parse(cell: str) -> dict[str, Any]:
    """Return a cell's value, the ends of its interval, its last figure's worth, and whether it is bold."""
    if cell == "--":
        return {"value": None, "bold": False, "low": None, "high": None}
    found = NUMBER.match(cell.strip("$"))
    assert found, cell
    scale = 10.0 ** int(found["power"] or 0)
    plain = {name: found[name] and found[name].replace("{,}", "") for name in ("value", "low", "high")}
    read = {name: None if text is None else float(text) * scale for name, text in plain.items()}
    decimals = len(plain["value"].partition(".")[2])
    return read | {"bold": found["bold"] is not None, "unit": scale * 10.0**-decimals}


def blocks(text: str) -> dict[str, dict[str, list[str]]]:
    """Return each row's cells but the first, by block and label."""
    found: dict[str, dict[str, list[str]]] = {}
    for line in text.splitlines():
        if line.startswith(r"\multicolumn"):
            rows = found.setdefault(line.split(r"\emph{")[1].split("}")[0], {})
        elif found and line.endswith(r" \\"):
            label, *cells = line.removesuffix(r" \\").split(" & ")
            rows[label.removeprefix("{}").removeprefix(r"\raggedright ")] = cells
    return found


def test_every_number_and_interval_is_that_of_the_csv(tmp_path: Path) -> None:
    rows = table()
    write_latex(rows, tmp_path / "table.tex")
    write_table(rows, tmp_path / "table.csv")
    csv = pd.read_csv(tmp_path / "table.csv").set_index(["output", "label"])
    found = blocks((tmp_path / "table.tex").read_text())
    names = {"Online": "online", "Smoothed": "smoothed"}
    assert {(names[block], label) for block, of in found.items() for label in of} == set(csv.index)
    ends = 0
    for block, of_block in found.items():
        for label, (_, runs, *cells) in of_block.items():
            row = csv.loc[names[block], label]
            assert runs == "6/6"
            for column, cell in zip(COLUMNS, map(parse, cells), strict=True):
                true = row[column.score] / column.divisor
                if cell["value"] is None:
                    assert np.isnan(true)
                    continue
                half = 0.501 * cell["unit"]
                assert cell["value"] == pytest.approx(true, abs=half)
                assert cell["unit"] <= max(1e-4, abs(true) / 50)
                if cell["low"] is not None:
                    ends += 1
                    assert cell["low"] == pytest.approx(row[f"{column.score}_low"] - true, abs=half)
                    assert cell["high"] == pytest.approx(row[f"{column.score}_high"] - true, abs=half)
    assert ends == 6 * 4


def test_the_best_of_each_block_is_bold_and_no_other() -> None:
    found = blocks(latex(table()))
    for of_block in found.values():
        for k, column in enumerate(COLUMNS):
            cells = {label: parse(cells[2 + k]) for label, cells in of_block.items()}
            values = [cell["value"] for cell in cells.values() if cell["value"] is not None]
            best = None if column.best is None else column.best(values)
            assert {label for label, cell in cells.items() if cell["bold"]} == {
                label for label, cell in cells.items() if best is not None and cell["value"] == best
            }, column.score
    online, smoothed = ({label: parse(cells[2])["value"] for label, cells in of.items()} for of in found.values())
    assert min(online.values()) != min(smoothed.values())  # each block has a best of its own


def test_what_did_not_end_every_run_is_reported_and_not_ranked() -> None:
    rows = table()
    lost = (rows["label"] == "eskf") & (rows["seed"] == 3)
    rows.loc[lost, "status"] = "diverged"
    rows.loc[rows["label"] == "eskf", "ate_rmse_m"] = 1e-3
    rows.loc[(rows["label"] == "fls") & rows["seed"].isin([1, 2]), "status"] = "failed"
    found = blocks(latex(rows))
    assert found["Online"]["eskf"][1] == "5/6, 1 diverged"
    assert found["Smoothed"]["fls"][1] == "4/6, 2 failed"
    assert parse(found["Online"]["eskf"][2])["value"] == 0.001
    assert not any(parse(cell)["bold"] for label in ("eskf", "fls") for cell in found["Online"][label][2:])
    assert any(parse(found["Online"][label][2])["bold"] for label in ("dr", "rts"))
    assert not any(parse(cell)["bold"] for of in found["Smoothed"].values() for cell in of[2:])  # one is no race


def test_the_caption_states_seeds_alignment_dimensions_and_step() -> None:
    caption = next(line for line in latex(table(align="yaw", dims="2d")).splitlines() if line.startswith(r"\caption"))
    stated = (
        "6 seeds (1\\textendash{}6)",
        "alignment: yaw",
        "in 2d",
        "RPE over 10 m, all pairs",
        "against ground truth",
    )
    for words in (*stated, "95 \\% interval", "Costs on Some Processor, 2 cores", "Bold"):
        assert words in caption, words
    few = latex(table(seeds=2))
    assert "2 seeds (1\\textendash{}2)" in few
    assert "Intervals need 5 seeds" in few
    assert "^{+" not in few
    alone = latex(table(seeds=1).assign(seed=pd.NA))
    assert "one run of a recording" in alone
    assert "pooled" not in alone


def test_costs_of_runs_with_nis_are_not_ranked() -> None:
    text = latex(table(spec='{"scores": {"nis": true}}'))
    assert "Costs are not comparable: NIS was asked for" in text
    for of_block in blocks(text).values():
        assert not any(parse(cell)["bold"] for cells in of_block.values() for cell in cells[-3:])


def test_where_nothing_was_run_there_is_no_table() -> None:
    assert r"\begin" not in latex(table(status="absent"))
    failed = latex(table(status="failed", truth_kind=None, lookahead_s=None))
    assert blocks(failed)["Online"]["eskf"] == ["--", "0/6, 6 failed", *["--"] * len(COLUMNS)]


def test_logs_have_labels_of_their_own() -> None:
    rows = pd.concat([table(log=log) for log in ("a b", "a_b", "A&b")])
    labels = re.findall(r"\\label\{(.*)\}", latex(rows))
    assert labels == ["tab:e-a_b", "tab:e-a_b-2", "tab:e-A_b-3"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.31949, "0.319"),
        (4.8349, "4.83"),
        (1234.4, "1{,}234"),
        (0.00123, "0.0012"),
        (0.0, "0"),
        (3.456e-7, r"3.5 \times 10^{-7}"),
        (2.04e6, r"2.0 \times 10^{6}"),
        (np.inf, r"\infty"),
    ],
)
def test_a_number_has_three_figures_that_count(value: float, text: str) -> None:
    assert number(value) == text


def test_the_ends_of_an_interval_have_the_decimals_of_their_number() -> None:
    assert number(0.4219, 0.3333, 0.5, bold=True) == r"\mathbf{0.422}_{-0.089}^{+0.078}"
    assert number(4.2e-7, 4.0e-7, 4.5e-7) == r"4.2_{-0.2}^{+0.3} \times 10^{-7}"


# -- text -------------------------------------------------------------------------------------------------------------

COMMAND = re.compile(r"\\(?:[A-Za-z]+|.)|\$|[{}]|[^\\${}]")


@given(st.text(st.one_of(st.sampled_from([*ESCAPED, *ACCENTS]), st.characters()), max_size=40))
def test_any_text_is_ascii_with_balanced_braces_and_nothing_special(text: str) -> None:
    depth, mathematics = 0, False
    for token in COMMAND.findall(escape(text)):
        assert token.isascii()
        depth += {"{": 1, "}": -1}.get(token, 0)
        mathematics ^= token == "$"
        assert depth >= 0
        assert token not in "#%&~" or len(token) > 1
        assert token not in "_^" or mathematics
    assert depth == 0
    assert not mathematics


@given(st.text(st.characters(codec="ascii", categories=["L", "N"]), max_size=20))
def test_letters_and_digits_stay_as_they_are(text: str) -> None:
    assert escape(text) == text


def test_special_letters_are_escaped() -> None:
    assert escape("a_b 100 % & #1 σ° µs × –") == (r"a\_b 100 \% \& \#1 $\sigma$$^\circ$ $\mu$s $\times$ \textendash{}")
    assert escape("--x") == "-{}-x"
    assert escape("é Å m² 東") == r"\'{e} \r{A} m$^2$ [U+6771]"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here: LaTeX is not installed")
def test_pdflatex_sets_it_for_any_names(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    every = "".join(
        [*ESCAPED, *(f"e{accent}" for accent in ACCENTS), *(chr(0x391 + k) for k in range(58)), *map(chr, range(256))]
    )
    assert GREEK
    random = ["".join(map(chr, rng.integers(1, 0xD7FF, 12))) for _ in range(20)]
    odd = [
        "[1] of *all*",
        "* x",
        "a_label_that_goes_on for rather longer than anybody would like it to",
        r"\end{tabular}",
        "%",
    ]
    rows = [table(seeds=5)]
    for k, name in enumerate([every, *random, *odd]):
        one = table(seeds=1)
        rows.append(one.assign(log="odd & 100 % of_it", label=one["label"] + f" {k} " + name if k % 2 else name))
    write_latex(pd.concat(rows), tmp_path / "table.tex")
    paper = r"\documentclass{article}\usepackage{booktabs}\begin{document}\input{table.tex}\clearpage\end{document}"
    (tmp_path / "paper.tex").write_text(paper)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120, check=False)
    output = done.stdout.decode(errors="replace")
    assert done.returncode == 0, output[-2000:]
    assert (tmp_path / "paper.pdf").read_bytes().startswith(b"%PDF")
    assert "Missing character" not in (tmp_path / "paper.log").read_text(errors="replace")
