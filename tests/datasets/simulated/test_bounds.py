"""What no computer could simulate, or no sea holds, is refused before an array is made."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from fathom.datasets import DatasetError, Scenario, Trajectory, simulate


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"duration_s": 1e12}, "`duration_s`.*less than or equal to 1000000"),
        (
            {"imu": {"rate_hz": 1e9}},
            r"imu.rate_hz 1e\+09 over duration_s 600 gives 6e\+11 readings; at most 10,000,000",
        ),
        ({"dvl": {"rate_hz": 1e300}}, "dvl.rate_hz"),
        ({"duration_s": 1e6, "heading": {"rate_hz": 20}}, "imu.rate_hz 100 over duration_s 1e\\+06"),
        ({"leg_m": 1e-9, "mission": "transit"}, "transit: more than 1,000,000 turns"),
        ({"turn_radius_m": 1e-9, "helix_pitch_m": 1e-9, "mission": "helix"}, "helix: more than 1,000,000 turns"),
        ({"speed_m_s": 1e9}, "`speed_m_s`"),
        ({"surface_every_s": 1e-300}, "`surface_every_s`"),
        ({"depth_m": 1e300}, "`depth_m`"),
        ({"seabed": {"depth_m": 1e5}}, "`seabed.depth_m`"),
        ({"tide": {"amplitude_m": 1e9}}, "`tide.amplitude_m`"),
        ({"tide": {"period_h": 1e-300}}, "`tide.period_h`"),
        ({"gps": {"delay_s": 1e300}}, "`gps.delay_s`"),
        ({"dvl": {"disorder_s": 1e12}}, "`dvl.disorder_s`"),
        ({"noise_scale": 1e300}, "`noise_scale`"),
        ({"start_ns": 10**30}, "`start_ns`"),
        ({"prior": {"position_m": 0}}, "`prior.position_m`"),
        ({"heading": {"sigma_deg": -1}}, "`heading.sigma_deg`"),
    ],
)
def test_a_scenario_without_bounds_is_refused(values: dict[str, Any], says: str) -> None:
    with pytest.raises(DatasetError, match=says):
        Scenario.from_dict(values)


def test_the_longest_and_the_fastest_are_not() -> None:
    Scenario.from_dict({"duration_s": 1e5})
    Scenario.from_dict({"duration_s": 600, "imu": {"rate_hz": 4000}, "dvl": {"rate_hz": 100}})
    Scenario.from_dict({"mission": "box", "leg_m": 1, "turn_radius_m": 0.5})


def every_number(spec: Any, above: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """The places of all numbers in a scenario."""
    if isinstance(spec, dict):
        return [place for key, value in spec.items() for place in every_number(value, (*above, key))]
    return [above] if isinstance(spec, int | float) and not isinstance(spec, bool) else []


NUMBERS = every_number(Scenario.from_dict({"seabed": {}, "waves": {}, "tide": {}, "latitude_deg": 40.0}).to_dict())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, True])
@pytest.mark.parametrize("place", NUMBERS, ids=".".join)
def test_no_number_of_a_scenario_is_infinite_or_none(place: tuple[str, ...], bad: float) -> None:
    values: Any = bad
    for key in reversed(place):
        values = {key: values}
    with pytest.raises(DatasetError, match=place[-1]):
        Scenario.from_dict(values)


def test_knots_closer_than_the_poses_are_refused_before_they_are_made() -> None:
    t_ns = np.arange(40, dtype=np.int64) * 10**9
    path = Trajectory(t_ns, np.tile(np.eye(3), (40, 1, 1)), np.zeros((40, 3)))
    scenario = Scenario.from_dict({"mission": "recorded", "path": "given", "duration_s": 30, "path_spacing_s": 1e-300})
    with pytest.raises(DatasetError, match=r"40 poses are too few for knots every 1e-300 s"):
        simulate(scenario, 1, path)


@pytest.mark.parametrize("seed", [-1, 1 << 63, 10**400], ids=["negative", "64 bits", "400 digits"])
def test_a_seed_has_63_bits(seed: int) -> None:
    with pytest.raises(DatasetError, match="seed must be from 0 to"):
        simulate(Scenario(duration_s=20.0), seed)
