"""YAML of ours: what is meant is read, a key that stands twice is an error, and small files stay small."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import yaml
from fathom.bench.errors import ExperimentError
from fathom.bench.experiment.plan import Experiment
from fathom.datasets import DatasetError
from fathom.datasets.described.description import read_description
from fathom.datasets.formats import yaml_file
from fathom.datasets.formats.yaml_file import MOST_BYTES, parse_yaml, read_yaml
from limited import limited

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    "path", [*ROOT.glob("bench/experiments/*.yaml"), *ROOT.glob("datasets/catalog/*.yaml")], ids=lambda path: path.name
)
def test_our_own_files_read_as_pyyaml_reads_them(path: Path) -> None:
    assert read_yaml(path) == yaml.safe_load(path.read_text())


@pytest.mark.parametrize(
    "text",
    [
        "", "# nothing\n", "a: [1, -2.5, 1.0e3, .inf, 0x1f, 1_000, true, null, ~, 2024-05-03, 2024-05-03 12:00:00]",
        "a: 'x: y'\nb: \"\\x41\\n\"\nc: |\n  two\n  lines\nd: >\n  one\n  line\n", '{"a": {"b": [[], {}]}}',
        "a: &x [1, 2]\nb: [*x, *x]\n", "a: &x {p: 1, q: 2}\nb: {<<: *x, q: 3}\n",
        "a: &x {p: 1}\nb: &y {p: 2, r: 3}\nc: {<<: [*x, *y], s: 4}\n", "a: !!str 3\nb: !!float 3\nc: !!binary aGk=\n",
    ],
)  # fmt: skip
def test_a_text_means_what_pyyaml_says(text: str) -> None:
    assert repr(parse_yaml(text, "x")) == repr(yaml.safe_load(text))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_mark_of_byte_order_is_no_matter(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "x.yaml").write_bytes("name: Ångström\n".encode(encoding))
    assert read_yaml(tmp_path / "x.yaml") == {"name": "Ångström"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: 1\nb: 2\na: 3\n", "x: line 3: the key 'a' stands there twice, in line 1 and in line 3"),
        ("a:\n  b:\n    dvl: 1\n    imu: 2\n    dvl: 3\n", "line 5: the key 'dvl' stands there twice, in line 3"),
        ("- {p: 1,\n   p: 2}", "line 2: the key 'p' stands there twice, in line 1 and in line 2"),
        ("a: &x {p: 1}\nb: {<<: *x, <<: *x}\n", "line 2: the key '<<' stands there twice"),
        ("true: 1\n1: 2\n", "stands there twice"),
        ("a: [1\nb: 2\n", "x: line 2: not YAML: .*expected ',' or ']'"),
        ("a:\n\tb: 1\n", "line 2: not YAML: .*; indent with blanks, not with tabs"),
        ("a: b: c\n", "line 1: not YAML: .*put text that contains `: ` in quotes"),
        ("a: 1\n---\nb: 2\n", "line 2: a second document begins"),
        ("a: 1\nb: \x1b[31m\n", "line 2: not YAML: an invisible character, 0x1b"),
        ("a: *x\n", r"line 1: the alias \*x has no &x before it"),
        ("a: &x [*x]\n", r"line 1: the alias \*x has no &x before it"),
        ("a: {<<: 3}\n", "`<<` takes a mapping, or a list of mappings"),
        ("\n[1]: 2\n", "line 2: a key is a list"),
        ("a: !!python/object/apply:os.system [x]\n", "line 1: the tag .* is not known here"),
        ("a: !!set {x}\n", "the tag .*set is not known here"),
        ("a: !mine x\n", "the tag !mine is not known here"),
        ("a: 2024-13-45\n", "'2024-13-45' cannot be read as timestamp: month must be in 1..12; put text in quotes"),
        ("%TAG !a! tag:b,2000:\n---\na: 1\n", "line 1: %TAG is not known here"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(text: str, says: str) -> None:
    with pytest.raises(DatasetError, match=says):
        parse_yaml(text, "x")


def test_a_key_twice_is_an_error_in_every_kind_of_file(tmp_path: Path) -> None:
    (tmp_path / "log.yaml").write_text("streams: {imu: 1}\nname: x\nstreams: {}\n")
    with pytest.raises(DatasetError, match=r"log\.yaml: line 3: the key 'streams' stands there twice"):
        read_description(tmp_path / "log.yaml")
    (tmp_path / "x.yaml").write_text("estimators: [eskf]\nlogs: []\nestimators: [dead-reckoning]\n")
    with pytest.raises(ExperimentError, match=r"x\.yaml: line 3: the key 'estimators' stands there twice"):
        Experiment.load(tmp_path / "x.yaml")


@pytest.mark.parametrize("name", ["fifo", "folder", "none", "latin.yaml", "large.yaml"])
def test_what_cannot_be_read_is_told(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "latin.yaml").write_bytes(b"a: 1\nb: \xc5\n")
    with (tmp_path / "large.yaml").open("wb") as file:
        file.truncate(MOST_BYTES + 1)
    says = {"fifo": "found a pipe", "folder": "found a folder", "none": "no such file",
            "latin.yaml": "line 2: not YAML: no UTF-8", "large.yaml": "larger than 16 MiB"}[name]  # fmt: skip
    with pytest.raises(DatasetError, match=says):
        read_yaml(tmp_path / name)


def bomb(first: str, more: str) -> str:
    """Nine levels of ten aliases each: 1e9 values in some hundred bytes."""
    levels = [more.format(n=n, ten=",".join([f"*b{n - 1}"] * 10)) for n in range(1, 9)]
    return "\n".join([first, *levels])


BOMBS = {
    "lists": bomb("b0: &b0 [x,x,x,x,x,x,x,x,x,x]", "b{n}: &b{n} [{ten}]"),
    "merges": bomb("b0: &b0 {x: 1}", "b{n}: &b{n} {{<<: [{ten}]}}"),
    "keys": bomb("b0: &b0 {x: 1}", "b{n}: &b{n} [{ten}]"),
    "text": f"a: &a {'x' * 100_000}\nb: [{'*a,' * 100_000}]",
    "depth": "[" * 1_000_000,
    "depth of keys": "{a: " * 100_000,
    "depth of blocks": "\n".join(" " * i + "a:" for i in range(1500)),
    "values": f"a: [{'x,' * 20_000}]",
    "digits": f"a: {'9' * 1_000_000}",
    "sixtieths": f"a: 1{':1' * 1_000_000}",
    "keys of one hash": "\n".join(f"{k * (2**61 - 1)}: 1" for k in range(1, 5000)),
    "tags": "".join(f"%TAG !a{i}! tag:b,2000:\n" for i in range(50_000)) + "---\na: 1\n",
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_file_that_wants_to_hurt_is_refused_at_once(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_file, "MOST_VALUES", 20_000)  # for a short test
    with pytest.raises(DatasetError, match="x: line"):
        limited(lambda: parse_yaml(BOMBS[kind], "x"), megabytes=300)


def test_a_description_of_many_wrong_values_is_refused_briefly(tmp_path: Path) -> None:
    (tmp_path / "log.yaml").write_text(f"notes: [{'1,' * 20_000}]")
    with pytest.raises(DatasetError, match=r"and 19\d+ more of this kind") as error:
        limited(lambda: read_description(tmp_path / "log.yaml"), megabytes=300)
    assert len(str(error.value)) < 20_000


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: 1\nb: 045\n", "x: line 2: 045 is a number with a leading zero.*; write 45, or put text in quotes"),
        ("a: [010]", "write 10,"),
        ("a: -087", "-087 is a number with a leading zero.*write -87,"),
        ("a: !!int 010", "write 10,"),
        ("a: 1:30", "1:30 is a number in base 60.*; write a decimal number, or put text in quotes"),
        ("a: {b: -8:42:06.5}", "base 60"),
        ("010: a", "write 10,"),
    ],
)
def test_numbers_that_yaml_reads_otherwise_than_they_look_are_refused(text: str, says: str) -> None:
    with pytest.raises(DatasetError, match=says):
        parse_yaml(text, "x")


def test_other_numbers_and_quoted_text_are_taken() -> None:
    text = "[0, -0, 0.5, 01.5, 0x1f, '045', \"1:30\", !!str 010, 2024-05-03, a:1]"
    assert repr(parse_yaml(text, "x")) == repr(yaml.safe_load(text))
