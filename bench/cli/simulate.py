"""`fathom simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ...datasets.simulated.scenario import Scenario


def simulate(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="YAML file with the keys of a scenario, or the name of a mission.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Folder to write; it must not hold a log already.")
    ],
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, metavar="N", help="Seed of all random numbers.")] = 1,
) -> None:
    """Simulate a mission and write it as a log.

    The log is a folder of Parquet files with a log.yaml.
    """
    from ...datasets.described.folder import write_folder
    from ...datasets.errors import shown
    from ...datasets.simulated import simulator

    log = simulator.simulate(_scenario(scenario), seed)
    write_folder(log, out)
    typer.echo(shown(f"{out}: {log.name}, {log.duration_s:.0f} s, {', '.join(['imu', *log.streams, 'truth'])}"))


def _scenario(text: str) -> Scenario:
    from ...datasets.formats.yaml_file import read_yaml
    from ...datasets.simulated.scenario import Scenario

    if not text.endswith((".yaml", ".yml")):
        return Scenario.from_dict({"mission": text})
    return Scenario.from_dict(read_yaml(Path(text)), text)
