"""`fathom list`."""

from __future__ import annotations

import sys
from enum import StrEnum
from shutil import get_terminal_size
from typing import Annotated

import typer

INDENT = 4
"""Letters by which the further lines of an entry are indented, on a terminal."""


class Listing(StrEnum):
    """What `fathom list` can list."""

    estimators = "estimators"
    logs = "logs"
    experiments = "experiments"
    scores = "scores"


def list_(what: Annotated[Listing, typer.Argument(metavar="LIST")]) -> None:
    """List estimators, logs, experiments or scores."""
    from ...datasets.errors import shown
    from ..saying import folded

    for name, about in LISTS[what]().items():
        line = shown(f"{name}: {about}" if about else name)
        typer.echo(folded(line, get_terminal_size().columns, INDENT) if sys.stdout.isatty() else line)


def _estimators() -> dict[str, str]:
    from ...estimators.registry import EstimatorError, known_estimators, load_estimator

    found = {}
    for name in known_estimators():
        try:
            found[name] = ", ".join(getattr(load_estimator(name), "__dataclass_fields__", ()))
        except EstimatorError as error:
            found[name] = str(error).removeprefix(f"{name}: ")
    return found


def _logs() -> dict[str, str]:
    from ...datasets.described.opening import catalog_names
    from ...datasets.simulated.specs import MISSIONS

    return dict.fromkeys(catalog_names(), "recorded") | dict.fromkeys(MISSIONS, "mission, simulated")


def _experiments() -> dict[str, str]:
    from ...datasets.formats.yaml_file import read_yaml
    from ..experiment.packaged import shipped_experiments

    return {name: read_yaml(path)["description"] for name, path in shipped_experiments().items()}


def _scores() -> dict[str, str]:
    from ..metrics.floor_ratio import FLOORS
    from ..metrics.scoring import COSTS, INNOVATIONS, SCORES

    return SCORES | FLOORS | INNOVATIONS | COSTS


LISTS = {
    Listing.estimators: _estimators,
    Listing.logs: _logs,
    Listing.experiments: _experiments,
    Listing.scores: _scores,
}
