"""The outcome of a search: data sheet and best trial, on training and held-out runs; printed, written and drawn."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ..drawing import PALETTE, WIDTH_IN, empty_figure, handle, logarithmic, save
from ..errors import ExperimentError
from ..files import writing
from ..metrics.interval import FEWEST_SEEDS
from ..output.tables import terminal
from .objective import EXPECTED, Marks
from .search import Search, Trial, best_of
from .tuning import Tuning

NEAR = 0.01
"""A trial is near the best where its loss is within 1 % of the best's (within 0.01 if it is a distance)."""

FLAT = 3.0
"""A dial hardly matters where trials near the best span more than this factor of it."""

SIDES = ("training", "held out")

EDGE = 1.1
"""A best factor within 10 % of an end of its range may lie beyond it."""


@dataclass(frozen=True)
class Outcome:
    """The end of a search.

    Attributes:
        trials: every one.
        sheet, best: the first trial, with the data sheet's noise, and the one with the smallest loss.
        train: their scores on training runs; None if the data sheet's runs did not finish.
        held_out: their scores on the held-out runs that both finished; None if there are none.
        lost: why held-out runs have no score.
    """

    tuning: Tuning
    trials: Sequence[Trial]
    sheet: Trial
    best: Trial
    train: tuple[Marks | None, Marks]
    held_out: tuple[Marks, Marks] | None
    lost: tuple[str, ...]

    @property
    def warnings(self) -> list[str]:
        """Warnings about the best trial, above all that its gain is not confirmed on held-out runs."""
        found = list(self.lost)
        low, high = self.tuning.low, self.tuning.high
        for dial, factor in self.best.factors.items():
            if factor < low * EDGE or factor > high / EDGE:
                found.append(f"{dial}: the best factor, {factor:.3g}, is at an end of its range; widen it by --span")
        if self.best.number == 0 or self.sheet.loss is None or self.best.loss is None:
            return found
        if self.held_out is None:
            return [*found, "no held-out run has a score: the gain on training is not confirmed"]
        trained = self.tuning.objective.gain_of(self.best.loss, self.sheet.loss)
        gained, interval = self.tuning.objective.gain(*reversed(self.held_out))
        low, high = interval or (gained, math.inf if gained >= trained / 2 else gained)  # too few for one
        if low <= 0:
            found.append(
                f"the gain on training ({self.words(trained)}) is not confirmed on held-out runs "
                f"({self.words(gained, interval)}): keep the data sheet, or train on more logs"
            )
        elif high < trained:
            found.append(
                f"training and held-out runs differ: a gain of {self.words(trained)} on training, of "
                f"{self.words(gained, interval)} on held-out runs: expect no more than the latter"
            )
        return found

    @property
    def near_best(self) -> list[Trial]:
        """The trials whose loss is near that of the best, see NEAR."""
        best = self.best.loss or 0.0
        limit = best + NEAR if self.tuning.objective.is_distance else best * (1 + NEAR)
        return [trial for trial in self.trials if trial.loss is not None and trial.loss <= limit]

    def near(self, dial: str) -> tuple[float, float]:
        """Return the smallest and the largest factor of a dial among the trials near the best."""
        factors = [trial.factors[dial] for trial in self.near_best]
        return min(factors), max(factors)

    def spec(self) -> str:
        """Return the tuned estimator as YAML, ready for `estimators:`; factors to three figures."""
        of = self.tuning.estimator
        factors = {dial: float(f"{factor:.3g}") for dial, factor in self.best.factors.items()}
        entry = {"name": of.name, "label": f"{of.label} tuned", "with": self.tuning.options(factors)}
        return yaml.safe_dump([entry], default_flow_style=None, sort_keys=False, width=110)

    def words(self, gain: float, interval: tuple[float, float] | None = None) -> str:
        """Return a gain as text."""
        if self.tuning.objective.is_distance:
            bounds = "" if interval is None else f" [{interval[0]:.3g}, {interval[1]:.3g}]"
            return f"{gain:.3g}{bounds} closer in logarithm"
        bounds = "" if interval is None else f" [{_percent(interval[0])}, {_percent(interval[1])}]"
        return f"{_percent(gain)}{bounds} %"


def _percent(gain: float) -> str:
    return f"{100 * -math.expm1(-gain):.2g}"


def run_with_bar(search: Search, trials: int, jobs: int = 0) -> None:
    """Run the search, then the data sheet and the best on held-out runs, with a progress bar."""
    columns = (TextColumn("{task.fields[what]}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("{task.description}", markup=False))  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("", what="trials", total=trials)
        for at in search.run(trials, jobs):
            best = "" if at.best is None else f"best so far: trial {at.best.number}, {at.best.loss:.4g}"
            bar.update(task, completed=at.known, total=max(at.trials, at.known), description=best)
        known = search.trials()
        last = {trial.number: trial for trial in (known[0], best_of(known) or known[0])}
        task = bar.add_task("", what="held out", total=len(last) * len(search.tuning.split.held_out))
        for _ in search.run_held_out(list(last.values()), jobs):
            bar.update(task, advance=1)


def judge(search: Search) -> Outcome:
    """Score the data sheet and the best on training runs and, as far as they exist, on held-out runs.

    Raises:
        ExperimentError: no trial finished.
    """
    tuning, trials = search.tuning, search.trials()
    objective, sheet, best = tuning.objective, trials[0], best_of(trials)
    if best is None:
        raise ExperimentError(f"{tuning.estimator.label}: no trial finished; {sheet.cause}")
    lost, pairs = [], []
    for run in tuning.split.held_out:
        rows = [row for trial in (sheet, best) for row in search.rows(trial.number, [run])]
        causes = [cause for row in rows if (cause := objective.lacking(row)) is not None]
        lost += [f"held out, {cause}" for cause in dict.fromkeys(causes)]
        if not causes and len(rows) == 2:
            pairs.append(rows)
    of_sheet, of_best = ([pair[k] for pair in pairs] for k in (0, 1))
    held_out = (objective.marks(of_sheet), objective.marks(of_best)) if pairs else None
    of_sheet, of_best = (search.rows(trial.number, tuning.split.train) for trial in (sheet, best))
    train = (None if sheet.loss is None else objective.marks(of_sheet), objective.marks(of_best))
    return Outcome(tuning, trials, sheet, best, train, held_out, tuple(lost))


def write_outcome(outcome: Outcome) -> list[Path]:
    """Write trials.csv, tuned.yaml and the figure into the folder of the search, and return the files.

    Raises:
        ExperimentError: they cannot be written.
    """
    folder = outcome.tuning.folder
    table, spec = folder / "trials.csv", folder / "tuned.yaml"
    with writing(folder, "; the trials are kept"):
        with table.open("w", encoding="utf-8", newline="") as file:
            write = csv.writer(file).writerow
            write(["trial", *outcome.tuning.dials, "loss", "cause"])
            for trial in outcome.trials:
                write([trial.number, *(trial.factors[dial] for dial in outcome.tuning.dials), trial.loss, trial.cause])
        spec.write_text(outcome.spec(), encoding="utf-8")
        return [table, spec, *save(draw_search(outcome), folder / "factors")]


def draw_search(outcome: Outcome) -> Figure:
    """Draw each trial's training loss against each factor; mark the data sheet, the best, and trials near the best."""
    tuning, columns = outcome.tuning, min(3, len(outcome.tuning.dials))
    lines = -(-len(tuning.dials) // columns)
    figure, panels = empty_figure(lines, columns, WIDTH_IN, 0.9 + 2.0 * lines, share_x=False)
    good = [trial for trial in outcome.trials if trial.loss is not None]
    bad = [trial for trial in outcome.trials if trial.loss is None]
    marks = ((good, "o", PALETTE[0], 3), ([outcome.sheet], "s", "black", 5), ([outcome.best], "*", PALETTE[1], 11))
    for axes, dial in zip(panels, tuning.dials, strict=False):
        axes.axvspan(*outcome.near(dial), color=PALETTE[1], alpha=0.12, linewidth=0)
        for trials, marker, colour, size in marks:
            points = [(trial.factors[dial], trial.loss) for trial in trials if trial.loss is not None]
            axes.plot(*zip(*points, strict=True) if points else ([], []), marker=marker, color=colour, markersize=size,
                      linestyle="none", alpha=0.5 if trials is good else 1.0)  # fmt: skip
        top = axes.get_xaxis_transform()
        axes.plot([t.factors[dial] for t in bad], [0.97] * len(bad), "x", color=PALETTE[6], markersize=4, transform=top)
        axes.set_xlim(tuning.low, tuning.high)
        logarithmic(axes, "x" if tuning.objective.is_distance else "xy")
        axes.set_xlabel(f"factor on the sigma of {dial}")
    for axes in panels[::columns]:
        axes.set_ylabel(
            f"|ln {tuning.objective.score} / expected|" if tuning.objective.is_distance else tuning.objective.score
        )
    for axes in panels[len(tuning.dials) :]:
        axes.set_visible(False)
    figure.suptitle(
        f"{tuning.estimator.label}: {len(outcome.trials)} trials on {len(tuning.split.train)} runs", fontsize=10
    )
    handles = [
        handle("trial", "o", PALETTE[0], True),
        handle("data sheet", "s", "black", True),
        handle("best; shaded: trials within 1 % of it", "*", PALETTE[1], True),
    ] + ([handle("did not finish", "x", PALETTE[6], True)] if bad else [])
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def print_outcome(outcome: Outcome, console: Console | None = None) -> None:
    """Print the scores, the factors with their sharpness, the warnings, and the YAML to paste."""
    console = console or terminal.console()
    tuning = outcome.tuning
    runs = (len(tuning.split.train), len(outcome.held_out[0].values) if outcome.held_out else 0)
    headings = [f"{side}, {n} {'run' if n == 1 else 'runs'}" for side, n in zip(SIDES, runs, strict=True)]
    title = Text(f"{tuning.estimator.label}: {tuning.objective.score}", "table.title")
    scores = Table("", *headings, title=title, title_justify="left", box=box.SIMPLE_HEAD)
    scores.caption, scores.caption_justify = _caption(outcome), "left"
    held = outcome.held_out or (None, None)
    scores.add_row("data sheet", _score(tuning, outcome.train[0], False), _score(tuning, held[0], True))
    scores.add_row(f"best, trial {outcome.best.number}", *(
        _score(tuning, marks, interval) for marks, interval in ((outcome.train[1], False), (held[1], True))
    ))  # fmt: skip
    console.print(scores)
    near = f"within 1 % of it: {len(outcome.near_best)} of {len(outcome.trials)} trials"
    factors = Table("factor on sigma", "best", near, "", box=box.SIMPLE_HEAD)
    for dial in tuning.dials:
        low, high = outcome.near(dial)
        says = "hardly matters to this score" if high / low > FLAT else ""
        factors.add_row(dial, f"{outcome.best.factors[dial]:.3g}", f"{low:.3g} to {high:.3g}", says)
    console.print(factors)
    if outcome.best.number == 0:
        console.print("no trial was better than the data sheet")
    for warning in outcome.warnings:
        console.print(f"warning: {warning}", style="red", highlight=False, markup=False, soft_wrap=True)
    console.print(outcome.spec(), highlight=False, markup=False, soft_wrap=True)


def _score(tuning: Tuning, marks: Marks | None, with_interval: bool) -> str:
    if marks is None:
        return "–"
    value = f"{float(tuning.objective.taken(*marks)):.4g}"
    interval = tuning.objective.interval(marks) if with_interval else None
    return value if interval is None else f"{value} [{interval[0]:.4g}, {interval[1]:.4g}]"


def _few(outcome: Outcome) -> bool:
    return outcome.held_out is None or len(outcome.held_out[0].values) < FEWEST_SEEDS


def _caption(outcome: Outcome) -> str:
    expected = EXPECTED.get(outcome.tuning.objective.score)
    says = "" if expected is None else f"{expected:.3g} if consistent; "
    few = "too few held-out runs for an interval" if _few(outcome) else "intervals: 95 %, over runs"
    if outcome.held_out is None or outcome.best.number == 0 or outcome.best.loss is None:
        return f"{says}{few}"
    gained, interval = outcome.tuning.objective.gain(*reversed(outcome.held_out))
    return f"{says}{few}; gain on held-out runs: {outcome.words(gained, interval)}"
