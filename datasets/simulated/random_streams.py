"""Random streams: one for each mission, cause of randomness and seed."""

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
    "imu_outliers": 12,
    "dvl_outliers": 13,
    "depth_outliers": 14,
    "gps_outliers": 15,
    "heading_outliers": 16,
    "imu_dropouts": 17,
    "dvl_dropouts": 18,
    "depth_dropouts": 19,
    "gps_dropouts": 20,
    "heading_dropouts": 21,
    "imu_repeats": 22,
    "dvl_repeats": 23,
    "depth_repeats": 24,
    "gps_repeats": 25,
    "heading_repeats": 26,
    "dvl_beams": 27,
    "waves": 28,
}
"""Separate, so that dropping one changes no other. Never renumber: a seed would give another log."""


def random_stream(mission: str, cause: str, seed: int) -> np.random.Generator:
    """Return the generator of one mission, one cause of randomness and one seed.

    Two missions share nothing, so that one seed gives two experiments. The key cannot be ambiguous: of a name,
    every word of 32 bits is larger than any cause, and a seed is one word or two at the end.
    """
    name = int.from_bytes(mission.encode("utf-8"), "little")
    return np.random.default_rng([name, RANDOM_STREAMS[cause], seed])
