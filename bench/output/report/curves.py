"""What the page draws of tables: accuracy against cost, and NEES over the log; and how each estimator looks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...metrics import BLOCKS
from ...metrics.consistency import anees_of
from ...results.summary import Record, groups
from ..figures.drawing import DASHES, Look
from .sheets import lookahead

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
    """Return in plotly's words how each label looks in the other figures."""
    return {
        label: {"colour": look.colour, "symbol": SYMBOL[look.marker], "dash": DASH[look.dash]}
        for label, look in of.items()
    }


def costs(summary: Sequence[Record]) -> list[dict[str, Any]]:
    """Return error against computing time of one log, a point per estimator and output."""
    return [
        {
            "label": row["label"],
            "output": row["output"],
            "ahead": lookahead(row),
            "x": 1000 / row["real_time_factor"],
            "y": row["ate_rmse_m"],
        }
        for row in summary
        if row["real_time_factor"] and row["ate_rmse_m"] is not None
    ]


def anees(rows: Sequence[Record]) -> dict[str, Any]:
    """Return by block the NEES averaged over seeds at the fixed times of one log, with its interval."""
    found: dict[str, Any] = {block: [] for block in BLOCKS}
    done = [row for row in rows if row["status"] == "done"]
    for (label, output), of in groups(done, "label", "output").items():
        for block, average in anees_of([row["nees_at"] for row in of]).items():
            found[block].append(
                {
                    "label": label,
                    "output": output,
                    "ahead": lookahead(of[0]),
                    "runs": int(average.runs.max()),
                    "t": average.t_s.tolist(),
                    "value": average.value.tolist(),
                    "low": average.low.tolist(),
                    "high": average.high.tolist(),
                }
            )
    return {block: lines for block, lines in found.items() if lines}
