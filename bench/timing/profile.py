"""Where an estimator's time goes, the same split for every estimator: a table, bars, and by lag and over a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console

from ...datasets import Log, Scenario, simulate
from ...estimators.interface import Estimator
from ...estimators.registry import ESTIMATORS, create, package_of
from ..drawing import PALETTE, WIDTH_IN, empty_figure, looks_of, save
from ..files import write_csv
from ..output.cells import ABSENT, Cell
from ..output.sheets import Line, Sheet
from ..output.tables import terminal
from ..output.tables.table import print_sheet
from ..results.store import provenance
from .passes import PARTS, Timed, quickest, stopwatch
from .printing import machine_text, made
from .scaling import by_lag, draw_by_lag, draw_over_log, growth_text, over_log

ABOUT = (
    "propagation: IMU block, preintegration, prediction of state and covariance · linearisation: residuals and "
    "Jacobians of a smoother, factors made, GTSAM's calls of our factors · solve: a filter's whole update; a "
    "smoother's factorisation and back-substitution, and GTSAM's own linearisation and marginalisation, which cannot "
    "be told apart from outside · marginal: covariance of a state, marginalisation · output: beliefs, smoothed states "
    "written down · rest: readings sorted, Python, all else"
)
REPEATS = 5
"""Of each log; the quickest of each step is kept, so that interruptions do not count."""
EVERY = "all"
SHORT_S, LONG_S = 90.0, 1200.0
"""Length of the log for the split and the lags, three times the longest lag; and of that for the course over a log."""
LONGEST_S = {"isam2": 300.0, "batch": 300.0, "fls-batch": 300.0}
"""Length of the latter for estimators whose cost grows, or that would take too long."""

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Profile:
    """What the steps and beliefs of one estimator are made of, on one log.

    Attributes:
        label: the estimator's.
        timed: with stages timed; of each step the quickest of the repeats.
        plain_ns: all steps and beliefs without; of each the quickest of the repeats.
    """

    label: str
    timed: Timed
    plain_ns: int

    @property
    def shares(self) -> dict[str, float]:
        """Share of each of PARTS; they add up to 1."""
        parts_ns = self.timed.parts_ns
        return dict(zip(PARTS, (parts_ns / parts_ns.sum()).tolist(), strict=True))

    @property
    def accounted(self) -> float:
        """All parts over what the harness's own clock says of the same run."""
        return float(self.timed.parts_ns.sum() / self.timed.whole_ns)

    @property
    def overhead(self) -> float:
        """What timing the stages adds, as a share of the time without."""
        return self.timed.whole_ns / self.plain_ns - 1

    @property
    def keyframes(self) -> int | None:
        """Number of keyframes of a smoother; None where there are none."""
        return self.timed.counts.get("keyframes")

    def record(self) -> dict[str, float | str | None]:
        """Return the row of a table: times without timing the stages, shares with it."""
        return {
            "estimator": self.label,
            "us_per_step": self.plain_ns / len(self.timed.step_ns) / 1e3,
            "us_per_imu_sample": self.plain_ns / self.timed.imu_samples / 1e3,
            "us_per_keyframe": self.plain_ns / self.keyframes / 1e3 if self.keyframes else None,
            **{f"{part}_share": share for part, share in self.shares.items()},
            "finish_ms": self.timed.finish_ns / 1e6,
            "accounted": self.accounted,
            "timing_adds": self.overhead,
        }


def profile(
    estimators: Mapping[str, Estimator], log: Log, repeats: int = REPEATS, tell: Tell = lambda doing: None
) -> list[Profile]:
    """Return the profile of each estimator on a log, in their order; runs with stages timed and without take turns.

    Args:
        estimators: by label. An estimator that marks no stages is all rest.
        log: all of them run on it.
        repeats: of each run.
        tell: called with what is being done.

    Raises:
        EstimatorError: an estimator did not reach the end.
    """
    profiles = []
    with stopwatch() as process:
        for label, estimator in estimators.items():
            tell(f"{label}: compiling, if this is the first time")
            process.warm_up(estimator)
            staged, plain = [], []
            for k in range(repeats):
                tell(f"{label}: run {k + 1} of {repeats}")
                staged.append(process.run(log, estimator, stages=True))
                plain.append(process.run(log, estimator))
            profiles.append(Profile(label, quickest(staged), quickest(plain).whole_ns))
    return profiles


def profile_sheet(profiles: Sequence[Profile], title: str) -> Sheet:
    """Return the table of profiles for the terminal."""
    headings = ["estimator", *(f"µs per\n{what}" for what in ("step", "IMU sample", "keyframe"))]
    headings += [*(f"share, %\n{part}" for part in PARTS), "finish\nms", "timing adds\n%"]
    lines = []
    for one in profiles:
        row = one.record()
        times = [row["us_per_step"], row["us_per_imu_sample"], row["us_per_keyframe"]]
        texts = [ABSENT if us is None else _us(float(us)) for us in times]
        texts += [f"{100 * share:.1f}" for share in one.shares.values()]
        texts += [f"{one.timed.finish_ns / 1e6:,.1f}", f"{100 * one.overhead:.0f}"]
        lines.append(Line(one.label, [Cell(text) for text in texts]))
    return Sheet(title, [], headings, lines)


def _us(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def draw_profile(profiles: Sequence[Profile], title: str) -> Figure:
    """Draw the shares as one bar per estimator, with the time of its step beside it."""
    figure, (axes,) = empty_figure(1, 1, WIDTH_IN, 1.1 + 0.3 * len(profiles))
    places = range(len(profiles), 0, -1)
    left = [0.0] * len(profiles)
    for part, colour in zip(PARTS, (*PALETTE[:5], "#D0D0D0"), strict=True):
        widths = [100 * one.shares[part] for one in profiles]
        axes.barh(list(places), widths, left=left, height=0.7, color=colour, label=part)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    for place, one in zip(places, profiles, strict=True):
        axes.text(101, place, f"{_us(one.plain_ns / len(one.timed.step_ns) / 1e3)} µs", va="center", fontsize=7)
    axes.set_yticks(list(places), [one.label for one in profiles])
    axes.set_xlim(0, 112)
    axes.set_xticks(range(0, 101, 20))
    axes.set_xlabel("share of the time of steps and beliefs, %; at the right, mean per step")
    axes.set_title(title, fontsize=9)
    axes.grid(visible=False, axis="y")
    figure.legend(loc="outside lower center", ncols=len(PARTS), frameon=False, fontsize=8)
    return figure


def print_profile(names: Sequence[str], folder: Path | None) -> None:
    """Print and draw where the time of these estimators goes, by stage, by lag and over a log.

    Args:
        names: of estimators; "all" for every one of ours.
        folder: for profile.csv and the figures; default: results/profile.

    Raises:
        EstimatorError: an estimator is not known, or did not reach the end.
        TimingError: the folder cannot be made.
    """
    chosen = list(dict.fromkeys(each for name in names for each in (ESTIMATORS if name == EVERY else (name,))))
    estimators = {name: create(name) for name in chosen}
    folder = made(folder or Path("results") / "profile")
    looks = looks_of(list(ESTIMATORS | estimators))
    console = Console(stderr=True)
    with console.status("") as status:
        log = _survey(SHORT_S)
        profiles = profile(estimators, log, tell=status.update)
        lags = by_lag(estimators, log, tell=status.update)
        courses = {}
        for duration_s in sorted({LONGEST_S.get(name, LONG_S) for name in chosen}):
            some = {name: one for name, one in estimators.items() if LONGEST_S.get(name, LONG_S) == duration_s}
            courses |= over_log(some, _survey(duration_s), tell=status.update)
    files = [folder / "profile.csv"]
    write_csv(pd.DataFrame([one.record() for one in profiles]), files[0])
    title = f"{log.name}, {log.duration_s:.0f} s"
    files += save(draw_profile(profiles, f"{title}: where the time goes"), folder / "profile")
    files += save(draw_by_lag(lags, looks, f"{title}: steps against lag"), folder / "step-against-lag")
    files += save(draw_over_log(courses, looks, f"{log.name}: steps against time in the log"), folder / "step-over-log")

    out = terminal.console()
    print_sheet(profile_sheet(profiles, title), out)
    out.print(ABOUT)
    out.print(f"{title}; of each step the quickest of {REPEATS} repeats; µs with no stage timed, shares with all timed")
    out.print(machine_text(provenance()["machine"], provenance()["versions"]))
    for name in chosen:
        if package_of(name) is not None:
            out.print(f"{name} is from another package: what it does not mark as a stage is rest")
    for label, by in lags.items():
        if None not in by:
            out.print(f"{label}, ms per second at lag: " + ", ".join(f"{lag:g} s {ms:.3g}" for lag, ms in by.items()))
    for label, one in courses.items():
        out.print(f"{label}, over {one.t_s[-1] / 60:.0f} minutes: {growth_text(one)}")
    console.print(f"{folder}: {', '.join(file.name for file in files)}", highlight=False)


def _survey(duration_s: float) -> Log:
    return simulate(Scenario(mission="lawnmower", duration_s=duration_s, imu="tactical"), seed=1)
