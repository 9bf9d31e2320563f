"""The part `mounting` of a log.yaml and of a scenario: the pose of a sensor on the vehicle."""

from __future__ import annotations

import numpy as np
from pydantic import model_validator
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from .notes import Note
from .quantities import STRICT, Finite, Vector
from .rig import Mounting
from .rotations import note, off_rotation, orthonormalised

Matrix = tuple[Vector, Vector, Vector]


@dataclass(frozen=True, config=STRICT)
class MountingSpec:
    """Pose of a sensor's axes S on the body's (forward-left-up): R_BS = Rz(yaw) Ry(pitch) Rx(roll), and its lever arm.

    Attributes:
        translation_m: p_BS_B.
        R_BS: the rotation itself, by rows, in place of the angles; three decimals are enough to be one.
    """

    translation_m: Vector = (0.0, 0.0, 0.0)
    roll_deg: Finite = 0.0
    pitch_deg: Finite = 0.0
    yaw_deg: Finite = 0.0
    R_BS: Matrix | None = None

    @model_validator(mode="after")
    def _is_a_mounting(self) -> MountingSpec:
        if self.R_BS is not None and (self.roll_deg or self.pitch_deg or self.yaw_deg):
            raise ValueError("give R_BS or the angles, not both")
        self.mounting()
        return self

    def notes(self, sensor: str) -> tuple[Note, ...]:
        """Return in a sentence that R_BS was orthonormalised; nothing where it was not."""
        return () if self.R_BS is None else note(f"{sensor}: mounting", off_rotation(np.array([self.R_BS])), sensor)

    def mounting(self) -> Mounting:
        """Return the mounting as the rig holds it, its rotation without the rounding of its decimals."""
        p_BS_B = np.array(self.translation_m)
        if self.R_BS is not None:
            R_BS = np.array(self.R_BS)
            return Mounting(orthonormalised(R_BS, off_rotation(R_BS)), p_BS_B)
        angles_deg = [self.yaw_deg, self.pitch_deg, self.roll_deg]
        if not any(angles_deg):
            return Mounting(np.eye(3), p_BS_B)
        return Mounting(Rotation.from_euler("ZYX", angles_deg, degrees=True).as_matrix(), p_BS_B)
