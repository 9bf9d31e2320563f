"""What a verb says of bad input: each complaint on a line of its own, folded between words on a terminal."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import typer
from fathom.bench.cli.verb import BAD_INPUT, refuse
from fathom.bench.errors import ExperimentError
from fathom.bench.experiment.plan import Experiment


def test_complaints_keep_their_lines_where_the_output_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as end:
        refuse(str(ExperimentError("x.yaml: " + "word " * 40, "x.yaml: two \x1b[31m")))
    assert end.value.exit_code == BAD_INPUT
    assert capsys.readouterr().err == f"fathom: x.yaml: {'word ' * 39}word\nx.yaml: two \\x1b[31m\n"


def test_on_a_terminal_lines_are_folded_between_words(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "30")
    with pytest.raises(typer.Exit):
        refuse("a-b/log.yaml: unknown key `streems`; did you mean 'streams'?\na-b/log.yaml: missing key `streams`")
    lines = capsys.readouterr().err.splitlines()
    assert max(map(len, lines)) <= 30
    assert [line for line in lines if line.startswith("a-b")] == ["a-b/log.yaml: missing key"]
    assert all(line.startswith("  ") for line in lines[1:] if not line.startswith("a-b"))


def test_every_complaint_of_an_experiment_is_a_line_that_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("logs: [{scenario: {}}]\nestimators: [{name: eskf}]\nseedz: 1\nbaselin: eskf\n")
    with pytest.raises(ExperimentError) as error:
        Experiment.load(path)
    lines = str(error.value).splitlines()
    assert len(lines) == 2
    assert all(line.startswith(f"{path}: unknown key ") for line in lines)
