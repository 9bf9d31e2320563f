"""The command prints on a terminal without our letters, and goes on where its reader has gone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fathom.bench.cli.stdout import WORDS, in_ascii
from fathom.bench.output.cells import ABSENT, ACCURACY, DIRECTIONS, OTHERS

FATHOM = Path(sys.executable).with_name("fathom")


@pytest.mark.parametrize(
    ("letter", "ascii_"), [("–", "-"), ("°", "deg"), ("µ", "u"), ("é", "e"), ("²", "2"), ("相", "\\u76f8")]
)
def test_a_letter_is_written_in_ascii(letter: str, ascii_: str) -> None:
    assert in_ascii(letter) == ascii_


def test_every_letter_of_a_table_has_its_word() -> None:
    shown = {ABSENT, *DIRECTIONS, "▲▼ ±3σ Δ 95 % ×", *(column.heading for column in (*ACCURACY, *OTHERS))}
    beyond = {letter for text in shown for letter in text if not letter.isascii()}
    assert beyond <= WORDS.keys()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_a_terminal_of_any_encoding_gets_the_text(encoding: str) -> None:
    code = (
        "import sys; sys.argv = ['fathom', 'list', 'scores']; from fathom.bench.cli.app import main, set_up; set_up();"
        "from fathom.bench.output.tables.terminal import console; console().print('ATE – 3.2 °, ±3σ, 相模湾'); main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONIOENCODING": encoding}, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    first, *others = done.stdout.splitlines()  # the others are typer's, which takes an ASCII terminal for one of UTF-8
    expected = {
        "ascii": "ATE - 3.2 deg, +-3sigma, \\u76f8\\u6a21\\u6e7e",
        "latin-1": "ATE - 3.2 °, ±3sigma, \\u76f8\\u6a21\\u6e7e",
        "utf-8": "ATE – 3.2 °, ±3σ, 相模湾",
    }
    assert first.decode(encoding) == expected[encoding]
    assert any(line.startswith(b"ate_rmse_m") for line in others)


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_command_goes_on_where_its_reader_has_gone(stream: str, tmp_path: Path) -> None:
    code = (
        "import sys, pathlib, rich.console, typer; from fathom.bench.cli.stdout import set_up; set_up();"
        f"stream = sys.{stream}; console = rich.console.Console(file=stream);"
        "[(console.print('x' * 1000), print('y' * 1000, file=stream), stream.flush()) for _ in range(300)];"
        f"typer.echo('z' * 10**6, file=stream); pathlib.Path({str(tmp_path / 'end')!r}).touch()"
    )
    read, write = os.pipe()
    child = subprocess.Popen([sys.executable, "-c", code], **{stream: write})
    os.close(write)
    assert os.read(read, 10)
    os.close(read)
    assert child.wait() == 0
    assert (tmp_path / "end").exists()


def test_help_has_a_short_name_for_every_verb() -> None:
    for verb in ([], ["run"], ["timing", "budgets"]):
        done = subprocess.run([FATHOM, *verb, "-h"], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout[:6]) == (0, "Usage:")
