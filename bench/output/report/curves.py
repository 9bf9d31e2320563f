"""Figures of the page besides tracks: accuracy against cost, and NEES over the log; and how each estimator looks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...drawing import DASHES, Look
from ...metrics.consistency import anees_of
from ...metrics.state_error import BLOCKS
from ...results.summary import Record, groups
from ..cells import ONLINE, column, output_and_lag, text

SYMBOL = {
    "o": "circle",
    "s": "square",
    "^": "triangle-up",
    "D": "diamond",
    "v": "triangle-down",
    "P": "cross",
    "X": "x",
    "*": "star",
}
DASH: dict[Any, str] = dict(zip(DASHES, ("solid", "dash", "dot", "dashdot"), strict=True))


def looks(of: Mapping[str, Look]) -> dict[str, Any]:
    """Return, as plotly calls it, how each label looks in the other figures."""
    return {
        label: {"colour": look.colour, "symbol": SYMBOL[look.marker], "dash": DASH[look.dash]}
        for label, look in of.items()
    }


def named(row: Record) -> dict[str, Any]:
    """Return whose curve this is: its label, whether it is online, and what a legend calls it."""
    output = output_and_lag(row["output"], row["lookahead_s"])
    online = row["output"] == ONLINE
    name = row["label"] if online else f"{row['label']}, {output}"
    return {"label": row["label"], "online": online, "name": name, "output": output}


def costs(summary: Sequence[Record]) -> list[dict[str, Any]]:
    """Return error against computing time of one log, a point per estimator and output."""
    priced = [row for row in summary if row["real_time_factor"] and row["ate_rmse_m"] is not None]
    points = []
    for row in priced:
        x, y = 1000 / row["real_time_factor"], row["ate_rmse_m"]
        says = f"{column('ate_rmse_m').text(y)} m, {text(x)} ms/s"
        points.append(named(row) | {"x": x, "y": y, "says": says})
    return points


def anees(rows: Sequence[Record]) -> dict[str, Any]:
    """Return by block the NEES averaged over seeds at the fixed times of one log, with its interval."""
    found: dict[str, Any] = {block: [] for block in BLOCKS}
    done = [row for row in rows if row["status"] == "done"]
    for of in groups(done, "label", "output").values():
        for block, average in anees_of([row["nees_at"] for row in of]).items():
            runs = int(average.runs.max())
            t, value = average.t_s.tolist(), average.value.tolist()
            found[block].append(
                named(of[0])
                | {
                    "runs": runs,
                    "t": t,
                    "value": value,
                    "says": [f"{text(y)} at {x:.1f} s, {runs} seeds" for x, y in zip(t, value, strict=True)],
                    "low": average.low.tolist(),
                    "high": average.high.tolist(),
                }
            )
    return {block: lines for block, lines in found.items() if lines}
