"""Where all is linear every road is one: GTSAM's smoothers, the filter, the filter run backwards, and least squares.

GTSAM's IMU factor has three things that our block has not, so the toy is one in which they are nothing:

- each sample's position noise, INTEGRATION_DENSITY: beside 1 m/s²/√Hz of the accelerometer it is 1e-8 of the variance;
- a bias that walks by LEAST_WALK of the white noise at least: this one walks by just that;
- the walk's own part in the motion within a block: (walk T / density)²/3 of the motion's variance, and a correlation
  of √3/2 walk T / density at most with the bias's step. At T = 0.2 s they are 1e-10 and 1e-5, and the step is 1e-4 of
  what is known of the bias.
"""

from __future__ import annotations

import pytest
from linear import LAG, SEEDS, apart, exact, run


@pytest.mark.parametrize("thorough", [False, True], ids=["as shipped", "to the last digit"])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["batch", "isam2", "fls"])
def test_online_every_smoother_is_the_filter_and_least_squares_so_far(name: str, seed: int, thorough: bool) -> None:
    online, _ = run(name, seed, thorough)
    assert apart(online, run("eskf", seed)[0]) < 1e-6
    assert apart(online, [exact(seed, k + 1)[k] for k in range(len(online))]) < 1e-6


@pytest.mark.parametrize("thorough", [False, True], ids=["as shipped", "to the last digit"])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["batch", "isam2"])
def test_over_the_whole_log_every_smoother_is_least_squares(name: str, seed: int, thorough: bool) -> None:
    online, smoothed = run(name, seed, thorough)
    assert apart(smoothed, exact(seed, len(online))) < 1e-6
    assert apart(smoothed, run("rts", seed)[1]) < 1e-6
    assert apart(smoothed, online) > 0.1  # there was something to learn


@pytest.mark.parametrize("thorough", [False, True], ids=["as shipped", "to the last digit"])
@pytest.mark.parametrize("seed", SEEDS)
def test_at_a_lag_smoothed_states_are_least_squares_on_the_readings_so_far(seed: int, thorough: bool) -> None:
    """A state leaves once the keyframe has come that is the lag younger; marginalising the older lost nothing."""
    _, smoothed = run("fls", seed, thorough)
    n = len(smoothed)
    assert apart(smoothed, [exact(seed, min(k + LAG + 1, n))[k] for k in range(n)]) < 1e-6
    assert apart(smoothed[: -2 * LAG], exact(seed, n)[: -2 * LAG]) > 1e-3  # the window does matter
