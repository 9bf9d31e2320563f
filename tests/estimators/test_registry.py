"""Estimators are made by name; a name or an option that is not known is an error that helps."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import pytest
from fathom.estimators import ESTIMATORS, Estimator, create
from fathom.estimators.registry import EstimatorError


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
        ("fls", {"lags": 3.0}, "did you mean 'lag_s'"),
        ("fls", {"lag_s": -1.0}, "lag_s"),
        ("fls", {"lag_s": float("nan")}, "lag_s"),
        ("fls", {"dvl": ["preintegrated"]}, "preintegrated-loose"),
        ("eskf", {"factors": ["dvll"]}, "did you mean 'dvl'"),
        ("eskf", {"inflate": {"headin": 2.0}}, "did you mean 'heading'"),
        ("eskf", {"inflate": {"dvl": -2.0}}, "inflate"),
    ],
)
def test_what_is_not_known_is_an_error_that_names_it(name: str, options: dict[str, object], message: str) -> None:
    with pytest.raises(EstimatorError, match=message):
        create(name, **options)
