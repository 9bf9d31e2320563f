"""The parts of a scenario, as a file states them: missions, sea, sensors and the prior, each validated.

A spec's own dials of noise are both simulated and told: the log's rig, readings and prior state them. What stands under
`faults` is simulated and never told. What stands under `told` is told in place of the dial of that name.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator
from pydantic.dataclasses import dataclass

from ..errors import nearest
from ..mounting import MountingSpec
from ..quantities import STRICT, Finite, NotNegative, Number, Positive, Probability
from ..rig import ImuNoise
from .faults import DepthFaults, DvlFaults, GpsFaults, HeadingFaults, ImuFaults
from .imu_grades import IMU_GRADES

LONGEST_S = 1e6
"""Of a mission, and of a delay: eleven days."""
DEEPEST_M = 11_000.0
"""The deepest sea is 10.9 km deep."""
STEEPEST = 1 / 15
"""Significant height over the length of the peak's wave: steeper seas break."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What tells one mission from another.

    Attributes:
        turns_deg: course changes, over and over; counter-clockwise positive.
        sawtooth: whether the vehicle keeps climbing and diving between two depths, or runs level at the deeper.
        legs: whether a straight leg comes before each course change; without, the vehicle climbs by the turn.
    """

    turns_deg: tuple[float, ...]
    sawtooth: bool = False
    legs: bool = True


MISSIONS = {
    "lawnmower": Plan(turns_deg=(180.0, -180.0)),
    "yo-yo": Plan(turns_deg=(70.0, -100.0, 60.0, -30.0), sawtooth=True),
    "helix": Plan(turns_deg=(360.0,), sawtooth=True, legs=False),
    "box": Plan(turns_deg=(90.0,)),
    "transit": Plan(turns_deg=(0.0,)),
}


RECORDED = "recorded"
"""The mission that follows a given trajectory."""


@dataclass(frozen=True, config=STRICT)
class WavesSpec:
    """A sea state: significant height, period of the spectrum's peak, and where the waves run (from east, to north).

    Attributes:
        told: whether the depth sensor's sigma has in it what the waves do to its readings.
    """

    told: bool = True
    height_m: Positive = 0.5
    period_s: Annotated[Number, Field(ge=4, le=30)] = 6.0
    towards_deg: Finite = 0.0

    @model_validator(mode="after")
    def _not_breaking(self) -> WavesSpec:
        length_m = 9.81 * self.period_s**2 / (2 * math.pi)
        if self.height_m > STEEPEST * length_m:
            raise ValueError(
                f"waves {self.height_m:g} m high and {length_m:.3g} m long break; height_m at most "
                f"{STEEPEST * length_m:.2g} for period_s {self.period_s:g}"
            )
        return self


@dataclass(frozen=True, config=STRICT)
class TideSpec:
    """A rise and fall of the water, from z = 0 at the log's start; its phase there is 0 where it rises fastest.

    Attributes:
        told: whether the depth sensor's readings are corrected for it, as from a table of tides.
    """

    told: bool = False
    amplitude_m: Annotated[Positive, Field(le=10)] = 1.0
    period_h: Annotated[Positive, Field(ge=0.1)] = 12.42
    phase_deg: Finite = 0.0


Delay = Annotated[NotNegative, Field(le=LONGEST_S)]


def _known_noise(noise: str | ImuNoise) -> str | ImuNoise:
    if isinstance(noise, str) and noise not in IMU_GRADES:
        raise ValueError(f"no IMU grade {noise!r}{nearest(noise, IMU_GRADES)}; known: {', '.join(IMU_GRADES)}")
    if isinstance(noise, ImuNoise):
        for name, value in dataclasses.asdict(noise).items():
            if not (math.isfinite(value) and (value > 0 or (value == 0 and name.endswith("walk")))):
                raise ValueError(f"{name} must be positive and finite, found {value}")
    return noise


Noise = Annotated[
    Annotated[str, Tag("grade")] | Annotated[ImuNoise, Tag("figures")],
    Discriminator(lambda noise: "grade" if isinstance(noise, str) else "figures"),
    AfterValidator(_known_noise),
]


@dataclass(frozen=True, config=STRICT)
class ImuTold:
    """What the rig states of the IMU's noise."""

    noise: Noise | None = None


@dataclass(frozen=True, config=STRICT)
class DvlTold:
    """What the DVL's sigmas are made from."""

    beam_sigma_m_s: Positive | None = None


@dataclass(frozen=True, config=STRICT)
class DepthTold:
    """The depth sensor's sigma, waves or not."""

    sigma_m: Positive | None = None


@dataclass(frozen=True, config=STRICT)
class GpsTold:
    """The fixes' sigmas."""

    horizontal_sigma_m: Positive | None = None
    vertical_sigma_m: Positive | None = None


@dataclass(frozen=True, config=STRICT)
class HeadingTold:
    """The headings' sigma."""

    sigma_deg: Positive | None = None


@dataclass(frozen=True, config=STRICT)
class PriorTold:
    """The sigmas in the prior's covariance."""

    attitude_deg: Positive | None = None
    heading_deg: Annotated[Positive, Field(le=180)] | None = None
    position_m: Positive | None = None
    velocity_m_s: Positive | None = None


@dataclass(frozen=True, config=STRICT)
class ImuSpec:
    """Inertial measurement unit.

    Attributes:
        noise: a name in IMU_GRADES, or figures of one's own.
    """

    noise: Noise = "tactical"
    rate_hz: Positive = 100.0
    mounting: MountingSpec = MountingSpec((-0.35, 0.05, 0.12), roll_deg=180.0, pitch_deg=2.0, yaw_deg=87.0)
    told: ImuTold = ImuTold()
    faults: ImuFaults = ImuFaults()

    @property
    def figures(self) -> ImuNoise:
        """The figures behind `noise`."""
        return IMU_GRADES[self.noise] if isinstance(self.noise, str) else self.noise


@dataclass(frozen=True, config=STRICT)
class DvlSpec:
    """Four-beam Janus DVL at B. 5 mm/s per beam: Nortek DVL1000, RDI WHN600; 22.5° and 0.05–50 m: Water Linked A50."""

    rate_hz: Positive = 5.0
    beam_sigma_m_s: Positive = 0.005
    beam_angle_deg: Annotated[Number, Field(gt=0, lt=90)] = 22.5  # from B's downward axis
    min_range_m: NotNegative = 0.05  # along each beam, where there is a seabed
    max_range_m: Positive = 50.0
    max_tilt_deg: Annotated[Number, Field(gt=0, lt=90)] | None = None  # of its axis from the vertical
    beam_loss_probability: Probability = 0.0  # of each beam of each reading
    three_beams: bool = True  # whether three beams are enough for a reading
    delay_s: Delay = 0.0
    disorder_s: Delay = 0.0
    told: DvlTold = DvlTold()
    faults: DvlFaults = DvlFaults()


@dataclass(frozen=True, config=STRICT)
class DepthSpec:
    """Pressure sensor. The Bar30 resolves 2 mm; sigma covers air pressure as well, and is told with waves in it."""

    rate_hz: Positive = 10.0
    sigma_m: Positive = 0.02
    delay_s: Delay = 0.0
    disorder_s: Delay = 0.0
    mounting: MountingSpec = MountingSpec((0.40, -0.06, 0.05))
    told: DepthTold = DepthTold()
    faults: DepthFaults = DepthFaults()


@dataclass(frozen=True, config=STRICT)
class GpsSpec:
    """GPS, heard only while the antenna is out of the water. 1–5 m is what receivers give without corrections."""

    rate_hz: Positive = 1.0
    horizontal_sigma_m: Positive = 1.5
    vertical_sigma_m: Positive = 3.0
    reacquisition_s: NotNegative = 0.0  # from when the antenna leaves the water to the first fix; it begins with one
    delay_s: Delay = 0.0
    disorder_s: Delay = 0.0
    mounting: MountingSpec = MountingSpec((-0.25, 0.0, 0.30))
    told: GpsTold = GpsTold()
    faults: GpsFaults = GpsFaults()


@dataclass(frozen=True, config=STRICT)
class HeadingSpec:
    """Magnetic heading, 1–2° after calibration."""

    rate_hz: Positive = 5.0
    sigma_deg: Positive = 1.0
    delay_s: Delay = 0.0
    disorder_s: Delay = 0.0
    mounting: MountingSpec = MountingSpec((0.55, 0.0, 0.05), roll_deg=1.5, pitch_deg=-2.0, yaw_deg=4.0)
    told: HeadingTold = HeadingTold()
    faults: HeadingFaults = HeadingFaults()


SensorSpec = DvlSpec | DepthSpec | GpsSpec | HeadingSpec


SENSORS = ("dvl", "depth", "gps", "heading")
"""The aiding sensors, by the names of their streams and specs."""


@dataclass(frozen=True, config=STRICT)
class PriorSpec:
    """Standard deviations of the belief at the start; those of the biases are the IMU's at turn-on.

    Attributes:
        attitude_deg: of each axis of B; of the two horizontal axes of W alone where heading_deg is given.
        heading_deg: about W's vertical; None: as attitude_deg.
        velocity_in: the axes in which the velocity is known. In "B" a vehicle knows how fast it moves, and not
            whereto: an error of attitude turns its velocity in W as well.
        wrong_by_deg: by how much the attitude is wrong, about a random axis; None: by a draw from its sigmas.
    """

    attitude_deg: Positive = 0.5
    heading_deg: Annotated[Positive, Field(le=180)] | None = None
    position_m: Positive = 1.0
    velocity_m_s: Positive = 0.05
    velocity_in: Literal["W", "B"] = "W"
    wrong_by_deg: Annotated[NotNegative, Field(le=180)] | None = None
    told: PriorTold = PriorTold()


Spec = TypeVar("Spec", ImuSpec, DvlSpec, DepthSpec, GpsSpec, HeadingSpec, PriorSpec)


def as_told(spec: Spec) -> Spec:
    """Return a spec whose noise is what the log states of it."""
    told = {name: value for name, value in vars(spec.told).items() if value is not None}
    return dataclasses.replace(spec, **told)
