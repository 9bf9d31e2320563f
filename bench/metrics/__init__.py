"""The scores: arrays in, numbers out. Associate, align, then score; an undefined score raises ScoreError.

`association` and `alignment` prepare the two trajectories. `absolute_error` (ATE, drift, outages), `relative_error`
(RPE, sub-trajectories) and `state_error` (velocity, biases, NEES, coverage) compare them, with `pose_error` below.
`consistency` averages NEES and NIS over seeds, `interval` is the interval over seeds; `floor` is the Cramér–Rao bound,
`floor_ratio` the RMSE over it. `scoring` has the names of all scores and computes them for a run. Equations:
docs/conventions.md (51) to (61), and (69) to (74).
"""

from .absolute_error import Ate, Drift, HorizontalError, Outage, ate, drift, horizontal_error, outage_drift
from .alignment import Alignment, align
from .association import ScoreError, associate
from .pose_error import Dims, pooled_rmse
from .relative_error import Pairs, Rpe, SegmentError, Unit, check_step, rpe, segment_errors
from .state_error import BLOCKS, DOF, Block, StateErrors, coverage, error_state, nees, not_positive, state_errors

__all__ = [
    "BLOCKS",
    "DOF",
    "Alignment",
    "Ate",
    "Block",
    "Dims",
    "Drift",
    "HorizontalError",
    "Outage",
    "Pairs",
    "Rpe",
    "ScoreError",
    "SegmentError",
    "StateErrors",
    "Unit",
    "align",
    "associate",
    "ate",
    "check_step",
    "coverage",
    "drift",
    "error_state",
    "horizontal_error",
    "nees",
    "not_positive",
    "outage_drift",
    "pooled_rmse",
    "rpe",
    "segment_errors",
    "state_errors",
]
