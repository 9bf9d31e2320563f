"""The files of a result folder beside its runs, and how to find a folder."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import yaml

from ....datasets.errors import message_of, nearest
from ...errors import ExperimentError
from ...experiment.plan import Experiment, plain, shipped_experiments
from ...files import from_csv, writing
from ...results.summary import Record, records

PLAN = "experiment.yaml"
NAMES = ("log", "label", "output", "baseline_log", "baseline_label", "baseline_output", "score")
"""Columns of paired.csv that are text, even if they look like numbers."""


def find_result(name: str, results: Path = Path("results")) -> Path:
    """Return the folder of a result: that folder itself, or an experiment's name under `results`.

    Raises:
        ExperimentError: neither; names the nearest known.
    """
    for folder in (Path(name), results / name):
        try:
            if (folder / "runs.sqlite").is_file():
                return folder
        except (OSError, ValueError):  # not a possible file name
            continue
    known = sorted(path.parent.name for path in results.glob("*/runs.sqlite"))
    found = f"(in {results}: {', '.join(known)})" if known else f"(none in {results}; `fathom run` makes them)"
    raise ExperimentError(f"{name}: no such result{nearest(Path(name).name, known)} {found}")


def keep_plan(plan: Experiment, folder: Path) -> None:
    """Write an experiment beside its runs, with every variant spelled out; `fathom run` accepts the file.

    Raises:
        ExperimentError: it cannot be written.
    """
    content = plain(plan)
    if plan.seeds == tuple(range(1, len(plan.seeds) + 1)):
        content["seeds"] = len(plan.seeds)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120)
    with writing(folder / PLAN):
        (folder / PLAN).write_text(text, encoding="utf-8")


def kept_plan(folder: Path, name: str) -> tuple[Experiment | None, str | None]:
    """Return the plan of a result folder, and how to name it to `fathom run`; (None, None) if it is not known.

    It is what `keep_plan` wrote, else the packaged experiment of this name.
    """
    kept, packaged = _load(folder / PLAN), _load(name) if name in shipped_experiments() else None
    if packaged is not None and (kept is None or plain(kept) == plain(packaged)):
        return packaged, name
    return (None, None) if kept is None else (kept, str(folder / PLAN))


def _load(source: str | Path) -> Experiment | None:
    """Return an experiment; None if the file is missing, or if another version wrote it."""
    try:
        return Experiment.load(source)
    except ExperimentError:
        return None


def in_order(rows: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """Return the rows of a store in the order of the experiment's logs, seeds and estimators, as figures colour them.

    Rows of labels and logs that the experiment no longer has go last.
    """
    plan, _ = kept_plan(folder, str(rows["experiment"].iloc[0]))
    known = ([log.name for log in plan.logs], [each.label for each in plan.estimators]) if plan else ([], [])
    places = {
        column: {name: place for place, name in enumerate(dict.fromkeys([*first, *rows[column]]))}
        for column, first in zip(("log", "label"), known, strict=True)
    }
    place = pd.DataFrame({column: [of[name] for name in rows[column]] for column, of in places.items()}, rows.index)
    return rows.loc[place.assign(seed=rows["seed"]).sort_values(["log", "seed", "label"], kind="stable").index]


def differences_of(folder: Path) -> list[Record]:
    """Return the paired differences that `fathom run` wrote to a result folder; none if there is no such file.

    Raises:
        ExperimentError: the file cannot be read.
    """
    path = folder / "paired.csv"
    if not path.is_file():
        return []
    try:
        table = pd.read_csv(path, dtype=dict.fromkeys(NAMES, str), keep_default_na=False, na_values=[""])
    except (OSError, ValueError) as error:
        raise ExperimentError(f"{path}: cannot be read ({message_of(error)})") from None
    names = {name: table[name].map(from_csv, na_action="ignore") for name in NAMES if name in table}
    return records(table.assign(**names))
