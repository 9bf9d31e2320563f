"""What `fathom timing` prints: budgets, a comparison with another revision, counts."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, TypeVar

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..output.tables.terminal import console
from ..results.store import provenance
from .revision import TimingError

Named = TypeVar("Named")
COLOUR = {
    "slower": "red",
    "broken": "red",
    "slower?": "yellow",
    "faster": "green",
    "missed": "red",
    "not measured": "yellow",
}


def print_comparison(
    revision: str, only: str | None, short: bool, limit: float, rounds: int, pairs: int, out: Path | None
) -> bool:
    """Compare with a revision, print and save what came out, and return whether nothing is slower.

    Raises:
        TimingError: nothing can be compared.
    """
    from .benchmarks import BENCHMARKS
    from .comparison import FULL, SHORT, Effort, compare

    usual = SHORT if short else FULL
    effort = Effort(pairs or usual.pairs, rounds or usual.rounds)
    chosen = select([each for each in BENCHMARKS if each.short or not short], only)
    with progress() as advance:
        found = compare(revision, chosen, effort, limit, advance)
    table = Table(
        *("benchmark", "group", "per", "now", "then", "ratio", f"{100 * found.level:.1f} % interval", "verdict"),
        box=box.SIMPLE_HEAD,
        title=f"{found.now} over {found.then}",
        caption=(
            f"processor time, µs; {effort.pairs} pairs of processes, {effort.rounds} turns A B B A each, twice as "
            f"many of both where marked *; slower: the whole interval is above {limit:g}\n{found.environment}"
        ),
        caption_justify="left",
    )
    for column in table.columns[3:7]:
        column.justify = "right"
    for row in found.rows:
        numbers = ["–"] * 4
        if row.ratio is not None:
            numbers = [
                _figures(row.now_us),
                _figures(row.then_us),
                f"{row.ratio:.3f}",
                f"{row.low:.3f} – {row.high:.3f}",
            ]
        verdict = f"{row.verdict}{'*' if row.again else ''}"
        table.add_row(row.name, row.group, row.unit, *numbers, verdict, style=COLOUR.get(row.verdict))
    console().print(table)
    for row in found.rows:
        if row.note:
            print(f"{row.name}: {row.note}")
    save(out, {"comparison": asdict(found) | {"effort": asdict(effort)}})
    slow = [row.name for row in found.rows if row.verdict in ("slower", "broken")]
    print(f"slower or broken: {'; '.join(slow)}" if slow else "nothing is slower")
    return not slow


def print_budgets(only: str | None, out: Path | None) -> bool:
    """Measure every budget of DESIGN, section 8, print and save what came out, and return whether all hold.

    Interrupted, it prints and saves what it has, and raises KeyboardInterrupt.
    """
    from .budgets import BUDGETS, Measured

    chosen = select(BUDGETS, only)
    found: list[tuple[Measured | None, str]] = []
    with progress() as advance:
        for k, budget in enumerate(chosen):
            advance(budget.name, k / len(chosen))
            try:
                found.append((budget.measure(), ""))
            except ModuleNotFoundError as error:
                found.append((None, f"{error.name} is not installed: pip install 'fathom-bench[dev]'"))
            except KeyboardInterrupt:
                break
    table = Table(
        *("what over what", "budget", "measured", "from – to", "verdict", "note"),
        box=box.SIMPLE_HEAD,
        caption="within this command: the median of rounds in which the two take turns, with the least and the largest",
        caption_justify="left",
    )
    for column in table.columns[1:4]:
        column.justify = "right"
    rows = []
    for budget, (measured, missing) in zip(chosen, found, strict=False):
        limit = f"{'≥' if budget.least else '≤'} {budget.limit:g}"
        if measured is None:
            verdict, numbers, note = "not measured", ("–", "–"), missing
        else:
            verdict = "holds" if budget.holds(measured) else "missed"
            numbers = (f"{measured.median:.3g}", f"{min(measured.ratios):.3g} – {max(measured.ratios):.3g}")
            note = "; ".join(filter(None, (measured.note, budget.obstacle if verdict == "missed" else "")))
        table.add_row(budget.name, limit, *numbers, verdict, note, style=COLOUR.get(verdict))
        rows.append({"name": budget.name, "budget": limit, "verdict": verdict, "note": note})
        rows[-1]["ratios"] = [] if measured is None else list(measured.ratios)
    console().print(table)
    save(out, {"budgets": rows})
    if len(found) < len(chosen):
        raise KeyboardInterrupt
    return all(row["verdict"] == "holds" for row in rows)


def print_counters(only: str | None, out: Path | None) -> bool:
    """Print and save the counters of every estimator that has any; there is nothing that could fail in them."""
    from .counters import COUNTED, COUNTERS, count

    names = [name for name in COUNTED if only is None or fnmatch(name, only)]
    if not names:
        raise TimingError(f"--only {only!r} matches nothing; there are: {'; '.join(COUNTED)}")
    found = {}
    with progress() as advance:
        for k, name in enumerate(names):
            advance(name, k / len(names))
            found[name] = count(name)
    table = Table("", *(key.replace("_", "\n") for key in COUNTERS), box=box.SIMPLE_HEAD)
    for name, counters in found.items():
        table.add_row(name, *(f"{counters[key]:,.4g}" if key in counters else "–" for key in COUNTERS))
    for column in table.columns[1:]:
        column.justify = "right"
    console().print(table)
    for key, meaning in COUNTERS.items():
        print(f"{key}: {meaning}")
    save(out, {"counters": found})
    return True


def select(known: Sequence[Named], only: str | None) -> list[Named]:
    """Return those whose name or group matches a pattern.

    Raises:
        TimingError: none does.
    """
    if only is None:
        return list(known)
    names = [(each, (getattr(each, "name", ""), getattr(each, "group", ""))) for each in known]
    chosen = [each for each, of in names if any(fnmatch(name, only) for name in of)]
    if not chosen:
        raise TimingError(f"--only {only!r} matches nothing; there are: {'; '.join(of[0] for _, of in names)}")
    return chosen


def save(out: Path | None, content: Mapping[str, Any]) -> None:
    """Write what was measured, with machine and versions, as JSON.

    Raises:
        TimingError: the file cannot be written.
    """
    if out is None:
        return
    of = provenance()
    made = {"commit": of["commit_id"], "versions": json.loads(of["versions"]), "machine": machine()}
    try:
        out.write_text(json.dumps({**content, **made}, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise TimingError(f"{out}: cannot be written ({error.strerror})") from None


def machine() -> dict[str, Any]:
    """Return what decides how fast a machine is, without its name."""
    of = json.loads(provenance()["machine"])
    return {"cpu": of["cpu"], "cores": of["cores"], "system": f"{platform.system()} {platform.machine()}"}


@contextmanager
def progress() -> Iterator[Any]:
    """Give a function to call with what is going on and the share that is done; draws a bar on a terminal."""
    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)


def _figures(value: float | None) -> str:
    return "–" if value is None else f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
