"""Random streams: every cause of randomness has one of its own."""

from __future__ import annotations

import numpy as np

RANDOM_STREAMS = {
    "mission": 0,
    "imu_noise": 1,
    "imu_bias": 2,
    "dvl": 3,
    "depth": 4,
    "gps": 5,
    "heading": 6,
    "prior": 7,
    "dvl_disorder": 8,
    "depth_disorder": 9,
    "gps_disorder": 10,
    "heading_disorder": 11,
}
"""Apart, so that dropping one changes no other. Never renumber."""


def random_stream(seed: int, cause: str) -> np.random.Generator:
    """Return the generator of one cause of randomness."""
    return np.random.default_rng([seed, RANDOM_STREAMS[cause]])
