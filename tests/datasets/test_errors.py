"""What errors show: other people's text cannot hide, forge or colour what stands beside it."""

from __future__ import annotations

import pickle
from typing import Any, Literal

import pytest
from fathom.bench.errors import ExperimentError
from fathom.bench.metrics import ScoreError
from fathom.datasets.errors import DatasetError, FathomError, complaints, one_line, shown
from fathom.estimators.registry import EstimatorError
from pydantic import BaseModel, ValidationError


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("ATE 0.3 m, Δ −2 °, Ångström 東京", "ATE 0.3 m, Δ −2 °, Ångström 東京"),
        ("\x1b[2Jgone", r"\x1b[2Jgone"),
        ("one\nfathom: two\ttabs\rback", r"one\nfathom: two\ttabs\rback"),
        ("\x00\x07\x7f\x85\x9b31m", r"\x00\x07\x7f\x85\x9b31m"),
        ("\u202egnp\u2066.exe\u2028\u200b", r"\u202egnp\u2066.exe\u2028\u200b"),
        ("a lone \udc80", r"a lone \udc80"),
        ("\U000e0041 tag", r"\U000e0041 tag"),
    ],
)
def test_what_cannot_be_printed_is_shown_by_its_code(text: str, says: str) -> None:
    assert shown(text) == says
    assert shown(says) == says, "showing twice is showing once"
    assert says.isprintable()


@pytest.mark.parametrize("kind", [DatasetError, EstimatorError, ExperimentError, ScoreError])
def test_every_error_for_users_is_shown_so(kind: type[FathomError]) -> None:
    error = kind("no topic \x1b[31m/imu\nfathom: all is well")
    assert str(error) == r"no topic \x1b[31m/imu\nfathom: all is well"
    assert isinstance(error, ValueError)


def test_lines_of_an_error_stay_lines_by_way_of_a_worker() -> None:
    error = pickle.loads(pickle.dumps(DatasetError("log.yaml: one", "log.yaml: \x1btwo")))
    assert str(error) == "log.yaml: one\nlog.yaml: \\x1btwo"


def test_an_exception_of_other_code_is_one_line_that_can_be_printed() -> None:
    assert one_line(RuntimeError("\x1b[2J\nworse")) == r"RuntimeError: \x1b[2J worse"


class _Time(BaseModel):
    unit: Literal["s", "ms", "us"] | tuple[Literal["s", "ms", "us"], Literal["s", "ms", "us"]] = "s"
    column: int | str = 0


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        ({"unit": "mss"}, ["`unit`: expected 's', 'ms' or 'us' or a list, found 'mss'; did you mean 'ms'?"]),
        ({"unit": ["s", "uss"]}, ["`unit[1]`: expected 's', 'ms' or 'us', found 'uss'; did you mean 'us'?"]),
        ({"column": 1.5}, ["`column`: expected a whole number or text, found 1.5"]),
    ],
)
def test_one_value_has_one_complaint_whatever_the_members_of_a_union_say(raw: dict[str, Any], says: list[str]) -> None:
    with pytest.raises(ValidationError) as error:
        _Time.model_validate(raw)
    assert complaints(error.value, _Time) == says
