"""A trajectory: arrays of states over time, with the look-ahead of the estimator that made them."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .errors import DatasetError
from .files import regular_file
from .notes import Note
from .rotations import TOLERANCE, complaint, is_rotation, note, off_rotation, off_unit, orthonormalised
from .state import DIM, Array, Belief, NavState, TimeArray
from .times import far, far_complaint, seconds_to_ns, times_ns

if TYPE_CHECKING:
    import pandas as pd

COVARIANCE = {(i, j): f"P_{i}_{j}" for i in range(DIM) for j in range(i, DIM)}
"""Columns of a table for the upper triangle of P, by row and column of it."""

COLUMNS = (
    "t_ns",
    *(f"R_WB_{i}{j}" for i in range(3) for j in range(3)),
    *(f"{name}_{axis}" for name in ("p_WB_W", "v_WB_W", "b_a", "b_g") for axis in "xyz"),
    *COVARIANCE.values(),
)
"""Every column that a table of a trajectory may have."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States of B in W over time.

    Attributes:
        t_ns: (n,) increasing.
        R_WB: (n, 3, 3).
        p_WB_W: (n, 3) m.
        v_WB_W: (n, 3) m/s, or None if unknown.
        b_a, b_g: (n, 3) m/s² and rad/s in the IMU's axes, or None.
        P: (n, 15, 15) covariance of the error state, or None; rows of NaN where it was not asked for.
        lookahead_s: how much of the future each state has seen: 0 for a filter, the lag for a fixed-lag smoother,
            infinity for a batch.
        notes: what was mended on reading, one sentence each.
    """

    t_ns: TimeArray
    R_WB: Array
    p_WB_W: Array
    v_WB_W: Array | None = None
    b_a: Array | None = None
    b_g: Array | None = None
    P: Array | None = None
    lookahead_s: float = 0.0
    notes: tuple[Note, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.t_ns)
        shapes = {"R_WB": (n, 3, 3), "p_WB_W": (n, 3), "v_WB_W": (n, 3), "b_a": (n, 3), "b_g": (n, 3), "P": (n, 15, 15)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise DatasetError(f"trajectory: {name} has shape {values.shape}, expected {shape}")
        late = np.flatnonzero(self.t_ns[1:] <= self.t_ns[:-1])
        if len(late):
            row = int(late[0]) + 1
            raise DatasetError(f"trajectory: row {row}: time {self.t_ns[row]} is not after the row above")

    def __len__(self) -> int:
        return len(self.t_ns)

    def with_times_checked(self) -> Trajectory:
        """Return it.

        Raises:
            DatasetError: a time is more than 400 days from the median, as of a clock that was not set.
        """
        bad = np.flatnonzero(far(self.t_ns))
        if len(bad):
            raise DatasetError(f"trajectory: row {bad[0]} ({len(bad)} in all): {far_complaint(self.t_ns, int(bad[0]))}")
        return self

    def select(self, rows: NDArray[np.bool_] | TimeArray | slice) -> Trajectory:
        """Return the rows given by a mask, indices or a slice."""

        def pick(values: Array | None) -> Array | None:
            return None if values is None else values[rows]

        return Trajectory(
            self.t_ns[rows],
            self.R_WB[rows],
            self.p_WB_W[rows],
            pick(self.v_WB_W),
            pick(self.b_a),
            pick(self.b_g),
            pick(self.P),
            self.lookahead_s,
            self.notes,
        )

    def with_rotations(self) -> Trajectory:
        """Return it with the rounding of its decimals taken out of R_WB, which a note tells; rows of NaN are unknown.

        Raises:
            DatasetError: a row is not a rotation.
        """
        known = ~np.isnan(self.R_WB).all(axis=(1, 2))
        off = np.where(known, off_rotation(self.R_WB), 0.0)
        bad = np.flatnonzero(~is_rotation(off))
        if len(bad):
            raise DatasetError(f"trajectory: row {bad[0]} ({len(bad)} in all): R_WB is {complaint(self.R_WB[bad[0]])}")
        return replace(self, R_WB=orthonormalised(self.R_WB, off), notes=(*self.notes, *note("trajectory", off)))

    def state(self, row: int) -> NavState:
        """Return one row as a state; unknown parts are zero."""
        zero = np.zeros(3)
        return NavState(
            self.R_WB[row],
            self.p_WB_W[row],
            zero if self.v_WB_W is None else self.v_WB_W[row],
            zero if self.b_a is None else self.b_a[row],
            zero if self.b_g is None else self.b_g[row],
        )

    @classmethod
    def from_beliefs(cls, beliefs: list[Belief], lookahead_s: float = 0.0) -> Trajectory:
        """Stack beliefs, in time order; P is None if no belief has a covariance."""
        P = np.array([b.P for b in beliefs]).reshape(-1, DIM, DIM)
        return cls(
            np.array([b.t_ns for b in beliefs], dtype=np.int64),
            np.array([b.state.R_WB for b in beliefs]).reshape(-1, 3, 3),
            np.array([b.state.p_WB_W for b in beliefs]).reshape(-1, 3),
            np.array([b.state.v_WB_W for b in beliefs]).reshape(-1, 3),
            np.array([b.state.b_a for b in beliefs]).reshape(-1, 3),
            np.array([b.state.b_g for b in beliefs]).reshape(-1, 3),
            P if np.isfinite(P[:, 0, 0]).any() else None,
            lookahead_s,
        )

    def to_tum(self, path: Path | str) -> None:
        """Write `t x y z qx qy qz qw` lines (TUM format): s, m, quaternion of R_WB; seconds with nine decimals."""
        q_xyzw = Rotation.from_matrix(self.R_WB).as_quat(canonical=True)
        with Path(path).open("w") as file:
            for t_ns, p, q in zip(self.t_ns.tolist(), self.p_WB_W.tolist(), q_xyzw.tolist(), strict=True):
                seconds, rest = divmod(abs(t_ns), 1_000_000_000)
                sign = "-" if t_ns < 0 else ""
                file.write(f"{sign}{seconds}.{rest:09d} " + " ".join(repr(x) for x in (*p, *q)) + "\n")

    @classmethod
    def from_tum(cls, path: Path | str, lookahead_s: float = 0.0, *, quoting: bool = True) -> Trajectory:
        """Read a TUM file; times keep their nanoseconds, and quaternions get the length one.

        Args:
            path: of the file.
            lookahead_s: see the class.
            quoting: whether an error may show a line of the file.

        Raises:
            DatasetError: names the file: it is missing or cannot be read, a row without eight numbers, a quaternion
                more than 1e-3 from unit length, an invalid time, or times out of order.
        """
        path = regular_file(Path(path))
        t_ns, poses = array("q"), array("d")
        try:
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                for number, line in enumerate(file, 1):
                    fields = line.replace(",", " ").split()
                    if not fields or fields[0].startswith("#"):
                        continue
                    try:
                        stamp_ns, pose = _pose(line if quoting else "", fields)
                    except ValueError as error:
                        raise DatasetError(f"{path}: line {number}: {error}") from None
                    t_ns.append(stamp_ns)
                    poses.extend(pose)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
        if not t_ns:
            raise DatasetError(f"{path}: no poses; expected lines of t x y z qx qy qz qw")
        values = np.array(poses).reshape(-1, 7)
        R_WB = Rotation.from_quat(values[:, 3:]).as_matrix()
        try:
            notes = note("trajectory", off_unit(values[:, 3:]))
            times = np.array(t_ns, dtype=np.int64)
            return cls(times, R_WB, values[:, :3], lookahead_s=lookahead_s, notes=notes).with_times_checked()
        except DatasetError as error:
            raise DatasetError(f"{path}: {error}") from None

    def to_columns(self) -> dict[str, Array | TimeArray]:
        """Return arrays (n,): t_ns, R_WB_00.., p_WB_W_x..; where known v, b_a, b_g, and P_0_0.. (j ≥ i)."""
        columns: dict[str, Array | TimeArray] = {"t_ns": self.t_ns}
        for i in range(3):
            for j in range(3):
                columns[f"R_WB_{i}{j}"] = self.R_WB[:, i, j]
        for name in ("p_WB_W", "v_WB_W", "b_a", "b_g"):
            values = getattr(self, name)
            if values is not None:
                columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
        if self.P is not None:
            columns |= {name: self.P[:, i, j] for (i, j), name in COVARIANCE.items()}
        return columns

    def to_pandas(self) -> pd.DataFrame:
        """Return one row per state, with the columns of `to_columns`."""
        import pandas as pd

        return pd.DataFrame(self.to_columns())

    @classmethod
    def from_pandas(cls, table: pd.DataFrame, lookahead_s: float = 0.0) -> Trajectory:
        """Inverse of `to_pandas`.

        Raises:
            DatasetError: a column is missing, or a time is invalid.
        """
        rotation, position = [f"R_WB_{i}{j}" for i in range(3) for j in range(3)], [f"p_WB_W_{a}" for a in "xyz"]
        absent = [name for name in ("t_ns", *rotation, *position) if name not in table]
        if absent:
            raise DatasetError(f"trajectory: missing columns: {', '.join(absent)}")

        def vectors(name: str) -> Array | None:
            return table[[f"{name}_{a}" for a in "xyz"]].to_numpy(float) if f"{name}_x" in table else None

        t_ns, timed = times_ns(table["t_ns"].to_numpy(), "ns")
        if not timed.all():
            row = int(np.flatnonzero(~timed)[0])
            raise DatasetError(f"trajectory: row {row}: t_ns is {table['t_ns'].iloc[row]}, not a time")
        P = None
        if COVARIANCE[0, 0] in table:
            P = np.empty((len(table), DIM, DIM))
            for (i, j), name in COVARIANCE.items():
                P[:, i, j] = P[:, j, i] = table[name].to_numpy(float)
        return cls(
            t_ns, table[rotation].to_numpy(float).reshape(-1, 3, 3), table[position].to_numpy(float),
            vectors("v_WB_W"), vectors("b_a"), vectors("b_g"), P, lookahead_s,
        )  # fmt: skip


def _pose(line: str, fields: list[str]) -> tuple[int, list[float]]:
    """Return the time (ns) of a line of a TUM file, and x y z qx qy qz qw; an error shows the line, if there is one.

    Raises:
        ValueError: what is wrong with it.
    """
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        found = f": {line.rstrip()[:60]!r}" if line else "; is this a TUM file?"
        raise ValueError(f"not numbers{found}") from None
    stamp_ns = seconds_to_ns(fields[0])
    if len(numbers) != 8:
        raise ValueError(f"expected t x y z qx qy qz qw, found {len(numbers)} fields")
    length = math.hypot(*numbers[4:])
    if not (all(map(math.isfinite, numbers)) and abs(length - 1) <= TOLERANCE):
        raise ValueError(f"not a finite pose with a unit quaternion (|q| = {length:.6g})")
    return stamp_ns, numbers[1:]
