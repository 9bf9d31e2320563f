"""`fathom score`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ...datasets.trajectory import Trajectory

LONGEST_TOLERANCE_S = 1e9
"""30 years; in nanoseconds it still fits an int64."""
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
) -> None:
    """Print ATE and RPE of an estimated trajectory."""
    from ..metrics import ScoreError, ate, check_step, rpe

    check_step(delta, unit.value)
    if not 0 <= tolerance_s <= LONGEST_TOLERANCE_S:
        raise ScoreError(f"--tolerance-s must be from 0 to {LONGEST_TOLERANCE_S:g}, found {tolerance_s}")
    true, estimated = _read_tum(truth), _read_tum(estimate)
    tolerance_ns = round(tolerance_s * 1e9)
    absolute = ate(true, estimated, align.value, tolerance_ns)
    rows = _score_rows("ATE", absolute, f"{absolute.n} poses")
    settings = f"alignment: {align.value}; matched within {tolerance_s:g} s"
    try:
        relative = rpe(true, estimated, delta, unit.value, pairs.value, tolerance_ns)
        rows += _score_rows("RPE", relative, f"{relative.n} pairs")
        settings += f"; RPE over {delta:g} {unit.value}, {pairs.value} pairs"
    except ScoreError as error:
        settings += f"\nno RPE: {str(error).removeprefix('rpe: ')}"
    _print_scores(rows)
    typer.echo(settings)


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
    from rich import box
    from rich.table import Table

    from ..output.tables.terminal import console

    table = Table("", *STATISTICS, "over", box=box.SIMPLE_HEAD)
    for row in rows:
        table.add_row(*row)
    console().print(table)
