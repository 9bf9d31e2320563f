"""What to simulate: a scenario is frozen, validated and printable, and with a seed it determines a log."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator
from pydantic.dataclasses import dataclass

from ..errors import DatasetError, complaints, nearest
from ..quantities import STRICT, Finite, Latitude, NotNegative, Number, Positive, Whole
from ..rig import LEAST_GRAVITY, MOST_GRAVITY, ImuNoise, Mounting, Rig
from ..state import Array
from .faults import AnyFaults, true_mounting
from .seabed import SeabedSpec
from .specs import (
    DEEPEST_M,
    LONGEST_S,
    MISSIONS,
    RECORDED,
    SENSORS,
    DepthSpec,
    DvlSpec,
    GpsSpec,
    HeadingSpec,
    ImuSpec,
    PriorSpec,
    TideSpec,
    WavesSpec,
    as_told,
)

MOST_READINGS = 10_000_000
"""Of one sensor: 28 h at 100 Hz. While an IMU is simulated each needs about 600 bytes."""
MOST_TURNS = 1_000_000
"""Of a mission: one a second for the longest."""
FASTEST_M_S = 100.0
"""No vehicle is as fast under water."""
CLEARANCE_M = 0.5
"""Least height of a mission's deepest point above the seabed."""

CALLED_NOW = {
    "speed_mps": "speed_m_s",
    "gravity_mps2": "gravity_m_s2",
    "beam_sigma_mps": "beam_sigma_m_s",
    "velocity_mps": "velocity_m_s",
    **{f"{dial}_mps": f"{dial}_m_s" for dial in ("outlier", "limit", "quantum")},
    **{f"accel_{dial}_mps2": f"accel_{dial}_m_s2" for dial in ("outlier", "limit", "quantum")},
    **{f"gyro_{dial}_dps": f"gyro_{dial}_deg_s" for dial in ("outlier", "limit", "quantum")},
    **{f"imu_{name}": f"imu.{name}" for name in ("rate_hz", "faults")},
    "imu_bias_correlation_s": "imu.faults.bias_correlation_s",
    **{n: f"faults.{n}" for n in ("bias_correlation_s", "bias_deg", "soft_iron_deg", "soft_iron_axis_deg")},
    **{f"{sensor}_mounting": f"{sensor}.mounting" for sensor in ("imu", "depth", "gps", "heading")},
    **{name: f"noise.{name}" for name in ImuNoise.__dataclass_fields__},
    "roll_pitch_yaw_deg": "roll_deg, pitch_deg and yaw_deg",
    "lever_arm_m": "translation_m",
}
"""What keys of older scenarios are called now."""


def _of_this_noise(imu: Any) -> Any:
    """Return the IMU that is meant where only its noise is given."""
    return {"noise": imu} if isinstance(imu, str | ImuNoise) else imu


if TYPE_CHECKING:
    Imu = Any  # an ImuSpec, which may be made from its noise alone
else:
    Imu = Annotated[ImuSpec, BeforeValidator(_of_this_noise)]


@dataclass(frozen=True, config=STRICT)
class Scenario:
    """A mission, a vehicle and its sensors.

    The vehicle starts afloat, surfaces every `surface_every_s` or so, and ends afloat. Depths count from where it
    floats, down positive; courses from east, counter-clockwise. A sensor that is None is not aboard. A reading comes
    `delay_s` after it was true, and at random up to `disorder_s` later still, so that readings overtake one another.
    """

    mission: str = "lawnmower"  # a name in MISSIONS, or "recorded"
    duration_s: Annotated[Number, Field(ge=20, le=LONGEST_S)] = 600.0
    imu: Imu = ImuSpec()  # or its noise alone: "tactical"

    # the path
    speed_m_s: Annotated[Positive, Field(le=FASTEST_M_S)] = 1.5
    depth_m: Annotated[Positive, Field(le=DEEPEST_M)] = 20.0  # of level missions; yo-yo and helix turn upwards there
    shallow_m: NotNegative = 5.0  # where yo-yo and helix turn downwards
    climb_deg: Annotated[Number, Field(gt=0, le=45)] = 20.0  # of every climb and dive, but the helix's
    helix_pitch_m: Positive = 10.0  # depth that one turn of the helix gains
    leg_m: Positive = 100.0
    turn_radius_m: Positive = 10.0
    course_deg: Finite = 30.0  # of the first leg
    surface_every_s: Annotated[Positive, Field(ge=1)] = 270.0
    surface_for_s: Positive = 36.0  # half of it at the start and at the end
    wobble_deg: Annotated[Number, Field(ge=0, le=10)] = 1.5  # of roll, pitch and yaw, about the path's own

    # a recorded path: east-north-up, its z = 0 at the surface; all but the vehicle and the sensors is then in the file
    path: str | None = None  # a TUM file; relative to where the command runs
    path_start_s: NotNegative = 0.0  # when the log begins, after the path's first pose
    path_spacing_s: Positive | None = None  # between the knots of smoothing splines; None: through every pose

    # the world
    latitude_deg: Latitude | None = None  # where the Earth turns; None: it does not
    seabed: SeabedSpec | None = None  # None: always within the DVL's range
    waves: WavesSpec | None = None  # they move every mission but a recorded one, which has its own in it
    tide: TideSpec | None = None

    # the vehicle
    gravity_m_s2: Annotated[Number, Field(gt=LEAST_GRAVITY, lt=MOST_GRAVITY)] = 9.81

    # the sensors
    dvl: DvlSpec | None = DvlSpec()
    depth: DepthSpec | None = DepthSpec()
    gps: GpsSpec | None = GpsSpec()
    heading: HeadingSpec | None = HeadingSpec()
    prior: PriorSpec = PriorSpec()
    # of every random error, the prior's too; what is stated stays. 0: none
    noise_scale: Annotated[NotNegative, Field(le=1e6)] = 1.0
    start_ns: Annotated[Whole, Field(ge=0, le=4_000_000_000_000_000_000)] = 0

    @field_validator("mission")
    @classmethod
    def _known_mission(cls, name: str) -> str:
        known = [*MISSIONS, RECORDED]
        if name not in known:
            raise ValueError(f"no mission {name!r}{nearest(name, known)}; known: {', '.join(known)}")
        return name

    @model_validator(mode="after")
    def _saw_has_teeth(self) -> Scenario:
        if self.mission in MISSIONS and MISSIONS[self.mission].sawtooth and self.shallow_m >= self.depth_m:
            raise ValueError(f"{self.mission}: shallow_m {self.shallow_m} must be less than depth_m {self.depth_m}")
        return self

    @model_validator(mode="after")
    def _helix_climbs_gently(self) -> Scenario:
        if self.mission == "helix" and self.helix_pitch_m > 2 * math.pi * self.turn_radius_m:
            raise ValueError(
                f"helix: helix_pitch_m {self.helix_pitch_m:g} climbs at more than 45°; at most 2π · turn_radius_m"
            )
        return self

    @model_validator(mode="after")
    def _fits_into_memory(self) -> Scenario:
        aboard = {sensor: getattr(self, sensor) for sensor in ("imu", *SENSORS)}
        for sensor, spec in aboard.items():
            if spec is not None and spec.rate_hz * self.duration_s > MOST_READINGS:
                raise ValueError(
                    f"{sensor}.rate_hz {spec.rate_hz:g} over duration_s {self.duration_s:g} gives "
                    f"{spec.rate_hz * self.duration_s:.2g} readings; at most {MOST_READINGS:,}"
                )
        if self.mission in MISSIONS:
            plan = MISSIONS[self.mission]
            round_m = plan.legs * len(plan.turns_deg) * self.leg_m
            round_m += math.radians(sum(map(abs, plan.turns_deg))) * self.turn_radius_m
            if self.speed_m_s * self.duration_s * len(plan.turns_deg) > MOST_TURNS * round_m:
                raise ValueError(f"{self.mission}: more than {MOST_TURNS:,} turns; make leg_m or turn_radius_m longer")
        return self

    @model_validator(mode="after")
    def _stays_off_the_ground(self) -> Scenario:
        if self.mission in MISSIONS and self.seabed is not None:
            shallowest_m = self.seabed.depth_m - self.seabed.relief_m
            if self.depth_m + CLEARANCE_M > shallowest_m:
                raise ValueError(
                    f"a seabed {shallowest_m:g} m deep must be {CLEARANCE_M:g} m below depth_m {self.depth_m:g}"
                )
        return self

    @model_validator(mode="after")
    def _only_the_recorded_mission_has_a_path(self) -> Scenario:
        if self.path is not None and self.mission != RECORDED:
            raise ValueError(f"mission {self.mission} takes no `path`; only mission {RECORDED!r} follows one")
        return self

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str = "scenario") -> Scenario:
        """Build a scenario from what a file says.

        Raises:
            DatasetError: naming source, key, what is wrong, and for an unknown key its nearest known neighbour.
        """
        if not isinstance(values, Mapping):
            raise DatasetError(f"{source}: expected a mapping of keys, found {values!r}")
        if values.get("mission") == RECORDED and values.get("path") is None:
            raise DatasetError(f"{source}: mission {RECORDED!r} needs `path`, a TUM file")
        try:
            return cls(**{str(key): value for key, value in values.items()})
        except ValidationError as error:
            raise DatasetError(f"{source}: {'; '.join(complaints(error, cls, renamed=CALLED_NOW))}") from None

    def to_dict(self) -> dict[str, Any]:
        """Inverse of `from_dict`: plain values, ready for YAML."""
        return dataclasses.asdict(self)

    @property
    def noisy(self) -> dict[str, Any]:
        """All that has noise, and says under `told` what is told of it: the IMU, the sensors aboard and the prior."""
        parts = {name: getattr(self, name) for name in ("imu", *SENSORS, "prior")}
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def truly_told(self) -> Scenario:
        """The same scenario, whose log states the noise that is simulated."""
        told = {name: dataclasses.replace(part, told=type(part.told)()) for name, part in self.noisy.items()}
        return dataclasses.replace(self, **told)

    @property
    def faults(self) -> dict[str, AnyFaults]:
        """The faults of the IMU and of every aiding sensor aboard, by sensor name."""
        aboard = {sensor: getattr(self, sensor) for sensor in SENSORS}
        return {"imu": self.imu.faults} | {name: spec.faults for name, spec in aboard.items() if spec is not None}

    @property
    def reach_s(self) -> tuple[float, float]:
        """From when to when the sensors look at the motion, from the log's start; a wrong clock looks elsewhere."""
        offsets_s = [faults.clock_offset_s for faults in self.faults.values()]
        return -max(0.0, *offsets_s), self.duration_s - min(0.0, *offsets_s)

    @property
    def earth_rate_rad_s(self) -> Array:
        """Angular rate of the Earth, (3,) in W axes; zero where it does not turn."""
        return np.zeros(3) if self.latitude_deg is None else self.rig.w_CW_W

    @cached_property
    def rig(self) -> Rig:
        """The rig that estimators get."""
        aboard = {sensor: getattr(self, sensor) for sensor in ("depth", "gps", "heading")}
        return Rig(
            imu_noise=as_told(self.imu).figures,
            imu=self.imu.mounting.mounting(),
            **{sensor: spec.mounting.mounting() for sensor, spec in aboard.items() if spec is not None},
            gravity=self.gravity_m_s2,
            latitude_deg=self.latitude_deg,
        )

    @cached_property
    def mountings(self) -> dict[str, Mounting]:
        """Where the IMU and the sensors aboard really sit, by sensor name: the rig's word and their faults."""
        rig = self.rig
        stated = {"imu": rig.imu, "dvl": Mounting(), "depth": rig.depth, "gps": rig.gps, "heading": rig.heading}
        return {sensor: true_mounting(stated[sensor], faults) for sensor, faults in self.faults.items()}
