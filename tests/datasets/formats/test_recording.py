"""The contract of loaders: formats of ours and of other people's packages, and every way in which one can be missed."""

from __future__ import annotations

import builtins
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError
from fathom.datasets.described.opening import open_log
from fathom.datasets.formats.recording import LOADERS, Recording, extra, known_formats, loader, not_found
from packages import distribution

NOISE = dict.fromkeys(
    ("gyro_density", "accel_density", "gyro_walk", "accel_walk", "gyro_bias_sigma", "accel_bias_sigma"), 1e-3
)
STREAMS: dict[str, Any] = {
    "imu": {
        "message": {"names": ["Inertial"], "entity": 2},
        "time": {"column": "host", "unit": "us"},
        "gyro": {"columns": ["p", "q", "r"], "unit": "deg/s"},
        "accel": {"columns": ["fx", "fy", "fz"], "unit": "m/s^2"},
        "axes": "FRD",
        "noise": NOISE,
    },
    "depth": {
        "message": {"names": ["Depth"]},
        "time": {"column": "host", "unit": "us"},
        "depth": {"columns": ["metres"], "unit": "m"},
        "sigma_m": 0.1,
    },
}
LOADER = '''
"""A loader as another package brings it: lines of `name sender host numbers`."""

from typing import ClassVar

import numpy as np

from fathom.datasets import DatasetError
from fathom.datasets.formats.recording import TopicInfo, Messages, Recording, not_found

FIELDS = {"Inertial": ("p", "q", "r", "fx", "fy", "fz"), "Depth": ("metres",)}


class LinesRecording(Recording):
    host_clock: ClassVar = ("host", "us")
    scale: float = 1.0

    def rows(self, folder):
        for line in self.path(folder).read_text().splitlines():
            name, sender, host, *numbers = line.split()
            yield name, int(sender), int(host), [float(x) * self.scale for x in numbers]

    def read(self, folder, wanted):
        found = []
        for want in wanted:
            if want.message not in FIELDS:
                raise not_found(str(self.path(folder)), "message", want.message, FIELDS)
            rows = [row for row in self.rows(folder) if row[0] == want.message and want.sender in (None, row[1])]
            columns = {"host": np.array([row[2] for row in rows])}
            columns |= dict(zip(FIELDS[want.message], np.array([row[3] for row in rows]).T))
            found.append({column: columns[column] for column in want.columns})
        return Messages(found, (f"lines: {len(found)} kinds read",))

    def contents(self, folder):
        return [TopicInfo("Inertial", "", 10, 1.0, FIELDS["Inertial"], 2)]
'''


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Two packages with loaders: one sound, one that cannot be imported and one whose class is not there."""
    site = tmp_path / "site"
    distribution(site, "lines", "[fathom.loaders]\nlines = lines_format:LinesRecording\n", lines_format=LOADER)
    points = "[fathom.loaders]\nwreck = wreck_format:Wreck\nhalf = half_format:Gone\nimc = wreck_format:Wreck\n"
    distribution(site, "wrecks", points, wreck_format="import no_such_module_here", half_format="")
    monkeypatch.syspath_prepend(str(site))
    yield tmp_path
    for module in ("lines_format", "half_format"):
        sys.modules.pop(module, None)


def described(folder: Path, **changes: Any) -> Path:
    lines = [f"Inertial {s} {10**9 + i * 10**5} {i} 0 0 1 2 {-9.8 - s}" for i in range(10) for s in (1, 2)]
    lines += [f"Depth 7 {10**9 + i * 10**6} {i}.5" for i in range(2)]
    (folder / "a.lines").write_text("\n".join(lines))
    keys = {key: value for key, value in {"format": "lines", "file": "a.lines", **changes}.items() if value is not None}
    (folder / "log.yaml").write_text(yaml.safe_dump({"recording": keys, "streams": STREAMS}))
    return folder


def test_a_loader_of_another_package_opens_a_log(installed):
    log = open_log(described(installed))
    np.testing.assert_allclose(log.imu.w_WI_I[:, 0], np.radians(np.arange(10)))
    np.testing.assert_allclose(log.imu.f_I, [[1, -2, 11.8]] * 10)
    np.testing.assert_array_equal(log.imu.t_ns, 10**12 + np.arange(10) * 10**8)
    np.testing.assert_array_equal(log.streams["depth"].z[:, 0], [-0.5, -1.5])
    assert log.notes == ("lines: 2 kinds read",)


def test_a_loaders_own_keys_stand_in_the_description(installed):
    log = open_log(described(installed, scale=2.0))
    np.testing.assert_array_equal(log.streams["depth"].z[:, 0], [-1.0, -3.0])


def test_known_formats_are_ours_and_theirs(installed):
    assert {"lines", "wreck", "half"} | set(LOADERS) == set(known_formats())
    assert loader("lines").__name__ == "LinesRecording"


@pytest.mark.parametrize("name", sorted(LOADERS))
def test_every_loader_of_ours_keeps_the_contract(name):
    kind = loader(name)
    assert issubclass(kind, Recording)
    assert not kind.__abstractmethods__
    column, unit = kind.host_clock
    assert column
    assert unit in ("s", "ms", "us", "ns")
    assert {"format", "file"} <= set(kind.model_fields)
    assert kind.model_config.get("extra") == "forbid"
    assert kind.model_config.get("frozen")


def test_ours_win_over_a_package_of_the_same_name(installed):
    assert loader("imc").__module__ == "fathom.datasets.formats.imc"


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"format": "line"}, r"log.yaml: `recording.format`: no format 'line'; did you mean 'lines'\? \(known: a.*imc"),
        ({"format": 7}, r"log.yaml: `recording.format`: no format 7 \(known: "),
        ({"format": ["imc"]}, r"log.yaml: `recording.format`: no format \['imc'\]"),
        ({"format": None}, r"log.yaml: missing key `recording.format`"),
        ({"file": None}, r"log.yaml: missing key `recording.file`"),
        ({"file": 3}, r"log.yaml: `recording.file`: expected text, found 3"),
        ({"fiel": "x"}, r"unknown key `recording.fiel`; did you mean 'file'\? \(known: format, file, scale\)"),
        ({"scale": "much"}, r"log.yaml: `recording.scale`: .*found 'much'"),
        ({"file": "b.lines"}, r"b.lines: no such file; did you mean 'a.lines'\?"),
        (
            {"format": "wreck"},
            r"`recording.format`: format 'wreck': cannot be loaded from the package 'wrecks': ModuleNotFound.*_here",
        ),
        ({"format": "half"}, r"format 'half': cannot be loaded from the package 'wrecks': AttributeError: .*'Gone'"),
    ],
)
def test_what_is_wrong_with_a_recording_is_named(installed, changes, error):
    with pytest.raises(DatasetError, match=error) as caught:
        open_log(described(installed, **changes))
    assert str(caught.value).startswith(str(installed))


def test_a_package_that_hangs_on_import_is_given_up(installed, monkeypatch):
    """Also where it catches the interruption once."""
    hangs = "import time\ntry:\n    time.sleep(60)\nexcept Exception:\n    time.sleep(60)\n"
    distribution(installed / "site", "stuck", "[fathom.loaders]\nstuck = stuck_format:Stuck\n", stuck_format=hangs)
    monkeypatch.setattr("fathom.datasets.errors.LOAD_S", 0.1)
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(DatasetError, match=r"'stuck'.*TimeoutError: not done after 0\.1 s, and given up"):
        open_log(described(installed, format="stuck"))
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_recording_must_be_keys_and_values(installed):
    (installed / "log.yaml").write_text(yaml.safe_dump({"recording": "a.lines", "streams": STREAMS}))
    with pytest.raises(DatasetError, match=r"log.yaml: `recording`"):
        open_log(installed)


def test_a_message_that_the_recording_has_not_gets_its_nearest(installed):
    streams = {**STREAMS, "depth": {**STREAMS["depth"], "message": {"names": ["Dept"]}}}
    folder = described(installed)
    keys = {"format": "lines", "file": "a.lines"}
    (folder / "log.yaml").write_text(yaml.safe_dump({"recording": keys, "streams": streams}))
    with pytest.raises(
        DatasetError, match=r"a.lines: no message 'Dept'; did you mean 'Depth'\?; found Depth, Inertial"
    ):
        open_log(folder)


def test_a_missing_extra_is_named_with_the_command_that_brings_it(tmp_path, monkeypatch):
    """As it is on a machine without pymavlink."""
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.split(".")[0] == "pymavlink":
            raise ModuleNotFoundError("No module named 'pymavlink'", name="pymavlink")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    (tmp_path / "a.BIN").touch()
    flight = loader("ardupilot").model_validate({"format": "ardupilot", "file": "a.BIN"})
    with pytest.raises(DatasetError) as error:
        flight.contents(tmp_path)
    assert str(error.value) == (
        "No module named 'pymavlink'; this format needs an extra: pip install 'fathom-bench[ardupilot]'"
    )


def test_an_extra_hides_no_other_error():
    with pytest.raises(ZeroDivisionError), extra("ros"):
        _ = 1 / 0
    with pytest.raises(DatasetError, match=r"fathom-bench\[ros\]"), extra("ros"):
        raise ImportError("libfoo.so.1: cannot open shared object file")


def test_what_is_not_held_is_listed_with_what_is_and_not_with_all_of_it():
    names = [f"/topic/{i:03d}" for i in range(100)]
    told = str(not_found("x.bag", "topic", "/topic/0033", names))
    assert told.startswith("x.bag: no topic '/topic/0033'; did you mean '/topic/0")
    assert told.endswith("/topic/039, …")
    assert str(not_found("x.bag", "topic", "/imu", [])) == "x.bag: no topic '/imu'; found none"


def test_a_recording_without_a_folder_is_reported(tmp_path):
    flight = loader("imc").model_validate({"format": "imc", "file": "gone/a.lsf"})
    with pytest.raises(DatasetError, match=r"gone/a.lsf: no such file$"):
        flight.path(tmp_path)
