"""Estimators are made by name; a name or an option that is not known is an error that helps."""

from __future__ import annotations

import locale
import os
import signal
import sys
import warnings
from dataclasses import FrozenInstanceError
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fathom.estimators import ESTIMATORS, Estimator, create, registry
from fathom.estimators.registry import EstimatorError, known_estimators, load_estimator, package_of
from packages import distribution


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
    points = "[fathom.estimators]\nwreck = wreck:Wreck\nsound = sound:Sound\n"
    distribution(tmp_path, "wrecks", points, wreck="import no_such_module_here", sound="class Sound: pass")
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


def test_what_is_installed_is_read_once_however_many_estimators_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def counted(group: str) -> Any:
        asked.append(group)
        return entry_points(group=group)

    monkeypatch.setattr(registry, "entry_points", counted)
    distribution(tmp_path, "sounds", "[fathom.estimators]\nsound = sound:Sound\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for _ in range(3):
        create("eskf")
        assert package_of("sound") == "sounds 1.0"
    assert asked == ["fathom.estimators"]


PLAIN = """
from dataclasses import dataclass
from typing import Literal
from fathom.estimators import FACTORS

@dataclass(frozen=True)
class Plain:
    gain: float = 0.5
    mode: Literal["slow", "fast"] = "slow"
    factors: frozenset[str] = FACTORS

    def begin(self, prior, rig):
        return None

class NoDataclass:
    factors = FACTORS

    def begin(self, prior, rig):
        return None

@dataclass(frozen=True)
class NoBegin:
    factors: frozenset[str] = FACTORS

@dataclass(frozen=True)
class NoFactors:
    def begin(self, prior, rig):
        return None

@dataclass(frozen=True)
class Exits(Plain):
    def __post_init__(self):
        raise SystemExit(0)

def function():
    return Plain()
"""


def install(folder: Path, name: str, source: str, **points: str) -> None:
    """Put a package with these estimators, by their names, into a folder."""
    lines = [f"{point} = {name}:{what}" for point, what in points.items()]
    distribution(folder, name, "\n".join(["[fathom.estimators]", *lines]), **{name: source})


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("plain_one", "plain_two", "leaver", "meddler"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def test_options_of_a_plain_dataclass_have_its_types(site: Path) -> None:
    install(site, "plain_one", PLAIN, plain="Plain")
    made: Any = create("plain", gain="2", factors=["dvl"])
    assert (made.gain, made.factors) == (2.0, frozenset({"dvl"}))


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("Plain", {"gain": "much"}, "option 'gain': Input should be a valid number"),
        ("Plain", {"mode": "fats"}, "option 'mode': Input should be 'slow' or 'fast', found 'fats'"),
        ("Plain", {"gian": 1.0}, "no option 'gian'; did you mean 'gain'"),
        ("Plain", {"factors": ["dvll"]}, "Plain.factors: Value error, no sensor 'dvll'; did you mean 'dvl'"),
        ("NoDataclass", {}, "is not a dataclass, whose fields are the options; docs/your-own-estimator.md"),
        ("function", {}, "is not a dataclass, whose fields are the options"),
        ("NoBegin", {}, "NoBegin has no method begin(prior, rig); docs/your-own-estimator.md has the interface"),
        ("NoFactors", {}, "NoFactors has no `factors`, the sensors that it is given"),
        ("Exits", {}, "SystemExit: 0"),
    ],
)
def test_what_is_no_estimator_is_refused_when_it_is_made(
    site: Path, name: str, options: dict[str, Any], says: str
) -> None:
    install(site, "plain_one", PLAIN, other=name)
    with pytest.raises(EstimatorError, match=r"^other: ") as caught:
        create("other", **options)
    assert says in str(caught.value)


def test_a_name_that_two_packages_use_is_refused_and_both_are_named(site: Path) -> None:
    install(site, "plain_one", PLAIN, plain="Plain", eskf="Plain", own="Plain")
    install(site, "plain_two", PLAIN, plain="Plain")
    with pytest.raises(EstimatorError, match=r"plain: several packages .*\(plain.one 1.0, plain.two 1.0\); rename"):
        create("plain")
    with pytest.raises(EstimatorError, match=r"eskf: several packages .*\(fathom, plain.one 1.0\); rename"):
        create("eskf")
    assert create("own")
    assert create("iekf")


def test_a_package_that_exits_when_imported_ends_nothing(site: Path) -> None:
    install(site, "leaver", "import sys\nsys.exit(0)\n", leaver="Leaver")
    with pytest.raises(EstimatorError, match="leaver: cannot be loaded from the package 'leaver': SystemExit: 0"):
        create("leaver")


SLOW = """
import time
from dataclasses import dataclass
@dataclass(frozen=True)
class Slow:
    def __post_init__(self):
        time.sleep(60)
"""


def test_a_package_that_hangs_when_imported_or_configured_is_given_up(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(site, "stuck", "import time\ntime.sleep(60)\n", stuck="Stuck")
    install(site, "slow", SLOW, slow="Slow")
    monkeypatch.setattr("fathom.datasets.errors.LOAD_S", 0.1)
    monkeypatch.setattr("fathom.estimators.registry.LOAD_S", 0.1)
    for name in ("stuck", "slow"):
        with pytest.raises(EstimatorError, match=rf"{name}: .*TimeoutError: not done after 0\.1 s, and given up"):
            create(name)


MEDDLES = """
import locale, os, signal, sys, warnings
import numpy as np
os.chdir("/")
os.environ["FATHOM_DATA"] = "/nowhere"
del os.environ["HOME"]
np.seterr(all="raise")
sys.setrecursionlimit(5000)
signal.signal(signal.SIGINT, signal.SIG_IGN)
warnings.simplefilter("ignore")
locale.setlocale(locale.LC_ALL, "C")
print("loud")
"""


def state() -> tuple[Any, ...]:
    handler, language = signal.getsignal(signal.SIGINT), locale.setlocale(locale.LC_ALL)
    return os.getcwd(), dict(os.environ), np.geterr(), sys.getrecursionlimit(), handler, warnings.filters[:], language


def test_importing_a_package_leaves_this_process_as_it_was(
    site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(site, "meddler", MEDDLES + PLAIN, meddler="Plain")
    monkeypatch.setenv("HOME", str(site))
    before = state()
    create("meddler")
    assert state() == before
    assert capsys.readouterr() == ("", "loud\n")
