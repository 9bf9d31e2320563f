"""Every score, by name: associate, align, then one of these. A score that is not defined raises ScoreError."""

from .absolute_error import Ate, Drift, HorizontalError, Outage, ate, drift, horizontal_error, outage_drift
from .alignment import Alignment, align
from .association import ScoreError, associate
from .pose_error import Dims, pooled_rmse
from .relative_error import Pairs, Rpe, SegmentError, Unit, check_step, rpe, segment_errors
from .state_error import BLOCKS, Block, StateErrors, error_state, nees, state_errors

__all__ = [
    "BLOCKS",
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
    "drift",
    "error_state",
    "horizontal_error",
    "nees",
    "outage_drift",
    "pooled_rmse",
    "rpe",
    "segment_errors",
    "state_errors",
]
