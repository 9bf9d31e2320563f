"""`fathom score`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from ...datasets.trajectory import Trajectory
    from ..metrics import Ate

LONGEST_TOLERANCE_S = 1e9
"""30 years; in nanoseconds it still fits an int64."""
ENOUGH = 0.5
"""Of the shorter trajectory's poses: where fewer match, a few poses stand for the whole."""
MUCH_LESS = 0.5
"""Of the ATE: an offset that only follows the estimate's drift lowers it by less."""
ROUNDED_UP = 1.005
"""So that three digits of a tolerance are not below it."""
LETTERS = 80
"""Longest line of text, for a terminal of that width."""
STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


class Align(StrEnum):
    """How an estimate is aligned before it is scored."""

    none = "none"
    origin = "origin"
    yaw = "yaw"
    se3 = "se3"


class Unit(StrEnum):
    """Unit of the step of the RPE."""

    frames = "frames"
    s = "s"
    m = "m"


class Pairs(StrEnum):
    """Which pairs of poses the RPE is taken over."""

    consecutive = "consecutive"
    all = "all"


def score(
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="Ground truth, TUM file: t x y z qx qy qz qw.")],
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help="Estimated trajectory, TUM file.")],
    align: Annotated[Align, typer.Option(help="Alignment of the estimate with the truth.")] = Align.none,
    tolerance_s: Annotated[
        float,
        typer.Option(
            min=0, metavar="SECONDS", help="Largest difference in time between two poses that are compared, s."
        ),
    ] = 0.01,
    delta: Annotated[float, typer.Option(metavar="STEP", help="Step of the RPE, in --unit.")] = 1.0,
    unit: Annotated[Unit, typer.Option(help="Unit of the step.")] = Unit.m,
    pairs: Annotated[Pairs, typer.Option(help="Pairs of poses for the RPE.")] = Pairs.all,
    offset_s: Annotated[
        float, typer.Option(metavar="SECONDS", help="Added to the estimate's times before poses are compared, s.")
    ] = 0.0,
) -> None:
    """Print ATE and RPE of an estimated trajectory.

    Says how many of its poses they are taken over, and what would match more.
    """
    from ..metrics import ScoreError, ate, check_step, rpe
    from ..saying import folded

    check_step(delta, unit.value)
    if not 0 <= tolerance_s <= LONGEST_TOLERANCE_S:
        raise ScoreError(f"--tolerance-s must be from 0 to {LONGEST_TOLERANCE_S:g}, found {tolerance_s}")
    if not abs(offset_s) <= LONGEST_TOLERANCE_S:
        raise ScoreError(f"--offset-s must be within {LONGEST_TOLERANCE_S:g} s, found {offset_s}")
    true, estimated = _read_tum(truth), _shifted(_read_tum(estimate), offset_s)
    tolerance_ns = round(tolerance_s * 1e9)
    _check_matches(true, estimated, tolerance_s, offset_s)
    absolute = ate(true, estimated, align.value, tolerance_ns)
    rows = _score_rows("ATE", absolute, f"{absolute.n} poses")
    settings = f"alignment: {align.value}; {_matched(true, estimated, absolute.n, tolerance_s, offset_s)}"
    try:
        relative = rpe(true, estimated, delta, unit.value, pairs.value, tolerance_ns)
        rows += _score_rows("RPE", relative, f"{relative.n} pairs")
        settings += f"; RPE over {delta:g} {unit.value}, {pairs.value} pairs"
    except ScoreError as error:
        settings += f"\nno RPE: {str(error).removeprefix('rpe: ')}"
    _print_scores(rows)
    for line in (*settings.splitlines(), *_hints(true, estimated, absolute, tolerance_s, offset_s)):
        typer.echo(folded(line, LETTERS))


def _shifted(estimate: Trajectory, offset_s: float) -> Trajectory:
    """Return the estimate with an offset added to its times."""
    from ...datasets.errors import DatasetError

    offset_ns = round(offset_s * 1e9)
    if len(estimate) and max(abs(int(estimate.t_ns[k]) + offset_ns) for k in (0, -1)) >= 2**63:
        raise DatasetError(f"--offset-s {offset_s:g}: the times of the estimate would be beyond the clock")
    return replace(estimate, t_ns=estimate.t_ns + offset_ns)


def _check_matches(truth: Trajectory, estimate: Trajectory, tolerance_s: float, offset_s: float) -> None:
    """Refuse two trajectories without one pair of poses, and say which option would find some.

    Raises:
        ScoreError: no pose of the estimate is within the tolerance of one of the truth.
    """
    from ..metrics import ScoreError, associate

    try:
        associate(truth, estimate, round(tolerance_s * 1e9))
    except ScoreError:
        advice = _tolerance_advice(truth, estimate)
        if not advice:
            apart_s = (int(truth.t_ns[0]) - int(estimate.t_ns[0])) * 1e-9
            advice = f"with --offset-s {offset_s + apart_s:.3f} both begin together"
        raise ScoreError(
            f"no two poses are within {tolerance_s:g} s of each other: the truth has {_span(truth)}, the estimate "
            f"{_span(estimate)}; {advice}"
        ) from None


def _span(of: Trajectory) -> str:
    return f"{len(of)} poses from {of.t_ns[0] * 1e-9:.3f} s to {of.t_ns[-1] * 1e-9:.3f} s"


def _matched(truth: Trajectory, estimate: Trajectory, n: int, tolerance_s: float, offset_s: float) -> str:
    """Return how many poses were compared, of how many of each."""
    shifted = f" after {offset_s:+g} s" if offset_s else ""
    return (
        f"within {tolerance_s:g} s{shifted} matched:\n"
        f"{n} of {len(truth)} poses of the truth and of {len(estimate)} of the estimate"
    )


def _hints(
    truth: Trajectory, estimate: Trajectory, absolute: Ate, tolerance_s: float, offset_s: float
) -> Iterator[str]:
    """Yield which tolerance would match more poses, if few are, and which offset would lower the error by much."""
    from ..metrics.time_offset import best_offset_s

    if absolute.n < ENOUGH * min(len(truth), len(estimate)):
        advice = _tolerance_advice(truth, estimate)
        yield f"few poses match{f': {advice}' if advice else ', for the two hardly overlap in time'}"
    best = best_offset_s(truth, estimate, absolute.alignment)
    if best is not None and abs(best[0]) > tolerance_s and best[1] < MUCH_LESS * absolute.rmse_m:
        yield f"with --offset-s {offset_s + best[0]:.3f} the ATE would be about {best[1]:.3g} m"


def _tolerance_advice(truth: Trajectory, estimate: Trajectory) -> str:
    """Return which tolerance pairs most poses; "" where none does."""
    from ..metrics.time_offset import tolerance_needed_s

    needed_s = tolerance_needed_s(truth, estimate)
    return "" if needed_s is None else f"--tolerance-s {needed_s * ROUNDED_UP:.3g} would match most of them"


def _read_tum(path: Path) -> Trajectory:
    from ...datasets.errors import DatasetError
    from ...datasets.trajectory import Trajectory

    try:
        if path.is_dir():
            raise DatasetError(f"{path}: a folder; expected a TUM file")
        return Trajectory.from_tum(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None


def _score_rows(title: str, numbers: object, over: str) -> list[list[str]]:
    rows = []
    for unit, name in (("m", "{}_m"), ("°", "rotation_{}_deg")):
        values = [getattr(numbers, name.format(statistic)) for statistic in STATISTICS]
        rows.append([f"{title} {unit}", *("–" if value is None else f"{value:.6f}" for value in values), over])
    return rows


def _print_scores(rows: list[list[str]]) -> None:
    """Print a line for each error; on a narrow console, where numbers would be cut, a column for each."""
    from ..output.tables.terminal import ANY_WIDTH, console

    there, headings = console(), ["", *STATISTICS, "over"]
    table = _table(headings, rows)
    if there.measure(table, options=there.options.update_width(ANY_WIDTH)).maximum > there.width:
        headings, *rows = map(list, zip(headings, *rows, strict=True))
        table = _table(headings, rows)
    there.print(table)


def _table(headings: list[str], rows: list[list[str]]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table
