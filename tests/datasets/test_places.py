"""A latitude or longitude is the same place in whatever unit or words; what is none on Earth is refused everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets import DatasetError, ImuNoise, Rig, Scenario
from fathom.datasets.described.description import Origin
from fathom.datasets.places import angle, is_place, radians, turned_by
from pydantic import ValidationError

PLACE = 41.184999
"""°, that is 41°11.09994' and 41°11'5.9964"."""


@pytest.mark.parametrize(
    ("value", "unit"),
    [(PLACE, "deg"), (np.radians(PLACE), "rad"), (4111.09994, "ddmm"), (411105.9964, "ddmmss"), (411849990, "degE7")],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_every_unit_says_the_same_place_and_keeps_its_sign(value, unit, sign):
    found = radians(np.array([sign * value, 0.0]), unit)
    np.testing.assert_allclose(found, np.radians([sign * PLACE, 0.0]), rtol=1e-13)


@pytest.mark.parametrize(
    "text",
    ["41.184999", "41.184999N", "N 41.184999", "41.184999° n", "41°11.09994'N", "41 11.09994 N", "41:11:05.9964",
     "41°11'05.9964\"N", "41d11m05.9964 N", "41º 11′ 05.9964″ N", " 41 11 5.9964", "4.1184999e1"],
)  # fmt: skip
def test_every_way_of_writing_says_the_same_place(text):
    assert angle(text, "deg", "NS") == pytest.approx(np.radians(PLACE), rel=1e-13)


@pytest.mark.parametrize("text", ["-41.184999", "41.184999S", "s 41°11.09994'", "-41 11 5.9964", "41:11:5.9964S"])
def test_south_is_negative(text):
    assert angle(text, "deg", "NS") == pytest.approx(np.radians(-PLACE), rel=1e-13)


@pytest.mark.parametrize(
    "text", ["", "-", "N", "41E", "-41S", "N41N", "41 60 N", "41 11 60", "abc", "41,18", "41 11 5 3", "9" * 50]
)
def test_what_says_no_place_is_nan(text):
    assert not is_place(np.degrees(angle(text, "deg", "NS")))


def test_columns_of_hemispheres_give_the_sign_and_may_not_contradict():
    values = np.array([8.7, 8.7, -8.7, -8.7, 8.7, 8.7])
    found = turned_by(["E", " w", "West", "E", "N", ""], "EW", values)
    np.testing.assert_array_equal(found, [8.7, -8.7, -8.7, np.nan, np.nan, np.nan])


def test_the_poles_and_a_whole_turn_are_is_place_and_nothing_beyond():
    latitude = np.degrees(radians(np.array([90.0, -90.0, 90.1, np.nan, 0, 0]), "deg"))
    longitude = np.degrees(radians(np.array([0.0, 0, 0, 0, 360.0, 361.0]), "deg"))
    assert is_place(latitude, longitude).tolist() == [True, True, False, False, True, False]


def test_a_rig_a_scenario_and_an_origin_ask_the_same():
    noise = ImuNoise(*[1e-3] * 6)
    for bad in (90.5, -91.0, float("nan")):
        with pytest.raises(DatasetError, match="latitude_deg must lie between"):
            Rig(noise, latitude_deg=bad)
        with pytest.raises(DatasetError, match="latitude_deg"):
            Scenario.from_dict({"latitude_deg": bad}, "here")
        with pytest.raises(ValidationError):
            Origin(latitude_deg=bad, longitude_deg=0)
    origin = Origin.model_validate({"latitude_deg": "41°11'06\" N", "longitude_deg": "8 42.36 W"})
    assert origin.latitude_deg == pytest.approx(41.185)
    assert origin.longitude_deg == pytest.approx(-8.706)
