"""The terminal output of `fathom reproduce`: repeated runs against stored ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import median
from textwrap import shorten

from rich.console import Console

from ...execution.reproduce import Again, Difference, Value, changed_facts
from ..cells import ABSENT, Cell
from ..sheets import Line, Sheet
from . import terminal
from .table import print_sheet

WIDEST = 44
"""Letters of a value in a cell: one such, a name and an output fit 80 columns, two fit 120."""
HEADINGS = ("log / label", "runs", "verdict", "then", "now", "difference", "relative")

ROUNDING = (
    "versions or kind of machine differ, so sums are rounded differently: expect relative differences of about 1e-10, "
    "more only where rounding tips a threshold (a gate, a relinearisation); see docs/reproduce.md"
)
CODE = "the code has changed: differences of any size may be intended; see the commits in between"
SAME = "code, versions and kind of machine are the same, so the scores must be identical, bit for bit"


def print_reproduction(every: Sequence[Again], console: Console | None = None) -> None:
    """Print what has changed, a verdict per estimator and output, what could not be run, and the total.

    Of a single run every score that differs is listed; of several the one that differs most in each group.
    """
    console = console or terminal.console()
    run = [again for again in every if again.skipped is None]
    if run:
        _print_facts(run, console)
        print_sheet(_verdicts(run, most=None if len(run) == 1 else 1), console)
    for line in _sentences(every):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _print_facts(run: Sequence[Again], console: Console) -> None:
    """Print what has changed in code, versions and machine, and which differences to expect from that."""
    counts = Counter((fact.name, fact.then, fact.now) for again in run for fact in changed_facts(again.stored))
    if counts:
        lines = []
        for (name, then, now), n in counts.items():
            texts = [_short_hash(each) if name in ("commit", "code") else _text(each) for each in (then, now)]
            lines.append(Line(name, [Cell(text) for text in (*texts, f"{n}/{len(run)}")]))
        print_sheet(Sheet("", [], ("made with", "then", "now", "runs"), lines), console)
    names = {name for name, _, _ in counts} - {"commit"}
    sentence = CODE if "code" in names else ROUNDING if names else SAME
    console.print(sentence, highlight=False, markup=False, soft_wrap=True)
    console.print()


def _verdicts(run: Sequence[Again], most: int | None) -> Sheet:
    """Return a row per log, label and output if all is identical, else one for each of the `most` worst scores."""
    lines = []
    grouped: dict[tuple[str, str], list[Again]] = {}
    for again in sorted(run, key=lambda again: again.stored.group):
        for output in again.differences:
            grouped.setdefault((again.stored.group, output), []).append(again)
    for (group, output), of_group in grouped.items():
        same = sum(not again.differences[output] for again in of_group)
        worst = sorted(
            ((each, again) for again in of_group for each in again.differences[output]),
            key=lambda pair: -pair[0].relative,
        )
        whose, runs = output, f"{same}/{len(of_group)}"
        if not worst:
            lines.append(_line(group, whose, [runs, "identical", "", "", "", ""]))
        for each, again in _listed(worst)[:most]:
            seed = "" if most is None or again.stored.first["seed"] is None else f" (seed {again.stored.first['seed']})"
            lines.append(_line(group, whose, [runs, f"{each.name}{seed}", *_difference(each)]))
            whose, runs = "", ""
    return Sheet("", [], HEADINGS, lines, section="output")


def _line(group: str, output: str, texts: Sequence[str]) -> Line:
    return Line(group, [Cell(text) for text in texts], section=output)


def _listed(worst: Sequence[tuple[Difference, Again]]) -> list[tuple[Difference, Again]]:
    """Return the differences; of those of the NEES at fixed times only the first."""
    at_times = [pair for pair in worst if pair[0].name.startswith("nees_at.")]
    return [pair for pair in worst if pair not in at_times[1:]]


def _difference(each: Difference) -> list[str]:
    if each.absolute is None:
        return [_text(each.then), _text(each.now), "", ""]
    return [_text(each.then), _text(each.now), f"{each.absolute:+.1e}", f"{each.relative:.1e}"]


def _sentences(every: Sequence[Again]) -> list[str]:
    """Return the remarks about single runs, and the total."""
    remarks = [(remark, again.stored.name) for again in every for remark in again.remarks]
    remarks += [(f"not run again: {again.skipped}", again.stored.name) for again in every if again.skipped is not None]
    names: dict[str, list[str]] = {}
    for sentence, name in remarks:
        names.setdefault(sentence, []).append(name)
    lines = [f"{_several(of)}: {sentence}" for sentence, of in names.items()]
    run = [again for again in every if again.skipped is None]
    ratios = [again.time_ratio for again in run if again.time_ratio is not None]
    took = f"; computing took {median(ratios):.2f} times as long (median; not compared)" if ratios else ""
    same = sum(again.is_identical for again in run)
    lines.append(f"{same} of {len(run)} runs came out identical, bit for bit{took}")
    return lines


def _several(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _short_hash(value: Value) -> str:
    digest, *edited = str(value or ABSENT).split("-", 1)
    return "-".join([digest[:12], *edited])


def _text(value: Value) -> str:
    if value is None or value == "":
        return ABSENT
    return shorten(value, WIDEST, placeholder="…") if isinstance(value, str) else f"{value:.12g}"
