"""Compare our ATE and RPE with those of evo: the same numbers, and how much longer evo takes. evo is for tests only."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...datasets import Trajectory
from ..metrics import ate, rpe
from .benchmarks import random_walk

TOLERANCE = 1e-9
"""In metres and in degrees."""

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


@dataclass(frozen=True)
class Compared:
    """Time of evo over each of ours, and the largest difference of any statistic."""

    ratios: tuple[float, ...]
    largest_difference: float


def compare(n: int, repeats: int = 5) -> Compared:
    """Score n poses by both, RPE over 1 m and all pairs; ours runs before and after evo.

    Raises:
        ModuleNotFoundError: evo is not installed.
    """
    import evo  # noqa: F401  # before anything takes long

    truth, estimate = random_walk(n)
    ours = [_ours(truth, estimate)[0] for _ in range(repeats)]
    started = time.process_time()
    theirs = list(_theirs(truth, estimate))
    evo_s = time.process_time() - started
    ours += [_ours(truth, estimate)[0] for _ in range(repeats)]
    absolute, relative = _ours(truth, estimate)[1]
    pairs = zip((absolute, absolute, relative, relative), ("{}_m", "rotation_{}_deg") * 2, theirs, strict=True)
    differences = [
        abs(getattr(our, pattern.format(name)) - their[name]) for our, pattern, their in pairs for name in STATISTICS
    ]
    return Compared(tuple(evo_s / each for each in ours), max(differences))


def _ours(truth: Trajectory, estimate: Trajectory) -> tuple[float, tuple[Any, Any]]:
    started = time.process_time()
    both = ate(truth, estimate), rpe(truth, estimate, 1.0, "m", "all")
    return time.process_time() - started, both


def _theirs(truth: Trajectory, estimate: Trajectory) -> Iterator[dict[str, float]]:
    """Yield evo's statistics: ATE and then RPE, of translation and then of rotation."""
    from evo.core.metrics import APE, RPE, PoseRelation, Unit

    data = tuple(_path(each) for each in (truth, estimate))
    relations = (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
    for relation in relations:
        metric = APE(relation)
        metric.process_data(data)
        yield metric.get_all_statistics()
    for relation in relations:
        metric = RPE(relation, 1.0, Unit.meters, all_pairs=True, pairs_from_reference=True)
        metric.process_data(data)
        yield metric.get_all_statistics()


def _path(of: Trajectory) -> Any:
    from evo.core.trajectory import PosePath3D

    poses = np.tile(np.eye(4), (len(of), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = of.R_WB, of.p_WB_W
    return PosePath3D(poses_se3=list(poses))
