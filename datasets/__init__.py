"""What there is to know: logs, readings, the rig, the truth; the simulator; one loader per format."""

from .errors import DatasetError
from .log import Log
from .rig import ImuNoise, Mounting, Rig
from .state import Belief, NavState
from .trajectory import Trajectory

__all__ = ["Belief", "DatasetError", "ImuNoise", "Log", "Mounting", "NavState", "Rig", "Trajectory"]
