"""Every figure of an experiment, as PDF and PNG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from ...drawing import looks_of, save
from ...results.summary import Record, Rows, file_names, groups, records, summarise
from ..estimates import tracks_of
from .ablation import draw_ablation
from .consistency import draw_nees
from .cost import draw_costs, priced
from .lag import draw_lag_curve, lag_curve
from .step_time import draw_step_times, step_times
from .track import draw_errors, draw_tracks, pages_of

Tell = Callable[[int, int], None]


def draw_figures(
    rows: Rows, folder: Path, differences: Sequence[Record] = (), tell: Tell = lambda done, total: None
) -> list[Path]:
    """Draw every figure of an experiment into folder/figures and return the files; a figure without data is left out.

    Args:
        rows: of the store; tracks and errors of each simulated log are drawn with the first of its seeds.
        folder: the experiment's, with its trajectories.
        differences: what `paired` found.
        tell: called before each figure, with how many are drawn of how many.
    """
    figures = _figures(rows, folder, differences)
    files = []
    for k, (path, draw) in enumerate(figures):
        tell(k, len(figures))
        files += save(draw(), path)
    return files


def _figures(rows: Rows, folder: Path, differences: Sequence[Record]) -> list[tuple[Path, Callable[[], Figure]]]:
    """Return the path, without suffix, of each figure that has data, and the function that draws it."""
    every = records(rows)
    summary = summarise(every)
    looks = looks_of([label for (label,) in groups(every, "label")])
    stems = {log: folder / "figures" / name for log, name in file_names(row["log"] for row in every).items()}
    found: list[tuple[Path, Callable[[], Figure]]] = []
    for (log,), of_log in groups(every, "log").items():
        if any(row["nees_at"] not in (None, "{}") for row in of_log if row["status"] == "done"):
            found.append((Path(f"{stems[log]}-nees"), partial(draw_nees, of_log, looks, log)))
        of_summary = [record for record in summary if record["log"] == log]
        if lag_curve(of_summary) is not None:
            found.append((Path(f"{stems[log]}-lag"), partial(draw_lag_curve, of_summary, looks, log)))
        if step_times(of_log)[0]:
            found.append((Path(f"{stems[log]}-step-times"), partial(draw_step_times, of_log, looks, log)))
        tracks, seed = tracks_of(of_log, folder / "trajectories")
        if not tracks:
            continue
        title = log if seed is None else f"{log}, seed {seed}"
        found.append((Path(f"{stems[log]}-tracks"), partial(draw_tracks, tracks, looks, title)))
        for k, page in enumerate(pages_of(tracks)):
            found.append(
                (Path(f"{stems[log]}-errors{f'-{k + 1}' if k else ''}"), partial(draw_errors, page, looks, title))
            )
    known = [row for row in differences if row["ratio"] is not None]
    for (log,), of_log in groups(known, "baseline_log").items():
        found.append((Path(f"{stems[log]}-ablation"), partial(draw_ablation, of_log, looks, log)))
    if to_price := priced(summary):
        found.append((folder / "figures" / "accuracy-cost", partial(draw_costs, to_price, looks)))
    return found
