"""The initial belief of a log, estimated from its first seconds.

Biases are known by their turn-on sigmas. Level comes from the accelerometers, which measure the change of velocity
(known from the DVL) less gravity. Heading comes from the heading sensor; without one, from fitting the track of gyro
and DVL to GPS fixes. Position comes from GPS or from the definition of W's origin, height from pressure, velocity from
the DVL or else from GPS. At rest the velocity is zero, and the gyro measures its bias. What no sensor measures gets a
large sigma and a note. The least-squares problem is in `initial_state`.

The belief is at the end of the window (at the IMU sample there), and epochs begin after it, so no reading is used
twice. W's origin is the vehicle's place at the start of the log (for geodetic logs: its first fix at or after the
start). So without GPS the position at the end of the window is the distance travelled since the start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...datasets.log import Log
from ...datasets.state import VELOCITY, Belief
from .initial_state import InitialState
from .rest import rest_s
from .window import heard

ALIGNED_RAD = np.radians(5.0)
"""A heading by GPS is accepted once its sigma is below this."""
WAY_M_S = 0.5
"""A velocity by GPS is accepted once its sigma is below this."""


@dataclass(frozen=True, eq=False)
class Initialisation:
    """A belief, and how it was found.

    Attributes:
        start: "static" or "moving", and after a comma, if unusual: "heading by GPS", "heading unknown".
        notes: sentences on how each part of it was found.
    """

    belief: Belief
    start: str
    notes: tuple[str, ...]


def initialise(log: Log, window_s: float = 2.0, max_wait_s: float = 10.0, max_align_s: float = 60.0) -> Initialisation:
    """Estimate the belief at the end of the log's first seconds.

    Args:
        log: its truth and its prior are not used.
        window_s: least length of the window.
        max_wait_s: the window grows up to this while the vehicle rests; until the heading sensor and the DVL have
            readings; and, without a DVL, until GPS gives the velocity.
        max_align_s: without a heading sensor it grows up to this, until GPS and the DVL give the heading.
    """
    start_ns = int(log.imu.t_ns[0]) - log.imu.period_ns
    still_s = rest_s(log, start_ns, max(max_wait_s, window_s))
    if still_s >= window_s:
        end_ns = _sample_at(log, start_ns + round(still_s * 1e9))
        return _with_notes(InitialState(log, start_ns, end_ns, still_s, at_rest=True))
    end_ns = _end(log, start_ns, window_s, max_wait_s)
    has_dvl, has_heading = (len(heard(stream, start_ns, end_ns)) > 0 for stream in (log.dvl, log.heading))
    if not has_dvl:
        state = InitialState(log, start_ns, end_ns, window_s)
        for later_ns in _fixes(log, end_ns, start_ns + round(max_wait_s * 1e9)):
            state = InitialState(log, start_ns, later_ns, window_s)
            if state.belief.P[VELOCITY, VELOCITY].diagonal()[:2].max() < WAY_M_S**2:
                break
        return _with_notes(state)
    if not has_heading:
        for later_ns in _fixes(log, end_ns, start_ns + round(max_align_s * 1e9)):
            state = InitialState(log, start_ns, later_ns, window_s, heading_by_gps=True)
            if state.yaw_sigma < ALIGNED_RAD:
                return _with_notes(state)
    return _with_notes(InitialState(log, start_ns, end_ns, window_s))


def _with_notes(state: InitialState) -> Initialisation:
    start = "static" if state.at_rest else "moving"
    unusual = "" if state.heading == "sensor" else f", heading {state.heading}"
    return Initialisation(state.belief, start + unusual, tuple(state.notes))


def _end(log: Log, start_ns: int, window_s: float, max_wait_s: float) -> int:
    """Return the IMU sample's time at which the window ends."""
    end_ns = start_ns + round(window_s * 1e9)
    latest_ns = start_ns + round(max(window_s, max_wait_s) * 1e9)
    for stream in (log.heading, log.dvl):
        rows = heard(stream, start_ns, latest_ns)
        if stream is not None and len(rows):
            end_ns = max(end_ns, int(stream.received_ns[rows].min()))
    return _sample_at(log, end_ns)


def _sample_at(log: Log, t_ns: int) -> int:
    """Return the time of the sample that covers t_ns; there is always one after it."""
    at = int(np.searchsorted(log.imu.t_ns, t_ns))
    return int(log.imu.t_ns[min(at, max(len(log.imu.t_ns) - 2, 0))])


def _fixes(log: Log, after_ns: int, until_ns: int) -> Iterator[int]:
    """Yield the times at which to check whether GPS suffices: at a fix, then when the window is a tenth longer."""
    if log.gps is None:
        return
    start_ns = int(log.imu.t_ns[0]) - log.imu.period_ns
    last_ns, next_ns = min(until_ns, int(log.imu.t_ns[-2])), after_ns
    for received_ns in np.sort(log.gps.received_ns).tolist():
        if next_ns < received_ns <= last_ns:
            yield _sample_at(log, received_ns)
            next_ns = received_ns + (received_ns - start_ns) // 10
