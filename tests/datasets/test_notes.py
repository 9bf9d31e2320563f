"""Notes are sentences, and data."""

from __future__ import annotations

import json
import pickle

import pytest
from fathom.datasets.notes import KINDS, Note, as_data


def test_a_note_is_its_sentence_and_says_the_same_to_a_machine() -> None:
    note = Note("dvl: 3 rows invalid dropped", "dropped", "dvl", count=3, of=12)
    assert note == "dvl: 3 rows invalid dropped"
    assert json.loads(json.dumps(as_data(note))) == {
        "kind": "dropped", "text": str(note), "stream": "dvl", "count": 3, "of": 12, "share": 0.25,
    }  # fmt: skip
    again = pickle.loads(pickle.dumps(note))
    assert as_data(again) == as_data(note)


def test_a_plain_sentence_is_a_note_about_the_log() -> None:
    assert as_data("box, seed 7") == {"kind": "about", "text": "box, seed 7"}
    assert list(KINDS)[-1] == "about"


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="no kind of note 'drop'; known: damage"):
        Note("", "drop")
