"""Trajectories on the page: some seeds of every log, every k-th pose of every track."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow.parquet import read_metadata

from ....datasets.state import POSITION, Array
from ...results.summary import Record, groups
from ..estimates import Track, error_m, has_bounds, is_near, tracks_of
from .curves import named

OF_A_TRACK = (2000, 1000, 500, 200)
"""Poses drawn of one track: the most for which one seed of each log has room; else less than these."""
MOST_SEEDS = 10
"""Seeds of a log that are drawn at most: more take long to read, and are too many to look through."""


@dataclass(frozen=True)
class Drawn:
    """What is drawn of one log.

    Attributes:
        seeds: what the page's script reads, by seed; the seed of a recorded log is None.
        every: one pose in so many is shown.
        poses: how many the longest track has.
        left_out: how many seeds are not drawn.
        missing: trajectories that cannot be read, and why.
    """

    seeds: dict[int | None, Any] = field(default_factory=dict)
    every: int = 1
    poses: int = 0
    left_out: int = 0
    missing: list[str] = field(default_factory=list)


def draw_all(rows: Sequence[Record], folder: Path, room: int) -> dict[str, Drawn]:
    """Read as many seeds of each log as the page has room for; seeds with a run that did not finish come first.

    Args:
        rows: of the store.
        folder: where its trajectories are.
        room: how many poses the page has room for.
    """
    logs = {log: groups(of, "seed") for (log,), of in groups(filter(_is_saved, rows), "log").items()}
    lengths = [_poses(folder / row["trajectory"]) for of_log in logs.values() for row in next(iter(of_log.values()))]
    fewest = max(2, room // max(1, len(lengths)))
    most = next((m for m in OF_A_TRACK if sum(min(m, n) for n in lengths) <= room), min(OF_A_TRACK[-1], fewest))
    seeds = min(MOST_SEEDS, max(1, room // max(1, sum(min(most, n) for n in lengths))))
    return {
        log: _draw({seed: of for (seed,), of in of_log.items()}, folder, most, seeds) for log, of_log in logs.items()
    }


def _is_saved(row: Record) -> bool:
    return row["trajectory"] is not None


def _poses(path: Path) -> int:
    """Return how many poses a file holds; 0 where it cannot be read."""
    try:
        return read_metadata(path).num_rows
    except (OSError, ValueError):
        return 0


def _draw(by_seed: Mapping[int | None, Sequence[Record]], folder: Path, most: int, seeds: int) -> Drawn:
    troubled = sorted(by_seed, key=lambda seed: (all(row["status"] == "done" for row in by_seed[seed]), seed or 0))
    tracks: dict[int | None, list[tuple[Record, Track]]] = {}
    missing: list[str] = []
    for seed in sorted(troubled[:seeds], key=lambda seed: seed or 0):
        read = [(row, _read(row, folder, missing)) for row in by_seed[seed]]
        found = [(row, track) for row, track in read if track is not None]
        if found:
            tracks[None if seed is None else int(seed)] = found
    poses = max((len(track.estimate) for of in tracks.values() for _, track in of), default=0)
    every = -(-poses // most) or 1
    blocks = {seed: _block(of, every) for seed, of in tracks.items()}
    return Drawn(blocks, every, poses, len(by_seed) - len(troubled[:seeds]), missing)


def _read(row: Record, folder: Path, missing: list[str]) -> Track | None:
    """Return the track of a row; None if it has no score, or if it cannot be read, which is added to `missing`."""
    for name in (row["trajectory"], row["truth_trajectory"]):
        if name is not None and not (folder / name).is_file():
            missing.append(f"{name}: not there")
            return None
    tracks, _ = tracks_of([row], folder, missing)
    return tracks[0] if tracks else None


def _block(tracks: Sequence[tuple[Record, Track]], every: int) -> dict[str, Any]:
    """Return one seed's tracks, one pose in `every`, as the script reads them: m and s, each array as base64."""
    start_ns = min(int(track.estimate.t_ns[0]) for _, track in tracks)
    truths = [track.truth for _, track in tracks if track.truth is not None]
    longest = max(truths, key=len, default=None)
    return {
        "truth": None if longest is None else _coordinates(longest.p_WB_W[::every, :2]),
        "kind": next((track.truth_kind for _, track in tracks if track.truth is not None), "truth"),
        "tracks": [
            {
                **named(row),
                "near": is_near(track),
                "t": floats(1e-9 * (track.estimate.t_ns[::every] - start_ns).astype(float)),
                "p": _coordinates(track.estimate.p_WB_W[::every, :2]),
                "error": _errors(track, every),
                "sigma": _sigmas(track, every),
            }
            for row, track in tracks
        ],
    }


def _errors(track: Track, every: int) -> list[str] | None:
    if track.truth is None:
        return None
    return _coordinates(error_m(track)[::every])


def _sigmas(track: Track, every: int) -> list[str] | None:
    """Return σ by axis; None where there is no covariance, or it is in other axes than the aligned error."""
    if not has_bounds(track):
        return None
    assert track.estimate.P is not None
    variance = np.diagonal(track.estimate.P[::every, POSITION, POSITION], axis1=1, axis2=2)
    return _coordinates(np.sqrt(variance.clip(min=0)))


def _coordinates(values: Array) -> list[str]:
    return [floats(column) for column in np.asarray(values).T]


def floats(values: Array) -> str:
    """Return numbers as the base64 of little-endian 32-bit floats: to a millimetre at 10 km."""
    with np.errstate(over="ignore"):
        return b64encode(np.asarray(values, "<f4").tobytes()).decode("ascii")
