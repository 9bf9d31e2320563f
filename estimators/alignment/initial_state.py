"""The state at the end of a log's first seconds, by least squares over all readings in them.

Unknown, at the end E of the window: the velocity u of the IMU and gravity γ, both in B; the biases b_a and
b_g; the yaw; the position of B; and, where no DVL measures u, the velocity of B in W. The level is the direction of −γ.
With Φ, R_EB and u(t) of `window`, the rows are

    DVL at t            R_EB(t)ᵀ u(t) − ω × p_BI_B                          v_WB_B
    constant velocity   the velocity in B at the start of the window equals that at its end
    at rest             u(t) at both ends is zero, and the mean of the gyro is b_g
    heading sensor      yaw and the azimuth of R_EB R_BH e_x by the level   ψ
    GPS at t            p + R_WB (D(t) + R_EB(t) p_BG_B)                    p_WG_W
    depth               p · e_z and the lever arm                           z

with D(t) the position of B relative to the end, by gyro and DVL. So the errors of all parts are correlated as they
should be: biases with the tilt that they cause, yaw with the velocity and the position that it rotates.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ...datasets.log import AttitudeStream, Log
from ...datasets.notes import Note
from ...datasets.rig import EARTH_RATE_RAD_S
from ...datasets.state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array, Belief, NavState, TimeArray
from ..physics.so3 import skew
from .rest import REST_M_S, mean_velocity
from .window import Window

MOTION_M_S2 = 0.1
"""Sigma of the vehicle's own mean acceleration in B over the window: where no sensor measures it, it appears
as tilt."""
HEADING_FLOOR_RAD = np.radians(1.0)
"""Least sigma of a heading or an attitude by sensor: its errors do not average out over a window."""
UNKNOWN_HEADING_RAD = np.pi / np.sqrt(3)
"""Standard deviation of a heading that is equally likely in every direction."""
SLIP_RAD = 0.05
"""Sigma of the drift angle of a vehicle whose sideways velocity is not measured."""
UNKNOWN_SPEED_M_S, FASTEST_M_S = 1.5, 30.0
"""Sigma of an unknown velocity; and of one from fixes, of a ship or a car as well."""
SILENCE_S = 2.0
"""A DVL's first velocity is taken as that of so long before it, and its last as that of so long after."""
LONGEST_LOST_S = 60.0
"""A longer gap before the start counts as this long: it is more likely a wrong stamp than a voyage."""
ORIGIN_SIGMA_M = 0.5
"""Sigma of the vehicle's position at the start of the log relative to W's origin."""
UNKNOWN_DEPTH_M = 5.0
"""Sigma of the depth at the start without a depth sensor: a log begins near the surface."""
NEWEST = 3
"""Number of readings to wait for; errors of depth are correlated for longer, so the median of so many counts as one."""
OUTLIER_SIGMAS, OUTLIER_M_S = 6.0, 0.3
"""A DVL reading further than both from the median of the five about it is left out."""
LEAST_ACCEL_BIAS, LEAST_GYRO_BIAS = 1e-6, 1e-9
"""m/s² and rad/s: a covariance is positive even for a perfect IMU."""

# the unknowns
SPEED, GRAVITY, ACCEL, GYRO = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
YAW, PLACE, WAY = 12, slice(13, 16), slice(16, 19)
UNKNOWNS = 19
ITERATIONS = 4
"""How often the rows of heading, position and height are relinearised."""
EACH = np.eye(UNKNOWNS)
LEVI_CIVITA = skew(np.eye(3)).transpose(1, 0, 2) * -1.0
"""ε_ijk, (3, 3, 3)."""


@dataclass
class Rows:
    """Linear equations H x = z ± sigma of the unknowns; rows without a finite sigma are left out."""

    H: list[Array] = field(default_factory=list)
    z: list[Array] = field(default_factory=list)
    sigma: list[Array] = field(default_factory=list)

    def add(self, H: Array, z: Array, sigma: Array | float, about: Array | None = None) -> None:
        """Add equations.

        Args:
            H: (m, 19).
            z: (m,), or what is left of it `about` the unknowns (19,) at which equations were linearised.
            sigma: (m,) or one for all.
            about: (19,).
        """
        sigma = np.broadcast_to(sigma, len(z))
        measured = np.isfinite(sigma)
        self.H.append(H[measured])
        self.z.append((z if about is None else z + H @ about)[measured])
        self.sigma.append(sigma[measured])

    def solve(self) -> tuple[Array, Array]:
        """Return the unknowns and their covariance."""
        sigma = np.concatenate(self.sigma)
        A = np.concatenate(self.H) / sigma[:, None]
        scale = np.linalg.norm(A, axis=0)
        Q, R = np.linalg.qr(A / scale)
        root = np.linalg.inv(R) / scale[:, None]
        return root @ (Q.T @ (np.concatenate(self.z) / sigma)), root @ root.T


class InitialState:
    """The belief at the end of a window, and how it was found.

    Args:
        log: its truth and its prior are not used.
        start_ns, end_ns: the part of the log that is used; both are times of IMU samples.
        level_s: length of its last part, from which level and velocity are estimated; extended to hold three readings
            of the DVL. Over a longer part the gyro's noise would tilt them.
        at_rest: the vehicle does not move in it.
        heading_by_gps: the yaw is found by fitting the track to the fixes.

    Attributes:
        belief: at end_ns.
        heading: its source: "sensor", "by GPS", "unknown".
        knows_velocity: it is measured, or the vehicle rests.
        yaw_sigma: rad.
        notes: sentences on how each part was found.
    """

    def __init__(
        self,
        log: Log,
        start_ns: int,
        end_ns: int,
        level_s: float,
        *,
        at_rest: bool = False,
        heading_by_gps: bool = False,
    ) -> None:
        self.at_rest = at_rest
        self._log, self._rig, self._noise = log, log.rig, log.rig.imu_noise
        self._whole = Window.of(log, start_ns, end_ns, at_rest=at_rest)
        self._headings, self._dvl = self._whole.heard(log.heading), self._likely_dvl()
        level_ns = end_ns - round(level_s * 1e9)
        if log.dvl is not None and len(self._dvl):
            level_ns = min(level_ns, int(log.dvl.t_ns[self._dvl[-NEWEST:]].min()) - 1)
        self._window = self._whole if at_rest or level_ns <= start_ns else Window.of(log, level_ns, end_ns)
        self.heading = "by GPS" if heading_by_gps else "sensor" if len(self._headings) else "unknown"
        self._knows_speed = at_rest or len(self._dvl) > 0
        fixes, depths = self._whole.heard(log.gps), self._window.heard(log.depth)
        self._fixes = fixes if heading_by_gps or not self._knows_speed else fixes[-1:]
        self._depths = depths[-NEWEST:] if self._knows_speed else depths
        self.knows_velocity = self._knows_speed or len(self._fixes) > 1
        self._silent_s = self._without_dvl()
        self._level, self._up = np.eye(3), np.array([0.0, 0.0, 1.0])
        self._way, self._way_by_gyro = self._ways()
        self._levelled_by = 0  # readings of the DVL
        self._stretch = 1.0  # of the sigma of GPS
        self.belief, cov = self._solve()
        self.yaw_sigma, self.notes = float(np.sqrt(cov[YAW, YAW])), self._notes(cov)

    def _solve(self) -> tuple[Belief, Array]:
        linear = Rows()
        self._know_biases(linear)
        if self.at_rest:
            self._know_rest(linear)
        else:
            self._know_motion(linear)
        x = self._solved(linear, None)[0]
        self._level, self._up = level(x[GRAVITY]), up(x[GRAVITY])
        if self.heading == "by GPS":
            x[YAW] = self._first_yaw(x)
        elif self.heading == "sensor" and isinstance(self._log.heading, AttitudeStream):
            x[YAW] = self._yaw_of(self._log.heading, x)
        x, cov = self._iterated(linear, x)
        if self.heading == "by GPS":
            self._stretch = self._misfit(x)
            x, cov = self._iterated(linear, x)
            if not self._measured[1]:
                cov[YAW, YAW] += SLIP_RAD**2
        return self._as_belief(x, cov), cov

    def _iterated(self, linear: Rows, x: Array) -> tuple[Array, Array]:
        """Return the unknowns and their covariance; only rotations are not linear, and only the yaw may be far off."""
        cov = np.eye(UNKNOWNS)
        for _ in range(ITERATIONS):
            x, cov = self._solved(linear, x)
        return x, cov

    def _solved(self, linear: Rows, x: Array | None) -> tuple[Array, Array]:
        """Solve the linear rows and, if x is given, those of heading and position linearised at x."""
        rows = Rows([*linear.H], [*linear.z], [*linear.sigma])
        if x is None:
            rows.add(EACH[YAW:], np.zeros(UNKNOWNS - YAW), 1.0)
        else:
            self._know_heading(rows, x)
            self._know_place(rows, x)
            self._know_height(rows, x)
            ahead = FASTEST_M_S if len(self._fixes) > 1 else UNKNOWN_SPEED_M_S
            rows.add(EACH[WAY], np.zeros(3), np.array([ahead, ahead, UNKNOWN_SPEED_M_S]))
        return rows.solve()

    # --- level, velocity, biases -------------------------------------------------------------------------------------

    def _know_biases(self, rows: Rows) -> None:
        rows.add(EACH[ACCEL], np.zeros(3), max(self._noise.accel_bias_sigma, LEAST_ACCEL_BIAS))
        rows.add(EACH[GYRO], np.zeros(3), max(self._noise.gyro_bias_sigma, LEAST_GYRO_BIAS))

    def _velocity_at(self, k: int, nominal_B: Array) -> tuple[Array, Array]:
        """Return H (3, 19) and constant (3,) of the velocity of the IMU at time k of the window, in B at that time."""
        w, R, left_s = self._window, self._window.R_EB[k].T, self._window.left_s[k]
        u_E = w.R_EB[k] @ nominal_B
        H = np.zeros((3, UNKNOWNS))
        H[:, SPEED], H[:, GRAVITY], H[:, ACCEL] = R, -left_s * R, R @ w.held[k]
        H[:, GYRO] = R @ (skew(u_E) @ w.turn[k] - w.push_bg[k])
        return H, -R @ w.push[k]

    def _know_motion(self, rows: Rows) -> None:
        """Add the readings of the DVL, and that the velocity in B stays constant."""
        w, lever_B, log = self._window, self._rig.imu.p_BS_B, self._log
        nominal, since = np.zeros(3), []
        if log.dvl is not None:
            since = self._dvl[log.dvl.t_ns[self._dvl] > w.t_ns[0]].tolist()
            for row, k in zip(since, w.moments(log.dvl.t_ns[since]), strict=True):
                measured = np.isfinite(log.dvl.sigma[row])
                of_lever = skew(w.w_WB_B[k]) @ lever_B
                nominal = np.where(measured, log.dvl.z[row], 0.0)
                H, constant = self._velocity_at(k, nominal + of_lever)
                drift = self._noise.accel_density * np.sqrt(w.left_s[k])
                rows.add(H, log.dvl.z[row] + of_lever - constant, np.hypot(log.dvl.sigma[row], drift))
        self._levelled_by = len(since)
        rows.add(EACH[SPEED], skew(w.w_WB_B[-1]) @ lever_B, UNKNOWN_SPEED_M_S)
        H, constant = self._velocity_at(0, nominal)
        H[:, SPEED] -= np.eye(3)
        of_lever = skew(w.w_WB_B[0]) @ lever_B - skew(w.w_WB_B[-1]) @ lever_B
        drift = self._noise.accel_density * np.sqrt(w.length_s)
        rows.add(H, of_lever - constant, np.hypot(MOTION_M_S2 * w.length_s, drift))

    def _know_rest(self, rows: Rows) -> None:
        """Add that the velocity is zero at both ends of the window, and that the mean of the gyro is its bias."""
        w, velocity = self._window, mean_velocity(self._log, int(self._window.t_ns[0]), int(self._window.t_ns[-1]))
        assert velocity is not None
        still = np.hypot(REST_M_S, velocity[1].max())
        rows.add(EACH[SPEED], np.zeros(3), still)
        H, constant = self._velocity_at(0, np.zeros(3))
        rows.add(H, -constant, np.hypot(still, self._noise.accel_density * np.sqrt(w.length_s)))
        t_ns = self._log.imu.t_ns
        w_WI_I = self._log.imu.w_WI_I[(t_ns > w.t_ns[0]) & (t_ns <= w.t_ns[-1])].mean(axis=0)
        white = self._noise.gyro_density / np.sqrt(w.length_s)
        rows.add(EACH[GYRO], w_WI_I, np.hypot(white, EARTH_RATE_RAD_S))

    @property
    def _measured(self) -> list[bool]:
        """Return which of the three axes of the velocity in B are measured by any reading."""
        dvl = self._log.dvl
        return [dvl is not None and bool(np.isfinite(dvl.sigma[self._dvl, axis]).any()) for axis in range(3)]

    def _likely_dvl(self) -> TimeArray:
        """Return the rows of the DVL that are not outliers."""
        rows = self._whole.heard(self._log.dvl)
        if self._log.dvl is None or len(rows) < 3:
            return rows
        z, sigma = self._log.dvl.z[rows], self._log.dvl.sigma[rows]
        off = np.abs(z - median_filter(z, size=(5, 1), mode="nearest"))
        return rows[(off <= np.maximum(OUTLIER_SIGMAS * sigma, OUTLIER_M_S)).all(axis=1)]

    # --- heading -----------------------------------------------------------------------------------------------------

    def _know_heading(self, rows: Rows, x: Array) -> None:
        if self.heading == "by GPS":
            return
        if self.heading == "unknown":
            rows.add(EACH[YAW : YAW + 1], np.zeros(1), UNKNOWN_HEADING_RAD)
            return
        heading, w = self._log.heading, self._whole
        assert heading is not None
        if isinstance(heading, AttitudeStream):
            self._know_attitude(rows, heading, x)
            return
        psi, sigma = heading.psi[self._headings], np.nanmin(heading.sigma[self._headings], axis=1)
        k = w.moments(heading.t_ns[self._headings])
        R_level = self._levelled(x)
        a_E = w.R_EB[k] @ self._rig.heading.R_BS[:, 0]
        h = a_E @ R_level.T
        left = psi - np.arctan2(h[:, 1], h[:, 0]) - x[YAW]
        # a rotation ρ of B in E axes moves the azimuth of h by e_z × h / |h_xy|² · R_level (ρ × a)
        across = np.stack([-h[:, 1], h[:, 0], np.zeros(len(h))], axis=1)
        across /= np.maximum(h[:, 0] ** 2 + h[:, 1] ** 2, 1e-3)[:, None]
        by_turn = np.cross(a_E, across @ R_level)
        by_gyro = np.einsum("ni,nij->j", by_turn, w.turn[k]) / len(k)
        total = min(float(np.hypot(np.sqrt(np.mean(sigma**2)), HEADING_FLOOR_RAD)), UNKNOWN_HEADING_RAD)
        H = np.zeros((1, UNKNOWNS))
        H[0, YAW], H[0, GRAVITY], H[0, GYRO] = 1.0, by_turn.mean(axis=0) @ tilt_by_gravity(x[GRAVITY]), by_gyro
        mean = np.arctan2(np.sin(left).mean(), np.cos(left).mean())
        rows.add(H, np.array([mean]), total, x)

    def _know_attitude(self, rows: Rows, attitude: AttitudeStream, x: Array) -> None:
        """Add the mean of the attitudes, about each axis of B that any of them measures."""
        k, sigma = self._whole.moments(attitude.t_ns[self._headings]), attitude.sigma[self._headings]
        R_EB = self._whole.R_EB[k]
        R_WB = attitude.z[self._headings].reshape(-1, 3, 3) @ np.asarray(self._rig.heading.R_BS).T
        missed = Rotation.from_matrix(R_WB.transpose(0, 2, 1) @ self._attitude(x) @ R_EB).as_rotvec()
        by_turn = R_EB.transpose(0, 2, 1)
        measured = np.isfinite(sigma)
        share = measured / np.maximum(measured.sum(axis=0), 1)  # of each reading in the mean about each axis
        H = np.zeros((3, UNKNOWNS))
        mean_turn = np.einsum("ni,nij->ij", share, by_turn)
        H[:, GRAVITY], H[:, YAW] = mean_turn @ tilt_by_gravity(x[GRAVITY]), mean_turn @ up(x[GRAVITY])
        H[:, GYRO] = np.einsum("ni,nij,njk->ik", share, by_turn, self._whole.turn[k])
        square = np.einsum("ni,ni->i", share, np.where(measured, sigma, 0.0) ** 2)
        total = np.where(measured.any(axis=0), np.hypot(np.sqrt(square), HEADING_FLOOR_RAD), np.inf)
        rows.add(H, -np.einsum("ni,ni->i", share, missed), total, x)

    def _yaw_of(self, attitude: AttitudeStream, x: Array) -> float:
        """Return the yaw at which the attitudes fit best."""
        R_EB = self._whole.R_EB[self._whole.moments(attitude.t_ns[self._headings])]
        R_WB = attitude.z[self._headings].reshape(-1, 3, 3) @ np.asarray(self._rig.heading.R_BS).T
        M = np.einsum("nij,nkj->ik", R_WB, self._levelled(x) @ R_EB)
        return float(np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1]))

    # --- position and path --------------------------------------------------------------------------------------------

    def _ways(self) -> tuple[Array, Array]:
        """Return the position of B relative to its last one, in E axes (n, 3), and its derivative by the gyro bias.

        Where no velocity is known, (n, 3, 3): by the velocity in B, taken as constant.
        """
        w, dvl = self._whole, self._log.dvl
        if not self._knows_speed:
            return np.stack([w.way(np.broadcast_to(e, (len(w.t_ns), 3)))[0] for e in np.eye(3)], axis=2), np.zeros(0)
        v_B = np.zeros((len(w.t_ns), 3))  # an axis that is not measured does not move
        if not self.at_rest and dvl is not None:
            for axis in range(3):
                rows = self._dvl[np.isfinite(dvl.sigma[self._dvl, axis])]
                if len(rows):
                    t_s = w.length_s - w.left_s
                    v_B[:, axis] = np.interp(t_s, t_s[w.moments(dvl.t_ns[rows])], dvl.z[rows, axis])
        return w.way(v_B)

    def _without_dvl(self) -> Array:
        """Return how long no DVL is heard between each time and the end, before its first and after its last, (n,) s.

        SILENCE_S is not counted.
        """
        w, dvl = self._whole, self._log.dvl
        if self.at_rest or dvl is None or not len(self._dvl):
            return np.zeros(len(w.t_ns))
        first_ns, last_ns = dvl.t_ns[self._dvl[[0, -1]]]
        silent_ns = np.maximum(first_ns - w.t_ns, 0) + (w.t_ns[-1] - np.maximum(w.t_ns, last_ns))
        return np.asarray(np.maximum(silent_ns * 1e-9 - SILENCE_S, 0.0))

    @property
    def _lost_s(self) -> float:
        """How long of the log's beginning lies before the window, s."""
        t_ns, start_ns = self._log.imu.t_ns, self._whole.t_ns[:1]
        before_s = np.diff(np.concatenate([t_ns[t_ns < start_ns[0]], start_ns])) * 1e-9
        return float(np.minimum(before_s, LONGEST_LOST_S).sum())

    def _point(self, x: Array, k: int, lever_B: Array) -> tuple[Array, Array]:
        """Return H (3, 19) and position (3,) in W of a point of the body at time k."""
        R_WE, lever_E = self._attitude(x), self._whole.R_EB[k] @ lever_B
        H = np.zeros((3, UNKNOWNS))
        by_gyro = -skew(lever_E) @ self._whole.turn[k]
        if self._knows_speed:
            turned_E = q = self._way[k] + lever_E
            by_gyro = by_gyro + self._way_by_gyro[k]
        else:
            turned_E, q = lever_E, self._way[k] @ R_WE.T @ x[WAY] + lever_E  # the path is in W
            H[:, WAY] = R_WE @ self._way[k] @ R_WE.T
        H[:, PLACE], H[:, GYRO] = np.eye(3), R_WE @ by_gyro
        by_turn = -R_WE @ skew(turned_E)
        H[:, GRAVITY], H[:, YAW] = by_turn @ tilt_by_gravity(x[GRAVITY]), by_turn @ up(x[GRAVITY])
        return H, x[PLACE] + R_WE @ q

    def _drift_m(self, k: int) -> float:
        """Return the sigma, m, of the path from time k to the end."""
        left_s, dvl = float(self._whole.left_s[k]), self._log.dvl
        if self.at_rest:
            return REST_M_S * left_s
        if not self._knows_speed or dvl is None:
            return 0.5 * MOTION_M_S2 * left_s**2
        sigma, silent_s = dvl.sigma[self._dvl], float(self._silent_s[k])
        between_s = self._whole.length_s / len(self._dvl)
        heard_m = float(np.median(sigma[np.isfinite(sigma)])) * np.sqrt(left_s * max(between_s, min(left_s, 1.0)))
        strayed_m = MOTION_M_S2 * np.sqrt(SILENCE_S * silent_s**3 / 3)  # a new acceleration every SILENCE_S
        return float(np.hypot(heard_m, min(strayed_m, UNKNOWN_SPEED_M_S * silent_s)))

    def _know_place(self, rows: Rows, x: Array) -> None:
        """Add the fixes: the last one if velocity and heading are known, else all; without fixes, W's origin."""
        gps = self._log.gps
        if gps is not None and len(self._fixes):
            for row, k in zip(self._fixes, self._whole.moments(gps.t_ns[self._fixes]).tolist(), strict=True):
                H, p = self._point(x, k, self._rig.gps.p_BS_B)
                rows.add(H, gps.z[row] - p, np.hypot(self._stretch * gps.sigma[row], self._drift_m(k)), x)
        else:
            H, p = self._point(x, 0, np.zeros(3))
            start_m = np.hypot(ORIGIN_SIGMA_M, UNKNOWN_SPEED_M_S * self._lost_s)
            rows.add(H, -p, np.hypot([start_m, start_m, np.inf], self._drift_m(0)), x)

    @property
    def _height_by_gps(self) -> bool:
        gps = self._log.gps
        return gps is not None and bool(np.isfinite(gps.sigma[self._fixes, 2]).any())

    def _know_height(self, rows: Rows, x: Array) -> None:
        """Add the median of the newest depths as one reading; or each depth, where the vertical path is unknown."""
        depth, parts, left = self._log.depth, [], []
        if depth is None or not len(self._depths):
            if not self._height_by_gps:
                rows.add(EACH[PLACE], np.zeros(3), np.array([np.inf, np.inf, UNKNOWN_DEPTH_M]))
            return
        moments = self._whole.moments(depth.t_ns[self._depths]).tolist()
        for row, k in zip(self._depths, moments, strict=True):
            H, p = self._point(x, k, self._rig.depth.p_BS_B)
            parts.append(H[2:])
            left.append(depth.z[row] - p[2:])
        sigma = np.hypot(depth.sigma[self._depths, 0], [self._drift_m(k) for k in moments])
        if self._knows_speed:
            rows.add(parts[-1], np.median(left, axis=0), float(np.median(sigma)), x)
            return
        for k in range(len(left)):
            rows.add(parts[k], left[k], sigma[k], x)

    # --- heading by GPS ----------------------------------------------------------------------------------------------

    def _antenna(self, x: Array) -> tuple[Array, Array, Array]:
        """Return the antenna's positions by the track and by the fixes, (n, 2) m, and the sigma of the latter."""
        gps = self._log.gps
        assert gps is not None
        moments = self._whole.moments(gps.t_ns[self._fixes]).tolist()
        p = np.array([self._point(x, k, self._rig.gps.p_BS_B)[1][:2] for k in moments])
        drift = np.array([self._drift_m(k) for k in moments])
        return p, gps.z[self._fixes, :2], np.hypot(gps.sigma[self._fixes, :2].max(axis=1), drift)

    def _first_yaw(self, x: Array) -> float:
        """Return the yaw that fits the antenna's track to the fixes, in the plane."""
        p, z, sigma = self._antenna(x)
        track, fixes = (xy[:, 0] + 1j * xy[:, 1] for xy in (p, z))
        weight = sigma**-2 / np.sum(sigma**-2)
        product = np.conj(track - weight @ track) * (fixes - weight @ fixes)
        return float(x[YAW] + np.angle(weight @ product))

    def _misfit(self, x: Array) -> float:
        """Return the factor by which the residuals of the fixes exceed their sigma; 1 where chance may explain it."""
        p, z, sigma = self._antenna(x)
        total, dof = float(np.sum((p - z) ** 2 / sigma[:, None] ** 2)), 2 * len(p) - 3
        return float(np.sqrt(total / dof)) if dof > 0 and total > chi2.ppf(0.99, dof) else 1.0

    # --- the result ----------------------------------------------------------------------------------------------

    def _levelled(self, x: Array) -> Array:
        """Return R_WB (3, 3) at the end, less its yaw: the first level, turned by the least that fits gravity.

        So a change of gravity never turns the yaw, nose up or down either.
        """
        a, b = up(x[GRAVITY]), self._up
        S = skew(np.cross(a, b))
        return np.asarray(self._level @ (np.eye(3) + S + S @ S / (1.0 + a @ b)))

    def _attitude(self, x: Array) -> Array:
        """Return R_WB (3, 3) at the end."""
        return np.asarray(Rotation.from_euler("Z", x[YAW]).as_matrix() @ self._levelled(x))

    def _as_belief(self, x: Array, cov: Array) -> Belief:
        R_WB, w, A = self._attitude(x), self._window, np.zeros((DIM, UNKNOWNS))
        A[THETA, GRAVITY], A[THETA, YAW] = tilt_by_gravity(x[GRAVITY]), up(x[GRAVITY])
        A[POSITION, PLACE] = A[ACCEL_BIAS, ACCEL] = A[GYRO_BIAS, GYRO] = np.eye(3)
        if self._knows_speed:
            v_B = x[SPEED] - skew(w.w_WB_B[-1]) @ self._rig.imu.p_BS_B
            v_WB_W = R_WB @ v_B
            A[VELOCITY] = -R_WB @ skew(v_B) @ A[THETA]
            A[VELOCITY, SPEED] += R_WB
            bent = R_WB @ second_order(v_B, cov[SPEED, SPEED], A[THETA] @ cov @ A[THETA].T) @ R_WB.T
        else:
            v_WB_W, bent = x[WAY], np.zeros((3, 3))
            A[VELOCITY, WAY] = np.eye(3)
        P = A @ cov @ A.T
        P[VELOCITY, VELOCITY] += bent
        P = 0.5 * (P + P.T) + np.diag(np.repeat([1e-10, 0.0, 0.0, 0.0, 0.0], 3))
        state = NavState(R_WB, x[PLACE], v_WB_W, x[ACCEL], x[GYRO])
        return Belief(int(w.t_ns[-1]), state, P)

    def _notes(self, cov: Array) -> list[str]:
        """Return sentences on how each part was found."""
        samples, fixes, depths = len(self._window.t_ns) - 1, len(self._fixes), len(self._depths)
        sigma_deg, length_s = np.degrees(np.sqrt(cov[YAW, YAW])), self._whole.length_s
        seen = f" and {self._levelled_by} DVL readings" if self._levelled_by else ""
        notes = [
            f"moving: prior at {length_s:.2f} s; level from {samples} accelerometer samples{seen}, turned by the gyro"
        ]
        if self.at_rest:
            notes = [f"static: prior at {length_s:.2f} s, all at rest; level from {samples} accelerometer samples"]
            notes += ["gyro bias from its mean at rest; its sigma includes the Earth's rate"]
        if self.heading == "sensor":
            notes += [f"heading from {len(self._headings)} readings, sigma {sigma_deg:.1f} deg (not averaged down)"]
        elif self.heading == "by GPS":
            notes += [f"heading from fitting the track of gyro and DVL to {fixes} fixes, sigma {sigma_deg:.1f} deg"]
        else:
            text = "no readings of a heading sensor, and no track to fit to fixes: heading unknown"
            notes += [Note(text, "start", "heading")]
        if self._stretch > 1.0:
            notes += [f"the residuals of the fixes are {self._stretch:.1f} times their sigma: sigma enlarged"]
        if self.at_rest:
            notes += ["velocity zero, at rest"]
        elif self._knows_speed:
            unmeasured = [axis for axis, there in zip("xyz", self._measured, strict=True) if not there]
            but = f"; {', '.join(unmeasured)} of B not measured: unknown" if unmeasured else ""
            notes += [f"velocity from {self._levelled_by} DVL readings{but}"]
        elif fixes > 1:
            notes += [f"no DVL readings: velocity from {fixes} fixes"]
        else:
            notes += [Note("no DVL readings: velocity unknown, taken as zero", "start", "dvl")]
        if fixes:
            notes += [f"position from {fixes} fixes" if fixes > 1 else "position from the last fix"]
        else:
            notes += ["position zero at the start by definition of W, plus the distance travelled since"]
            if self._lost_s > 0:
                notes += [f"the way of the {self._lost_s:.1f} s before that is not known: sigma enlarged"]
        if depths:
            notes += [f"height from {depths} depth readings"]
        elif not self._height_by_gps:
            notes += ["no depth readings: height unknown"]
        return notes


def up(gravity_B: Array) -> Array:
    """Return the unit vector that points up, in B (3,)."""
    return -gravity_B / np.linalg.norm(gravity_B)


def tilt_by_gravity(gravity_B: Array) -> Array:
    """Return the derivative (3, 3) of theta by gravity in B; the yaw does not depend on it."""
    return skew(up(gravity_B)) / np.linalg.norm(gravity_B)


def second_order(v_B: Array, V: Array, T: Array) -> Array:
    """Return the covariance (3, 3), in B, of the second-order terms of the velocity exp(θ) (v + e) in W.

    With e of covariance V and θ of T: that of θ × e, and of θ × (θ × v) / 2, which for a heading known to 5° changes
    the velocity by more than a good DVL's noise. A rotation changes it by twice the velocity at most.
    """
    crossed = np.einsum("ijk,lmn,jm,kn->il", LEVI_CIVITA, LEVI_CIVITA, T, V)
    # E a aᵀ of a = θ (θ·v) − v (θ·θ), by the fourth moments of a normal θ
    Tv, vTv, trace, square = T @ v_B, v_B @ T @ v_B, np.trace(T), np.trace(T @ T)
    along = vTv * T + 2 * np.outer(Tv, Tv)
    mixed = np.outer(trace * Tv + 2 * T @ Tv, v_B)
    bent = 0.25 * (along - mixed - mixed.T + (trace**2 + 2 * square) * np.outer(v_B, v_B))
    return crossed + bent * min(1.0, 2 * (v_B @ v_B) / max(np.trace(bent), 1e-12))


def level(gravity_B: Array) -> Array:
    """Return R_WB (3, 3) of yaw zero."""
    x, y, z = up(gravity_B)
    return Rotation.from_euler("ZYX", [0.0, np.arctan2(-x, np.hypot(y, z)), np.arctan2(y, z)]).as_matrix()
