"""Tuning: what is held out stays unseen, a search that was stopped goes on as if it had not been, and it finds."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.bench.cli.app import app
from fathom.bench.errors import ExperimentError
from fathom.bench.execution.task import Finished
from fathom.bench.experiment.plan import Experiment, SplitPatterns
from fathom.bench.tuning import search as tuning_search
from fathom.bench.tuning.objective import EXPECTED, SCORES, Marks, Objective
from fathom.bench.tuning.outcome import Outcome, judge, write_outcome
from fathom.bench.tuning.search import Trial, searching
from fathom.bench.tuning.tuning import Tuning, prepare
from fathom.datasets import Scenario, simulate
from fathom.datasets.described.folder import write_folder
from fathom.datasets.errors import DatasetError
from fathom.estimators.registry import create
from typer.testing import CliRunner

pytestmark = pytest.mark.slow  # whole runs and searches: seconds each

SHORT = {"scenario": {"duration_s": 20, "imu": "industrial"}, "name": "sim"}
Law = Callable[[dict[str, float], str, int | None], float | None]


def experiment(**changes: Any) -> Experiment:
    content = {"name": "t", "logs": [SHORT], "estimators": [{"name": "eskf"}], "seeds": 12} | changes
    return Experiment.from_dict(content)


def call(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


# -- who sees what ----------------------------------------------------------------------------------------------------


def recorded(folder: Path, *names: str) -> list[dict[str, str]]:
    """Write one short log under each name, and return the entries of an experiment."""
    log = simulate(Scenario(duration_s=20), seed=1)
    for name in names:
        write_folder(log, folder / name, "csv")
    return [{"log": str(folder / name)} for name in names]


def test_without_a_word_the_first_half_of_the_seeds_trains_and_recorded_logs_take_no_part(tmp_path: Path) -> None:
    split = prepare(experiment(seeds=5, logs=[SHORT, *recorded(tmp_path, "a")]), out=tmp_path).split
    assert [run.seed for run in split.train] == [1, 2, 3]
    assert [run.seed for run in split.held_out] == [4, 5]
    assert split.aside == ["a"]


def test_the_experiment_may_name_the_training_runs_and_the_command_line_overrules_it(tmp_path: Path) -> None:
    plan = experiment(seeds=4, tune={"held_out": ["sim/4"]})
    assert [run.seed for run in prepare(plan, out=tmp_path).split.train] == [1, 2, 3]
    split = prepare(plan, patterns=SplitPatterns(train=("sim/[23]",)), out=tmp_path).split
    assert [run.seed for run in split.train] == [2, 3]
    assert [run.seed for run in split.held_out] == [1, 4]


@pytest.mark.parametrize(
    ("changes", "sides", "complaint"),
    [
        ({"seeds": 1}, SplitPatterns(), "nothing is held out of sim/1; name them"),
        ({}, SplitPatterns(("sim/1",), ("sim/*",)), "sim/1 trains and sim/1 is held out: the same random numbers"),
        ({}, SplitPatterns(("sim",), ()), "nothing is held out"),
        ({}, SplitPatterns(("smi",), ()), "train: 'smi' matches none of: sim/1, "),
        (
            {"logs": [SHORT, {"scenario": {"mission": "box"}, "name": "box"}]},
            SplitPatterns(("sim",), ("box",)),
            "sim/1 trains and box/1 is held out: the same random numbers",
        ),
        ({"tune": {"held_uot": ["x"]}}, SplitPatterns(), "unknown key `tune.held_uot`; did you mean 'held_out'"),
    ],
)
def test_no_log_is_on_both_sides_and_none_is_empty(
    tmp_path: Path, changes: dict[str, Any], sides: SplitPatterns, complaint: str
) -> None:
    with pytest.raises(ExperimentError, match=re.escape(complaint).replace("'held_uot';", "'held_uot'.*")):
        prepare(experiment(**changes), patterns=sides, out=tmp_path)


def test_one_recording_under_two_names_is_not_held_out(tmp_path: Path) -> None:
    (same,) = recorded(tmp_path, "a")
    logs = [same | {"name": "x"}, {"log": str(tmp_path / "." / "b" / ".." / "a"), "name": "y"}]
    (tmp_path / "b").mkdir()
    with pytest.raises(ExperimentError, match="x trains and y is held out: the same recording"):
        prepare(experiment(logs=logs), patterns=SplitPatterns(("x",), ("y",)), out=tmp_path)


def test_what_cannot_be_tuned_is_refused_before_anything_runs(tmp_path: Path) -> None:
    several = experiment(estimators=[{"name": "eskf"}, {"name": "dead-reckoning"}, {"name": "fls"}])
    with pytest.raises(ExperimentError, match="say which to tune by --estimator LABEL \\(can be: eskf, fls\\)"):
        prepare(several, out=tmp_path)
    with pytest.raises(ExperimentError, match="'dead-reckoning': has no `inflate`"):
        prepare(several, "dead-reckoning", out=tmp_path)
    with pytest.raises(ExperimentError, match="no such label; did you mean 'eskf'"):
        prepare(several, "ekf", out=tmp_path)
    with pytest.raises(ExperimentError, match=r"--sensor: eskf has no 'dlv' .* did you mean 'dvl'"):
        prepare(experiment(), sensors=["dlv"], out=tmp_path)
    with pytest.raises(ExperimentError, match="no score 'ate_rmse'; did you mean 'ate_rmse_m'"):
        Objective("ate_rmse")
    blind = simulate(Scenario(duration_s=20), seed=1)
    write_folder(replace(blind, truth=None), tmp_path / "blind", "csv")
    logs, sides = [*recorded(tmp_path, "a"), {"log": str(tmp_path / "blind")}], SplitPatterns(("blind",), ("a",))
    with pytest.raises(ExperimentError, match="blind: no truth, so no ate_rmse_m; --score nis_dvl"):
        prepare(experiment(logs=logs), patterns=sides, out=tmp_path)
    assert prepare(experiment(logs=logs), patterns=sides, objective=Objective("nis_dvl"), out=tmp_path).dials
    with pytest.raises(DatasetError, match="ictineu_stpere_2004: held out, but neither here nor in"):
        prepare(
            experiment(logs=[*recorded(tmp_path, "c"), {"log": "ictineu_stpere_2004"}]),
            patterns=SplitPatterns(("c",), ()),
            out=tmp_path,
            data=tmp_path,
        )


def test_the_dials_are_what_the_estimator_uses_and_the_training_logs_have(tmp_path: Path) -> None:
    plan = experiment(
        logs=[{"scenario": {"duration_s": 20, "gps": None}}],
        estimators=[{"name": "eskf", "with": {"factors": ["dvl", "gps", "heading"]}}],
    )
    assert prepare(plan, out=tmp_path).dials == ("dvl", "heading", "accel", "gyro")
    tuning = prepare(
        experiment(estimators=[{"name": "eskf", "with": {"inflate": {"gps": 2.0}}}]), sensors=["dvl"], out=tmp_path
    )
    assert tuning.options({"dvl": 3.0}) == {"inflate": {"gps": 2.0, "dvl": 3.0}}


# -- what is made smaller ---------------------------------------------------------------------------------------------


def test_the_loss_of_a_consistency_score_is_least_at_its_expected_value_and_symmetric() -> None:
    for score, due in EXPECTED.items():
        objective, n = Objective(score), np.ones(2)
        assert objective.loss(np.array([due, due]), n) == pytest.approx(0, abs=1e-12)
        assert objective.loss(np.array([2 * due] * 2), n) == pytest.approx(objective.loss(np.array([due / 2] * 2), n))
    assert {"nees_all", "nis_dvl", "ate_rmse_m"} < set(SCORES)
    assert "step_median_us" not in SCORES


def test_squared_errors_are_pooled_before_the_root_and_nis_over_its_degrees_of_freedom() -> None:
    rows = [{"ate_rmse_m": 1.0, "n_scored": 1}, {"ate_rmse_m": 3.0, "n_scored": 3}]
    objective = Objective("ate_rmse_m")
    assert objective.loss(*objective.marks(rows)) == pytest.approx(math.sqrt((1 + 3 * 9) / 4))
    rows = [{"nis_dvl": 1.0, "nis_dof": json.dumps({"dvl": 30})}, {"nis_dvl": 4.0, "nis_dof": json.dumps({"dvl": 10})}]
    objective = Objective("nis_dvl")
    assert objective.taken(*objective.marks(rows)) == pytest.approx(70 / 40)


def test_the_gain_is_of_pairs_so_what_the_runs_have_in_common_does_not_widen_its_interval() -> None:
    rng = np.random.default_rng(1)
    sheet = np.exp(rng.normal(0, 1, 20))
    objective, n = Objective("ate_rmse_m"), np.ones(20)
    gain, interval = objective.gain(Marks(0.9 * sheet, n), Marks(sheet, n))
    assert gain == pytest.approx(-math.log(0.9))
    assert interval == pytest.approx((gain, gain))
    assert objective.gain(Marks(sheet[:4], n[:4]), Marks(sheet[:4], n[:4]))[1] is None


# -- the search, its runs done by a law that is known -----------------------------------------------------------------


class Sea:
    """Stands in for the workers: a run's score is what the law says of its factors, log and seed; None: diverged."""

    def __init__(self, law: Law, stop_after: float = math.inf) -> None:
        self.law, self.stop_after, self.asked = law, stop_after, []

    def run_all(self, tasks: Sequence[Any], jobs: int = 0) -> Iterator[Finished]:
        for task in tasks:
            if len(self.asked) >= self.stop_after:
                raise KeyboardInterrupt
            self.asked.append((task.run.log.name, task.run.seed))
            value = self.law(task.run.estimator.options["inflate"], task.run.log.name, task.run.seed)
            if value is None:
                yield Finished([task.row("diverged", "lost")])
            else:
                yield Finished([task.row("done", None) | {"ate_rmse_m": value, "n_scored": 10}])


def valley(factors: dict[str, float], log: str, seed: int | None) -> float:
    """Least at dvl 3, for any gps."""
    return math.exp(abs(math.log(factors["dvl"] / 3)))


@pytest.fixture
def tuning(tmp_path: Path) -> Tuning:
    return prepare(experiment(), sensors=["dvl", "gps"], out=tmp_path / "r")


def go(tuning: Tuning, monkeypatch: pytest.MonkeyPatch, sea: Sea, trials: int = 25) -> list[Trial]:
    monkeypatch.setattr(tuning_search, "run_all", sea.run_all)
    with searching(tuning) as search:
        for _ in search.run(trials):
            pass
        return search.trials()


def end(tuning: Tuning, monkeypatch: pytest.MonkeyPatch, law: Law, trials: int = 30) -> Outcome:
    monkeypatch.setattr(tuning_search, "run_all", Sea(law).run_all)
    with searching(tuning) as search:
        for _ in search.run(trials):
            pass
        known = search.trials()
        for _ in search.run_held_out([known[0], min(known, key=lambda trial: trial.loss or math.inf)]):
            pass
        return judge(search)


def test_the_first_trial_is_the_data_sheet_and_the_search_finds_the_valley(tuning, monkeypatch) -> None:
    trials = go(tuning, monkeypatch, Sea(valley), 60)
    assert trials[0].factors == {"dvl": 1.0, "gps": 1.0}
    assert trials[0].loss == pytest.approx(3.0)
    best = min(trials, key=lambda trial: trial.loss)
    assert best.factors["dvl"] == pytest.approx(3, rel=0.1)
    assert all(0.1 <= factor <= 10 for trial in trials for factor in trial.factors.values())


def test_the_search_asks_for_training_runs_alone(tuning, monkeypatch) -> None:
    sea = Sea(valley)
    go(tuning, monkeypatch, sea)
    assert set(sea.asked) == {("sim", seed) for seed in range(1, 7)}
    assert len(sea.asked) == 25 * 6


@pytest.mark.slow
def test_a_search_that_was_stopped_anywhere_ends_as_if_it_had_not_been(tmp_path, monkeypatch) -> None:
    whole = go(prepare(experiment(seeds=4), out=tmp_path / "whole"), monkeypatch, Sea(valley))
    for stop in (1, 19, 31):
        tuning = prepare(experiment(seeds=4), out=tmp_path / str(stop))
        first, second = Sea(valley, stop_after=stop), Sea(valley)
        with pytest.raises(KeyboardInterrupt):
            go(tuning, monkeypatch, first)
        assert go(tuning, monkeypatch, second) == whole
        assert len(first.asked) + len(second.asked) == 25 * 2  # what was finished is not run again


@pytest.mark.slow
def test_a_search_stopped_while_it_asks_for_a_batch_asks_for_the_rest_of_it(tmp_path, monkeypatch) -> None:
    whole = go(prepare(experiment(seeds=4), out=tmp_path / "whole"), monkeypatch, Sea(valley))
    tuning = prepare(experiment(seeds=4), out=tmp_path / "stopped")
    go(tuning, monkeypatch, Sea(valley), trials=10)
    with searching(tuning) as search:
        search._ask(13)
    assert go(tuning, monkeypatch, Sea(valley)) == whole


@pytest.mark.slow
def test_the_same_seed_gives_the_same_search_and_another_seed_another(tmp_path, monkeypatch) -> None:
    first, second, third = (
        go(prepare(experiment(), out=tmp_path / str(k), seed=seed), monkeypatch, Sea(valley), 12)
        for k, seed in enumerate((0, 0, 1))
    )
    assert first == second
    assert [trial.factors for trial in first[1:]] != [trial.factors for trial in third[1:]]


def test_another_range_estimator_or_log_begins_a_new_study_and_is_reported(tmp_path, monkeypatch) -> None:
    one = prepare(experiment(), out=tmp_path)
    go(one, monkeypatch, Sea(valley), 5)
    with searching(one) as search:
        assert "5 trials were done already" in search.notes
    gated = [{"name": "eskf", "with": {"gate": {"gps": 0.999}}}]
    longer = [{"scenario": {"duration_s": 21, "imu": "industrial"}, "name": "sim"}]
    others = [
        prepare(experiment(), span=(0.2, 5.0), out=tmp_path),
        prepare(experiment(estimators=gated), out=tmp_path),
        prepare(experiment(logs=longer), out=tmp_path),
        prepare(experiment(), sensors=["dvl"], out=tmp_path),
    ]
    assert len({one.identity, *(other.identity for other in others)}) == 5
    with searching(others[0]) as search:
        assert search.resumed == 0
        assert any(note.startswith("a new study: the 1 before") for note in search.notes)


def test_a_trial_that_diverges_is_a_bad_one_and_no_crash(tuning, monkeypatch) -> None:
    def cliff(factors: dict[str, float], log: str, seed: int | None) -> float | None:
        return None if factors["dvl"] < 1 and seed == 2 else valley(factors, log, seed)

    trials = go(tuning, monkeypatch, Sea(cliff), 40)
    assert all((trial.loss is None) == (trial.factors["dvl"] < 1) for trial in trials)
    assert "sim/2: diverged: lost" in {trial.cause for trial in trials}
    later = [trial.factors["dvl"] for trial in trials[20:]]
    assert np.mean(np.array(later) > 1) > 0.7  # the search learns to stay away


def test_where_every_trial_fails_the_search_ends_and_says_why(tuning, monkeypatch) -> None:
    sea = Sea(lambda *_: None)
    with pytest.raises(ExperimentError, match="eskf: no trial finished; sim/1: diverged: lost"):
        go(tuning, monkeypatch, sea)
    assert len(sea.asked) <= 10 * 6


# -- whether it is confirmed -------------------------------------------------------------------------------------------


def test_a_gain_that_what_is_held_out_bears_out_is_not_warned_of(tuning, monkeypatch) -> None:
    def noisy(factors: dict[str, float], log: str, seed: int | None) -> float:
        luck = np.random.default_rng(seed).normal(0, 0.02) * math.log(factors["dvl"])
        return valley(factors, log, seed) * math.exp(luck)

    outcome = end(tuning, monkeypatch, noisy)
    assert outcome.best.factors["dvl"] == pytest.approx(3, rel=0.2)
    assert not outcome.warnings


def test_a_gain_on_training_alone_is_warned_of(tuning, monkeypatch) -> None:
    """Each run has a best factor of its own, drawn about 1: what suits the training runs suits no other."""

    def own(factors: dict[str, float], log: str, seed: int | None) -> float:
        mine = np.random.default_rng(seed).normal(0, 0.5)
        if seed is not None and seed <= 6:
            mine = 0.8
        return math.exp((math.log(factors["dvl"]) - mine) ** 2)

    outcome = end(tuning, monkeypatch, own)
    assert outcome.best.number != 0
    assert any("is not confirmed on held-out runs" in warning for warning in outcome.warnings)


def test_a_smaller_gain_on_what_is_held_out_is_distinguished_from_none(tuning, monkeypatch) -> None:
    def half(factors: dict[str, float], log: str, seed: int | None) -> float:
        share = 1.0 if seed is not None and seed <= 6 else 0.3
        return valley(factors, log, seed) ** share

    (warning,) = end(tuning, monkeypatch, half).warnings
    assert warning.startswith("training and held-out runs differ: a gain of ")


def test_the_best_at_an_end_of_the_range_is_reported(tuning, monkeypatch) -> None:
    outcome = end(tuning, monkeypatch, lambda factors, *_: 1 / factors["dvl"], 40)
    assert any(warning.startswith("dvl: the best factor, ") for warning in outcome.warnings)


def test_a_dial_that_does_not_matter_is_flat_and_one_that_does_is_sharp(tuning, monkeypatch) -> None:
    outcome = end(tuning, monkeypatch, lambda factors, *_: 1 + 0.1 * math.log(factors["dvl"] / 2) ** 2, 40)
    low, high = outcome.near("dvl")
    assert low <= outcome.best.factors["dvl"] <= high < low * 2
    low, high = outcome.near("gps")
    assert high / low > 3


def test_the_outcome_is_written_and_its_yaml_makes_the_tuned_estimator(tuning, monkeypatch) -> None:
    outcome = end(tuning, monkeypatch, valley)
    names = {path.name for path in write_outcome(outcome)}
    assert names == {"trials.csv", "tuned.yaml", "factors.pdf", "factors.png"}
    (entry,) = yaml.safe_load((tuning.folder / "tuned.yaml").read_text())
    assert create(entry["name"], **entry["with"]).inflate["dvl"] == pytest.approx(
        outcome.best.factors["dvl"], rel=0.005
    )
    assert len((tuning.folder / "trials.csv").read_text().splitlines()) == 31


def test_optuna_missing_is_one_line_that_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "optuna", None)
    file = tmp_path / "t.yaml"
    file.write_text(yaml.safe_dump({"logs": [SHORT], "estimators": [{"name": "eskf"}], "seeds": 2}))
    code, _, err = call("tune", file, "--out", tmp_path)
    assert code == 2
    assert "pip install 'fathom-bench[tune]'" in err.splitlines()[-1]


# -- real runs --------------------------------------------------------------------------------------------------------


def misstated(folder: Path, name: str, seed: int, factor: float) -> dict[str, str]:
    """Write a log whose DVL is `factor` times noisier than its log.yaml says."""
    log = simulate(Scenario(duration_s=60, imu="industrial"), seed)
    assert log.dvl is not None
    write_folder(replace(log, dvl=replace(log.dvl, sigma=log.dvl.sigma / factor)), folder / name, "csv")
    return {"log": str(folder / name)}


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_tuning_finds_by_how_much_the_sheet_is_wrong_on_logs_it_never_opened(tmp_path: Path, factor: float) -> None:
    """NIS over 60 s at 5 Hz has 900 degrees of freedom, so ln σ is known to 1/√1800 = 0.024; and the search's grain.

    What is held out cannot be read until the search is over: whoever opened it would fail.
    """
    logs = [misstated(tmp_path, name, seed, factor) for name, seed in (("train", 1), ("other", 2))]
    held_out = tmp_path / "other" / "log.yaml"
    content = held_out.read_text()
    held_out.write_text("{nobody: [may read this")
    file = tmp_path / "t.yaml"
    file.write_text(yaml.safe_dump({"logs": logs, "estimators": [{"name": "eskf"}]}))
    command = ("tune", file, "--out", tmp_path / "r", "--train", "train", "--score", "nis_dvl", "--sensor", "dvl",
               "--trials", 30, "--span", 6, "--jobs", 1)  # fmt: skip
    code, out, err = call(*command)
    assert code == 1
    assert "held out, other: failed: DatasetError" in out
    assert "training on train; held out: other" in err

    held_out.write_text(content)
    code, out, err = call(*command)
    assert code == 0
    assert "30 trials were done already" in err
    (entry,) = yaml.safe_load((tmp_path / "r" / "t" / "tuning" / "eskf" / "tuned.yaml").read_text())
    assert abs(math.log(entry["with"]["inflate"]["dvl"] / factor)) < 4 * 0.024 + 0.05
    assert factor == 1.0 or "warning" not in out  # the other log has the same wrong sheet
