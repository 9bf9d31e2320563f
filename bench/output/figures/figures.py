"""Every figure of an experiment, as PDF and PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ...drawing import looks_of, save
from ...results.summary import Record, file_names, groups, records, summarise
from ..estimates import tracks_of
from .ablation import draw_ablation
from .consistency import draw_nees
from .cost import draw_costs, priced
from .lag import draw_lag_curve, lag_curve
from .step_time import draw_step_times, step_times
from .track import draw_errors, draw_tracks, pages_of


def draw_figures(rows: pd.DataFrame, folder: Path, differences: Sequence[Record] = ()) -> list[Path]:
    """Draw every figure of an experiment into folder/figures and return the files; a figure without data is left out.

    Args:
        rows: of the store; tracks and errors of each simulated log are drawn with the first of its seeds.
        folder: the experiment's, with its trajectories.
        differences: what `paired` found.
    """
    every, summary = records(rows), summarise(rows)
    looks = looks_of([label for (label,) in groups(every, "label")])
    stems = {log: folder / "figures" / name for log, name in file_names(row["log"] for row in every).items()}
    files = []
    for (log,), of_log in groups(every, "log").items():
        if any(row["nees_at"] not in (None, "{}") for row in of_log if row["status"] == "done"):
            files += save(draw_nees(of_log, looks, log), Path(f"{stems[log]}-nees"))
        of_summary = [record for record in summary if record["log"] == log]
        if lag_curve(of_summary) is not None:
            files += save(draw_lag_curve(of_summary, looks, log), Path(f"{stems[log]}-lag"))
        if step_times(of_log)[0]:
            files += save(draw_step_times(of_log, looks, log), Path(f"{stems[log]}-step-times"))
        tracks, seed = tracks_of(of_log, folder / "trajectories")
        if not tracks:
            continue
        title = log if seed is None else f"{log}, seed {seed}"
        files += save(draw_tracks(tracks, looks, title), Path(f"{stems[log]}-tracks"))
        for k, page in enumerate(pages_of(tracks)):
            files += save(draw_errors(page, looks, title), Path(f"{stems[log]}-errors{f'-{k + 1}' if k else ''}"))
    known = [row for row in differences if row["ratio"] is not None]
    for (log,), of_log in groups(known, "baseline_log").items():
        files += save(draw_ablation(of_log, looks, log), Path(f"{stems[log]}-ablation"))
    if to_price := priced(summary):
        files += save(draw_costs(to_price, looks), folder / "figures" / "accuracy-cost")
    return files
