"""Estimators: filters and smoothers over one physics, behind one interface.

physics/            rotations, state, IMU block, measurements, elimination: compiled, written once
alignment/          the initial state from a log
unknown_start       which starts an estimator refuses
interface           `Estimator` and `Pass`; registry: estimators by name; stages: where the time of a step goes
filters/            Kalman filters, and rts on top of eskf
smoothers           options of every smoother; robust: losses
keyframes           which reading makes a keyframe, and where each reading belongs: for every smoother
between_keyframes   beliefs between keyframes
window/             the smoother on our own solver (docs/window.md)
graph/              the smoothers on GTSAM, the only folder that imports gtsam
"""

from .interface import FACTORS, Diverged, Estimator, Pass
from .registry import ESTIMATORS, create

__all__ = ["ESTIMATORS", "FACTORS", "Diverged", "Estimator", "Pass", "create"]
