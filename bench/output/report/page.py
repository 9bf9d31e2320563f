"""The HTML page of an experiment's results: one file that needs no network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from shlex import quote
from typing import Any

from ....datasets.errors import shown
from ...drawing import looks_of
from ...errors import ExperimentError
from ...files import write_whole, writing
from ...results.store import load_runs
from ...results.summary import Record, Rows, groups, records, summarise
from .. import cells, notices, sheets
from ..remarks import mostly_outside, not_positive, waited
from . import curves, runs
from .packing import embedded, packed, packed_text
from .results import differences_of, in_order, kept_plan
from .tracks import Drawn, draw_all

HERE = Path(__file__).parent
SCRIPTS = ("tables.js", "runs.js", "figures.js")
POSES = 100_000
"""Poses that a page may hold, 48 bytes each, 64 as base64: 6.4 MB."""
POSES_OF_A_ROW = 4
"""A row of the store takes as much of the page as so many poses: 250 bytes, compressed, as base64."""
LEAST_POSES = 20_000
"""That have room beside any number of rows."""


class NoExtraError(ExperimentError):
    """The packages that the page is made with are not installed."""


def report(folder: Path, file: Path | None = None) -> Path:
    """Write the page of a result folder, from what lies there, and return the file.

    Args:
        folder: with the runs.sqlite of an experiment.
        file: where the page goes; folder/report.html without.

    Raises:
        ExperimentError: no store there, an empty one, or the page cannot be written; NoExtraError without the extra.
    """
    check_extra()
    rows = load_runs(folder, shared_specs=True)
    if rows.empty:
        raise ExperimentError(f"{folder / 'runs.sqlite'}: there is no run in it; `fathom run` makes them")
    return write_report(in_order(rows, folder), folder, differences_of(folder), file)


def write_report(rows: Rows, folder: Path, differences: Sequence[Record] = (), file: Path | None = None) -> Path:
    """Write the page of these rows and return the file.

    Args:
        rows: of the store.
        folder: the experiment's, with its trajectories and its `kept_plan`.
        differences: what `paired` found.
        file: where the page goes; folder/report.html without.

    Raises:
        ExperimentError: it cannot be written; NoExtraError where the extra is not installed.
    """
    text = render(rows, folder, differences)
    file = folder / "report.html" if file is None else file
    with writing(file, "; choose another place by -o"):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, text.encode())
    return file


def check_extra() -> None:
    """Raise NoExtraError where the extra is not installed."""
    try:
        import jinja2  # noqa: F401
        import plotly  # noqa: F401
    except ImportError as error:
        raise NoExtraError(f"{error}; the report needs an extra: pip install 'fathom-bench[report]'") from None


def render(rows: Rows, folder: Path, differences: Sequence[Record]) -> str:
    """Return the page's HTML.

    Raises:
        NoExtraError: the extra is not installed.
    """
    check_extra()
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    every = records(rows)
    summary = summarise(every)
    by_log = {log: of for (log,), of in groups(summary, "log").items()}
    done = _done(every)
    drawn = draw_all(every, folder / "trajectories", max(LEAST_POSES, POSES - POSES_OF_A_ROW * len(every)))
    table, whys = runs.table(every)
    common, blocks = runs.details(every)
    logs = [
        {
            "name": log,
            "drawn": drawn.get(log, Drawn()),
            "seeds": list(drawn[log].seeds) if log in drawn else [],
            "truth": any(row["truth_kind"] is not None for row in of),
            "aligned": next((row["align"] for row in of if row["align"]), "none"),
            "anees": curves.anees([row for row in every if row["log"] == log]),
            "costs": curves.costs(of),
        }
        for log, of in by_log.items()
    ]
    name = str(every[0]["experiment"] or folder.name)
    plan, again = kept_plan(folder, name)
    templates = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: shown(value) if type(value) is str else value,
    )
    templates.filters["ordinal"] = ordinal
    return templates.get_template("page.html").render(
        name=name,
        description="" if plan is None else plan.description,
        again=None if again is None else quote(again),
        folder=quote(str(folder)),
        example=next(((row["identity"] or "")[: runs.SHOWN_OF_IDENTITY] for row in every if row["identity"]), None),
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        facts=runs.facts(every),
        failures=runs.failures(every),
        noticed=notices.sheet(every),
        warnings=[*mostly_outside(every), *not_positive(summary), *waited(summary), *_mixed(every), *_missing(drawn)],
        accuracy=[sheets.accuracy(of, done) for of in by_log.values()],
        over_floor=_there(map(sheets.over_floor, by_log.values())),
        differences=sheets.differences(differences),
        consistency=_there(of(each) for each in by_log.values() for of in (sheets.consistency, sheets.prediction)),
        late=_there(map(sheets.late_or_out, by_log.values())),
        costs=_there(map(sheets.cost, by_log.values())),
        logs=logs,
        runs=every,
        exact=runs.EXACT,
        every_run=runs.heading(len(every), whys),
        table_of_runs=table,
        common=common,
        details=blocks,
        environments=runs.environments(every),
        style=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        scripts=[Markup((HERE / script).read_text(encoding="utf-8")) for script in SCRIPTS],
        plotly=_packed_plotly(),
        embedded=embedded,
        packed=packed,
        page={
            "looks": curves.looks(looks_of([label for (label,) in groups(every, "label")])),
            "axes": axes(),
            "logs": [{key: log[key] for key in ("name", "truth", "aligned", "anees", "costs")} for log in logs],
        },
    )  # fmt: skip


@cache
def _packed_plotly() -> str:
    from plotly.offline import get_plotlyjs

    return packed_text(get_plotlyjs())


def axes() -> dict[str, Any]:
    """Return the titles of the figures' axes, and what plotly says of a point of a track or of an error."""
    east, north, _ = cells.DIRECTIONS
    return {
        "east": f"{east} (m)",
        "north": f"{north} (m)",
        "errors": [f"{direction} error (m)" for direction in cells.DIRECTIONS],
        "time": cells.TIME,
        "nees": cells.NEES_OVER_DOF,
        "computing": cells.COMPUTING,
        "ate": cells.column("ate_rmse_m").axis,
        "of_track": "east %{x:.2f} m, north %{y:.2f} m<br>at %{customdata:.1f} s",
        "of_error": "%{y:.3f} m at %{x:.1f} s",
    }


def ordinal(k: int) -> str:
    """Return "2nd", "3rd", "4th", "11th", "22nd"."""
    suffix = "th" if k % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(k % 10, "th")
    return f"{k}{suffix}"


def _done(every: Sequence[Record]) -> sheets.Done:
    outputs = groups(every, "log", "label", "output")
    return {key: [row for row in of if row["status"] == "done"] for key, of in outputs.items()}


def _there(found: Iterable[sheets.Sheet | None]) -> list[sheets.Sheet]:
    return [sheet for sheet in found if sheet is not None]


def _mixed(every: Sequence[Record]) -> list[str]:
    """Say where rows are from several machines or versions."""
    what = {"machine": "machines: their timings are not comparable", "versions": "sets of versions"}
    kinds = {column: len({row[column] for row in every}) for column in what}
    return [f"these runs were made with {n} {what[column]}" for column, n in kinds.items() if n > 1]


def _missing(drawn: dict[str, Drawn]) -> list[str]:
    """Say which trajectories cannot be drawn."""
    lines = []
    for log, of in drawn.items():
        if of.missing:
            more = "" if len(of.missing) == 1 else f", and {len(of.missing) - 1} more"
            lines.append(f"{log}: trajectories are missing from the figures: {of.missing[0]}{more}")
    return lines
