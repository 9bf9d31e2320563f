"""One run's estimate beside the truth, as the store keeps it: what figures and report draw."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from ...datasets.errors import one_line
from ...datasets.state import Array
from ...datasets.trajectory import COVARIANCE, Trajectory
from ..metrics import Alignment, Dims, ScoreError, align, associate
from ..results.summary import Record

SMALLEST_EXTENT_M = 1.0
"""Of a truth that hardly moves: otherwise every track would be far from it."""


class Track(NamedTuple):
    """One run's estimate beside the truth, associated and aligned, or alone where there is no truth.

    Attributes:
        dims: "2d" where heights are not scored.
        truth_kind: "truth", or what else the truth is.
    """

    label: str
    output: str
    align: Alignment
    truth: Trajectory | None
    estimate: Trajectory
    dims: Dims = "3d"
    truth_kind: str = "truth"


def tracks_of(rows: Sequence[Record], folder: Path, missing: list[str] | None = None) -> tuple[list[Track], int | None]:
    """Read the trajectories of a log's first seed that has any; return (tracks, seed).

    A file that cannot be read, as a truncated one, is a sentence added to `missing`; without it, an error.
    """
    saved = [row for row in rows if row["trajectory"] is not None and (folder / row["trajectory"]).is_file()]
    if not saved:
        return [], None
    seed = min((row["seed"] for row in saved if row["seed"] is not None), default=None)
    tracks = [_readable(row, folder, missing) for row in saved if row["seed"] == seed]
    return [track for track in tracks if track is not None], seed


def _readable(row: Record, folder: Path, missing: list[str] | None) -> Track | None:
    """Return the track of a row; None where it has no state or no score, or cannot be read."""
    try:
        return _track(row, folder)
    except (OSError, ValueError, KeyError) as error:  # a truncated file, or not one of ours
        if missing is None:
            raise
        missing.append(f"{row['trajectory']}: {one_line(error)}")
        return None


def _track(row: Record, folder: Path) -> Track | None:
    estimate = load_trajectory(folder / row["trajectory"])
    if not len(estimate):  # the run ended before its first state, as where a smoother refuses its start
        return None
    truth = row["truth_trajectory"]
    if truth is None or not (folder / truth).is_file():
        return Track(row["label"], row["output"], "none", None, estimate)
    try:
        truth, estimate = associate(load_trajectory(folder / truth), estimate)
        aligned = align(truth, estimate, row["align"])
        return Track(row["label"], row["output"], row["align"], truth, aligned, row["dims"], row["truth_kind"])
    except ScoreError:  # it has no score either
        return None


def load_trajectory(path: Path) -> Trajectory:
    """Read a saved trajectory; of its covariance the 3 × 3 blocks are kept, the rest is NaN.

    Raises:
        OSError, ValueError, KeyError: it cannot be read: it is damaged, or there is not enough memory for it.
    """
    try:
        return _loaded(path)
    except MemoryError as error:
        raise ValueError(f"there is not enough memory to read it ({error})") from None
    except (OSError, ValueError, KeyError):
        raise
    except Exception as error:  # pandas and pyarrow raise many kinds for a file that is not what it seems
        raise ValueError(one_line(error)) from None


def _loaded(path: Path) -> Trajectory:
    table = pd.read_parquet(path)
    if COVARIANCE[0, 0] in table:
        table = table.reindex(columns=[*table.columns, *(name for name in COVARIANCE.values() if name not in table)])
    return Trajectory.from_pandas(table)


def error_m(track: Track) -> Array:
    """Return the position error (n, 3), m, of a track that has a truth; NaN upwards where only 2d is scored."""
    assert track.truth is not None
    error = track.estimate.p_WB_W - track.truth.p_WB_W
    if track.dims == "2d":
        error[:, 2] = np.nan
    return error


def is_near(track: Track) -> bool:
    """Whether a track keeps within the truth's own extent of it: one that got lost does not set a figure's scale."""
    if track.truth is None:
        return True
    extent_m = np.ptp(track.truth.p_WB_W[:, :2], axis=0).max()
    return bool(np.nanmax(np.abs(error_m(track)[:, :2]), initial=0.0) < max(extent_m, SMALLEST_EXTENT_M))


def has_bounds(track: Track) -> bool:
    """Whether the error has a σ in its own axes: there is a truth and a covariance, and nothing was aligned."""
    return track.truth is not None and track.align == "none" and track.estimate.P is not None
