"""The initial belief of a log, estimated from its first seconds.

Biases are known by their turn-on sigmas. Level comes from the accelerometers, which measure the change of velocity
(known from the DVL) less gravity. Heading comes from the heading sensor; without one, from fitting the track of gyro
and DVL to GPS fixes. Position comes from GPS or from the definition of W's origin, height from pressure, velocity from
the DVL or else from GPS. At rest the velocity is zero, and the gyro measures its bias. What no sensor measures gets a
large sigma and a note. The least-squares problem is in `initial_state`.

The belief is at the end of the window (at the IMU sample there), and epochs begin after it, so no reading is used
twice. W's origin is the vehicle's place at the start of the log (for geodetic logs: its first fix at or after the
start). So without GPS the position at the end of the window is the distance travelled since the start.

A start waits. The window holds no gap of the IMU: where one is in the log's first seconds, it begins behind it. It ends
when heading and velocity are known: when their sensors have spoken, if they ever do, or when GPS gives both. If that
takes longer than `max_wait_s`, there is no start, rather than one from nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...datasets.errors import DatasetError
from ...datasets.log import Log
from ...datasets.notes import Note
from ...datasets.state import VELOCITY, Belief
from .initial_state import InitialState
from .rest import is_at_rest, rest_s
from .window import heard

AWAITED = ("heading", "dvl")
"""Sensors that a start waits for."""
ALIGNED_RAD = np.radians(5.0)
"""A heading by GPS is accepted once its sigma is below this."""
WAY_M_S = 0.5
"""A velocity by GPS is accepted once its sigma is below this."""
PATIENCE_S = 10.0
"""A sensor that speaks within this is waited for; if it takes longer, GPS may give the same before. At rest the window
grows up to this."""
LONGEST_WINDOW_S = 60.0
"""Over a longer time the gyro of a cheap IMU turns the track by more than it can be fitted to fixes."""
MAX_WAIT_S = 300.0
"""Sensors that are switched on one after another speak within minutes."""
LONGEST_GAP_S, LONGEST_GAP_SAMPLES = 0.1, 3
"""A longer gap of the IMU than both is not in a window: at 10 °/s the vehicle turns by a degree meanwhile."""
LONGEST_BRIDGED_S = 1.0
"""A run ends at a longer gap, as `max_gap_s` is by default: one in the first PATIENCE_S would cost the log."""


@dataclass(frozen=True, eq=False)
class Initialisation:
    """A belief, and how it was found.

    Attributes:
        start: "static" or "moving", and after commas what is unusual: "heading by GPS", "heading unknown", "velocity
            unknown", "begun late".
        notes: sentences on how each part of it was found; a `Note` of kind "start" for what is unknown, and for how
            much of the log is left out.
    """

    belief: Belief
    start: str
    notes: tuple[str, ...]


class Stretch(NamedTuple):
    """A part of a log whose IMU has no long gap: from the start of its first sample, to its last sample but one."""

    start_ns: int
    last_ns: int

    @property
    def length_s(self) -> float:
        """Seconds of it in which a start may end."""
        return (self.last_ns - self.start_ns) * 1e-9


def initialise(log: Log, window_s: float = 2.0, max_wait_s: float | None = None) -> Initialisation:
    """Estimate the belief at the end of the log's first seconds.

    Args:
        log: its truth and its prior are not used.
        window_s: least length of the window.
        max_wait_s: how long to wait for heading and velocity, in seconds of the IMU; by default the log's, else
            MAX_WAIT_S. Sensors that never speak are not waited for.

    Raises:
        DatasetError: they are first known later than that, or the IMU has a gap in every window.
    """
    wait_s = max(max_wait_s or log.max_wait_s or MAX_WAIT_S, window_s)
    left_s = wait_s
    for stretch in _usable(list(_stretches(log)), window_s):
        state = _start_in(log, stretch, left_s, window_s)
        if state is not None:
            return _told(log, stretch, state)
        left_s -= stretch.length_s
        if left_s < window_s:
            break
    length_s = (int(log.imu.t_ns[-1]) - log.imu.start_ns) * 1e-9
    raise DatasetError(
        f"{log.name}: no start: it needs {window_s:g} s of the IMU without a gap of more than {LONGEST_GAP_S:g} s, and "
        f"there are none in the first {min(wait_s, length_s):.1f} s; begin later by `from_s`, or raise `max_wait_s`"
    )


def _stretches(log: Log) -> Iterator[Stretch]:
    """Yield the parts between the long gaps of the IMU."""
    t_ns, sampling_ns = log.imu.t_ns, log.imu.sampling_ns
    long = log.imu.gaps_ns > np.maximum(LONGEST_GAP_S * 1e9, LONGEST_GAP_SAMPLES * sampling_ns)
    firsts = [0, *np.flatnonzero(long).tolist(), len(t_ns)]
    for first, end in pairwise(firsts):
        yield Stretch(int(t_ns[first] - sampling_ns[first]), int(t_ns[max(end - 2, first)]))


def _usable(stretches: Sequence[Stretch], window_s: float) -> list[Stretch]:
    """Return those long enough for a start; short ones at whose end a run would end only if there are no others."""
    long = [stretch for stretch in stretches if stretch.length_s >= window_s]
    behind_ns = dict(zip(stretches, [following.start_ns for following in stretches[1:]], strict=False))

    def goes_on(stretch: Stretch) -> bool:
        gap_ns = behind_ns.get(stretch, stretch.last_ns) - stretch.last_ns
        return stretch.length_s > PATIENCE_S or gap_ns <= LONGEST_BRIDGED_S * 1e9

    return [stretch for stretch in long if goes_on(stretch)] or long


def _start_in(log: Log, stretch: Stretch, left_s: float, window_s: float) -> InitialState | None:
    """Return the first start in a stretch; None if what it waits for comes after the stretch.

    Raises:
        DatasetError: what it waits for comes more than left_s after the stretch's start.
    """
    start_ns, last_ns = stretch
    spoke = _first_spoke(log, start_ns)
    rest = _at_rest(log, stretch, window_s)
    if rest is not None and (rest.heading == "sensor" or not _may_know_heading(log, spoke)):
        return rest
    limit_ns = start_ns + round(left_s * 1e9)
    ready_ns = max([start_ns + round(window_s * 1e9), *spoke.values()])
    tried = None
    if len(spoke) < len(AWAITED) or ready_ns > start_ns + PATIENCE_S * 1e9:
        tried, is_known = _by_gps(log, stretch, spoke, limit_ns, window_s)
        if is_known:
            return tried
    if ready_ns > limit_ns:
        raise DatasetError(_too_late(log, spoke, limit_ns))
    if ready_ns > last_ns:
        return None
    if tried is not None and "dvl" not in spoke and (tried.heading == "sensor" or "heading" not in spoke):
        return tried
    end_ns = _sample_at(log, ready_ns)
    begin_ns = _begin(stretch, end_ns)
    still = rest is not None and is_at_rest(log, begin_ns, end_ns)
    found = InitialState(log, begin_ns, end_ns, window_s, at_rest=still)
    return rest if rest is not None and found.heading == "unknown" else found


def _first_spoke(log: Log, start_ns: int) -> dict[str, int]:
    """Return when the first reading after start_ns was received, of each sensor of AWAITED that has any."""
    end_ns = int(log.imu.t_ns[-1])
    rows = {sensor: heard(log.streams.get(sensor), start_ns, end_ns) for sensor in AWAITED}
    return {sensor: int(log.streams[sensor].received_ns[n].min()) for sensor, n in rows.items() if len(n)}


def _may_know_heading(log: Log, spoke: Mapping[str, int]) -> bool:
    """Return whether a heading sensor, or the DVL and GPS together, may ever tell the heading."""
    return "heading" in spoke or ("dvl" in spoke and log.gps is not None)


def _at_rest(log: Log, stretch: Stretch, window_s: float) -> InitialState | None:
    """Return the start at rest; None if the vehicle moves in its first window_s."""
    start_ns, last_ns = stretch
    still_s = rest_s(log, start_ns, min(max(PATIENCE_S, window_s), stretch.length_s))
    if still_s < window_s:
        return None
    end_ns = min(_sample_at(log, start_ns + round(still_s * 1e9)), last_ns)
    return InitialState(log, start_ns, end_ns, still_s, at_rest=True)


def _by_gps(
    log: Log, stretch: Stretch, spoke: Mapping[str, int], limit_ns: int, window_s: float
) -> tuple[InitialState | None, bool]:
    """Return the start once GPS gives what slow or absent sensors do not; else the last one tried, and False."""
    early_ns = stretch.start_ns + round(PATIENCE_S * 1e9)
    early = [t_ns for t_ns in spoke.values() if t_ns <= early_ns]
    until_ns = max([early_ns, *spoke.values()])
    if "dvl" in spoke and "heading" not in spoke:  # only GPS tells the heading
        until_ns = limit_ns
    until_ns = min(until_ns, limit_ns, stretch.last_ns)
    found = None
    for end_ns in _fixes(log, stretch, max([stretch.start_ns + round(window_s * 1e9), *early]), until_ns):
        heard_by_now = {sensor for sensor, t_ns in spoke.items() if t_ns <= end_ns}
        aligns = heard_by_now == {"dvl"}
        found = InitialState(log, _begin(stretch, end_ns), end_ns, window_s, heading_by_gps=aligns)
        has_velocity = "dvl" in heard_by_now or found.belief.P[VELOCITY, VELOCITY].diagonal()[:2].max() < WAY_M_S**2
        has_heading = found.yaw_sigma < ALIGNED_RAD if aligns else found.heading == "sensor"
        if has_velocity and (has_heading or not _may_know_heading(log, spoke)):
            return found, True
    return found, False


def _too_late(log: Log, spoke: Mapping[str, int], limit_ns: int) -> str:
    """Return which sensor is waited for too long, and what to do."""
    first_ns = log.imu.start_ns
    late = [f"{s} at {(t_ns - first_ns) * 1e-9:.1f} s" for s, t_ns in spoke.items() if t_ns > limit_ns]
    return (
        f"{log.name}: no start: the first reading of {' and of '.join(late)} comes after max_wait_s "
        f"({(limit_ns - first_ns) * 1e-9:g} s); raise `max_wait_s`, begin later by `from_s`, or leave that stream out"
    )


def _told(log: Log, stretch: Stretch, state: InitialState) -> Initialisation:
    """Return the start with its notes."""
    first_ns, patience_ns = log.imu.start_ns, PATIENCE_S * 1e9
    notes, unusual = list(state.notes), ""
    if state.heading != "sensor":
        unusual += f", heading {state.heading}"
    if not state.knows_velocity:
        unusual += ", velocity unknown"
    if stretch.start_ns > first_ns:
        before, away_s = int(np.count_nonzero(log.imu.t_ns <= stretch.start_ns)), (stretch.start_ns - first_ns) * 1e-9
        text = (
            f"the start lies behind a gap of the IMU, {away_s:.2f} s after the first sample: {before} samples left out"
        )
        notes.append(Note(text, "start", "imu", before, len(log.imu.t_ns), away_s))
    spoke = _first_spoke(log, stretch.start_ns)
    slow = [s for s, t_ns in spoke.items() if stretch.start_ns + patience_ns < t_ns <= state.belief.t_ns]
    for sensor in slow:
        waited_s = (spoke[sensor] - stretch.start_ns) * 1e-9
        text = f"the start waited {waited_s:.1f} s for the first reading of {sensor}"
        notes.append(Note(text, "start", sensor, seconds=waited_s))
    if slow or stretch.start_ns > first_ns:
        unusual += ", begun late"
    return Initialisation(state.belief, ("static" if state.at_rest else "moving") + unusual, tuple(notes))


def _begin(stretch: Stretch, end_ns: int) -> int:
    """Return where the window begins that ends at end_ns."""
    return max(stretch.start_ns, end_ns - round(LONGEST_WINDOW_S * 1e9))


def _sample_at(log: Log, t_ns: int) -> int:
    """Return the time of the sample that covers t_ns; there is always one after it."""
    at = int(np.searchsorted(log.imu.t_ns, t_ns))
    return int(log.imu.t_ns[min(at, max(len(log.imu.t_ns) - 2, 0))])


def _fixes(log: Log, stretch: Stretch, after_ns: int, until_ns: int) -> Iterator[int]:
    """Yield the times at which to check whether GPS suffices: at a fix, then when the window is a tenth longer."""
    if log.gps is None:
        return
    next_ns = after_ns
    for received_ns in np.sort(log.gps.received_ns).tolist():
        if next_ns < received_ns <= until_ns:
            yield _sample_at(log, received_ns)
            next_ns = received_ns + (received_ns - stretch.start_ns) // 10
