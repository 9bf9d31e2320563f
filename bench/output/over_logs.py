"""Tables over all logs of an experiment, in groups of lines: each log's name, and below it the estimators'."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ..metrics.state_error import BLOCKS, DOF
from ..results.convergence import JUDGED, limits
from ..results.honesty import band_of, compared
from ..results.summary import Record, groups
from .cells import ABSENT, ONLINE, Cell, interval, judged, lag, text
from .sheets import SHORT, Line, Sheet

INDENT = "  "
"""Before an estimator's name, below that of the log."""
BESIDE_NAMES = "a time or `all` beside a name: smoothed, with that look-ahead"


def honesty(found: Sequence[Record]) -> Sheet | None:
    """Return ANEES by log, estimator and block, of what `results.honesty` found; None where there is too little."""
    shown = compared(found)
    if not shown:
        return None
    seeds, times = (max(row[name] or 0 for row in shown) for name in ("seeds", "times"))
    bands = dict.fromkeys(
        f"{interval(*band)} of {DOF[block]} states" for block in BLOCKS if (band := band_of(shown, block)) is not None
    )
    note = [
        f"mean over {times} fixed times of the ANEES over {seeds} seeds, per degree of freedom: 1 is consistent",
        "▲k, ▼k: at k of these times above (overconfident), below the band that 99 % of consistent ones never leave:",
        ", ".join(bands),
        f"{BESIDE_NAMES}; k/n: of n runs k finished; {ABSENT}: none did",
    ]

    def cells(of: Sequence[Record]) -> list[Cell]:
        by_block = {row["block"]: row for row in of}
        each = [by_block[block] for block in BLOCKS]
        return [
            Cell(ABSENT) if row["anees"] is None else judged(row["anees"], row["above"], row["below"]) for row in each
        ]

    headings = ["estimator", *(SHORT.get(block, block) for block in BLOCKS)]
    return Sheet("honesty: ANEES", note, headings, _grouped(shown, cells, len(BLOCKS)))


def convergence(found: Sequence[Record]) -> Sheet | None:
    """Return what `results.convergence` found; None where convergence was not asked for."""
    if not found:
        return None
    note = [
        f"converged: the attitude's error stays below {limits(found)} to the end; of all runs, "
        "[ ]: 95 % interval (Wilson)",
        "time (median), ATE and ANEES are of the runs that converge; ANEES per degree of freedom: 1 is consistent",
        f"{BESIDE_NAMES}; {ABSENT}: no run converged",
    ]

    def cells(of: Sequence[Record]) -> list[Cell]:
        (row,) = of
        share = f"{row['converged']}/{row['runs']}"
        numbers = [row[name] for name in ("median_s", "ate_rmse_m", *(f"anees_{block}" for block in JUDGED))]
        return [
            Cell(share, row["share"], interval(100 * row["low"], 100 * row["high"], "{:.0f} %".format)),
            *(Cell(ABSENT) if number is None else Cell(text(number), number) for number in numbers),
        ]

    headings = ["estimator", "converged", "time\ns", "ATE\nm", *(f"ANEES\n{SHORT.get(b, b)}" for b in JUDGED)]
    return Sheet("convergence", note, headings, _grouped(found, cells, len(headings) - 1))


def _grouped(rows: Sequence[Record], cells: Callable[[Sequence[Record]], list[Cell]], columns: int) -> list[Line]:
    """Return a line for each output, below a line with the name of its log."""
    lines = []
    for (log,), of_log in groups(rows, "log").items():
        lines.append(Line(log, [Cell("")] * columns))
        for (label, _), of in groups(of_log, "label", "output").items():
            row = of[0]
            name = label if row["output"] == ONLINE else f"{label}, {lag(row['lookahead_s'])}"
            part = "" if row.get("seeds", row["runs"]) == row["runs"] else f" {row['seeds']}/{row['runs']}"
            lines.append(Line(f"{INDENT}{name}{part}", cells(of)))
    return lines
