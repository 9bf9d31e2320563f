"""Where all is linear every road is one: GTSAM's smoothers, the filter, the filter run backwards, and least squares.

GTSAM's IMU factor has three things that our block has not, so the toy is one in which they are nothing:

- each sample's position noise, INTEGRATION_DENSITY: beside 1 m/s²/√Hz of the accelerometer it is 1e-8 of the variance;
- a bias that walks by LEAST_WALK of the white noise at least: this one walks by just that;
- the walk's own part in the motion within a block: (walk T / density)²/3 of the motion's variance, and a correlation
  of √3/2 walk T / density at most with the bias's step. At T = 0.2 s they are 1e-10 and 1e-5, and the step is 1e-4 of
  what is known of the bias.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from fathom.datasets import Belief, ImuNoise, Mounting, Rig
from fathom.datasets.epochs import Epoch
from fathom.estimators import ESTIMATORS, create
from fathom.estimators.graph.gtsam_border import LEAST_WALK
from paths import GRAVITY, random_rotation
from test_filters import LINEAR, TINY, linear_toy
from test_rts import least_squares

RIG = Rig(
    ImuNoise(TINY, 1.0, LEAST_WALK * TINY, LEAST_WALK, TINY, 1.0),
    Mounting(random_rotation(np.random.default_rng(7))),
    gravity=GRAVITY,
)
LAG = 5
"""The window, in epochs; each makes one keyframe."""
SEEDS = [0, 1]


def options(name: str, thorough: bool) -> dict[str, object]:
    """As shipped, but for the lag and covariances at every tick; or linearising anew and carrying on whatever moves."""
    wanted: dict[str, object] = {"lag_s": 0.2 * LAG, "hindsight_covariance_s": 1e-3}
    if thorough:
        wanted |= {"relinearize": [1e-9] * 4, "wildfire": 0.0}
    return {key: value for key, value in wanted.items() if key in ESTIMATORS[name].__dataclass_fields__}


@cache
def toy(seed: int) -> tuple[Belief, list[Epoch]]:
    return linear_toy(seed, epochs=25, rig=RIG)


@cache
def exact(seed: int, seen: int) -> list[Belief]:
    """Least squares on the first `seen` epochs, as one dense problem: the beliefs at each of them."""
    prior, epochs = toy(seed)
    return least_squares(prior, epochs[:seen], RIG, LINEAR, 1)[0]


@cache
def run(name: str, seed: int, thorough: bool = False) -> tuple[list[Belief], list[Belief]]:
    """The beliefs at the end of each epoch, and those with hindsight if there are any."""
    prior, epochs = toy(seed)
    one, online = create(name, **options(name, thorough)).begin(prior, RIG), []
    for epoch in epochs:
        one.step(epoch)
        online.append(one.belief())
    track = one.finish()
    return online, [] if track is None else [
        Belief(int(t), track.state(k), track.P[k]) for k, t in enumerate(track.t_ns)
    ]


def apart(ours: list[Belief], theirs: list[Belief]) -> float:
    """The largest difference of state over σᵢ, and of covariance over σᵢσⱼ, of what is uncertain."""
    assert [a.t_ns for a in ours] == [b.t_ns for b in theirs]
    worst = 0.0
    for a, b in zip(ours, theirs, strict=True):
        sigma = np.sqrt(np.diag(b.P)[LINEAR])
        state = np.abs(b.state.local(a.state)[LINEAR] / sigma)
        P = np.abs((a.P - b.P)[np.ix_(LINEAR, LINEAR)] / np.outer(sigma, sigma))
        worst = np.maximum(worst, max(state.max(), P.max()))
    return float(worst)


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
def test_with_all_hindsight_every_smoother_is_least_squares(name: str, seed: int, thorough: bool) -> None:
    online, hindsight = run(name, seed, thorough)
    assert apart(hindsight, exact(seed, len(online))) < 1e-6
    assert apart(hindsight, run("rts", seed)[1]) < 1e-6
    assert apart(hindsight, online) > 0.1  # there was something to learn


@pytest.mark.parametrize("thorough", [False, True], ids=["as shipped", "to the last digit"])
@pytest.mark.parametrize("seed", SEEDS)
def test_at_a_lag_hindsight_is_least_squares_on_what_had_been_seen_by_then(seed: int, thorough: bool) -> None:
    """A state leaves once the keyframe has come that is the lag younger; marginalising the older lost nothing."""
    _, hindsight = run("fls", seed, thorough)
    n = len(hindsight)
    assert apart(hindsight, [exact(seed, min(k + LAG + 1, n))[k] for k in range(n)]) < 1e-6
    assert apart(hindsight[: -2 * LAG], exact(seed, n)[: -2 * LAG]) > 1e-3  # the window does matter
