"""Search an estimator's noise factors on training runs, then score them once on held-out runs.

The search is a tree-structured Parzen estimator (optuna). Trial 0 is the data sheet: every factor is 1. Each trial is a
set of ordinary runs in worker processes. Finished runs are in the store at once, so the same command resumes a search
that was stopped, and its trials are the same as without the stop.

Source: Bergstra, Bardenet, Bengio & Kégl 2011, Algorithms for Hyper-Parameter Optimization, NeurIPS 24.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from ..errors import ExperimentError
from ..execution.pool import run_all
from ..experiment.plan import Run
from ..files import writing
from ..results.identity import FINAL
from ..results.store import Row, Store, sole_writer
from ..results.summary import groups, records
from .split import in_words
from .tuning import Tuning

BATCH = 10
"""How many trials are chosen before any of them is run. It does not depend on the number of workers, so neither do
the trials."""


class Trial(NamedTuple):
    """One point of the search; loss is None where a run failed or has no score, and cause says why."""

    number: int
    factors: dict[str, float]
    loss: float | None
    cause: str | None = None


class Progress(NamedTuple):
    """Progress of a search: finished trials, of how many, and the best of them."""

    known: int
    trials: int
    best: Trial | None


class Search:
    """One search, its study and its store open; `searching` opens them.

    Attributes:
        resumed: how many trials an earlier search has left behind, by the same study.
        others: how many other studies there are: of another spec, log, range, version or seed.
    """

    def __init__(self, tuning: Tuning, study: Any, others: int, store: Store) -> None:
        self.tuning, self.others = tuning, others
        self._study, self._store = study, store
        self._rows: dict[tuple[str, str, int | None], list[Any]] = {}
        self._keep(records(store.read()))
        every = study.trials
        self._waiting: dict[int, dict[str, float]] = {
            trial.number: trial.params for trial in every if not trial.state.is_finished()
        }
        self._known = {
            trial.number: self._judged(trial.number, trial.params) for trial in every if trial.state.is_finished()
        }
        self.resumed = len(self._known)

    @property
    def notes(self) -> list[str]:
        """Notes for the user before the search begins."""
        split = self.tuning.split
        found = [f"training on {in_words(split.train)}; held out: {in_words(split.held_out)}"]
        if split.aside:
            found.append(f"not used: {', '.join(split.aside)}")
        if self.resumed:
            found.append(f"{self.resumed} trials were done already")
        elif self.others:
            found.append(f"a new study: the {self.others} before were of another spec, log, range, seed or version")
        return found

    def run(self, trials: int = 60, jobs: int = 0) -> Iterator[Progress]:
        """Run the missing runs of this many trials on training logs; yield the progress after each run.

        Raises:
            ExperimentError: the data sheet's runs lack the score; no trial of the first batch finished.
        """
        yield self._progress(trials)
        while waiting := self._ask(trials):
            for _ in self._runs(waiting, self.tuning.split.train, jobs):
                self._tell()
                yield self._progress(trials)
            self._tell()

    def run_held_out(self, trials: Sequence[Trial], jobs: int = 0) -> Iterator[None]:
        """Run these trials on held-out logs; yield after each run."""
        yield from self._runs({trial.number: trial.factors for trial in trials}, self.tuning.split.held_out, jobs)

    def trials(self) -> list[Trial]:
        """Return the trials whose runs have all ended, in their order."""
        return [self._known[number] for number in sorted(self._known)]

    def rows(self, number: int, runs: Sequence[Run]) -> list[Row]:
        """Return one row per run that has ended: of the objective's output, if it exists."""
        found = [self._rows.get(self._key(number, run), []) for run in runs]
        output = self.tuning.objective.output
        return [next((row for row in rows if row["output"] == output), rows[0]) for rows in found if rows]

    def _ask(self, trials: int) -> dict[int, dict[str, float]]:
        """Return the trials that wait for runs, by number; asks for the next batch where none does.

        All trials of a batch are chosen before any result is known, and each trial's sampler has a seed of its own. So
        the trials depend neither on the number of workers nor on interruptions.
        """
        from optuna import create_study
        from optuna.distributions import FloatDistribution
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState, create_trial

        asked = len(self._known) + len(self._waiting)
        last = max(asked - 1, 0) // BATCH * BATCH
        if not self._waiting:
            end = (asked // BATCH + 1) * BATCH
        else:  # complete a batch that was interrupted while it was chosen
            end = last + BATCH if all(number in self._waiting for number in range(last, asked)) else asked
        factor = FloatDistribution(self.tuning.low, self.tuning.high, log=True)
        space: dict[str, Any] = dict.fromkeys(self.tuning.dials, factor)
        shadow = create_study()  # a copy to sample from, so that the study holds complete trials only
        shadow.add_trials(self._study.trials)
        if not asked:
            shadow.enqueue_trial(dict.fromkeys(self.tuning.dials, 1.0))
        for number in range(asked, min(end, trials)):
            seed = (self.tuning.seed * 1_000_003 + number) % 2**32
            shadow.sampler = TPESampler(seed=seed, n_startup_trials=BATCH)
            params = shadow.ask(space).params
            self._study.add_trial(create_trial(state=TrialState.RUNNING, params=params, distributions=space))
            self._waiting[number] = params
        return dict(self._waiting)

    def _runs(self, trials: Mapping[int, dict[str, float]], runs: Sequence[Run], jobs: int) -> Iterator[None]:
        """Run the missing runs of these trials, log by log, and store each run as it ends."""
        tasks = [
            self.tuning.task(number, factors, run, self._study.study_name)
            for run in runs
            for number, factors in trials.items()
            if not any(row["status"] in FINAL for row in self._rows.get(self._key(number, run), []))
        ]
        for finished in run_all(tasks, jobs):
            kept = [{**row, "trajectory": None, "truth_trajectory": None} for row in finished.rows]
            self._store.write(kept)
            self._keep(kept)
            yield

    def _tell(self) -> None:
        """Report every finished trial to the study; one with a failed run is reported as worse than all others."""
        from optuna.trial import TrialState

        train = self.tuning.split.train
        for number, factors in sorted(self._waiting.items()):
            if len(self.rows(number, train)) < len(train):
                continue
            trial = self._known[number] = self._judged(number, factors)
            del self._waiting[number]
            if trial.loss is None:
                self._study.tell(number, state=TrialState.PRUNED)
            else:
                self._study.tell(number, trial.loss)
        known = self.trials()
        if known and not self._waiting and all(trial.loss is None for trial in known):
            raise ExperimentError(f"{self.tuning.estimator.label}: no trial finished; {known[0].cause}")

    def _judged(self, number: int, factors: dict[str, float]) -> Trial:
        objective, rows = self.tuning.objective, self.rows(number, self.tuning.split.train)
        for row in rows:
            if (cause := objective.lacking(row)) is not None:
                return Trial(number, factors, None, cause)
        marks = objective.marks(rows)
        loss = float(objective.loss(marks.values, marks.weights))
        return Trial(number, factors, loss) if math.isfinite(loss) else Trial(number, factors, None, f"loss is {loss}")

    def _progress(self, trials: int) -> Progress:
        known = self.trials()
        return Progress(len(known), trials, best_of(known))

    def _keep(self, rows: Iterable[Row]) -> None:
        for key, of_run in groups([dict(row) for row in rows], "label", "log", "seed").items():
            self._rows[key[0], key[1], key[2]] = of_run

    def _key(self, number: int, run: Run) -> tuple[str, str, int | None]:
        return f"{self._study.study_name} {number}", run.log.name, run.seed


def best_of(trials: Sequence[Trial]) -> Trial | None:
    """Return the trial of the smallest loss, the earliest of equals; None where no trial has one."""
    return min((trial for trial in trials if trial.loss is not None), key=lambda trial: trial.loss or 0.0, default=None)


@contextmanager
def searching(tuning: Tuning) -> Iterator[Search]:
    """Open the study and the store of a search, alone; make them where there are none.

    Raises:
        ExperimentError: optuna is missing; the files cannot be written, or are no such files; another search uses them.
    """
    try:
        import optuna
        from sqlalchemy.exc import SQLAlchemyError
    except ImportError as error:
        raise ExperimentError(f"{error}; tuning needs an extra: pip install 'fathom-bench[tune]'") from None
    path = tuning.folder / "study.sqlite"
    with writing(tuning.folder, "; give another --out", "made"):
        tuning.folder.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # its messages are replaced by ours
    with sole_writer(tuning.folder), Store(tuning.folder / "runs.sqlite") as store:
        try:
            storage = optuna.storages.RDBStorage(f"sqlite:///{path}")
            try:
                study = optuna.create_study(storage=storage, study_name=tuning.identity, load_if_exists=True)
                others = len(optuna.get_all_study_names(storage)) - 1
                yield Search(tuning, study, others, store)
            finally:
                storage.remove_session()
                storage.engine.dispose()
        except SQLAlchemyError as error:
            raise ExperimentError(
                f"{path}: cannot be used as a study ({error}); move it, or give another --out"
            ) from None
