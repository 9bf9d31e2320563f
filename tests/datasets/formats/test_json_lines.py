"""Files of JSON objects: kinds by a key, nested numbers by dots, and what is no object skipped and told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fathom.datasets import DatasetError
from fathom.datasets.formats import json_lines
from fathom.datasets.formats.json_lines import JsonLinesRecording
from fathom.datasets.formats.recording import Messages, Wanted, recording_at
from limited import limited

VELOCITY: dict[str, Any] = {
    "type": "velocity",
    "vx": 0.25,
    "covariance": [[1e-6, 0], [0, 4e-6]],
    "velocity_valid": True,
    "time_of_validity": 1638191471563017,
}
POSITION = {"type": "position_local", "ts": 49056.8, "x": 12.5}


def read(folder: Path, text: str, message: str, *columns: str, **keys: Any) -> Messages:
    (folder / "a50.jsonl").write_text(text)
    recording = JsonLinesRecording(format="jsonlines", file="a50.jsonl", **keys)
    return recording.read(folder, [Wanted(message, None, columns)])


def test_numbers_of_one_kind_of_object_are_read_by_their_path(tmp_path: Path) -> None:
    text = "\n".join(map(json.dumps, [VELOCITY, POSITION, {**VELOCITY, "vx": -1, "velocity_valid": False}]))
    columns = ("vx", "covariance.1.1", "velocity_valid", "time_of_validity")
    (found,) = read(tmp_path, text, "velocity", *columns).columns
    assert {name: values.tolist() for name, values in found.items()} == {
        "vx": [0.25, -1.0], "covariance.1.1": [4e-6] * 2, "velocity_valid": [1, 0],
        "time_of_validity": [1638191471563017] * 2,
    }  # fmt: skip
    assert found["time_of_validity"].dtype == np.int64


def test_the_kinds_and_their_fields_are_listed(tmp_path: Path) -> None:
    (tmp_path / "a50.jsonl").write_text("\n".join(map(json.dumps, [VELOCITY, POSITION, VELOCITY])))
    recording = recording_at(tmp_path / "a50.jsonl")
    assert recording is not None
    held = {info.message: (info.count, info.span_s, info.fields) for info in recording.contents(tmp_path)}
    assert held == {
        "position_local": (1, 0.0, ("ts", "x")),
        "velocity": (2, 0.0, ("vx", "covariance.0.0", "velocity_valid", "time_of_validity")),
    }


def test_objects_without_that_key_are_one_kind(tmp_path: Path) -> None:
    (found,) = read(tmp_path, '{"vx": 1}\n{"vx": 2.5, "type": 7}\n', "object", "vx").columns
    assert found["vx"].tolist() == [1.0, 2.5]
    (found,) = read(tmp_path, '{"vx": 1, "id": "a"}\n{"vx": 2, "id": "b"}\n', "b", "vx", kind="id").columns
    assert found["vx"].tolist() == [2]


def test_lines_that_are_no_objects_are_skipped_and_told(tmp_path: Path) -> None:
    good = json.dumps(VELOCITY)
    read_ = read(tmp_path, f"{good}\n\n[1]\n{good}\n{good[:20]}", "velocity", "vx")
    assert read_.columns[0]["vx"].tolist() == [0.25] * 2
    (note,) = read_.notes
    assert "2 of 5 lines are no JSON objects, the first is line 3" in note
    with pytest.raises(DatasetError, match="no line is a JSON object"):
        read(tmp_path, "t,vx\n1,2\n", "velocity", "vx")
    with pytest.raises(DatasetError, match="did you mean 'velocity'"):
        read(tmp_path, good, "velocty", "vx")
    with pytest.raises(DatasetError, match="'vy'"):
        read(tmp_path, good, "velocity", "vy")


LONG = 20 << 20
"""Characters of a line."""


@pytest.mark.parametrize(
    "line",
    [
        "[" * 100_000,
        '{"type": "velocity", "vx": ' + "9" * 10_000 + "}",
        " " * LONG,
        '{"a": "' + "x" * LONG,
    ],
)
def test_a_line_that_wants_to_hurt_is_no_object(tmp_path: Path, line: str) -> None:
    text = f"{line}\n{json.dumps(VELOCITY)}\n"
    found = limited(lambda: read(tmp_path, text, "velocity", "vx").columns[0]["vx"], 3 * len(text) // (1 << 20) + 40)
    assert found.tolist() == [0.25]


def test_objects_of_too_many_kinds_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "\n".join(json.dumps({"type": f"kind {i}"}) for i in range(10_001))
    with pytest.raises(DatasetError, match="topics"):
        read(tmp_path, text, "kind 1")
    monkeypatch.setattr(json_lines, "LONGEST_LINE", 20)
    with pytest.raises(DatasetError, match="no line"):
        read(tmp_path, json.dumps(VELOCITY), "velocity", "vx")
