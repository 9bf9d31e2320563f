"""Every figure of an experiment, as PDF and PNG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from ....datasets.errors import one_line
from ...drawing import Look, looks_of, save
from ...results.convergence import convergence
from ...results.honesty import compared, honesty
from ...results.summary import Record, Rows, file_names, groups, records, summarise
from ..estimates import tracks_of
from .ablation import draw_ablation
from .consistency import draw_nees
from .convergence import draw_convergence
from .cost import draw_costs, priced
from .honesty import draw_honesty
from .lag import draw_lag_curve, lag_curve
from .step_time import draw_step_times, step_times
from .track import draw_errors, draw_tracks, pages_of

Tell = Callable[[int, int], None]


def draw_figures(
    rows: Rows,
    folder: Path,
    differences: Sequence[Record] = (),
    tell: Tell = lambda done, total: None,
    missing: list[str] | None = None,
    honest: Sequence[Record] | None = None,
) -> list[Path]:
    """Draw every figure of an experiment into folder/figures and return the files; a figure without data is left out.

    Args:
        rows: of the store; tracks and errors of each simulated log are drawn with the first of its seeds.
        folder: the experiment's, with its trajectories.
        differences: what `paired` found.
        tell: called before each figure, with how many are drawn of how many.
        missing: gets a sentence for each figure that cannot be drawn, and each trajectory that cannot be read.
        honest: what `results.honesty.honesty` finds in the rows, where that is known already.

    Raises:
        OSError: a file cannot be written.
    """
    missing = [] if missing is None else missing
    figures = _figures(rows, folder, differences, missing, honesty(rows) if honest is None else honest)
    files = []
    for k, (path, draw) in enumerate(figures):
        tell(k, len(figures))
        try:
            files += save(draw(), path)
        except OSError:
            raise
        except Exception as error:  # one figure less is better than none
            missing.append(f"figure {path.name} cannot be drawn ({one_line(error)})")
    return files


Found = list[tuple[Path, Callable[[], Figure]]]
"""The path of each figure, without suffix, and the function that draws it."""


def _figures(
    rows: Rows, folder: Path, differences: Sequence[Record], missing: list[str], honest: Sequence[Record]
) -> Found:
    """Return each figure that has data; what cannot be read is a sentence in `missing`."""
    every = records(rows)
    summary = summarise(every)
    looks = looks_of([label for (label,) in groups(every, "label")])
    stems = {log: folder / "figures" / name for log, name in file_names(row["log"] for row in every).items()}
    found: Found = []
    for (log,), of_log in groups(every, "log").items():
        of_summary = [record for record in summary if record["log"] == log]
        for of_kind in (
            partial(_of_scores, of_log, of_summary, looks, log, stems[log]),
            partial(_of_tracks, of_log, folder, looks, log, stems[log], missing),
        ):
            try:
                found += of_kind()
            except Exception as error:  # damage in one log's rows costs that log's figures
                missing.append(f"{log}: figures cannot be drawn ({one_line(error)})")
    known = [row for row in differences if row["ratio"] is not None]
    for (log,), of_log in groups(known, "baseline_log").items():
        found.append((Path(f"{stems[log]}-ablation"), partial(draw_ablation, of_log, looks, log)))
    if to_price := priced(summary):
        found.append((folder / "figures" / "accuracy-cost", partial(draw_costs, to_price, looks)))
    if over_logs := compared(honest):
        found.append((folder / "figures" / "honesty", partial(draw_honesty, over_logs, looks)))
    if converged := convergence(every):
        found.append((folder / "figures" / "convergence", partial(draw_convergence, converged, looks)))
    return found


def _of_scores(
    rows: Sequence[Record], summary: Sequence[Record], looks: dict[str, Look], log: str, stem: Path
) -> Found:
    """Return the figures of a log's consistency, lags and step times."""
    found: Found = []
    if any(row["nees_at"] not in (None, "{}") for row in rows if row["status"] == "done"):
        found.append((Path(f"{stem}-nees"), partial(draw_nees, rows, looks, log)))
    if lag_curve(summary) is not None:
        found.append((Path(f"{stem}-lag"), partial(draw_lag_curve, summary, looks, log)))
    if step_times(rows)[0]:
        found.append((Path(f"{stem}-step-times"), partial(draw_step_times, rows, looks, log)))
    return found


def _of_tracks(
    rows: Sequence[Record], folder: Path, looks: dict[str, Look], log: str, stem: Path, missing: list[str]
) -> Found:
    """Return the figures of a log's tracks and errors."""
    tracks, seed = tracks_of(rows, folder / "trajectories", missing)
    if not tracks:
        return []
    title = log if seed is None else f"{log}, seed {seed}"
    found: Found = [(Path(f"{stem}-tracks"), partial(draw_tracks, tracks, looks, title))]
    for k, page in enumerate(pages_of(tracks)):
        found.append((Path(f"{stem}-errors{f'-{k + 1}' if k else ''}"), partial(draw_errors, page, looks, title)))
    return found
