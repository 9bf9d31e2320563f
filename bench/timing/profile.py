"""Where a step's time goes, the same split for every estimator: a table, and bars."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure
from rich import box
from rich.table import Table

from ...datasets.log import Log
from ...estimators.interface import Estimator
from ..output.figures.drawing import PALETTE, WIDTH_IN, empty_figure
from .driver import PARTS as NAMES
from .driver import Driver, Timed, quickest

PARTS = ("propagation", "linearisation", "solve", "marginal", "output", "rest")
ABOUT = (
    "propagation: IMU block, preintegration, state and covariance predicted · linearisation: residuals, Jacobians, "
    "factors made, GTSAM's calls of ours · solve: gain, or factorisation and back-substitution; in GTSAM also its own "
    "linearisation and its marginalising, which cannot be told apart from outside · marginal: covariance of a state, "
    "marginalising · output: beliefs, and writing hindsight down · rest: readings sorted, Python, all else"
)
REPEATS = 5

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Profile:
    """What one estimator's steps and beliefs are made of, on one log.

    Attributes:
        label: the estimator's.
        timed: with probes, of each step the quickest of the repeats.
        plain_ns: all steps and beliefs without probes, of each the quickest of the repeats.
        compiled_s: time until it was warm with probes, compiling included if it was the first time.
    """

    label: str
    timed: Timed
    plain_ns: int
    compiled_s: float

    @property
    def shares(self) -> dict[str, float]:
        """Share of each of PARTS; they add up to 1."""
        parts_ns = dict(zip(NAMES, self.timed.parts_ns.tolist(), strict=True))
        return {part: parts_ns[part] / self.timed.parts_ns.sum() for part in PARTS}

    @property
    def accounted(self) -> float:
        """All parts over what the harness's own clock says of the same run."""
        return float(self.timed.parts_ns.sum() / self.timed.whole_ns)

    @property
    def overhead(self) -> float:
        """What the probes add, as a share of the time without them."""
        return self.timed.whole_ns / self.plain_ns - 1

    @property
    def keyframes(self) -> int | None:
        """Of a smoother; None where there are none."""
        return self.timed.counts.get("keyframes")

    def record(self) -> dict[str, float | str | None]:
        """Return the row of a table: times without probes, shares with them."""
        return {
            "estimator": self.label,
            "us_per_step": self.plain_ns / len(self.timed.step_ns) / 1e3,
            "us_per_imu_sample": self.plain_ns / self.timed.imu_samples / 1e3,
            "us_per_keyframe": self.plain_ns / self.keyframes / 1e3 if self.keyframes else None,
            **{f"{part}_share": share for part, share in self.shares.items()},
            "finish_ms": self.timed.finish_ns / 1e6,
            "accounted": self.accounted,
            "probes_add": self.overhead,
        }


def profile(
    estimators: Mapping[str, Estimator], log: Log, repeats: int = REPEATS, tell: Tell = lambda doing: None
) -> list[Profile]:
    """Return the profile of each estimator on a log, in their order; runs with probes and without take turns.

    Args:
        estimators: by label. Of another package's estimator it shows what that calls of ours, and the rest.
        log: which all of them go through.
        repeats: of each run.
        tell: told what is being done.

    Raises:
        EstimatorError: one did not come to the end.
    """
    profiles = []
    with Driver(probed=True) as probed, Driver(probed=False) as plain:
        for label, estimator in estimators.items():
            tell(f"{label}: compiling with probes, if this is the first time")
            compiled_s = probed.warm_up(estimator)
            plain.warm_up(estimator)
            with_probes, without = [], []
            for k in range(repeats):
                tell(f"{label}: run {k + 1} of {repeats}")
                with_probes.append(probed.run(log, estimator))
                without.append(plain.run(log, estimator))
            profiles.append(Profile(label, quickest(with_probes), quickest(without).whole_ns, compiled_s))
    return profiles


def profile_table(profiles: Sequence[Profile]) -> Table:
    """Return the table of profiles for the terminal."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    table.add_column("estimator")
    headings = ("µs per\nstep", "IMU\nsample", "key-\nframe", "propa-\ngation %", "linear-\nisation %", "solve\n%")
    for heading in (*headings, "mar-\nginal %", "output\n%", "rest\n%", "finish\nms", "probes\nadd %"):
        table.add_column(heading, justify="right")
    for one in profiles:
        row = one.record()
        times = [row["us_per_step"], row["us_per_imu_sample"], row["us_per_keyframe"]]
        table.add_row(
            one.label,
            *("–" if us is None else _us(float(us)) for us in times),
            *(f"{100 * share:.1f}" for share in one.shares.values()),
            f"{one.timed.finish_ns / 1e6:,.1f}",
            f"{100 * one.overhead:.0f}",
        )
    return table


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
