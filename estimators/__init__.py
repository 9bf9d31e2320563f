"""Filters and smoothers behind one interface, on one copy of the physics.

- `interface`: `Estimator.begin(prior, rig)` returns a `Pass`, stepped epoch by epoch; `registry` names them all.
- `physics`: rotations, the state, the IMU block, one residual and Jacobian per sensor, elimination; compiled.
- `alignment`: the belief at the start of a log that states none.
- `filters`: `eskf`, `eskf-filterpy`, `iekf`, `ukf`, and `rts` on top of `eskf`.
- `graph`: smoothers on GTSAM, the only folder that imports it; `window`: our own smoother, compiled.
- `dead_reckoning`: no fusion, to compare with.

They import the types of `datasets`, and nothing of `bench`. Equations: docs/conventions.md.
"""

from .compiled_cache import use_compiled_folder

use_compiled_folder()  # before anything is compiled or loaded

from .interface import FACTORS, Diverged, Estimator, Pass  # noqa: E402
from .registry import ESTIMATORS, create  # noqa: E402

__all__ = ["ESTIMATORS", "FACTORS", "Diverged", "Estimator", "Pass", "create"]
