"""Estimators are made by name; a name or an option that is not known is an error that helps."""

from __future__ import annotations

import sys
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest
from fathom.estimators import ESTIMATORS, Estimator, create
from fathom.estimators.registry import EstimatorError, known_estimators, load_estimator


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_is_a_frozen_configuration_with_defaults(name: str) -> None:
    estimator = create(name)
    assert isinstance(estimator, Estimator)
    assert estimator == create(name)
    with pytest.raises(FrozenInstanceError):
        estimator.factors = frozenset()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("eskff", {}, "did you mean 'eskf'"),
        ("eskf", {"name": "x"}, "no option 'name'"),
        ("fls", {"lags": 3.0}, "did you mean 'lag_s'"),
        ("fls", {"lag_s": -1.0}, "lag_s"),
        ("fls", {"lag_s": float("nan")}, "lag_s"),
        ("fls", {"wildfire": -1e-3}, "wildfire"),
        ("fls", {"extra_updates": -1}, "extra_updates"),
        ("fls-batch", {"wildfire": 0.0}, "no option 'wildfire'"),
        ("fls", {"robust": {"gsp": "huber"}}, "did you mean 'gps'"),
        ("batch", {"robust": {"gps": "hubert"}}, "'huber', 'cauchy' or 'tukey'"),
        ("fls", {"dvl": ["preintegrated"]}, "preintegrated-loose"),
        ("fls", {"dvl": ["preintegrated-loose", "preintegrated-tight"]}, "used twice"),
        ("eskf", {"factors": ["dvll"]}, "did you mean 'dvl'"),
        ("eskf", {"inflate": {"headin": 2.0}}, "did you mean 'heading'"),
        ("eskf", {"inflate": {"dvl": -2.0}}, "inflate"),
    ],
)
def test_what_is_not_known_is_an_error_that_names_it(name: str, options: dict[str, object], message: str) -> None:
    with pytest.raises(EstimatorError, match=message):
        create(name, **options)


def test_a_broken_package_is_named_and_spoils_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wrecks-1.0.dist-info").mkdir()
    (tmp_path / "wreck.py").write_text("import no_such_module_here")
    (tmp_path / "sound.py").write_text("class Sound: pass")
    (tmp_path / "wrecks-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: wrecks\nVersion: 1.0\n")
    points = "[fathom.estimators]\nwreck = wreck:Wreck\nsound = sound:Sound\n"
    (tmp_path / "wrecks-1.0.dist-info" / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "sound", raising=False)
    assert {"wreck", "sound", "eskf"} <= set(known_estimators())
    assert load_estimator("sound").__name__ == "Sound"
    with pytest.raises(
        EstimatorError, match=r"wreck: cannot be loaded from the package 'wrecks': ModuleNotFound.*_here"
    ):
        create("wreck")
    with pytest.raises(EstimatorError, match="no estimator 'eskff'"):
        create("eskff")
