"""Compare the speed of two revisions, with a verdict that a busy machine does not change.

Each revision has a process, and the two take turns A B B A, so that what slows the machine slows both. Processor time
is compared, since other processes take their share of the clock; and of two turns of one side the faster one, since
noise only adds. Two processes of the same code still differ by some per cent for as long as they live, by where things
lie in memory. Taking turns does not remove that, so there are several pairs of processes. The interval is a bootstrap
over pairs and, within them, over turns.

The intervals hold for all benchmarks together (Bonferroni). A benchmark slower than the limit is measured again, by
twice as many new pairs of twice as many turns. It counts as slower if its whole second interval is above the limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from ..output.tables.terminal import console
from . import benchmarks
from .benchmarks import Benchmark
from .printing import COLOUR, TimingError, progress, save, select
from .revision import PREFIX, Side, checked_out, started, working_tree

Array = NDArray[np.float64]
Verdict = Literal["slower", "slower?", "same", "faster", "new", "broken"]

CONFIDENCE = 0.95
"""That all intervals together hold."""

LEAST_S = 0.02
"""A turn is repeated until it takes this long, s: a shorter one measures the clock."""

RESAMPLES = 5_000
"""The ends of a 99.8 % interval are then the fifth resamples from either side."""


@dataclass(frozen=True)
class Effort:
    """How much is measured: pairs of processes, and turns A B B A of each pair."""

    pairs: int
    rounds: int

    def doubled(self) -> Effort:
        """Return twice as much of both."""
        return Effort(2 * self.pairs, 2 * self.rounds)


FULL, SHORT = Effort(5, 4), Effort(3, 3)
"""Enough to find a slowdown of 20 % on a busy machine (`test_comparison`); the short one takes a minute or two."""


@dataclass(frozen=True)
class Compared:
    """The result of one benchmark in both revisions.

    Attributes:
        name, group, unit: of the benchmark.
        now_us, then_us: processor time per unit, µs, the median over turns; None where it cannot run.
        ratio, low, high: now over then, with its interval.
        again: whether it was measured twice; the numbers are then those of the second time.
        verdict: "slower": the whole interval is above the limit; "slower?": only the ratio is; "faster": the whole
            interval is below 1 / limit; "new": the other revision cannot run it; "broken": the working tree cannot.
        note: why it cannot run, or that the two did different amounts of work.
    """

    name: str
    group: str
    unit: str
    verdict: Verdict
    now_us: float | None = None
    then_us: float | None = None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    again: bool = False
    note: str = ""


@dataclass(frozen=True)
class Comparison:
    """The result of all benchmarks, and how they were measured."""

    now: str
    then: str
    environment: str
    limit: float
    level: float
    rows: tuple[Compared, ...]

    @property
    def failed(self) -> list[str]:
        """Names of what is slower or broken."""
        return [row.name for row in self.rows if row.verdict in ("slower", "broken")]


Progress = Callable[[str, float], None]
"""Called with what is being done, and the share of all work that is finished."""


def compare(revision: str, chosen: Sequence[Benchmark], effort: Effort, limit: float, progress: Progress) -> Comparison:
    """Compare the working tree with a revision.

    Raises:
        TimingError: there is no such revision, or nothing to run it with.
    """
    ours = working_tree()
    with TemporaryDirectory(prefix=PREFIX) as temporary:
        folder = Path(temporary)
        progress(f"checking out {revision}", 0.0)
        with checked_out(revision, folder) as theirs:
            now = Side(ours, ours.packages(folder / "now"), folder / "inputs")
            then = Side(theirs, theirs.packages(folder / "then"), folder / "inputs")
            progress("writing logs", 0.02)
            benchmarks.write_inputs(folder / "inputs", chosen)
            units, broken = _warm_up(now, then, chosen, progress)
            runnable = [each for each in chosen if each.name in units]
            level = 1 - (1 - CONFIDENCE) / max(len(runnable), 1)
            rows = _measure(now, then, runnable, units, effort, limit, level, progress)
            slow = [each for each in runnable if (rows[each.name].ratio or 0.0) > limit]
            if slow:
                twice = effort.doubled()
                second = _measure(now, then, slow, units, twice, limit, level, progress, again=True)
                rows |= second
    rows |= broken
    return Comparison(
        ours.name, theirs.name, theirs.environment, limit, level, tuple(rows[each.name] for each in chosen)
    )


def _warm_up(
    now: Side, then: Side, chosen: Sequence[Benchmark], progress: Progress
) -> tuple[dict[str, int], dict[str, Compared]]:
    """Compile everything in both trees; return the repeats of each benchmark, and the rows of those that cannot run.

    The processes that compiled end here. The processes that are timed load compiled code, all of them alike.
    """
    answers: list[dict[str, dict[str, Any]]] = []
    for side in (now, then):
        with started(side) as (worker,):
            found = {}
            for k, each in enumerate(chosen):
                progress(f"compiling {each.name} of {side.tree.name}", 0.05 + 0.05 * (len(answers) + k / len(chosen)))
                found[each.name] = worker.ask(prepare=each.name)
        answers.append(found)
    repeats, rows = {}, {}
    for each in chosen:
        ours, theirs = (found[each.name] for found in answers)
        if "lacks" in ours:
            rows[each.name] = Compared(each.name, each.group, each.unit, "broken", note=ours["lacks"])
        elif "lacks" in theirs:
            rows[each.name] = Compared(each.name, each.group, each.unit, "new", note=theirs["lacks"])
        else:
            repeats[each.name] = math.ceil(LEAST_S / max(min(ours["cpu_s"], theirs["cpu_s"]), 1e-6))
    return repeats, rows


def _measure(
    now: Side,
    then: Side,
    chosen: Sequence[Benchmark],
    repeats: Mapping[str, int],
    effort: Effort,
    limit: float,
    level: float,
    progress: Progress,
    again: bool = False,
) -> dict[str, Compared]:
    """Time every benchmark on both sides, in turns, and compare."""
    seconds = {each.name: np.zeros((effort.pairs, effort.rounds, 4)) for each in chosen}
    units: dict[str, tuple[int, int]] = {}
    for pair in range(effort.pairs):
        with started(now, then) as workers:
            for each in chosen:
                for worker in workers:
                    worker.send(prepare=each.name)
                found = [worker.receive() for worker in workers]
                if any("lacks" in one for one in found):
                    raise TimingError(f"{each.name}: ran the first time but not the second: {found}")
                units[each.name] = (found[0]["units"], found[1]["units"])
            for turn in range(effort.rounds):
                done = (pair + turn / effort.rounds) / effort.pairs
                progress(f"{'measuring again' if again else 'measuring'}, pair {pair + 1}", 0.15 + 0.85 * done)
                for each in chosen:
                    order = workers if turn % 2 == 0 else workers[::-1]
                    for k, worker in enumerate((order[0], order[1], order[1], order[0])):
                        answer = worker.ask(time=each.name, repeat=repeats[each.name])
                        place = (0, 2, 3, 1)[k] if turn % 2 == 0 else (2, 0, 1, 3)[k]
                        seconds[each.name][pair, turn, place] = answer["cpu_s"]
    rows = {}
    for each in chosen:
        ratio, low, high = ratio_of(seconds[each.name], level)
        ours_us, theirs_us = (
            float(np.median(seconds[each.name][:, :, of])) / n * 1e6
            for of, n in zip((slice(0, 2), slice(2, 4)), units[each.name], strict=True)
        )
        note = "" if len(set(units[each.name])) == 1 else "{} units now, {} then".format(*units[each.name])
        verdict = verdict_of(ratio, low, high, limit)
        rows[each.name] = Compared(
            each.name, each.group, each.unit, verdict, ours_us, theirs_us, ratio, low, high, again, note
        )
    return rows


def verdict_of(ratio: float, low: float, high: float, limit: float) -> Verdict:
    """Return the verdict on a ratio with its interval."""
    if low > limit:
        return "slower"
    if ratio > limit:
        return "slower?"
    return "faster" if high < 1 / limit else "same"


def ratio_of(seconds: Array, level: float, seed: int = 0) -> tuple[float, float, float]:
    """Return now over then, and its bootstrap interval.

    The ratio is the median over all turns, of the faster of two calls. The bootstrap resamples pairs, and turns within
    each pair.

    Args:
        seconds: (pairs, rounds, 4); the last axis is now, now, then, then.
        level: of the interval.
        seed: of the draws.
    """
    logs = np.log(seconds[..., :2].min(axis=-1) / seconds[..., 2:].min(axis=-1))
    pairs, rounds = logs.shape
    rng = np.random.default_rng(seed)
    drawn = rng.integers(pairs, size=(RESAMPLES, pairs))
    turns = rng.integers(rounds, size=(RESAMPLES, pairs, rounds))
    medians = np.median(logs[drawn[:, :, None], turns].reshape(RESAMPLES, -1), axis=1)
    low, high = np.quantile(medians, [(1 - level) / 2, (1 + level) / 2])
    return math.exp(np.median(logs)), math.exp(low), math.exp(high)


def print_comparison(
    revision: str, only: str | None, short: bool, limit: float, rounds: int, pairs: int, out: Path | None
) -> bool:
    """Compare with a revision, print and save the result, and return whether nothing is slower.

    Raises:
        TimingError: nothing can be compared.
    """
    usual = SHORT if short else FULL
    effort = Effort(pairs or usual.pairs, rounds or usual.rounds)
    chosen = select([each for each in benchmarks.BENCHMARKS if each.short or not short], only)
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
    print(f"slower or broken: {'; '.join(found.failed)}" if found.failed else "nothing is slower")
    return not found.failed


def _figures(value: float | None) -> str:
    return "–" if value is None else f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
