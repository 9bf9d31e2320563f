"""The command `fathom`. Heavy imports wait inside the commands, so that `fathom --help` answers at once."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ...datasets.formats.recording import Recording
    from ...datasets.simulated.scenario import Scenario
    from ...datasets.trajectory import Trajectory

app = typer.Typer(
    help="Filter or smoother? A benchmark for underwater navigation.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

SOME_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
LONGEST_TOLERANCE_S = 1e9


class Listing(StrEnum):
    """What `fathom list` can list."""

    estimators = "estimators"
    logs = "logs"
    experiments = "experiments"
    scores = "scores"


class Align(StrEnum):
    """What an estimate is forgiven before it is scored."""

    none = "none"
    origin = "origin"
    yaw = "yaw"
    se3 = "se3"


class Unit(StrEnum):
    """What the step of the RPE is counted in."""

    frames = "frames"
    s = "s"
    m = "m"


class Pairs(StrEnum):
    """Which steps the RPE is taken over."""

    consecutive = "consecutive"
    all = "all"


Data = Annotated[Path | None, typer.Option(envvar="FATHOM_DATA", help="Where recorded logs are.")]
Repair = Annotated[bool, typer.Option("--repair", help="Drop bad rows of logs, and count them.")]


@app.command()
def run(
    experiment: Annotated[str, typer.Argument(help="A shipped experiment's name, or a YAML file.")],
    data: Data = None,
    out: Annotated[Path, typer.Option(help="Where results go.")] = Path("results"),
    jobs: Annotated[int, typer.Option(min=0, help="Worker processes; 0: one per core.")] = 0,
    only: Annotated[
        str | None, typer.Option(help="Pattern: an estimator's label, a log's name, or \"log/label\".")
    ] = None,
    repair: Repair = False,
    force: Annotated[bool, typer.Option("--force", help="Run again what is done already.")] = False,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run on a Dask cluster: tcp://host:port, its scheduler file (.json), or local: a cluster of --jobs "
            "processes here.",
        ),
    ] = None,
) -> None:
    """Run every estimator of EXPERIMENT on every one of its logs, and print the tables.

    What an earlier `fathom run` finished is not run again, unless its spec, its log, or the version has changed.
    """
    with refusing_bad_input():
        from ..execution.sweep import Outcome, run_experiment
        from ..experiment.plan import Experiment
        from ..output.present import present

        plan = Experiment.load(experiment)
        folder = out / plan.name
        try:
            rows = run_experiment(plan, data, out, jobs, only, repair, force, dask)
        except KeyboardInterrupt:
            _say(f"interrupted: the finished runs are kept in {folder / 'runs.sqlite'}; the same command does the rest")
            raise typer.Exit(INTERRUPTED) from None
        present(Outcome(rows, **rows.attrs), plan, folder)
    statuses = set(rows.loc[~rows["log"].isin(rows.attrs["kept"]), "status"])
    if statuses <= {"absent"}:  # nothing was run
        raise typer.Exit(BAD_INPUT)
    if statuses - {"done", "absent"}:
        raise typer.Exit(SOME_FAILED)


@app.command()
def report(
    result: Annotated[str, typer.Argument(help="A result folder, or the name of an experiment under `results`.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="The page; RESULT/report.html without.")] = None,
) -> None:
    """Write RESULT as one HTML page that needs no network: sortable tables, figures to zoom, every run's spec."""
    with refusing_bad_input():
        from rich.console import Console

        from ..output.report.page import report as write
        from ..output.report.results import find_result

        folder = find_result(result)
        with Console(stderr=True).status(f"reading {folder}"):
            file = write(folder, out)
        typer.echo(f"{file}: {file.stat().st_size / 1e6:.1f} MB")


@app.command()
def reproduce(
    result: Annotated[str, typer.Argument(help="A folder that `fathom run` wrote, or its name under `results`.")],
    row: Annotated[
        str | None,
        typer.Argument(
            help='"log/label" or "log/label/seed", a pattern of these, or how an identity begins; all without.'
        ),
    ] = None,
    data: Data = None,
    jobs: Annotated[int, typer.Option(min=0, help="Worker processes; 0: one per core.")] = 0,
) -> None:
    """Run rows of RESULT again from what it stores, and say whether the scores are identical, bit for bit.

    Exit status 0: all are; 1: some are not, or could not be run again; 2: nothing was run. RESULT stays as it is.
    """
    with refusing_bad_input():
        from ..execution.reproduce import reproduce_all
        from ..output.report.results import find_result
        from ..output.tables.reproduction import print_reproduction
        from ..results.select import choose

        runs = choose(find_result(result), row)
        every, whole = reproduce_all(runs, data, jobs)
        print_reproduction(every)
    if not whole:
        _say(f"interrupted: {len(every)} of {len(runs)} runs were looked at; nothing was written")
        raise typer.Exit(INTERRUPTED)
    ran = [again for again in every if again.skipped is None]
    if not ran:
        raise typer.Exit(BAD_INPUT)
    if not all(again.is_identical for again in every if again.stored.first["status"] != "absent"):
        raise typer.Exit(SOME_FAILED)


@app.command("list")
def list_(what: Listing) -> None:
    """Print the known estimators (with their options), logs, shipped experiments, or scores."""
    with refusing_bad_input():
        for name, about in _LISTS[what]().items():
            typer.echo(f"{name}: {about}" if about else name)


def _estimators() -> dict[str, str]:
    from ...estimators.registry import EstimatorError, known_estimators, load_estimator

    found = {}
    for name in known_estimators():
        try:
            found[name] = ", ".join(getattr(load_estimator(name), "__dataclass_fields__", ()))
        except EstimatorError as error:
            found[name] = str(error).removeprefix(f"{name}: ")
    return found


def _logs() -> dict[str, str]:
    from ...datasets.described.opening import catalog_names
    from ...datasets.simulated.specs import MISSIONS

    return dict.fromkeys(catalog_names(), "recorded") | dict.fromkeys(MISSIONS, "mission, simulated")


def _experiments() -> dict[str, str]:
    import yaml

    from ..experiment.packaged import shipped_experiments

    return {name: yaml.safe_load(path.read_text())["description"] for name, path in shipped_experiments().items()}


def _scores() -> dict[str, str]:
    from ..metrics.floor_ratio import FLOORS
    from ..metrics.scoring import COSTS, INNOVATIONS, SCORES

    return SCORES | FLOORS | INNOVATIONS | COSTS


_LISTS = {
    Listing.estimators: _estimators,
    Listing.logs: _logs,
    Listing.experiments: _experiments,
    Listing.scores: _scores,
}


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help="A YAML file of a scenario's keys, or a mission's name.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The folder to write; it must not hold a log already.")],
    seed: Annotated[int, typer.Option(min=0)] = 1,
) -> None:
    """Simulate SCENARIO and write the log as a folder that `fathom` and anybody else can read."""
    with refusing_bad_input():
        from ...datasets.described.folder import write_folder
        from ...datasets.simulated import simulator

        log = simulator.simulate(_scenario(scenario), seed)
        write_folder(log, out)
        typer.echo(f"{out}: {log.name}, {log.duration_s:.0f} s, {', '.join(['imu', *log.streams, 'truth'])}")


def _scenario(text: str) -> Scenario:
    import yaml

    from ...datasets.errors import DatasetError
    from ...datasets.simulated.scenario import Scenario

    if not text.endswith((".yaml", ".yml")):
        return Scenario.from_dict({"mission": text})
    try:
        content = yaml.safe_load(Path(text).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DatasetError(f"{text}: not readable as YAML: {' '.join(str(error).split())}") from None
    return Scenario.from_dict(content, text)


@app.command()
def inspect(
    log: Annotated[
        str,
        typer.Argument(
            help="A recorded log's name, a folder with a log.yaml, a description (.yaml), or a bare recording (.bag, "
            ".db3, .mcap, .bin, .lsf), whose messages are then listed."
        ),
    ],
    data: Data = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Figure (.png, .pdf, .svg), or a folder; inspect-NAME.png without."),
    ] = None,
) -> None:
    """Look over LOG before anything runs on it: what each sensor says, what looks wrong, and how log.yaml mends it."""
    with refusing_bad_input():
        from rich.console import Console

        from ..inspection.contents import print_contents
        from ..inspection.inspecting import inspect_log, open_to_inspect
        from ..inspection.page import page_file, print_inspection, save_page
        from ..output.tables.terminal import console

        undescribed = _undescribed(Path(log))
        if undescribed is not None:
            held = undescribed.contents(Path(log).parent)
            print_contents(held, console())
            return
        page_file(out, "")  # refuses before anything is read
        with Console(stderr=True).status(f"inspecting {log}") as status:
            opened, repairs = open_to_inspect(log, data)
            inspection = inspect_log(opened, repairs)
            file = page_file(out, opened.name)
            status.update(f"drawing {file}")
            save_page(inspection, file)
        print_inspection(inspection, console())
        typer.echo(f"figure: {file}")


def _undescribed(path: Path) -> Recording | None:
    """Return the loader of a bare recording: a file, or the folder of a ROS 2 bag."""
    from ...datasets.formats.recording import loader, recording_at

    if (path / "metadata.yaml").is_file() and not (path / "log.yaml").is_file():
        return loader("ros")(format="ros", file=path.name)
    return recording_at(path) if path.is_file() else None


class Output(StrEnum):
    """Which trajectory of an estimator is scored."""

    online = "online"
    smoothed = "smoothed"


@app.command()
def tune(
    experiment: Annotated[str, typer.Argument(help="A shipped experiment's name, or a YAML file.")],
    estimator: Annotated[
        str | None, typer.Option(help="Label of the one to tune; needed where several can be.")
    ] = None,
    train: Annotated[list[str] | None, typer.Option(help='Pattern of a log, or "log/seed"; may be repeated.')] = None,
    held_out: Annotated[list[str] | None, typer.Option(help="Likewise: what the search never sees.")] = None,
    sensor: Annotated[
        list[str] | None, typer.Option(help="Whose noise to search; may be repeated; every sensor, gyro and accel.")
    ] = None,
    trials: Annotated[int, typer.Option(min=2, help="How many sets of factors, the data sheet among them.")] = 60,
    score: Annotated[str, typer.Option(help="What to make smaller, or more honest; as in `fathom list scores`.")] = (
        "ate_rmse_m"
    ),
    output: Annotated[Output, typer.Option(help="Score the online or the smoothed trajectory.")] = Output.online,
    span: Annotated[float, typer.Option(min=1.01, help="Factors are searched from 1/SPAN to SPAN.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the search.")] = 0,
    data: Data = None,
    out: Annotated[Path, typer.Option(help="Where results go.")] = Path("results"),
    jobs: Annotated[int, typer.Option(min=0, help="Worker processes; 0: one per core.")] = 0,
    repair: Repair = False,
) -> None:
    """Search the factors on an estimator's noise on training logs, and check them once on logs that are held out.

    Without --train, --held-out or `tune:` in the experiment, the first half of a simulated log's seeds trains. The same
    command goes on where it was stopped.
    """
    with refusing_bad_input():
        from ..experiment.plan import Experiment, Sides
        from ..tuning.objective import Objective
        from ..tuning.outcome import judge, print_outcome, run_with_bar, write_outcome
        from ..tuning.search import searching
        from ..tuning.tuning import prepare

        plan, sides = Experiment.load(experiment), Sides(tuple(train or ()), tuple(held_out or ()))
        objective = Objective(score, output.value)
        tuning = prepare(plan, estimator, sides, sensor or (), objective, (1 / span, span), seed, out, data, repair)
        try:
            with searching(tuning) as search:
                for note in search.notes:
                    _say(note)
                run_with_bar(search, trials, jobs)
                outcome = judge(search)
        except KeyboardInterrupt:
            _say(f"interrupted: what is finished is kept in {tuning.folder}; the same command goes on")
            raise typer.Exit(INTERRUPTED) from None
        files = write_outcome(outcome)
        print_outcome(outcome)
        _say(f"{tuning.folder}: {', '.join(file.name for file in files)}, study.sqlite, runs.sqlite")
    if outcome.lost:
        raise typer.Exit(SOME_FAILED)


@app.command()
def score(
    truth: Annotated[Path, typer.Argument(help="TUM file: t x y z qx qy qz qw.")],
    estimate: Annotated[Path, typer.Argument(help="TUM file.")],
    align: Annotated[Align, typer.Option(help="What the estimate is forgiven.")] = Align.none,
    tolerance_s: Annotated[float, typer.Option(min=0, help="How far apart in time two poses may be.")] = 0.01,
    delta: Annotated[float, typer.Option(help="Step of the RPE.")] = 1.0,
    unit: Annotated[Unit, typer.Option(help="Of the step.")] = Unit.m,
    pairs: Annotated[Pairs, typer.Option(help="Which steps.")] = Pairs.all,
) -> None:
    """Print ATE and RPE of ESTIMATE against TRUTH."""
    with refusing_bad_input():
        from ..metrics import ScoreError, ate, check_step, rpe

        check_step(delta, unit.value)
        if not 0 <= tolerance_s <= LONGEST_TOLERANCE_S:
            raise ScoreError(f"--tolerance-s must be from 0 to {LONGEST_TOLERANCE_S:g}, found {tolerance_s}")
        true, estimated = _read_tum(truth), _read_tum(estimate)
        tolerance_ns = round(tolerance_s * 1e9)
        absolute = ate(true, estimated, align.value, tolerance_ns)
        rows = _score_rows("ATE", absolute, f"{absolute.n} poses")
        settings = f"alignment: {align.value}; matched within {tolerance_s:g} s"
        try:
            relative = rpe(true, estimated, delta, unit.value, pairs.value, tolerance_ns)
            rows += _score_rows("RPE", relative, f"{relative.n} pairs")
            settings += f"; RPE over {delta:g} {unit.value}, {pairs.value} pairs"
        except ScoreError as error:
            settings += f"\nno RPE: {error}"
        _print_scores(rows)
        typer.echo(settings)


def _read_tum(path: Path) -> Trajectory:
    from ...datasets.errors import DatasetError
    from ...datasets.trajectory import Trajectory

    try:
        if path.is_dir():
            raise DatasetError(f"{path}: a folder; expected a TUM file")
        return Trajectory.from_tum(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None


@app.command()
def timing(
    against: Annotated[
        str | None, typer.Option(metavar="REV", help="Compare the working tree with this revision instead.")
    ] = None,
    only: Annotated[str | None, typer.Option(help="Pattern: a budget's or a benchmark's name.")] = None,
    short: Annotated[bool, typer.Option("--short", help="With --against: fewer benchmarks, a minute or two.")] = False,
    limit: Annotated[float, typer.Option(min=1.0, help="With --against: the ratio that is too slow.")] = 1.10,
    pairs: Annotated[int, typer.Option(min=0, help="With --against: pairs of processes; 0: 5, or 3 if short.")] = 0,
    rounds: Annotated[int, typer.Option(min=0, help="With --against: turns A B B A per pair; 0: 4, or 3.")] = 0,
    counters: Annotated[
        bool, typer.Option("--counters", help="Count work that no machine changes: factors, callbacks, allocations.")
    ] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 where a budget is missed.")] = False,
    profile: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ESTIMATOR", help='Where its time goes, by lag, and over a log; may be repeated, or "all".'
        ),
    ] = None,
    cost: Annotated[bool, typer.Option("--cost", help="Make the README's table of costs, and its figure.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Also write to this JSON file; with --profile or --cost, the folder to write to."
        ),
    ] = None,
) -> None:
    """Measure every budget of speed and memory, or compare with another revision.

    With --against, exit status 1 says that something is slower: its whole interval is above --limit. The working tree
    counts as it is. Without, a missed budget is said and no error, but for --strict. See docs/timing.md.
    """
    with refusing_bad_input():
        from ..timing.command import print_budgets, print_comparison, print_counters
        from ..timing.profile_command import print_cost, print_profile

        try:
            if cost:
                good = print_cost(out)
            elif profile:
                good = print_profile(profile, out)
            elif against is not None:
                good = print_comparison(against, only, short, limit, rounds, pairs, out)
            elif counters:
                good = print_counters(only, out)
            else:
                good = print_budgets(only, out) or not strict
        except KeyboardInterrupt:
            _say("interrupted" + ("; finished runs are kept, and the same command does the rest" if cost else ""))
            raise typer.Exit(INTERRUPTED) from None
    if not good:
        raise typer.Exit(SOME_FAILED)


STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def _score_rows(title: str, numbers: object, over: str) -> list[list[str]]:
    rows = []
    for unit, name in (("m", "{}_m"), ("°", "rotation_{}_deg")):
        values = [getattr(numbers, name.format(statistic)) for statistic in STATISTICS]
        rows.append([f"{title} {unit}", *("–" if value is None else f"{value:.6f}" for value in values), over])
    return rows


def _print_scores(rows: list[list[str]]) -> None:
    from rich import box
    from rich.table import Table

    from ..output.tables.terminal import console

    table = Table("", *STATISTICS, "over", box=box.SIMPLE_HEAD)
    for row in rows:
        table.add_row(*row)
    console().print(table)


@contextmanager
def refusing_bad_input() -> Iterator[None]:
    """Turn what a user can mend into one line on stderr and exit status 2; our own bugs keep their traceback."""
    try:
        yield
    except ValueError as error:
        from ...datasets.errors import DatasetError
        from ...estimators.registry import EstimatorError
        from ..errors import ExperimentError
        from ..metrics.association import ScoreError

        if not isinstance(error, DatasetError | EstimatorError | ExperimentError | ScoreError):
            raise
        _say(f"fathom: {' '.join(str(error).split())}")
        raise typer.Exit(BAD_INPUT) from None


def _say(message: str) -> None:
    print(message, file=sys.stderr)


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
