"""Numbers of configs: what YAML turns into something else than was written is refused, and so is what is no place."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError, ImuNoise, Rig, Scenario
from fathom.datasets.places import is_place
from fathom.estimators.registry import EstimatorError, create


@pytest.mark.parametrize("word", ["yes", "no", "on", "off", "true", "false"])
@pytest.mark.parametrize(
    "key",
    ["duration_s: {}", "dvl: {{rate_hz: {}}}", "start_ns: {}", "depth: {{mounting: {{translation_m: [{}, 0, 0]}}}}",
     "gps: {{faults: {{dropout_probability: {}}}}}", "latitude_deg: {}"],
)  # fmt: skip
def test_a_truth_value_is_no_number(key: str, word: str) -> None:
    text = key.format(word)
    with pytest.raises(DatasetError, match=r"expected a number, found (True|False) \(YAML takes yes, no, on and off"):
        Scenario.from_dict(yaml.safe_load(text))


@pytest.mark.parametrize(
    ("name", "options"),
    [("eskf", {"merge_ns": True}), ("fls", {"lag_s": True}), ("eskf", {"gate": {"gps": True}}), ("ukf", {"beta": True}),
     ("window", {"extra_updates": True}), ("eskf", {"inflate": {"gps": True}}), ("batch", {"max_hold_s": True})],
)  # fmt: skip
def test_a_truth_value_is_no_option_that_is_a_number(name: str, options: dict[str, Any]) -> None:
    with pytest.raises(EstimatorError, match="expected a number, found True"):
        create(name, **options)


@pytest.mark.parametrize(("text", "value"), [("1e2", 100.0), ("1E2", 100.0), ("+1.2e2", 120.0), ("100", 100.0)])
def test_an_exponent_without_a_point_is_a_number(text: str, value: float) -> None:
    assert Scenario.from_dict(yaml.safe_load(f"duration_s: {text}")).duration_s == value


def test_a_place_is_on_earth() -> None:
    latitude = np.array([0, 90, -90, 90.1, math.nan, math.inf, 40, 40, 40])
    longitude = np.array([0, 180, 360, 0, 0, 0, 361, math.nan, -180])
    assert is_place(latitude, longitude).tolist() == [True, True, True, False, False, False, False, False, True]


@pytest.mark.parametrize("bad", [90.5, -91.0, math.nan, math.inf])
def test_a_rig_and_a_scenario_lie_on_earth(bad: float) -> None:
    noise = ImuNoise(1e-4, 1e-3, 0.0, 0.0, 1e-3, 1e-2)
    with pytest.raises(DatasetError, match="latitude_deg must lie between"):
        Rig(noise, latitude_deg=bad)
    with pytest.raises(DatasetError, match="latitude_deg"):
        Scenario.from_dict({"latitude_deg": bad})


@pytest.mark.parametrize("bad", [-1e-9, math.nan, math.inf])
@pytest.mark.parametrize("name", ImuNoise.__dataclass_fields__)
def test_noise_is_finite_and_not_negative(name: str, bad: float) -> None:
    with pytest.raises(DatasetError, match=f"imu noise: {name} must be finite and not negative"):
        ImuNoise(**{**dict.fromkeys(ImuNoise.__dataclass_fields__, 1e-3), name: bad})
